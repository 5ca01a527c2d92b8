"""Comparison of real pairs: alignment, ground and kinds of points, on data made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol.oxford import OxfordError, RadarScan
from rol_data.oxford_pairs import PairedScan, RealPairs, find_pairs
from rol_sim.session.oxford_files import save_radar, save_timestamps, save_velodyne_binary
from rol_study import real_pairs
from rol_study.real_calibration import locate_stamp, measure_stamps
from rol_study.real_pairs import (
    COLUMNS,
    Pair,
    chance_level,
    compare_points,
    describe_points,
    distance_from_path,
    fit_ground,
    load_path,
    load_scan_pairs,
    tabulate,
    tabulate_corrected,
    tabulate_kinds,
    tabulate_on_map,
)

TWIST = (8.0, 0.0, 0.0)


def make_radar(rows: np.ndarray, bins: np.ndarray) -> RadarScan:
    """A scan with echoes of a bin's width at some rows and bins."""
    power = np.full((400, 3768), 10, dtype=np.uint8)
    power[rows, bins] = 200
    stamps = np.arange(1, 401, dtype=np.int64) * 625
    return RadarScan(stamps, (13 + 14 * np.arange(400)).astype(np.uint16), np.full(400, 255, np.uint8), power)


def make_pair(cloud: np.ndarray, radar: RadarScan | None = None, twist: tuple = TWIST) -> Pair:
    scan = PairedScan(Path("1.png"), 1, 125_001, twist, np.zeros(3), None)
    none = np.zeros(0, dtype=int)
    return Pair(scan, radar or make_radar(none, none), "compensated", "turn", cloud)


def lift(points: np.ndarray, z: float = 0.0) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), z), np.zeros(len(points))])


def test_plane_of_the_street_is_fitted_below_cars_and_walls() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(-25.0, 25.0, (4000, 2))
    street = np.column_stack([xy, -2.1 + 0.02 * xy[:, 0] - 0.01 * xy[:, 1] + rng.normal(0, 0.02, 4000)])
    objects = np.column_stack([xy[:1500], rng.uniform(-1.9, 3.0, 1500)])
    assert fit_ground(np.vstack([street, objects])) == pytest.approx((-2.1, 0.02, -0.01), abs=0.01)
    assert np.isnan(fit_ground(objects[:20])).all()


def test_points_are_described_by_what_the_lidar_has_around_them() -> None:
    street = np.stack(np.meshgrid(np.arange(-20, 20, 0.4), np.arange(-5, 5, 0.4)), axis=-1).reshape(-1, 2)
    wall = np.column_stack([np.arange(-20.0, 20.0, 0.2), np.full(200, 8.1)])
    hedge = np.column_stack([np.arange(5.0, 9.0, 0.2), np.full(20, -6.1)])
    cloud = np.vstack([lift(street, -2.0), lift(wall, 3.0), lift(wall, -1.0), lift(hedge, -1.2)])
    pair = make_pair(cloud)
    tops = pair.tops
    is_wall = pair.lidar_points[:, 1] > 0
    assert np.allclose(tops[is_wall], 5.0, atol=0.1) and np.allclose(tops[~is_wall], 0.8, atol=0.1)
    points = np.array([[0.0, 8.0], [7.0, -6.0], [1.0, 16.0], [10.0, 0.0]])
    pair = replace(
        pair, cloud=np.vstack([cloud, [[2.0, 0.0, -0.5, 0.0]]])
    )  # the vehicle's own bonnet hides nothing
    table = describe_points(points, pair)
    assert table.top_m.tolist() == pytest.approx([5.0, 0.8, 5.0, 0.8], abs=0.1)
    assert table.from_path_m.tolist() == pytest.approx([8.0, 6.0, 16.0, 0.0], abs=0.01)
    assert table.is_hidden.tolist() == [False, False, True, False]
    assert (table.distance_m < 1.0).tolist() == [True, True, False, False]
    kinds = tabulate_kinds([pair, pair], [{"some": points}, {"some": points, "none": points[:0]}])
    row = kinds.loc["some"]
    assert row[real_pairs.POINTS].tolist() == [25.0, 50.0, 25.0]
    assert row["within 1 m, by m from path"].tolist() == [0.0, 100.0, 0.0]
    # One of two is hidden behind the wall, the other one is on the road.
    assert row["over 2 m off"].tolist() == [50.0, 25.0, 25.0]
    reached = row["lidar points reached, by height [m]"]
    assert 0.0 < reached["over 2.5"] < reached["0‑1"] < 100.0
    numbers = real_pairs.describe_kinds(kinds, "some")
    assert numbers["hidden"] == 25.0 and numbers["road_of_wrong"] == 50.0


