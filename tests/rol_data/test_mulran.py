"""The reader of MulRan: its numbers, its frames, and what it says of files that are at fault."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rol.geometry import transform_points_3d
from rol_data import mulran
from rol_data.rall import RallError

START_NS = 1_567_410_201_563_630_080


def make_image(counts: np.ndarray | None = None, stamps: np.ndarray | None = None) -> np.ndarray:
    """One scan in MulRan's form with a target of power 200 in row 100, bin 1000."""
    image = np.zeros((mulran.N_AZIMUTHS, 11 + mulran.N_BINS), dtype=np.uint8)
    stamps = START_NS + np.arange(400) * 625_000 if stamps is None else stamps
    counts = 7 + 14 * np.arange(400) if counts is None else counts
    image[:, :8] = stamps.astype("<i8").view(np.uint8).reshape(400, 8)
    image[:, 8:10] = counts.astype("<u2").view(np.uint8).reshape(400, 2)
    image[:, 10] = 255
    image[100, 11 + 1000] = 200
    return image


def write_image(root: Path, image: np.ndarray, name: str = "000000.png") -> Path:
    path = root / mulran.SCANS_PATH / name
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)
    return path


def write_cloud(path: Path, points: np.ndarray, n_stated: int | None = None) -> None:
    """Write an ASCII .pcd; `n_stated` points in its header."""
    n = len(points) if n_stated is None else n_stated
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    header += f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA ascii\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points)
    path.write_text(header + rows, encoding="utf-8")


def test_a_scan_keeps_times_bearings_and_power(tmp_path: Path) -> None:
    scan = mulran.load_scan(write_image(tmp_path, make_image()))
    assert scan.power.shape == (400, 3360) and scan.power[100, 1000] == 200 and scan.power.sum() == 200
    assert scan.row_stamps_ns[0] == START_NS and scan.row_stamps_ns[-1] == START_NS + 399 * 625_000
    assert scan.azimuths[0] == pytest.approx(-2 * np.pi * 7 / 5600)  # clockwise from straight ahead
    np.testing.assert_allclose(np.diff(scan.azimuths), -2 * np.pi / 400)


def test_scans_are_in_the_order_of_time(tmp_path: Path) -> None:
    write_image(tmp_path, make_image(stamps=START_NS + 10**9 + np.arange(400)), "000000.png")
    write_image(tmp_path, make_image(), "000001.png")
    assert [scan.path.stem for scan in mulran.load_scans(tmp_path)] == ["000001", "000000"]
    assert mulran.load_scans(tmp_path / "nowhere") == []


def header_of_noise() -> np.ndarray:
    """A scan whose first 11 columns are power."""
    return np.random.default_rng(0).integers(0, 90, (400, 3371)).astype(np.uint8)


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (None, "000000.png: missing"),
        (make_image()[:, 11:], "got uint8 .400, 3360.; the 11 columns of the header are missing"),
        (make_image()[:399], r"expected a grey image of .400, 3371., got uint8 .399, 3371."),
        (make_image().astype(np.uint16), "got uint16"),
        (header_of_noise(), "000000.png: no header: the row times"),
        (make_image(stamps=np.zeros(400)), "no header: the row times 0 .. 0 ns"),
        (make_image(stamps=START_NS + np.arange(400) * 2_000_000), "are not those of one turn"),
        (make_image(counts=np.zeros(400)), "the encoder counts do not go clockwise once around"),
        (make_image(counts=5599 - 14 * np.arange(400)), "the encoder counts do not go clockwise"),
        (make_image() * np.repeat([1, 0], [11, 3360]).astype(np.uint8), "000000.png: holds no power"),
    ],
)
def test_a_scan_at_fault_is_named(tmp_path: Path, image: np.ndarray | None, fault: str) -> None:
    path = tmp_path / mulran.SCANS_PATH / "000000.png"
    if image is not None:
        write_image(tmp_path, image)
    with pytest.raises(mulran.MulranError, match=fault):
        mulran.load_scan(path)


