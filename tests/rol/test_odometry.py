"""Registration of clouds against closed forms and oracles."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.geometry import accumulate_increments, compose, invert, relative_pose, transform_points
from rol.odometry import (
    IcpSettings,
    OdometryError,
    fit_rigid,
    icp_2d,
    scan_to_scan_icp,
    sort_cloud,
    stack_increments,
)


def posts(n: int = 250) -> np.ndarray:
    """Points (n, 2) scattered over 60 m x 60 m, some 4 m apart: no two places look alike [m]."""
    return np.random.default_rng(0).uniform(-30.0, 30.0, (n, 2))


def svd_fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rigid motion by the singular value decomposition of Arun et al. 1987, the oracle."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = vt.T @ np.diag([1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    shift = target.mean(0) - rotation @ source.mean(0)
    return np.array([*shift, np.arctan2(rotation[1, 0], rotation[0, 0])])


def test_fit_rigid_by_hand():
    # a unit step and a quarter turn: (1, 0) -> (2, 4), (3, 0) -> (2, 6)
    source, target = np.array([[1.0, 0.0], [3.0, 0.0]]), np.array([[2.0, 4.0], [2.0, 6.0]])
    np.testing.assert_allclose(fit_rigid(source, target), (2.0, 3.0, np.pi / 2), atol=1e-12)


def test_fit_rigid_agrees_with_the_svd():
    rng = np.random.default_rng(0)
    for _ in range(20):
        source, pose = rng.normal(0.0, 10.0, (30, 2)), rng.uniform(-3.0, 3.0, 3)
        target = transform_points(pose, source) + rng.normal(0.0, 0.5, source.shape)
        np.testing.assert_allclose(fit_rigid(source, target), svd_fit(source, target), atol=1e-9)


def test_fit_rigid_refuses_clouds_of_unequal_length():
    with pytest.raises(OdometryError, match="3 source points cannot be paired with 2 target points"):
        fit_rigid(np.eye(3)[:, :2], np.eye(2))


def icp_by_tree(source, target, pose, limit=3.0, least=1.0, trim=0.9):
    """ICP as in `icp_2d`, with a k-d tree and NumPy, the oracle: pose, pairs, fits, and whether it converged."""
    tree, pose = cKDTree(target), np.array(pose)
    for iteration in range(1, 31):
        moved = transform_points(pose, source)
        distances, neighbours = tree.query(moved, distance_upper_bound=limit)
        kept = np.argsort(distances)[: int(np.ceil(trim * np.isfinite(distances).sum()))]
        change = fit_rigid(moved[kept], target[neighbours[kept]])
        last, pose = pose, compose(change, pose)
        if limit <= least and np.hypot(*(pose - last)[:2]) + 30.0 * abs(change[2]) < 1e-3:
            return pose, len(kept), iteration, True
        limit = max(0.8 * limit, least)
    return pose, len(kept), 30, False


@pytest.mark.parametrize("limits", [(3.0, 1.0), (25.0, 2.0), (0.7, 0.7), (np.inf, np.inf)])
@pytest.mark.parametrize("n", [25, 1000])
def test_icp_agrees_with_a_search_by_tree(limits, n):
    rng = np.random.default_rng(n)
    stray = [(1e6, -3e6), (-1e15, 0.0), (1e200, 1e200)]
    target = np.concatenate([rng.uniform(-40.0, 40.0, (2 * n, 2)), stray])
    source = transform_points(invert((0.4, -0.2, 0.02)), target[:n])
    source = np.concatenate([source + rng.normal(0.0, 0.05, source.shape), rng.uniform(-90, 90, (n // 2, 2))])
    settings = IcpSettings(max_distance=limits[0], min_distance=limits[1], max_points=9999)
    found = icp_2d(source, target, (0.1, 0.05, 0.01), settings)
    pose, *rest = icp_by_tree(source, target, (0.1, 0.05, 0.01), *limits)
    np.testing.assert_allclose(found.T_target_source, pose, rtol=0.0, atol=1e-12)
    assert [found.n_matched, found.iterations, found.converged] == rest


def test_stray_points_need_no_memory():
    cloud = np.concatenate([posts(), [[1e6, 1e6], [-1e12, 5.0]]])
    assert len(sort_cloud(cloud).starts) == len(sort_cloud(posts()).starts) < 10 * len(cloud)
    np.testing.assert_array_equal(np.unique(sort_cloud(cloud).points, axis=0), np.unique(cloud, axis=0))


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.8, -0.2, 0.05), (-1.5, 0.6, -0.08)])
def test_icp_recovers_a_known_motion(motion):
    target = posts()
    source = transform_points(invert(motion), target)
    result = icp_2d(source, target)
    assert result.converged
    np.testing.assert_allclose(result.T_target_source, motion, atol=1e-3)
    assert result.rmse_m < 1e-3 and result.n_matched == int(np.ceil(0.9 * len(source)))


def test_icp_withstands_false_points_and_finds_a_large_motion_from_a_good_guess():
    rng, target, motion = np.random.default_rng(1), posts(), np.array([6.0, 1.0, 0.5])
    source = transform_points(invert(motion), target) + rng.normal(0.0, 0.03, target.shape)
    source = np.concatenate([source, rng.uniform(-30, 30, (60, 2))])
    result = icp_2d(source, target, motion + (0.5, -0.3, 0.04))
    assert result.converged
    np.testing.assert_allclose(result.T_target_source, motion, atol=0.02)


def test_the_increment_is_the_later_pose_in_the_earlier():
    world = posts()
    earlier, later = np.array([1.0, 0.5, 0.1]), np.array([2.0, 0.6, 0.15])
    result = icp_2d(transform_points(invert(later), world), transform_points(invert(earlier), world))
    np.testing.assert_allclose(result.T_target_source, relative_pose(earlier, later), atol=1e-3)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (np.zeros((0, 2)), posts()),
        (posts(), np.zeros((0, 2))),
        (np.ones((3, 2)), posts()),
        (posts() + 500.0, posts()),  # nothing within reach
        (np.full((50, 2), 6.0), posts()),  # one place only: no heading
    ],
)
def test_degenerate_clouds_keep_the_guess_and_say_so(source, target):
    result = icp_2d(source, target, (0.1, 0.2, 0.0))
    assert not result.converged
    np.testing.assert_array_equal(result.T_target_source, (0.1, 0.2, 0.0))


@pytest.mark.parametrize(
    ("cloud", "fault"),
    [
        (np.zeros((5, 3)), r"source cloud: expected points of shape \(n, 2\), got \(5, 3\)"),
        (np.array([[0.0, 0.0], [np.nan, 1.0]]), "source cloud: point 1 is not finite"),
    ],
)
def test_bad_clouds_are_refused(cloud, fault):
    with pytest.raises(OdometryError, match=fault):
        icp_2d(cloud, posts())
    with pytest.raises(ValueError, match="initial guess"):
        icp_2d(posts(), posts(), (np.nan, 0.0, 0.0))


def test_too_few_iterations_are_flagged():
    target = posts()
    result = icp_2d(transform_points((1.0, 0.0, 0.1), target), target, settings=IcpSettings(max_iterations=2))
    assert not result.converged and result.iterations == 2


def test_scan_to_scan_icp_tracks_increments_too_long_for_a_guess_of_zero():
    # at 4 m a scan the nearest post is the wrong one; the guess of constant velocity finds the right one
    steps = np.tile((1.0, 0.0, 0.02), (12, 1)) * np.linspace(0.5, 4.0, 12)[:, None]
    poses, world = accumulate_increments(steps), posts()
    clouds = [transform_points(invert(pose), world) for pose in poses]
    found = stack_increments(scan_to_scan_icp(clouds))
    np.testing.assert_allclose(found, steps, atol=0.01)
    assert np.abs(icp_2d(clouds[-1], clouds[-2]).T_target_source - steps[-1]).max() > 0.5


def test_scan_to_scan_icp_continues_after_an_empty_cloud():
    world, poses = posts(), accumulate_increments(np.tile((0.5, 0.0, 0.0), (4, 1)))
    clouds = [transform_points(invert(pose), world) for pose in poses]
    clouds[2] = np.zeros((0, 2))
    results = list(scan_to_scan_icp(clouds))
    assert [r.converged for r in results] == [True, False, False, True]
    np.testing.assert_allclose(stack_increments(results), np.tile((0.5, 0.0, 0.0), (4, 1)), atol=2e-3)


def test_scan_to_scan_icp_of_one_or_no_cloud_is_empty():
    assert stack_increments(scan_to_scan_icp([posts()])).shape == (0, 3)
    assert stack_increments(scan_to_scan_icp([])).shape == (0, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_distance", 0.0), ("max_distance", np.nan), ("min_distance", -1.0), ("trim", 0.0), ("trim", 1.5),
        ("tolerance", -1.0), ("max_iterations", 0), ("min_matched", 0), ("max_points", 2.5),
    ],
)  # fmt: skip
def test_icp_refuses_settings_out_of_range(name: str, value: float):
    with pytest.raises(OdometryError, match=f"{name}: {value} is not"):
        IcpSettings(**{name: value})
