"""What must hold of the cluster profiles, and of the files that go with the project: hooks, changelog, Binder."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import chapters
import rol

ROOT = Path(__file__).resolve().parents[2]
PROFILES = ROOT / "workflow" / "profiles"
NAMES = sorted(path.parent.name for path in PROFILES.glob("*/config.yaml"))
HOOKS = {
    hook["id"]: hook
    for repo in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    for hook in repo["hooks"]
}


def load_profile(name: str) -> dict:
    return yaml.safe_load((PROFILES / name / "config.yaml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def rules() -> set[str]:
    """Names of the rules of the Snakefile."""
    command = [sys.executable, "-m", "snakemake", "--list-rules", "--snakefile", str(ROOT / "Snakefile")]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    return set(answer.stdout.split())


def requests(profile: dict) -> dict[str, dict[str, int]]:
    """What a profile asks for, by rule, with what all rules get if they have nothing of their own."""
    return {"": profile["default-resources"], **profile["set-resources"]}


# ---- cluster profiles -----------------------------------------------------------------------------------------


def test_there_is_a_profile_for_slurm_and_one_for_kubernetes() -> None:
    assert NAMES == ["kubernetes", "slurm"]


@pytest.mark.parametrize("name", NAMES)
def test_profile_names_rules_that_exist(name: str, rules: set[str]) -> None:
    profile = load_profile(name)
    assert "pix2pix" in rules
    assert set(profile["set-resources"]) <= rules
    assert set(profile.get("set-threads", {})) <= rules


@pytest.mark.parametrize("name", NAMES)
def test_profile_asks_for_what_a_node_has(name: str) -> None:
    for rule, asked in requests(load_profile(name)).items():
        assert set(asked) - {"gpu"} == {"mem_mb", "runtime"}, rule
        assert 1000 <= asked["mem_mb"] <= 64000
        assert 30 <= asked["runtime"] <= 7 * 24 * 60


def test_profiles_ask_for_the_same() -> None:
    kubernetes = load_profile("kubernetes")
    assert kubernetes["default-resources"].pop("gpu") == 0  # its command needs a number
    assert requests(load_profile("slurm")) == requests(kubernetes)


@pytest.mark.parametrize("name", NAMES)
def test_plugin_of_the_executor_is_pinned(name: str) -> None:
    executor = load_profile(name)["executor"]
    pins = [
        line
        for line in (PROFILES / name / "requirements.txt").read_text(encoding="utf-8").splitlines()
        if line[:1].isalpha()
    ]
    assert pins and all(re.fullmatch(r"[\w-]+==\d+\.\d+\.\d+", pin) for pin in pins)
    assert pins[0].startswith(f"snakemake-executor-plugin-{executor}==")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_profile_plans_all_jobs(name: str, tmp_path: Path) -> None:
    """All but the plugin's own options, since the plugin need not be installed."""
    for folder in ("notebooks", "config", "book", "src", "workflow", "data/weights"):
        (tmp_path / folder).parent.mkdir(exist_ok=True)
        (tmp_path / folder).symlink_to(ROOT / folder)
    profile = load_profile(name)
    executor = profile.pop("executor")
    own = {key: value for key, value in profile.items() if not key.startswith(f"{executor}-")}
    (tmp_path / "profile").mkdir()
    (tmp_path / "profile" / "config.yaml").write_text(yaml.safe_dump(own), encoding="utf-8")
    words = ["--snakefile", ROOT / "Snakefile", "--profile", "profile", "--configfile", "config/smoke.yaml"]
    command = [sys.executable, "-m", "snakemake", "-n", *words]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert answer.returncode == 0, answer.stderr
    plan = answer.stdout + answer.stderr
    runs = len(chapters.all_runs(chapters.load_config(ROOT / "config/smoke.yaml")))
    assert re.search(
        rf"^total +{runs + 5 + 5 + 1}$", plan, flags=re.MULTILINE
    )  # five sessions to make, their generated images, and the book


def test_script_that_tries_slurm_is_a_script() -> None:
    script = ROOT / "workflow/try_slurm.sh"
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", script], check=True)
    assert "--profile workflow/profiles/slurm" in script.read_text(encoding="utf-8")


# ---- jobs of Kubernetes ---------------------------------------------------------------------------------------


