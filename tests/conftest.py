"""Fixtures that several test files share."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_root() -> Path:
    """Folder of the real data; skips the test where it is absent."""
    root = ROOT / (os.environ.get("ROL_REAL_ROOT") or "data/real")
    if (root / "RaLL").is_dir():
        return root
    pytest.skip("real data not found: set ROL_REAL_ROOT or run `make real`")
