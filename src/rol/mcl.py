"""Monte Carlo localization on a prior lidar map: predict, weight, resample, estimate.

The particle filter of the paper (Sec. III-B, Eq. 6-9) in functions that can be read, tested and copied one by
one. A set of particles is an array (n, 3) of poses (x, y, yaw) in the map frame [m, m, rad] with an array
(n,) of weights that sum to one. The map is stored as a grid: cell ``[i, j]`` spans ``origin +
(i .. i + 1, j .. j + 1) * cell``, x along the first axis and y along the second. Points outside the grid are
unmatched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

if __package__:
    from .compiled import compiled
    from .geometry import check_fields, check_grid, check_points, check_pose, check_poses, compose, wrap_angle
else:  # this file was copied and is imported by its own name
    from compiled import compiled
    from geometry import check_fields, check_grid, check_points, check_pose, check_poses, compose, wrap_angle


class MclError(ValueError):
    """A value with which no filter update is possible; the message names it."""


@dataclass(frozen=True)
class MotionNoise:
    """Gaussian noise of the odometry increments (Eq. 7); the paper states no values.

    Attributes
    ----------
    forward_m, left_m, yaw_rad : float
        Standard deviations of every increment [m, m, rad]. 0.5 m, 0.3 m and 1 deg: ICP between generated
        clouds is up to 0.8 m short in an increment while the vehicle accelerates, as it stays close to its
        initial guess. 0.2 m, 0.2 m and 0.5 deg lost the pose on two of the demo's four sessions as they were
        first simulated; these values were chosen after that.
    per_m, yaw_per_rad : float
        Standard deviation added per metre driven and per radian turned. 0.03 is twice the 1.5 % by which the
        authors' published odometry is short.

    Raises
    ------
    MclError
        If a value is out of its range; the message names it.
    """

    forward_m: float = 0.5
    left_m: float = 0.3
    yaw_rad: float = float(np.deg2rad(1.0))
    per_m: float = 0.03
    yaw_per_rad: float = 0.03

    def __post_init__(self) -> None:
        check_fields(self, {"[0, inf)": "forward_m left_m yaw_rad per_m yaw_per_rad"}, MclError)

    def sample(self, increment: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw n noisy increments about a measured one, shape (n, 3) [m, m, rad]."""
        along = self.per_m * np.hypot(increment[0], increment[1])
        sigma_yaw = self.yaw_rad + self.yaw_per_rad * abs(increment[2])
        sigmas = np.array([self.forward_m + along, self.left_m + along, sigma_yaw])
        return increment + rng.standard_normal((n, 3)) * sigmas


@dataclass(frozen=True)
class Measurement:
    """Likelihood of a scan by its matched points (Eq. 8-9); the paper states no values.

    Attributes
    ----------
    exponent : float
        lambda of Eq. 8. 20: one per cent more matched points increases a weight by a fifth. With 1 the counts
        of neighbouring particles differ too little to correct the estimate.
    d_th_m : float
        Matching distance of Eq. 9 [m]. 0.5: two image pixels, about the width of a wall in the map.
    cell_m : float
        Side of a grid cell [m]. 0.125 keeps the rounding of a distance below 0.09 m, well below ``d_th_m``.

    Raises
    ------
    MclError
        If a value is out of its range; the message names it.
    """

    exponent: float = 20.0
    d_th_m: float = 0.5
    cell_m: float = 0.125

    def __post_init__(self) -> None:
        check_fields(self, {"(0, inf)": "exponent d_th_m cell_m"}, MclError)

    def build_grid(self, map_points: np.ndarray) -> MapGrid:
        """Build the grid of a map, shape (m, 2) [m], once per map."""
        return build_matched_grid(map_points, self.d_th_m, self.cell_m)


