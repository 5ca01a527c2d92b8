"""Put the book together: pages, executed notebooks and generated pages, copied into one folder that Sphinx can build.

python workflow/stage_book.py config/demo.yaml           stages into the profile's book_dir
python workflow/stage_book.py --where config/demo.yaml   only says where the built book's first page lies
"""

from __future__ import annotations

import ast
import base64
import datetime
import importlib.metadata
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import yaml

from chapters import (
    CHAPTERS,
    NOTEBOOKS,
    PACKAGE,
    ROOT,
    ChapterError,
    Run,
    all_runs,
    book_pages,
    load_config,
    load_run,
    tagged_cells,
)

VERSIONS_SHOWN = "numpy scipy opencv-python-headless numba pandas torch open3d-cpu matplotlib papermill snakemake jupyter-book"
# The picture of the first page, taken from a run: chapter, and the name of the figure in it.
RESULT_FIGURE = ("07_localization", "fig-trajectory")


# ---- notebooks ------------------------------------------------------------------------------------------------


def fold_injected(notebook: nbformat.NotebookNode) -> None:
    """Hide the cell of parameters that papermill put in behind a line that says what it is (in place)."""
    for cell in tagged_cells(notebook, "injected-parameters"):
        cell.metadata["tags"] = ["injected-parameters", "hide-input"]
        cell.metadata["mystnb"] = {"code_prompt_show": "Show the parameters of this run"}


def number_title(notebook: nbformat.NotebookNode, page: str) -> None:
    """Put the chapter's number before the notebook's title, and what sets the page apart from its like behind (in place)."""
    chapter, _, more = page.partition("-")
    cell = next(cell for cell in notebook.cells if cell.cell_type == "markdown")
    title = rf"# {int(chapter[:2])}. \1" + (f": {more}" if more else "")
    cell.source = re.sub(r"^# (.*)$", title, cell.source, count=1, flags=re.MULTILINE)


def complete_captions(notebook: nbformat.NotebookNode, kind: str) -> None:
    """Let every caption say what data it shows, virtual or real, where it does not say so itself (in place)."""
    for cell in notebook.cells:
        figure = cell.metadata.get("mystnb", {}).get("figure", {})
        if "caption" in figure and not re.search(
            r"\b(virtual|real (data|scan|session|route|car))|\{glue:text\}`kind`",
            figure["caption"],
            re.IGNORECASE,
        ):
            figure["caption"] = f"{figure['caption'].strip()} {kind} data."


DEFINED = re.compile(
    r"^\(([\w:.-]+)\)=\s*$|^:(?:label|name): *([\w:.-]+)\s*$|^\$\$ *\(([\w:.-]+)\)\s*$", re.MULTILINE
)
REFERRED = re.compile(r"(\{(?:ref|numref|eq)\}`(?:[^`<]*<)?|\]\(#?)([\w:.-]+)(?=>?`|\))")


def relabel(notebook: nbformat.NotebookNode, suffix: str) -> None:
    """Make the labels of a page its own, where one chapter is shown several times (in place).

    Labels are known to the whole book; the numbered equations, figures and targets of the second copy would clash with
    those of the first.
    """
    text = [cell for cell in notebook.cells if cell.cell_type == "markdown"]
    figures = [
        cell.metadata.mystnb.figure
        for cell in notebook.cells
        if cell.metadata.get("mystnb", {}).get("figure")
    ]
    labels = {label for cell in text for match in DEFINED.findall(cell.source) for label in match if label}
    labels |= {figure["name"] for figure in figures if "name" in figure}

    def renamed(match: re.Match) -> str:
        return match[1] + match[2] + (suffix if match[2] in labels else "")

    def redefined(match: re.Match) -> str:
        label = next(group for group in match.groups() if group)
        return match[0].replace(label, label + suffix)

    for cell in text:
        cell.source = REFERRED.sub(renamed, DEFINED.sub(redefined, cell.source))
    for figure in figures:
        if "name" in figure:
            figure["name"] += suffix
        if "caption" in figure:
            figure["caption"] = REFERRED.sub(renamed, figure["caption"])


