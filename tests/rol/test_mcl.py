"""The filter's pieces, each with numbers worked out by hand or against a slow oracle."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from rol import mcl
from rol.geometry import transform_points

# 5 x 5 cells of 1 m: a wall along x = 2.5 (row 2) and a post at (4.5, 0.5); first axis x, second axis y
MATCHED = np.array(
    [[0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=np.uint8
)
CLOUD = np.array([[2.0, 0.0], [2.0, 1.0], [4.0, -2.0]])  # two wall points ahead, the post ahead to the right
ORIGIN = np.zeros(2)


def count_on(particles, points, values, origin, cell):
    """Count matches on a grid given by its fields."""
    return mcl.count_matches(particles, points, mcl.MapGrid(values, origin, cell))


class TopOfRange:
    """A generator whose draws are the largest number below one: where cumulative sums round."""

    def random(self, size=None):
        return np.nextafter(1.0, 0.0) if size is None else np.full(size, np.nextafter(1.0, 0.0))


@pytest.mark.parametrize(
    ("particle", "count"),
    [
        ((0.5, 2.5, 0.0), 3),  # wall, wall, post
        ((1.5, 2.5, 0.0), 0),  # 1 m too far: all in empty cells or outside
        ((0.5, 1.5, 0.0), 2),  # 1 m to the right: the post's point leaves the grid
        ((2.5, 0.5, np.pi / 2), 1),  # facing along y: the points fall on (2.5, 2.5), (1.5, 2.5), (4.5, 4.5)
        ((4.5, 2.5, np.pi), 2),  # from the other side: the post's point falls on (0.5, 4.5)
        ((100.0, 100.0, 0.0), 0),
    ],
)
def test_count_matches_by_hand(particle, count):
    got = count_on(np.array([particle]), CLOUD, MATCHED, ORIGIN, 1.0)
    assert got.tolist() == [count]
    assert got.dtype == np.int64


@pytest.mark.parametrize("move", [(10.0, -3.0, 0.0), (0.0, 0.0, 0.25)])
def test_count_matches_moves_with_the_map(move):
    # the same map elsewhere, or finer cells of the same map: the same counts
    finer = np.kron(MATCHED, np.ones((4, 4), dtype=np.uint8)) if move[2] else MATCHED
    cell, shift = (0.25 if move[2] else 1.0), np.array([*move[:2], 0.0])
    particles = np.array([[0.5, 2.5, 0.0], [0.5, 1.5, 0.0], [4.5, 2.5, np.pi]]) + shift
    got = count_on(particles, CLOUD, finer.astype(bool), shift[:2], cell)
    assert got.tolist() == [3, 2, 2]


def test_count_matches_agrees_with_a_slow_loop():
    rng = np.random.default_rng(1)
    matched, origin, cell = rng.random((40, 60)) < 0.3, np.array([-3.0, 7.0]), 0.3
    particles = rng.uniform((-5, 5, -4), (12, 28, 4), (50, 3))
    points = rng.uniform(-6, 6, (30, 2))
    expected = []
    for particle in particles:
        cells = np.floor((transform_points(particle, points) - origin) / cell).astype(int)
        expected.append(sum(bool(0 <= i < 40 and 0 <= j < 60 and matched[i, j]) for i, j in cells))
    assert count_on(particles, points, matched, origin, cell).tolist() == expected


def test_count_matches_refuses_other_grids_and_bad_points():
    with pytest.raises(mcl.MclError, match="2D values of bool or uint8, got 2D of float64"):
        count_on(np.zeros((1, 3)), CLOUD, MATCHED.astype(float), ORIGIN, 1.0)
    with pytest.raises(mcl.MclError, match="cloud: point 0 is not finite"):
        count_on(np.zeros((1, 3)), np.array([[np.nan, 0.0]]), MATCHED, ORIGIN, 1.0)
    with pytest.raises(mcl.MclError, match=r"cloud: expected points of shape \(n, 2\)"):
        count_on(np.zeros((1, 3)), np.zeros((4, 3)), MATCHED, ORIGIN, 1.0)
    with pytest.raises(ValueError, match="particles: value at index"):
        count_on(np.full((1, 3), np.nan), CLOUD, MATCHED, ORIGIN, 1.0)


def test_matched_grid_agrees_with_scipy():
    rng = np.random.default_rng(2)
    points = rng.uniform(-5, 9, (40, 2))
    grid = mcl.build_matched_grid(points, d_th=0.9, cell=0.25)
    centres = grid.origin + (np.stack(np.indices(grid.values.shape), axis=-1) + 0.5) * 0.25
    np.testing.assert_array_equal(grid.values, cKDTree(points).query(centres)[0] < 0.9)
    # points on cell centres: the exact distance transform of the occupied cells says the same
    points = (rng.integers(0, 30, (25, 2)) + 0.5) * 0.25
    grid = mcl.build_matched_grid(points, d_th=0.9, cell=0.25)
    is_free = np.ones(grid.values.shape, dtype=bool)
    is_free[tuple(np.floor((points - grid.origin) / 0.25).astype(int).T)] = False
    np.testing.assert_array_equal(grid.values, 0.25 * distance_transform_edt(is_free) < 0.9)


def test_grids_hold_every_matched_place():
    # beyond the grid nothing is within reach: a point just inside the threshold is still in the grid
    point = np.array([[3.3, -7.1]])
    grid = mcl.build_matched_grid(point, d_th=0.5, cell=0.125)
    inside = np.array([[3.3 + 0.4, -7.1, 0.0], [3.3 - 0.4, -7.1, 0.0], [3.3, -6.7, 0.0], [3.3, -7.5, 0.0]])
    assert count_on(inside, np.zeros((1, 2)), grid.values, grid.origin, grid.cell).tolist() == [1] * 4


def test_matched_grid_uses_a_strict_threshold():
    # one point in a cell's centre, threshold one cell: the four neighbours at d_th are not matched (Eq. 9)
    grid = mcl.build_matched_grid(np.array([[0.5, 0.5]]), d_th=1.0, cell=1.0)
    assert grid.values.sum() == 1
    assert mcl.build_matched_grid(np.array([[0.5, 0.5]]), d_th=1.01, cell=1.0).values.sum() == 5


def test_an_empty_map_is_an_error():
    with pytest.raises(mcl.MclError, match="the map holds no point"):
        mcl.build_matched_grid(np.zeros((0, 2)))
    with pytest.raises(mcl.MclError, match="map: point 0 is not finite"):
        mcl.build_matched_grid(np.array([[np.inf, 0.0]]))


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ((2.0, 0.0, 0.0), (1.0, 4.0, np.pi / 2)),  # straight on, facing along y
        ((0.0, 0.0, np.pi / 2), (1.0, 2.0, -np.pi)),  # turn on the spot
        ((2.0, 1.0, -np.pi / 2), (0.0, 4.0, 0.0)),  # turn and go
    ],
)
def test_predict_without_noise(step, expected):
    quiet = mcl.MotionNoise(0, 0, 0, 0, 0)
    moved = mcl.predict(np.array([[1.0, 2.0, np.pi / 2]]), step, quiet, np.random.default_rng(0))
    np.testing.assert_allclose(moved, [expected], atol=1e-12)


def test_predict_spreads_as_stated():
    noise = mcl.MotionNoise(forward_m=0.1, left_m=0.05, yaw_rad=0.01, per_m=0.03, yaw_per_rad=0.1)
    moved = mcl.predict(np.zeros((40_000, 3)), (2.0, 0.0, 0.2), noise, np.random.default_rng(4))
    np.testing.assert_allclose(moved.mean(axis=0), (2.0, 0.0, 0.2), atol=3e-3)
    np.testing.assert_allclose(moved.std(axis=0), (0.16, 0.11, 0.03), rtol=0.02)
    with pytest.raises(ValueError, match="odometry increment"):
        mcl.predict(np.zeros((3, 3)), (np.nan, 0.0, 0.0), noise, np.random.default_rng(4))


def test_sample_particles():
    particles = mcl.sample_particles((1.0, 2.0, 3.1), 20_000, 0.5, 0.1, np.random.default_rng(5))
    np.testing.assert_allclose(particles[:, :2].mean(axis=0), (1.0, 2.0), atol=0.02)
    np.testing.assert_allclose(particles[:, :2].std(axis=0), 0.5, rtol=0.03)
    assert particles[:, 2].min() >= -np.pi and particles[:, 2].max() < np.pi
    with pytest.raises(mcl.MclError, match="at least one particle"):
        mcl.sample_particles((0.0, 0.0, 0.0), 0, 0.5, 0.1, np.random.default_rng(5))


def test_weights_by_hand():
    # N = 1, 2, 3 and lambda = 2: weights 1, 4, 9 of 14
    weights, measurement_used = mcl.normalize_weights(mcl.log_weights(np.array([1, 2, 3]), 2.0))
    np.testing.assert_allclose(weights, [1 / 14, 4 / 14, 9 / 14])
    assert measurement_used
    # a prior of 1/2, 1/4, 1/4 turns them into 2, 4, 9 of 15
    weights, _ = mcl.normalize_weights(mcl.log_weights(np.array([1, 2, 3]), 2.0), np.array([0.5, 0.25, 0.25]))
    np.testing.assert_allclose(weights, [2 / 15, 4 / 15, 9 / 15])


def test_weights_beyond_floats():
    # 2000^400 overflows and (1/2)^400 of it underflows no sum
    weights, _ = mcl.normalize_weights(mcl.log_weights(np.array([2000, 1000, 0, 2000]), 400.0))
    np.testing.assert_allclose(weights, [0.5, 0.0, 0.0, 0.5], atol=1e-100)


def test_zero_total_weight_leaves_the_weights_as_they_were():
    prior = np.array([0.2, 0.8])
    weights, measurement_used = mcl.normalize_weights(mcl.log_weights(np.array([0, 0]), 2.0), prior)
    np.testing.assert_array_equal(weights, prior)
    assert not measurement_used
    weights, _ = mcl.normalize_weights(np.full(4, -np.inf))
    np.testing.assert_array_equal(weights, 0.25)
    # likewise when only particles of no prior weight match
    weights, measurement_used = mcl.normalize_weights(np.array([0.0, -np.inf]), np.array([0.0, 1.0]))
    assert weights.tolist() == [0.0, 1.0] and not measurement_used


def test_bad_weights_are_refused():
    with pytest.raises(mcl.MclError, match="counts must be"):
        mcl.log_weights(np.array([1.0, np.nan]), 2.0)
    with pytest.raises(mcl.MclError, match="counts must be"):
        mcl.log_weights(np.array([-1]), 2.0)
    with pytest.raises(mcl.MclError, match="exponent must be above zero"):
        mcl.log_weights(np.array([1]), 0.0)
    with pytest.raises(mcl.MclError, match="log-weights must not be NaN"):
        mcl.normalize_weights(np.array([0.0, np.nan]))
    for weights, fault in (
        ([np.nan, 1.0], "finite"),
        ([-0.5, 1.5], "negative"),
        ([0.0, 0.0], "all weights are zero"),
    ):
        with pytest.raises(mcl.MclError, match=fault):
            mcl.resample_multinomial(np.array(weights), np.random.default_rng(0))
    with pytest.raises(mcl.MclError, match="expected shape"):
        mcl.effective_sample_size(np.zeros(0))


@pytest.mark.parametrize(
    ("weights", "ess"),
    [([0.25] * 4, 4.0), ([1.0, 0.0, 0.0], 1.0), ([5.0, 5.0], 2.0), ([0.5, 0.25, 0.25], 1 / 0.375)],
)
def test_effective_sample_size(weights, ess):
    assert mcl.effective_sample_size(np.array(weights)) == pytest.approx(ess)


def test_resampling_copies_each_particle_in_proportion_to_its_weight():
    rng, weights, runs = np.random.default_rng(6), np.array([0.45, 0.35, 0.0, 0.15, 0.05]), 20_000
    copies = np.array([np.bincount(mcl.resample_multinomial(weights, rng), minlength=5) for _ in range(runs)])
    assert (copies.sum(axis=1) == 5).all() and (copies[:, 2] == 0).all()
    np.testing.assert_allclose(copies.mean(axis=0), 5 * weights, atol=0.03)  # sd of the mean below 0.01


def test_resampling_when_the_cumulative_sum_rounds_below_the_draw():
    weights = np.append(np.full(7, 1 / 7), 0.0)  # the running sum is 0.9999999999999998
    assert np.cumsum(weights / weights.sum())[-1] < np.nextafter(1.0, 0.0)
    indices = mcl.resample_multinomial(weights, TopOfRange())
    assert indices.max() == 6  # the last particle with weight, not the one without, not one past the end


def test_estimate_pose():
    particles = np.array([[0.0, 0.0, np.pi - 0.1], [2.0, 0.0, -np.pi + 0.1]])
    pose, spread_m, spread_yaw = mcl.estimate_pose(particles, np.array([0.5, 0.5]))
    np.testing.assert_allclose(pose, [1.0, 0.0, -np.pi], atol=1e-12)  # the mean heading is west, not east
    assert spread_m == pytest.approx(1.0) and spread_yaw == pytest.approx(0.1)
    pose, _, _ = mcl.estimate_pose(particles, np.array([3.0, 1.0]))
    np.testing.assert_allclose(pose[:2], [0.5, 0.0])
    opposite = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -np.pi]])
    assert (
        mcl.estimate_pose(opposite, np.array([0.5, 0.5]))[0][2] == 0.0
    )  # no mean direction: the first heaviest


def wall_filter(clouds, increments, **changes):
    """Run the filter along a straight wall with a corner, from the origin."""
    points = np.stack([np.arange(0.0, 40.0, 0.25), np.full(160, 5.0)], axis=1)
    points = np.concatenate([points, np.stack([np.full(20, 40.0), np.arange(0.0, 5.0, 0.25)], axis=1)])
    settings = mcl.MclSettings(n_particles=200, **changes)
    grid = settings.measurement.build_grid(points)
    particle_filter = mcl.ParticleFilter(grid, (30.0, 0.0, 0.0), settings, np.random.default_rng(8))
    return points, list(mcl.localize(particle_filter, increments, clouds))


def test_scan_without_points_leaves_the_particles_to_the_motion_model():
    _, updates = wall_filter([np.zeros((0, 2))] * 4, [(1.0, 0.0, 0.0)] * 3)
    np.testing.assert_allclose(updates[-1].pose, (33.0, 0.0, 0.0), atol=0.15)
    spreads = [u.spread_m for u in updates]
    assert spreads == sorted(spreads)
    for u in updates:
        assert not u.measurement_used and u.inlier_ratio == 0.0 and u.ess == pytest.approx(200)
        np.testing.assert_array_equal(u.next_particles, u.particles)


def test_scan_that_fits_nowhere_leaves_the_particles_to_the_motion_model():
    _, updates = wall_filter([np.array([[0.0, -500.0]])] * 2, [(1.0, 0.0, 0.0)])
    assert [u.measurement_used for u in updates] == [False, False]
    np.testing.assert_array_equal(updates[1].next_particles, updates[1].particles)


def test_update_pulls_the_particles_to_the_corner():
    truth = np.array([30.5, 0.4, 0.01])
    points, _ = wall_filter([], [])
    cloud = transform_points((-truth[0], -truth[1], 0.0), points)
    cloud = transform_points((0.0, 0.0, -truth[2]), cloud)
    _, updates = wall_filter([cloud] * 6, [(0.0, 0.0, 0.0)] * 5)
    assert np.hypot(*(updates[-1].pose - truth)[:2]) < 0.2
    assert updates[-1].spread_m < updates[0].spread_m or updates[-1].spread_m < 0.3
    assert updates[-1].inlier_ratio > 0.8
    assert all(u.next_weights.sum() == pytest.approx(1.0) for u in updates)


def test_weights_are_equal_after_resampling_and_kept_without():
    points, _ = wall_filter([], [])
    _, (plain,) = wall_filter([points - (30.0, 0.0)], [])
    np.testing.assert_allclose(plain.next_weights, 1 / 200)
    assert plain.ess < 200
    _, (lazy,) = wall_filter([points - (30.0, 0.0)], [], resampling=mcl.Resampling(ess_fraction=0.01))
    np.testing.assert_array_equal(lazy.next_weights, lazy.weights)
    np.testing.assert_array_equal(lazy.next_particles, lazy.particles)


def test_reset_callback_restarts_the_particles():
    calls = []

    def reset_callback(index, pose):
        calls.append(index)
        return (10.0, 0.0, 0.0) if index == 1 else None

    points, _ = wall_filter([], [])
    settings = mcl.MclSettings(n_particles=50)
    grid, rng = settings.measurement.build_grid(points), np.random.default_rng(9)
    particle_filter = mcl.ParticleFilter(grid, (30.0, 0.0, 0.0), settings, rng)
    clouds, increments = [np.zeros((0, 2))] * 3, [(0.0, 0.0, 0.0)] * 2
    updates = mcl.localize(particle_filter, increments, clouds, reset_callback)
    poses = np.array([u.pose for u in updates])
    assert calls == [0, 1, 2]
    np.testing.assert_allclose(poses[:, 0], (30.0, 30.0, 10.0), atol=0.4)


def test_localize_is_online():
    # each estimate is there before the next cloud or step is asked for
    given = []

    def clouds():
        for k in range(3):
            given.append(k)
            yield np.zeros((0, 2))

    settings = mcl.MclSettings(n_particles=10)
    grid, rng = settings.measurement.build_grid(CLOUD), np.random.default_rng(0)
    particle_filter = mcl.ParticleFilter(grid, (0.0, 0.0, 0.0), settings, rng)
    updates = mcl.localize(particle_filter, iter([(1.0, 0.0, 0.0)] * 2), clouds())
    assert next(updates).pose[0] < 0.5 and given == [0]
    assert next(updates).pose[0] > 0.5 and given == [0, 1]


def test_more_clouds_than_increments_is_an_error():
    with pytest.raises(mcl.MclError, match="no odometry increment for scan 2"):
        wall_filter([np.zeros((0, 2))] * 3, [(0.0, 0.0, 0.0)])


def test_defaults_are_the_documented_ones():
    # a changed default must be argued in the docstring again
    settings, measurement = mcl.MclSettings(), mcl.Measurement()
    assert f"start. {settings.n_particles}:" in mcl.MclSettings.__doc__
    assert f"lambda of Eq. 8. {measurement.exponent:.0f}:" in mcl.Measurement.__doc__
    assert f"[m]. {measurement.d_th_m:.1f}:" in mcl.Measurement.__doc__


def count_plainly(particles, points, values, origin, cell):
    """Sum the values under the points in plain NumPy, all pairs at once."""
    c, s = np.cos(particles[:, 2:]), np.sin(particles[:, 2:])
    x = particles[:, :1] + c * points[:, 0] - s * points[:, 1]
    y = particles[:, 1:2] + s * points[:, 0] + c * points[:, 1]
    i, j = np.floor((x - origin[0]) / cell).astype(int), np.floor((y - origin[1]) / cell).astype(int)
    is_inside = (i >= 0) & (i < values.shape[0]) & (j >= 0) & (j < values.shape[1])
    return np.sum(np.where(is_inside, values[i * is_inside, j * is_inside], 0), axis=1, dtype=np.int64)


@pytest.mark.parametrize("n", [1, 3, 200])
@pytest.mark.parametrize("m", [0, 1, 7, 333])
@pytest.mark.parametrize("middle", [0.0, 60.0, 500.0])  # amid the grid, about its corner, far outside
def test_count_matches_equals_plain_numpy(n, m, middle):
    rng = np.random.default_rng([n, m, int(middle)])
    values, origin, cell = rng.integers(0, 256, (470, 510), dtype=np.uint8), np.array([-59.0, -63.0]), 0.25
    values[0, 0] = 255  # the cell that stands in for those outside
    particles = rng.uniform((-30, -30, -4), (30, 30, 4), (n, 3)) + (middle, -middle, 0.0)
    points = rng.uniform(-60, 60, (m, 2))
    for grid in (values, values > 128):
        expected = count_plainly(particles, points, grid, origin, cell)
        got = count_on(particles, points, grid, origin, cell)
        assert got.dtype == np.int64
        np.testing.assert_array_equal(got, expected)
        assert expected.any() == (middle < 500.0) or m < 300


def test_count_matches_far_from_the_origin_on_fine_cells():
    # kilometres from the origin on cells of an eighth of a metre, where 32 bits would round points into the next cell
    rng = np.random.default_rng(3)
    values, origin, cell = rng.random((2400, 2400)) < 0.5, np.array([1400.0, -1700.0]), 0.125
    particles = rng.uniform((1500, -1600, -4), (1600, -1500, 4), (300, 3))
    points = rng.uniform(-45, 45, (2000, 2))
    got = count_on(particles, points, values, origin, cell)
    np.testing.assert_array_equal(got, count_plainly(particles, points, values, origin, cell))


def test_points_on_an_edge_belong_to_the_cell_above():
    # cells are half-open: the lower edge belongs to the grid, the upper one does not
    values = np.array([[1, 2, 4], [8, 16, 32]], dtype=np.uint8)
    corners = np.array([[i, j] for i in range(3) for j in range(4)], dtype=float)
    got = [count_on(np.zeros((1, 3)), corner[None], values, ORIGIN, 1.0)[0] for corner in corners]
    assert got == [1, 2, 4, 0, 8, 16, 32, 0, 0, 0, 0, 0]
    below = np.array([[-1e-9, 0.5], [0.5, -1e-9], [-0.5, -0.5]])  # cut towards zero they would be inside
    assert count_on(np.zeros((1, 3)), below, values, ORIGIN, 1.0).tolist() == [0]


def test_count_matches_takes_any_layout_and_leaves_it_as_it_was():
    rng = np.random.default_rng(4)
    values = rng.integers(0, 2, (90, 120), dtype=np.uint8)
    wide, tall = rng.uniform(0, 20, (40, 6)), rng.uniform(-8, 8, (4, 60))
    particles, points = wide[::2, ::2], tall[1:3].T
    for grid in (values[::2, 5:80], values.T, np.asfortranarray(values), values[::-1].astype(bool)):
        before = [a.copy() for a in (wide, tall, values)]
        got = count_on(particles, points, grid, (0.5, -0.5), 0.25)
        np.testing.assert_array_equal(got, count_plainly(particles, points, grid, (0.5, -0.5), 0.25))
        for was, now in zip(before, (wide, tall, values), strict=True):
            np.testing.assert_array_equal(was, now)


def test_count_matches_reads_a_grid_that_is_read_only():
    read_only = np.frombuffer(MATCHED.tobytes(), dtype=np.uint8).reshape(5, 5)
    assert count_on(np.array([[0.5, 2.5, 0.0]]), CLOUD, read_only, ORIGIN, 1.0).tolist() == [3]


def test_count_matches_of_nothing():
    two, none = np.zeros((2, 3)), np.zeros((0, 2))
    for shape in ((0, 0), (0, 5), (5, 0)):  # a grid without a cell: everything is outside
        empty = np.zeros(shape, dtype=bool)
        assert count_on(two, CLOUD, empty, ORIGIN, 1.0).tolist() == [0, 0]
    assert count_on(two, none, MATCHED, ORIGIN, 1.0).tolist() == [0, 0]
    assert count_on(two[:0], CLOUD, MATCHED, ORIGIN, 1.0).shape == (0,)


def test_covariance_is_that_of_the_particles():
    _, (update,) = wall_filter([np.zeros((0, 2))], [])
    spread = np.sqrt(np.trace(update.covariance[:2, :2]))
    assert spread == pytest.approx(np.hypot(update.spread_m, np.sqrt(2e-4)), rel=1e-6)
    assert update.covariance[2, 2] == pytest.approx(update.spread_yaw_rad**2, rel=0.02)
