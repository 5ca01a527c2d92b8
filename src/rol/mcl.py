"""Monte Carlo localization on a prior lidar map: predict, weigh, resample, estimate.

The filter of the paper (Sec. III-B, Eq. 6-9) in pieces that can be read, tested and copied one by one. A set
of particles is an array (n, 3) of poses (x, y, yaw) in the map frame [m, m, rad] and an array (n,) of weights
that sum to one. The map is asked through a grid: cell ``[i, j]`` spans ``origin + (i .. i + 1, j .. j + 1) *
cell``, x along the first axis and y along the second; what lies outside the grid is unmatched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import get_num_threads, prange

try:
    from .compiled import compiled
    from .geometry import check_fields, check_grid, check_poses, compose, wrap_angle
except ImportError:  # this file was copied on its own
    from compiled import compiled
    from geometry import check_fields, check_grid, check_poses, compose, wrap_angle


class MclError(ValueError):
    """Raised for input from which no sound filter step can be made."""


@dataclass(frozen=True)
class MclSettings:
    """Settings of the filter; the paper states none of these numbers, so each default gives its reason.

    Attributes
    ----------
    n_particles : int
        500: a scan's update stays near ten milliseconds on one core; more changes little once the pose is
        tracked.
    exponent : float
        lambda of Eq. 8. 20: one per cent more matched points weighs a fifth more. With 1 the counts of
        neighbouring particles differ too little to pull the estimate anywhere.
    d_th_m : float
        Matching distance of Eq. 9 [m]. 0.5: two image pixels, about the width of a wall in the map.
    noise_forward_m, noise_side_m, noise_yaw_rad : float
        Standard deviations added to every step, moving or not [m, m, rad]. 0.5 m, 0.3 m and 1 deg: ICP between
        fake clouds is up to 0.8 m short in a step while the car gains speed, for it stays near its first guess (see
        `odometry.search_motion`). 0.2 m, 0.2 m and 0.5 deg lost the pose on two of the demo's four sessions as they
        were first simulated; these values were chosen after that.
    noise_per_m, noise_yaw_per_rad : float
        Standard deviation added per metre driven and per radian turned; 0.03 is twice the 1.5 % by which the
        authors' published odometry is short.
    start_spread_m, start_spread_yaw_rad : float
        Standard deviation of the first particles about the given start [m, rad]: a start set by hand.
    likelihood : str
        "count" (Eq. 8-9) or "distance": in the sum of Eq. 8 a point counts a Gaussian of its distance to the map
        instead of one or nothing. What is far counts nothing either way, so false points do no more harm.
    sigma_m : float
        Of "distance" only: width of that Gaussian [m]. 0.2: on the real route 0.3 has a tenth more error, and with
        0.45 the pose is lost where the map is dense.
    crowd_m : float
        Of "distance" only: a point counts the less, the fuller the map is within this distance, see
        `build_distance_grid` [m]; 0 counts all alike. With 2 the pose slips far less often
        along the street of hedges of the real route, where points fit at many places.
    resampling : str
        "multinomial" (plain) or "systematic" (one draw for all).
    resample_below : float
        Resample when the effective sample size falls below this share of the particles; 1 means after each
        scan.
    cell_m : float
        Side of a grid cell [m]; 0.125 keeps the rounding of a distance below 0.09 m, well inside ``d_th_m``.
    min_particles : int
        Below ``n_particles`` their number follows the particles' spread, see `count_needed`, but never falls under
        this; 0 keeps it as it is.

    Raises
    ------
    MclError
        If a value is out of its range; the message names it.
    """

    n_particles: int = 500
    exponent: float = 20.0
    d_th_m: float = 0.5
    noise_forward_m: float = 0.5
    noise_side_m: float = 0.3
    noise_yaw_rad: float = float(np.deg2rad(1.0))
    noise_per_m: float = 0.03
    noise_yaw_per_rad: float = 0.03
    start_spread_m: float = 0.5
    start_spread_yaw_rad: float = float(np.deg2rad(1.0))
    likelihood: str = "count"
    sigma_m: float = 0.2
    crowd_m: float = 0.0
    resampling: str = "multinomial"
    resample_below: float = 1.0
    cell_m: float = 0.125
    min_particles: int = 0

    def __post_init__(self) -> None:
        allowed = {
            "[1, inf)": "n_particles",
            "(0, inf)": "exponent d_th_m sigma_m cell_m",
            "[0, inf)": "noise_forward_m noise_side_m noise_yaw_rad noise_per_m noise_yaw_per_rad "
            "start_spread_m start_spread_yaw_rad crowd_m min_particles",
            "[0, 1]": "resample_below",
            ("count", "distance"): "likelihood",
            ("multinomial", "systematic"): "resampling",
        }
        check_fields(self, allowed, MclError)


def settings_for(method: str, **changes: object) -> MclSettings:
    """Give the settings of a named method.

    Parameters
    ----------
    method : str
        "paper": matched counts to the power lambda, plain resampling after each scan. "rol": distances
        instead of a threshold, which count less where the map is full, systematic resampling when the effective sample
        size falls below one half, as many particles as their spread asks for. Its lambda of 20 was chosen with clouds on
        the real route (chapter 09).
    **changes
        Settings that differ from the method's defaults.

    Returns
    -------
    settings : MclSettings

    Raises
    ------
    MclError
        If the method is unknown, or a value is out of its range.
    """
    methods = {
        "paper": MclSettings(),
        "rol": MclSettings(
            n_particles=1000,
            min_particles=200,
            exponent=20.0,
            likelihood="distance",
            crowd_m=2.0,
            resampling="systematic",
            resample_below=0.5,
            cell_m=0.25,
        ),
    }
    if method not in methods:
        raise MclError(f"unknown method {method!r}; there are {', '.join(sorted(methods))}")
    return replace(methods[method], **changes)


@dataclass(frozen=True)
class MapGrid:
    """What a point is worth at each place of the map.

    Attributes
    ----------
    values : array of uint8, shape (h, w)
        0 or 1 (matched, Eq. 9), or how well a point is matched, 0 to 255; a byte per cell, for the grid of a whole
        city should fit into the processor's reach. Outside the grid it is 0.
    origin : array, shape (2,)
        Corner of cell [0, 0] with the smallest x and y [m].
    cell : float
        Side of a cell [m].
    best : int
        Value of a cell on the map.
    """

    values: np.ndarray
    origin: np.ndarray
    cell: float
    best: int = 1


@compiled
def _stamp(values: np.ndarray, points: np.ndarray, reach: float, codes: np.ndarray) -> None:
    """Raise, in place, cells nearer than the reach to a point [cells] to the code of their distance."""
    h, w = values.shape
    for k in range(points.shape[0]):
        u, v = points[k, 0] - 0.5, points[k, 1] - 0.5
        for i in range(max(0, int(np.ceil(u - reach))), min(h - 1, int(np.floor(u + reach))) + 1):
            for j in range(max(0, int(np.ceil(v - reach))), min(w - 1, int(np.floor(v + reach))) + 1):
                share = ((i - u) ** 2 + (j - v) ** 2) / (reach * reach)
                if share < 1.0:
                    values[i, j] = max(values[i, j], codes[int(share * len(codes))])


def stamp_grid(
    map_points: np.ndarray, cell: float, reach: float, codes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate a value that falls with the exact distance from a cell's centre to the nearest map point.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    cell : float
        Side of a cell [m].
    reach : float
        Cells from this distance on stay 0, and the grid reaches this far beyond the map [m].
    codes : array of uint8, shape (k,)
        Values, not increasing, for k equal parts of the squared distance from 0 to the reach's square.

    Returns
    -------
    values : array of uint8, shape (h, w)
        Value of each cell.
    origin : array, shape (2,)
        Corner of cell [0, 0] with the smallest x and y [m].

    Raises
    ------
    MclError
        If the map is empty, not finite or too large for a grid, or a length is not above zero.
    """
    map_points = _check_points(map_points, "map")
    if len(map_points) == 0:
        raise MclError("the map holds no point")
    if not (0.0 < cell < np.inf and 0.0 < reach < np.inf):
        raise MclError(f"grid of the map: cell {cell} m and reach {reach} m must be above zero")
    origin = np.floor((map_points.min(axis=0) - reach) / cell) * cell
    shape = np.ceil((map_points.max(axis=0) + reach - origin) / cell)
    values = np.zeros(check_grid(shape, map_points, "map", error=MclError), dtype=np.uint8)
    _stamp(values, (map_points - origin) / cell, reach / cell, codes)
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
        1 where matched, else 0. Yin et al. 2020, Sec. III-B, Eq. 9.
    """
    return MapGrid(*stamp_grid(map_points, cell, d_th, np.ones(1, dtype=np.uint8)), cell)


def build_distance_grid(
    map_points: np.ndarray, sigma: float = 0.2, cell: float = 0.25, crowd_m: float = 0.0
) -> MapGrid:
    """Tabulate how well a point is matched: a Gaussian of its distance to the map, less where the map is full.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    sigma : float
        Standard deviation of the Gaussian [m].
    cell : float
        Side of a cell [m].
    crowd_m : float
        Half the side of the square about each cell within which the map is looked at [m]; 0: not at all.

    Returns
    -------
    grid : MapGrid
        exp(-d^2 / 2 sigma^2) in 255 steps, nothing from three sigma on: Eq. 9 with a soft edge. With ``crowd_m`` it is
        divided by 1 + c / 0.6, c its mean over the square: in a hedge, where nearly every place is matched, a point that
        fits tells little.
    """
    squares = (np.arange(4096) + 0.5) / 4096 * 9.0
    codes = np.round(255.0 * np.exp(-0.5 * squares)).astype(np.uint8)
    values, origin = stamp_grid(map_points, cell, 3.0 * sigma, codes)
    return MapGrid(_thin_crowds(values, round(crowd_m / cell)) if crowd_m else values, origin, cell, 255)


def _thin_crowds(values: np.ndarray, n_cells: int, half: float = 0.6) -> np.ndarray:
    """Divide each value by one plus the mean of those around it, in units of ``half`` the highest."""
    from scipy.ndimage import uniform_filter

    crowd = uniform_filter(values, 2 * n_cells + 1, output=np.float32, mode="constant")
    crowd /= np.float32(255.0 * half)
    crowd += 1.0
    return np.round(np.divide(values, crowd, out=crowd), out=crowd).astype(np.uint8)


def build_grid(map_points: np.ndarray, settings: MclSettings) -> MapGrid:
    """Build the grid that the settings' likelihood asks, once per map.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    settings : MclSettings
        ``likelihood`` decides: matched cells, or how near the map each cell is.

    Returns
    -------
    grid : MapGrid
    """
    if settings.likelihood == "count":
        return build_matched_grid(map_points, settings.d_th_m, settings.cell_m)
    return build_distance_grid(map_points, settings.sigma_m, settings.cell_m, settings.crowd_m)


@compiled
def _sum_values(particles, points, values, x0, y0, cell):
    """Sum the grid's values under the points as seen from each particle.

    Two loops for each particle, neither with a branch: the first finds the points' cells, several at once in the
    processor's wide registers, the second only reads them. A point outside the grid is read at the first cell, whose
    value is taken off the sum again.
    """
    h, w = np.int32(values.shape[0]), np.int32(values.shape[1])  # 64 bits would be converted one by one
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
            total += flat[np.uint64(cells[k])]  # unsigned, or numba lets negative numbers count from the end
        sums[i] = total
    return sums


@compiled(parallel=True)
def _sum_values_parallel(particles, points, values, x0, y0, cell, n_parts):
    """Do the same with the particles shared out in parts among all threads."""
    n = particles.shape[0]
    sums = np.empty(n, dtype=np.int64)
    for part in prange(n_parts):
        first, end = part * n // n_parts, (part + 1) * n // n_parts
        sums[first:end] = _sum_values(particles[first:end], points, values, x0, y0, cell)
    return sums


def count_matches(
    particles: np.ndarray,
    points: np.ndarray,
    matched: np.ndarray,
    origin: np.ndarray,
    cell: float,
    *,
    parallel: bool = False,
) -> np.ndarray:
    """Count for each particle the points of a cloud that fall on matched cells.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses T_map_radar (x, y, yaw) [m, m, rad].
    points : array, shape (m, 2)
        Cloud in the radar frame [m].
    matched : array of bool or uint8, shape (h, w)
        1 for cells closer than d_th to the map, see `build_matched_grid`; other values are summed up, see
        `build_distance_grid`. Contiguous; any other is copied first.
    origin : array-like, shape (2,)
        Corner of cell [0, 0] with the smallest x and y [m].
    cell : float
        Side of a cell [m].
    parallel : bool
        Use all of numba's threads.

    Returns
    -------
    counts : array of int, shape (n,)
        N of Eq. 8; zeros for a cloud without points. Yin et al. 2020, Sec. III-B, Eq. 9.
    """
    particles, points = check_poses(particles, "particles"), _check_points(points, "cloud")
    if matched.ndim != 2 or matched.dtype not in (np.dtype(bool), np.dtype(np.uint8)):
        raise MclError(
            f"matched: expected a 2D grid of bool or uint8, got {matched.ndim}D of {matched.dtype}"
        )
    if matched.size == 0:
        return np.zeros(len(particles), dtype=np.int64)
    values, particles = np.ascontiguousarray(matched).view(np.uint8), np.ascontiguousarray(particles)
    given = particles, points, values, float(origin[0]), float(origin[1]), float(cell)
    return _sum_values_parallel(*given, get_num_threads()) if parallel else _sum_values(*given)


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
        Source of randomness.

    Returns
    -------
    particles : array, shape (n, 3)
        Poses, yaw in [-pi, pi).
    """
    if n < 1:
        raise MclError(f"at least one particle is needed, got {n}")
    particles = check_poses(pose, "start pose") + rng.standard_normal((n, 3)) * (
        spread_m,
        spread_m,
        spread_yaw,
    )
    particles[:, 2] = wrap_angle(particles[:, 2])
    return particles