def point_to_pages(text: str, pages: dict[str, Run]) -> str:
    """Point links between chapters to the pages of the book: a chapter shown several times to its first page."""
    for chapter in CHAPTERS:
        first = next(page for page, run in pages.items() if run.chapter == chapter)
        text = re.sub(rf"(?<![\w-]){chapter}(\.ipynb|\.md)", rf"{first}\1", text)
    return text


def stage_notebooks(config: dict, book: Path) -> None:
    """Copy the executed notebooks that the book shows; a run with a fault ends the staging."""
    pages = book_pages(config)
    seen: set[str] = set()
    kind = "Virtual" if all(session.startswith("virtual-") for session in config["sessions"]) else "Real"
    (book / "notebooks").mkdir()
    for page, run in pages.items():
        notebook = load_run(run.path(config["out_dir"]), NOTEBOOKS / f"{run.chapter}.ipynb")
        fold_injected(notebook)
        complete_captions(notebook, kind)
        number_title(notebook, page)
        if run.chapter in seen:
            relabel(notebook, re.sub(r"\W+", "-", page.removeprefix(run.chapter)))
        seen.add(run.chapter)
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                cell.source = point_to_pages(cell.source, pages)
        nbformat.write(notebook, book / "notebooks" / f"{page}.ipynb")


def stage_result_figure(config: dict, book: Path) -> None:
    """Write the picture of the first page from the run that shows it."""
    chapter, name = RESULT_FIGURE
    run = next(run for run in book_pages(config).values() if run.chapter == chapter)
    for cell in nbformat.read(run.path(config["out_dir"]), as_version=4).cells:
        if cell.metadata.get("mystnb", {}).get("figure", {}).get("name") == name:
            for output in cell.outputs:
                if "image/png" in output.get("data", {}):
                    (book / "images").mkdir(exist_ok=True)
                    (book / "images" / "result.png").write_bytes(base64.b64decode(output.data["image/png"]))
                    return
    raise ChapterError(f"notebooks/{chapter}.ipynb: no PNG figure named {name}, which the first page shows")


# ---- table of contents ----------------------------------------------------------------------------------------


def expand_contents(contents: dict, pages: dict[str, Run], modules: list[str]) -> dict:
    """Replace every chapter in the table of contents by its pages, and list the pages of the modules."""
    for part in contents["parts"]:
        entries = []
        for entry in part["chapters"]:
            name = entry["file"].removeprefix("notebooks/")
            if name in CHAPTERS:
                entries += [
                    {"file": f"notebooks/{page}"} for page, run in pages.items() if run.chapter == name
                ]
            elif entry["file"] == "toolbox/index":
                entries.append(entry | {"sections": [{"file": f"toolbox/{module}"} for module in modules]})
            else:
                entries.append(entry)
        part["chapters"] = entries
    return contents


# ---- generated pages ------------------------------------------------------------------------------------------


def as_text(docstring: str) -> str:
    """Make MyST show a docstring's words as they stand: only code in backticks keeps its meaning."""
    parts = re.split(r"(``?[^`]+``?)", docstring)
    return "".join(p if i % 2 else re.sub(r"([\\*_|<>\[\]{}$#~])", r"\\\1", p) for i, p in enumerate(parts))


