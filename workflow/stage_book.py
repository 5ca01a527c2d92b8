"""Copy pages, executed notebooks and generated pages into one folder that Sphinx can build.

python workflow/stage_book.py config/demo.yaml           stages into the profile's book_dir
python workflow/stage_book.py --where config/demo.yaml   only says where the built book's first page lies
"""

from __future__ import annotations

import base64
import datetime
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

import nbformat
import yaml

import chapters
import check
from chapters import NOTEBOOKS, ROOT, ChapterError
from rol.files import read_text, write_text
from toolbox_pages import stage_toolbox

FIGURE_DATA = ("session", "real", "simulated", "both", "none")  # what a figure shows; none: no data
MADE_TITLE, STAGING = "# How this book was made", "# This book is being staged"  # first line of made.md
GLUED_KIND = "{glue:text}`kind`"
# The picture of the first page is taken from a run: the first of these that there is, and what the page says of it.
RESULT_FIGURES = (
    ("10_real_radar", "fig-story", "real.md"),
    ("07_localization", "fig-trajectory", "simulated.md"),
)


# ---- notebooks ------------------------------------------------------------------------------------------------


def figure_of(cell: nbformat.NotebookNode) -> dict:
    """Return the figure that the metadata of a cell describe, with its name and its caption; empty where it has none."""
    return cell.metadata.get("mystnb", {}).get("figure", {})


def name_folded_cells(notebook: nbformat.NotebookNode) -> None:
    """Hide the parameters, and label each hidden cell by what it holds (in place)."""
    names = {
        "parameters": "parameters",
        "injected-parameters": "parameters of this run",
        "hide-input": "plot code",
        "hide-cell": "setup",
    }
    for cell in notebook.cells:
        tags = cell.metadata.get("tags", [])
        tag = next((tag for tag in names if tag in tags), None)
        if tag is None:
            continue
        if tag.endswith("parameters"):
            cell.metadata["tags"] = [tag, "hide-input"]
        prompts = {f"code_prompt_{do}": f"{do.title()} {names[tag]}" for do in ("show", "hide")}
        cell.metadata["mystnb"] = cell.metadata.get("mystnb", {}) | prompts
        if tag == "hide-cell":
            names[tag] = "computation"  # of all but the first


def complete_captions(notebook: nbformat.NotebookNode, kind: str) -> None:
    """Add to the captions of figures that show the sessions whether those are simulated or real (in place).

    The metadata of every figure's cell state in `data` what the figure shows. Only "session" depends on the profile;
    the captions of the others name their data themselves, as do those that glue in the `kind`.
    """
    for cell in notebook.cells:
        figure, data = figure_of(cell), cell.metadata.get("data")
        if "caption" not in figure:
            continue
        if data not in FIGURE_DATA:
            fault = f"`data` in the metadata of its cell is {data!r}, none of {', '.join(FIGURE_DATA)}"
            raise ChapterError(f"figure {figure.get('name')}: {fault}")
        if data == "session" and GLUED_KIND not in figure["caption"]:
            figure["caption"] = f"{figure['caption'].strip()} {kind} data."


def stage_notebooks(config: dict, book: Path) -> None:
    """Copy the executed notebooks that the book shows; a run with a fault ends the staging."""
    kind = "Simulated" if all(session.startswith("sim-") for session in config["sessions"]) else "Real"
    (book / "notebooks").mkdir()
    for run in chapters.book_pages(config):
        notebook = chapters.load_run(run.path(config["out_dir"]), NOTEBOOKS / f"{run.chapter}.ipynb")
        name_folded_cells(notebook)
        complete_captions(notebook, kind)
        nbformat.write(notebook, book / "notebooks" / f"{run.chapter}.ipynb")


def png_of(cell: nbformat.NotebookNode) -> bytes | None:
    """Return the PNG among the outputs of a cell; none where the run drew none."""
    for output in cell.outputs:
        if "image/png" in output.get("data", {}):
            return base64.b64decode(output.data["image/png"])
    return None


