"""Arrays come back from the file as they were put in, and no file is left."""

import errno
from pathlib import Path

import numpy as np
import pytest

from rol.array_file import ArrayFile

ARRAYS = [
    np.arange(6.0).reshape(3, 2),
    np.zeros((0, 2), np.float32),
    np.array([[1, 2], [3, 4]], np.uint8).T,
    np.array(7),
]


def test_arrays_come_back_in_any_order_and_can_be_changed(tmp_path: Path) -> None:
    kept = ArrayFile(tmp_path / "new", iter(ARRAYS))
    for index in (2, 0, 3, 1, -1):
        assert kept[index].dtype == ARRAYS[index].dtype
        np.testing.assert_array_equal(kept[index], ARRAYS[index])
    kept[0][:] = 1.0
    kept.append(np.ones(2))
    np.testing.assert_array_equal(kept[0], ARRAYS[0])
    assert [array.shape for array in kept] == [(3, 2), (0, 2), (2, 2), (), (2,)] and len(kept) == 5
    with pytest.raises(IndexError):
        kept[5]


def test_two_passes_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    kept = ArrayFile(tmp_path, [np.full(3, k) for k in range(9)])
    assert [(int(a[0]), int(b[0])) for a, b in zip(kept, reversed(kept), strict=True)] == [
        (k, 8 - k) for k in range(9)
    ]


def test_folder_stays_empty(tmp_path: Path) -> None:
    kept = ArrayFile(tmp_path, ARRAYS)
    assert len(kept) == 4 and list(tmp_path.iterdir()) == []


def test_full_disk_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def seek(self, place: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    kept = ArrayFile(tmp_path)
    monkeypatch.setattr(kept, "_file", Full())
    with pytest.raises(OSError, match=f"temporary file: No space left on device: '{tmp_path}'"):
        kept.append(np.zeros(3))
