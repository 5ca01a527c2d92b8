"""Real scans and sweeps are found wherever they lie; what belongs nowhere is left out and named."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rol import oxford
from rol_data.oxford_pairs import RealPairs, find_pairs, firing_fractions, load_sweep_points, sweep_start
from rol_sim.session import oxford_files

START = 1_547_131_046_000_000
BOTH_ORDERS = pytest.mark.parametrize("order", ["laser after laser", "firing after firing"])


def make_sweep(start_deg: float = 90.0, order: str = "laser after laser", n: int = 1000) -> np.ndarray:
    """A turn of an HDL-32E in a round room of 10 m: x, y (left), z, intensity."""
    clockwise, elevation = np.deg2rad(start_deg + np.arange(n) * 360.0 / n), -oxford.ELEVATIONS_DOWN
    laser, firing = np.meshgrid(np.arange(32), np.arange(n), indexing="ij")
    if order == "firing after firing":
        laser, firing = laser.T, firing.T
    laser, firing = laser.ravel(), firing.ravel()
    height = oxford.FIRE_HEIGHT + 10.0 * np.tan(elevation[laser])
    flat = 10.0 * np.cos(clockwise[firing]), -10.0 * np.sin(clockwise[firing])
    return np.column_stack([*flat, height, np.full(len(laser), 9.0)]).astype(np.float32)


def make_scan(folder: Path, stamp_us: int) -> None:
    power = np.full((400, 3768), 20, dtype=np.uint8)
    stamps = stamp_us + np.arange(400) * 625
    counters = (13 + np.arange(400) * 14).astype(np.uint16)
    scan = oxford.RadarScan(stamps, counters, np.full(400, 255, dtype=np.uint8), power)
    oxford_files.save_radar(folder / f"{stamp_us}.png", scan)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Two scans in one repository, six sweeps of the left lidar in another, listed one folder higher."""
    for i in range(2):
        make_scan(tmp_path / "one/radar", START + i * 250_000)
    sweeps = [START + 10_000 + i * 50_000 for i in range(6)]
    for stamp in sweeps:
        oxford_files.save_velodyne_binary(tmp_path / f"two/data/binaries/{stamp}.bin", make_sweep())
    oxford_files.save_timestamps(tmp_path / "two/data/velodyne_left.timestamps", np.array(sweeps))
    return tmp_path


def stamps_of(pairs: RealPairs) -> list[int]:
    return [sweep.stamp_us - START for sweep in pairs.sweeps]


def test_scans_and_sweeps_of_different_folders_are_paired(tree: Path) -> None:
    pairs = find_pairs(tree)
    assert [scan.stamp_us - START for scan in pairs.scans] == [0, 250_000]
    assert {sweep.lidar for sweep in pairs.sweeps} == {"velodyne_left"} and pairs.faults == []
    assert [s.stamp_us - START for s in pairs.turn(pairs.scans[0])] == [
        10_000,
        60_000,
        110_000,
        160_000,
        210_000,
    ]
    assert [s.stamp_us - START for s in pairs.turn(pairs.scans[1])] == [260_000]
    assert [s.stamp_us - START for s in pairs.nearest(START + 125_000)] == [110_000]
    assert pairs.nearest(START + 400_000) == []
    # Without an odometry the velocity is unknown, and mid-scan is half a turn after the stamp.
    assert [(scan.twist, scan.mid_us - scan.stamp_us) for scan in pairs.scans] == 2 * [(None, 125_000)]


def test_only_the_given_places_are_searched(tree: Path) -> None:
    assert len(find_pairs(tree, ("one/radar/*.png",), ("two/**/*.bin",)).scans) == 2
    assert find_pairs(tree, ("two/**/*.png",)).scans == []