def predict(
    particles: np.ndarray, step: np.ndarray, settings: MclSettings, rng: np.random.Generator
) -> np.ndarray:
    """Move every particle by the odometry step, each with its own noise.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses at the last scan [m, m, rad].
    step : array-like, shape (3,)
        Pose of this scan in the last one (x, y, yaw) [m, m, rad].
    settings : MclSettings
        The ``noise_...`` fields: a constant part plus a part that grows with the motion.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    particles : array, shape (n, 3)
        Poses at this scan. Yin et al. 2020, Sec. III-B, Eq. 7.
    """
    step = check_poses(step, "odometry step")
    along = settings.noise_per_m * np.hypot(step[0], step[1])
    sigmas = np.array(
        [
            settings.noise_forward_m + along,
            settings.noise_side_m + along,
            settings.noise_yaw_rad + settings.noise_yaw_per_rad * abs(step[2]),
        ]
    )
    return compose(particles, step + rng.standard_normal((len(particles), 3)) * sigmas)


def weigh(counts: np.ndarray, exponent: float) -> np.ndarray:
    """Turn matched counts into the logarithms of the importance weights.

    Parameters
    ----------
    counts : array, shape (n,)
        Matched points of each particle, not negative.
    exponent : float
        lambda, above zero.

    Returns
    -------
    log_weights : array, shape (n,)
        lambda log N; minus infinity where nothing matched. Logarithms, for 1000^200 is beyond any float.
        Yin et al. 2020, Sec. III-B, Eq. 8.
    """
    counts = np.asarray(counts, dtype=np.float64)
    if not np.isfinite(counts).all() or (counts < 0).any():
        raise MclError("counts must be finite and not negative")
    if not exponent > 0:
        raise MclError(f"the exponent must be above zero, got {exponent}")
    return exponent * np.log(counts, out=np.full(counts.shape, -np.inf), where=counts > 0)


