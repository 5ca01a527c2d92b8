"""Comparison of real pairs: time of a sweep, calibration, ground and kinds of points, on data made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol.lidar import relate_sensors
from rol.oxford import EXTRINSICS, FIRE_HEIGHT, RadarOdometry, RadarScan
from rol.radar import MEASURED, ScanMotion, peaks_to_points
from rol_data.oxford_pairs import PairedScan, Sweep, find_pairs
from rol_sim.session.oxford_files import save_radar_odometry, save_velodyne_binary
from rol_study.real_pairs import (
    COLUMNS,
    Calibration,
    Pair,
    RadarAgreement,
    chance_level,
    compare_points,
    describe_points,
    distance_from_path,
    fit_ground,
    fit_ranges,
    fit_span,
    load_path,
    load_scan_pairs,
    locate_stamp,
    measure_stamps,
    measure_walls,
    sweep_consistency,
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


@pytest.mark.parametrize(("place", "weights"), [(0.0, (1, 0)), (0.5, (0.5, 0.5)), (1.0, (0, 1))])
def test_place_of_a_stamp_follows_from_sweeps_of_different_length(place: float, weights: tuple) -> None:
    rng = np.random.default_rng(1)
    turned = 360.0 + rng.choice([-1.0, 3.0], 200)
    durations = turned / 360.0 * 50.0
    intervals = weights[0] * durations + weights[1] * np.roll(durations, -1) + rng.normal(0.0, 0.05, 200)
    intervals[50] += 20.0  # a sweep was lost
    found, error, n = locate_stamp(intervals, turned)
    assert found == pytest.approx(place, abs=4.0 * error) and error < 0.03 and n == 197


def test_calibration_that_made_a_scan_is_found() -> None:
    rng = np.random.default_rng(2)
    rows, bins = rng.integers(0, 400, 900), rng.integers(200, 1100, 900)
    radar = make_radar(rows, bins)
    motion = ScanMotion(TWIST)
    points = peaks_to_points(rows, bins, radar.azimuths, calibration=MEASURED, motion=motion)
    shifted = transform_points((0.3, -0.2, np.deg2rad(0.6)), points)  # where the lidar has them
    names = ["rotation_deg", "forward_m", "left_m"]
    best, errors = RadarAgreement([make_pair(lift(shifted), radar)]).fit(names)
    assert best.rotation_deg == pytest.approx(-0.6, abs=0.1) and set(errors) == set(names)
    assert best.forward_m == pytest.approx(-0.3, abs=0.08) and best.left_m == pytest.approx(0.2, abs=0.08)
    agreement = RadarAgreement([make_pair(lift(points), radar)])
    best, _ = agreement.fit(["delay_s", "doppler_s"], Calibration(doppler_s=0.06))
    assert best.delay_s == pytest.approx(0.0, abs=0.006) and best.doppler_s == pytest.approx(0.049, abs=0.006)
    best, _ = agreement.fit(["resolution_m", "offset_m"], Calibration(resolution_m=0.0436, offset_m=-0.2))
    assert best.resolution_m == pytest.approx(0.0438, abs=1e-4)
    assert best.offset_m == pytest.approx(-0.31, abs=0.05)
    assert agreement.scores(Calibration()) > agreement.scores(replace(Calibration(), left_m=0.6))


def test_ranges_are_fitted_to_walls() -> None:
    pairs = []
    for first in (6.0, 7.0, 8.0):
        bins = np.rint((np.linspace(first, 40.0, 400) + 0.4) / 0.0436 - 0.5).astype(int)
        radar = make_radar(np.repeat(np.arange(400), 9), (bins[:, None] + np.arange(-4, 5)).ravel())
        ranges, azimuths = (bins + 0.5) * 0.0436 - 0.4, radar.azimuths
        wall = ranges[:, None] * np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        cloud = np.vstack([lift(wall, z) for z in np.arange(-0.9, 2.0, 0.3)])
        pairs.append(make_pair(cloud, radar, (0.0, 0.0, 0.0)))
    walls = measure_walls(pairs, Calibration())
    values, errors = fit_ranges(walls)
    assert len(walls) > 1000 and values == pytest.approx([0.0436, -0.4], abs=2e-3)
    assert (errors < 2e-3).all()
    low = [replace(pair, cloud=pair.cloud[pair.cloud[:, 2] < 0.0]) for pair in pairs]  # a kerb is no wall
    assert len(measure_walls(low, Calibration())) == 0
    assert np.isnan(fit_ranges(walls[:0])).all()


def test_duration_of_a_sweep_that_made_the_sweeps_is_found(tmp_path: Path) -> None:
    """Poles seen from a vehicle at 10 m/s by a lidar that turns once in 50 ms."""
    rng = np.random.default_rng(4)
    poles = np.column_stack([rng.uniform(-25.0, 45.0, 900), rng.uniform(-25.0, 25.0, 900)])
    lidar = np.linalg.inv(relate_sensors(EXTRINSICS["radar"], EXTRINSICS["velodyne_left"]))
    start = 1_547_131_046_000_000
    stamps = start + 50_000 * np.arange(16)
    sweeps = []
    for stamp in stamps:
        seconds = np.zeros(len(poles))
        for _ in range(6):
            x = poles[:, 0] - 10.0 * ((stamp - start) / 1e6 + seconds)
            seen = np.column_stack([x, poles[:, 1], np.zeros(len(poles)), np.ones(len(poles))]) @ lidar.T
            clockwise = -np.arctan2(seen[:, 1], seen[:, 0])
            seconds = 0.05 * np.mod(clockwise - np.pi / 2.0, 2.0 * np.pi) / (2.0 * np.pi)
        order = np.argsort(seconds)
        level = np.hypot(seen[:, 0], seen[:, 1])[order]
        lasers = [
            np.column_stack([seen[order, :2], FIRE_HEIGHT + level * np.tan(up), np.ones(len(order))])
            for up in (0.0, 0.0232, 0.0466)
        ]
        path = tmp_path / f"{stamp}.bin"
        save_velodyne_binary(path, np.vstack(lasers).astype(np.float32))
        sweeps.append(Sweep(path, "velodyne_left", int(stamp)))
    first = start + np.arange(-2, 6) * 250_000
    moved = np.tile([2.5, 0.0, 0.0, 0.0, 0.0, 0.0], (7, 1))
    mid = first + 125_000
    odometry = RadarOdometry(mid[1:], mid[:-1], first[1:], first[:-1], moved)
    save_radar_odometry(tmp_path / "radar_odometry.csv", odometry)
    spans = np.arange(-0.05, 0.151, 0.025)
    apart = sweep_consistency(sweeps, tmp_path / "radar_odometry.csv", spans, lag=10, n_pairs=4)
    span, error = fit_span(spans, apart, np.random.default_rng(5))
    assert span == pytest.approx(0.05, abs=0.01) and error < 0.02
    assert spans[apart.mean(axis=0).argmin()] == pytest.approx(0.05)
    none = sweep_consistency(sweeps[:5], tmp_path / "radar_odometry.csv", spans)
    assert none.shape == (0, len(spans)) and np.isnan(fit_span(spans, none, np.random.default_rng(5))).all()


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
    assert row["points"].tolist() == [25.0, 50.0, 25.0] and row["within 1 m"].tolist() == [0.0, 100.0, 0.0]
    assert row["over 2 m off"].tolist() == [50.0, 25.0]  # one of two is hidden behind the wall
    reached = row["lidar points reached"]
    assert 0.0 < reached["higher"] < reached["below 1 m"] < 100.0


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
    assert chance_level(lidar, lidar) == {"precision_1m": 0.0, "precision_2m": 0.0}
    ring = np.column_stack([np.cos(np.linspace(0, 6.28, 500)), np.sin(np.linspace(0, 6.28, 500))])
    assert chance_level(ring, ring) == {"precision_1m": 1.0, "precision_2m": 1.0}


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
