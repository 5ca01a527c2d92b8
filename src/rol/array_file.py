"""Keep a long sequence of arrays in a temporary file instead of memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from weakref import finalize

import numpy as np


class ArrayFile(Sequence):
    """A sequence of arrays in a temporary file, which is removed with the sequence, however the process ends.

    Parameters
    ----------
    folder : path
        Folder of the file; made if absent.
    arrays : iterable of array
        Arrays of any shapes and plain dtypes, consumed one by one.

    Raises
    ------
    OSError
        If the file cannot be written; the message names the folder.
    """

    def __init__(self, folder: str | Path, arrays: Iterable[np.ndarray] = ()) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._file = TemporaryFile(dir=self.folder)  # noqa: SIM115 (lives as long as the sequence)
        finalize(self, self._file.close)
        self._places: list[tuple[int, tuple[int, ...], np.dtype]] = []
        self._end = 0
        for array in arrays:
            self.append(array)

    def append(self, array: np.ndarray) -> None:
        """Add an array at the end."""
        data = np.asarray(array)
        try:
            self._file.seek(self._end)
            self._file.write(data.tobytes())
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, f"temporary file: {error.strerror}", str(self.folder)) from error
        self._places.append((self._end, data.shape, data.dtype))
        self._end += data.nbytes

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> np.ndarray:
        """Read one array."""
        start, shape, dtype = self._places[index]
        self._file.seek(start)
        return np.fromfile(self._file, dtype, int(np.prod(shape))).reshape(shape)
