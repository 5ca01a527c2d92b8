"""Correlative scan matching and scan-to-map ICP."""

import numpy as np
import pytest

from rol.geometry import compose, invert, relative_pose, transform_points
from rol.odometry import IcpSettings, OdometryError, icp_2d, scan_to_scan_icp, stack_increments
from rol_beyond.scan_matching import ScanToMapSettings, correlative_scan_match, scan_to_map_icp


def posts(n: int = 250) -> np.ndarray:
    """Points (n, 2) scattered over 60 m x 60 m, some 4 m apart: no two places look alike [m]."""
    return np.random.default_rng(0).uniform(-30.0, 30.0, (n, 2))


def thick_street(rng: np.random.Generator) -> np.ndarray:
    """Two thick house fronts with recesses and some posts, on the grid of a generated image."""
    x = np.arange(-40.0, 40.0, 0.25)
    fronts = [
        np.column_stack([x, np.full_like(x, side + depth) + 1.5 * ((x // 7) % 3 == 0)])
        for side in (-9.0, 8.0)
        for depth in np.arange(0.0, 1.0, 0.25)
    ]
    posts = np.repeat(rng.uniform((-40.0, -6.0), (40.0, 6.0), (12, 2)), 9, axis=0)
    return np.concatenate([*fronts, posts + rng.uniform(-0.4, 0.4, posts.shape)])


def seen_from(pose: tuple[float, float, float], world: np.ndarray) -> np.ndarray:
    local = transform_points(relative_pose(np.array(pose), np.zeros(3)), world)
    near = local[np.hypot(*local.T) < 30.0]
    return np.unique(np.round(near / 0.25) * 0.25, axis=0)


@pytest.mark.parametrize("motion", [(1.3, -0.2, 0.03), (-0.9, 0.4, -0.06), (0.0, 0.0, 0.0)])
def test_correlative_match_finds_a_motion_far_from_the_guess(motion: tuple[float, float, float]) -> None:
    world = thick_street(np.random.default_rng(0))
    found = correlative_scan_match(seen_from(motion, world), seen_from((0.0, 0.0, 0.0), world))
    assert np.hypot(*(found - motion)[:2]) < 0.16 and abs(found[2] - motion[2]) < 0.01


def test_correlative_match_tracks_an_accelerating_vehicle() -> None:
    world = thick_street(np.random.default_rng(1))
    steps = np.linspace(0.1, 2.2, 8)
    clouds = [seen_from((x, 0.0, 0.0), world) for x in np.concatenate([[0.0], np.cumsum(steps)]) - 9.0]
    plain, searched = (
        stack_increments(scan_to_scan_icp(clouds, refine_guess=refine))[:, 0]
        for refine in (None, correlative_scan_match)
    )
    assert np.abs(searched - steps).max() < 0.16
    assert np.abs(plain - steps).max() > np.abs(searched - steps).max()


def test_correlative_match_without_points_gives_the_guess_and_refuses_bad_ones() -> None:
    cloud, guess = np.random.default_rng(0).normal(size=(20, 2)), np.array([0.5, 0.0, 0.1])
    for source, target in ((np.zeros((0, 2)), cloud), (cloud, np.zeros((0, 2)))):
        np.testing.assert_array_equal(correlative_scan_match(source, target, guess), guess)
    with pytest.raises(OdometryError, match="source cloud: point 0 is not finite"):
        correlative_scan_match(np.full((4, 2), np.nan), cloud)


def test_correlative_match_ignores_stray_points_and_refuses_what_fits_no_grid() -> None:
    world = thick_street(np.random.default_rng(0))
    source, target = seen_from((1.3, -0.2, 0.03), world), seen_from((0.0, 0.0, 0.0), world)
    stray = np.concatenate([target, [[1e6, 1e6], [-1e6, 0.0]]])
    np.testing.assert_array_equal(
        correlative_scan_match(source, stray), correlative_scan_match(source, target)
    )
    with pytest.raises(
        OdometryError, match=r"source and target cloud: .* 2000000 m x 10000\d\d m, too far .*stray"
    ):
        correlative_scan_match(np.concatenate([source, [[1e6, 1e6]]]), stray)
    far = target + 5000.0  # nothing to fall on
    np.testing.assert_array_equal(correlative_scan_match(source, far, (0.1, 0.0, 0.0)), (0.1, 0.0, 0.0))


def test_scan_to_map_icp_corrects_the_drift_of_odometry():
    points, truth = posts(), np.array([(float(x), 0.0, 0.02) for x in range(-15, 15, 2)])
    steps = relative_pose(truth[:-1], truth[1:]) * (0.9, 1.0, 1.0)  # a tenth too short
    clouds = [transform_points(invert(pose), points)[::2] for pose in truth]
    results = list(scan_to_map_icp(steps, clouds, points, truth[0]))
    poses = np.array([result.T_target_source for result in results])
    np.testing.assert_allclose(poses, truth, atol=0.05)
    assert all(result.converged for result in results)


def test_scan_to_map_icp_registers_to_the_near_points_alone():
    rng, points = (
        np.random.default_rng(5),
        np.concatenate([posts(400), posts(400) + (60.0, 0.0), [[1e7, 0.0]]]),
    )
    poses = [(float(x), 0.5, 0.01) for x in (0, 9, 40, 107)]
    clouds = [transform_points(invert(pose), points)[:-1] + rng.normal(0.0, 0.1, (800, 2)) for pose in poses]
    steps = relative_pose(np.array(poses[:-1]), np.array(poses[1:]))
    settings = ScanToMapSettings(range_m=20.0, min_inlier_ratio=0.05, icp=IcpSettings(max_points=700))
    results = list(scan_to_map_icp(steps, clouds, points, poses[0], settings=settings))
    guess = np.array(poses[0])
    for step, cloud, found in zip([*steps, np.zeros(3)], clouds, results, strict=True):
        near = points[np.hypot(*(points - guess[:2]).T) <= 20.0]
        expected = icp_2d(cloud, near, guess, IcpSettings(max_points=700))
        assert found.converged == expected.converged and found.n_matched == expected.n_matched
        if found.converged:
            np.testing.assert_allclose(found.T_target_source, expected.T_target_source, rtol=0.0, atol=1e-12)
        guess = compose(found.T_target_source, step)
    assert [found.converged for found in results] == [True, True, True, False]
    assert 0 < len(near) < 10 and results[-1].n_matched == 0  # too few to register to


def test_scan_to_map_icp_uses_the_increment_without_points_and_can_be_reset():
    nothing = np.zeros((0, 2))

    def reset_callback(index, pose):
        return (20.0, 0.0, 0.0) if index == 1 else None

    steps = [(1.0, 0.0, 0.0)] * 2
    results = scan_to_map_icp(steps, [nothing] * 3, posts(), (0.0, 0.0, 0.0), reset_callback)
    ahead = [result.T_target_source[0] for result in results]
    np.testing.assert_allclose(ahead, [0.0, 1.0, 21.0])


def test_scan_to_map_icp_rejects_a_low_inlier_ratio():
    rng, false = np.random.default_rng(1), np.random.default_rng(2)
    cloud = np.concatenate([posts()[:30], false.uniform(100.0, 140.0, (300, 2))])
    settings = ScanToMapSettings(range_m=60.0)
    (result,) = scan_to_map_icp(
        [], [cloud], posts(), rng.normal(0.0, 0.3, 3) * (1.0, 1.0, 0.0), settings=settings
    )
    assert not result.converged and result.n_matched < 0.2 * len(cloud)


def test_scan_to_map_icp_needs_an_increment_per_cloud_and_a_map():
    with pytest.raises(OdometryError, match="no odometry increment for scan 1"):
        list(scan_to_map_icp([], [np.zeros((0, 2))] * 2, posts(), np.zeros(3)))
    with pytest.raises(OdometryError, match="map: expected points"):
        list(scan_to_map_icp([], [np.zeros((0, 2))], np.zeros((3, 3)), np.zeros(3)))


@pytest.mark.parametrize(
    ("name", "value"),
    [("window", (-1.0, 1.0, 0.1)), ("window", (1e6, 1.0, 0.1)), ("cell", 0), ("max_points", 0)],
)
def test_correlative_match_refuses_settings_out_of_range(name: str, value: float):
    with pytest.raises(OdometryError, match=f"{name}: .* is not"):
        correlative_scan_match(posts(), posts(), **{name: value})