def test_correction_of_the_calibration_brings_points_to_the_wall() -> None:
    turn = np.deg2rad(np.arange(0.0, 360.0, 0.5))
    ranges = 20.0 + 5.0 * np.sin(8.0 * turn)
    lidar, radar = (
        r[:, None] * np.column_stack([np.cos(turn + by), np.sin(turn + by)])
        for r, by in ((ranges, 0.0), (ranges + 0.5, np.deg2rad(2.0)))
    )
    table = tabulate_corrected([make_pair(lift(lidar))], [{"some": radar}], 2.0, 0.5)
    assert (table.loc["some", "corrected"] == 100.0).all()
    assert table.loc["some", ("as is", "0.25 m")] < 50.0


def test_points_are_compared_with_a_map_where_the_pose_is_known() -> None:
    wall = np.column_stack([np.arange(-20.0, 20.0, 0.25), np.full(160, 8.125)])
    pair = make_pair(lift(wall, 1.0))
    pairs, points = [{("compensated", "turn"): pair}], [{"some": np.array([[0.0, 8.0], [0.0, 3.0]])}]
    tree = cKDTree(transform_points((100.0, 50.0, 0.5), wall))
    table = tabulate_on_map(pairs, points, {1: np.array([100.0, 50.0, 0.5])}, tree)
    assert table.share_1m.to_dict() == {"lidar, turn": 1.0, "some": 0.5}
    assert len(tabulate_on_map(pairs, points, {2: np.zeros(3)}, tree)) == 0


def test_distance_is_taken_from_a_curved_path_and_its_straight_continuation() -> None:
    scan = PairedScan(Path("1.png"), 1, 2, TWIST, np.array([5.0, 0.0, 0.0]), None)
    bend = np.array([[0.0, -4.0, 0.0], [5.0, 0.0, 0.0], [10.0, 4.0, np.pi / 2.0]])
    distances = distance_from_path(np.array([[5.0, 4.0], [5.0, 40.0], [-5.0, -4.0]]), scan, bend)
    assert distances == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


def test_scores_and_chance_of_points_at_known_places() -> None:
    lidar = np.array([[10.0, 0.0], [10.0, 1.0]])
    scores = compare_points(np.array([[10.5, 0.0], [11.5, 0.0], [30.0, 0.0]]), lidar)
    assert scores == pytest.approx(
        {
            "n_points": 3,
            "n_lidar_points": 2,
            "precision_1m": 1 / 3,
            "precision_2m": 2 / 3,
            "recall_1m": 0.5,
            "recall_2m": 1.0,
        }
    )
    assert chance_level(lidar, lidar) == 0.0
    ring = np.column_stack([np.cos(np.linspace(0, 6.28, 500)), np.sin(np.linspace(0, 6.28, 500))])
    assert chance_level(ring, ring) == 1.0


