"""The whole chain in the plane: walls, a scanner that drives, a map of its own, odometry, filter, figures."""

import numpy as np
import pytest

from rol.evaluation import FailureMonitor, pose_errors, rmse, summarize
from rol.geometry import accumulate_increments, compose, relative_pose
from rol.maps import accumulate_map, register_maps
from rol.mcl import MclSettings, ParticleFilter, localize
from rol.odometry import scan_to_scan_icp, stack_increments
from rol_beyond.robust import settings_for

SCAN_US = 250_000


def build_walls(rng: np.random.Generator) -> np.ndarray:
    """Give walls (k, 2, 2) of 25 houses of odd sizes on a 5 x 5 block grid, streets 16 to 22 m wide [m]."""
    walls = []
    for i in range(5):
        for j in range(5):
            low = np.array([60.0 * i, 60.0 * j]) + rng.uniform(8.0, 11.0, 2)
            x0, y0, x1, y1 = *low, *(low + rng.uniform(38.0, 42.0, 2))
            notch = rng.uniform(8.0, 20.0)
            corners = [(x0, y0), (x1, y0), (x1, y1), (x0 + notch, y1), (x0 + notch, y1 - 6.0), (x0, y1 - 6.0)]
            walls += list(zip(corners, corners[1:] + corners[:1], strict=True))
    return np.array(walls)


def drive(offset: tuple[float, float, float], step_m: float) -> np.ndarray:
    """Give the poses (n, 3) of a drive around two blocks with rounded corners, begun at an offset."""
    straight = [(step_m, 0.0, 0.0)] * int(100 / step_m)
    bend = [(step_m, 0.0, step_m / 10.0)] * round(np.pi / 2 * 10.0 / step_m)
    increments = np.array((straight + bend) * 2 + straight)
    return accumulate_increments(increments, compose((70.0, 60.0, 0.0), offset))


def scan(walls: np.ndarray, pose: np.ndarray, rng: np.random.Generator, clutter: int = 60) -> np.ndarray:
    """Cast 400 rays, jitter the hits by 0.1 m, lose a third, add false points; cloud (m, 2)."""
    angles = np.arange(400) * np.pi / 200
    rays = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)
    a, edge = walls[:, 0] - pose[:2], walls[:, 1] - walls[:, 0]
    cross = rays[:, :1] * edge[None, :, 1] - rays[:, 1:] * edge[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / cross
        along = (a[None, :, 0] * rays[:, 1:] - a[None, :, 1] * rays[:, :1]) / cross
    reach[~((reach > 0) & (along >= 0) & (along <= 1))] = np.inf
    ranges = reach.min(axis=1)
    seen = (ranges < 64.0) & (rng.random(400) < 0.67)
    hits = ranges[seen, None] * np.stack([np.cos(angles[seen]), np.sin(angles[seen])], axis=1)
    return np.concatenate([hits + rng.normal(0.0, 0.1, hits.shape), rng.uniform(-40.0, 40.0, (clutter, 2))])


@pytest.fixture(scope="module")
def town() -> dict[str, np.ndarray | list]:
    """Two drives through one town of walls, each with its true poses and its clouds."""
    rng = np.random.default_rng(3)
    walls = build_walls(rng)
    first, second = drive((0.0, 0.0, 0.0), 1.0), drive((1.5, -0.8, 0.03), 1.4)
    return {
        "first": first,
        "second": second,
        "first_clouds": [scan(walls, pose, rng, clutter=0) for pose in first],
        "second_clouds": [scan(walls, pose, rng) for pose in second],
        "second_clean": [scan(walls, pose, rng, clutter=0) for pose in second],
    }


def test_ground_truth_from_two_maps_finds_the_offset_of_the_starts(town):
    # each session knows only its own odometry, its start set to zero (Sec. IV-A)
    first, second = (relative_pose(town[name][0], town[name]) for name in ("first", "second"))
    target = accumulate_map(town["first_clouds"], first)
    source = accumulate_map(town["second_clean"], second)
    registration = register_maps(source, target)
    expected = relative_pose(town["first"][0], town["second"][0])
    assert registration.converged and registration.fraction_1m > 0.95
    np.testing.assert_allclose(registration.T_target_source, expected, atol=0.05)


@pytest.mark.parametrize("method", ["paper", "robust"])
def test_filter_follows_the_second_drive_on_the_map_of_the_first(town, method):
    truth, clouds = town["second"], town["second_clouds"]
    increments = stack_increments(scan_to_scan_icp(clouds))
    settings = settings_for(method, n_particles=300)
    grid = settings.measurement.build_grid(accumulate_map(town["first_clouds"], town["first"]))
    monitor = FailureMonitor(np.arange(len(truth)) * SCAN_US, truth)
    particle_filter = ParticleFilter(grid, truth[0], settings, np.random.default_rng(7))
    poses = np.array([u.pose for u in localize(particle_filter, increments, clouds, monitor)])
    metrics = summarize(
        poses,
        truth,
        method=method,
        session="walls",
        failures=len(monitor.failures),
        update_ms_median=1.0,
        seed=7,
    )
    assert metrics["failures"] == 0
    assert metrics["rmse_m"] < 0.5 and metrics["rmse_yaw_deg"] < 1.0
    assert pose_errors(poses[-1:], truth[-1:]).position_m[0] < 0.5
    # and it beats the odometry that it is fed with
    alone = pose_errors(accumulate_increments(increments, truth[0]), truth)
    assert metrics["rmse_m"] < rmse(alone.position_m)


def test_same_seed_gives_the_same_numbers(town):
    settings = MclSettings(n_particles=50)
    grid = settings.measurement.build_grid(accumulate_map(town["first_clouds"], town["first"]))
    increments, clouds = relative_pose(town["second"][:9], town["second"][1:10]), town["second_clouds"][:10]
    runs = []
    for k in (5, 5, 6):
        particle_filter = ParticleFilter(grid, town["second"][0], settings, np.random.default_rng(k))
        runs.append(np.array([u.pose for u in localize(particle_filter, increments, clouds)]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 0