def stage_result_figure(config: dict, book: Path) -> None:
    """Write the picture of the first page, and the words below it: of real data where a run shows them."""
    for chapter, name, words in RESULT_FIGURES:
        run = next((run for run in chapters.book_pages(config) if run.chapter == chapter), None)
        cells = chapters.read_notebook(run.path(config["out_dir"])).cells if run else []
        png = next((png_of(cell) for cell in cells if figure_of(cell).get("name") == name), None)
        if png:
            (book / "images").mkdir(exist_ok=True)
            (book / "images" / "result.png").write_bytes(png)
            shutil.copy(book / "images" / words, book / "picture.md")
            return
    raise ChapterError(f"notebooks/{chapter}.ipynb: no PNG figure named {name}, which the first page shows")


# ---- table of contents ----------------------------------------------------------------------------------------


def expand_contents(contents: dict, toolbox: list[dict]) -> dict:
    """Add the pages of the packages to the table of contents, below the entry of the toolbox (in place)."""
    for part in contents["parts"]:
        for entry in part["chapters"]:
            if entry["file"] == "toolbox/index":
                entry["sections"] = toolbox
    return contents


# ---- launch buttons -------------------------------------------------------------------------------------------


def launch_settings(environment: Mapping[str, str]) -> dict:
    """Return the settings of the button that opens a chapter on Binder; none where no address of the repository is known.

    Binder builds `environment.yml` with the whole repository around the notebook; what earlier chapters hand on is made
    there by `snakemake -c2 chapters` in a terminal. Colab opens a notebook alone, so no chapter would run there.

    Parameters
    ----------
    environment : mapping
        ``ROL_REPOSITORY_URL``, ``ROL_REPOSITORY_BRANCH`` ("main") and ``ROL_BINDERHUB_URL`` ("https://mybinder.org").

    Returns
    -------
    settings : dict
        Keys of `_config.yml`.

    Raises
    ------
    ChapterError
        If an address is not one that a browser can open.
    """
    if not environment.get("ROL_REPOSITORY_URL"):
        return {}
    addresses = []
    for name, default in (("ROL_REPOSITORY_URL", ""), ("ROL_BINDERHUB_URL", "https://mybinder.org")):
        address = environment.get(name) or default
        if urlsplit(address).scheme not in ("http", "https") or not urlsplit(address).netloc:
            raise ChapterError(f"{name}: not an address that begins with https:// ({address})")
        addresses.append(address.rstrip("/").removesuffix(".git"))
    branch = environment.get("ROL_REPOSITORY_BRANCH") or "main"
    return {
        "repository": {"url": addresses[0], "branch": branch},
        "launch_buttons": {"notebook_interface": "jupyterlab", "binderhub_url": addresses[1]},
    }


def stage_settings(book: Path, environment: Mapping[str, str]) -> None:
    """Complete the staged `_config.yml` by what this build knows; with nothing to add it stays as it is."""
    more = launch_settings(environment)
    if more:
        path = book / "_config.yml"
        write_text(path, yaml.safe_dump(yaml.safe_load(read_text(path)) | more, sort_keys=False))


# ---- generated pages ------------------------------------------------------------------------------------------


def commit() -> str:
    """Name the commit of the working tree, where git knows it."""
    words = ["git", "describe", "--always", "--abbrev=40", "--exclude=*"]
    words.append("--dirty=, with changes that are not committed")
    answer = subprocess.run(words, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    return answer.stdout.strip() if answer.returncode == 0 else "not known (no git repository)"


def markdown_table(header: list[str], lines: list[list[str]]) -> str:
    """Write a table in Markdown."""
    cells = [header, ["---"] * len(header), *lines]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in cells)


