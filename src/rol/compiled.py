"""Compile functions with numba, cached on disk if possible.

With numba's own ``cache=True`` a module cannot be imported where no folder for the cache can be written (no
writable home, code from a string), and a cache file that is empty or cut off raises at every call.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache


def compiled(function: Callable | None = None, **options: Any) -> Callable:
    """Decorate a function for compilation by numba, without Python objects, cached where possible.

    Parameters
    ----------
    function : callable, optional
        The function; absent when the decorator is called with options.
    **options
        Options of ``numba.njit``, such as ``nogil=True``.

    Returns
    -------
    callable
        The compiled function, or the decorator if ``function`` is absent.
    """
    if function is None:
        return lambda function: compiled(function, **options)
    dispatcher = njit(**options)(function)
    with contextlib.suppress(RuntimeError):  # no folder for the cache: compile in memory
        dispatcher._cache = _TolerantCache(function)
    return dispatcher


class _TolerantCache(FunctionCache):
    """numba's cache; it replaces files that cannot be read and skips those that cannot be written."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with contextlib.suppress(Exception):  # damaged pickles raise almost any exception
            return super().load_overload(sig, target_context)
        with contextlib.suppress(OSError):
            self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(Exception):  # full disk, or a damaged index that could not be replaced
            super().save_overload(sig, data)