def submit(folder: Path, gpus: int = 0, mount: Path | None = None) -> subprocess.CompletedProcess:
    """Hand a job in from a folder with the command of the profile and a stand-in for kubectl, which prints the manifest."""
    kubectl = folder.parent / "kubectl"
    kubectl.write_text("#!/bin/sh\ncat\n", encoding="utf-8")
    kubectl.chmod(0o755)
    command = load_profile("kubernetes")["cluster-generic-submit-cmd"]
    values = {"rule": "real_vs_fake", "threads": "2", "resources.mem_mb": "8000", "resources.runtime": "90"}
    for name, value in (values | {"resources.gpu": str(gpus)}).items():
        assert f"{{{name}}}" in command
        command = command.replace(f"{{{name}}}", value)
    words = shlex.split(command.replace("MOUNT=/volume", f"MOUNT={mount or folder.parent}"))
    assert (ROOT / words[-1]).is_file()
    command = [*words[:-1], ROOT / words[-1], folder / "job.sh"]
    environment = os.environ | {"PATH": f"{folder.parent}:{os.environ['PATH']}"}
    return subprocess.run(command, cwd=folder, env=environment, check=False, capture_output=True, text=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder on the volume, with a name that YAML would misread without quotes."""
    (tmp_path / "a: 'b' #c").mkdir()
    return tmp_path / "a: 'b' #c"


def test_job_runs_its_script_on_the_volume(folder: Path) -> None:
    job = yaml.safe_load(submit(folder).stdout)
    assert (job["apiVersion"], job["kind"]) == ("batch/v1", "Job")
    assert re.fullmatch(r"[a-z0-9-]+", job["metadata"]["generateName"])
    assert job["metadata"]["labels"] == {"app": "radar-on-lidar", "rule": "real-vs-fake"}
    pod = job["spec"]["template"]["spec"]
    container = pod["containers"][0]
    assert container["image"] == "python:3.11"
    assert container["command"] == ["sh", str(folder / "job.sh")]
    assert container["workingDir"] == str(folder)
    assert container["volumeMounts"] == [{"name": pod["volumes"][0]["name"], "mountPath": str(folder.parent)}]
    assert pod["volumes"][0]["persistentVolumeClaim"] == {"claimName": "radar-on-lidar"}
    assert container["resources"]["requests"] == {"cpu": "2", "memory": "8000M"}
    assert container["resources"]["limits"] == {"memory": "8000M"}
    assert job["spec"]["activeDeadlineSeconds"] == 5400
    assert (pod["restartPolicy"], job["spec"]["backoffLimit"]) == ("Never", 0)


def test_job_with_a_graphics_card_asks_for_it(folder: Path) -> None:
    job = yaml.safe_load(submit(folder, gpus=1).stdout)
    container = job["spec"]["template"]["spec"]["containers"][0]
    assert container["resources"]["limits"] == {"memory": "8000M", "nvidia.com/gpu": "1"}


def test_job_off_the_volume_is_refused(folder: Path) -> None:
    answer = submit(folder, mount=Path("/elsewhere"))
    assert answer.returncode == 1 and not answer.stdout
    assert f"{folder} does not lie on the volume, which is mounted at /elsewhere" in answer.stderr


@pytest.mark.parametrize(
    ("answer", "status", "told"),
    [
        ("rol-x ", 0, "running"),
        ("rol-x Suspended", 0, "running"),
        ("rol-x SuccessCriteriaMet Complete", 0, "success"),
        ("rol-x FailureTarget Failed", 0, "failed"),
        ("rol-x FailureTarget", 0, "running"),
        ("", 0, "failed"),
        ("", 1, "running"),
    ],
)
def test_state_of_a_job_is_told_in_the_words_of_snakemake(
    answer: str, status: int, told: str, tmp_path: Path
) -> None:
    kubectl = tmp_path / "kubectl"
    kubectl.write_text(f"#!/bin/sh\nprintf '%s' '{answer}'\nexit {status}\n", encoding="utf-8")
    kubectl.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    script = ROOT / load_profile("kubernetes")["cluster-generic-status-cmd"]
    answered = subprocess.run([script, "rol-x"], env=environment, capture_output=True, text=True, check=True)
    assert answered.stdout == f"{told}\n"


# ---- hooks, changelog, Binder ---------------------------------------------------------------------------------


def run_hook(name: str, *files: Path) -> subprocess.CompletedProcess:
    """Run a hook as pre-commit does, with the ruff beside this Python."""
    words = shlex.split(HOOKS[name]["entry"])
    if words[0] == ".venv/bin/ruff":
        words[0] = str(Path(sys.executable).with_name("ruff"))
    return subprocess.run([*words, *map(str, files)], capture_output=True, text=True, check=False, cwd=ROOT)


def test_hooks_need_no_network() -> None:
    repos = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    assert [repo["repo"] for repo in repos] == ["local"]
    assert {hook["language"] for hook in HOOKS.values()} == {"system"}
    assert {"jupyter", "python"} <= set(HOOKS["ruff-check"]["types_or"]) & set(
        HOOKS["ruff-format"]["types_or"]
    )


def test_ruff_hooks_find_faults_in_code_and_notebooks(tmp_path: Path) -> None:
    bad, good = tmp_path / "bad.py", tmp_path / "good.py"
    bad.write_text("import os\nx = 'a'\n", encoding="utf-8")
    good.write_text('x = "a"\n', encoding="utf-8")
    for hook in ("ruff-check", "ruff-format"):
        assert run_hook(hook, good).returncode == 0
    assert "F401" in run_hook("ruff-check", bad).stdout
    run_hook("ruff-format", bad)
    assert '"a"' in bad.read_text(encoding="utf-8")
    for hook in ("ruff-check", "ruff-format"):
        answer = run_hook(hook, *sorted((ROOT / "notebooks").glob("*.ipynb")))
        assert answer.returncode == 0, answer.stdout


def test_large_files_are_refused(tmp_path: Path) -> None:
    large, small = tmp_path / "large file.png", tmp_path / "small.png"
    large.write_bytes(bytes(1537 * 1024))
    small.write_bytes(bytes(1536 * 1024))
    assert run_hook("large-files", small).returncode == 0
    answer = run_hook("large-files", small, large)
    assert answer.returncode == 1 and answer.stdout.strip() == str(large)


def test_files_of_the_project_are_not_large() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git repository")
    free = re.compile(HOOKS["large-files"]["exclude"])
    files = [ROOT / name for name in listed.stdout.split("\0") if name and not free.search(name)]
    answer = run_hook("large-files", *(file for file in files if file.exists()))
    assert answer.returncode == 0, answer.stdout


def test_changelog_begins_with_this_version() -> None:
    headings = re.findall(
        r"^## \[(\S+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert next(heading for heading in headings if heading != "Unreleased") == rol.__version__


def test_binder_makes_a_session_of_the_demo() -> None:
    script = ROOT / "postBuild"
    assert os.access(script, os.X_OK)
    config, session, out = re.search(
        r"rol_sim (\S+) --session (\S+) --out (\S+)", script.read_text(encoding="utf-8")
    ).groups()
    demo = chapters.load_config(ROOT / config)
    assert demo["profile"] == "demo" and session == demo["sessions"][0] and out == demo["sessions_root"]


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("profile: smoke", "profile: [", "not YAML"),
        ("methods: [paper, robust]", "methods: paper", "`methods` is no list of names"),
        ("methods: [paper, robust]", "methods: []", "`methods` is no list of names, or empty"),
        ("book_dir: build/smoke/book", "book_dir: .", "`book_dir` names no folder of its own: '.'"),
        ("out_dir: build/smoke", 'out_dir: ""', "`out_dir` names no folder of its own: ''"),
    ],
)
def test_profiles_with_values_of_another_kind_are_named(
    tmp_path: Path, old: str, new: str, fault: str
) -> None:
    text = (chapters.ROOT / "config/smoke.yaml").read_text(encoding="utf-8")
    (tmp_path / "x.yaml").write_text(text.replace(old + "\n", new + "\n", 1), encoding="utf-8")
    with pytest.raises(chapters.ChapterError, match=f"x.yaml: {fault}"):
        chapters.load_config(tmp_path / "x.yaml")


def test_an_empty_profile_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").touch()
    with pytest.raises(chapters.ChapterError, match=r"x\.yaml: holds no keys"):
        chapters.load_config(tmp_path / "x.yaml")
