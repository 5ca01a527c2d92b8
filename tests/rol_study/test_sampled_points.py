"""Points of given precision sampled from a map: visible cells, mixture of kinds, resulting fractions."""

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol_study.sampled_points import (
    DenseMapError,
    FrontEnd,
    SampledPointsError,
    find_visible_points,
    fraction_within_2m,
    sample_points,
    solve_mixture,
)

WALL = np.column_stack([np.full(160, 10.125), np.arange(-20.0, 20.0, 0.25) + 0.125])
SECOND, THIRD = WALL + (5.0, 0.0), WALL + (10.0, 0.0)
STREETS = np.concatenate([WALL, WALL - (25.0, 0.0), np.random.default_rng(0).uniform(-60, 60, (150, 2))])


def test_a_beam_is_spent_after_so_many_surfaces() -> None:
    pose = np.array([[0.0, 0.0, 0.0]])
    for n_surfaces, seen in ((1, {10}), (2, {10, 15}), (3, {10, 15, 20})):
        visible = find_visible_points(np.concatenate([WALL, SECOND, THIRD]), pose, n_surfaces=n_surfaces)
        assert set(np.floor(visible[0][:, 0]).astype(int)) == seen


def test_what_is_seen_is_in_the_frame_of_the_radar_and_within_its_reach() -> None:
    pose = np.array([[3.0, 4.0, np.pi / 2.0]])  # looks along the wall, which is to its right
    visible = find_visible_points(WALL, pose, max_range_m=15.0)
    placed = transform_points(pose[0], visible[0])
    assert np.abs(placed[:, 0] - 10.125).max() < 0.02 and np.hypot(*visible[0].T).max() < 15.3
    assert (visible[0][:, 1] < 0).all() and len(np.unique(visible.points, axis=0)) == len(visible.points)
    nothing = find_visible_points(WALL, np.array([[500.0, 0.0, 0.0], *pose]))
    assert len(nothing) == 2 and len(nothing[0]) == 0 and len(nothing[1]) > 50


def test_mixture_has_the_given_fractions() -> None:
    fractions = np.array([[1.0, 0.0, 0.3], [1.0, 1.0, 0.5]])
    mixture = solve_mixture(fractions, 0.4, 0.6)
    # 0.16 + 0.3 * 0.8 = 0.4, and 0.16 + 0.04 + 0.5 * 0.8 = 0.6
    np.testing.assert_allclose(mixture, [0.16, 0.04, 0.8])
    fractions[0, 0] = 0.9
    words = "0.95 within 1 m and 0.99 within 2 m here: it would need near 1.05, beside -0.07, false 0.02"
    with pytest.raises(SampledPointsError, match=words) as caught:
        solve_mixture(fractions, 0.95, 0.99)
    assert not isinstance(caught.value, DenseMapError)


@pytest.mark.parametrize(
    ("asked", "least_2m"),
    [((0.1, 0.2), np.nan), ((0.25, 0.45), np.nan), ((0.4, 0.49), 0.571), ((0.9, 0.91), 0.929)],
)
def test_a_map_that_is_too_dense_is_named_with_its_chance(
    asked: tuple[float, float], least_2m: float
) -> None:
    fractions = np.array([[1.0, 0.0, 0.3], [1.0, 1.0, 0.5]])
    words = f"too dense for points with {asked[0]:.2f} within 1 m and {asked[1]:.2f} within 2 m: by chance 0.30 and 0.50"
    with pytest.raises(DenseMapError, match=words) as caught:
        solve_mixture(fractions, *asked)
    copy = pickle.loads(pickle.dumps(caught.value))  # as a worker process hands it on
    assert (copy.chance_1m, copy.chance_2m) == (0.3, 0.5) and str(copy) == str(caught.value)
    assert copy.least_2m == pytest.approx(least_2m, abs=1e-3, nan_ok=True)
    if np.isfinite(least_2m):
        mixture = solve_mixture(fractions, asked[0], copy.least_2m + 1e-9)
        assert mixture[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("fraction_1m", "fraction_2m"), [(0.4, 0.6), (0.8, 0.9)])
def test_sampled_points_have_the_given_fractions(fraction_1m: float, fraction_2m: float) -> None:
    poses = np.column_stack([np.linspace(-5, 5, 40), np.zeros(40), np.linspace(0, 1, 40)])
    front_end = FrontEnd(fraction_1m, fraction_2m, n_points=300)
    visible, rng = find_visible_points(STREETS, poses), np.random.default_rng(1)
    clouds = list(sample_points(STREETS, poses, visible, front_end, rng))
    tree = cKDTree(STREETS)
    away = [tree.query(transform_points(p, c))[0] for p, c in zip(poses, clouds, strict=True)]
    fractions = [[np.mean(d < radius) for d in away] for radius in (1.0, 2.0)]
    np.testing.assert_allclose(np.mean(fractions, axis=1), [fraction_1m, fraction_2m], atol=0.04)
    assert np.abs([len(c) for c in clouds] - np.float64(300)).max() < 60


def test_same_seed_same_clouds() -> None:
    poses = np.zeros((3, 3))
    visible = find_visible_points(STREETS, poses)
    first, again = (
        list(sample_points(STREETS, poses, visible, FrontEnd(), np.random.default_rng(5))) for _ in range(2)
    )
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_false_points_last_as_long_as_stated() -> None:
    poses, far = np.zeros((200, 3)), np.array([[300.0, 0.0], [300.0, 60.0]])
    front_end = FrontEnd(n_points=200, persistent_fraction=1.0, life_scans=5.0)
    from rol_study.sampled_points import _renew

    rng, points, stayed = np.random.default_rng(6), np.zeros((0, 2)), []
    for pose in poses:
        before = {tuple(p) for p in points}
        points = _renew(points, pose, 100, front_end, rng)
        assert len(points) == 100
        stayed.append(len(before & {tuple(p) for p in points}))
    assert np.mean(stayed[10:]) == pytest.approx(80.0, abs=3.0)  # four of five go on
    assert len(find_visible_points(far, poses[:1])[0]) == 0


def test_an_empty_or_invisible_map_is_refused() -> None:
    with pytest.raises(SampledPointsError, match="holds no point"):
        find_visible_points(np.zeros((0, 2)), np.zeros((1, 3)))
    poses = np.zeros((2, 3))
    with pytest.raises(SampledPointsError, match="nothing of the map is visible"):
        next(
            sample_points(
                WALL + (900.0, 0.0),
                poses,
                find_visible_points(WALL + (900.0, 0.0), poses),
                FrontEnd(),
                np.random.default_rng(0),
            )
        )


def test_points_near_the_map_are_as_real_front_ends_have_them() -> None:
    assert [fraction_within_2m(value) for value in (0.40, 0.70, 1.0)] == [0.60, 0.80, 1.0]
    assert abs(fraction_within_2m(0.80) - 0.85) < 0.03