def test_real_pairs_agree_and_a_stamp_is_the_beginning_of_its_sweep(real_root: Path) -> None:
    found = find_pairs(real_root)
    if not found.scans:
        pytest.skip("no raw scans with sweeps under the folder of the real data")
    plain = [sweep for sweep in found.sweeps if sweep.path.suffix == ".bin"][:60]
    place, error, _ = locate_stamp(*measure_stamps(plain))
    assert abs(place) < 0.2 and error < 0.1
    scan = found.scans[0]
    pairs = load_scan_pairs(found, scan)
    assert len(pairs) == 4 and load_path(scan).shape[1] == 3
    recorded, compensated = (pairs[motion, "nearest"].misalignment for motion in ("none", "compensated"))
    assert abs(compensated[0]) < 0.5 < abs(recorded[0])
    rows = tabulate(pairs["compensated", "turn"], {"same": pairs["compensated", "turn"].lidar_points})
    assert list(rows[0]) == COLUMNS and rows[0]["precision_1m"] == rows[0]["recall_1m"] == 1.0


def test_scans_are_counted_with_and_without_velocity() -> None:
    scans = [PairedScan(Path("1.png"), t, t, TWIST, None, None) for t in (1_000_000, 1_250_000)]
    numbers = real_pairs.describe_scans(RealPairs(scans, [], []))
    assert numbers == pytest.approx(
        {"n_scans": 2, "n_sweeps": 0, "seconds": 0.5, "distance": 2.0, "speed_min": 8.0, "speed_max": 8.0}
    )
    assert np.isnan(real_pairs.describe_scans(RealPairs([], [], []))["speed_max"])


def test_misalignment_is_averaged_over_the_nearest_sweeps() -> None:
    rows = [("none", "nearest", 8.0, -0.8, 0.0), ("none", "nearest", 4.0, -0.6, 0.0)]
    rows += [("none", "turn", 8.0, 9.0, 0.0), ("compensated", "nearest", 8.0, 0.1, 0.0)]
    table = pd.DataFrame(rows, columns=["motion", "sweeps", "speed_mps", "forward_m", "left_m"])
    numbers = real_pairs.describe_misalignment(table)
    assert numbers == pytest.approx({"lag_none": 0.7, "lag_compensated": 0.1})
    empty = real_pairs.tabulate_misalignment([])
    assert np.isnan(list(real_pairs.describe_misalignment(empty).values())).all()


def test_ground_is_measured_with_its_margin() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(-25.0, 25.0, (4000, 2))
    street = lift(xy, -2.0)
    street[:, 2] += 0.02 * xy[:, 0]
    wall = lift(np.column_stack([np.linspace(-20, 20, 1000), np.full(1000, 9.0)]), 1.0)
    ground = real_pairs.measure_ground([make_pair(np.vstack([street, wall]))], -1.5)
    assert ground.numbers["ground"] == pytest.approx(2.0, abs=0.01)
    assert ground.numbers["slope"] == pytest.approx(2.0, abs=0.1)
    assert ground.numbers["margin"] == pytest.approx(0.5, abs=0.01)
    assert ground.numbers["kept"] == pytest.approx(20.0, abs=0.5) and ground.kept[0] > ground.kept[-1]
    assert np.isnan(list(real_pairs.measure_ground([], -1.5).numbers.values())).all()


