"""The examples of book/take.md run in a folder that holds nothing but the files which the page names.

Each one runs twice: with the files beside it, and with the files in a package. The pages on symbols and on citing
agree with the code and the bibliography.
"""

import ast
import atexit
import functools
import importlib.metadata
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "rol"
TAKE, OWN_RADAR = ROOT / "book" / "take.md", ROOT / "book" / "own_radar.md"
# What the modules import, by the name that pip knows it by.
PACKAGES = {
    "numpy": "numpy", "scipy": "scipy", "numba": "numba", "pandas": "pandas", "torch": "torch",
    "opencv-python-headless": "cv2", "safetensors": "safetensors", "matplotlib": "matplotlib",
    "open3d-cpu": "open3d", "pyyaml": "yaml",
}  # fmt: skip

# Modules that may import torch; no module of `rol` may import open3d or matplotlib.
WITH_TORCH = {"pipeline", "pix2pix", "training"}
END = "----- end of an example -----\n"


@dataclass(frozen=True)
class Example:
    """An example of the page.

    Attributes
    ----------
    packages, files : set of str
        What must be installed, and the files that must lie beside the module.
    code, printed : str
        The example with the files beside it, and what it prints.
    """

    packages: set[str]
    files: set[str]
    code: str
    printed: str

    @property
    def code_for_package(self) -> str:
        """Import the modules from the package `tools`."""
        modules = "|".join(file.stem for file in PACKAGE.glob("[!.]*.py"))
        return re.sub(rf"^from ({modules}) import", r"from tools.\1 import", self.code, flags=re.MULTILINE)


def read_examples(page: Path) -> dict[str, Example]:
    """Read the examples of a page: a table of what modules need; for each a heading, code, and what it prints."""
    page_text = page.read_text(encoding="utf-8")
    table = re.findall(r"^\| \[(\w+)\]\(#\1\) \| .+ \| (.+) \| (.+) \|$", page_text, re.MULTILINE)
    parts = re.split(r"^### \[(\w+)\]\(.*\)\n", page_text, flags=re.MULTILINE)[1:]
    texts, found = dict(zip(parts[::2], parts[1::2], strict=True)), {}
    for name, packages, files in table:
        packages = packages.replace("opencv", "opencv-python-headless")
        code = re.search(r"^```python\n(.*?)^```$", texts[name], re.MULTILINE | re.DOTALL)[1]
        printed = re.search(r"^```text\n(.*?)^```$", texts[name], re.MULTILINE | re.DOTALL)[1]
        needs = {word for word in packages.split(", ") if word != "-"}
        found[name] = Example(needs, {f"{word}.py" for word in re.findall(r"\w+", files)}, code, printed)
    return found


EXAMPLES = read_examples(TAKE)
# Those with torch take turns in one process, since importing it takes longer than the examples.
GROUPS = [[name] for name, example in EXAMPLES.items() if "torch" not in example.packages]
GROUPS.append([name for name, example in EXAMPLES.items() if "torch" in example.packages])
# Runs `example.py` in each folder as `python example.py` would, with nothing installed but what lies in the first one.
RUN_ALONE = """
import os, runpy, sys
sys.path.insert(0, sys.argv[1])
for folder in sys.argv[3:]:
    os.chdir(folder)
    sys.path.insert(0, folder)
    runpy.run_path("example.py", run_name="__main__")
    print(end=sys.argv[2])
    sys.path.remove(folder)
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(folder) or name.partition(".")[0] == "tools":
            del sys.modules[name]
"""


def with_requirements(packages: Iterable[str]) -> set[str]:
    """Add what these packages bring along when pip installs them; on other systems open3d has another name."""
    found, left = set(), {name.lower() for name in packages}
    while left:
        name = left.pop()
        found.add(name)
        try:
            wanted = [Requirement(line) for line in importlib.metadata.requires(name) or []]
        except importlib.metadata.PackageNotFoundError:
            continue
        left |= {w.name.lower() for w in wanted if not w.marker or w.marker.evaluate({"extra": ""})} - found
    return found


