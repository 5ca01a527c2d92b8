"""Global search of a pose: merging and filtering of clouds, score contrast, and a hidden pose."""

from itertools import pairwise

import numpy as np
import pytest

from rol.geometry import compose, invert, transform_points
from rol_beyond.likelihood_field import build_likelihood_field
from rol_beyond.search import (
    CorrelationGrid,
    SearchSettings,
    _find_peaks,
    merge_clouds,
    remove_ego_static_points,
    score_contrast,
    search_poses,
)


def town(rng: np.random.Generator) -> np.ndarray:
    """Walls of all lengths along both axes within 150 m [m]."""
    walls = []
    for _ in range(120):
        start, length = rng.uniform(-150.0, 150.0, 2), rng.uniform(4.0, 25.0)
        along = np.arange(0.0, length, 0.25)
        walls.append(start + np.column_stack([along, 0 * along])[:, :: rng.choice([-1, 1])])
    return np.concatenate(walls)


def look(points: np.ndarray, pose: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Some points within 40 m as seen from a pose, with as many false ones."""
    cloud = transform_points(invert(pose), points)
    cloud = cloud[np.hypot(*cloud.T) < 40.0]
    cloud = cloud[rng.integers(len(cloud), size=n)] + rng.normal(0.0, 0.1, (n, 2))
    return np.concatenate([cloud, rng.uniform(-28.0, 28.0, (n, 2))])


def test_clouds_are_merged_in_the_frame_of_the_last() -> None:
    point, poses = np.array([[7.0, 2.0]]), np.array([[0.0, 0.0, 0.1], [1.0, 0.2, 0.3], [2.0, 0.9, 0.6]])
    clouds = [transform_points(invert(pose), point) for pose in poses]
    steps = [compose(invert(a), b) for a, b in pairwise(poses)]
    np.testing.assert_allclose(merge_clouds(clouds, steps), np.repeat(clouds[-1], 3, axis=0), atol=1e-12)


def test_ego_static_points_are_removed_only_while_the_vehicle_moves() -> None:
    rng = np.random.default_rng(1)
    fixed, others = np.array([[5.0, 5.0]]), [rng.uniform(-40.0, 40.0, (20, 2)) for _ in range(6)]
    clouds = [np.concatenate([fixed, other]) for other in others]
    kept = remove_ego_static_points(clouds, [np.array([1.0, 0.0, 0.0])] * 5)
    assert all(not (cloud == fixed).all(axis=1).any() for cloud in kept)
    assert sum(map(len, kept)) >= 6 * 20 - 3  # hardly one of the others
    standing = remove_ego_static_points(clouds, [np.zeros(3)] * 5)
    assert [len(cloud) for cloud in standing] == [21] * 6


def test_score_contrast_is_zero_by_chance_and_large_at_the_correct_pose() -> None:
    rng = np.random.default_rng(2)
    points, pose = town(rng), np.array([3.0, -8.0, 0.7])
    grid = build_likelihood_field(points)
    cloud = look(points, pose, 200, rng)
    right, wrong = score_contrast(np.array([pose, pose + (9.0, 4.0, 0.4)]), cloud, grid)
    assert right > 0.25 and abs(wrong) < 0.1
    assert score_contrast(pose[None], np.zeros((0, 2)), grid).tolist() == [0.0]


def test_correlation_agrees_with_counting() -> None:
    rng = np.random.default_rng(3)
    points = town(rng)
    grid = build_likelihood_field(points, 0.5, 0.5)
    cloud = np.round(look(points, np.zeros(3), 100, rng) / 0.5) * 0.5  # on cells, so that nothing is rounded
    correlation = CorrelationGrid(cloud, grid, np.zeros(2), 6.0)
    fit = correlation.contrast(0.0) + correlation.chance
    places = correlation.position(np.argwhere(np.ones_like(fit)))
    shifted = np.floor((places[:, None] + cloud - grid.origin) / 0.5 + 1e-6).astype(int)
    expected = grid.values[shifted[..., 0], shifted[..., 1]].mean(axis=1) / 255.0
    np.testing.assert_allclose(fit.ravel(), expected, atol=1e-4)


@pytest.mark.parametrize(("coarse_cell", "reach_yaw"), [(0.25, np.deg2rad(30.0)), (1.0, np.pi)])
def test_a_hidden_pose_is_found(coarse_cell: float, reach_yaw: float) -> None:
    rng = np.random.default_rng(4)
    points, pose = town(rng), np.array([12.0, -20.0, 0.9])
    fine, coarse = (
        build_likelihood_field(points),
        build_likelihood_field(points, max(0.2, 0.45 * coarse_cell), coarse_cell),
    )
    cloud = look(points, pose, 400, rng)
    poses, contrast = search_poses(
        cloud,
        coarse,
        fine,
        pose + (15.0, -9.0, -0.3),
        SearchSettings(30.0, reach_yaw, yaw_step=np.deg2rad(2.0), n_refined=400),
    )
    assert (np.diff(contrast) <= 0.0).all()
    off = np.abs(poses[0] - pose)
    assert np.hypot(off[0], off[1]) < 0.6 and off[2] < np.deg2rad(2.0)
    gaps = np.abs(poses[:, None] - poses[None]) + np.eye(len(poses))[..., None] * 9.0
    assert ((gaps[..., :2] >= 2.0).any(axis=-1) | (gaps[..., 2] >= np.deg2rad(6.0))).all()


def test_nothing_is_found_from_nothing() -> None:
    grid = build_likelihood_field(np.array([[0.0, 0.0]]))
    poses, contrast = search_poses(np.zeros((0, 2)), grid, grid, np.zeros(3), SearchSettings(10.0))
    assert poses.shape == (0, 3) and contrast.shape == (0,)
    with pytest.raises(ValueError, match="centre of the search"):
        search_poses(np.zeros((1, 2)), grid, grid, np.array([0.0, np.nan, 0.0]), SearchSettings(10.0))


@pytest.mark.parametrize(("size", "n", "block"), [(41, 30, 2), (41, 10, 8), (7, 100, 3)])
@pytest.mark.parametrize("n_levels", [3, 10**6])  # with few levels many blocks are equally high
def test_peaks_are_the_highest_of_the_block_maxima(size: int, n: int, block: int, n_levels: int) -> None:
    values = np.random.default_rng(4).integers(-n_levels, n_levels, (size, size)).astype(np.float32)
    cells, heights = _find_peaks(values, n, block)
    corners = [(i, j) for i in range(0, size, block) for j in range(0, size, block)]
    maxima = np.array([values[i : i + block, j : j + block].max() for i, j in corners])
    order = np.argsort(-maxima, kind="stable")[:n]
    np.testing.assert_array_equal(heights, maxima[order])
    np.testing.assert_array_equal(values[cells[:, 0], cells[:, 1]], heights)
    np.testing.assert_array_equal(cells // block * block, np.array(corners)[order])
