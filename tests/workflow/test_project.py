"""What must hold of the project as a whole: versions, profiles, the parameters of the notebooks, and the workflow's tools."""

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
import yaml
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

import chapters
import renew_notebooks
from chapters import CHAPTERS, NOTEBOOKS, ChapterError, Run

ROOT = Path(__file__).resolve().parents[2]
PROFILES = sorted((ROOT / "config").glob("*.yaml"))
STORED = [NOTEBOOKS / f"{chapter}.ipynb" for chapter in CHAPTERS]


def tracked_text_files() -> list[Path]:
    """Every file of the project that is meant to be read, without what is generated or installed."""
    kinds = {
        ".py",
        ".md",
        ".yaml",
        ".yml",
        ".toml",
        ".lock",
        ".sh",
        ".cff",
        ".bib",
        ".csv",
        ".json",
        ".ipynb",
    }
    names = ("src", "tests", "workflow", "config", "book", "notebooks", ".ci", "data/paper")
    files = [file for name in names for file in (ROOT / name).rglob("[!.]*")]
    files = [file for file in files if file.suffix in kinds or file.name == "run"]
    return files + [file for file in ROOT.iterdir() if file.is_file() and file.suffix in kinds | {""}]


# ---- versions and files ---------------------------------------------------------------------------------------


def test_no_file_names_a_path_of_a_machine() -> None:
    home = re.compile(r"(?<![\w.])/(?:home|root|Users)/\w")
    for file in tracked_text_files():
        text = file.read_text(encoding="utf-8")
        assert str(ROOT) not in text, f"{file} names the folder it lay in"
        assert not home.search(text), f"{file}: {home.search(text)[0]}"


# ---- profiles and parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES, ids=lambda path: path.stem)
def test_profile_is_complete_and_names_parameters_of_the_notebooks(profile: Path) -> None:
    config = chapters.load_config(profile)
    assert config["profile"] == profile.stem
    for run in chapters.all_runs(config):
        chapters.run_parameters(config, run)
    made = set((config["simulated"] or {}).get("sessions", {}))
    assert made == {session for session in config["sessions"] if session.startswith("sim-")}


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_demo_profile_is_the_defaults_of_the_notebooks(chapter: str) -> None:
    config = chapters.load_config(ROOT / "config/demo.yaml")
    run = renew_notebooks.default_run(config, chapter)
    defaults = chapters.notebook_parameters(NOTEBOOKS / f"{chapter}.ipynb")
    passed = chapters.run_parameters(config, run)
    assert {name: defaults[name] for name in passed} == passed


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_notebook_builds_every_path_from_its_parameters(path: Path) -> None:
    defaults = chapters.notebook_parameters(path)
    assert "out_dir" in defaults
    rest = "\n".join(chapters.code_cells(chapters.read_notebook(path))[1:])
    assert "build/demo" not in rest and "../" not in rest and "data/sessions" not in rest


def test_no_two_figures_have_the_same_name() -> None:
    cells = [cell for path in STORED for cell in chapters.read_notebook(path).cells]
    names = [cell.metadata.get("mystnb", {}).get("figure", {}).get("name") for cell in cells]
    assert not {name for name in names if name and names.count(name) > 1}


def test_profile_with_an_unknown_key_is_refused() -> None:
    config = chapters.load_config(ROOT / "config/demo.yaml") | {"particels": 100}
    with pytest.raises(ChapterError, match="particels"):
        chapters.check_config(config, "some.yaml")


def test_profile_with_an_unknown_chapter_is_refused() -> None:
    config = chapters.load_config(ROOT / "config/demo.yaml") | {"notebooks": {"07_localisation": {}}}
    with pytest.raises(ChapterError, match="07_localisation"):
        chapters.check_config(config, "some.yaml")


def write_notebook(path: Path, *cells: nbformat.NotebookNode) -> Path:
    nbformat.write(new_notebook(cells=list(cells)), path)
    return path


