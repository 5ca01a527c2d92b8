"""Set-up: the lock for every Python, what the pages name, and set_up.sh with interpreters that only pretend."""

import fcntl
import functools
import importlib.metadata
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
LOCK = [line for line in (ROOT / "requirements.lock").read_text("utf-8").splitlines() if line[:1] != "#"]
PYTHONS = ["3.11.0", "3.11.2", "3.11.14", "3.12.0", "3.13.0"]
LINUX = {"sys_platform": "linux", "platform_machine": "x86_64", "platform_system": "Linux"}
MACOS = {"sys_platform": "darwin", "platform_machine": "arm64", "platform_system": "Darwin"}


def environment(python: str, platform: dict[str, str]) -> dict[str, str]:
    """Describe a Python on a platform as markers see it."""
    return {"python_full_version": python, "python_version": python.rpartition(".")[0], **platform}


def pins(where: dict[str, str]) -> dict[str, str]:
    """Read the versions that the lock has for an environment; a name may have one only."""
    found = {}
    for pin in map(Requirement, LOCK):
        if pin.marker is None or pin.marker.evaluate(where):
            name = canonicalize_name(pin.name)
            assert name not in found, f"two versions of {name} for {where}"
            [specifier] = pin.specifier
            assert specifier.operator == "==", pin
            found[name] = specifier.version
    return found


# ---- the lock -------------------------------------------------------------------------------------------------


def test_lock_names_no_index_and_no_file() -> None:
    assert [line for line in LOCK if not re.match(r"[A-Za-z0-9_.-]+==[\w.+]+( ; .+)?$", line)] == []


@pytest.mark.parametrize("platform", [LINUX, MACOS], ids=["linux", "macos"])
@pytest.mark.parametrize("python", PYTHONS)
def test_lock_covers_what_the_project_asks_for(python: str, platform: dict[str, str]) -> None:
    where = environment(python, platform)
    versions = pins(where)
    for wanted in map(Requirement, itertools.chain(PROJECT["dependencies"], *EXTRAS.values())):
        if wanted.name != "rol" and (wanted.marker is None or wanted.marker.evaluate(where)):
            assert versions[canonicalize_name(wanted.name)] in wanted.specifier, wanted


@functools.cache
def asked_for_by(name: str, version: str) -> list[Requirement]:
    """Read what a package asks for; nothing if it is not installed in this version, as for another Python."""
    found = list(importlib.metadata.distributions(name=name))[:1]
    is_there = found and found[0].version.partition("+")[0] == version
    return [Requirement(line) for line in found[0].requires or []] if is_there else []


@pytest.mark.parametrize("python", PYTHONS)
def test_lock_covers_what_the_packages_ask_for(python: str) -> None:
    where = environment(python, LINUX)
    versions = pins(where)
    for name, version in versions.items():
        for part in asked_for_by(name, version):
            if part.marker is None or part.marker.evaluate({**where, "extra": ""}):
                brought_by_torch = re.match(r"cuda|nvidia|triton", part.name)
                assert brought_by_torch or canonicalize_name(part.name) in versions, (
                    f"{name} needs {part.name}"
                )


def test_python_is_the_same_everywhere() -> None:
    allowed = SpecifierSet(PROJECT["requires-python"])
    conda = yaml.safe_load((ROOT / "environment.yml").read_text("utf-8"))["dependencies"][0]
    assert conda.removeprefix("python=") + ".0" in allowed
    fitting = re.search(r"^fitting='(.*)'", (ROOT / "workflow/set_up.sh").read_text("utf-8"), re.MULTILINE)
    for version in [(3, 10, 9), (3, 11, 0), (3, 12, 4), (3, 13, 9), (3, 14, 0)]:
        code = f"import sys; sys.version_info = {version}; {fitting[1]}"
        fits = subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
        assert fits == (".".join(map(str, version)) in allowed), version


# ---- what the system must have --------------------------------------------------------------------------------


def test_readme_names_the_packages_of_the_system() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    for manager, file in (("apt-get install", "apt.txt"), ("dnf install", "workflow/dnf.txt")):
        packages = (ROOT / file).read_text("utf-8").split()
        assert packages == sorted(packages, key=str.lower)
        assert f"{manager} {' '.join(packages)}\n" in readme


