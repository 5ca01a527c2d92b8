"""Statistics of lidar sweeps: what was put into made sweeps is found in them, and faults are named."""

from pathlib import Path

import numpy as np
import pytest

from rol.oxford import LIDARS, OxfordError, VelodyneRaw, open_session, velodyne_raw_to_points
from rol_sim.sensors.lidar import CLEAR_LASERS, Sweep, hide_behind_car, schedule_firings
from rol_sim.session import oxford_files
from rol_study import lidar_statistics as statistics

STAMP = 1_547_131_046_260_961


def box_sweep(
    rng: np.random.Generator, noise_m: float = 0.0, lost: float = 0.0, past_seam: float = 0.03
) -> Sweep:
    """A sweep inside a box of 20 m x 20 m with its floor 1.7 m below the lidar and no lid."""
    stamps, angles = schedule_firings(STAMP, rng, past_seam=past_seam)
    a, e = np.deg2rad(0.01 * angles), statistics.ELEVATIONS_DOWN[:, None]
    walls = 10.0 / np.maximum(np.abs(np.sin(a)), np.abs(np.cos(a))) / np.cos(e)
    floor = np.where(e > 0.0, (1.7 + statistics.FIRE_HEIGHT) / np.sin(np.maximum(e, 1e-9)), np.inf)
    ranges = np.minimum(walls, floor) + noise_m * rng.standard_normal(walls.shape)
    ranges[rng.random(ranges.shape) < lost] = 0.0
    counts = np.rint(ranges / 0.002).astype(np.uint16)
    return Sweep(np.full(counts.shape, 30, np.uint8), counts, angles, stamps, np.ones(counts.shape, np.uint8))


def points_of(sweep: Sweep) -> np.ndarray:
    return velodyne_raw_to_points(
        VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us)
    )[0]


def test_beams_are_recovered_from_points() -> None:
    sweep = box_sweep(np.random.default_rng(0))
    lasers, angles, ranges = statistics.recover_beams(points_of(sweep))
    firings, true = np.nonzero(sweep.ranges.T)
    np.testing.assert_array_equal(lasers, true)
    np.testing.assert_allclose(angles, 0.01 * sweep.angles[firings], atol=1e-3)
    np.testing.assert_allclose(ranges, 0.002 * sweep.ranges.T[firings, true], atol=1e-4)
    assert statistics.angle_step(angles) == pytest.approx(0.3318, abs=5e-4)
    assert statistics.first_angle(lasers, angles) == pytest.approx(180.0 + np.rad2deg(0.03), abs=0.01)
    with pytest.raises(ValueError, match="not in the frame of an HDL-32E"):
        statistics.recover_beams(points_of(sweep) + [0.0, 0.0, 0.3, 0.0])


@pytest.mark.parametrize("noise_m", [0.004, 0.02])
def test_noise_is_measured_along_scan_lines_and_on_planes(noise_m: float) -> None:
    rng = np.random.default_rng(1)
    points = points_of(box_sweep(rng, noise_m))
    assert statistics.range_noise(points) == pytest.approx(noise_m, rel=0.12)
    planes = statistics.plane_noise(points, rng, count=300)
    assert planes["ground"] == pytest.approx(noise_m, rel=0.25) and planes["walls"] == pytest.approx(
        noise_m, rel=0.25
    )


def test_losses_and_the_view_past_the_car() -> None:
    rng = np.random.default_rng(2)
    sweeps = [box_sweep(rng, 0.005, 0.1, past_seam=past) for past in (0.0, 0.02, 0.04, 0.06)]
    free = statistics.sweep_statistics([points_of(sweep) for sweep in sweeps], rng, n_noise=2)
    assert free["no_return"] == pytest.approx(0.1, abs=0.01) and free["steep_returns"] == pytest.approx(
        0.9, abs=0.01
    )
    assert free["blocked"] == 0.0 and free["near"] == 0.0
    hidden = [points_of(hide_behind_car(sweep, "velodyne_left")) for sweep in sweeps]
    found = statistics.sweep_statistics(hidden, rng, n_noise=2)
    assert found["blocked"] == pytest.approx(1.0 - CLEAR_LASERS.mean() / 32.0, abs=1e-9)
    np.testing.assert_array_equal(
        found["return_fractions"] > 0.02, np.arange(32)[:, None] < CLEAR_LASERS.repeat(2)
    )
    assert found["steep_returns"] == pytest.approx(
        free["steep_returns"], abs=1e-3
    )  # beside the car nothing is hidden


