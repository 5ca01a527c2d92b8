"""Odometry by registration: 2D point-to-point ICP between the clouds of successive scans.

The motion u of the filter (paper, Sec. III-B): the cloud of one scan is registered to the cloud of the scan
before. A result ``T_target_source`` maps points of the source into the target's frame. With the earlier scan
as the target it is the odometry increment: the pose of the later scan in the earlier one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

if __package__:
    from .compiled import compiled
    from .geometry import check_fields, check_points, check_pose
else:  # this file was copied and is imported by its own name
    from compiled import compiled
    from geometry import check_fields, check_points, check_pose


class OdometryError(ValueError):
    """A cloud or a setting that no registration can use; the message names it."""


@dataclass(frozen=True)
class IcpSettings:
    """Settings of `icp_2d`.

    Attributes
    ----------
    max_distance, min_distance : float
        Pairs farther apart than a limit are discarded. The limit falls from the first value to the second by
        a fifth per iteration: the first fits correct large offsets, the last ones exclude false neighbours
        [m].
    trim : float
        Fraction of the remaining pairs, the closest ones, that is kept.
    max_iterations : int
        Largest number of fits.
    tolerance : float
        Stop when the limit has reached ``min_distance`` and a fit moves less than this [m, and rad at 30 m].
    min_matched : int
        With fewer pairs the registration stops and ``converged`` is False.
    max_points : int
        Of a larger source this many points are used, evenly spaced; the target is used whole. With clouds of
        3,000 points the result is as good with 1,000, in a quarter of the time.

    Raises
    ------
    OdometryError
        If a value is out of its range; the message names it.
    """

    max_distance: float = 3.0
    min_distance: float = 1.0
    trim: float = 0.9
    max_iterations: int = 30
    tolerance: float = 1e-3
    min_matched: int = 10
    max_points: int = 1000

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf]": "max_distance min_distance",
            "(0, 1]": "trim",
            "[0, inf)": "tolerance",
            "[1, inf)": "max_iterations min_matched max_points",
        }
        check_fields(self, allowed, OdometryError)


@dataclass(frozen=True)
class IcpResult:
    """Result of one registration.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the source in the target [m, m, rad]; the initial guess where nothing could be matched.
    n_matched : int
        Pairs in the last fit.
    rmse_m : float
        Root mean square distance of these pairs [m]; NaN without pairs.
    iterations : int
        Fits made.
    converged : bool
        True when the last fits moved less than the tolerance; False also for clouds too small to be matched.
    """

    T_target_source: np.ndarray
    n_matched: int
    rmse_m: float
    iterations: int
    converged: bool


class SortedCloud(NamedTuple):
    """Target cloud with points sorted by cells of 1 m, for several registrations; from `sort_cloud`.

    Attributes
    ----------
    points : array, shape (n, 2)
        Points in the order of their cells [m].
    starts : array of int, shape (k,)
        Index of the first point of each cell, and the number of points at the end.
    around : tuple of float
        Points outside this circle are ignored: x and y of its centre [m], its squared radius [m2].
    """

    points: np.ndarray
    starts: np.ndarray
    around: tuple[float, float, float] = (0.0, 0.0, np.inf)


def fit_rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit the rigid motion between paired points by least squares.

    Parameters
    ----------
    source, target : array, shape (n, 2)
        Points [m]; row i of one is paired with row i of the other; n at least 2.

    Returns
    -------
    T_target_source : array, shape (3,)
        Minimizer of the sum of squared distances [m, m, rad]. In the plane the SVD solution of Arun et al.
        has this closed form: the heading is the angle of (sum of dot products, sum of cross products).

    Raises
    ------
    OdometryError
        If an array is no finite cloud, or the clouds have different sizes.
    """
    source = check_points(source, "source", error=OdometryError)
    target = check_points(target, "target", error=OdometryError)
    if len(source) != len(target):
        raise OdometryError(f"{len(source)} source points cannot be paired with {len(target)} target points")
    rows = np.arange(len(source))
    return np.array(_fit_rigid(source, target, rows, rows)[0])


def sort_cloud(points: np.ndarray, name: str = "target cloud") -> SortedCloud:
    """Sort a cloud by cells, as `icp_2d` does with its target at each call.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m].
    name : str
        Name of the cloud in the message.

    Returns
    -------
    cloud : SortedCloud

    Raises
    ------
    OdometryError
        If the cloud has another shape or a value that is not finite.
    """
    return SortedCloud(*_sort(check_points(points, name, error=OdometryError)))