@dataclass(frozen=True)
class Resampling:
    """Multinomial resampling, the paper's.

    Attributes
    ----------
    ess_fraction : float
        Resample when the effective sample size falls below this fraction of the particles; 1 means after each
        scan.

    Raises
    ------
    MclError
        If a value is out of its range; the message names it.
    """

    ess_fraction: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self, {"[0, 1]": "ess_fraction"}, MclError)

    def draw(self, particles: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw particles by their weights, shape (n, 3)."""
        return particles[resample_multinomial(weights, rng)]


@dataclass(frozen=True)
class MclSettings:
    """Settings of the filter; the defaults are the paper's method.

    Attributes
    ----------
    n_particles : int
        Particles at the start. 500: an update takes about ten milliseconds on one core; more particles change
        little once the pose is tracked.
    start_spread_m, start_spread_yaw_rad : float
        Standard deviation of the first particles about the start pose [m, rad]: a start set by hand.
    motion : MotionNoise
        Any object with its method ``sample``.
    measurement : Measurement
        Any object with ``exponent`` and the method ``build_grid``.
    resampling : Resampling
        Any object with ``ess_fraction`` and the method ``draw``.

    Raises
    ------
    MclError
        If a value is out of its range; the message names it.
    """

    n_particles: int = 500
    start_spread_m: float = 0.5
    start_spread_yaw_rad: float = float(np.deg2rad(1.0))
    motion: MotionNoise = MotionNoise()
    measurement: Measurement = Measurement()
    resampling: Resampling = Resampling()

    def __post_init__(self) -> None:
        allowed = {"[1, inf)": "n_particles", "[0, inf)": "start_spread_m start_spread_yaw_rad"}
        check_fields(self, allowed, MclError)


@dataclass(frozen=True)
class MapGrid:
    """Score of a point at each place of the map.

    Attributes
    ----------
    values : array of uint8, shape (h, w)
        1 where a point is matched (Eq. 9), else 0; or a score from 0 to ``best``. One byte per cell, so that
        the grid of a city fits into the processor's cache. The score outside the grid is 0.
    origin : array, shape (2,)
        Corner of cell [0, 0] with the smallest x and y [m].
    cell : float
        Side of a cell [m].
    best : int
        Largest score, that of a point on the map.
    """

    values: np.ndarray
    origin: np.ndarray
    cell: float
    best: int = 1


@compiled
def _stamp(values: np.ndarray, points: np.ndarray, reach: float, scores: np.ndarray) -> None:
    """Raise, in place, the cells within reach of a point [cells] to the score of their distance."""
    h, w = values.shape
    for k in range(points.shape[0]):
        u, v = points[k, 0] - 0.5, points[k, 1] - 0.5
        for i in range(max(0, int(np.ceil(u - reach))), min(h - 1, int(np.floor(u + reach))) + 1):
            for j in range(max(0, int(np.ceil(v - reach))), min(w - 1, int(np.floor(v + reach))) + 1):
                part = ((i - u) ** 2 + (j - v) ** 2) / (reach * reach)
                if part < 1.0:
                    values[i, j] = max(values[i, j], scores[int(part * len(scores))])


def tabulate_distances(
    map_points: np.ndarray, cell: float, reach: float, scores: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate a score that decreases with the distance from a cell's centre to the nearest map point.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    cell : float
        Side of a cell [m].
    reach : float
        Distance from which the score is 0; the grid extends this far beyond the map [m].
    scores : array of uint8, shape (k,)
        Non-increasing scores for k equal parts of the squared distance from 0 to the squared reach.

    Returns
    -------
    values : array of uint8, shape (h, w)
        Score of each cell.
    origin : array, shape (2,)
        Corner of cell [0, 0] with the smallest x and y [m].

    Raises
    ------
    MclError
        If the map is empty, not finite or too large for a grid, or a length is not above zero.
    """
    map_points = check_points(map_points, "map", error=MclError)
    if len(map_points) == 0:
        raise MclError("the map holds no point")
    if not (0.0 < cell < np.inf and 0.0 < reach < np.inf):
        raise MclError(f"grid of the map: cell {cell} m and reach {reach} m must be above zero")
    origin = np.floor((map_points.min(axis=0) - reach) / cell) * cell
    shape = np.ceil((map_points.max(axis=0) + reach - origin) / cell)
    values = np.zeros(check_grid(shape, map_points, "map", error=MclError), dtype=np.uint8)
    _stamp(values, (map_points - origin) / cell, reach / cell, scores)
    return values, origin


def build_matched_grid(map_points: np.ndarray, d_th: float = 0.5, cell: float = 0.125) -> MapGrid:
    """Mark the cells whose centre is closer than d_th to a map point.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    d_th : float
        Matching distance [m].
    cell : float
        Side of a cell [m].

    Returns
    -------
    grid : MapGrid
        1 where matched, else 0.

    Notes
    -----
    Yin et al. 2020, Sec. III-B, Eq. 9.
    """
    return MapGrid(*tabulate_distances(map_points, cell, d_th, np.ones(1, dtype=np.uint8)), cell)


@compiled
def _sum_values(particles, points, values, x0, y0, cell):
    """Sum the grid's values under the points at each particle.

    Two loops per particle, both without branches. The first finds the points' cells, several at once in the
    processor's vector registers; the second only reads them. A point outside the grid is read at the first
    cell, whose value is subtracted from the sum again.
    """
    # With 64 bits, each value would be converted on its own.
    h, w = np.int32(values.shape[0]), np.int32(values.shape[1])
    flat, cells = values.ravel(), np.empty(points.shape[0], dtype=np.int64)
    x, y = points[:, 0].copy(), points[:, 1].copy()
    sums = np.empty(particles.shape[0], dtype=np.int64)
    for i in range(particles.shape[0]):
        c, s = np.cos(particles[i, 2]) / cell, np.sin(particles[i, 2]) / cell
        u0, v0 = (particles[i, 0] - x0) / cell, (particles[i, 1] - y0) / cell
        n_outside = 0
        for k in range(cells.shape[0]):
            u, v = u0 + c * x[k] - s * y[k], v0 + s * x[k] + c * y[k]
            is_inside = (u >= 0.0) & (u < h) & (v >= 0.0) & (v < w)
            cells[k] = np.int64(np.int32(u)) * np.int64(w) + np.int32(v) if is_inside else 0
            n_outside += not is_inside
        total = -n_outside * np.int64(flat[0])
        for k in range(cells.shape[0]):
            # Unsigned, as numba otherwise lets negative numbers count from the end.
            total += flat[np.uint64(cells[k])]
        sums[i] = total
    return sums


def count_matches(particles: np.ndarray, points: np.ndarray, grid: MapGrid) -> np.ndarray:
    """Count the matched points of a scan at each particle.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses T_map_radar (x, y, yaw) [m, m, rad].
    points : array, shape (m, 2)
        Points of the scan in the radar frame [m].
    grid : MapGrid
        From `build_matched_grid`; scores of another grid are summed. ``values`` of bool or uint8; an array
        that is not contiguous is copied first.

    Returns
    -------
    counts : array of int, shape (n,)
        N of Eq. 8; zeros for a scan without points.

    Raises
    ------
    MclError
        If the points or the grid have another shape or type, or a point is not finite.

    Notes
    -----
    Yin et al. 2020, Sec. III-B, Eq. 9.
    """
    particles, points = check_poses(particles, "particles"), check_points(points, "cloud", error=MclError)
    matched = grid.values
    if matched.ndim != 2 or matched.dtype not in (np.dtype(bool), np.dtype(np.uint8)):
        raise MclError(f"grid: expected 2D values of bool or uint8, got {matched.ndim}D of {matched.dtype}")
    if matched.size == 0:
        return np.zeros(len(particles), dtype=np.int64)
    values, particles = np.ascontiguousarray(matched).view(np.uint8), np.ascontiguousarray(particles)
    return _sum_values(particles, points, values, *map(float, grid.origin), float(grid.cell))


def sample_particles(
    pose: np.ndarray, n: int, spread_m: float, spread_yaw: float, rng: np.random.Generator
) -> np.ndarray:
    """Draw particles about a pose.

    Parameters
    ----------
    pose : array-like, shape (3,)
        Mean (x, y, yaw) [m, m, rad].
    n : int
        Number of particles, at least one.
    spread_m, spread_yaw : float
        Standard deviations of x and y [m] and of the heading [rad].
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    particles : array, shape (n, 3)
        Poses, yaw in [-pi, pi).

    Raises
    ------
    MclError
        If n is below one.
    """
    if n < 1:
        raise MclError(f"at least one particle is needed, got {n}")
    spreads = spread_m, spread_m, spread_yaw
    particles = check_pose(pose, "start pose") + rng.standard_normal((n, 3)) * spreads
    particles[:, 2] = wrap_angle(particles[:, 2])
    return particles


def predict(
    particles: np.ndarray, increment: np.ndarray, motion: MotionNoise, rng: np.random.Generator
) -> np.ndarray:
    """Move every particle by the odometry increment, each with its own noise.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses at the last scan [m, m, rad].
    increment : array-like, shape (3,)
        Pose of this scan in the last one (x, y, yaw) [m, m, rad].
    motion : MotionNoise
        Its method ``sample`` draws the noisy increments.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    particles : array, shape (n, 3)
        Poses at this scan.

    Notes
    -----
    Yin et al. 2020, Sec. III-B, Eq. 7.
    """
    increment = check_pose(increment, "odometry increment")
    return compose(particles, motion.sample(increment, len(particles), rng))


def log_weights(counts: np.ndarray, exponent: float) -> np.ndarray:
    """Compute the logarithms of the importance weights from the matched counts.

    Parameters
    ----------
    counts : array, shape (n,)
        Matched points at each particle, not negative.
    exponent : float
        lambda, above zero.

    Returns
    -------
    log_weights : array, shape (n,)
        lambda log N; minus infinity where nothing matched. Logarithms, as 1000^200 overflows.

    Raises
    ------
    MclError
        If a count is negative or not finite, or the exponent is not above zero.

    Notes
    -----
    Yin et al. 2020, Sec. III-B, Eq. 8.
    """
    counts = np.asarray(counts, dtype=np.float64)
    if not np.isfinite(counts).all() or (counts < 0).any():
        raise MclError("counts must be finite and not negative")
    if not exponent > 0:
        raise MclError(f"the exponent must be above zero, got {exponent}")
    return exponent * np.log(counts, out=np.full(counts.shape, -np.inf), where=counts > 0)


def normalize_weights(log_weights: np.ndarray, prior: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
    """Multiply prior weights by new ones and normalize the product.

    Parameters
    ----------
    log_weights : array, shape (n,)
        Logarithms of the new weights; minus infinity is a weight of zero.
    prior : array, shape (n,), optional
        Weights before this scan; equal ones if not given.

    Returns
    -------
    weights : array, shape (n,)
        Normalized weights (eta of Eq. 6). When the total is zero the prior is returned unchanged: a scan that
        matches nowhere is no evidence about the pose.
    measurement_used : bool
        False when the total was zero.

    Raises
    ------
    MclError
        If a value is NaN or plus infinity.
    """
    log_weights = np.asarray(log_weights, dtype=np.float64)
    prior = np.full(len(log_weights), 1.0 / len(log_weights)) if prior is None else check_weights(prior)
    if np.isnan(log_weights).any() or (log_weights == np.inf).any():
        raise MclError("log-weights must not be NaN or infinite")
    joint = log_weights + np.log(prior, out=np.full(prior.shape, -np.inf), where=prior > 0)
    if np.isneginf(joint).all():
        return prior, False
    weights = np.exp(joint - joint.max())
    return weights / weights.sum(), True


def effective_sample_size(weights: np.ndarray) -> float:
    """Compute the effective sample size.

    Parameters
    ----------
    weights : array, shape (n,)
        Weights, of any positive total.

    Returns
    -------
    ess : float
        Between 1 (one particle has the whole weight) and n (all weights are equal).
    """
    weights = check_weights(weights)
    return float(1.0 / np.sum(weights**2))


def resample_multinomial(weights: np.ndarray, rng: np.random.Generator, n: int | None = None) -> np.ndarray:
    """Draw n indices independently, each with the probability of its weight.

    Parameters
    ----------
    weights : array, shape (m,)
        Weights, of any positive total.
    rng : numpy.random.Generator
        Random generator.
    n : int, optional
        Number of draws; as many as there are weights if not given.

    Returns
    -------
    indices : array of int, shape (n,)
        Particles to keep; index i occurs n * w_i times on average.
    """
    return pick_indices(check_weights(weights), rng.random(len(weights) if n is None else n))


def estimate_pose(particles: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Average the particles.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses (x, y, yaw) [m, m, rad].
    weights : array, shape (n,)
        Their weights, of any positive total.

    Returns
    -------
    pose : array, shape (3,)
        Weighted mean; the heading is that of the mean direction, or of the particle with the largest weight
        where the mean direction is undefined.
    spread_m : float
        Root of the weighted mean squared distance to the mean [m].
    spread_yaw : float
        Root of the weighted mean squared heading difference to the mean [rad].
    """
    weights = check_weights(weights)
    c, s = weights @ np.cos(particles[:, 2]), weights @ np.sin(particles[:, 2])
    yaw = np.arctan2(s, c) if np.hypot(c, s) > 1e-9 else particles[np.argmax(weights), 2]
    pose = np.array([weights @ particles[:, 0], weights @ particles[:, 1], wrap_angle(yaw)])
    spread_m = np.sqrt(weights @ np.sum((particles[:, :2] - pose[:2]) ** 2, axis=1))
    return pose, float(spread_m), float(np.sqrt(weights @ wrap_angle(particles[:, 2] - yaw) ** 2))


@dataclass(frozen=True)
class MclUpdate:
    """Estimate after one scan, with diagnostics.

    Attributes
    ----------
    pose : array, shape (3,)
        Estimate T_map_radar [m, m, rad].
    particles, weights : array, shape (n, 3) and (n,)
        Particles with their weights before resampling.
    next_particles, next_weights : array, shape (k, 3) and (k,)
        Particles with their weights for the next scan.
    ess : float
        Effective sample size before resampling.
    spread_m, spread_yaw_rad : float
        Spread of the particles about the estimate [m, rad].
    inlier_ratio : float
        Mean score of a point, averaged over the particles: 0 (all off the map) to 1 (all on it).
    n_points : int
        Points of the scan.
    measurement_used : bool
        False when the scan had no points or matched nowhere, and only the motion model moved the particles.
    """

    pose: np.ndarray
    particles: np.ndarray
    weights: np.ndarray
    next_particles: np.ndarray
    next_weights: np.ndarray
    ess: float
    spread_m: float
    spread_yaw_rad: float
    inlier_ratio: float
    n_points: int
    measurement_used: bool

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of (x, y, yaw), shape (3, 3) [m, m, rad], enlarged by 1 cm and 0.05 deg (squared)."""
        away = self.particles - self.pose
        away[:, 2] = wrap_angle(away[:, 2])
        return (away * self.weights[:, None]).T @ away + np.diag([1e-4, 1e-4, np.deg2rad(0.05) ** 2])


def update(
    particles: np.ndarray,
    weights: np.ndarray,
    points: np.ndarray,
    grid: MapGrid,
    settings: MclSettings,
    rng: np.random.Generator,
) -> MclUpdate:
    """Weight moved particles by one scan, estimate the pose, and resample.

    Parameters
    ----------
    particles, weights : array, shape (n, 3) and (n,)
        Particles after `predict` and their weights.
    points : array, shape (m, 2)
        Points of the scan in the radar frame [m]; without points the weights stay as they are.
    grid : MapGrid
        From the measurement's ``build_grid``.
    settings : MclSettings
        Measurement and resampling.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    result : MclUpdate

    Notes
    -----
    Yin et al. 2020, Sec. III-B, Eq. 6-9.
    """
    is_used, inlier_ratio = len(points) > 0, 0.0
    if is_used:
        sums = count_matches(particles, points, grid)
        weights, is_used = normalize_weights(log_weights(sums, settings.measurement.exponent), weights)
        inlier_ratio = float(weights @ sums) / (len(points) * grid.best)
    pose, *spreads = estimate_pose(particles, weights)
    ess, kept, kept_weights = effective_sample_size(weights), particles, weights
    if is_used and ess <= settings.resampling.ess_fraction * len(weights):
        kept = settings.resampling.draw(particles, weights, rng)
        kept_weights = np.full(len(kept), 1.0 / len(kept))
    estimate = pose, particles, weights, kept, kept_weights, ess
    return MclUpdate(*estimate, *spreads, inlier_ratio, len(points), is_used)


class ParticleFilter:
    """Particle filter that is given one scan at a time.

    Parameters
    ----------
    grid : MapGrid
        From the measurement's ``build_grid``.
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    settings : MclSettings
        Particles, motion, measurement and resampling.
    rng : numpy.random.Generator
        Random generator.
    """

    def __init__(
        self, grid: MapGrid, start: np.ndarray, settings: MclSettings, rng: np.random.Generator
    ) -> None:
        self.grid, self.settings, self.rng = grid, settings, rng
        self.reset(start)

    def reset(self, pose: np.ndarray) -> None:
        """Draw the particles anew about a pose [m, m, rad]."""
        n, settings = self.settings.n_particles, self.settings
        spreads = settings.start_spread_m, settings.start_spread_yaw_rad
        self.particles = sample_particles(pose, n, *spreads, self.rng)
        self.weights = np.full(n, 1.0 / n)

    def step(self, points: np.ndarray, increment: np.ndarray | None = None) -> MclUpdate:
        """Process one scan.

        Parameters
        ----------
        points : array, shape (m, 2)
            Points of the scan in the radar frame [m].
        increment : array-like, shape (3,), optional
            Pose of this scan in the last one [m, m, rad]; none for the first scan.

        Returns
        -------
        result : MclUpdate

        Notes
        -----
        Yin et al. 2020, Sec. III-B, Eq. 6-9.
        """
        if increment is not None:
            self.particles = predict(self.particles, increment, self.settings.motion, self.rng)
        result = update(self.particles, self.weights, points, self.grid, self.settings, self.rng)
        self.particles, self.weights = result.next_particles, result.next_weights
        return result


def localize(
    particle_filter: ParticleFilter,
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    reset_callback: Callable[[int, np.ndarray], np.ndarray | None] | None = None,
) -> Iterator[MclUpdate]:
    """Run a filter over successive scans; each estimate is yielded before the next scan is read.

    Parameters
    ----------
    particle_filter : ParticleFilter
        Or any object with its methods ``step`` and ``reset``.
    increments : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    reset_callback : callable, optional
        Called with the index of the scan and the estimate; the filter is reset to a pose that it returns, as
        the authors did by hand.

    Yields
    ------
    result : MclUpdate
        One per scan.

    Raises
    ------
    MclError
        If there are too few increments, or a scan is no finite cloud.

    Notes
    -----
    Yin et al. 2020, Sec. III-B.
    """
    increments = iter(increments)
    for index, points in enumerate(clouds):
        increment = next(increments, None) if index else None
        if index and increment is None:
            raise MclError(f"no odometry increment for scan {index}: one fewer than clouds are needed")
        result = particle_filter.step(points, increment)
        yield result
        restart = reset_callback(index, result.pose) if reset_callback else None
        if restart is not None:
            particle_filter.reset(restart)


def pick_indices(weights: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Find the indices of draws in [0, 1] on the cumulative weights.

    A draw beyond their rounded end takes the last positive weight.
    """
    indices = np.searchsorted(np.cumsum(weights), draws, side="right")
    return np.minimum(indices, np.flatnonzero(weights)[-1])


def check_weights(weights: np.ndarray) -> np.ndarray:
    """Check weights, shape (n,), and normalize them; raises `MclError`."""
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 1 or len(weights) == 0:
        raise MclError(f"weights: expected shape (n,), got {weights.shape}")
    if not np.isfinite(weights).all() or (weights < 0).any():
        raise MclError("weights must be finite and not negative")
    if weights.sum() <= 0:
        raise MclError("all weights are zero")
    return weights / weights.sum()
