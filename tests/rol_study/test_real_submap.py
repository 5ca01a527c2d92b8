"""A submap of sweeps along an odometry: places, motion, what is left out, and sweeps that cannot be placed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rol.geometry import compose, exp, relative_pose, transform_points, transform_points_3d
from rol.lidar import relate_sensors
from rol.oxford import EXTRINSICS, ODOMETRY_COLUMNS, OxfordError
from rol_data.rall import SCANS_PATH
from rol_study import real_submap

FIRST_US, TWIST = 1_547_131_046_000_000, np.array([8.0, 0.0, 0.2])
T_LIDAR_RADAR = np.linalg.inv(relate_sensors(EXTRINSICS["radar"], EXTRINSICS["velodyne_left"]))
WALLS = [np.column_stack([np.linspace(-30.0, 60.0, 140), np.full(140, y)]) for y in (9.0, -9.0)]
WALLS += [np.column_stack([np.full(40, x), np.linspace(9.4, 29.4, 40)]) for x in (-12.0, 17.3, 41.1)]
PLACES = np.column_stack([np.vstack(WALLS), np.zeros(400)])


def write_odometry(root: Path, n: int = 9) -> None:
    """A constant twist, scans every 0.25 s; the first mid-scan time is FIRST_US."""
    path = root / SCANS_PATH / "gt" / "radar_odometry.csv"
    path.parent.mkdir(parents=True)
    x, y, yaw = exp(TWIST, 0.25)
    rows = [",".join(ODOMETRY_COLUMNS)]
    for i in range(n):
        mid = FIRST_US + 250_000 * i
        values = (mid + 250_000, mid, x, -y, 0, 0, 0, -yaw, mid + 125_000, mid - 125_000)
        rows.append(",".join(str(value) for value in values))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_sweep(path: Path, stamp_us: int) -> None:
    """A sweep of `PLACES`, and of the ground, by a radar that moves with TWIST, from the first place clockwise."""
    fractions = np.zeros(400)
    for _ in range(5):  # when a point is fired depends on its bearing, and the bearing on when
        poses = exp(TWIST, (stamp_us - FIRST_US) / 1e6 + 0.05 * fractions)
        local = np.stack(
            [relative_pose(p, np.array([x, y, 0.0])) for p, (x, y, _) in zip(poses, PLACES, strict=True)]
        )
        local[:, 2] = np.where(np.arange(400) % 4 == 0, -2.0, 0.5)  # each fourth point is on the ground
        points = transform_points_3d(T_LIDAR_RADAR, local)
        clockwise = -np.arctan2(points[:, 1], points[:, 0])
        fractions = np.mod(clockwise - clockwise[0], 2.0 * np.pi) / (2.0 * np.pi)
    points = points[np.argsort(fractions)] * (1, -1, -1)
    rows = np.vstack([points.T, np.full(400, 7.0)]).astype("<f4")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(rows.tobytes())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Twenty sweeps of the world within the odometry, and one file that is not listed."""
    write_odometry(tmp_path)
    folder = tmp_path / real_submap.SWEEPS_PATH
    stamps = FIRST_US + 200_000 + 50_000 * np.arange(20)
    for stamp in (*stamps, FIRST_US + 123):
        write_sweep(folder / "binaries" / f"{stamp}.bin", stamp)
    listing = "".join(f"{stamp} 1\n" for stamp in stamps)
    (folder / "velodyne_left.timestamps").write_text(listing, encoding="utf-8")
    return tmp_path


def distances_to_places(points: np.ndarray) -> np.ndarray:
    """Distances to the nearest place in the frame of the first sweep."""
    places = np.array([relative_pose(exp(TWIST, 0.2), np.array([x, y, 0.0]))[:2] for x, y, _ in PLACES])
    return np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1)


def test_sweeps_lie_where_they_were_recorded(root: Path) -> None:
    sweeps = real_submap.load_placed_sweeps(root)
    assert len(sweeps.clouds) == len(sweeps.poses) == 20  # the file that is not listed is not among them
    np.testing.assert_allclose(sweeps.poses, exp(TWIST, 0.05 * np.arange(20)), atol=1e-9)
    np.testing.assert_allclose(sweeps.scan_poses([FIRST_US + 125_000]), [exp(TWIST, 0.05)], atol=1e-9)
    submap = real_submap.build_submap(sweeps, min_hits=3)
    assert len(submap) > 150 and np.mean(distances_to_places(submap) < 0.001) > 0.9
    assert len(sweeps.clouds[3]) < 301  # the ground is removed


def test_sweeps_near_a_scan_are_left_out(root: Path) -> None:
    sweeps, middle = real_submap.load_placed_sweeps(root), FIRST_US + 200_000
    kept = real_submap.build_submap(sweeps, [middle], 0.9, min_hits=1)
    late = real_submap.build_submap(
        real_submap.PlacedSweeps(
            sweeps.stamps_us[18:],
            sweeps.clouds[18:],
            sweeps.poses[18:],
            sweeps.odometry_stamps_us,
            sweeps.odometry_poses,
        ),
        min_hits=1,
    )
    np.testing.assert_array_equal(kept, late)
    with pytest.raises(real_submap.SubmapError, match="all 20 sweeps are within 1.0 s of a scan"):
        real_submap.build_submap(sweeps, [middle])


