"""The progress bar: items pass unchanged, and it is shown in terminals and in Jupyter only."""

import sys

import pytest

from rol_book import progress
from rol_book.progress import is_watched, track


@pytest.fixture(autouse=True)
def nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)


def test_nothing_is_written_where_nobody_watches(capsys: pytest.CaptureFixture) -> None:
    assert list(track(range(3), "scans")) == [0, 1, 2] and not is_watched()
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("total", [None, 3])
def test_the_bar_is_seen_in_jupyter_and_goes_at_the_end(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, total: int | None
) -> None:
    monkeypatch.setenv("JPY_SESSION_NAME", "notebooks/05_real_vs_fake.ipynb")
    assert list(track((k for k in range(3)), "scans", total)) == [0, 1, 2]
    shown = capsys.readouterr()
    assert shown.out == "" and "scans" in shown.err
    assert shown.err.endswith("\r") and not shown.err.rsplit("\r", 2)[1].strip()  # wiped


def test_the_bar_is_seen_in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert is_watched()


def test_items_are_asked_for_one_by_one() -> None:
    asked = []
    going = track((asked.append(k) or k for k in range(3)), "scans")
    assert next(going) == 0 and asked == [0]


def test_without_tqdm_there_is_no_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setenv("JPY_SESSION_NAME", "a.ipynb")
    monkeypatch.setattr(progress, "tqdm", None)
    assert list(track(range(3), "scans")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
