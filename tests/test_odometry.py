"""Registration of clouds against closed forms and oracles."""

import numpy as np
import pytest

from rol.geometry import accumulate_steps, invert, relative_pose, transform_points
from rol.odometry import OdometryError, chain, fit_rigid, icp_2d, search_motion, steps_of


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
    poses, world = accumulate_steps(steps), posts()
    clouds = [transform_points(invert(pose), world) for pose in poses]
    found = steps_of(chain(clouds))
    np.testing.assert_allclose(found, steps, atol=0.01)
    assert np.abs(icp_2d(clouds[-1], clouds[-2]).T_target_source - steps[-1]).max() > 0.5


def test_chain_goes_on_through_an_empty_cloud():
    world, poses = posts(), accumulate_steps(np.tile((0.5, 0.0, 0.0), (4, 1)))
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
