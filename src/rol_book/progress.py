"""A progress bar for long work, shown only in a terminal and in a notebook that is open in Jupyter.

Notebooks that papermill runs are stored with their outputs, and logs are read line by line: a bar would
clutter both.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

try:
    from tqdm import tqdm
except ImportError:  # without tqdm no bar is shown
    tqdm = None

T = TypeVar("T")


def is_watched() -> bool:
    """Return whether a bar would be seen: standard error is a terminal, or Jupyter started this kernel."""
    return sys.stderr.isatty() or "JPY_SESSION_NAME" in os.environ


def track(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Iterate over items, with a progress bar where it is seen and tqdm is installed.

    Parameters
    ----------
    items : iterable
        The items; a generator does its work meanwhile.
    label : str
        Text before the bar.
    total : int, optional
        Number of items, for iterables without a length.

    Yields
    ------
    item : object
        The items.
    """
    if tqdm is None or not is_watched():
        yield from items
    else:
        yield from tqdm(items, desc=label, total=total, leave=False)
