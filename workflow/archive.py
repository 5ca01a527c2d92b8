"""Pack the project and what `make book` made of it into one zip: code, executed notebooks, rendered book and results.

python workflow/archive.py config/demo.yaml

Every file keeps its path of the project; `index.html` opens the book, and `ro-crate-metadata.json` (an RO-Crate) lists
which command made which files from which inputs. Sessions, images, networks and checkpoints stay out. The same commit
and the same build give the same zip.
"""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from chapters import CHAPTERS, ROOT, all_runs, code_cells, load_config, read_notebook
from rol.files import write_bytes

RESULTS = {".csv", ".json", ".tum"}  # metrics, tables and trajectories
NOT_RESULTS = {"logs", "notebooks"}  # folders of out_dir without results
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"  # Process Run Crate
PROGRAM = re.compile(r"'[^']*/bin/([\w.-]+)'|\S*/bin/([\w.-]+)")  # a program of the environment, by its path
START_PAGE = '<!doctype html><title>{title}</title><meta http-equiv="refresh" content="0; url={book}">'
START_PAGE += '<a href="{book}">{title}</a>\n'


class ArchiveError(RuntimeError):
    """Raised if something that belongs into the archive is missing or out of date; names it and the remedy."""


class Job(NamedTuple):
    """A finished job of the workflow: its rule, what it read and wrote, and its command."""

    rule: str
    inputs: list[str]
    outputs: list[str]
    command: str


# ---- what there is --------------------------------------------------------------------------------------------


def run(*words: str, cwd: Path = ROOT) -> bytes:
    """Run a command and return its output; a failure is an error with its last line."""
    done = subprocess.run(words, cwd=cwd, capture_output=True, check=False)
    if done.returncode:
        last = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines() or ["no message"]
        raise ArchiveError(f"{' '.join(words[:2])}: {last[-1]}")
    return done.stdout


def read_code(root: Path) -> dict[str, tuple[bytes, bool]]:
    """Read the files of the last commit, each with whether it is executable.

    Raises
    ------
    ArchiveError
        If there is no git repository, or a tracked file differs from the commit.
    """
    changed = run("git", "status", "--porcelain", "--untracked-files=no", cwd=root).decode().splitlines()
    if changed:
        raise ArchiveError(f"{changed[0][3:]}: changed since the last commit; commit or restore it")
    tar = io.BytesIO(run("git", "archive", "--format=tar", "HEAD", cwd=root))
    with tarfile.open(fileobj=tar) as members:
        return {m.name: (members.extractfile(m).read(), bool(m.mode & 0o100)) for m in members if m.isfile()}


def parse_summary(table: str, profile: str) -> list[Job]:
    """Read the jobs of the workflow from the table that `snakemake --detailed-summary` prints.

    Raises
    ------
    ArchiveError
        If an output is missing or out of date; names the first one and the command that makes it.
    """
    jobs: dict[tuple[str, str], Job] = {}
    faults = []
    for line in table.splitlines()[1:]:
        output, _, rule, logs, inputs, command, status, plan = line.split("\t")
        if status == "missing" or plan != "no update":
            faults.append((output, "missing" if status == "missing" else "out of date"))
            continue
        command = PROGRAM.sub(lambda found: found[1] or found[2], command).partition(" || {")[0]
        read = [path for path in inputs.split(",") if path not in ("", "-")]
        job = jobs.setdefault((rule, output if logs == "-" else logs), Job(rule, read, [], command))
        job.outputs.append(output)
    if faults:
        more = f" (and {len(faults) - 1} more)" if faults[1:] else ""
        raise ArchiveError(
            f"{faults[0][0]}: {faults[0][1]}{more}; run `make book PROFILE={profile}` first. If that leaves it so: "
            f"`.venv/bin/snakemake --configfile config/{profile}.yaml --cores 2 {faults[0][0]}`"
        )
    return list(jobs.values())


def find_results(root: Path, config: Mapping[str, Any]) -> list[str]:
    """List the metrics, tables and trajectories of a build, as paths of the project."""
    out, book = root / config["out_dir"], root / config["book_dir"]
    found = [path for path in out.rglob("*") if path.suffix in RESULTS and book not in path.parents]
    found = [path for path in found if path.relative_to(out).parts[0] not in NOT_RESULTS]
    return sorted(path.relative_to(root).as_posix() for path in found)


