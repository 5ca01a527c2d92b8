"""Number the tables that cells print, and stack the panels of figures on a narrow screen.

Sphinx loads this file as an extension, see `local_extensions` in `_config.yml`.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from docutils import nodes
from PIL import Image
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.writers.html5 import HTML5Translator

NARROW_PX = 700  # up to this width of the window panels stand one below the other
IMAGE = re.compile(r'<img [^>]*class="[^"]*\bpanels-(\d)\b[^"]*"[^>]*>')
MAX_SHIFT = 0.15  # how far a gap may be from where equal panels would meet [width of a panel]


class TableFigure(nodes.figure):
    """A table with a caption, made by a code cell; numbered among the tables."""


class NumberTables(SphinxTransform):
    """Turn figures whose name begins with ``tab-`` into tables, before labels and numbers are collected (in place)."""

    default_priority = 800

    def apply(self, **kwargs: object) -> None:
        """Replace the figures of a page."""
        for figure in list(self.document.findall(nodes.figure)):
            if any(name.startswith("tab-") for name in figure["names"]):
                figure["classes"].append("table-figure")
                table = TableFigure(figure.rawsource, *figure.children, **figure.attributes)
                table.source, table.line, table.document = figure.source, figure.line, self.document
                figure.replace_self(table)
                self.document.ids |= dict.fromkeys(table["ids"], table)  # numbers are looked up here


def caption_of(node: nodes.Node) -> str | None:
    """Return the caption of a table."""
    return next((part.astext() for part in node.findall(nodes.caption)), None)


def find_gaps(image: np.ndarray, n_panels: int) -> list[int] | None:
    """Find the blank columns between panels of equal width.

    Parameters
    ----------
    image : array, shape (h, w), uint8
        Grey picture, 255 where it is blank.
    n_panels : int
        Number of panels side by side.

    Returns
    -------
    cuts : list of int or None
        Middle column of each gap; None where panels are not separated near the expected place.
    """
    width = image.shape[1] / n_panels
    blank = np.flatnonzero((image == 255).all(axis=0))
    cuts = []
    for k in range(1, n_panels):
        near = blank[np.abs(blank - k * width) < MAX_SHIFT * width]
        if len(near) == 0:
            return None
        runs = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
        long = max(map(len, runs)) / 2.0  # the first gap, left of the next panel's label
        cuts.append(int(np.median(next(run for run in runs if len(run) >= long))))
    return cuts


def stack_panels(path: Path, n_panels: int) -> Path | None:
    """Write a picture with the panels of another one below each other; None where they cannot be separated."""
    with Image.open(path) as stored:
        picture = stored.convert("RGB")
    cuts = find_gaps(np.asarray(picture.convert("L")), n_panels)
    if cuts is None:
        return None
    edges = [0, *cuts, picture.width]
    parts = [picture.crop((a, 0, b, picture.height)) for a, b in pairwise(edges)]
    stacked = Image.new("RGB", (max(part.width for part in parts), n_panels * picture.height), "white")
    for k, part in enumerate(parts):
        stacked.paste(part, (0, k * picture.height))
    target = path.with_name(f"{path.stem}-stacked.png")
    stacked.quantize(255).save(target, optimize=True)
    return target


def add_stacked_pictures(app: Sphinx, exception: Exception | None) -> None:
    """Give each picture of class ``panels-N`` a stacked form for narrow windows, in the finished pages."""
    if exception or app.builder.format != "html":
        return
    for page in Path(app.outdir).glob("notebooks/*.html"):

        def with_stacked(match: re.Match, folder: Path = page.parent) -> str:
            source = re.search(r'src="([^"]+)"', match[0])[1]
            stacked = stack_panels((folder / source).resolve(), int(match[1]))
            if stacked is None:
                return match[0]
            media = f'media="(max-width: {NARROW_PX}px)"'
            address = f"{source.rpartition('/')[0]}/{stacked.name}"
            return f'<picture><source {media} srcset="{address}">{match[0]}</picture>'

        before = page.read_text(encoding="utf-8")
        after = IMAGE.sub(with_stacked, before)
        if after != before:
            page.write_text(after, encoding="utf-8")


def setup(app: Sphinx) -> dict:
    """Connect the functions to the events of Sphinx."""
    show = (HTML5Translator.visit_figure, HTML5Translator.depart_figure)
    app.add_enumerable_node(TableFigure, "table", caption_of, html=show)
    app.add_transform(NumberTables)
    app.connect("build-finished", add_stacked_pictures, priority=600)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
