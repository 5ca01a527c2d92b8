"""Every file of src/rol, copied into an empty folder with geometry.py, files.py and compiled.py, must import there."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "rol"
FILES = sorted(file for file in PACKAGE.rglob("[!.]*.py") if not file.name.startswith("__"))
# The heavy parts, and the only files that may bring them in when they are imported.
HEAVY = {
    "torch": {"pix2pix.py", "unet.py"},
    "open3d": {"virtual/scene.py"},
    "matplotlib": {"plots.py", "virtual/plots.py"},
}

IMPORT_ALONE = """
import sys
sys.path.insert(0, sys.argv[1])
__import__(sys.argv[2])
if "rol" in sys.modules:
    sys.exit("it imported the package rol, which a reader who copied one file does not have")
print(*(name for name in sys.argv[3:] if name in sys.modules))
"""


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_file_imports_when_copied_alone(file: Path, tmp_path: Path) -> None:
    for neighbour in ("geometry.py", "files.py", "compiled.py"):
        shutil.copy(PACKAGE / neighbour, tmp_path)
    shutil.copy(file, tmp_path)
    command = [sys.executable, "-I", "-c", IMPORT_ALONE, str(tmp_path), file.stem, *HEAVY]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert answer.returncode == 0, answer.stderr
    place = file.relative_to(PACKAGE).as_posix()
    heavy = [name for name in answer.stdout.split() if place not in HEAVY[name]]
    assert not heavy, f"{place} imports {heavy}; only {[HEAVY[name] for name in heavy]} may"


def test_nobody_but_virtual_imports_virtual() -> None:
    for file in FILES:
        if file.parent.name != "virtual":
            text = file.read_text(encoding="utf-8")
            assert "from .virtual" not in text and "rol_sim" not in text, f"{file.name} imports rol_sim"
