"""The executed notebooks that are kept in the repository: whole, small, and of the code that is there now."""

from pathlib import Path

import pytest

from chapters import (
    CHAPTERS,
    NOTEBOOKS,
    ROOT,
    faults_of_run,
    load_config,
    notebook_parameters,
    read_notebook,
    stored_digest,
    tagged_cells,
)
from renew_notebooks import LARGEST_MB

STORED = [NOTEBOOKS / f"{chapter}.ipynb" for chapter in CHAPTERS]
pytestmark = pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)


def test_every_cell_ran_without_error_or_stderr(path: Path) -> None:
    assert faults_of_run(read_notebook(path)) == []


def test_outputs_are_of_this_code(path: Path) -> None:
    notebook = read_notebook(path)
    config = load_config(ROOT / "config/demo.yaml")
    assert notebook.metadata.get("rol", {}).get("digest") == stored_digest(notebook, config), (
        f"{path.name}, the code under src, requirements.lock or config/demo.yaml changed since the stored run; renew it with `make notebooks`"
    )


def test_file_is_small_and_ran_with_its_defaults(path: Path) -> None:
    assert path.stat().st_size <= LARGEST_MB * 1e6
    assert notebook_parameters(path)
    assert tagged_cells(read_notebook(path), "injected-parameters") == []


def test_every_figure_has_caption_name_and_alt_text(path: Path) -> None:
    for cell in read_notebook(path).cells:
        shows_image = any("image/png" in output.get("data", {}) for output in cell.get("outputs", []))
        if not shows_image:
            continue
        settings = cell.metadata.get("mystnb", {})
        start = cell.source[:60]
        assert {"caption", "name"} <= set(settings.get("figure", {})), (
            f"{path.name}: no caption or name: {start}"
        )
        assert settings.get("image", {}).get("alt"), f"{path.name}: no alt text: {start}"
