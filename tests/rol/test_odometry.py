"""Registration of clouds against closed forms and oracles."""

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.evaluation import pose_errors, rmse
from rol.geometry import accumulate_increments, compose, invert, relative_pose, transform_points
from rol.odometry import (
    LocalMapSettings,
    OdometryError,
    build_local_map,
    chain,
    correct_cloud,
    fit_rigid,
    follow_map,
    icp_2d,
    local_map_odometry,
    register_robust,
    search_motion,
    sort_cloud,
    steps_of,
)
from rol.radar import DOPPLER_SECONDS, SCAN_SECONDS, peaks_to_points


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
    found = icp_2d(
        source, target, (0.1, 0.05, 0.01), max_distance=limits[0], min_distance=limits[1], max_points=9999
    )
    pose, *rest = icp_by_tree(source, target, (0.1, 0.05, 0.01), *limits)
    np.testing.assert_allclose(found.T_target_source, pose, rtol=0.0, atol=1e-12)
    assert [found.n_matched, found.iterations, found.converged] == rest


def test_stray_points_need_no_memory():
    cloud = np.concatenate([posts(), [[1e6, 1e6], [-1e12, 5.0]]])
    assert len(sort_cloud(cloud).starts) == len(sort_cloud(posts()).starts) < 10 * len(cloud)
    np.testing.assert_array_equal(np.unique(sort_cloud(cloud).points, axis=0), np.unique(cloud, axis=0))


def wall(length_m: float = 60.0, noise_m: float = 0.1, seed: int = 0) -> np.ndarray:
    """One straight wall across the axes, shape (n, 2) [m]."""
    along = np.arange(-length_m / 2.0, length_m / 2.0, 0.25)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, len(along))
    return transform_points((3.0, 5.0, 0.6), np.column_stack([along, noise]))


def test_icp_reports_that_a_wall_leaves_one_direction_unconstrained():
    along = transform_points((0.0, 0.0, 0.6), np.array([[2.0, 0.0]]))[0]  # 2 m along the wall
    one = icp_2d(wall()[40:-40] + along, wall(seed=1))
    assert one.converged and one.weakest_direction < 0.05
    corner = [np.concatenate([w, transform_points((0.0, 0.0, np.pi / 2), w)]) for w in (wall(), wall(seed=1))]
    both = icp_2d(corner[0] + 0.1, corner[1])
    assert both.converged and both.weakest_direction > 0.8
    most = [np.concatenate([wall(seed=seed), posts(80)]) for seed in (0, 1)]  # 240 points of a wall, 80 posts
    assert one.weakest_direction < icp_2d(most[0] + 0.1, most[1]).weakest_direction < both.weakest_direction
    assert np.isnan(icp_2d(wall(), wall() + 500.0).weakest_direction)


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


def test_the_step_is_the_later_pose_seen_from_the_earlier():
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
    result = icp_2d(transform_points((1.0, 0.0, 0.1), target), target, max_iterations=2)
    assert not result.converged and result.iterations == 2


def test_chain_follows_steps_too_long_for_a_guess_of_zero():
    # at 4 m a scan the nearest post is the wrong one; the guess of constant velocity finds the right one
    steps = np.tile((1.0, 0.0, 0.02), (12, 1)) * np.linspace(0.5, 4.0, 12)[:, None]
    poses, world = accumulate_increments(steps), posts()
    clouds = [transform_points(invert(pose), world) for pose in poses]
    found = steps_of(chain(clouds))
    np.testing.assert_allclose(found, steps, atol=0.01)
    assert np.abs(icp_2d(clouds[-1], clouds[-2]).T_target_source - steps[-1]).max() > 0.5


def test_chain_goes_on_through_an_empty_cloud():
    world, poses = posts(), accumulate_increments(np.tile((0.5, 0.0, 0.0), (4, 1)))
    clouds = [transform_points(invert(pose), world) for pose in poses]
    clouds[2] = np.zeros((0, 2))
    results = list(chain(clouds))
    assert [r.converged for r in results] == [True, False, False, True]
    np.testing.assert_allclose(steps_of(results), np.tile((0.5, 0.0, 0.0), (4, 1)), atol=2e-3)


def test_chain_of_one_or_no_cloud_has_no_step():
    assert steps_of(chain([posts()])).shape == (0, 3)
    assert steps_of(chain([])).shape == (0, 3)


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
def test_search_finds_a_motion_far_from_the_guess(motion: tuple[float, float, float]) -> None:
    world = thick_street(np.random.default_rng(0))
    found = search_motion(seen_from(motion, world), seen_from((0.0, 0.0, 0.0), world))
    assert np.hypot(*(found - motion)[:2]) < 0.16 and abs(found[2] - motion[2]) < 0.01