@functools.cache
def installed_alone(packages: frozenset[str]) -> Path:
    """Make a folder in which these packages are installed, and no other, by links to where they are."""
    folder = Path(tempfile.mkdtemp(prefix="only-"))
    atexit.register(shutil.rmtree, folder)
    for name in with_requirements(packages):
        for distribution in importlib.metadata.distributions(name=name):
            tops = {file.parts[0] for file in distribution.files or []} - {"..", "__pycache__"}
            for top in tops:
                link = folder / top
                if not link.exists():
                    link.symlink_to(Path(distribution.locate_file(top)))
    return folder


def run_examples(folders: Iterable[Path], packages: Iterable[str]) -> list[str]:
    """Run examples where only some packages are installed, `rol` not among them, and give what each prints."""
    site = installed_alone(frozenset(packages))
    command = [sys.executable, "-I", "-S", "-c", RUN_ALONE, str(site), END, *map(str, folders)]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert answer.stderr == ""
    return answer.stdout.split(END)[:-1]


def copy_files(names: Iterable[str], folder: Path, compiled: Path) -> None:
    """Copy files of the package into a new folder, whose cache of compiled functions is that of other copies.

    numba knows a copy by the name, size and time of the file, and by the name of the module.
    """
    folder.mkdir(parents=True)
    compiled.mkdir(exist_ok=True)
    (folder / "__pycache__").symlink_to(compiled)
    for name in names:
        shutil.copy2(PACKAGE / name, folder)


def code_blocks(page: Path, section: str) -> list[tuple[str, str]]:
    """Give language and text of the code blocks of a section of the second level."""
    text = page.read_text(encoding="utf-8").partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the caches of compiled functions, one for all processes that run tests."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "compiled"
    folder.mkdir(exist_ok=True)
    return folder


# ---- each file ------------------------------------------------------------------------------------------------


def test_every_module_has_an_example() -> None:
    modules = {file.stem for file in PACKAGE.glob("[!.]*.py") if not file.name.startswith("__")}
    assert set(EXAMPLES) == modules


@pytest.mark.parametrize("group", GROUPS, ids="-".join)
def test_examples_run_flat_and_as_a_package_with_what_the_page_names(
    group: list[str], tmp_path: Path, compiled: Path
) -> None:
    expected = {}
    for name in group:
        files, example = [f"{name}.py", *EXAMPLES[name].files], EXAMPLES[name]
        for kind, below, code in (("flat", "", example.code), ("package", "tools", example.code_for_package)):
            folder = tmp_path / name / kind
            copy_files(files, folder / below, compiled / kind)
            (folder / "example.py").write_text(code, encoding="utf-8")
            expected[folder] = example.printed
    printed = run_examples(expected, set.union(*(EXAMPLES[name].packages for name in group)))
    assert dict(zip(expected, printed, strict=True)) == expected


@pytest.mark.parametrize("name", EXAMPLES)
def test_page_names_all_that_a_module_needs(name: str) -> None:
    files, packages = follow_imports(PACKAGE / f"{name}.py")
    heavy = packages & {"torch", "open3d", "matplotlib"}
    assert heavy <= {"torch"} and (not heavy or name in WITH_TORCH)
    packages |= {"numpy"} if "torch" in packages else set()  # torch complains where it is not installed
    assert {PACKAGES[word] for word in EXAMPLES[name].packages} == packages & set(PACKAGES.values())
    assert EXAMPLES[name].files == files


def follow_imports(start: Path) -> tuple[set[str], set[str]]:
    """Find the other files that a file imports in turn, and all packages that they import."""
    left, seen, packages = [start], {start}, set()
    while left:
        for level, module in runtime_imports(ast.parse(left.pop().read_text(encoding="utf-8"))):
            target = PACKAGE / f"{module}.py"
            if target.is_file() and target not in seen:
                seen.add(target)
                left.append(target)
            elif not target.is_file() and not level:
                packages.add(module)
    return {file.name for file in seen - {start}}, packages