def test_a_truncated_scan_is_named(tmp_path: Path) -> None:
    path = write_image(tmp_path, make_image())
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(mulran.MulranError, match="000000.png: missing or not an image"):
        mulran.load_scan(path)


def test_keyframes_have_the_times_of_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / mulran.KEYFRAMES_PATH
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    write_cloud(folder / "Scans" / "000002.pcd", points)
    (folder / "times.txt").write_text("1.5\n2.5\n3.5\n", encoding="utf-8")
    seconds, paths = mulran.load_keyframes(tmp_path)
    assert seconds.tolist() == [3.5]
    np.testing.assert_allclose(mulran.load_cloud(paths[0]), points)


@pytest.mark.parametrize(
    ("times", "cloud", "fault"),
    [
        (None, "000000.pcd", "times.txt: missing"),
        ("one\n", "000000.pcd", "times.txt: not a list of times"),
        ("1.5\n", "000001.pcd", "000001.pcd: has no time in"),
        ("1.5\n", "first.pcd", "first.pcd: has no time in"),
        ("1.5\n", None, "Scans: holds no cloud"),
    ],
)
def test_keyframes_at_fault_are_named(
    tmp_path: Path, times: str | None, cloud: str | None, fault: str
) -> None:
    folder = tmp_path / mulran.KEYFRAMES_PATH
    folder.mkdir(parents=True)
    if times is not None:
        (folder / "times.txt").write_text(times, encoding="utf-8")
    if cloud is not None:
        write_cloud(folder / "Scans" / cloud, np.ones((1, 3)))
    with pytest.raises(mulran.MulranError, match=fault):
        mulran.load_keyframes(tmp_path)


def test_a_cloud_at_fault_is_named(tmp_path: Path) -> None:
    path = tmp_path / "000000.pcd"
    with pytest.raises(mulran.MulranError, match="000000.pcd: missing"):
        mulran.load_cloud(path)
    path.write_bytes(b"no cloud")
    with pytest.raises(mulran.MulranError, match="000000.pcd: truncated"):
        mulran.load_cloud(path)
    write_cloud(path, np.ones((2, 3)), n_stated=1000)
    with pytest.raises(mulran.MulranError, match="000000.pcd: truncated"):
        mulran.load_cloud(path)


def test_the_lidar_faces_backward_ahead_of_the_radar() -> None:
    ahead_of_lidar, at_lidar = transform_points_3d(
        mulran.radar_from_lidar(), np.array([[-10.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    )
    np.testing.assert_allclose(at_lidar, [0.2042, 0.019, -0.1653], atol=0.005)
    assert ahead_of_lidar[0] == pytest.approx(10.2, abs=0.02)


def test_the_map_has_kaists_corner(tmp_path: Path) -> None:
    path = tmp_path / mulran.KAIST_MAP_PATH
    path.parent.mkdir(parents=True)
    image = np.zeros((4000, 4000), dtype=np.uint8)
    image[0, 0] = image[2000, 799] = 255
    cv2.imwrite(str(path), image)
    np.testing.assert_allclose(mulran.load_kaist_map(tmp_path), [[499.875, 199.875], [-0.125, 0.125]])
    cv2.imwrite(str(path), image[:100])
    with pytest.raises(RallError, match="laser_map_kaist.png: .100, 4000. pixels instead of"):
        mulran.load_kaist_map(tmp_path)


def test_the_real_scans_and_keyframes(real_root: Path) -> None:
    scans = mulran.load_scans(real_root)
    if not scans:
        pytest.skip("no MulRan scans under ROL_REAL_ROOT: run `make real`")
    assert len(scans) == 2 and all(100 < scan.power.max() < 140 for scan in scans)
    seconds, paths = mulran.load_keyframes(real_root)
    first, last = (scans[0].row_stamps_ns[i] / 1e9 for i in (0, -1))
    assert len(paths) == 21 and first < seconds[0] < last
    heights = transform_points_3d(mulran.radar_from_lidar(), mulran.load_cloud(paths[0]))[:, 2]
    assert -2.3 < np.percentile(heights, 10) < -1.5  # the ground
    assert len(mulran.load_kaist_map(real_root)) > 100_000
