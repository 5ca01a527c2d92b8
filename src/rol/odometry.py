"""Odometry by registration: 2D point-to-point ICP between successive clouds, and a better way.

The motion u of the filter (paper, Sec. III-B): the cloud of one scan is aligned to the cloud of the scan
before. A result ``T_target_source`` maps points of the source into the target's frame; with the earlier scan
as the target it is the step of the car, seen from where it was. `chain` is the paper's way. Beside it stands the
book's own, `local_map_odometry`: each cloud is aligned to those of the last metres, corrected for the car's motion
during the turn of the radar and for Doppler, with the velocity that comes out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

try:
    from .compiled import compiled
    from .geometry import (
        check_fields,
        check_number,
        check_poses,
        compose,
        relative_pose,
        transform_points,
        wrap_angle,
    )
except ImportError:  # this file was copied on its own
    from compiled import compiled
    from geometry import (
        check_fields,
        check_number,
        check_poses,
        compose,
        relative_pose,
        transform_points,
        wrap_angle,
    )


_FIRST_REACH = (6.0, 0.8, np.deg2rad(4.0))  # of a search for the first motion [m, m, rad]
_REACH = (2.0, 0.8, np.deg2rad(8.0))  # of one for a later motion, up to half a second long
_MAX_CELLS = 10**8  # of a search: 400 MB


class OdometryError(ValueError):
    """Raised for clouds that are no clouds: wrong shape, or values that are not finite."""


@dataclass(frozen=True)
class IcpResult:
    """Outcome of one registration.

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
    weakest_direction : float
        How well the last pairs constrain the translation in its weakest direction, as a fraction of the strongest:
        near 0 along one straight wall, where the pose can slide although ICP converged; 1 where all directions are
        equal. A pair on a line counts only across it; the line is fitted to the target points within 2 m. NaN
        without pairs.
    """

    T_target_source: np.ndarray
    n_matched: int
    rmse_m: float
    iterations: int
    converged: bool
    weakest_direction: float = float("nan")


class SortedCloud(NamedTuple):
    """A target cloud whose points are sorted by cells of 1 m, for many registrations; from `sort_cloud`.

    Attributes
    ----------
    points : array, shape (n, 2)
        The points in the order of their cells [m].
    starts : array of int, shape (k,)
        Where the points of each cell start, and their number at the end.
    around : tuple of float
        Points outside this circle do not count: x and y of its centre [m], its squared radius [m2].
    """

    points: np.ndarray
    starts: np.ndarray
    around: tuple[float, float, float] = (0.0, 0.0, np.inf)


def check_cloud(points: np.ndarray, name: str) -> np.ndarray:
    """Check that an array is a finite cloud.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m]; n may be zero.
    name : str
        What the cloud is called in the message.

    Returns
    -------
    points : array, shape (n, 2)
        The same values as float64.

    Raises
    ------
    OdometryError
        If the shape is another one or a value is not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise OdometryError(f"{name}: expected points of shape (n, 2), got {points.shape}")
    if not np.isfinite(points).all():
        raise OdometryError(f"{name}: point {int(np.argwhere(~np.isfinite(points))[0, 0])} is not finite")
    return points


def fit_rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Find the rigid motion that brings paired points together with least squares.

    Parameters
    ----------
    source, target : array, shape (n, 2)
        Points [m]; row i of one belongs to row i of the other; n at least 2.

    Returns
    -------
    T_target_source : array, shape (3,)
        The minimizer of the sum of squared distances [m, m, rad]. In the plane the SVD solution of Arun et
        al. has this closed form: the heading is the angle of (sum of dot products, sum of cross products).

    Raises
    ------
    OdometryError
        If a cloud is none, or has more points than the other.
    """
    source, target = check_cloud(source, "source"), check_cloud(target, "target")
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
        What the cloud is called in the message.

    Returns
    -------
    cloud : SortedCloud

    Raises
    ------
    OdometryError
        If the cloud has another shape or a value that is not finite.
    """
    return SortedCloud(*_sort(np.ascontiguousarray(check_cloud(points, name))))


