"""Numbers that the text of a chapter shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from myst_nb import glue


def glue_numbers(values: Mapping[str, Any] | None = None, /, **more: Any) -> None:
    """Store numbers and words under names by which Markdown shows them.

    Parameters
    ----------
    values, **more
        Values by name: numbers, NumPy scalars or strings. The role ``glue:text`` shows one, as ``name:.2f``.

    Raises
    ------
    TypeError
        If a value is neither a number nor a string; names it.
    """
    for name, value in {**(values or {}), **more}.items():
        plain = value.item() if isinstance(value, np.generic) else value
        if not isinstance(plain, bool | int | float | str):
            raise TypeError(f"{name} is {type(plain).__name__}, expected a number or a string")
        glue(name, plain, display=False)