def parameters_cell(source: str) -> nbformat.NotebookNode:
    return new_code_cell(source, metadata={"tags": ["parameters"]})


def test_parameter_that_the_notebook_lacks_or_the_run_sets_is_refused(tmp_path: Path) -> None:
    write_notebook(
        tmp_path / "07_localization.ipynb", parameters_cell('session = "a"\nmethod = "b"\nparticles = 1')
    )
    config = {"sessions": ["s", "t"], "out_dir": "o", "sessions_root": "r", "seed": 1}
    run = Run("07_localization", "t", "paper")
    known = chapters.run_parameters(
        config | {"notebooks": {"07_localization": {"particles": 5}}}, run, tmp_path
    )
    assert known == {"session": "t", "method": "paper", "particles": 5}
    for refused in ({"particels": 5}, {"method": "robust"}):  # the run itself has session and method
        with pytest.raises(ChapterError, match=f"cannot set {next(iter(refused))}; "):
            chapters.run_parameters(config | {"notebooks": {"07_localization": refused}}, run, tmp_path)


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("n = 2 * 3", "not a plain literal"),
        ("import os", "not `name = literal`"),
        ("a, b = 1, 2", "not `name = literal`"),
    ],
)
def test_parameters_must_be_literals(tmp_path: Path, source: str, fault: str) -> None:
    path = write_notebook(tmp_path / "n.ipynb", parameters_cell(source))
    with pytest.raises(ChapterError, match=re.escape(fault)):
        chapters.notebook_parameters(path)


def test_parameters_cell_must_come_first(tmp_path: Path) -> None:
    path = write_notebook(tmp_path / "n.ipynb", new_code_cell("x = 1"), parameters_cell("n = 1"))
    with pytest.raises(ChapterError, match="first code cell"):
        chapters.notebook_parameters(path)


def test_papermill_arguments_keep_types() -> None:
    parameters = {"session": "007", "rate": 1e-5, "names": ["1e5", "b c"], "n": 3, "root": "", "none": None}
    words = __import__("shlex").split(chapters.papermill_arguments(parameters))
    read = {}
    while words:
        flag = words.pop(0)
        read |= {words.pop(0): words.pop(0)} if flag == "-r" else yaml.safe_load(words.pop(0))
    assert read == parameters


# ---- digests --------------------------------------------------------------------------------------------------


