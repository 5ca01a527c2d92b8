"""Fixtures that several test files share."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_root() -> Path:
    """Folder of the real data; skips the test where it is absent."""
    candidates = [os.environ.get("ROL_REAL_ROOT"), ROOT / "data/real", ROOT.parent / "shared/real"]
    for candidate in candidates:
        if candidate and (Path(candidate) / "RaLL").is_dir():
            return Path(candidate)
    pytest.skip("real data not found: set ROL_REAL_ROOT or run `make real`")
