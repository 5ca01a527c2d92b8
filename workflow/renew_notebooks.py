"""Renew the executed notebooks that are stored in the repository from the runs of a profile.

    python workflow/renew_notebooks.py config/demo.yaml

Each notebook takes the outputs of the run whose parameters are its defaults, so it shows what a reader gets who runs it
without any. Times, paths and widget states are dropped, and a digest says for which code and profile the outputs hold.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import nbformat

import chapters
from chapters import CHAPTERS, NOTEBOOKS, ROOT, ChapterError, Run, literal_assignments, tagged_cells
from rol.files import write_text

LARGEST_MB = 1.5
KEPT_METADATA = ("kernelspec", "language_info")


def default_run(config: dict, chapter: str) -> Run:
    """Find the run of a chapter whose session and method are the notebook's defaults."""
    defaults = chapters.notebook_parameters(NOTEBOOKS / f"{chapter}.ipynb")
    for run in chapters.all_runs(config):
        own = {"session": run.session, "method": run.method}
        if run.chapter == chapter and all(defaults.get(key) == value for key, value in own.items() if value):
            return run
    raise ChapterError(f"notebooks/{chapter}.ipynb: its default session and method are no run of the profile")


def drop_injected(notebook: nbformat.NotebookNode, name: str) -> None:
    """Drop the cell of parameters that papermill put in, after a look that they are the defaults (in place)."""
    defaults = literal_assignments(tagged_cells(notebook, "parameters")[0].source, name)
    for cell in tagged_cells(notebook, "injected-parameters"):
        other = {k: v for k, v in literal_assignments(cell.source, name).items() if defaults.get(k) != v}
        if other:
            raise ChapterError(f"{name}: ran with {other}, which are not its defaults")
        notebook.cells.remove(cell)


def strip(notebook: nbformat.NotebookNode) -> None:
    """Drop what differs from run to run or from machine to machine (in place)."""
    for key in set(notebook.metadata) - set(KEPT_METADATA):
        del notebook.metadata[key]
    count = 0
    for cell in notebook.cells:
        for key in ("papermill", "execution", "ExecuteTime"):
            cell.metadata.pop(key, None)
        if cell.cell_type != "code" or cell.execution_count is None:
            continue
        count += 1
        cell.execution_count = count
        for output in cell.outputs:
            output.get("data", {}).pop("application/vnd.jupyter.widget-view+json", None)
            if output.output_type == "execute_result":
                output.execution_count = count
            if output.output_type == "stream":
                output.text = output.text.replace(f"{ROOT}/", "")
            for kind, text in output.get("data", {}).items():
                if kind.startswith("text/") and isinstance(text, str):
                    output.data[kind] = re.sub(r" at 0x[0-9a-f]+", "", text.replace(f"{ROOT}/", ""))


def renew(config_path: str) -> None:
    """Renew every stored notebook from the runs of a profile."""
    config = chapters.load_config(config_path)
    for chapter in CHAPTERS:
        path = NOTEBOOKS / f"{chapter}.ipynb"
        notebook = chapters.load_run(default_run(config, chapter).path(config["out_dir"]), path)
        drop_injected(notebook, path.name)
        strip(notebook)
        notebook.metadata["rol"] = {"digest": chapters.stored_digest(notebook, config)}
        text = nbformat.writes(notebook)
        if (megabytes := len(text.encode()) / 1e6) > LARGEST_MB:
            raise ChapterError(f"{path}: {megabytes:.2f} MB with its outputs; {LARGEST_MB} MB are allowed")
        write_text(path, text)
        print(f"renewed: {Path('notebooks', path.name)}")


if __name__ == "__main__":
    try:
        renew(sys.argv[1])
    except ChapterError as error:
        sys.exit(f"ERROR: {error}")
