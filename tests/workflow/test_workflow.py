"""The Snakefile with a stand-in for papermill: paths of any name, checkpoints that are continued, one run at a time."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

import chapters

ROOT = Path(__file__).resolve().parents[2]
PAPERMILL = """
import sys
from pathlib import Path
out_dir = sys.argv[sys.argv.index("out_dir") + 1]
weights = Path(out_dir, "pix2pix", "generator.safetensors")
checkpoint = Path(out_dir, "pix2pix", "checkpoint", "last.safetensors")
print("python:", sys.executable)
print("continues" if checkpoint.exists() else "starts")
checkpoint.write_text("steps")
Path(sys.argv[2]).write_text("{}")
weights.write_text("weights")
"""
HOLD = "import sys, run_lock; run_lock.wait_for_lock(sys.argv[1], 'a.yaml'); print('held', flush=True); sys.stdin.read()"


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """A root of the repository, and an interpreter, below a folder whose name has a space, an umlaut and a quote."""
    root = tmp_path / "Käse 'Ordner"
    for name in ("notebooks", "config", "book", "src", "workflow", "data/weights"):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).symlink_to(ROOT / name)
    (root / "python").symlink_to(sys.executable)
    (root / "stub/papermill").mkdir(parents=True)
    (root / "stub/papermill/__init__.py").touch()
    (root / "stub/papermill/__main__.py").write_text(PAPERMILL, encoding="utf-8")
    config = chapters.load_config(ROOT / "config/smoke.yaml") | {"out_dir": str(root / "my results")}
    (root / "mein Profil.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    pairs = root / "my results/pairs" / config["sessions"][0] / "pairs.json"
    pairs.parent.mkdir(parents=True)
    pairs.write_text("{}", encoding="utf-8")
    return root


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen]]:
    """Start processes, and end those that are left."""
    started = []

    def start_one(words: list[str | Path], **options: object) -> subprocess.Popen:
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        started.append(subprocess.Popen(words, text=True, **pipes, **options))
        return started[-1]

    yield start_one
    for process in started:
        process.kill()
        process.communicate()


def train(root: Path, profile: str = "mein Profil.yaml", *words: str) -> list[str | Path]:
    """Return the command that runs the rule of chapter 4 alone."""
    python = [root / "python", "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "-c1", "--nolock"]
    weights = root / "my results/pix2pix/generator.safetensors"
    return [*python, "--allowed-rules", "pix2pix", "--configfile", profile, *words, "--", weights]


def environment(root: Path) -> dict[str, str]:
    """Give the environment in which the interpreter finds the stand-in first, with an ASCII locale."""
    paths = [root / "stub", ROOT / "src", *(path for path in sys.path if "site-packages" in path)]
    return os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "LC_ALL": "C"}


def test_every_path_in_a_command_is_quoted() -> None:
    names = r"PYTHON|JUPYTER_BOOK|(?:input|output|log)(?:\.\w+)?"
    text = (ROOT / "Snakefile").read_text(encoding="utf-8")
    assert re.findall(rf"\{{(?:{names})\}}", text) == []
    assert len(re.findall(rf"\{{(?:{names}):q\}}", text)) > 10


@pytest.mark.slow
def test_training_continues_after_a_stop_and_starts_anew_after_a_change(workplace: Path) -> None:
    run = {"cwd": workplace, "env": environment(workplace), "capture_output": True, "text": True}
    folder, log = workplace / "my results/pix2pix", workplace / "my results/logs/04_pix2pix.log"
    profile, told = workplace / "mein Profil.yaml", []
    for steps in (20, 20, 30):
        profile.write_text(
            profile.read_text(encoding="utf-8").replace("steps: 20", f"steps: {steps}"), encoding="utf-8"
        )
        (folder / "generator.safetensors").unlink(missing_ok=True)  # as after a stop
        answer = subprocess.run(train(workplace), check=False, **run)
        assert answer.returncode == 0, answer.stderr
        told.append(log.read_text(encoding="utf-8").splitlines())
    assert [lines[1] for lines in told] == ["starts", "continues", "starts"]
    assert told[0][0] == f"python: {workplace / 'python'}"
    assert (folder / "checkpoint-before/last.safetensors").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "folder", "listing", "image"),
    [
        ("generated_images", "fake", "fake.json", "7.png"),
        ("ground_removal", "pairs", "pairs.json", "radar/7.png"),
    ],
)
def test_images_of_other_code_are_made_anew(
    workplace: Path, rule: str, folder: str, listing: str, image: str
) -> None:
    config = chapters.load_config(ROOT / "config/smoke.yaml")
    session = config["sessions"][0]
    made = workplace / "my results" / folder / session
    needed = [
        workplace / config["sessions_root"] / session / "session.json",
        workplace / "my results/alignment" / session / "alignment.csv",
        made / image,
    ]
    for path in needed:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (made / "settings.json").write_text(f'{{"listing": "{listing}", "settings": {{}}}}', encoding="utf-8")
    if rule == "ground_removal":
        (made / listing).unlink()
    command = [word if word != "pix2pix" else rule for word in train(workplace)[:-1]] + [made / listing]
    there = []
    for code in ("other", None):
        needed[-1].touch()
        if code:
            made.with_name(f"{made.name}.code").write_text(code, encoding="utf-8")
        answer = subprocess.run(
            command, check=False, cwd=workplace, env=environment(workplace), capture_output=True, text=True
        )
        # The job ends without images: the pairs are none, and papermill is a stand-in.
        assert rule in answer.stdout + answer.stderr and answer.returncode != 0
        there.append(needed[-1].exists())
    assert there == [False, True]


@pytest.mark.parametrize("profile", sorted((ROOT / "config").glob("*.yaml")), ids=lambda path: path.stem)
def test_no_profile_trains_from_step_0_after_a_stop(profile: Path) -> None:
    run = chapters.Run("04_pix2pix")
    known = chapters.notebook_parameters(chapters.NOTEBOOKS / "04_pix2pix.ipynb")
    assert (known | chapters.run_parameters(chapters.load_config(profile), run))["resume"] is True


def test_lock_is_waited_for_and_free_after_a_kill(
    tmp_path: Path, start: Callable[..., subprocess.Popen]
) -> None:
    hold = [sys.executable, "-c", HOLD, tmp_path / ".snakemake/run.lock"]
    options = {"env": os.environ | {"PYTHONPATH": str(ROOT / "workflow")}}
    first = start(hold, **options)
    assert first.stdout.readline() == "held\n"
    second = start(hold, **options)
    told = second.stderr.readline()
    assert f"at work in {tmp_path}: a.yaml, process {first.pid}, since " in told
    assert second.poll() is None
    first.kill()
    assert second.stdout.readline() == "held\n"
    assert f"process {second.pid}," in (tmp_path / ".snakemake/run.lock").read_text(encoding="utf-8")


@pytest.mark.slow
def test_second_run_waits_for_the_first_and_a_dry_run_does_not(
    workplace: Path, start: Callable[..., subprocess.Popen]
) -> None:
    options = {"cwd": workplace, "env": environment(workplace) | {"PYTHONUNBUFFERED": "1"}}
    hold = [workplace / "python", "-c", HOLD, workplace / ".snakemake/run.lock"]
    first = start(hold, cwd=workplace / "workflow", env=options["env"])
    assert first.stdout.readline() == "held\n"
    second = start(train(workplace), **options)
    assert "Another run is at work" in next(line for line in second.stderr if "run" in line)
    dry = subprocess.run(
        train(workplace, "mein Profil.yaml", "-n"), check=False, capture_output=True, **options
    )
    assert dry.returncode == 0 and not (workplace / "my results/pix2pix/generator.safetensors").exists()
    first.kill()
    assert second.wait() == 0, second.stderr.read()
    assert (workplace / "my results/pix2pix/generator.safetensors").is_file()
