"""Fetch listed files of public Git repositories at pinned commits, and compare their checksums.

Only the listed files are transferred (partial clone, sparse checkout, one commit deep). Each one is put in
its place after its checksum was compared, so a run after an interruption continues with the files that are
missing. Files that are not listed stay as they are.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

FETCHING = ".fetching"  # below the folder of the data: a clone while its repository is being fetched
GIT_PLACES = {"GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_COMMON_DIR"}
BATCH = 32  # files per transfer; an interruption loses one transfer at most


class FetchError(RuntimeError):
    """Raised for a repository or file that cannot be had as listed; names it and the fault."""


def load_list(path: Path) -> list[dict]:
    """Read the list of repositories: commit, terms, size [bytes], SHA-256 of every file."""
    return json.loads(path.read_text(encoding="utf-8"))["repositories"]


def find_faults(folder: Path, files: dict[str, str]) -> dict[str, str]:
    """Name the files of a repository that are missing or have another checksum, each with its fault."""
    faults = {}
    for name, digest in files.items():
        if not (folder / name).is_file():
            faults[name] = "missing"
        elif hashlib.sha256((folder / name).read_bytes()).hexdigest() != digest:
            faults[name] = "corrupted (another SHA-256 than listed)"
    return faults


def run_git(clone: Path, *arguments: str) -> None:
    """Run git in a clone, never in a repository around it or one that the environment names.

    Raises
    ------
    FetchError
        If git fails, with its last words.
    """
    command = ["git", f"--git-dir={clone}/.git", f"--work-tree={clone}", "-c", "http.lowSpeedLimit=1000"]
    environment = {name: value for name, value in os.environ.items() if name not in GIT_PLACES}
    environment |= {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}
    command += ["-c", "http.lowSpeedTime=60", *arguments]
    done = subprocess.run(command, check=False, env=environment, capture_output=True)
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").splitlines() or ["no message"]
        words = [line for line in lines if line.startswith(("fatal:", "error:"))]
        raise FetchError(f"git {arguments[0]}: {(words or lines)[0]}")


def make_clone(clone: Path, url: str, commit: str) -> None:
    """Clone one commit, without its files, in an empty folder."""
    run_git(clone, "init", "-q")
    run_git(clone, "config", "remote.origin.url", url)
    run_git(clone, "config", "core.sparseCheckout", "true")
    # No conversion of line ends, whatever the reader's settings are.
    (clone / ".git" / "info").mkdir(exist_ok=True)
    rule = "* -text -eol -filter -ident -working-tree-encoding\n"
    (clone / ".git" / "info" / "attributes").write_text(rule, encoding="utf-8")
    run_git(clone, "fetch", "-q", "--depth", "1", "--filter=blob:none", "origin", commit)


def fetch_files(clone: Path, commit: str, names: list[str], digests: dict[str, str], folder: Path) -> None:
    """Check files out of a clone, compare their checksums, and move them into the repository's folder.

    Raises
    ------
    FetchError
        If a file is not in the commit or has another checksum than listed; the others are in place by then.
    """
    patterns = "".join(f"/{name}\n" for name in names)
    (clone / ".git" / "info" / "sparse-checkout").write_text(patterns, encoding="utf-8")
    (clone / ".git" / "index").unlink(missing_ok=True)
    run_git(clone, "checkout", "-q", "-f", "--detach", commit)
    faults = find_faults(clone, {name: digests[name] for name in names})
    for name in names:
        if name not in faults:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(clone / name, folder / name)
    if faults:
        raise FetchError("; ".join(f"{name}: {fault} in the commit" for name, fault in faults.items()))


def fetch_repository(repository: dict, root: Path, url: str, report: Callable[[str], None]) -> None:
    """Fetch the files of a repository that are missing or corrupted.

    Raises
    ------
    FetchError
        If the commit or a file of it cannot be had; names the repository.
    """
    folder, files = root / repository["folder"], repository["files"]
    faults = find_faults(folder, files)
    for name, fault in faults.items():
        if fault != "missing":
            report(f"  {folder / name}: {fault}; is fetched again")
    report(f"  {len(files) - len(faults)} of {len(files)} files are there")
    if not faults:
        return
    names, url = list(faults), f"{url}/{repository['repository']}.git"
    with tempfile.TemporaryDirectory(dir=root / FETCHING, ignore_cleanup_errors=True) as place:
        clone = Path(place).resolve()
        try:
            make_clone(clone, url, repository["commit"])
            for first in range(0, len(names), BATCH):
                batch = names[first : first + BATCH]
                fetch_files(clone, repository["commit"], batch, files, folder)
                report(f"  {first + len(batch)} of {len(names)} files fetched")
        except FetchError as error:
            raise FetchError(f"{repository['repository']} at {repository['commit'][:10]}: {error}") from error


def fetch_all(
    repositories: list[dict], root: Path, url: str, report: Callable[[str], None] = print
) -> list[str]:
    """Fetch all repositories into a folder, one after the other; list what could not be had."""
    (root / FETCHING).mkdir(parents=True, exist_ok=True)
    faults = []
    with (root / FETCHING / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FetchError(f"{root}: another run is fetching into this folder") from error
        for left in (root / FETCHING).glob("*/"):
            shutil.rmtree(left, ignore_errors=True)  # clone of an interrupted run
        for repository in repositories:
            report(
                f"{repository['repository']}: {repository['content']} ({repository['bytes'] / 1e6:.1f} MB)"
            )
            report(f"  terms: {repository['terms']}; cite {repository['cite']}")
            try:
                fetch_repository(repository, root, url, report)
            except FetchError as error:
                faults.append(str(error))
        shutil.rmtree(root / FETCHING, ignore_errors=True)
    return faults


def check_all(repositories: list[dict], root: Path) -> list[str]:
    """List what is missing or has another checksum: files, or a repository of which no file is there."""
    faults = []
    for repository in repositories:
        folder = root / repository["folder"]
        found = find_faults(folder, repository["files"])
        if list(found.values()) == ["missing"] * len(repository["files"]):
            faults.append(f"{folder}: missing ({len(found)} files)")
        else:
            faults += [f"{folder / name}: {fault}" for name, fault in found.items()]
    return faults