def find_book(root: Path, config: Mapping[str, Any]) -> list[str]:
    """List the files of the rendered book."""
    html = root / config["book_dir"] / "_build" / "html"
    return sorted(path.relative_to(root).as_posix() for path in html.rglob("*") if path.is_file())


def assign_results(results: Iterable[str], config: Mapping[str, Any], root: Path) -> dict[str, str]:
    """Name the executed notebook that wrote each result.

    The notebooks write below ``Path(out_dir, "folder", ...)`` only, with the session and the method in the path.
    """
    folders = {}
    for chapter in CHAPTERS:
        path = root / "notebooks" / f"{chapter}.ipynb"
        code = "\n".join(code_cells(read_notebook(path))) if path.is_file() else ""
        folders |= dict.fromkeys(re.findall(r'\bout_dir,\s*"([\w-]+)"', code), chapter)
    writers = {}
    for result in results:
        parts = Path(result).relative_to(config["out_dir"]).with_suffix("").parts
        for one in all_runs(config):
            own = {one.session, one.method} - {""}
            if one.chapter == folders.get(parts[0]) and own <= set(parts):
                writers[result] = one.path(config["out_dir"]).as_posix()
    return writers


# ---- the crate ------------------------------------------------------------------------------------------------


def describe(files: Mapping[str, bytes], jobs: Iterable[Job], writers: Mapping[str, str]) -> bytes:
    """Describe the archive as an RO-Crate: the files, and an action for each job that made some of them.

    Parameters
    ----------
    files : mapping
        Content of every file of the archive by path.
    jobs : iterable of Job
        Jobs of the workflow.
    writers : mapping
        Executed notebook that wrote a result, for results that the workflow does not declare.

    Returns
    -------
    metadata : bytes
        Content of ``ro-crate-metadata.json``.
    """
    from rocrate.model.contextentity import ContextEntity
    from rocrate.rocrate import ROCrate

    citation = yaml.safe_load(files["CITATION.cff"])
    crate = ROCrate(version="1.1")
    crate.name, crate.license = citation["title"], f"https://spdx.org/licenses/{citation['license']}"
    crate.description = json.loads(files["codemeta.json"])["description"]
    crate.datePublished = citation["date-released"]
    crate.root_dataset["version"] = citation["version"]
    profile = {"@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}
    crate.root_dataset["conformsTo"] = crate.add(ContextEntity(crate, PROFILE, profile))
    authors = [{"@type": "Organization", "name": author["name"]} for author in citation["authors"]]
    authors = [ContextEntity(crate, f"#author-{n}", author) for n, author in enumerate(authors)]
    crate.root_dataset["author"] = [crate.add(author) for author in authors]
    for job in jobs:
        made = [*job.outputs, *(result for result, writer in writers.items() if writer in job.outputs)]
        add_action(crate, files, job, list(dict.fromkeys(made)))
    for path in sorted({"README.md", "CITATION.cff", "codecheck.yml", *writers} & set(files)):
        entity(crate, files, path)
    return json.dumps(crate.metadata.generate(), indent=1, sort_keys=True).encode() + b"\n"


def add_action(crate: Any, files: Mapping[str, bytes], job: Job, made: list[str]) -> None:
    """Add what one job did to a crate: its command, notebook, inputs, outputs and times."""
    from rocrate.model.contextentity import ContextEntity

    notebook = re.search(r"-m papermill '?([^\s']+)", job.command)
    source = notebook[1] if notebook else "Snakefile"
    instrument = entity(crate, files, source)
    properties = {
        "@type": "CreateAction",
        "name": f"{job.rule}: {made[0]}",
        "description": job.command,
        "instrument": {"@id": instrument.id},
        "object": [{"@id": entity(crate, files, path).id} for path in job.inputs if path != source],
        "result": [{"@id": entity(crate, files, path).id} for path in made],
        **times_of(files, made),
    }
    action = crate.add(ContextEntity(crate, f"#run-{made[0]}", properties))
    crate.root_dataset.append_to("mentions", action)


def times_of(files: Mapping[str, bytes], made: Iterable[str]) -> dict[str, str]:
    """Read start and end of a run from papermill's notes in the executed notebook, if it is there."""
    for path in made:
        if path.endswith(".ipynb") and path in files:
            notes = json.loads(files[path])["metadata"].get("papermill", {})
            words = {"startTime": notes.get("start_time"), "endTime": notes.get("end_time")}
            return {key: value for key, value in words.items() if value}
    return {}


def entity(crate: Any, files: Mapping[str, bytes], path: str) -> Any:
    """Describe a file as an entity; one that stays out of the archive is described without being part of it."""
    from rocrate.model.contextentity import ContextEntity
    from rocrate.model.file import File

    known = crate.dereference(path) or crate.dereference(f"#{path}")
    if known:
        return known
    if path in files:
        is_code = path == "Snakefile" or path.startswith("notebooks/")
        words = {"name": Path(path).name, "contentSize": str(len(files[path]))}
        words |= {"@type": ["File", "SoftwareSourceCode"]} if is_code else {}
        return crate.add(File(crate, dest_path=path, properties=words))
    words = {
        "@type": "CreativeWork",
        "name": path,
        "description": "Not in the archive; its command makes it.",
    }
    return crate.add(ContextEntity(crate, f"#{path}", words))


# ---- the zip --------------------------------------------------------------------------------------------------


def collect(root: Path, config: Mapping[str, Any], jobs: list[Job]) -> tuple[dict[str, bytes], set[str]]:
    """Collect the content of the archive by path, and the paths of executable files."""
    code = read_code(root)
    notebooks = [one.path(config["out_dir"]).as_posix() for one in all_runs(config)]
    results = find_results(root, config)
    files = {name: content for name, (content, _) in code.items()}
    files |= {path: (root / path).read_bytes() for path in (*notebooks, *results, *find_book(root, config))}
    title = yaml.safe_load(files["CITATION.cff"])["title"]
    address = f"{config['book_dir']}/_build/html/index.html"
    files["index.html"] = START_PAGE.format(title=title, book=address).encode()
    files["ro-crate-metadata.json"] = describe(files, jobs, assign_results(results, config, root))
    return files, {name for name, (_, executable) in code.items() if executable}


def make_zip(files: Mapping[str, bytes], executable: set[str], seconds: int) -> bytes:
    """Write a zip, sorted, with one time [s since 1970, UTC] for all files."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, time.gmtime(seconds)[:6])
            info.create_system, info.compress_type = 3, zipfile.ZIP_DEFLATED
            info.external_attr = (0o100755 if name in executable else 0o100644) << 16
            archive.writestr(info, files[name])
    return content.getvalue()


def pack(root: Path, config: Mapping[str, Any], summary: str) -> Path:
    """Write the archive of a profile.

    Parameters
    ----------
    root : Path
        Folder of the project.
    config : mapping
        The profile.
    summary : str
        What `snakemake --detailed-summary` prints for it.

    Returns
    -------
    path : Path
        The zip, ``build/radar-on-lidar-VERSION-PROFILE.zip``.

    Raises
    ------
    ArchiveError
        If a part is missing or out of date.
    """
    files, executable = collect(root, config, parse_summary(summary, config["profile"]))
    version = yaml.safe_load(files["CITATION.cff"])["version"]
    path = root / "build" / f"radar-on-lidar-{version}-{config['profile']}.zip"
    write_bytes(path, make_zip(files, executable, int(run("git", "log", "-1", "--format=%ct", cwd=root))))
    return path


def main(config_file: str) -> int:
    """Write the archive of a profile; return 0, or 1 after a fault."""
    command = [sys.executable, "-m", "snakemake", "--configfile", config_file, "--cores", "1"]
    try:
        summary = run(*command, "--detailed-summary", "book").decode()
        path = pack(ROOT, load_config(config_file), summary)
    except (ArchiveError, OSError) as error:
        print(f"archive: {error}", file=sys.stderr)
        return 1
    size = f"{path.stat().st_size / 1e6:.0f} MB"
    print(f"The archive: {path.relative_to(ROOT)} ({size}; unzip it into a folder and open index.html)")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
