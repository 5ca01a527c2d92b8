"""Compilation by numba: without a folder for the cache, with damaged cache files, and with good ones."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "rol"
DOUBLE = """
from rol.compiled import compiled

@compiled
def double(x):
    return 2 * x
"""
# Runs each file as code without a file name, as from stdin.
RUN_AS_TEXT = """
import sys
sys.path.insert(0, sys.argv[1])
for path in sys.argv[2:]:
    with open(path, encoding="utf-8") as file:
        exec(compile(file.read(), "<stdin>", "exec"), {"__name__": "__main__"})
"""


def run_without_home(code: str, *words: str | Path) -> None:
    """Run Python code where the home cannot be written; nothing may be printed on stderr."""
    places = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null", "PYTHONPATH": str(PACKAGE.parent)}
    command = [sys.executable, "-c", code, *map(str, words)]
    environment = {"PATH": os.environ["PATH"], **places}
    answer = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (answer.returncode, answer.stderr) == (0, "")


def load_double(path: Path) -> Callable:
    """Import the function `double` of a file anew, with nothing compiled."""
    spec = importlib.util.spec_from_file_location("doubled", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.double


def cache_hits(path: Path) -> int:
    """Call `double` of a file and count what came from the cache."""
    double = load_double(path)
    assert double(21) == 42
    return sum(double.stats.cache_hits.values())


def test_modules_as_text_compile_in_memory() -> None:
    files = [file for file in PACKAGE.parent.rglob("[!.]*.py") if file.name != "compiled.py"]
    users = [file for file in files if "\n@compiled" in file.read_text("utf-8")]
    assert len(users) >= 5 and {file.relative_to(PACKAGE.parent).parts[0] for file in users} > {"rol"}
    run_without_home(RUN_AS_TEXT, PACKAGE, *users)


def test_module_without_any_folder_for_the_cache_compiles_in_memory(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").write_text("a file in place of the folder", encoding="utf-8")
    (tmp_path / "doubled.py").write_text(DOUBLE, encoding="utf-8")
    run_without_home(
        "import sys; sys.path.insert(0, sys.argv[1]); import doubled; assert doubled.double(21) == 42",
        tmp_path,
    )


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("kept", [0, 20])
def test_damaged_cache_is_replaced(kind: str, kept: int, tmp_path: Path) -> None:
    path = tmp_path / "doubled.py"
    path.write_text(DOUBLE, encoding="utf-8")
    assert [cache_hits(path), cache_hits(path)] == [0, 1]
    [file] = (tmp_path / "__pycache__").glob(f"*.{kind}")
    file.write_bytes(file.read_bytes()[:kept])
    assert [cache_hits(path), cache_hits(path)] == [0, 1]
    assert len(list(file.parent.glob("*.nb?"))) == 2


def test_damaged_cache_that_cannot_be_replaced_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "doubled.py"
    path.write_text(DOUBLE, encoding="utf-8")
    double = load_double(path)

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(double._cache._cache_file, "_save_index", refuse)
    Path(double._cache._cache_file._index_path).write_bytes(b"")
    assert double(21) == 42