def icp_2d(
    source: np.ndarray,
    target: np.ndarray | SortedCloud,
    init: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    max_distance: float = 3.0,
    min_distance: float = 1.0,
    trim: float = 0.9,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
    min_matched: int = 10,
    max_points: int = 1000,
) -> IcpResult:
    """Align one cloud to another by iterating nearest neighbours and rigid fits.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m]; a target of several registrations may be a `SortedCloud`.
    init : array-like, shape (3,)
        First guess of T_target_source [m, m, rad].
    max_distance, min_distance : float
        Pairs further apart than a limit are dropped; the limit falls from the one to the other by a fifth at
        each iteration, so that the first fits can pull from afar and the last ones see no false neighbours
        [m].
    trim : float
        Share of the remaining pairs, the closest, that is kept.
    max_iterations : int
        Fits at most.
    tolerance : float
        Stop when the limit has reached ``min_distance`` and a fit moves less than this [m, and rad at 30 m].
    min_matched : int
        Fewer pairs than this cannot be trusted: stop with ``converged`` False.
    max_points : int
        Of a larger source only so many points are used, evenly chosen; the target is used whole. On clouds of
        3,000 points the steps are as good with 1,000, in a quarter of the time.

    Returns
    -------
    result : IcpResult
        For empty or too small clouds the initial guess, ``converged`` False.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite, or a setting is out of its range. Yin et al. 2020,
        Sec. III-B, below Eq. 7.
    """
    for name, value, span in (
        ("max_distance", max_distance, "(0, inf]"),
        ("min_distance", min_distance, "(0, inf]"),
        ("trim", trim, "(0, 1]"),
        ("tolerance", tolerance, "[0, inf)"),
    ):
        check_number(name, value, span, error=OdometryError)
    for name, value in (
        ("max_iterations", max_iterations), ("min_matched", min_matched), ("max_points", max_points)
    ):  # fmt: skip
        check_number(name, value, "[1, inf)", True, OdometryError)
    source, pose = check_cloud(source, "source cloud"), check_poses(init, "initial guess").copy()
    target = target if isinstance(target, SortedCloud) else sort_cloud(target)
    if min(len(source), _count_around(target, min_matched)) < min_matched:
        return IcpResult(pose, 0, float("nan"), 0, False)
    limits = float(max_distance), float(min_distance)
    stops = float(trim), int(max_iterations), float(tolerance), int(min_matched)
    return IcpResult(*_iterate_icp(_choose(source, max_points), target, pose, limits, stops))


def search_motion(
    source: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    reach: tuple[float, float, float] = (2.0, 0.8, np.deg2rad(4.0)),
    cell: float = 0.125,
    max_points: int = 600,
) -> np.ndarray:
    """Find a first guess for ICP by trying motions about a given one: first in coarse steps, then in fine ones.

    Nearest neighbours pull a cloud of thick strokes wherever it overlaps already, and it stays near the first
    guess. How many points fall onto the other cloud has its greatest value at the true motion.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m].
    guess : array-like, shape (3,)
        Middle of the search [m, m, rad].
    reach : tuple of float
        How far to search to each side in x, y [m] and heading [rad].
    cell : float
        Side of the cells in which the target is marked, each with its neighbours [m].
    max_points : int
        Of a larger source only so many points are used, evenly chosen.

    Returns
    -------
    pose : array, shape (3,)
        The best T_target_source, of equally good ones the nearest to the guess; the guess itself for an empty
        cloud. It is tried in steps of 0.4 m and 1 deg, then, within a
        fifth of the reach, of 0.08 m and 0.2 deg.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite, a setting is out of its range, or if both extend so
        far that the grid would need more than 400 MB.
    """
    check_number("reach", reach, "[0, 100]", error=OdometryError)  # all candidates are held in memory
    check_number("cell", cell, "(0, inf)", error=OdometryError)
    check_number("max_points", max_points, "[1, inf)", True, OdometryError)
    source, target = check_cloud(source, "source cloud"), check_cloud(target, "target cloud")
    best = check_poses(guess, "initial guess").copy()
    if min(len(source), len(target)) == 0:
        return best
    source = _choose(source, max_points)
    target = _within_reach(source, target, best, reach, cell)
    if len(target) == 0:
        return best
    corner = target.min(axis=0) - 3.5 * cell  # points of an image then lie in the middle of cells
    marked = np.zeros(np.ceil((target.max(axis=0) - corner) / cell).astype(int) + 4, dtype=np.int32)
    u, v = np.floor((target - corner) / cell).astype(int).T
    for reach_cells in (2, 1):  # near a point is worth one, at a point two
        for i, j in np.ndindex(2 * reach_cells + 1, 2 * reach_cells + 1):
            marked[u + i - reach_cells, v + j - reach_cells] = 3 - reach_cells
    for share in (1.0, 0.2):  # the second time within a fifth of the reach, in steps a fifth as long
        offsets = _offsets(share * np.array(reach), share * np.array([0.4, 0.4, np.deg2rad(1.0)]))
        candidates = best + offsets
        best = candidates[np.argmax(_count_marked(candidates, source, marked, corner, cell))]
    return best


def chain(
    clouds: Iterable[np.ndarray],
    first_guess: np.ndarray | None = None,
    *,
    search: bool = False,
    **settings: float,
) -> Iterator[IcpResult]:
    """Register each cloud to the one before, guessing that the car goes on as it went.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m].
    first_guess : array, shape (3,), optional
        Guess of the first step [m, m, rad]; standing still if not given.
    search : bool
        Improve each guess by `search_motion` before ICP: not in the paper.
    **settings
        Of `icp_2d`.

    Yields
    ------
    result : IcpResult
        One fewer than clouds: the pose of each scan in the one before. Where the registration cannot be made,
        an empty cloud for instance, the step is the guess (constant velocity) and ``n_matched`` is below
        ``min_matched``.
    """
    clouds = iter(clouds)
    guess = np.zeros(3) if first_guess is None else check_poses(first_guess, "first guess")
    target = next(clouds, None)
    for source in clouds:
        start = search_motion(source, target, guess) if search else guess
        result = icp_2d(source, target, start, **settings)
        yield result
        guess, target = result.T_target_source, source


