"""Files appear whole or not at all, text is UTF-8 with or without a byte order mark, foreign folders are left alone."""

import ast
import errno
import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import chapters
from rol import evaluation, files, maps, oxford, pairs
from rol.pairs import generated_folder, pair_folder
from rol_data import rall
from rol_sim.session import oxford_files
from rol_sim.session.settings import load_settings

ROOT = Path(__file__).resolve().parents[2]
BOM = b"\xef\xbb\xbf"
IMAGE = np.zeros((8, 8), dtype=np.uint8)
POINTS = np.ones((3, 2))
METRICS = {key: kind(1) for key, kind in evaluation.METRICS.items()}


def save_history(path: Path) -> None:
    torch = pytest.importorskip("torch")
    from rol.pix2pix import save_tensors

    save_tensors(path, {"w": torch.ones(2)}, {})


WRITERS = {
    "text.txt": lambda path: files.write_text(path, "text"),
    "lidar/7.png": lambda path: pairs.save_pair(path.parents[1], 7, IMAGE, IMAGE),
    "map.npz": lambda path: maps.save_map(path, POINTS, np.zeros(3)),
    "run.tum": lambda path: evaluation.write_tum(path, np.array([1, 2]), np.zeros((2, 3))),
    "metrics.json": lambda path: evaluation.write_metrics(path, METRICS),
    "radar.timestamps": lambda path: oxford_files.save_timestamps(path, np.array([1, 2])),
    "1.bin": lambda path: oxford_files.save_velodyne_binary(path, np.ones((3, 4))),
    "weights.safetensors": save_history,
    "settings.json": lambda path: generated_folder(path.parent).prepare({"weights": "a"}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_named_and_leaves_no_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_some(path: Path, data: bytes) -> None:
        with open(path, "wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_some)
    faulty = name.replace("lidar", "radar")  # the first of the two images of a pair
    with pytest.raises(OSError, match=f"the disk is full.*{faulty}'") as error:
        WRITERS[name](tmp_path / name)
    assert error.value.errno == errno.ENOSPC and error.value.filename == str(tmp_path / faulty)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_name_that_is_too_long_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot write this file") as error:
        files.write_text(tmp_path / f"{'x' * 250}.csv", "")
    assert error.value.errno == errno.ENAMETOOLONG


def test_a_file_that_is_there_survives_a_failed_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.write_text(tmp_path / "a.txt", "Käse")
    monkeypatch.setattr(files.os, "replace", lambda *paths: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        files.write_text(tmp_path / "a.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert files.read_text(tmp_path / "a.txt") == "Käse"


def test_a_file_in_place_of_the_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(OSError, match="out/a.txt'"):
        files.write_text(tmp_path / "out" / "a.txt", "text")


def test_other_encodings_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(BOM + "line\nKäse\n".encode())
    assert files.read_text(tmp_path / "a.txt") == "line\nKäse\n"
    (tmp_path / "b.txt").write_bytes("line\nKäse\n".encode("latin-1"))
    with pytest.raises(evaluation.EvaluationError, match=r"b.txt: line 2 is not UTF-8 text \(byte 0xe4\)"):
        evaluation.read_tum(tmp_path / "b.txt")
    with pytest.raises(ValueError, match=r"b.txt: line 2 is not UTF-8"):
        files.read_text(tmp_path / "b.txt")


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n", lambda path: evaluation.read_tum(path)[1].shape),
        ("1 1\n2 1\n", lambda path: oxford.load_timestamps(path)[0].tolist()),
        (
            ",".join(oxford.ODOMETRY_COLUMNS) + "\n375000,125000,1,0,0,0,0,0,250000,1\n",
            lambda path: oxford.load_radar_odometry(path).increments.tolist(),
        ),
        ("1 2 3\n", lambda path: rall.load_poses(path).tolist()),
        ("timestamp_us,x_m,y_m,yaw_rad\n1,0,0,0\n", lambda path: list(rall.load_scan_poses(path))),
        ("simulated: {sessions: {sim-a: {start: 2019-01-10T11:46:21, scans: 3}}}\n", load_settings),
        (json.dumps(METRICS), evaluation.read_metrics),
        ((ROOT / "config" / "demo.yaml").read_text(encoding="utf-8"), chapters.load_config),
    ],
)
def test_a_byte_order_mark_changes_nothing(text: str, read: Callable[[Path], object], tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(text.encode())
    (tmp_path / "b").write_bytes(BOM + text.encode())
    assert read(tmp_path / "a") == read(tmp_path / "b")


# ---- folders that are cleared ----


@pytest.mark.parametrize("kind", [pair_folder, generated_folder])
@pytest.mark.parametrize("marker", [None, "{}", "[]", '{"a": 1', '{"format": 4, "session": {}}'])
def test_folders_of_others_are_left_alone(
    kind: Callable[..., files.ImageFolder], marker: str | None, tmp_path: Path
) -> None:
    names = ("radar/1.png", "lidar/1.png", "2.png", "fake.json", "pairs.json")
    for name in names:
        files.write_text(tmp_path / name, "raw")
    if marker is not None:
        files.write_text(tmp_path / "settings.json", marker)
    with pytest.raises(ValueError, match=f"{tmp_path.name}: not empty.*nothing was removed. Choose another"):
        kind(tmp_path).prepare({"motion": "none"})
    assert all(files.read_text(tmp_path / name) == "raw" for name in names)


def test_each_kind_of_folder_is_cleared_by_its_own_function_only(tmp_path: Path) -> None:
    pair_folder(tmp_path).prepare({"motion": "none"})
    with pytest.raises(ValueError, match=r"not made for fake\.json"):
        generated_folder(tmp_path).prepare({})


def test_images_behind_a_symbolic_link_are_left_alone(tmp_path: Path) -> None:
    pair_folder(tmp_path / "pairs").prepare({"motion": "none"})
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "1.png").write_bytes(b"raw")
    (tmp_path / "pairs" / "radar").symlink_to(tmp_path / "raw")
    with pytest.raises(ValueError, match="radar: a symbolic link"):
        pair_folder(tmp_path / "pairs").prepare({"motion": "corrected"})
    assert (tmp_path / "raw" / "1.png").read_bytes() == b"raw"


def test_only_known_files_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".DS_Store").touch()
    assert pair_folder(tmp_path).prepare({"motion": "none"}) == set()
    pairs.save_pair(tmp_path, 7, IMAGE, IMAGE)
    for name in ("radar/notes.txt", "radar/plan.png", "thesis.txt", "radar/.8.png.17.tmp"):
        files.write_text(tmp_path / name, "mine")
    assert pair_folder(tmp_path).prepare({"motion": "none"}) == {7}
    assert not (tmp_path / "radar/.8.png.17.tmp").exists()  # of a run that was killed
    assert pair_folder(tmp_path).prepare({"motion": "corrected"}) == set()
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {".DS_Store", "settings.json", "thesis.txt", "radar/notes.txt", "radar/plan.png"}


# ---- the rest of the code ----


@functools.cache
def calls_of(file: Path) -> list[tuple[str, ast.Call]]:
    """List the calls of a file by the last part of the function's name; a notebook's cells make one file."""
    if file.suffix == ".ipynb":
        nbformat = pytest.importorskip("nbformat")
        cells = nbformat.read(file, as_version=4).cells
        text = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    else:
        text = files.read_text(file)
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return [(getattr(call.func, "attr", getattr(call.func, "id", "")), call) for call in found]


def test_only_one_file_of_the_package_writes() -> None:
    """What all others write goes through it, so that the two tests on full disks hold for every writer."""
    direct = {"write_text", "write_bytes", "imwrite", "save_file", "savetxt"}
    for file in sorted(
        [*(ROOT / "src" / "rol").rglob("[!.]*.py"), *(ROOT / "notebooks").glob("[!.]*.ipynb")]
    ):
        calls = [
            call for name, call in calls_of(file) if isinstance(call.func, ast.Attribute) and name in direct
        ]
        assert not calls or file.name == "files.py", f"{file.name}: {[ast.unparse(call) for call in calls]}"


def test_every_text_file_is_opened_with_an_encoding() -> None:
    folders = ("src", "workflow", "tests", "benchmarks", "notebooks")
    sources = [
        file for folder in folders for kind in ("[!.]*.py", "*.ipynb") for file in (ROOT / folder).rglob(kind)
    ]
    assert len(sources) > 100
    for file in sources:
        for name, call in calls_of(file):
            keywords, n_given = {word.arg for word in call.keywords}, len(call.args)
            if isinstance(call.func, ast.Attribute):
                is_bare = name == "read_text" and n_given == 0 or name == "write_text" and n_given < 2
                # `rol.files` takes UTF-8 by itself.
                is_bare = is_bare and ast.unparse(call.func.value) != "files"
            else:
                is_bare = name == "open" and not any("b" in ast.unparse(word) for word in call.args[1:2])
            if is_bare and "encoding" not in keywords:
                pytest.fail(f"{file.relative_to(ROOT)}: no encoding in {ast.unparse(call)}")