def runtime_imports(node: ast.AST) -> list[tuple[int, str]]:
    """List imports as levels of the folder (0: by name) and first names, without those for type checkers."""
    found = []
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            found += [(0, alias.name.partition(".")[0]) for alias in child.names]
        elif isinstance(child, ast.ImportFrom):
            names = [child.module] if child.module else [alias.name for alias in child.names]
            found += [(child.level, name.partition(".")[0]) for name in names]
        found += runtime_imports(child)
    return found


# ---- the longer ones ------------------------------------------------------------------------------------------


def run_with_packages(section: str, folder: Path) -> str:
    """Run the script of a section of the page on radars of one's own, with the packages of `src` at hand."""
    blocks = dict(code_blocks(OWN_RADAR, section))
    for package in ROOT.glob("src/*/__init__.py"):  # links, so that what numba has compiled is used
        (folder / package.parent.name).symlink_to(package.parent)
    (folder / "example.py").write_text(blocks["python"], encoding="utf-8")
    [printed] = run_examples([folder], PACKAGES.keys() - {"torch", "safetensors", "open3d-cpu", "matplotlib"})
    assert printed == blocks["text"]
    return printed


def test_radar_of_ones_own_is_localized(tmp_path: Path) -> None:
    error = re.search(r"error (\d+\.\d+) m", run_with_packages("Localize on your map", tmp_path))
    assert float(error[1]) < 0.3


def test_session_of_ones_own_is_read_as_oxfords_and_aligned(tmp_path: Path) -> None:
    printed = run_with_packages("Write Oxford's files", tmp_path)
    for place in re.findall(r"(\d+\.\d+) m to the left", printed):
        assert abs(float(place) - 20.0) <= 0.25
    pytest.importorskip("papermill")
    command = dict(code_blocks(OWN_RADAR, "Write Oxford's files"))["bash"]
    words = shlex.split(command.replace("\\\n", ""))
    (tmp_path / "notebooks").mkdir()
    shutil.copy(ROOT / words[1], tmp_path / "notebooks")
    command = [sys.executable, "-m", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "MPLBACKEND": "Agg"}
    answer = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert answer.returncode == 0, answer.stderr
    summary = json.loads(
        (tmp_path / "build/my-town/alignment/my-town/summary.json").read_text(encoding="utf-8")
    )
    assert summary["n_aligned"] == summary["n_scans"] == 5


# ---- symbols and citations ------------------------------------------------------------------------------------


def test_names_in_the_list_of_symbols_stand_in_the_code() -> None:
    rows = re.findall(r"^\| \$.*$", (ROOT / "book" / "symbols.md").read_text(encoding="utf-8"), re.MULTILINE)
    files = [*PACKAGE.glob("[!.]*.py"), *(ROOT / "notebooks").glob("0*.ipynb")]
    words = {word for file in files for word in re.findall(r"\w+", file.read_text(encoding="utf-8"))}
    assert len(rows) > 40
    for row in rows:
        assert {name for name in re.findall(r"`\.?(\w+)(?:\(\))?`", row)} <= words, row


def test_entries_for_citing_are_those_of_the_bibliography() -> None:
    known = (ROOT / "book" / "references.bib").read_text(encoding="utf-8")
    entries = re.findall(
        r"^@.*?^}$", (ROOT / "book" / "cite.md").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    [book] = [entry for entry in entries if entry not in known]
    assert len(entries) == 7
    version = re.search(r'__version__ = "(.*)"', (PACKAGE / "__init__.py").read_text(encoding="utf-8"))[1]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version and f"Version {version}" in book
    assert citation["title"] in book and citation["authors"][0]["name"] in book
    paper = citation["preferred-citation"]
    assert paper["title"] in entries[0] and str(paper["year"]) in entries[0]


# Hides a package from the imports that follow.
WITHOUT = """
import sys
class Without:
    def __init__(self, package):
        self.package = package
    def find_spec(self, name, *_):
        if name == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}")
"""


@pytest.mark.parametrize(("module", "missing"), [("mcl", "numba"), ("pipeline", "torch")])
def test_a_missing_package_is_named(module: str, missing: str) -> None:
    code = f"{WITHOUT}sys.meta_path.insert(0, Without({missing!r}))\nimport rol.{module}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert f"No module named {missing!r}" in answer.stderr.splitlines()[-1]