def test_search_follows_a_car_that_gains_speed() -> None:
    world = thick_street(np.random.default_rng(1))
    steps = np.linspace(0.1, 2.2, 8)
    clouds = [seen_from((x, 0.0, 0.0), world) for x in np.concatenate([[0.0], np.cumsum(steps)]) - 9.0]
    plain, searched = (steps_of(chain(clouds, search=search))[:, 0] for search in (False, True))
    assert np.abs(searched - steps).max() < 0.16
    assert np.abs(plain - steps).max() > np.abs(searched - steps).max()


def test_search_without_points_gives_the_guess_and_refuses_bad_ones() -> None:
    cloud, guess = np.random.default_rng(0).normal(size=(20, 2)), np.array([0.5, 0.0, 0.1])
    for source, target in ((np.zeros((0, 2)), cloud), (cloud, np.zeros((0, 2)))):
        np.testing.assert_array_equal(search_motion(source, target, guess), guess)
    with pytest.raises(OdometryError, match="source cloud: point 0 is not finite"):
        search_motion(np.full((4, 2), np.nan), cloud)


def test_search_ignores_stray_points_and_refuses_what_fits_no_grid() -> None:
    world = thick_street(np.random.default_rng(0))
    source, target = seen_from((1.3, -0.2, 0.03), world), seen_from((0.0, 0.0, 0.0), world)
    stray = np.concatenate([target, [[1e6, 1e6], [-1e6, 0.0]]])
    np.testing.assert_array_equal(search_motion(source, stray), search_motion(source, target))
    with pytest.raises(
        OdometryError, match=r"source and target cloud: .* 2000000 m x 10000\d\d m, too far .*stray"
    ):
        search_motion(np.concatenate([source, [[1e6, 1e6]]]), stray)
    far = target + 5000.0  # nothing to fall on
    np.testing.assert_array_equal(search_motion(source, far, (0.1, 0.0, 0.0)), (0.1, 0.0, 0.0))


# ---- registration to a local map ----