def test_folders_that_are_links_are_searched(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    root = tmp_path_factory.mktemp("links")
    (root / "scans").symlink_to(tree / "one")
    (root / "sweeps").symlink_to(tree / "two")
    assert len(find_pairs(root).scans) == 2


def test_a_session_with_two_lidars_is_found_in_its_own_layout(tree: Path) -> None:
    shutil.move(tree / "two/data/binaries", tree / "one/velodyne_left")
    (tree / "two/data/velodyne_left.timestamps").rename(tree / "one/velodyne_left.timestamps")
    shutil.copytree(
        tree / "one/velodyne_left", tree / "one/velodyne_right"
    )  # without a list: all files count
    pairs = find_pairs(tree)
    assert [sweep.lidar for sweep in pairs.nearest(START)] == ["velodyne_left", "velodyne_right"]
    assert len(pairs.turn(pairs.scans[0])) == 10 and pairs.faults == []


def test_file_that_is_not_listed_and_listed_sweep_without_file_are_left_out_and_named(tree: Path) -> None:
    folder = tree / "two/data/binaries"
    (folder / f"{START + 60_000}.bin").rename(folder / f"{START + 70_000}.bin")
    pairs = find_pairs(tree)
    assert stamps_of(pairs) == [10_000, 110_000, 160_000, 210_000, 260_000]
    unlisted, missing = pairs.faults
    assert unlisted.startswith(f"{folder}: 1 sweeps that are not in velodyne_left.timestamps")
    assert unlisted.endswith(f"{START + 70_000}.bin")
    assert missing.startswith(f"{folder.parent / 'velodyne_left.timestamps'}: 1 stamps without a file")
    assert missing.endswith(str(START + 60_000))


def test_sweep_flagged_0_is_left_out(tree: Path) -> None:
    path = tree / "two/data/velodyne_left.timestamps"
    listed = path.read_text(encoding="utf-8").replace(f"{START + 60_000} 1", f"{START + 60_000} 0")
    path.write_text(listed, encoding="utf-8")
    assert stamps_of(find_pairs(tree)) == [10_000, 110_000, 160_000, 210_000, 260_000]


def test_sweeps_that_no_list_assigns_to_a_lidar_are_named(tree: Path) -> None:
    (tree / "two/data/velodyne_left.timestamps").unlink()
    pairs = find_pairs(tree)
    assert pairs.scans == [] and pairs.sweeps == []
    assert "6 sweeps without a velodyne_*.timestamps that names them" in pairs.faults[0]


def test_sweeps_of_another_time_are_named(tree: Path) -> None:
    folder, later = tree / "two/data/binaries", 60_000_000
    stamps = sorted(int(path.stem) for path in folder.iterdir())
    for stamp in stamps:
        (folder / f"{stamp}.bin").rename(folder / f"{stamp + later}.bin")
    oxford_files.save_timestamps(tree / "two/data/velodyne_left.timestamps", np.array(stamps) + later)
    pairs = find_pairs(tree)
    assert pairs.scans == [] and len(pairs.sweeps) == 6
    [fault] = pairs.faults
    assert fault.startswith(f"{tree / 'one/radar'}: 2 scans without a sweep inside their turn")
    assert str(stamps[0] + later) in fault


def test_truncated_sweep_is_named(tree: Path) -> None:
    sweep = find_pairs(tree).sweeps[0]
    data = sweep.path.read_bytes()
    for n_bytes, fault in ((7, "truncated"), (16 * 900, "not four rows")):
        sweep.path.write_bytes(data[:-n_bytes])
        with pytest.raises(oxford.OxfordError, match=f"{sweep.path.name}.*{fault}"):
            load_sweep_points(sweep)


def test_odometry_beside_the_scans_gives_the_velocity(tree: Path) -> None:
    n = 4
    first = START + np.arange(-1, n) * 250_000
    moved = np.tile([2.0, 0.0, 0.0, 0.0, 0.0, 0.0], (n, 1))
    mid = first + 125_000
    odometry = oxford.RadarOdometry(mid[1:], mid[:-1], first[1:], first[:-1], moved)
    path = tree / "one/gt/radar_odometry.csv"
    oxford_files.save_radar_odometry(path, odometry)
    scan = find_pairs(tree).scans[1]
    assert scan.twist == pytest.approx((8.0, 0.0, 0.0)) and scan.odometry_path == path
    np.testing.assert_allclose(scan.pose, [4.0, 0.0, 0.0])
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(lines[:2] + lines[3:]), encoding="utf-8")  # a gap
    pairs = find_pairs(tree)
    assert pairs.scans[1].twist is None
    assert "gap before line 3" in pairs.faults[0] and str(path) in pairs.faults[0]


def test_other_images_with_long_numbers_are_no_scans(tree: Path) -> None:
    oxford_files._write_png(tree / f"one/{START + 1}.png", np.zeros((10, 20), dtype=np.uint8))
    (tree / f"one/{START + 2}.png").write_bytes(b"no image")
    assert len(find_pairs(tree).scans) == 2


def test_empty_and_missing_folders_have_no_pairs(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        assert find_pairs(folder) == RealPairs([], [], [])


@BOTH_ORDERS
def test_time_of_a_point_follows_its_bearing(order: str) -> None:
    points = make_sweep(start_deg=93.0, order=order)
    assert np.rad2deg(sweep_start(points)) % 360.0 == pytest.approx(93.0, abs=0.01)
    firing = np.tile(np.arange(1000), 32) if order == "laser after laser" else np.repeat(np.arange(1000), 32)
    fractions = firing_fractions(points)
    off = np.abs(fractions - firing / 1000.0)
    assert np.minimum(off, 1.0 - off).max() < 1e-4


def test_missing_returns_do_not_move_the_start() -> None:
    points = make_sweep(start_deg=93.0)
    kept = np.ones(len(points), dtype=bool)
    kept[:40] = kept[5000:5030] = False  # the first returns of two lasers
    assert np.rad2deg(sweep_start(points[kept])) % 360.0 == pytest.approx(93.0, abs=0.01)


def test_real_scans_are_found_with_their_sweeps(real_root: Path) -> None:
    pairs = find_pairs(real_root)
    if not pairs.scans:
        pytest.skip("no raw scans with sweeps under the folder of the real data")
    stamps = {scan.stamp_us for scan in pairs.scans}
    assert 1547131046353776 in stamps and 1547120953445209 not in stamps
    assert any("1547131051073558.bin" in fault for fault in pairs.faults)
    assert any("1547120953445209" in fault for fault in pairs.faults)
    scan = pairs.scans[0]
    assert len(pairs.turn(scan)) == 5 and scan.twist[0] == pytest.approx(9.66, abs=0.01)
    points, seconds = load_sweep_points(pairs.turn(scan)[0])
    assert len(points) == len(seconds) > 20_000
    assert 0.0 <= seconds.min() < 0.001 and 0.049 < seconds.max() < 0.05
    # Laser after laser: the order in the file is not the order in time.
    assert (np.diff(seconds) < -0.04).sum() > 20