def test_sweeps_outside_the_odometry_are_named(root: Path) -> None:
    listing = root / real_submap.SWEEPS_PATH / "velodyne_left.timestamps"
    listing.write_text(f"{FIRST_US + 60_000_000} 1\n", encoding="utf-8")
    with pytest.raises(
        real_submap.SubmapError, match=r"radar_odometry.csv: covers \d+ .. \d+ us, but the sweeps are"
    ):
        real_submap.load_placed_sweeps(root)


def test_a_scan_without_odometry_is_named(root: Path) -> None:
    with pytest.raises(real_submap.SubmapError, match="has no pose for scan 17"):
        real_submap.load_placed_sweeps(root).scan_poses([17])


def test_a_listed_sweep_at_fault_is_named(root: Path) -> None:
    path = sorted((root / real_submap.SWEEPS_PATH / "binaries").glob("*.bin"))[5]
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(OxfordError, match=f"{path.name}: .* truncated"):
        real_submap.load_placed_sweeps(root)
    path.unlink()
    with pytest.raises(OxfordError, match=f"{path.name}: file is missing"):
        real_submap.load_placed_sweeps(root)


def test_points_are_free_where_the_lidar_saw_past_them() -> None:
    wall = np.column_stack([np.full(200, 20.0), np.linspace(-10.0, 10.0, 200)])
    points = np.array([[10.0, 0.3], [20.2, 0.3], [25.0, 0.3], [-10.0, 0.3]])  # gone, there, hidden, no return
    counts = real_submap.count_sightings(points, [wall, wall], np.zeros((2, 3)))
    np.testing.assert_array_equal(counts, [[2, 0], [0, 2], [0, 0], [0, 0]])


def test_changes_near_the_path() -> None:
    wall = np.column_stack([np.full(200, 20.0), np.linspace(-10.0, 10.0, 200)])
    car, old_car, far = np.array([[15.0, 9.0]]), np.array([[10.0, 0.3]]), np.array([[200.0, 0.0]])
    sweeps, poses = [np.vstack([wall, car])] * 2, np.zeros((2, 3))
    changes = real_submap.find_changes(np.vstack([wall, car]), np.vstack([wall, old_car, far]), sweeps, poses)
    np.testing.assert_array_equal(changes.new, car)
    np.testing.assert_array_equal(changes.gone, old_car)
    assert len(changes.same) == 200 and len(changes.confirmed) + len(changes.hidden) == 200
    assert len(changes.hidden) < 12  # the wall behind the new car


def test_the_right_rotation_is_the_sharpest(root: Path) -> None:
    sweeps = real_submap.load_placed_sweeps(root)
    angles = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    counts = real_submap.measure_sharpness(sweeps, np.deg2rad(angles), every=3)
    assert counts.argmin() == 2 and counts.max() > 1.2 * counts.min()
    assert abs(real_submap.sharpest_angle(angles, counts)) < 0.3


def test_segments_registered_alone_show_an_error_of_the_odometry(root: Path) -> None:
    sweeps = real_submap.load_placed_sweeps(root)
    target, moved = real_submap.build_submap(sweeps, min_hits=1), sweeps.poses.copy()
    moved[10:, 1] -= 0.5  # the second half is placed half a metre to the right
    sweeps = replace(sweeps, poses=moved)
    table = real_submap.register_segments(sweeps, target, np.zeros(3), [0, 10, 20])
    assert table["first"].tolist() == [0, 10] and table["last"].tolist() == [9, 19]
    np.testing.assert_allclose(table.speed_mps, 8.0, atol=0.1)
    np.testing.assert_allclose(np.hypot(table.forward_m, table.left_m), [0.0, 0.5], atol=0.1)


def test_a_submap_is_registered_from_several_starts(root: Path) -> None:
    truth = np.array([30.0, -5.0, 0.4])
    sweeps = real_submap.load_placed_sweeps(root)
    target = transform_points(truth, real_submap.build_submap(sweeps, min_hits=3))
    stamps = sweeps.odometry_stamps_us[1:4].tolist()
    poses = compose(truth, sweeps.scan_poses(stamps))
    poses[:, 1] += 0.3
    offsets = np.array([[1.0, 0.5, 0.02], [-1.0, 0.5, -0.02]])
    found = real_submap.register_submap(root, stamps, poses, target, offsets, min_hits=3)
    np.testing.assert_allclose(found.T_map_submap, truth, atol=0.05)
    assert found.spread_m < 0.05 and found.residuals_m.max() < 0.3
    np.testing.assert_allclose(found.differences[:, 2], 0.3, atol=0.05)
    np.testing.assert_allclose(found.path[0], truth, atol=0.05)
    segments = pd.DataFrame({"forward_m": [-0.2, 0.1]})
    changes = real_submap.Changes(*(np.zeros((n, 2)) for n in (3, 1, 4, 1, 7)))
    numbers = real_submap.describe_submap(found, segments, changes, -0.3)
    assert numbers["submap_worst_m"] == found.differences[:, 2].max() and numbers["sharpest_deg"] == -0.3
    assert (numbers["segment_low_m"], numbers["segment_high_m"]) == (-0.2, 0.1)
    assert (numbers["changed_new"], numbers["changed_gone"]) == (25.0, 20.0)
    none = real_submap.describe_submap(None, None, None)
    assert set(none) == set(numbers) and np.isnan(list(none.values())).all()