def test_correct_cloud_by_hand():
    # at 10 m/s: what is ahead was seen 125 ms before mid-scan and 0.49 m too near; right 62.5 ms before, behind at
    # mid-scan and too far, left 62.5 ms after
    points = np.array([[20.0, 0.0], [0.0, -20.0], [-20.0, 0.0], [0.0, 20.0], [0.0, 0.0]])
    corrected = correct_cloud(points, (10.0, 0.0, 0.0))
    expected = [[20.49 - 1.25, 0.0], [-0.625, -20.0], [-20.0 + 0.49, 0.0], [0.625, 20.0]]
    np.testing.assert_allclose(corrected[:4], expected, atol=1e-9)
    assert np.isfinite(corrected).all()
    np.testing.assert_allclose(
        correct_cloud(points, (10.0, 0.0, 0.0), scan_seconds=0.0)[:2], [[20.49, 0.0], [0.0, -20.0]], atol=1e-9
    )
    # turning left by 1 rad/s: what is behind was seen at mid-scan, and 62.5 ms are 0.0625 rad
    turned = correct_cloud(points, (0.0, 0.0, 1.0), doppler_seconds=0.0)
    np.testing.assert_allclose(turned[2], (-20.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(turned[1], 20.0 * np.array([-np.sin(0.0625), -np.cos(0.0625)]), atol=1e-9)


def test_correct_cloud_does_what_the_radar_room_does_to_peaks():
    rng, azimuths, twist = np.random.default_rng(2), -2.0 * np.pi * np.arange(400) / 400, (8.0, 0.3, 0.4)
    rows, bins = rng.integers(0, 400, 500), rng.integers(60, 1400, 500)
    plain = peaks_to_points(rows, bins, azimuths)
    expected = peaks_to_points(rows, bins, azimuths, twist=twist, doppler_seconds=DOPPLER_SECONDS)
    ahead = rows == 0  # there a rounding decides between the first and the last moment of the turn
    np.testing.assert_allclose(correct_cloud(plain, twist)[~ahead], expected[~ahead], atol=1e-9)


def test_local_map_keeps_the_mean_of_cells_that_were_seen_twice():
    settings = LocalMapSettings(cell_m=1.0, min_views=2)
    clouds = [np.array([[0.0, 0.0], [0.2, 0.4], [5.0, 0.0]]), np.array([[0.4, 0.2]]), np.array([[9.0, 9.0]])]
    np.testing.assert_allclose(build_local_map(clouds, settings).cloud.points, [[0.2, 0.2]])
    one = build_local_map(clouds[:1], settings)  # of one cloud all is kept
    np.testing.assert_allclose(one.cloud.points, [[0.1, 0.2], [5.0, 0.0]])
    np.testing.assert_allclose(one.metrics, np.tile(np.eye(2), (2, 1, 1)))
    assert build_local_map([], settings) is None and build_local_map([np.zeros((0, 2))] * 3, settings) is None


def test_points_on_a_wall_are_held_across_it_and_let_go_along_it():
    wall = np.column_stack([np.arange(0.0, 10.0, 0.5), 0.5 * np.arange(0.0, 10.0, 0.5)])  # slope one half
    local_map = build_local_map([np.concatenate([wall, [[50.0, 0.0]]])], LocalMapSettings(cell_m=0.25))
    along, across = np.array([2.0, 1.0]) / np.sqrt(5), np.array([-1.0, 2.0]) / np.sqrt(5)
    for point, metric in zip(local_map.cloud.points, local_map.metrics, strict=True):
        assert across @ metric @ across == pytest.approx(1.0)
        on_wall = 1.0 < point[0] < 9.0
        if on_wall or point[0] == 50.0:
            assert along @ metric @ along == pytest.approx(0.05 if on_wall else 1.0)


def test_lines_are_fitted_to_the_twelve_nearest_points():
    points = np.random.default_rng(4).uniform(0.0, 6.0, (200, 2)) * (1.0, 0.1)
    settings = LocalMapSettings(cell_m=1e-3, line_radius_m=0.8, line_ratio=0.3)
    local_map = build_local_map([points], settings)
    distances, neighbours = cKDTree(points).query(local_map.cloud.points, 12)
    n_lines = 0
    for metric, near, rows in zip(local_map.metrics, distances < 0.8, neighbours, strict=True):
        (low, high), axes = np.linalg.eigh(np.cov(points[rows[near]].T, bias=True))
        is_line = near.sum() >= 5 and low < 0.3 * high
        n_lines += is_line
        np.testing.assert_allclose(
            metric, np.eye(2) - is_line * 0.95 * np.outer(axes[:, 1], axes[:, 1]), atol=1e-9
        )
    assert 20 < n_lines < 180


def test_robust_registration_reports_that_a_wall_leaves_one_direction_unconstrained():
    settings = LocalMapSettings()
    found = register_robust(wall()[20:-20], build_local_map([wall(seed=1)], settings), np.zeros(3), settings)
    assert found.converged and found.weakest_direction < 0.1
    cross = register_robust(street()[::2], build_local_map([street()], settings), np.zeros(3), settings)
    assert cross.weakest_direction > 0.3


@pytest.mark.parametrize("along_weight", [0.05, 1.0])
def test_robust_registration_withstands_more_false_points_than_true_ones(along_weight):
    rng, motion = np.random.default_rng(3), np.array([1.2, -0.4, 0.05])
    target, settings = street(), LocalMapSettings(along_weight=along_weight)
    source = transform_points(invert(motion), target)[::3] + rng.normal(0.0, 0.05, (len(target[::3]), 2))
    false = rng.uniform(-50.0, 50.0, (int(1.5 * len(source)), 2))
    result = register_robust(
        np.concatenate([false, source]), build_local_map([target], settings), np.zeros(3), settings
    )
    assert (np.abs(result.T_target_source - motion) < (0.04, 0.04, 0.003)).all()


def test_robust_registration_without_a_match_says_so():
    settings = LocalMapSettings()
    local_map = build_local_map([street()], settings)
    for cloud in (street() + 900.0, np.zeros((0, 2)), np.full((50, 2), 4.0)):
        result = register_robust(cloud, local_map, (0.1, 0.2, 0.0), settings)
        assert not result.converged
    with pytest.raises(OdometryError, match="source cloud: point 3 is not finite"):
        register_robust(
            np.where(np.arange(8)[:, None] == 3, np.nan, street()[:8]), local_map, np.zeros(3), settings
        )


def street() -> np.ndarray:
    """Corners of house fronts, walls and posts along two streets that cross, shape (n, 2) [m]."""
    rng = np.random.default_rng(11)
    walls = []
    for x in np.arange(-60.0, 160.0, 13.0):
        for side in (-1.0, 1.0):
            begin, aside = x + rng.uniform(-2.0, 2.0), side * rng.uniform(7.0, 12.0)
            front = begin + np.arange(0.0, rng.uniform(5.0, 10.0), 0.3)
            depth = aside + side * np.arange(0.0, 6.0, 0.3)
            walls += [np.column_stack([front, np.full_like(front, aside)])]
            walls += [np.column_stack([np.full_like(depth, begin), depth])]
    return np.concatenate([*walls, rng.uniform((-60.0, -14.0), (160.0, 14.0), (150, 2))])


class Drive:
    """A car on a winding way with changing speed, whose radar turns while it drives: the other way round from ours."""

    def __init__(self, n_scans: int = 40, first_s: float = 0.0) -> None:
        self.seconds = np.arange(0.0, 30.0, 1e-3)
        speed = 6.0 - 6.0 * np.cos(2.0 * np.pi * self.seconds / 14.0)  # 0 to 12 m/s
        self.velocity = np.column_stack([speed, 0.02 * speed * np.sin(self.seconds)])
        steps = np.column_stack([speed * 1e-3, np.zeros_like(speed), self.velocity[:, 1] * 1e-3])
        self.poses = accumulate_increments(steps[:-1])
        self.mid_s = 0.2 + first_s + SCAN_SECONDS * np.arange(n_scans)
        self.stamps_us = np.round(self.mid_s * 1e6).astype(np.int64)
        self.truth = self.at(self.mid_s)

    def at(self, seconds: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(seconds, self.seconds, column) for column in self.poses.T], axis=-1)

    def scan(self, mid_s: float, world: np.ndarray) -> np.ndarray:
        """Points as read: the moment of each is that at which the beam, clockwise from ahead, meets it."""
        moments = np.full(len(world), mid_s)
        for _ in range(6):
            x, y, yaw = self.at(moments).T
            dx, dy = world[:, 0] - x, world[:, 1] - y
            bearings = np.arctan2(dy, dx) - yaw
            moments = mid_s + (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * SCAN_SECONDS
        closing = np.interp(moments, self.seconds, self.velocity[:, 0]) * np.cos(bearings)
        ranges = np.hypot(dx, dy)
        read = ranges - DOPPLER_SECONDS * closing
        return np.column_stack([read * np.cos(bearings), read * np.sin(bearings)])[
            (3.0 < ranges) & (ranges < 50.0)
        ]

    def clouds(self, false_share: float, seed: int = 0) -> list[np.ndarray]:
        """One cloud a scan, 5 cm of noise, three quarters of the points each, and false ones among them."""
        rng, clouds = np.random.default_rng(seed), []
        for mid_s in self.mid_s:
            seen = self.scan(mid_s, street())
            seen = seen[rng.random(len(seen)) < 0.75]
            seen += rng.normal(0.0, 0.05, seen.shape)
            n_false = int(len(seen) * false_share / (1.0 - false_share))
            clouds.append(np.concatenate([seen, rng.uniform(-50.0, 50.0, (n_false, 2))]))
        return clouds

    def end_error(self, steps: np.ndarray) -> float:
        """How far the end is from the true one [m]."""
        end = accumulate_increments(steps, self.truth[0])[-1]
        return float(np.hypot(*(end - self.truth[-1])[:2]))


@pytest.mark.parametrize("false_share", [0.0, 0.5, 0.6])
def test_local_map_odometry_follows_a_car_through_false_points_motion_and_doppler(false_share):
    drive = Drive()
    results = list(local_map_odometry(drive.clouds(false_share), drive.stamps_us))
    assert [r.fault for r in results] == [""] * 39
    errors = pose_errors(steps_of(results), relative_pose(drive.truth[:-1], drive.truth[1:]))
    assert rmse(errors.position_m) < 0.12 and rmse(errors.yaw_rad) < np.deg2rad(0.3)
    assert drive.end_error(steps_of(results)) < 0.5  # of 71 m


def test_local_map_odometry_drifts_less_than_the_chain_of_the_paper_and_needs_its_correction():
    drive = Drive()
    clouds = drive.clouds(0.3)
    ours = steps_of(local_map_odometry(clouds, drive.stamps_us))
    plain = steps_of(local_map_odometry(clouds, drive.stamps_us, correct=None))
    paper = steps_of(chain(clouds))
    assert drive.end_error(ours) < 0.5 * min(drive.end_error(plain), drive.end_error(paper))


def test_clouds_that_are_corrected_already_need_no_correction():
    drive = Drive(12)
    twists = np.column_stack(
        [
            *(np.interp(drive.mid_s, drive.seconds, drive.velocity[:, 0]), np.zeros(12)),
            np.interp(drive.mid_s, drive.seconds, drive.velocity[:, 1]),
        ]
    )
    clouds = [correct_cloud(c, twist) for c, twist in zip(drive.clouds(0.3), twists, strict=True)]
    assert drive.end_error(steps_of(local_map_odometry(clouds, drive.stamps_us, correct=None))) < 0.2


def test_a_first_velocity_is_found_or_given():
    drive = Drive(8, first_s=5.0)  # 10 to 12 m/s from the first scan on
    clouds = drive.clouds(0.5)
    for first_twist in (None, (10.5, 0.0, 0.0)):
        results = list(local_map_odometry(clouds, drive.stamps_us, first_twist=first_twist))
        assert not any(r.fault for r in results)
        assert drive.end_error(steps_of(results)) < 0.4


@pytest.mark.parametrize("n_gone", [1, 5])
def test_empty_clouds_are_gone_over_at_constant_velocity_and_the_way_is_found_again(n_gone):
    drive = Drive()
    clouds = drive.clouds(0.5)
    clouds[20 : 20 + n_gone] = [np.zeros((0, 2))] * n_gone
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == list(range(19, 19 + n_gone))
    for result in results[19 : 19 + n_gone]:
        assert result.fault == "0 % of the points match" and result.match_share == 0.0
        np.testing.assert_allclose(result.T_target_source, results[18].T_target_source, atol=1e-9)
    assert drive.end_error(steps_of(results)) < 0.6


def test_the_local_map_begins_anew_when_nothing_has_matched_for_long():
    drive = Drive()
    clouds = drive.clouds(0.3)
    clouds[10:24] = [np.zeros((0, 2))] * 14  # 3.5 s
    results = list(local_map_odometry(clouds, drive.stamps_us))
    # the first cloud with points, scan 24, can only begin a map
    assert [i for i, r in enumerate(results) if r.fault] == list(range(9, 24))
    last = steps_of(results)[24:] - relative_pose(drive.truth[24:-1], drive.truth[25:])
    assert np.hypot(*last[:, :2].T).max() < 0.4


def test_clouds_without_points_at_the_start_are_waited_for():
    drive = Drive(8)
    clouds = drive.clouds(0.0)
    clouds[:3] = [np.zeros((0, 2))] * 3
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [bool(r.fault) for r in results] == [True] * 3 + [False] * 4


def test_motions_that_no_car_makes_are_not_believed():
    drive = Drive(20)
    clouds = drive.clouds(0.0)
    clouds[10] = transform_points((1.5, 0.0, 0.0), clouds[10])  # as if seen from 1.5 m farther back
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == [9]
    assert re.fullmatch(r"acceleration of \d\d m/s2", results[9].fault)
    assert drive.end_error(steps_of(results)) < 0.3
    narrow = LocalMapSettings(max_yaw_rate=0.05)
    faults = {r.fault for r in local_map_odometry(clouds, drive.stamps_us, narrow)}
    assert any(fault.startswith("yaw rate of ") and fault.endswith(" rad/s") for fault in faults)
    clouds = drive.clouds(0.0)
    clouds[10] = np.random.default_rng(6).uniform(-50.0, 50.0, clouds[10].shape)
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == [9]
    assert results[9].fault.endswith("% of the points match") and results[9].match_share < 0.2


def test_local_map_odometry_of_one_or_no_cloud_has_no_step():
    assert steps_of(local_map_odometry([posts()], [0])).shape == (0, 3)
    assert steps_of(local_map_odometry([], [])).shape == (0, 3)


@pytest.mark.parametrize(
    ("clouds", "stamps_us", "fault"),
    [
        ([posts()] * 3, [0, 250_000, 250_000], "stamps do not increase at index 2"),
        ([posts()] * 3, [[0, 1, 2]], r"stamps: expected shape \(m,\), got \(1, 3\)"),
        ([posts()] * 3, [0, 250_000], "2 stamps, but more clouds"),
        ([posts()] * 2, [0, 250_000, 500_000], "3 stamps for 2 clouds"),
        ([posts(), posts(), posts() * np.nan], [0, 250_000, 500_000], "cloud 2: point 0 is not finite"),
        (
            [posts(), np.zeros((5, 3))],
            [0, 250_000],
            r"cloud 1: expected points of shape \(n, 2\), got \(5, 3\)",
        ),
    ],
)
def test_local_map_odometry_refuses_what_is_no_drive(clouds, stamps_us, fault):
    with pytest.raises(OdometryError, match=fault):
        list(local_map_odometry(clouds, stamps_us))


# ---- on a map, without a filter --------------------------------------------------------------------------------


def test_follow_map_holds_the_pose_where_odometry_drifts():
    points, truth = posts(), np.array([(float(x), 0.0, 0.02) for x in range(-15, 15, 2)])
    steps = relative_pose(truth[:-1], truth[1:]) * (0.9, 1.0, 1.0)  # a tenth too short
    clouds = [transform_points(invert(pose), points)[::2] for pose in truth]
    results = list(follow_map(steps, clouds, points, truth[0]))
    poses = np.array([result.T_target_source for result in results])
    np.testing.assert_allclose(poses, truth, atol=0.05)
    assert all(result.converged for result in results)


def test_follow_map_registers_to_the_near_points_alone():
    rng, points = (
        np.random.default_rng(5),
        np.concatenate([posts(400), posts(400) + (60.0, 0.0), [[1e7, 0.0]]]),
    )
    poses = [(float(x), 0.5, 0.01) for x in (0, 9, 40, 107)]
    clouds = [transform_points(invert(pose), points)[:-1] + rng.normal(0.0, 0.1, (800, 2)) for pose in poses]
    steps = relative_pose(np.array(poses[:-1]), np.array(poses[1:]))
    results = list(follow_map(steps, clouds, points, poses[0], reach_m=20.0, max_points=700, min_share=0.05))
    guess = np.array(poses[0])
    for step, cloud, found in zip([*steps, np.zeros(3)], clouds, results, strict=True):
        near = points[np.hypot(*(points - guess[:2]).T) <= 20.0]
        expected = icp_2d(cloud, near, guess, max_points=700)
        assert found.converged == expected.converged and found.n_matched == expected.n_matched
        if found.converged:
            np.testing.assert_allclose(found.T_target_source, expected.T_target_source, rtol=0.0, atol=1e-12)
        guess = compose(found.T_target_source, step)
    assert [found.converged for found in results] == [True, True, True, False]
    assert 0 < len(near) < 10 and results[-1].n_matched == 0  # too few to register to


def test_follow_map_goes_on_by_the_step_without_points_and_begins_again_where_it_is_set():
    nothing = np.zeros((0, 2))

    def supervisor(index, pose):
        return (20.0, 0.0, 0.0) if index == 1 else None

    steps = [(1.0, 0.0, 0.0)] * 2
    results = follow_map(steps, [nothing] * 3, posts(), (0.0, 0.0, 0.0), supervisor)
    ahead = [result.T_target_source[0] for result in results]
    np.testing.assert_allclose(ahead, [0.0, 1.0, 21.0])


def test_follow_map_does_not_believe_what_hardly_matches():
    rng, false = np.random.default_rng(1), np.random.default_rng(2)
    cloud = np.concatenate([posts()[:30], false.uniform(100.0, 140.0, (300, 2))])
    (result,) = follow_map([], [cloud], posts(), rng.normal(0.0, 0.3, 3) * (1.0, 1.0, 0.0), reach_m=60.0)
    assert not result.converged and result.n_matched < 0.2 * len(cloud)


def test_follow_map_asks_for_a_step_to_each_cloud_and_for_a_map():
    with pytest.raises(OdometryError, match="no odometry step to scan 1"):
        list(follow_map([], [np.zeros((0, 2))] * 2, posts(), np.zeros(3)))
    with pytest.raises(OdometryError, match="map: expected points"):
        list(follow_map([], [np.zeros((0, 2))], np.zeros((3, 3)), np.zeros(3)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_distance", 0.0), ("max_distance", np.nan), ("min_distance", -1.0), ("trim", 0.0), ("trim", 1.5),
        ("tolerance", -1.0), ("max_iterations", 0), ("min_matched", 0), ("max_points", 2.5),
    ],
)  # fmt: skip
def test_icp_refuses_settings_out_of_range(name: str, value: float):
    with pytest.raises(OdometryError, match=f"{name}: {value} is not"):
        icp_2d(posts(), posts(), **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [("reach", (-1.0, 1.0, 0.1)), ("reach", (1e6, 1.0, 0.1)), ("cell", 0), ("max_points", 0)],
)
def test_search_refuses_settings_out_of_range(name: str, value: float):
    with pytest.raises(OdometryError, match=f"{name}: .* is not"):
        search_motion(posts(), posts(), **{name: value})
