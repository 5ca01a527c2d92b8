"""Runs of localization: reading of clouds, comparison with registration, files of a run, errors by motion."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from rol.bev import image_to_points, points_to_image
from rol.evaluation import FailureMonitor
from rol.geometry import accumulate_increments, invert, relative_pose, transform_points
from rol.mcl import MclSettings, ParticleFilter
from rol_study.filter_runs import run_filter
from rol_study.localization import (
    compare_with_registration,
    errors_by_motion,
    heading_bias_deg,
    read_clouds,
    read_run,
    speed_of,
    write_run,
)

N = 12
STAMPS_US = np.arange(N, dtype=np.int64) * 250_000
TRUTH = accumulate_increments(np.tile([2.0, 0.0, 0.02], (N - 1, 1)), (0.0, 0.0, 0.1))
INCREMENTS = relative_pose(TRUTH[:-1], TRUTH[1:])
SETTINGS = MclSettings(n_particles=200)


@pytest.fixture(scope="module")
def map_points() -> np.ndarray:
    """Walls in several directions around the path."""
    rng = np.random.default_rng(3)
    middles, angles = rng.uniform(-45.0, 65.0, (150, 2)), rng.uniform(0.0, np.pi, 150)
    along = np.linspace(-3.0, 3.0, 31)[:, None, None]
    return (middles + along * np.column_stack([np.cos(angles), np.sin(angles)])).reshape(-1, 2)


@pytest.fixture(scope="module")
def clouds(map_points: np.ndarray) -> list[np.ndarray]:
    """Map points within 40 m of each true pose, in the radar frame."""
    seen = (transform_points(invert(pose), map_points) for pose in TRUTH)
    return [points[np.hypot(*points.T) < 40.0][::3] for points in seen]


def new_filter(map_points: np.ndarray, seed: int = 1) -> ParticleFilter:
    grid = SETTINGS.measurement.build_grid(map_points)
    return ParticleFilter(grid, TRUTH[0], SETTINGS, np.random.default_rng(seed))


def test_every_seed_and_then_the_registration_is_run(
    map_points: np.ndarray, clouds: list[np.ndarray]
) -> None:
    found = list(
        compare_with_registration(
            clouds,
            INCREMENTS,
            map_points,
            lambda seed: new_filter(map_points, seed),
            lambda: FailureMonitor(STAMPS_US, TRUTH),
            range(5, 7),
        )
    )
    assert [row[:2] for row in found] == [("filter", 5), ("filter", 6), ("ICP on the map", 5)]
    assert (found[0][2].poses != found[1][2].poses).any()


def test_lidar_points_come_from_the_pairs_of_the_motion(tmp_path: Path) -> None:
    columns = {name: [0.0] for name in ("vx_mps", "vy_mps", "yaw_rate_radps")}
    folder = tmp_path / "alignment" / "town"
    folder.mkdir(parents=True)
    pd.DataFrame({"radar_stamp_us": [7], **columns}).to_csv(folder / "alignment.csv", index=False)
    for name, x in (("pairs", 10.0), ("pairs-corrected", 20.0)):
        image = points_to_image(np.array([[x, 5.0]]))
        path = tmp_path / name / "town" / "lidar" / "7.png"
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), image)
        source = name.replace("pairs", "real")
        (cloud,) = read_clouds(source, "town", np.array([7]), tmp_path, tmp_path)
        np.testing.assert_array_equal(cloud, image_to_points(image))
        assert abs(cloud[0, 0] - x) < 0.2


def test_unknown_points_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'sonar', expected one of raw, fake, real"):
        read_clouds("sonar", "town", STAMPS_US, tmp_path, tmp_path)


def test_heading_bias_is_that_of_fast_scans() -> None:
    poses = TRUTH + np.outer(np.where(np.arange(N) < 4, 0.5, 0.01), (0.0, 0.0, 1.0))
    speed = np.where(np.arange(N) < 4, 1.0, 9.0)
    assert heading_bias_deg(poses, TRUTH, speed) == pytest.approx(np.rad2deg(0.01))
    assert np.isnan(heading_bias_deg(poses, TRUTH, np.zeros(N)))


def test_run_is_read_as_it_was_written(
    map_points: np.ndarray, clouds: list[np.ndarray], tmp_path: Path
) -> None:
    run = run_filter(new_filter(map_points), INCREMENTS, clouds, FailureMonitor(STAMPS_US, TRUTH))
    metrics = run.summarize(TRUTH, "paper", "town", 1)
    write_run(tmp_path, replace(run, failures=[3]), STAMPS_US + 1, TRUTH, metrics)
    for name in ("seeds", "sources"):
        pd.DataFrame([metrics]).to_csv(tmp_path / f"{name}.csv", index=False)
    stored = read_run(tmp_path)
    assert stored.metrics == metrics
    np.testing.assert_allclose(stored.estimate, run.poses, atol=1e-6)
    np.testing.assert_allclose(stored.errors.position_m, stored.steps.position_m, atol=1e-5)
    np.testing.assert_allclose(stored.steps.speed_mps, 8.0, rtol=0.01)
    np.testing.assert_allclose(stored.steps.yaw_rate_degps, np.rad2deg(0.08), atol=0.01)
    assert list(np.flatnonzero(stored.steps.is_restarted)) == [3]
    np.testing.assert_array_equal(stored.steps.match_share, run.diagnostics.inlier_ratio)


def test_speed_is_that_of_the_path() -> None:
    np.testing.assert_allclose(speed_of(STAMPS_US, TRUTH), 8.0, rtol=0.01)


def test_errors_are_split_by_speed_and_by_yaw_rate() -> None:
    steps = pd.DataFrame(
        {
            "speed_mps": [1.0, 2.0, 8.0, 9.0],
            "yaw_rate_degps": [0.0, -5.0, 0.0, 5.0],
            "position_m": [3.0, 4.0, 6.0, 8.0],
            "longitudinal_m": [0.0, 0.0, 0.0, 0.0],
            "lateral_m": [3.0, 4.0, 6.0, 8.0],
            "yaw_rad": np.deg2rad([1.0, 3.0, -1.0, -3.0]),
        }
    )
    table = errors_by_motion(steps)
    assert list(table.n) == [4, 2, 2, 2, 2]
    assert table.rmse_m["slow"] == pytest.approx(np.sqrt(12.5))
    assert table.rmse_m["fast"] == pytest.approx(np.sqrt(50.0))
    assert table.rmse_yaw_deg["straight"] == pytest.approx(1.0)
    assert table.rmse_yaw_deg["turning"] == pytest.approx(3.0)
    assert table.rmse_m["all"] == pytest.approx(np.sqrt(31.25))
