"""Numbers for the text of a chapter."""

from __future__ import annotations

import numpy as np
import pytest

from rol_book import numbers


def test_values_are_stored_as_plain_numbers_and_words(monkeypatch: pytest.MonkeyPatch) -> None:
    stored = {}
    monkeypatch.setattr(numbers, "glue", lambda name, value, display: stored.update({name: value}))
    numbers.glue_numbers({"a_m": np.float32(0.5), "n": np.int64(3)}, kind="real")
    assert stored == {"a_m": 0.5, "n": 3, "kind": "real"}
    assert [type(value) for value in stored.values()] == [float, int, str]


def test_array_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="poses is ndarray"):
        numbers.glue_numbers(poses=np.zeros(3))
