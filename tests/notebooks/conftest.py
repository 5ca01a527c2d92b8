"""The profiles whose runs and books are checked: smoke, which `make test` has just made, and demo where it is there."""

from pathlib import Path

import pytest

from chapters import load_config

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(params=["smoke", "demo"])
def profile(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> dict:
    """The settings of a profile whose book is built; paths in it are relative to the root, where the test runs."""
    config = load_config(ROOT / "config" / f"{request.param}.yaml")
    monkeypatch.chdir(ROOT)
    if not (Path(config["book_dir"]) / "_build" / "html" / "index.html").is_file():
        if request.param == "demo":
            pytest.skip("the demo book is not built: run `make book`")
        pytest.fail(f"{config['book_dir']} is not built: run `make book PROFILE=smoke`")
    return config