def public_members(file: Path) -> list[tuple[str, str]]:
    """List the public functions and classes of a file with the first paragraph of their docstrings."""
    tree = ast.parse(file.read_text())
    kinds = ast.FunctionDef | ast.ClassDef
    return [
        (node.name, " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split()))
        for node in tree.body
        if isinstance(node, kinds) and not node.name.startswith("_")
    ]


def module_page(file: Path) -> str:
    """Write the page of one module: what it holds, and every function in full, ready to copy."""
    place = file.relative_to(PACKAGE)
    name = ".".join(place.with_suffix("").parts)
    docstring = ast.get_docstring(ast.parse(file.read_text())) or ""
    lines = [f"# {name}", "", as_text(docstring), "", f"File: `src/rol/{place.as_posix()}`", ""]
    for member, summary in public_members(file):
        lines += [f"## {member}", "", as_text(summary), "", "````{dropdown} The code", ""]
        lines += [
            f"```{{literalinclude}} ../src/rol/{place.as_posix()}",
            f":pyobject: {member}",
            ":language: python",
            "```",
        ]
        lines += ["````", ""]
    return "\n".join(lines)


def stage_toolbox(book: Path) -> list[str]:
    """Write a page for each module and their index; give the names of the pages."""
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if not file.name.startswith("__")]
    files.sort(key=lambda file: (len(file.relative_to(PACKAGE).parts), file))
    shutil.copytree(PACKAGE, book / "src" / "rol", ignore=shutil.ignore_patterns("__pycache__"))
    (book / "toolbox").mkdir()
    names, rows = [], []
    for file in files:
        name = "-".join(file.relative_to(PACKAGE).with_suffix("").parts)
        (book / "toolbox" / f"{name}.md").write_text(module_page(file))
        summary = (ast.get_docstring(ast.parse(file.read_text())) or "").splitlines()[:1]
        rows.append(f"- [{name.replace('-', '.')}]({name}.md): {as_text(summary[0] if summary else '')}")
        names.append(name)
    head = (
        "# All functions\n\nOne page for each file of `src/rol`, with every public function and its code.\n\n"
    )
    (book / "toolbox" / "index.md").write_text(head + "\n".join(rows) + "\n")
    return names


def git(*words: str) -> str:
    """Ask git, without minding when there is no repository."""
    answer = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return answer.stdout.strip() if answer.returncode == 0 else ""


def how_made_page(config: dict, config_path: str) -> str:
    """Write the page that says when, from what, with what and in what time the book was made."""
    commit = git("rev-parse", "HEAD") or "not known (no git repository)"
    if git("status", "--porcelain", "--untracked-files=no"):
        commit += ", with changes that are not committed"
    rows = [
        ("Made", datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ("Commit", commit),
        ("Profile", f"`{config_path}`"),
        ("Machine", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"),
        *((name, importlib.metadata.version(name)) for name in VERSIONS_SHOWN.split() if installed(name)),
    ]
    lines = [
        "# How this book was made",
        "",
        "| what | |",
        "|---|---|",
        *(f"| {k} | {v} |" for k, v in rows),
        "",
    ]
    lines += [
        "## Time that each chapter took",
        "",
        "| chapter | session | method | s |",
        "|---|---|---|---:|",
    ]
    for run in all_runs(config):
        metadata = nbformat.read(run.path(config["out_dir"]), as_version=4).metadata
        lines.append(f"| {run.chapter} | {run.session} | {run.method} | {metadata.papermill.duration:.0f} |")
    lines += ["", "## The profile", "", "```yaml", Path(config_path).read_text().strip(), "```", ""]
    return "\n".join(lines)


def installed(name: str) -> bool:
    """Say whether a distribution is installed."""
    return bool(list(importlib.metadata.distributions(name=name)))


def stage(config_path: str) -> Path:
    """Stage the whole book of a profile and give its folder."""
    config = load_config(config_path)
    book = Path(config["book_dir"])
    shutil.rmtree(book, ignore_errors=True)
    shutil.copytree(ROOT / "book", book)
    stage_notebooks(config, book)
    stage_result_figure(config, book)
    modules = stage_toolbox(book)
    (book / "made.md").write_text(how_made_page(config, config_path))
    pages = book_pages(config)
    for page in book.glob("*.md"):
        page.write_text(point_to_pages(page.read_text(), pages))
    contents = expand_contents(yaml.safe_load((book / "_toc.yml").read_text()), pages, modules)
    (book / "_toc.yml").write_text(yaml.safe_dump(contents, sort_keys=False))
    return book


if __name__ == "__main__":
    if sys.argv[1] == "--where":
        print(Path(load_config(sys.argv[2])["book_dir"], "_build", "html", "index.html"))
    else:
        try:
            print(f"staged: {stage(sys.argv[1])}")
        except ChapterError as error:
            sys.exit(f"ERROR: {error}")
