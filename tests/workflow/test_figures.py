"""The book's extension for figures: numbered tables, and panels that stack."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from docutils import nodes
from docutils.utils import new_document
from PIL import Image

from chapters import ROOT


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("figures", ROOT / "book" / "_ext" / "figures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def picture_with(gap: range) -> np.ndarray:
    """A picture 200 pixels wide with something in every column but those of a gap."""
    picture = np.full((50, 200), 255, np.uint8)
    picture[10] = 0
    picture[:, gap] = 255
    return picture


def test_panels_are_cut_in_the_middle_of_the_gap(figures: ModuleType) -> None:
    assert figures.find_gaps(picture_with(range(90, 99)), 2) == [94]


def test_panels_without_a_gap_where_they_meet_stay_together(figures: ModuleType, tmp_path: Path) -> None:
    picture = picture_with(range(20, 30))
    assert figures.find_gaps(picture, 2) is None
    Image.fromarray(picture).save(tmp_path / "a.png")
    assert figures.stack_panels(tmp_path / "a.png", 2) is None


def test_narrow_windows_get_the_stacked_picture(figures: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "_images").mkdir()
    Image.fromarray(picture_with(range(95, 106))).save(tmp_path / "_images" / "a.png")
    page = tmp_path / "notebooks" / "a.html"
    page.write_text(
        '<p><img alt="x" class="panels-2 y" src="../_images/a.png" /></p><img src="b.png" />',
        encoding="utf-8",
    )
    app = SimpleNamespace(outdir=tmp_path, builder=SimpleNamespace(format="html"))
    figures.add_stacked_pictures(app, None)
    words = page.read_text(encoding="utf-8")
    assert '(max-width: 700px)" srcset="../_images/a-stacked.png"><img alt="x"' in words
    assert words.count("<picture>") == 1
    with Image.open(tmp_path / "_images" / "a-stacked.png") as stacked:
        assert stacked.size == (100, 100)


def test_figure_of_a_table_is_a_table(figures: ModuleType) -> None:
    document = new_document("page")
    for name in ("tab-a", "fig-a"):
        document += nodes.figure("", nodes.caption("", f"Words of {name}."), names=[name])
        document.note_explicit_target(document[-1])
    figures.NumberTables(document).apply()
    kinds = [type(node) for node in document.findall(nodes.figure)]
    assert kinds == [figures.TableFigure, nodes.figure]
    assert figures.caption_of(document[0]) == "Words of tab-a."
    assert document.ids["tab-a"] is document[0] and document.ids["fig-a"] is document[1]