def test_sets_are_compared_with_the_spread_of_halves() -> None:
    rng = np.random.default_rng(3)
    real = [points_of(box_sweep(rng, 0.005)) for _ in range(4)]
    brighter = [points + [0.0, 0.0, 0.0, 60.0] for points in real]
    found = statistics.compare_sweeps(real, {"simulated": brighter, "empty": []}, rng)
    assert list(found) == [statistics.REAL, *statistics.HALVES, "simulated"]
    assert [part["is_part"] for part in found.values()] == [False, True, True, False]
    rows = {name: statistics.summarize_sweeps(part) for name, part in found.items()}
    assert np.isnan(rows[statistics.REAL]["Hellinger distance of intensities"])
    assert {rows[half]["Hellinger distance of ranges"] < 0.05 for half in statistics.HALVES} == {True}
    assert rows["simulated"]["Hellinger distance of intensities"] == pytest.approx(1.0)
    assert rows["simulated"]["Hellinger distance of heights"] < 1e-6
    alone = statistics.compare_sweeps([], {"simulated": brighter}, rng)
    assert list(alone) == ["simulated"] and np.isnan(alone["simulated"]["distances"]["ranges"])


def test_faults_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for sweeps in ([], [np.zeros((0, 4))]):
        with pytest.raises(ValueError, match="none, or an empty one"):
            statistics.sweep_statistics(sweeps, rng)
    folder = tmp_path / statistics.SWEEPS_PATH
    with pytest.raises(OxfordError, match="velodyne_left.timestamps"):
        statistics.load_real_sweeps(tmp_path, 3)
    oxford_files.save_timestamps(folder / "velodyne_left.timestamps", np.array([STAMP, STAMP + 50_000]))
    oxford_files.save_velodyne_binary(folder / "binaries" / f"{STAMP}.bin", points_of(box_sweep(rng)))
    with pytest.raises(OxfordError, match=f"{STAMP + 50_000}.bin"):
        statistics.load_real_sweeps(tmp_path, 3)
    assert len(statistics.load_real_sweeps(tmp_path, 1)) == 1
    oxford_files.save_timestamps(
        folder / "velodyne_left.timestamps", np.array([STAMP]), valid=np.zeros(1, dtype=bool)
    )
    with pytest.raises(OxfordError, match="no sweep is valid"):
        statistics.load_real_sweeps(tmp_path, 1)


def test_the_simulated_lidar_is_like_the_real_one(real_root: Path) -> None:
    """What does not depend on the scene: beams, view past the car; noise and losses within their spread."""
    if not (real_root / statistics.SWEEPS_PATH).is_dir():
        pytest.skip(f"{real_root / statistics.SWEEPS_PATH}: not there")
    rng = np.random.default_rng(5)
    real = statistics.sweep_statistics(statistics.load_real_sweeps(real_root, 12), rng)
    past = rng.uniform(0.0, 0.069, 8)
    made = [hide_behind_car(box_sweep(rng, 0.005, past_seam=p), "velodyne_left") for p in past]
    ours = statistics.sweep_statistics([points_of(sweep) for sweep in made], rng)
    assert ours["step_deg"] == pytest.approx(real["step_deg"], abs=0.001)
    for statistic in (ours, real):
        assert 180.0 <= statistic["first_angles_deg"].min() and statistic["first_angles_deg"].max() < 184.1
    steep = np.s_[20:]  # they end on the road or on the car
    is_same = (ours["return_fractions"][steep] > 0.5) == (real["return_fractions"][steep] > 0.5)
    assert is_same.mean() > 0.95
    np.testing.assert_allclose(ours["laser_counts"][steep], real["laser_counts"][steep], atol=60.0)
    assert 0.003 < real["range_noise_m"] < 0.008 and real["steep_returns"] > 0.98


def test_left_sweeps_of_a_session_are_evenly_chosen(tmp_path: Path) -> None:
    rng, stamps = np.random.default_rng(6), STAMP + 50_000 * np.arange(5)
    session = tmp_path / "one"
    for us in stamps:
        oxford_files.save_velodyne_binary(session / LIDARS[0] / f"{us}.bin", points_of(box_sweep(rng)))
    oxford_files.save_timestamps(session / "velodyne_left.timestamps", stamps)
    oxford_files.save_timestamps(session / "radar.timestamps", stamps)
    (session / "radar").mkdir()
    assert len(statistics.load_left_sweeps(open_session(session), 3)) == 3
    assert len(statistics.load_left_sweeps(open_session(session), 9)) == 5
    other = points_of(box_sweep(rng)) + [0.0, 0.0, 0.3, 0.0]  # a lidar with other elevations
    oxford_files.save_velodyne_binary(session / LIDARS[0] / f"{stamps[2]}.bin", other)
    assert statistics.load_left_sweeps(open_session(session), 5) == []