def steps_of(results: Iterable[IcpResult]) -> np.ndarray:
    """Stack the steps of a chain.

    Parameters
    ----------
    results : iterable of IcpResult
        From `chain`.

    Returns
    -------
    steps : array, shape (n, 3)
        Step i is the pose of scan i + 1 in scan i [m, m, rad].
    """
    steps = [result.T_target_source for result in results]
    return np.array(steps).reshape(-1, 3)


def follow_map(
    steps: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    start: np.ndarray,
    supervisor: Callable[[int, np.ndarray], np.ndarray | None] | None = None,
    *,
    reach_m: float = 75.0,
    min_share: float = 0.2,
    max_points: int = 1000,
    **settings: float,
) -> Iterator[IcpResult]:
    """Follow the pose on a map by ICP alone, without a filter: each cloud is registered from the last pose and the step.

    Parameters
    ----------
    steps : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (n, 2)
        Cloud of each scan in the radar frame [m].
    map_points : array, shape (m, 2)
        The map [m].
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    supervisor : callable, optional
        As in `rol.mcl.localize`: a pose that it returns is where the next scan begins.
    reach_m : float
        Map points farther from the guess than this are left out [m].
    min_share : float
        A registration that does not come to rest, or ends with a smaller share of the points in pairs, is not believed.
        To take it all the same was worse on 2,000 scans of the real route.
    max_points, **settings
        Of `icp_2d`.

    Yields
    ------
    result : IcpResult
        One per scan, the pose T_map_radar as ``T_target_source``. Where the registration is not believed it is the
        guess, the last pose moved by the step, and ``converged`` is False. Yin et al. 2020, Sec. III-B.

    Raises
    ------
    OdometryError
        If there are fewer steps than clouds ask for, or a cloud is none.
    """
    target, pose, steps = sort_cloud(map_points, "map"), check_poses(start, "start"), iter(steps)
    for index, cloud in enumerate(clouds):
        step = np.zeros(3) if index == 0 else next(steps, None)
        if step is None:
            raise OdometryError(f"no odometry step to scan {index}: one fewer than clouds are needed")
        guess = compose(pose, step)
        near = target._replace(around=(float(guess[0]), float(guess[1]), float(reach_m) ** 2))
        result = icp_2d(cloud, near, guess, max_points=max_points, **settings)
        if not result.converged or result.n_matched < min_share * min(len(cloud), max_points):
            result = replace(result, T_target_source=guess, converged=False)
        yield result
        restart = supervisor(index, result.T_target_source) if supervisor else None
        pose = result.T_target_source if restart is None else check_poses(restart, "restart")


def _within_reach(
    source: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray,
    reach: tuple[float, float, float],
    cell: float,
) -> np.ndarray:
    """Discard target points that no source point can reach; refuse what is still too wide for a grid."""
    longest = np.hypot(*source.T).max() + 1.2 * np.hypot(*reach[:2]) + 4.0 * cell
    target = target[np.hypot(*(target - guess[:2]).T) <= longest]
    sides = np.ptp(target, axis=0) if len(target) else np.zeros(2)
    if np.prod(sides / cell + 8.0) > _MAX_CELLS:
        raise OdometryError(
            f"source and target cloud: points extend over {sides[0]:.0f} m x {sides[1]:.0f} m, too far for cells of "
            f"{cell} m; remove stray points"
        )
    return target


