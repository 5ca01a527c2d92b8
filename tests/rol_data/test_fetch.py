"""Fetching of the real data from public repositories, tried on local bare repositories."""

import fcntl
import hashlib
import json
import os
import re
import subprocess
from pathlib import Path

import pytest

import get_real
from get_real import LIST
from rol_data import fetch
from rol_data.fetch import FetchError, check_all, fetch_all, load_list

FILES = {f"data/scans/{number}.bin": bytes([number]) * 999 for number in range(5)} | {"poses.txt": b"1 2\r\n"}


def git(folder: Path, *arguments: str) -> str:
    names = {f"GIT_{who}_{what}": "a@b.c" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    command = ["git", "-C", str(folder), *arguments]
    done = subprocess.run(command, env=os.environ | names, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def public(tmp_path: Path) -> tuple[str, dict]:
    """A bare repository that serves parts of itself, and its entry in the list; its last commit has lost a file."""
    work = tmp_path / "work"
    for name, content in (FILES | {"data/large.bin": b"not listed"}).items():
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_bytes(content)
    git(work, "init", "-q")
    git(work, "config", "core.autocrlf", "false")
    git(work, "add", ".")
    git(work, "commit", "-q", "-m", "Data")
    commit = git(work, "rev-parse", "HEAD")
    git(work, "rm", "-q", "data/scans/0.bin")
    git(work, "commit", "-q", "-m", "Less data")
    bare = tmp_path / "server" / "owner" / "name.git"
    git(tmp_path, "clone", "-q", "--bare", str(work), str(bare))
    for setting in ("uploadpack.allowFilter", "uploadpack.allowAnySHA1InWant"):
        git(bare, "config", setting, "true")
    files = {name: hashlib.sha256(content).hexdigest() for name, content in FILES.items()}
    words = {"content": "scans", "terms": "none", "cite": "nobody", "bytes": 5000}
    entry = {"folder": "name", "repository": "owner/name", "commit": commit, "files": files} | words
    return f"file://{tmp_path}/server", entry


def tree(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root / "name").as_posix(): path.read_bytes()
        for path in (root / "name").rglob("*")
        if path.is_file()
    }


def test_only_the_listed_files_of_the_pinned_commit_are_fetched(
    public: tuple[str, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, entry = public
    monkeypatch.setenv("GIT_CONFIG_COUNT", "1")
    monkeypatch.setenv("GIT_CONFIG_KEY_0", "core.autocrlf")
    monkeypatch.setenv("GIT_CONFIG_VALUE_0", "input")
    assert fetch_all([entry], tmp_path / "real", url) == []
    assert tree(tmp_path / "real") == FILES
    assert os.listdir(tmp_path / "real") == ["name"]
    assert check_all([entry], tmp_path / "real") == []


def test_files_that_are_not_listed_are_not_transferred(public: tuple[str, dict], tmp_path: Path) -> None:
    url, entry = public
    clone, commit = tmp_path / "clone", entry["commit"]
    clone.mkdir()
    fetch.make_clone(clone, f"{url}/owner/name.git", commit)
    fetch.fetch_files(clone, commit, list(FILES), entry["files"], tmp_path / "real" / "name")
    assert tree(tmp_path / "real") == FILES
    listed = git(clone, "rev-list", "--objects", "--missing=print", commit)
    blob = hashlib.sha1(b"blob 10\0not listed").hexdigest()
    assert f"?{blob}" in listed and listed.count("?") == 1


def test_corrupted_and_missing_files_are_named_and_repaired(
    public: tuple[str, dict], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    url, entry = public
    root = tmp_path / "real"
    fetch_all([entry], root, url)
    before = (root / "name/data/scans/3.bin").stat()
    (root / "name/data/scans/1.bin").write_bytes(b"\x01" * 998 + b"?")
    (root / "name/data/scans/2.bin").unlink()
    (root / "name/data/scans/own.bin").write_bytes(b"own")
    faults = check_all([entry], root)
    assert len(faults) == 2 and re.search(r"1\.bin: corrupted", faults[0]) and "2.bin: missing" in faults[1]
    capsys.readouterr()
    assert fetch_all([entry], root, url) == []
    assert re.search(r"1\.bin: corrupted .*fetched again", capsys.readouterr().out)
    assert tree(root) == FILES | {"data/scans/own.bin": b"own"}
    assert (root / "name/data/scans/3.bin").stat().st_mtime_ns == before.st_mtime_ns


def test_interrupted_run_is_resumed(
    public: tuple[str, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, entry = public
    root, checkouts = tmp_path / "real", []
    run_git = fetch.run_git

    def stop_at_second(clone: Path, *arguments: str) -> None:
        checkouts.extend(arguments[:1] if arguments[0] == "checkout" else ())
        if len(checkouts) == 2:
            raise KeyboardInterrupt
        run_git(clone, *arguments)

    monkeypatch.setattr(fetch, "BATCH", 2)
    monkeypatch.setattr(fetch, "run_git", stop_at_second)
    with pytest.raises(KeyboardInterrupt):
        fetch_all([entry], root, url)
    (root / fetch.FETCHING / "killed" / ".git").mkdir(parents=True)  # as a killed run leaves it
    assert len(tree(root)) == 2 and len(check_all([entry], root)) == 4
    monkeypatch.setattr(fetch, "run_git", run_git)
    assert fetch_all([entry], root, url) == []
    assert tree(root) == FILES and os.listdir(root) == ["name"]


def test_what_cannot_be_had_is_named_and_the_rest_is_fetched(
    public: tuple[str, dict], tmp_path: Path
) -> None:
    url, entry = public
    unknown = entry | {"folder": "unknown", "commit": "1" * 40}
    absent = entry | {"folder": "absent", "repository": "owner/absent"}
    wrong = entry | {"folder": "wrong", "files": {"poses.txt": "0" * 64, "gone.txt": "0" * 64}}
    faults = fetch_all([unknown, absent, wrong, entry], tmp_path / "real", url)
    assert len(faults) == 3
    assert re.search("owner/name at 1111111111: git fetch: .*1111111111", faults[0])
    assert re.search("owner/absent at .*git fetch: ", faults[1])
    assert re.search("poses.txt: corrupted .* in the commit; gone.txt: missing in the commit", faults[2])
    assert not (tmp_path / "real/wrong/poses.txt").exists() and tree(tmp_path / "real") == FILES


def test_a_repository_named_by_the_environment_is_left_alone(
    public: tuple[str, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, entry = public
    own, before = tmp_path / "work", git(tmp_path / "work", "rev-parse", "HEAD")
    monkeypatch.setenv("GIT_DIR", str(own / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(own))
    assert fetch_all([entry], tmp_path / "real", url) == [] and tree(tmp_path / "real") == FILES
    monkeypatch.undo()
    assert git(own, "rev-parse", "HEAD") == before and git(own, "status", "--porcelain") == ""


def test_two_runs_at_once_are_refused(public: tuple[str, dict], tmp_path: Path) -> None:
    url, entry = public
    root = tmp_path / "real"
    (root / fetch.FETCHING).mkdir(parents=True)
    with (root / fetch.FETCHING / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(FetchError, match="another run is fetching"):
            fetch_all([entry], root, url)


def test_command_checks_and_fetches(
    public: tuple[str, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    url, entry = public
    (tmp_path / "list.json").write_text(json.dumps({"repositories": [entry]}), encoding="utf-8")
    monkeypatch.setattr(get_real, "LIST", tmp_path / "list.json")
    monkeypatch.setenv("ROL_REAL_URL", url)
    root = ["--root", str(tmp_path / "real")]
    assert get_real.main([*root, "--check"]) == 1
    assert "name: missing (6 files)" in capsys.readouterr().err and not (tmp_path / "real").exists()
    assert get_real.main(root) == 0 and get_real.main([*root, "--check"]) == 0
    assert "terms: none; cite nobody" in capsys.readouterr().out


def test_list_is_whole() -> None:
    repositories, page = load_list(LIST), (LIST.parent / "README.md").read_text(encoding="utf-8")
    assert len({repository["folder"] for repository in repositories}) == len(repositories) == 8
    for repository in repositories:
        assert f"| {repository['repository']} |" in page
        assert re.fullmatch("[0-9a-f]{40}", repository["commit"]) and repository["files"]
        assert repository["folder"] == repository["repository"].partition("/")[2]
        for name, digest in repository["files"].items():
            assert re.fullmatch("[0-9a-f]{64}", digest) and not name.startswith(("/", ".."))


def test_real_data_at_hand_are_as_listed(real_root: Path) -> None:
    assert check_all(load_list(LIST), real_root) == []
