"""Parameters of the notebooks: what cannot be run with is refused in the first cell, with the parameter's name."""

import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from chapters import (
    NOTEBOOKS,
    all_runs,
    load_config,
    notebook_parameters,
    read_notebook,
    run_parameters,
    tagged_cells,
)
from rol_book.parameters import ParameterError, check_parameters, read_parameters

ROOT = Path(__file__).resolve().parents[2]
PARAMETERS = """
sessions_root = "data/sessions"  # a comment
sessions = ["one", "two"]
session = "one"
in_dir = "build/in"
out_dir = "build/out"
weights = "data/weights/net.bin"
real_root = ""
seed = 1
reach = 0.5
bf16 = False
fast = "auto"
weights_root = "data/weights"
network = "net"
n_runs = 5
max_scans = 0
device = "cpu"
low_m = -1.5
"""


@pytest.fixture
def defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    """Parameters of a small notebook in a small repository, where the test runs; all that it reads is there."""
    cell = nbformat.v4.new_code_cell(PARAMETERS, metadata={"tags": ["parameters"]})
    for folder in ("notebooks", "data/sessions/one", "data/sessions/three", "build/in", "data/weights"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("net.bin", "net.safetensors"):
        (tmp_path / "data/weights" / name).touch()
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "notebooks" / "x.ipynb")
    monkeypatch.chdir(tmp_path)
    return read_parameters("notebooks/x.ipynb")


def test_defaults_pass_and_leave_only_a_mark(defaults: dict) -> None:
    namespace = dict(defaults)
    check_parameters("x", namespace)
    assert namespace == {**defaults, "_rol_checked": True}


def test_what_jupyter_puts_there_is_no_parameter(defaults: dict) -> None:
    check_parameters("x", {**defaults, "In": [""], "Out": {}, "_": "", "__name__": "__main__", "exit": print})