def _offsets(reach: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Motions on a grid around zero, the nearest to zero first, shape (n, 3)."""
    axes = [k * np.arange(-round(r / k), round(r / k) + 1) for r, k in zip(reach, step, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.argsort(np.abs(grid / step).sum(axis=1), kind="stable")]


def _count_marked(
    poses: np.ndarray, points: np.ndarray, marked: np.ndarray, corner: np.ndarray, cell: float
) -> np.ndarray:
    """How many points fall on marked cells from each pose, shape (n,)."""
    c, s = np.cos(poses[:, 2:]) / cell, np.sin(poses[:, 2:]) / cell
    x, y = ((poses[:, :2] - corner) / cell).T
    u = (x[:, None] + c * points[:, 0] - s * points[:, 1]).astype(np.int32)
    v = (y[:, None] + s * points[:, 0] + c * points[:, 1]).astype(np.int32)
    np.clip(u, 0, marked.shape[0] - 1, out=u)  # the rim is free
    np.clip(v, 0, marked.shape[1] - 1, out=v)
    return marked[u, v].sum(axis=1)


def _choose(points: np.ndarray, n: int) -> np.ndarray:
    """Choose at most n points, evenly spaced in their order."""
    return points[np.linspace(0, len(points) - 1, min(len(points), n)).astype(int)]


# ---- nearest neighbours in cells of 1 m, compiled ----------------------------------------------------------------
# The cells of a cloud are numbered as on a torus: cell (i, j) shares its number with (i + width, j), (i, j + width)
# and so on. Points far away cost no memory, and no point is missed.


@compiled
def _to_cell(x):
    """Number the 1 m cell along one axis; coordinates beyond 1e15 m share the outermost cell."""
    return np.int64(np.floor(min(max(x, -1e15), 1e15)))


@compiled
def _sort(points):
    """Sort points by cell: the sorted points, and where those of each cell start, shape (width^2 + 1,)."""
    width = 8
    while width * width < 4 * len(points):
        width *= 2
    cells, starts = np.empty(len(points), np.int64), np.zeros(width * width + 1, np.int64)
    for k in range(len(points)):
        u, v = _to_cell(points[k, 0]), _to_cell(points[k, 1])
        cells[k] = (u & (width - 1)) * width + (v & (width - 1))
        starts[cells[k] + 1] += 1
    starts = np.cumsum(starts)
    free, found = starts.copy(), np.empty_like(points)
    for k in range(len(points)):
        found[free[cells[k]]] = points[k]
        free[cells[k]] += 1
    return found, starts


@compiled
def _count_around(target, enough):
    """Count the points in the circle, no further than enough of them."""
    points, _, (x, y, limit) = target
    n = 0
    for k in range(len(points)):
        n += (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2 <= limit
        if n >= enough:
            break
    return n


@compiled
def _find_nearest(x, y, target, limit):
    """Find the point nearest to (x, y): its index and squared distance, (-1, limit) if none is below this limit.

    Cells of the `SortedCloud` are searched in square rings, until the next ring is too far away or the torus is closed.
    """
    points, starts, around = target
    width = np.int64(np.sqrt(len(starts) - 1))
    u, v, nearest = _to_cell(x), _to_cell(y), -1
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
def _pair(pose, source, target, limit):
    """Move points and pair them: the points with a neighbour, its index, and the squared distance."""
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
    """Fit as `fit_rigid` does: row k of the source, of those in ``rows``, belongs to row ``matched[k]`` of the target.

    Returns the motion (x, y, yaw) as a tuple, and whether these points of the source are apart from each other.
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
    n_matched, rmse_m = 0, np.nan
    for iteration in range(1, max_iterations + 1):
        moved, matched, squares = _pair(pose, source, target, limit * limit)
        kept = _find_closest(squares, trim)
        (x, y, yaw), is_fixed = _fit_rigid(moved, target.points, kept, matched)
        n_matched = len(kept)
        if n_matched < min_matched or not is_fixed:
            return pose, n_matched, rmse_m, iteration - 1, False, np.nan
        rmse_m = np.sqrt(np.mean(squares[kept]))
        c, s, last = np.cos(yaw), np.sin(yaw), pose
        heading = (yaw + last[2] + np.pi) % (2.0 * np.pi) - np.pi
        pose = np.array([x + c * last[0] - s * last[1], y + s * last[0] + c * last[1], heading])
        shift = np.hypot(pose[0] - last[0], pose[1] - last[1]) + 30.0 * abs(yaw)
        is_done = limit <= limits[1] and shift < tolerance
        if is_done or iteration == max_iterations:
            return pose, n_matched, rmse_m, iteration, is_done, _weigh_directions(target, matched[kept])
        limit = max(0.8 * limit, limits[1])
    return pose, 0, np.nan, 0, False, np.nan  # no iterations were allowed


@compiled
def _weigh_directions(target, matched):
    """Compute `IcpResult.weakest_direction` from at most 100 of the matched points."""
    total, even, slanted = 0.0, 0.0, 0.0  # xx + yy, xx - yy and 2 xy of the sum of the weights
    for m in range(0, len(matched), len(matched) // 100 + 1):
        n, xx, yy, xy = _spread_about(target, target.points[matched[m]], 2.0, len(target.points))
        largest = xx + yy + np.hypot(xx - yy, 2.0 * xy)  # twice the variance along the line
        if n < 3 or largest == 0.0:
            total += 1.0
        else:
            total += (xx + yy) / largest
            even -= (xx - yy) / largest
            slanted -= 2.0 * xy / largest
    unequal = np.hypot(even, slanted)
    return max((total - unequal) / (total + unequal), 0.0)


@compiled
def _spread_about(target, centre, radius, most):
    """Compute number, variances and covariance (n, xx, yy, xy) of the ``most`` nearest points within a radius."""
    near, n, x, y, xx, yy, xy = _find_near(target, centre, radius), 0, 0.0, 0.0, 0.0, 0.0, 0.0
    bound = np.partition(near[:, 2], most - 1)[most - 1] if len(near) > most else np.inf
    for k in range(len(near)):
        if near[k, 2] <= bound:
            u, v = near[k, 0], near[k, 1]
            n, x, y, xx, yy, xy = n + 1, x + u, y + v, xx + u * u, yy + v * v, xy + u * v
    x, y = x / n, y / n
    return n, xx / n - x * x, yy / n - y * y, xy / n - x * y


@compiled
def _find_near(target, centre, radius):
    """Collect offsets and squared distances (u, v, square) of the points within a radius, shape (n, 3)."""
    points, starts, _ = target
    width, found, n = np.int64(np.sqrt(len(starts) - 1)), np.empty((32, 3)), 0
    i, j = _to_cell(centre[0] - radius), _to_cell(centre[1] - radius)
    for p in range(i, min(_to_cell(centre[0] + radius) + 1, i + width)):
        for q in range(j, min(_to_cell(centre[1] + radius) + 1, j + width)):
            cell = (p & (width - 1)) * width + (q & (width - 1))
            for k in range(starts[cell], starts[cell + 1]):
                u, v = points[k, 0] - centre[0], points[k, 1] - centre[1]
                if u * u + v * v < radius * radius:
                    if n == len(found):
                        found = np.concatenate((found, found))
                    found[n, 0], found[n, 1], found[n, 2] = u, v, u * u + v * v
                    n += 1
    return found[:n]


# ---- not in the paper: registration to a local map -------------------------------------------------------------


@dataclass(frozen=True)
class LocalMapSettings:
    """Settings of `local_map_odometry`; each default gives its reason.

    Attributes
    ----------
    map_length_m : float
        Keyframes farther from the car than this are forgotten [m]. 20: 10 to 80 m drift alike, and a short map
        is quick.
    keyframe_m, keyframe_rad : float
        The local map gets a cloud after so much way or turning since the last one [m, rad].
    cell_m : float
        The local map keeps one point, the mean, per cell of this side [m]. 0.5: two pixels of an image.
    min_views : int
        A cell that fewer keyframes have seen is left out, once there are three of them: false points seldom fall
        twice onto one place. With half of all points false, 1 drifts four times as much as 2.
    line_radius_m, line_ratio : float
        A map point lies on a line when its neighbours within the radius [m] spread less across their main
        direction than this share of the variance along it.
    along_weight : float
        What a squared distance along such a line counts beside one across it. 0.05: with 1, point to point, steps
        err by a quarter more along the way.
    start_scale_m, end_scale_m : float
        Distance at which a pair counts a quarter; it falls from the one to the other by a fifth per fit [m].
    max_iterations, tolerance, min_matched, max_points
        As in `icp_2d`.
    rounds : int
        Registrations per scan, each with the cloud corrected for the velocity that the one before found. 2: with 1
        the drift is twice as large, and a third changes nothing.
    min_share : float
        Share of a cloud's points within ``end_scale_m`` of the local map below which a motion is not believed.
        0.2: 0.05 for clouds of nothing but false points, above 0.35 with half of them false.
    max_acceleration : float
        Change of velocity, in any direction, beyond which a motion is not believed [m/s2]. 10: full braking.
    max_yaw_rate : float
        Yaw rate beyond which a motion is not believed [rad/s]. 1.5: a tight turn at 15 km/h has 1.
    patience_s : float
        After so long without a motion that is believed the local map begins anew [s].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    map_length_m: float = 20.0
    keyframe_m: float = 1.0
    keyframe_rad: float = 0.05
    cell_m: float = 0.5
    min_views: int = 2
    line_radius_m: float = 1.5
    line_ratio: float = 0.1
    along_weight: float = 0.05
    start_scale_m: float = 2.0
    end_scale_m: float = 0.5
    max_iterations: int = 30
    tolerance: float = 1e-3
    min_matched: int = 10
    max_points: int = 1000
    rounds: int = 2
    min_share: float = 0.2
    max_acceleration: float = 10.0
    max_yaw_rate: float = 1.5
    patience_s: float = 3.0

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "map_length_m cell_m line_radius_m start_scale_m end_scale_m",
            "(0, inf]": "max_acceleration max_yaw_rate",
            "[0, inf)": "keyframe_m keyframe_rad line_ratio along_weight tolerance",
            "[0, inf]": "patience_s",
            "[1, inf)": "min_views max_iterations min_matched max_points rounds",
            "[0, 1]": "min_share",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class LocalMap:
    """Points to register to, and how distances from each are measured.

    Attributes
    ----------
    cloud : SortedCloud
        The points, shape (n, 2) [m].
    metrics : array, shape (n, 2, 2)
        Weight M of an offset d from each point, which counts d' M d: the identity, or less along a line.
    """

    cloud: SortedCloud
    metrics: np.ndarray


@dataclass(frozen=True)
class LocalMapStep:
    """Motion from one scan to the next.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the scan in the one before, both at mid-scan [m, m, rad].
    twist : array, shape (3,)
        Body velocity (vx, vy, yaw rate), what `correct_cloud` wants; constant since the last motion that was
        believed [m/s, m/s, rad/s].
    match_share : float
        Share of the cloud's points near the local map at the pose tried last; 0 where none could be tried.
    fault : str
        Empty for a motion that is believed; else why not, and the step goes on at constant velocity.
    """

    T_target_source: np.ndarray
    twist: np.ndarray
    match_share: float
    fault: str


def correct_cloud(
    points: np.ndarray,
    twist: np.ndarray | tuple[float, float, float],
    *,
    scan_seconds: float | None = None,
    doppler_seconds: float | None = None,
) -> np.ndarray:
    """Move the points of one turn of the radar to mid-scan, and take out what Doppler adds to their ranges.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points as read off a scan: each in the radar frame at its own time, which its bearing tells, since the
        beam begins ahead and turns clockwise [m].
    twist : array-like, shape (3,)
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    scan_seconds, doppler_seconds : float, optional
        Time of a turn, and range error per closing speed [s]; those of `rol.radar` if not given.

    Returns
    -------
    points : array, shape (n, 2)
        The points in the radar frame at mid-scan [m].

    Notes
    -----
    What `rol.radar.polar_to_cartesian` does to an image when it gets a twist, here for points of an image that was
    made without. Wants ``radar.py`` beside this file.
    """
    try:
        from . import radar
    except ImportError:  # this file was copied on its own
        import radar
    points = check_cloud(points, "cloud")
    turn = radar.SCAN_SECONDS if scan_seconds is None else scan_seconds
    doppler = radar.DOPPLER_SECONDS if doppler_seconds is None else doppler_seconds
    bearings, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    nearer = radar.doppler_shift(bearings, twist, doppler) / np.maximum(ranges, 1e-9)
    seconds = (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * turn
    return radar.deskew_points(points * (1.0 - nearer)[:, None], seconds, twist)


def build_local_map(clouds: Sequence[np.ndarray], settings: LocalMapSettings) -> LocalMap | None:
    """Join clouds, keep one point per cell, and find those that lie on lines.

    Parameters
    ----------
    clouds : sequence of array, shape (n, 2)
        Clouds of the keyframes in one frame [m].
    settings : LocalMapSettings
        Cells, views and lines.

    Returns
    -------
    local_map : LocalMap or None
        None without a point.
    """
    points = np.concatenate([np.zeros((0, 2)), *clouds])
    if len(points) == 0:
        return None
    owners = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    cells = np.floor((points - points.min(axis=0)) / settings.cell_m).astype(np.int64)
    _, cells = np.unique(cells @ (2**31, 1), return_inverse=True)
    seen = np.zeros((cells.max() + 1, len(clouds)), dtype=bool)
    seen[cells, owners] = True
    means = np.stack([np.bincount(cells, column) for column in points.T], axis=1)
    means /= np.bincount(cells)[:, None]
    kept = means[seen.sum(axis=1) >= min(settings.min_views, (len(clouds) + 1) // 2)]
    if len(kept) == 0:
        return None
    line = float(settings.line_radius_m), float(settings.line_ratio), float(settings.along_weight)
    cloud = sort_cloud(kept, "local map")
    return LocalMap(cloud, _line_metrics(cloud, *line))


def register_robust(
    source: np.ndarray,
    local_map: LocalMap,
    init: np.ndarray | tuple[float, float, float],
    settings: LocalMapSettings,
) -> IcpResult:
    """Align a cloud to a local map with weights that fall with distance (Geman and McClure's kernel).

    Parameters
    ----------
    source : array, shape (n, 2)
        Cloud in its own frame [m].
    local_map : LocalMap
        From `build_local_map`.
    init : array-like, shape (3,)
        First guess of T_map_source [m, m, rad].
    settings : LocalMapSettings
        Scales, iterations, sizes.

    Returns
    -------
    result : IcpResult
        ``T_target_source`` in the frame of the map; ``n_matched`` and ``rmse_m`` of the pairs within
        ``end_scale_m``; ``converged`` False, and the pose as far as it came, where too little matches.

    Raises
    ------
    OdometryError
        If the cloud has another shape or a value that is not finite.

    Notes
    -----
    A pair with the residual d has the error e = d' M d, M being its map point's, and counts 1 / (1 + e / scale^2)^2 in
    each Gauss-Newton step. A line tells little of a motion along it; that is left to points on none.
    ``weakest_direction`` is that of these weights; NaN without convergence.
    """
    source, pose = check_cloud(source, "source cloud"), check_poses(init, "initial guess").copy()
    scale = settings.start_scale_m
    source, n_matched, rmse_m = _choose(source, settings.max_points), 0, float("nan")
    for iteration in range(1, settings.max_iterations + 1):
        equations, n_paired, n_matched, error = _sum_equations(
            pose, source, local_map.cloud, local_map.metrics, (scale, settings.end_scale_m)
        )
        change = _solve(equations)
        if n_paired < settings.min_matched or change is None:
            return IcpResult(pose, n_matched, rmse_m, iteration - 1, False)
        rmse_m = float(np.sqrt(error / n_matched)) if n_matched else float("nan")
        pose = np.append(pose[:2] + change[:2], wrap_angle(pose[2] + change[2]))
        shift = np.hypot(*change[:2]) + 30.0 * abs(change[2])
        if scale <= settings.end_scale_m and shift < settings.tolerance:
            weakest, strongest = np.linalg.eigvalsh(equations[:2, :2])
            return IcpResult(pose, n_matched, rmse_m, iteration, True, float(weakest / strongest))
        scale = max(0.8 * scale, settings.end_scale_m)
    return IcpResult(pose, n_matched, rmse_m, settings.max_iterations, False)


def local_map_odometry(
    clouds: Iterable[np.ndarray],
    stamps_us: np.ndarray,
    settings: LocalMapSettings = LocalMapSettings(),
    *,
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = correct_cloud,
    first_twist: np.ndarray | None = None,
) -> Iterator[LocalMapStep]:
    """Register each cloud to those of the last metres, corrected for the motion that this finds.

    The book's own odometry, beside the paper's `chain`. Each motion is guessed from the one before. One that no car
    makes, or with too few matches, is tried again from a searched guess (`search_motion`); if that does no better,
    the step goes on at constant velocity and says so.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m]; empty ones may be among them.
    stamps_us : array of int, shape (m,)
        Increasing times of the scans [us], one per cloud.
    settings : LocalMapSettings
        See there.
    correct : callable, optional
        Takes a cloud and a twist and gives the cloud at mid-scan: `correct_cloud` for points as they were read off
        scans, None for points that are corrected already.
    first_twist : array, shape (3,), optional
        Body velocity at the first scan [m/s, m/s, rad/s]; searched for, up to some 24 m/s, if not given.

    Yields
    ------
    step : LocalMapStep
        One fewer than clouds: the pose of each scan in the one before; `steps_of` stacks them.

    Raises
    ------
    OdometryError
        If times do not increase or are more or fewer than clouds, or if a cloud has another shape or a value that is
        not finite. Not in the paper.
    """
    stamps_us = _check_stamps(stamps_us)
    track, n_clouds = _Track(settings, correct, first_twist), 0
    for cloud in clouds:
        if n_clouds == len(stamps_us):
            raise OdometryError(f"{n_clouds} stamps, but more clouds")
        cloud = check_cloud(cloud, f"cloud {n_clouds}")
        if n_clouds == 0:
            track.begin(cloud)
        else:
            yield track.follow(cloud, int(stamps_us[n_clouds] - stamps_us[n_clouds - 1]) / 1e6)
        n_clouds += 1
    if n_clouds < len(stamps_us):
        raise OdometryError(f"{len(stamps_us)} stamps for {n_clouds} clouds")


class _Track:
    """What `local_map_odometry` knows after a scan; its frame is that of the first scan."""

    def __init__(
        self,
        settings: LocalMapSettings,
        correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
        first_twist: np.ndarray | None,
    ) -> None:
        self.settings = settings
        self.fine = replace(settings, start_scale_m=settings.end_scale_m)
        self.correct = correct or (lambda cloud, twist: cloud)
        self.is_known = first_twist is not None  # whether the velocity is
        self.twist = check_poses(first_twist, "first twist") if self.is_known else np.zeros(3)
        self.pose = np.zeros(3)

    def begin(self, cloud: np.ndarray) -> None:
        """Begin a local map with a cloud; it is corrected anew until a motion from it is believed."""
        self.anchor: tuple[np.ndarray, np.ndarray] | None = (self.pose, cloud)
        self.keyframes: list[tuple[np.ndarray, np.ndarray]] = []
        self.local_map: LocalMap | None = None
        self.sure_pose, self.blind_s = self.pose, 0.0  # the last pose believed, and the time since then

    def follow(self, cloud: np.ndarray, seconds: float) -> LocalMapStep:
        """Find the motion to the next scan."""
        self.blind_s += seconds
        last_pose = self.pose
        guess = self.pose = compose(last_pose, _step_at(self.twist, seconds))
        is_easy = self.is_known and self.blind_s <= 0.5
        for is_searched in (False, True) if is_easy else (True,):
            pose, share = self._register(cloud, guess, is_searched)
            fault = self._find_fault(self._twist_to(pose), share)
            if not fault:
                self._believe(pose, cloud)
                break
        if fault and (self.anchor is not None or self.blind_s > self.settings.patience_s):
            self.is_known = False
            self.begin(cloud)
        return LocalMapStep(relative_pose(last_pose, self.pose), self.twist, share, fault)

    def _register(self, cloud: np.ndarray, guess: np.ndarray, is_searched: bool) -> tuple[np.ndarray, float]:
        """Register and correct in turns; the pose, and the share of points that match."""
        pose, twist, share, settings = guess, self.twist, 0.0, self.settings
        for _ in range(self.settings.rounds):
            source, local_map = self.correct(cloud, twist), self._map_at(twist)
            if local_map is None or len(source) < settings.min_matched:
                return guess, 0.0
            if is_searched and settings is self.settings:
                pose = search_motion(
                    source, local_map.cloud.points, guess, reach=self._reach(), max_points=300
                )
            result = register_robust(source, local_map, pose, settings)
            pose, settings = result.T_target_source, self.fine
            twist = self._twist_to(pose)
            share = result.n_matched / min(len(source), settings.max_points)
        return pose, share

    def _twist_to(self, pose: np.ndarray) -> np.ndarray:
        """Velocity that leads from the last pose believed to this one."""
        return _twist_over(relative_pose(self.sure_pose, pose), self.blind_s)

    def _reach(self) -> tuple[float, float, float]:
        """How far to search: the longer since a motion was believed, the farther."""
        if not self.is_known:
            return _FIRST_REACH
        x, y, yaw = _REACH
        growth = min(max(2.0 * self.blind_s, 1.0), 3.0)
        return x * growth, y * growth, yaw * growth

    def _believe(self, pose: np.ndarray, cloud: np.ndarray) -> None:
        """Go on from a pose found, with the velocity that leads there."""
        self.twist = self._twist_to(pose)
        self.pose, self.sure_pose = pose, pose
        self.is_known, self.blind_s = True, 0.0
        self._remember(cloud)

    def _map_at(self, twist: np.ndarray) -> LocalMap | None:
        """Give the local map; while it is but one cloud of unsure velocity, corrected for this one."""
        if self.anchor is None:
            return self.local_map
        return build_local_map([self._place(*self.anchor, twist)], self.settings)

    def _place(self, pose: np.ndarray, cloud: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """Correct a cloud and move it into the frame of the track."""
        return transform_points(pose, self.correct(cloud, twist))

    def _find_fault(self, twist: np.ndarray, share: float) -> str:
        """Say what makes a motion hard to believe, nothing if it is sound."""
        limits = self.settings
        if share < limits.min_share:
            return f"{100.0 * share:.0f} % of the points match"
        acceleration = np.hypot(*(twist - self.twist)[:2]) / self.blind_s
        if self.is_known and acceleration > limits.max_acceleration:
            return f"acceleration of {acceleration:.0f} m/s2"
        if abs(twist[2]) > limits.max_yaw_rate:
            return f"yaw rate of {twist[2]:.1f} rad/s"
        return ""

    def _remember(self, cloud: np.ndarray) -> None:
        """Add a cloud to the local map if the car has moved, and forget those left behind."""
        settings = self.settings
        if self.anchor is not None:
            self.keyframes = [(self.anchor[0], self._place(*self.anchor, self.twist))]
        moved = relative_pose(self.keyframes[-1][0], self.pose)
        is_new = np.hypot(*moved[:2]) >= settings.keyframe_m or abs(moved[2]) >= settings.keyframe_rad
        if is_new:
            self.keyframes.append((self.pose, self._place(self.pose, cloud, self.twist)))
        if is_new or self.anchor is not None:
            self.keyframes = [
                (pose, points)
                for pose, points in self.keyframes
                if np.hypot(*(pose - self.pose)[:2]) <= settings.map_length_m
            ]
            self.local_map = build_local_map([points for _, points in self.keyframes], settings)
            self.anchor = None


def _step_at(twist: np.ndarray, seconds: float) -> np.ndarray:
    """Give the step at constant velocity; the chord stands for the arc, 0.1 % off at 0.15 rad."""
    return compose((0.0, 0.0, twist[2] * seconds / 2.0), np.append(twist[:2], twist[2] / 2.0) * seconds)


def _twist_over(step: np.ndarray, seconds: float) -> np.ndarray:
    """Give the velocity that makes a step in some time, the inverse of `_step_at`."""
    return np.append(compose((0.0, 0.0, -step[2] / 2.0), step)[:2], step[2]) / seconds


def _check_stamps(stamps_us: np.ndarray) -> np.ndarray:
    """Check that times increase."""
    stamps_us = np.asarray(stamps_us)
    if stamps_us.ndim != 1:
        raise OdometryError(f"stamps: expected shape (m,), got {stamps_us.shape}")
    is_late = np.diff(stamps_us) <= 0
    if is_late.any():
        raise OdometryError(f"stamps do not increase at index {int(np.argmax(is_late)) + 1}")
    return stamps_us


@compiled
def _line_metrics(cloud, radius, ratio, along_weight):
    """Weight offsets from each map point by the shape of its surroundings, shape (n, 2, 2)."""
    metrics = np.empty((len(cloud.points), 2, 2))
    for k in range(len(metrics)):
        n, xx, yy, xy = _spread_about(cloud, cloud.points[k], radius, 12)
        unequal = np.hypot(xx - yy, 2.0 * xy)
        is_line = n >= 5 and xx + yy - unequal < ratio * (xx + yy + unequal)
        heading, freed = np.arctan2(2.0 * xy, xx - yy) / 2.0, 1.0 - along_weight if is_line else 0.0
        c, s = np.cos(heading), np.sin(heading)
        metrics[k, 0, 0], metrics[k, 1, 1] = 1.0 - freed * c * c, 1.0 - freed * s * s
        metrics[k, 0, 1] = metrics[k, 1, 0] = -freed * c * s
    return metrics


@compiled
def _sum_equations(pose, source, target, metrics, scales):
    """Sum the weighted normal equations of all pairs, within three times the first scale.

    Returns the Hessian for (x, y, yaw about the source's origin) beside the gradient, shape (3, 4); the number of pairs;
    that of those nearer than the second scale, and the sum of their errors.
    """
    moved, matched, _ = _pair(pose, source, target, (3.0 * scales[0]) ** 2)
    sums, n_near, near_error = np.zeros((3, 4)), 0, 0.0
    for k in range(len(moved)):
        a, b = moved[k, 0] - pose[0], moved[k, 1] - pose[1]
        x, y = moved[k, 0] - target.points[matched[k], 0], moved[k, 1] - target.points[matched[k], 1]
        xx, xy, yy = metrics[matched[k], 0, 0], metrics[matched[k], 0, 1], metrics[matched[k], 1, 1]
        error = xx * x * x + 2.0 * xy * x * y + yy * y * y
        if error < scales[1] ** 2:
            n_near, near_error = n_near + 1, near_error + error
        weight = 1.0 / (1.0 + error / scales[0] ** 2) ** 2
        for column, (u, v) in enumerate(((1.0, 0.0), (0.0, 1.0), (-b, a), (x, y))):
            p, q = weight * (xx * u + xy * v), weight * (xy * u + yy * v)
            sums[0, column] += p
            sums[1, column] += q
            sums[2, column] += a * q - b * p
    return sums, len(moved), n_near, near_error


def _solve(equations: np.ndarray) -> np.ndarray | None:
    """Solve for the motion (x, y, yaw) with the least weighted errors; None if it is not constrained."""
    values, directions = np.linalg.eigh(equations[:, :3])
    return None if values[0] <= 1e-12 * values[2] else -directions @ (equations[:, 3] @ directions / values)