def icp_2d(
    source: np.ndarray,
    target: np.ndarray | SortedCloud,
    init: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: IcpSettings = IcpSettings(),
) -> IcpResult:
    """Register two clouds by point-to-point ICP.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m]; a target of several registrations may be a `SortedCloud`.
    init : array-like, shape (3,)
        Initial guess of T_target_source [m, m, rad].
    settings : IcpSettings
        Limits of the pairs and of the iteration.

    Returns
    -------
    result : IcpResult
        For empty or too small clouds the initial guess, with ``converged`` False.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite.

    Notes
    -----
    Yin et al. 2020, Sec. III-B, below Eq. 7.
    """
    source = check_points(source, "source cloud", error=OdometryError)
    pose = check_pose(init, "initial guess").copy()
    target = target if isinstance(target, SortedCloud) else sort_cloud(target)
    if min(len(source), _count_around(target, settings.min_matched)) < settings.min_matched:
        return IcpResult(pose, 0, float("nan"), 0, False)
    limits = float(settings.max_distance), float(settings.min_distance)
    stops = float(settings.trim), settings.max_iterations, float(settings.tolerance), settings.min_matched
    source = choose_evenly(source, settings.max_points)
    return IcpResult(*_iterate_icp(source, target, pose, limits, stops))


def scan_to_scan_icp(
    clouds: Iterable[np.ndarray],
    first_guess: np.ndarray | None = None,
    settings: IcpSettings = IcpSettings(),
    refine_guess: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Iterator[IcpResult]:
    """Register each cloud to the one before, with a constant-velocity initial guess.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m].
    first_guess : array, shape (3,), optional
        Initial guess of the first increment [m, m, rad]; zero if not given.
    settings : IcpSettings
        Settings of `icp_2d`.
    refine_guess : callable, optional
        Takes source, target and guess and returns a better initial guess; not in the paper.

    Yields
    ------
    result : IcpResult
        One fewer than clouds: the pose of each scan in the one before. Where the registration is impossible
        (an empty cloud, for instance) the increment is the guess and ``n_matched`` is below ``min_matched``.

    Notes
    -----
    Yin et al. 2020, Sec. III-B.
    """
    clouds = iter(clouds)
    guess = np.zeros(3) if first_guess is None else check_pose(first_guess, "first guess")
    target = next(clouds, None)
    for source in clouds:
        start = refine_guess(source, target, guess) if refine_guess else guess
        result = icp_2d(source, target, start, settings)
        yield result
        guess, target = result.T_target_source, source


def stack_increments(results: Iterable[IcpResult]) -> np.ndarray:
    """Stack the increments of successive registrations.

    Parameters
    ----------
    results : iterable of IcpResult
        From `scan_to_scan_icp`, or any objects with ``T_target_source``.

    Returns
    -------
    increments : array, shape (n, 3)
        Row i is the pose of scan i + 1 in scan i [m, m, rad].
    """
    increments = [result.T_target_source for result in results]
    return np.array(increments).reshape(-1, 3)


def choose_evenly(points: np.ndarray, n: int) -> np.ndarray:
    """Choose at most n points, evenly spaced in their order, shape (n, 2)."""
    return points[np.linspace(0, len(points) - 1, min(len(points), n)).astype(int)]


# Nearest neighbours are searched in cells of 1 m. The cells of a cloud are numbered as on a torus: cell
# (i, j) shares its number with (i + width, j), (i, j + width) and so on. Distant points need no memory, and
# no point is missed.


@compiled
def cell_index(x):
    """Number the 1 m cell along one axis; coordinates beyond 1e15 m share the outermost cell."""
    return np.int64(np.floor(min(max(x, -1e15), 1e15)))


@compiled
def _sort(points):
    """Sort points by cell; return them and the first index of each cell, shape (width^2 + 1,)."""
    width = 8
    while width * width < 4 * len(points):
        width *= 2
    cells, starts = np.empty(len(points), np.int64), np.zeros(width * width + 2, np.int64)
    for k in range(len(points)):
        u, v = cell_index(points[k, 0]), cell_index(points[k, 1])
        cells[k] = (u & (width - 1)) * width + (v & (width - 1))
        starts[cells[k] + 2] += 1
    # Summed in place, since the array is large for a large map.
    for cell in range(2, len(starts)):
        starts[cell] += starts[cell - 1]
    found = np.empty_like(points)
    for k in range(len(points)):
        found[starts[cells[k] + 1]] = points[k]  # entry c + 1: start of cell c, its end when all are placed
        starts[cells[k] + 1] += 1
    return found, starts[:-1]


@compiled
def _count_around(target, enough):
    """Count the points of a `SortedCloud` in its circle, up to ``enough``."""
    points, _, (x, y, limit) = target
    n = 0
    for k in range(len(points)):
        n += (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2 <= limit
        if n >= enough:
            break
    return n


@compiled
def _find_nearest(x, y, target, limit):
    """Find the nearest point to (x, y) below a squared distance; return its index and squared distance.

    Without such a point these are -1 and the limit. Cells of the `SortedCloud` are searched in square rings,
    until the next ring is too far away or the torus is closed.
    """
    points, starts, around = target
    width = np.int64(np.sqrt(len(starts) - 1))
    u, v, nearest = cell_index(x), cell_index(y), -1
    margin = min(x - u, u + 1 - x, y - v, v + 1 - y)
    for ring in range(width // 2 + 1):
        gap = ring - 1 + margin
        if gap > 0.0 and gap * gap >= limit:
            break
        for i in range(-ring, ring + 1):
            aside, row = max(u + i - x, x - u - i - 1, 0.0), ((u + i) & (width - 1)) * width
            for j in range(-ring, ring + 1, 1 if abs(i) == ring else 2 * ring):
                cell = row + ((v + j) & (width - 1))
                if starts[cell] == starts[cell + 1]:
                    continue
                if aside * aside + max(v + j - y, y - v - j - 1, 0.0) ** 2 >= limit:
                    continue
                for k in range(starts[cell], starts[cell + 1]):
                    square = (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2
                    if square < limit:
                        away = (points[k, 0] - around[0]) ** 2 + (points[k, 1] - around[1]) ** 2
                        if away <= around[2]:
                            nearest, limit = k, square
    return nearest, limit


@compiled
def pair_points(pose, source, target, limit):
    """Transform points and pair each with its nearest target point.

    Returns the transformed points that have a neighbour below the squared limit, shape (k, 2), its index in
    the target and the squared distance, shape (k,).
    """
    moved, matched = np.empty_like(source), np.empty(len(source), np.int64)
    squares, c, s, n = np.empty(len(source)), np.cos(pose[2]), np.sin(pose[2]), 0
    for k in range(len(source)):
        x = c * source[k, 0] - s * source[k, 1] + pose[0]
        y = s * source[k, 0] + c * source[k, 1] + pose[1]
        matched[n], squares[n] = _find_nearest(x, y, target, limit)
        moved[n, 0], moved[n, 1] = x, y
        n += matched[n] >= 0
    return moved[:n], matched[:n], squares[:n]


@compiled
def _find_closest(squares, fraction):
    """Select the indices of the smallest values, the given fraction of them."""
    n = int(np.ceil(fraction * len(squares)))
    if n == len(squares):
        return np.arange(n)
    bound = np.partition(squares, n - 1)[n - 1] if n else 0.0
    below, equal = np.flatnonzero(squares < bound), np.flatnonzero(squares == bound)
    return np.concatenate((below, equal[: n - len(below)]))


@compiled
def _fit_rigid(source, target, rows, matched):
    """Fit as `fit_rigid` does; source row k, for k in ``rows``, is paired with target row ``matched[k]``.

    Returns the motion (x, y, yaw) as a tuple, and whether these source points are not all at one place.
    """
    x, y, u, v = 0.0, 0.0, 0.0, 0.0
    for k in rows:
        x, y = x + source[k, 0], y + source[k, 1]
        u, v = u + target[matched[k], 0], v + target[matched[k], 1]
    n = max(len(rows), 1)
    x, y, u, v = x / n, y / n, u / n, v / n
    dots, crosses, is_fixed = 0.0, 0.0, False
    for k in rows:
        a, b, p, q = source[k, 0] - x, source[k, 1] - y, target[matched[k], 0] - u, target[matched[k], 1] - v
        dots += a * p + b * q
        crosses += a * q - b * p
        is_fixed |= source[k, 0] != source[rows[0], 0] or source[k, 1] != source[rows[0], 1]
    yaw = np.arctan2(crosses, dots)
    c, s = np.cos(yaw), np.sin(yaw)
    return (u - c * x + s * y, v - s * x - c * y, yaw), is_fixed


@compiled
def _iterate_icp(source, target, pose, limits, stops):
    """Alternate pairing and fitting; return the fields of `IcpResult` in their order."""
    limit, (trim, max_iterations, tolerance, min_matched) = limits[0], stops
    n_matched, rmse_m, iteration, is_done = 0, np.nan, 0, False
    for iteration in range(1, max_iterations + 1):
        moved, matched, squares = pair_points(pose, source, target, limit * limit)
        kept = _find_closest(squares, trim)
        (x, y, yaw), is_fixed = _fit_rigid(moved, target.points, kept, matched)
        n_matched = len(kept)
        if n_matched < min_matched or not is_fixed:
            return pose, n_matched, rmse_m, iteration - 1, False
        rmse_m = np.sqrt(np.mean(squares[kept]))
        c, s, last = np.cos(yaw), np.sin(yaw), pose
        heading = (yaw + last[2] + np.pi) % (2.0 * np.pi) - np.pi
        pose = np.array([x + c * last[0] - s * last[1], y + s * last[0] + c * last[1], heading])
        shift = np.hypot(pose[0] - last[0], pose[1] - last[1]) + 30.0 * abs(yaw)
        is_done = limit <= limits[1] and shift < tolerance
        if is_done:
            break
        limit = max(0.8 * limit, limits[1])
    return pose, n_matched, rmse_m, iteration, is_done