def test_in_the_folder_of_the_notebooks_it_goes_to_the_root(
    defaults: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path.cwd()
    monkeypatch.chdir("notebooks")
    check_parameters("x", defaults)
    assert Path.cwd() == root


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"seed": "3"},
            r"x\.ipynb: seed: expected a whole number such as 1, got '3'; papermill passes it by -p",
        ),
        ({"seed": 3.0}, "seed: expected a whole number such as 1, got 3.0"),
        ({"seed": True}, "seed: expected a whole number"),
        ({"reach": "far"}, "reach: expected a number such as 0.5, got 'far'"),
        ({"reach": float("nan")}, "reach: nan"),
        ({"out_dir": ""}, "out_dir: must not be empty; its default is 'build/out'"),
        ({"max_scans": 1}, "max_scans: one scan is no path; 0 uses all"),
        ({"n_runs": 0}, "n_runs: must be at least 1, got 0"),
        ({"max_scans": -1}, "max_scans: must not be negative, got -1"),
        ({"reach": -0.1}, "reach: must not be negative, got -0.1"),
        ({"device": "gpu"}, "device: 'gpu' is none of 'cpu', 'cuda'"),
        ({"network": "nonsense"}, r"network: 'nonsense' has no file .*nonsense\.safetensors; there are: net"),
        ({"bf16": 1}, "bf16: expected True or False such as False, got 1"),
        ({"bf16": "True"}, "bf16: expected True or False"),
        ({"session": 2}, "session: expected text such as 'one', got 2; papermill passes text by -r"),
        ({"sessions": "one"}, "sessions: expected a list such as .*, got 'one'"),
        ({"sessions": ["one", 2]}, "sessions: in the list: expected text such as 'one', got 2"),
        ({"sessions": []}, "sessions: the list is empty"),
        ({"sede": 3}, r"sede: unknown parameter \(parameters: sessions_root, sessions, "),
        (
            {"sessions_root": "/nonexistent"},
            "sessions_root: folder '/nonexistent' does not exist; `make book`",
        ),
        ({"in_dir": "data/weights/net.bin"}, "in_dir: folder 'data/weights/net.bin' does not exist"),
        ({"in_dir": "build/other"}, "in_dir: folder 'build/other' does not exist; .*`make book`"),
        (
            {"weights": "data/none.bin"},
            "weights: file 'data/none.bin' does not exist; it comes with the repository",
        ),
        ({"real_root": "/nonexistent"}, "real_root: folder '/nonexistent' does not exist; `make real`"),
        ({"session": "three"}, "session: 'three' is none of the sessions one, two"),
        ({"session": "two"}, "session: 'two' is not in data/sessions; there are: one, three"),
        ({"seed": "3", "reach": "far"}, "seed: expected .*; reach: expected"),
    ],
)
def test_faults_are_named(defaults: dict, changes: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        check_parameters("x", defaults | changes)


def test_what_is_allowed(defaults: dict) -> None:
    check_parameters("x", defaults | {"reach": 1, "session": "all", "out_dir": "/nonexistent/out"})
    check_parameters("x", defaults | {"in_dir": "/nonexistent"}, optional=["in_dir"])
    check_parameters("x", defaults | {"fast": False})


def test_missing_parameters_and_notebooks_are_named(defaults: dict) -> None:
    without = {name: value for name, value in defaults.items() if name != "seed"}
    with pytest.raises(ParameterError, match="seed: missing, its default is 1"):
        check_parameters("x", without)
    with pytest.raises(ParameterError, match=r"y\.ipynb: not found in .*; run it in the root"):
        check_parameters("y", defaults)


def test_second_run_of_all_cells_passes(defaults: dict) -> None:
    """Without a restart of the kernel the names of later cells are there; the parameters are checked all the same."""
    check_parameters("x", defaults)
    defaults["n_later"] = 7
    check_parameters("x", defaults)
    with pytest.raises(ParameterError, match="seed"):
        check_parameters("x", defaults | {"seed": "3"})


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_every_notebook_checks_its_parameters_first(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_parameters(path) == notebook_parameters(path)
    code = [cell for cell in read_notebook(path).cells if cell.cell_type == "code"]
    lines = code[1].source.splitlines()
    assert lines[0] == "from rol_book.parameters import check_parameters"
    call = next(line for line in lines[1:] if line)
    assert call.startswith(f'check_parameters("{path.stem}", globals()')
    monkeypatch.chdir(ROOT)
    with pytest.raises(ParameterError, match=rf"{path.stem}\.ipynb: sede: unknown parameter"):
        check_parameters(path.stem, read_parameters(path) | {"sede": 3})


def test_papermill_ends_in_the_first_cell(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "papermill", "notebooks/10_real_radar.ipynb", str(tmp_path / "10.ipynb")]
    command += ["--kernel", "python3", "--no-progress-bar", "-r", "out_dir", str(tmp_path)]
    command += ["-r", "seed", "3", "-r", "real_root", "/nonexistent", "-p", "sede", "3"]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode != 0
    for words in (
        "ParameterError: notebooks/10_real_radar.ipynb: sede: unknown parameter",
        "seed: expected a whole number such as 1, got '3'",
        "real_root: folder '/nonexistent' does not exist",
    ):
        assert words in answer.stderr
    executed = read_notebook(tmp_path / "10.ipynb")
    assert len(tagged_cells(executed, "injected-parameters")) == 1
    done = [cell for cell in executed.cells if cell.get("execution_count")]
    assert len(done) == 3  # parameters, those that were passed, and the check


@pytest.mark.parametrize("profile", sorted((ROOT / "config").glob("*.yaml")), ids=lambda path: path.stem)
def test_profiles_pass_what_the_notebooks_accept(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for folders and sessions, which only a run has."""
    config = load_config(profile)
    monkeypatch.chdir(ROOT)
    for run in all_runs(config):
        defaults = read_parameters(NOTEBOOKS / f"{run.chapter}.ipynb")
        folders = [name for name, value in defaults.items() if isinstance(value, str)]
        namespace = defaults | run_parameters(config, run)
        if "session" in namespace:
            assert isinstance(namespace["session"], str)
            namespace["session"] = "all"
        check_parameters(run.chapter, namespace, optional=folders)


def test_zero_means_something_for_a_seed_and_below_zero_for_a_height(defaults: dict) -> None:
    check_parameters("x", {**defaults, "seed": 0, "low_m": -2.0, "network": "chapter 4"})


def test_text_is_no_value_of_bf16() -> None:
    with pytest.raises(ParameterError, match="bf16: 'false' is none of 'auto', True, False"):
        check_parameters(
            "10_real_radar", {**read_parameters(NOTEBOOKS / "10_real_radar.ipynb"), "bf16": "false"}
        )


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["benchmarks/filter.py", "--rounds", "0"], "argument --rounds: invalid positive value: '0'"),
        (["benchmarks/route.py", "--only", "typo"], "--only: no table 'typo'; there are: seeds"),
        (["workflow/generate_images.py", "a", "b", "c", "--device", "gpu"], "invalid choice: 'gpu'"),
    ],
)
def test_command_lines_refuse_numbers_and_names_that_do_nothing(words: list[str], fault: str) -> None:
    run = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 2 and fault in run.stderr