def test_code_text_leaves_out_comments_and_docstrings_only() -> None:
    source = '"""Doc."""\n\nX = "# no comment"  # a comment\n\n\ndef f():\n    """Doc."""\n    return X\n'
    assert chapters.code_text(source) == 'X = "# no comment"\ndef f():\n    return X'


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two packages, one of which imports the other, that stands for ``src``; and a lock file."""
    files = {
        "rol/__init__.py": '"""Package."""\n\n__version__ = "1"\n',
        "rol/geometry.py": "import numpy\n\ncompose = numpy.add\n",
        "rol/mcl.py": 'def f():\n    """Doc."""\n    from .geometry import compose\n',
        "rol/plots.py": "",
        "simulator/__init__.py": "",
        "simulator/world/__init__.py": "",
        "simulator/world/scene.py": "from rol.mcl import f\nfrom . import town\nfrom ..radar import *\n",
        "simulator/world/town.py": "import yaml\n",
        "simulator/radar.py": "",
    }
    for name, text in files.items():
        (tmp_path / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / name).write_text(text, encoding="utf-8")
    (tmp_path / "requirements.lock").write_text("# versions\nnumpy==2.0\n", encoding="utf-8")
    monkeypatch.setattr(chapters, "SOURCE", tmp_path / "src")
    monkeypatch.setattr(chapters, "LOCK", tmp_path / "requirements.lock")
    return tmp_path / "src"


def used_files(*sources: str) -> set[str]:
    files = chapters.module_files(sources, "n.ipynb")
    return {file.relative_to(chapters.SOURCE).as_posix() for file in files}


def test_imports_are_followed_through_all_packages(packages: Path) -> None:
    mcl = {"rol/__init__.py", "rol/mcl.py", "rol/geometry.py"}
    simulator = {file.relative_to(packages).as_posix() for file in packages.glob("simulator/**/*.py")}
    assert used_files("import numpy") == set()
    assert used_files("%matplotlib inline\nfrom rol.mcl import f") == mcl
    assert used_files("from rol import plots as p") == {"rol/__init__.py", "rol/plots.py"}
    assert used_files("from rol import __version__") == {"rol/__init__.py"}
    assert used_files("import simulator.world.scene") == mcl | simulator


@pytest.mark.parametrize(
    "line",
    [
        "import rol_gone.mcl",
        "from rol.gone import f",
        "from rol import gone",
        "from rol.mcl import gone",
        "import rolled",
    ],
)
def test_import_that_leads_to_nothing_is_refused(packages: Path, tmp_path: Path, line: str) -> None:
    gone = line.removeprefix("import ").replace("from ", "").replace(" import ", ".")
    with pytest.raises(ChapterError, match=f"n.ipynb: imports `{gone}`"):
        chapters.chapter_digest(write_notebook(tmp_path / "n.ipynb", new_code_cell(line)))
    (packages / "rol/plots.py").write_text(line, encoding="utf-8")
    with pytest.raises(ChapterError, match=f"plots.py: imports `{gone}`"):
        used_files("import rol.plots")


def test_package_that_is_no_longer_found_is_missed(packages: Path) -> None:
    (packages / "rol/__init__.py").unlink()
    with pytest.raises(ChapterError, match=r"scene.py: imports `rol\.mcl\.f`"):
        used_files("import simulator.world.scene")


def test_every_folder_of_code_is_a_package_that_digests_follow() -> None:
    folders = {file.parent for file in chapters.SOURCE.rglob("[!.]*.py")}
    assert all((folder / "__init__.py").is_file() for folder in folders)
    assert all(folder.relative_to(chapters.SOURCE).parts[0].startswith("rol") for folder in folders)


def test_every_import_of_packages_and_scripts_leads_to_a_name() -> None:
    files = sorted(chapters.SOURCE.rglob("[!.]*.py"))
    modules = [".".join(file.relative_to(chapters.SOURCE).with_suffix("").parts) for file in files]
    lines = [f"import {module.removesuffix('.__init__')}" for module in modules]
    assert chapters.module_files(lines, "all modules") == files
    for script in (ROOT / "workflow").glob("[!.]*.py"):
        chapters.module_files([script.read_text(encoding="utf-8")], str(script))


@pytest.mark.parametrize(
    ("file", "before", "after", "is_other"),
    [
        ("src/rol/geometry.py", "import numpy", "import scipy", True),
        ("src/rol/__init__.py", '"1"', '"2"', True),
        ("src/rol/mcl.py", '"""Doc."""', '"""Another docstring."""  # and a comment', False),
        ("src/rol/plots.py", "", "x = 1", False),
        ("requirements.lock", "numpy==2.0", "numpy==2.1", True),
        ("requirements.lock", "# versions", "# pinned versions", False),
    ],
)
def test_digest_follows_code_and_versions(
    packages: Path, tmp_path: Path, file: str, before: str, after: str, is_other: bool
) -> None:
    path = write_notebook(tmp_path / "n.ipynb", new_code_cell("from simulator.world import scene"))
    digests = [chapters.chapter_digest(path)]
    text = (tmp_path / file).read_text(encoding="utf-8")
    (tmp_path / file).write_text(text.replace(before, after, 1), encoding="utf-8")
    digests.append(chapters.chapter_digest(path))
    assert (digests[0] != digests[1]) == is_other


def test_every_digest_follows_the_lock_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def digests() -> list[str]:
        return [
            chapters.module_digest("rol.pairs"),
            chapters.script_digest("generate_images.py"),
            chapters.stored_digest(new_notebook(), {}),
        ]

    before = digests()
    monkeypatch.setattr(chapters, "LOCK", tmp_path / "other.lock")
    (tmp_path / "other.lock").write_text("numpy==2.1\n", encoding="utf-8")
    assert not set(before) & set(digests())


def test_stored_digest_covers_every_package(packages: Path) -> None:
    digests = {chapters.stored_digest(new_notebook(), {})}
    for n, file in enumerate(sorted(packages.rglob("*.py")), start=2):
        file.write_text(file.read_text(encoding="utf-8") + "x = 1\n", encoding="utf-8")
        digests.add(chapters.stored_digest(new_notebook(), {}))
        assert len(digests) == n


def test_digest_of_a_chapter_follows_its_code_and_not_its_text(tmp_path: Path) -> None:
    def digest(text: str, code: str) -> str:
        return chapters.chapter_digest(
            write_notebook(tmp_path / "n.ipynb", new_markdown_cell(text), new_code_cell(code))
        )

    assert digest("a", "x = 1") == digest("b", "x = 1") != digest("a", "x = 2")


# ---- executed notebooks ---------------------------------------------------------------------------------------


def executed(source: str, *outputs: nbformat.NotebookNode, count: int | None = 1) -> nbformat.NotebookNode:
    return new_code_cell(source, outputs=list(outputs), execution_count=count)


@pytest.mark.parametrize(
    ("cell", "fault"),
    [
        (executed("x", count=None), "did not run"),
        (
            executed("x", new_output("error", ename="ValueError", evalue="bad", traceback=[])),
            "ValueError: bad",
        ),
        (executed("x", new_output("stream", name="stderr", text="careful")), "stderr: careful"),
    ],
)
def test_faults_of_a_run_are_found(cell: nbformat.NotebookNode, fault: str) -> None:
    assert fault in chapters.faults_of_run(new_notebook(cells=[cell]))[0]


def test_run_takes_the_text_of_its_source_and_refuses_other_code(tmp_path: Path) -> None:
    injected = new_code_cell("n = 2", metadata={"tags": ["injected-parameters"]}, execution_count=2)
    done = executed("print(n)", new_output("stream", name="stdout", text="2"), count=3)
    first = parameters_cell("n = 1")
    first.execution_count = 1
    run = write_notebook(tmp_path / "run.ipynb", new_markdown_cell("old"), first, injected, done)
    source = write_notebook(
        tmp_path / "n.ipynb", new_markdown_cell("new"), parameters_cell("n = 1"), new_code_cell("print(n)")
    )
    cells = chapters.load_run(run, source).cells
    assert [cell.source for cell in cells] == ["new", "n = 1", "n = 2", "print(n)"]
    assert cells[3].outputs[0].text == "2"
    write_notebook(source, parameters_cell("n = 1"), new_code_cell("print(n + 1)"))
    with pytest.raises(ChapterError, match="run the chapter again"):
        chapters.load_run(run, source)


def test_stripping_leaves_nothing_of_the_machine() -> None:
    output = new_output("stream", name="stdout", text=f"wrote {ROOT}/build/x.csv")
    notebook = new_notebook(
        cells=[executed("x", output, count=7)],
        metadata={"papermill": {}, "kernelspec": {"name": "python3", "display_name": "Python 3"}},
    )
    notebook.cells[0].metadata["papermill"] = {"duration": 1}
    renew_notebooks.strip(notebook)
    assert notebook.metadata == {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    assert notebook.cells[0].execution_count == 1 and not notebook.cells[0].metadata
    assert output.text == "wrote build/x.csv"


def test_stored_notebook_refuses_a_run_with_other_parameters() -> None:
    injected = new_code_cell("n = 2", metadata={"tags": ["injected-parameters"]})
    with pytest.raises(ChapterError, match="not its defaults"):
        renew_notebooks.drop_injected(new_notebook(cells=[parameters_cell("n = 1"), injected]), "n.ipynb")


# ---- workflow -------------------------------------------------------------------------------------------------


def snakemake(folder: Path, *words: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--directory", folder]
    return subprocess.run([*command, *words], capture_output=True, text=True, check=False, cwd=folder)


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """An empty folder that Snakemake takes for the root of the repository."""
    for name in ("notebooks", "config", "book", "src", "workflow", "data/weights"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def test_generated_images_take_the_network_and_options_of_chapter_05() -> None:
    config = chapters.load_config(ROOT / "config/smoke.yaml")
    default = {
        "weights": "data/weights/unet.safetensors",
        "options": "--threshold=0 --device=cpu --bf16=auto",
    }
    assert chapters.translation(config) == default
    config["notebooks"]["05_real_vs_fake"] |= {"network": "chapter 4", "bf16": False, "device": "cuda"}
    assert chapters.translation(config) == {
        "weights": "build/smoke/pix2pix/generator.safetensors",
        "options": "--threshold=0 --device=cuda --bf16=false",
    }
    config["notebooks"]["05_real_vs_fake"]["network"] = "chapter 04"
    with pytest.raises(chapters.ChapterError, match=r"05_real_vs_fake: network: no file .*'chapter 4'"):
        chapters.translation(config)


def test_network_of_chapter_04_is_trained_before_its_images_are_generated(workplace: Path) -> None:
    config = chapters.load_config(ROOT / "config/smoke.yaml") | {"out_dir": "./build/smoke/"}
    config["notebooks"]["05_real_vs_fake"] |= {"network": "chapter 4"}
    (workplace / "own.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    made = "build/smoke/fake/sim-town-seq01/fake.json"
    answer = snakemake(workplace, "-n", "--quiet", "rules", "--configfile", "own.yaml", "--", made)
    assert answer.returncode == 0, answer.stderr
    plan = dict(re.findall(r"^(\w+) +(\d+)$", answer.stdout + answer.stderr, flags=re.MULTILINE))
    assert plan["pix2pix"] == "1" and plan["generated_images"] == "1"


def test_smoke_profile_plans_every_run(workplace: Path) -> None:
    answer = snakemake(workplace, "-n", "--quiet", "rules", "--configfile", "config/smoke.yaml")
    assert answer.returncode == 0, answer.stderr
    plan = dict(re.findall(r"^(\w+) +(\d+)$", answer.stdout + answer.stderr, flags=re.MULTILINE))
    assert plan == {
        "simulated_session": "5",
        "alignment": "5",
        "ground_removal": "5",
        "generated_images": "5",
        "localization": "8",
        "total": "41",
        **dict.fromkeys(("book", "sessions", "pix2pix", "real_vs_fake", "ground_truth", "results"), "1"),
        **dict.fromkeys(("oxford_route", "robust_filter", "real_pairs", "real_radar"), "1"),
        **dict.fromkeys(("ablations", "runtime", "simulator"), "1"),
    }


def test_missing_real_session_is_named(workplace: Path) -> None:
    answer = snakemake(workplace, "-n", "--configfile", "config/paper.yaml")
    assert answer.returncode != 0
    assert "2019-01-10-11-46-21-radar-oxford-10k/radar.timestamps is missing" in answer.stdout + answer.stderr


def test_unknown_parameter_ends_before_anything_runs(workplace: Path) -> None:
    config = chapters.load_config(ROOT / "config/smoke.yaml") | {
        "notebooks": {"08_results": {"no_such_parameter": 1}}
    }
    (workplace / "mine.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    answer = snakemake(workplace, "-n", "--configfile", "mine.yaml")
    assert answer.returncode != 0
    assert "cannot set no_such_parameter;" in answer.stdout + answer.stderr
