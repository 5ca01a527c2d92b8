"""Calibration of real radar scans against sweeps: times, rotation and ranges, on data made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_real_pairs import TWIST, lift, make_pair, make_radar

from rol.geometry import transform_points
from rol.lidar import relate_sensors
from rol.oxford import EXTRINSICS, FIRE_HEIGHT, RadarOdometry
from rol.radar import MEASURED, RangeCalibration, ScanMotion, peaks_to_points
from rol_data.oxford_pairs import Sweep
from rol_sim.session.oxford_files import save_radar_odometry, save_velodyne_binary
from rol_study.real_calibration import (
    Calibration,
    RadarAgreement,
    calibrate,
    describe_calibration,
    evaluate_ranges,
    fit_ranges,
    fit_span,
    locate_stamp,
    measure_times,
    measure_walls,
    sweep_consistency,
)


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
    times = measure_times(sweeps, tmp_path / "radar_odometry.csv", spans, np.random.default_rng(5))
    assert times.apart_m.shape == (0, len(spans)) and np.isnan(
        times.numbers["place"]
    )  # 16 sweeps are too few
    none = sweep_consistency(sweeps[:5], tmp_path / "radar_odometry.csv", spans)
    assert none.shape == (0, len(spans)) and np.isnan(fit_span(spans, none, np.random.default_rng(5))).all()


def test_error_of_a_calibration_is_given_by_range() -> None:
    walls = pd.DataFrame({"range_m": [5.0, 6.0, 45.0], "bin": [123.5, 148.5, 1123.5]})
    table = evaluate_ranges(walls, {"ours": RangeCalibration(0.04, 0.0)})
    assert table.range_m.tolist() == [5.5, 45.0]
    assert table.ours.tolist() == pytest.approx([-0.04, -0.04])


def test_without_pairs_there_is_no_calibration() -> None:
    table, walls = calibrate([])
    assert table.value.isna().all() and len(walls) == 0
    numbers = describe_calibration(table, walls)
    assert numbers["n_walls"] == 0 and {"rotation_deg", "rotation_deg_error", "delay_ms"} <= set(numbers)
    assert not any("," in name for name in numbers)
    assert np.isnan(measure_times([], None, [0.0, 0.05, 0.1], np.random.default_rng(0)).numbers["span_ms"])
