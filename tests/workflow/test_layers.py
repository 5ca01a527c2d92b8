"""The packages import downwards only, and `rol` imports none of the others."""

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "src"
MAY_IMPORT = {
    "rol": set(),
    "rol_beyond": {"rol"},
    "rol_data": {"rol"},
    "rol_sim": {"rol", "rol_beyond", "rol_data"},
    "rol_study": {"rol", "rol_beyond", "rol_data", "rol_sim"},
    "rol_book": {"rol"},
}
FILES = sorted(SRC.rglob("[!.]*.py"))


def test_every_package_has_its_place_in_the_order() -> None:
    assert {file.relative_to(SRC).parts[0] for file in FILES} == set(MAY_IMPORT)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(SRC).as_posix())
def test_file_imports_lower_packages_only(file: Path) -> None:
    package = file.relative_to(SRC).parts[0]
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.partition(".")[0])
    assert {name for name in found if name.startswith("rol")} <= MAY_IMPORT[package] | {package}
