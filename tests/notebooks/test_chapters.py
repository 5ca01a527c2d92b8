"""Limits of a chapter: words, lines of code, and what a reader sees of the code."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest

from chapters import CHAPTERS, NOTEBOOKS, own_code
from stage_book import FIGURE_DATA

MOST_WORDS, MOST_LINES, WIDEST = 1600, 350, 80
HIDDEN = {"parameters", "hide-cell", "hide-input"}


@pytest.fixture(scope="module", params=CHAPTERS)
def notebook(request: pytest.FixtureRequest) -> nbformat.NotebookNode:
    return nbformat.read(Path(NOTEBOOKS, f"{request.param}.ipynb"), as_version=4)


def test_text_is_short(notebook: nbformat.NotebookNode) -> None:
    text = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    assert len("\n".join(text).split()) <= MOST_WORDS


def test_no_line_of_text_is_taken_for_a_comment(notebook: nbformat.NotebookNode) -> None:
    """MyST drops a line that begins with a percent sign, such as the rest of "10 % of the points"."""
    text = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    assert not re.search(r"^%", "\n".join(text), re.MULTILINE)


def test_code_is_short(notebook: nbformat.NotebookNode) -> None:
    lines = [line for cell in own_code(notebook) for line in cell.source.splitlines() if line.strip()]
    assert len(lines) <= MOST_LINES


def test_shown_code_fits_the_page(notebook: nbformat.NotebookNode) -> None:
    shown = [cell for cell in own_code(notebook) if not HIDDEN & set(cell.metadata.get("tags", []))]
    wide = [line for cell in shown for line in cell.source.splitlines() if len(line) > WIDEST]
    assert not wide


def test_setup_comes_first(notebook: nbformat.NotebookNode) -> None:
    """The cell below the parameters is hidden and holds the imports; no other cell imports a package of the project."""
    parameters, setup, *others = own_code(notebook)
    assert "parameters" in parameters.metadata["tags"] and "hide-cell" in setup.metadata["tags"]
    assert not any(re.search(r"^(from|import) rol", cell.source, re.MULTILINE) for cell in others)


def test_numbers_are_stored_in_one_way(notebook: nbformat.NotebookNode) -> None:
    assert not any(re.search(r"\bglue\(", cell.source) for cell in own_code(notebook))


def test_figures_and_tables_are_numbered_and_say_what_they_show(notebook: nbformat.NotebookNode) -> None:
    for cell in own_code(notebook):
        figure = cell.metadata.get("mystnb", {}).get("figure", {})
        if figure:
            assert re.match(r"(fig|tab)-[a-z0-9-]+$", figure["name"])
            assert cell.metadata["data"] in FIGURE_DATA
            assert len(figure["caption"].split()) >= 6
