"""A bar for work that takes long, shown where a person watches and nowhere else.

A notebook that papermill runs is kept with all that its cells write, and a log is read line by line: a bar would litter
both. So it appears in a terminal and in a notebook that is open in Jupyter, and goes when the work is done.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def is_watched() -> bool:
    """Say whether a person sees a bar move: standard error is a terminal, or Jupyter's server started this kernel."""
    return sys.stderr.isatty() or "JPY_SESSION_NAME" in os.environ


def track(items: Iterable[T], words: str, total: int | None = None) -> Iterator[T]:
    """Go through items, with a bar where a person watches and tqdm is installed.

    Parameters
    ----------
    items : iterable
        What is gone through; a generator does its work meanwhile.
    words : str
        What the bar says before itself.
    total : int, optional
        Number of items, where they do not know it themselves.

    Yields
    ------
    item : object
        The items.
    """
    try:
        from tqdm import tqdm
    except ImportError:
        tqdm = None
    if tqdm is None or not is_watched():
        yield from items
    else:
        yield from tqdm(items, desc=words, total=total, leave=False)