def test_front_ends_are_compared_in_every_way(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = np.column_stack([np.arange(-20.0, 20.0, 0.25), np.full(160, 8.125)])
    far = wall + (0.0, 1.5)
    ways = {
        (motion, sweeps): replace(make_pair(lift(wall, 1.0)), motion=motion, sweeps=sweeps)
        for motion in real_pairs.MOTIONS
        for sweeps in real_pairs.REFERENCES
    }
    clouds = {"none": far, "compensated": wall}
    monkeypatch.setattr(
        real_pairs, "front_end_points", lambda pair, networks, bf16: ({"some": clouds[pair.motion]}, {})
    )
    comparison = real_pairs.compare_front_ends([ways], {}, kept={1})
    assert len(comparison.rows) == 4 and 0.0 <= comparison.chance_1m <= 1.0 and len(comparison.points) == 2
    assert comparison.average(real_pairs.AS_IN_PAPER).precision_1m["some"] == 0.0
    assert comparison.average(real_pairs.BEST).loc["some", ["precision_1m", "recall_1m"]].tolist() == [
        100,
        100,
    ]
    numbers = real_pairs.describe_comparison(comparison, ["some", "other"])
    assert (numbers["some_1m"], numbers["some_2m"], numbers["gain_sweeps"]) == (0.0, 100.0, 0.0)
    assert numbers["gain_motion"] == 100.0 and np.isnan(numbers["other_1m"])
    assert numbers["some_points"] > 0 and numbers["lidar_points"] > 0
    empty = real_pairs.compare_front_ends([], {})
    assert len(empty.average(real_pairs.BEST)) == 0
    assert np.isnan(list(real_pairs.describe_comparison(empty, ["some"]).values())).all()


def test_the_ceiling_is_that_of_the_nearest_sweep() -> None:
    rows = {"lidar, nearest": [0.8, 0.9, np.nan], "cfar": [0.5, 0.6, 0.4], "unet": [0.7, 0.8, 0.65]}
    columns = ["share_1m", "share_2m", "sweep_1m"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    numbers = real_pairs.describe_ceiling(table)
    assert numbers == pytest.approx(
        {
            "ceiling_1m": 80.0,
            "gain_min": 5.0,
            "gain_max": 10.0,
            "paper_min": 45.0,
            "paper_max": 50.0,
        }
    )
    assert np.isnan(list(real_pairs.describe_ceiling(table[:0]).values())).all()


def test_tables_without_pairs_are_empty() -> None:
    assert np.isnan(list(real_pairs.describe_kinds(tabulate_kinds([], []), "unet").values())).all()
    corrected = tabulate_corrected([], [], 0.5, 0.1)
    assert np.isnan(list(real_pairs.describe_corrected(corrected, "unet").values())).all()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One scan with the two sweeps of its turn that a list names, and a sweep that it does not name."""
    start = 1_547_131_046_000_000
    none = np.zeros(0, dtype=int)
    scan = make_radar(none, none)
    save_radar(tmp_path / f"one/{start}.png", replace(scan, row_stamps_us=start + np.arange(400) * 625))
    cloud = lift(np.column_stack([np.linspace(-9, 9, 64), np.full(64, 8.0)]), 1.0).astype(np.float32)
    stamps = start + np.array([10_000, 60_000])
    for stamp in (*stamps, start + 70_000):
        save_velodyne_binary(tmp_path / f"two/binaries/{stamp}.bin", cloud)
    save_timestamps(tmp_path / "two/velodyne_left.timestamps", stamps)
    return tmp_path


def test_a_sweep_that_no_list_names_is_not_compared(folder: Path) -> None:
    found = find_pairs(folder)
    pairs = load_scan_pairs(found, found.scans[0])
    assert set(pairs) == {("none", "nearest"), ("none", "turn")}  # the velocity is unknown
    assert len(pairs["none", "turn"].cloud) == 2 * 64 and "are not in velodyne_left" in found.faults[0]


def test_a_truncated_file_is_named(folder: Path) -> None:
    found = find_pairs(folder)
    sweep = found.sweeps[1].path
    sweep.write_bytes(sweep.read_bytes()[:-7])
    with pytest.raises(OxfordError, match=f"{sweep.name}.*truncated"):
        load_scan_pairs(found, found.scans[0])
    scan = found.scans[0].path
    scan.write_bytes(scan.read_bytes()[:2000])
    with pytest.raises(OxfordError, match=scan.name):
        load_scan_pairs(found, found.scans[0])


def test_a_sweep_that_is_lost_while_it_is_read_is_named(folder: Path) -> None:
    found = find_pairs(folder)
    found.sweeps[0].path.unlink()
    with pytest.raises(OxfordError, match=found.sweeps[0].path.name):
        load_scan_pairs(found, found.scans[0])