def normalize_weights(log_weights: np.ndarray, prior: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
    """Multiply weights onto the prior ones and scale them to sum to one.

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
        fits nowhere tells nothing about where.
    is_informed : bool
        False when the total was zero.

    Raises
    ------
    MclError
        If a value is NaN or plus infinity.
    """
    log_weights = np.asarray(log_weights, dtype=np.float64)
    prior = np.full(len(log_weights), 1.0 / len(log_weights)) if prior is None else _check_weights(prior)
    if np.isnan(log_weights).any() or (log_weights == np.inf).any():
        raise MclError("log-weights must not be NaN or infinite")
    joint = log_weights + np.log(prior, out=np.full(prior.shape, -np.inf), where=prior > 0)
    if np.isneginf(joint).all():
        return prior, False
    weights = np.exp(joint - joint.max())
    return weights / weights.sum(), True


def effective_sample_size(weights: np.ndarray) -> float:
    """Give the number of equally weighted particles that would be worth as much.

    Parameters
    ----------
    weights : array, shape (n,)
        Weights, of any positive total.

    Returns
    -------
    ess : float
        Between 1 (one particle holds all) and n (all equal).
    """
    weights = _check_weights(weights)
    return float(1.0 / np.sum(weights**2))


def resample_multinomial(weights: np.ndarray, rng: np.random.Generator, n: int | None = None) -> np.ndarray:
    """Draw n indices independently, each with its weight: plain resampling.

    Parameters
    ----------
    weights : array, shape (m,)
        Weights, of any positive total.
    rng : numpy.random.Generator
        Source of randomness.
    n : int, optional
        How many to draw; as many as there are weights if not given.

    Returns
    -------
    indices : array of int, shape (n,)
        Particles to keep; index i occurs n * w_i times on average.
    """
    return _pick(_check_weights(weights), rng.random(len(weights) if n is None else n))


def resample_systematic(weights: np.ndarray, rng: np.random.Generator, n: int | None = None) -> np.ndarray:
    """Draw n indices with a comb of n equal teeth and one random offset: the least variance.

    Parameters
    ----------
    weights : array, shape (m,)
        Weights, of any positive total.
    rng : numpy.random.Generator
        Source of randomness.
    n : int, optional
        How many to draw; as many as there are weights if not given.

    Returns
    -------
    indices : array of int, shape (n,)
        Particles to keep; index i occurs n * w_i times on average, and never a full copy more or less.
    """
    n = len(weights) if n is None else n
    return _pick(_check_weights(weights), (np.arange(n) + rng.random()) / n)


def count_needed(
    particles: np.ndarray,
    *,
    cell_m: float = 0.25,
    cell_yaw: float = np.deg2rad(2.0),
    error: float = 0.05,
    quantile: float = 2.33,
) -> int:
    """Give how many particles are needed to stand for a belief that is spread like these.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Particles of equal weight (x, y, yaw) [m, m, rad].
    cell_m, cell_yaw : float
        Sides of the cells in which the belief is told apart [m, rad].
    error : float
        Bound on the Kullback-Leibler distance between the belief and what the particles say of it.
    quantile : float
        Of the normal distribution: 2.33 keeps the bound in 99 % of all cases.

    Returns
    -------
    n : int
        At least one. Fox 2003, "Adapting the sample size in particle filters through KLD-sampling", Eq. 7.
    """
    cells = np.floor(particles / (cell_m, cell_m, cell_yaw)).astype(np.int64)
    cells -= cells.min(axis=0)
    sides = cells.max(axis=0) + 1
    k = len(np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2])) - 1
    if k == 0:
        return 1
    part = 2.0 / (9.0 * k)
    return int(np.ceil(k / (2.0 * error) * (1.0 - part + np.sqrt(part) * quantile) ** 3))


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
        Weighted mean; the heading is that of the mean direction, or the heaviest particle's where there is
        none.
    spread_m : float
        Root of the weighted mean squared distance to the mean [m].
    spread_yaw : float
        Root of the weighted mean squared heading difference to the mean [rad].
    """
    weights = _check_weights(weights)
    c, s = weights @ np.cos(particles[:, 2]), weights @ np.sin(particles[:, 2])
    yaw = np.arctan2(s, c) if np.hypot(c, s) > 1e-9 else particles[np.argmax(weights), 2]
    pose = np.array([weights @ particles[:, 0], weights @ particles[:, 1], wrap_angle(yaw)])
    spread_m = np.sqrt(weights @ np.sum((particles[:, :2] - pose[:2]) ** 2, axis=1))
    return pose, float(spread_m), float(np.sqrt(weights @ wrap_angle(particles[:, 2] - yaw) ** 2))


@dataclass(frozen=True)
class MclUpdate:
    """One scan's estimate and what is worth watching.

    Attributes
    ----------
    index : int
        Number of the scan, from zero.
    pose : array, shape (3,)
        Estimate T_map_radar [m, m, rad].
    particles, weights : array, shape (n, 3) and (n,)
        The particles with their weights before resampling.
    next_particles, next_weights : array, shape (n, 3) and (n,)
        What the next scan starts from.
    ess : float
        Effective sample size before resampling.
    spread_m, spread_yaw_rad : float
        Spread of the particles about the estimate [m, rad].
    match_share : float
        Mean value of a point, on average over the particles, between 0 (all off the map) and 1 (all on it).
    n_points : int
        Points in the cloud.
    is_informed : bool
        False when the scan had no points or matched nowhere, and only the motion model moved the particles.
    """

    index: int
    pose: np.ndarray
    particles: np.ndarray
    weights: np.ndarray
    next_particles: np.ndarray
    next_weights: np.ndarray
    ess: float
    spread_m: float
    spread_yaw_rad: float
    match_share: float
    n_points: int
    is_informed: bool


def update(
    index: int,
    particles: np.ndarray,
    weights: np.ndarray,
    points: np.ndarray,
    grid: MapGrid,
    settings: MclSettings,
    rng: np.random.Generator,
) -> MclUpdate:
    """Weigh moved particles by one scan, estimate the pose, and resample.

    Parameters
    ----------
    index : int
        Number of the scan.
    particles, weights : array, shape (n, 3) and (n,)
        Particles after `predict` and their weights.
    points : array, shape (m, 2)
        The scan's cloud in the radar frame [m]; without points the particles are left to the motion model.
    grid : MapGrid
        From `build_grid` with the same settings.
    settings : MclSettings
        Likelihood and resampling.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    result : MclUpdate
        Yin et al. 2020, Sec. III-B, Eq. 6-9.
    """
    is_informed, share = len(points) > 0, 0.0
    if is_informed:
        sums = count_matches(particles, points, grid.values, grid.origin, grid.cell)
        weights, is_informed = normalize_weights(weigh(sums, settings.exponent), weights)
        share = float(weights @ sums) / (len(points) * grid.best)
    pose, spread_m, spread_yaw = estimate_pose(particles, weights)
    ess, kept, kept_weights = effective_sample_size(weights), particles, weights
    if is_informed and ess <= settings.resample_below * len(weights):
        draw = {"multinomial": resample_multinomial, "systematic": resample_systematic}[settings.resampling]
        n = len(weights)
        if settings.min_particles:
            n = int(
                np.clip(
                    count_needed(particles[draw(weights, rng)]), settings.min_particles, settings.n_particles
                )
            )
        kept, kept_weights = particles[draw(weights, rng, n)], np.full(n, 1.0 / n)
    return MclUpdate(
        index,
        pose,
        particles,
        weights,
        kept,
        kept_weights,
        ess,
        spread_m,
        spread_yaw,
        share,
        len(points),
        is_informed,
    )


def localize(
    steps: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    grid: MapGrid,
    start: np.ndarray,
    settings: MclSettings,
    rng: np.random.Generator,
    supervisor: Callable[[int, np.ndarray], np.ndarray | None] | None = None,
    move: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray] | None = None,
    n_first: int | None = None,
) -> Iterator[MclUpdate]:
    """Run the filter scan by scan; a generator, so it can follow a live sensor.

    Parameters
    ----------
    steps : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Cloud of each scan in the radar frame [m].
    grid : MapGrid
        From `build_grid` with the same settings.
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    settings : MclSettings
        See there.
    rng : numpy.random.Generator
        Source of randomness.
    supervisor : callable, optional
        Called with the scan's number and the estimate; a pose that it returns restarts the particles there,
        as the authors did by hand.
    move : callable, optional
        Moves particles by a step, such as `rol_beyond.motion.sample_motion` with a learnt model; `predict` if not given.
    n_first : int, optional
        Particles at the first scan, where the start is known badly; ``settings.n_particles`` if not given.

    Yields
    ------
    result : MclUpdate
        One per scan. Yin et al. 2020, Sec. III-B.
    """
    spreads = settings.start_spread_m, settings.start_spread_yaw_rad
    n = n_first or settings.n_particles
    particles, weights = sample_particles(start, n, *spreads, rng), np.full(n, 1.0 / n)
    steps = iter(steps)
    for index, points in enumerate(clouds):
        if index > 0:
            step = next(steps, None)
            if step is None:
                raise MclError(f"no odometry step to scan {index}: one fewer than clouds are needed")
            particles = move(particles, step, rng) if move else predict(particles, step, settings, rng)
        result = update(index, particles, weights, points, grid, settings, rng)
        yield result
        particles, weights = result.next_particles, result.next_weights
        if index == 0 and n > settings.n_particles:
            particles, weights = _keep_some(particles, weights, settings.n_particles, rng)
        restart = supervisor(index, result.pose) if supervisor else None
        if restart is not None:
            particles = sample_particles(restart, settings.n_particles, *spreads, rng)
            weights = np.full(settings.n_particles, 1.0 / settings.n_particles)


def _keep_some(
    particles: np.ndarray, weights: np.ndarray, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Let n of the particles stand for all, by their weights; all the same if there are no more than n."""
    n = min(n, len(particles))
    drawn = np.sort(
        resample_systematic(weights, rng)
    )  # sorted, so that every so many-th stands for its neighbours
    chosen = drawn[np.linspace(0, len(drawn), n, endpoint=False, dtype=int)]
    return particles[chosen], np.full(n, 1.0 / n)


def _pick(weights: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Find draws in [0, 1] on the cumulative weights; one past their rounded end takes the last positive."""
    indices = np.searchsorted(np.cumsum(weights), draws, side="right")
    return np.minimum(indices, np.flatnonzero(weights)[-1])


def _check_weights(weights: np.ndarray) -> np.ndarray:
    """Check weights and scale them to sum to one."""
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 1 or len(weights) == 0:
        raise MclError(f"weights: expected shape (n,), got {weights.shape}")
    if not np.isfinite(weights).all() or (weights < 0).any():
        raise MclError("weights must be finite and not negative")
    if weights.sum() <= 0:
        raise MclError("all weights are zero")
    return weights / weights.sum()


def _check_points(points: np.ndarray, name: str) -> np.ndarray:
    """Check a finite cloud (m, 2) and give it as contiguous float64."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise MclError(f"{name}: expected points of shape (m, 2), got {points.shape}")
    if not np.isfinite(points).all():
        raise MclError(f"{name}: a point is not finite")
    return points