def reproduced_page(config: dict) -> str:
    """Fill the page that compares this build with the reference; without a reference its tables are empty."""
    has_reference = (check.REFERENCE / f"{config['profile']}.json").is_file()
    rows = check.compare_build(config) if has_reference else []
    made_on = check.read_reference(config["profile"])["machine"] if has_reference else {}
    tables = []
    for chapter in sorted({row.entry["chapter"] for row in rows}):
        own = [row for row in rows if row.entry["chapter"] == chapter]
        lines = [[*row.cells(), f"{row.entry['kind']}: {row.entry['reason']}"] for row in own]
        header = ["number", "reference", "this build", "tolerance", "result", "depends on"]
        title = f"### [Chapter {int(chapter[:2])}](notebooks/{chapter}.ipynb)"
        tables.append(f"{title}\n\n{markdown_table(header, lines)}")
    counts = [[result, str(n)] for result, n in [*check.count_results(rows).items(), ("all", len(rows))]]
    machines = [[k, made_on.get(k, ""), v] for k, v in (check.machine() | {"Commit": commit()}).items()]
    parts = {
        "counts": markdown_table(["result", "numbers"], counts),
        "numbers": "\n\n".join(tables),
        "machine": markdown_table(["what", "reference", "this build"], machines),
    }
    text = read_text(check.PAGE)
    for name, part in parts.items():
        text = text.replace(f"{{{{ {name} }}}}", part)
    return text


def how_made_page(config: dict, config_path: str) -> str:
    """Write the page that says when, from what, with what and in what time the book was made."""
    made = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    rows = {"Made": made, "Commit": commit(), "Profile": f"`{config_path}`", **check.machine()}
    times = []
    for run in chapters.all_runs(config):
        seconds = chapters.read_notebook(run.path(config["out_dir"])).metadata.papermill.duration
        times.append([run.chapter, run.session, run.method, f"{seconds:.0f}"])
    parts = [
        MADE_TITLE,
        markdown_table(["what", "this build"], [list(row) for row in rows.items()]),
        "## Time that each chapter took",
        markdown_table(["chapter", "session", "method", "s"], times),
        "## The profile",
        f"```yaml\n{read_text(config_path).strip()}\n```\n",
    ]
    return "\n\n".join(parts)


def clear(book: Path) -> None:
    """Remove a staged book; refuse a folder that holds files or links and is not a staged book."""
    made = book / "made.md"
    is_staged = made.is_file() and made.read_bytes().startswith((MADE_TITLE.encode(), STAGING.encode()))
    if not is_staged and any(path.is_file() or path.is_symlink() for path in book.rglob("*")):
        raise ChapterError(f"book_dir: {book}: holds files but no made.md of this program; left alone")
    if book.is_symlink():
        raise ChapterError(f"book_dir: {book}: a symbolic link; name the folder itself")
    shutil.rmtree(book, ignore_errors=True)
    write_text(made, STAGING)


def stage(config_path: str) -> Path:
    """Stage the whole book of a profile; return its folder."""
    config = chapters.load_config(config_path)
    book = Path(config["book_dir"])
    clear(book)
    shutil.copytree(ROOT / "book", book, ignore=shutil.ignore_patterns("._*"), dirs_exist_ok=True)
    stage_notebooks(config, book)
    stage_result_figure(config, book)
    toolbox = stage_toolbox(book)
    write_text(book / "made.md", how_made_page(config, config_path))
    write_text(book / "did_it_reproduce.md", reproduced_page(config))
    contents = expand_contents(yaml.safe_load(read_text(book / "_toc.yml")), toolbox)
    write_text(book / "_toc.yml", yaml.safe_dump(contents, sort_keys=False))
    stage_settings(book, os.environ)
    return book


if __name__ == "__main__":
    try:
        if sys.argv[1] == "--where":
            print(Path(chapters.load_config(sys.argv[2])["book_dir"], "_build", "html", "index.html"))
        else:
            print(f"staged: {stage(sys.argv[1])}")
    except ChapterError as error:
        sys.exit(f"ERROR: {error}")