def test_containers_take_the_same_steps() -> None:
    docker = (ROOT / "Dockerfile").read_text("utf-8")
    text = (ROOT / ".devcontainer/devcontainer.json").read_text("utf-8")
    container = json.loads(re.sub(r"^\s*//.*$", "", text, flags=re.MULTILINE))
    assert "$(cat apt.txt)" in docker and "RUN make setup" in docker
    assert (ROOT / ".devcontainer" / container["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"
    assert f" AS {container['build']['target']}\n" in docker
    assert container["postCreateCommand"] == "make setup"
    ignored = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert {".venv", "build", "data/sessions", "data/real"} <= set(ignored)


# ---- set_up.sh ------------------------------------------------------------------------------------------------

# Plays Python, pip and uv: what it is asked for goes into $LOG, and files in $FAULTS say what shall fail.
PRETENDER = r"""#!/bin/bash
echo "$(basename "$0") $*" >>"$LOG"
failing() { if [ -e "$FAULTS/$1" ]; then cat "$FAULTS/$1" >&2; exit 1; fi; }
case "$(basename "$0") $*" in
*"python install"*) failing python-download ;;
*"python find"*) echo "$BROUGHT" ;;
"uv pip install"*torch-backend*) failing torch ;;
"uv pip install"*)
    if [ -e "$FAULTS/killed" ]; then kill -9 "$PPID"; exit 1; fi
    failing uv-install; failing pip ;;
*ensurepip*) if [ -n "${UNFIT:-}" ] && [[ $0 != *.venv/* && $0 != */brought-python ]]; then exit 1; fi ;;
*"-m venv"*) mkdir -p "${*: -1}/bin"; cp "$0" "${*: -1}/bin/python" ;;
*"pip install -qq uv"*) failing uv; cp "$0" "$(dirname "$0")/uv" ;;
*"pip install -qq -r"*) failing pip ;;
*"import open3d"*) failing open3d ;;
*fcntl*) exec "$REAL" "$@" ;;
*"--version") echo "Python 3.x" ;;
esac
"""


TOOLS = [
    "bash",
    "basename",
    "cat",
    "cp",
    "dirname",
    "env",
    "mkdir",
    "paste",
    "rm",
    "sed",
    "tail",
    "touch",
    "uname",
]


class Place:
    """A folder with an awkward name in which set_up.sh finds nothing but pretended interpreters."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "Käse Ordner"
        self.log, self.faults = folder / "log", folder / "faults"
        for path in (self.root, self.faults, folder / "bin"):
            path.mkdir()
        shutil.copytree(
            ROOT / "workflow", self.root / "workflow", ignore=shutil.ignore_patterns("__pycache__")
        )
        shutil.copy(ROOT / "apt.txt", self.root)
        (self.root / "requirements.lock").write_text("torch==1.2.3\nuv==1\n", encoding="utf-8")
        brought = folder / "brought-python"
        self.environment = {
            "LOG": str(self.log),
            "FAULTS": str(self.faults),
            "BROUGHT": str(brought),
            "REAL": sys.executable,
        }
        for path in (folder / "bin" / "python3", brought):
            path.write_text(PRETENDER, encoding="utf-8")
            path.chmod(0o755)
        for tool in TOOLS:
            (folder / "bin" / tool).symlink_to(shutil.which(tool))
        self.environment["PATH"] = str(folder / "bin")

    def set_up(self, **variables: str) -> subprocess.CompletedProcess:
        self.log.write_text("", encoding="utf-8")
        return subprocess.run(
            ["workflow/set_up.sh", ".venv", ".venv/set-up-1"],
            cwd=self.root, env=self.environment | variables, capture_output=True, text=True, check=False,
        )  # fmt: skip

    def fail(self, what: str, message: str = "") -> None:
        (self.faults / what).write_text(message, encoding="utf-8")

    def start(self) -> subprocess.Popen:
        """Start set_up.sh beside the test."""
        command = ["workflow/set_up.sh", ".venv", ".venv/set-up-1"]
        return subprocess.Popen(
            command, cwd=self.root, env=self.environment, stdout=subprocess.PIPE, text=True
        )

    @property
    def done(self) -> bool:
        return (self.root / ".venv/set-up-1").exists()


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def test_set_up_waits_for_another_one_and_takes_its_result(place: Place) -> None:
    with (place.root / ".venv.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with place.start() as waiting:
            assert "another set-up is at work" in waiting.stdout.readline()
            (place.root / ".venv").mkdir()
            (place.root / ".venv/set-up-1").touch()
            fcntl.flock(lock, fcntl.LOCK_UN)
    assert waiting.returncode == 0
    assert not (place.root / ".venv/bin").exists()


def test_pip_installs_what_uv_cannot_find(place: Place) -> None:
    place.fail("uv-install", "error: no such index")
    answer = place.set_up()
    assert (answer.returncode, answer.stderr, place.done) == (0, "", True)
    assert "python -m pip install -qq -r requirements.lock" in place.log.read_text(encoding="utf-8")


def test_set_up_asks_uv_for_torch_and_then_for_the_rest(place: Place) -> None:
    answer = place.set_up()
    assert (answer.returncode, answer.stderr, place.done) == (0, "", True)
    steps = re.findall(
        r"-m venv|--torch-backend=auto torch==1.2.3|-r requirements.lock|import open3d",
        place.log.read_text(encoding="utf-8"),
    )
    assert steps == ["-m venv", "--torch-backend=auto torch==1.2.3", "-r requirements.lock", "import open3d"]
    assert not (place.root / ".venv/unfinished").exists()


def test_torch_comes_by_pip_where_its_index_cannot_be_reached(place: Place) -> None:
    place.fail("torch", "error: Failed to fetch\n  cause: no such host\n")
    answer = place.set_up()
    assert answer.returncode == 0 and place.done
    assert "PyTorch comes by pip" in answer.stdout and "(uv: no such host)" in answer.stdout


def test_missing_library_is_named_with_the_packages(place: Place) -> None:
    place.fail("open3d", "Traceback\nOSError: libX11.so.6: cannot open shared object file\n")
    answer = place.set_up()
    assert answer.returncode == 1 and not place.done
    assert "open3d cannot be imported: OSError: libX11.so.6" in answer.stderr
    assert (
        "apt-get install ca-certificates git" in answer.stderr and "dnf install git libgomp" in answer.stderr
    )
    (place.faults / "open3d").unlink()
    assert place.set_up().returncode == 0 and place.done
    assert "-m venv" not in place.log.read_text(encoding="utf-8")


@pytest.mark.parametrize("fault", ["pip", "killed"])
def test_interrupted_set_up_begins_anew(place: Place, fault: str) -> None:
    assert place.set_up().returncode == 0 and place.done
    place.fail(fault)
    assert place.set_up().returncode != 0 and not place.done
    (place.faults / fault).unlink()
    assert place.set_up().returncode == 0 and place.done
    assert "-m venv --clear .venv" in place.log.read_text(encoding="utf-8")


def test_python_is_brought_by_uv_where_none_fits(place: Place) -> None:
    answer = place.set_up(UNFIT="1")
    assert answer.returncode == 0 and place.done, answer.stderr
    assert "asking uv for Python 3.13" in answer.stderr
    assert "brought-python -m venv --clear .venv" in place.log.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("fault", "told"),
    [("python-download", "uv cannot bring Python 3.13 (no such host)"), ("uv", "(no such host)")],
)
def test_python_that_cannot_be_brought_is_told(place: Place, fault: str, told: str) -> None:
    place.fail(fault, "error\nno such host\n")
    answer = place.set_up(UNFIT="1")
    assert answer.returncode == 1 and not place.done
    assert told in answer.stderr and "Python 3.11 to 3.13" in answer.stderr


def test_python_that_was_named_and_does_not_fit_is_refused(place: Place) -> None:
    answer = place.set_up(UNFIT="1", PYTHON="python3")
    assert answer.returncode == 1 and not place.done
    assert "PYTHON=python3 is no Python 3.11, 3.12 or 3.13 with venv" in answer.stderr


@pytest.mark.parametrize("locale", ["C", "en_US.ISO-8859-1"])
def test_make_sets_up_in_a_folder_with_spaces_whatever_the_locale(place: Place, locale: str) -> None:
    shutil.copy(ROOT / "Makefile", place.root)
    (place.root / "pyproject.toml").write_text("", encoding="utf-8")
    variables = os.environ | place.environment | {"PATH": f"{place.environment['PATH']}:{os.environ['PATH']}"}
    variables |= {"LC_ALL": locale, "PYTHONUTF8": "0", "PYTHON": "python3"}
    command = ["make", "--no-print-directory", "setup"]
    answer = subprocess.run(command, cwd=place.root, env=variables, capture_output=True, check=False)
    assert answer.returncode == 0, answer.stderr
    again = subprocess.run([*command, "-q"], cwd=place.root, env=variables, check=False)
    assert again.returncode == 0
