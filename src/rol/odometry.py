"""Odometry by registration: 2D point-to-point ICP between successive clouds.

The motion u of the filter (paper, Sec. III-B): the cloud of one scan is aligned to the cloud of the scan
before. A result ``T_target_source`` maps points of the source into the target's frame; with the earlier scan
as the target it is the step of the car, seen from where it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

try:
    from .geometry import check_poses, compose, transform_points
except ImportError:  # this file was copied on its own
    from geometry import check_poses, compose, transform_points


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
    """

    T_target_source: np.ndarray
    n_matched: int
    rmse_m: float
    iterations: int
    converged: bool


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
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    x, y = target_mean - transform_points((0.0, 0.0, yaw), source_mean[None])[0]
    return np.array([x, y, yaw])


def icp_2d(
    source: np.ndarray,
    target: np.ndarray,
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
        Clouds in their own frames [m].
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
        If a cloud has another shape or a value that is not finite. Yin et al. 2020, Sec. III-B, below Eq. 7.
    """
    source, target = check_cloud(source, "source cloud"), check_cloud(target, "target cloud")
    pose, limit = check_poses(init, "initial guess").copy(), max_distance
    if min(len(source), len(target)) < min_matched:
        return IcpResult(pose, 0, float("nan"), 0, False)
    if len(source) > max_points:
        source = source[np.linspace(0, len(source) - 1, max_points).astype(int)]
    tree, n_matched, rmse_m = cKDTree(target), 0, float("nan")
    for iteration in range(1, max_iterations + 1):
        moved = transform_points(pose, source)
        distances, neighbours = tree.query(moved, distance_upper_bound=limit)
        pairs = _closest(distances, trim)
        n_matched = len(pairs)
        if n_matched < min_matched or np.ptp(moved[pairs], axis=0).max() == 0.0:
            return IcpResult(pose, n_matched, rmse_m, iteration - 1, False)
        rmse_m = float(np.sqrt(np.mean(distances[pairs] ** 2)))
        change = fit_rigid(moved[pairs], target[neighbours[pairs]])
        pose, last = compose(change, pose), pose
        shift = np.hypot(*(pose - last)[:2]) + 30.0 * abs(change[2])
        if limit <= min_distance and shift < tolerance:
            return IcpResult(pose, n_matched, rmse_m, iteration, True)
        limit = max(0.8 * limit, min_distance)
    return IcpResult(pose, n_matched, rmse_m, max_iterations, False)


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
        If a cloud has another shape or a value that is not finite.
    """
    source, target = check_cloud(source, "source cloud"), check_cloud(target, "target cloud")
    best = check_poses(guess, "initial guess").copy()
    if min(len(source), len(target)) == 0:
        return best
    source = source[np.linspace(0, len(source) - 1, min(len(source), max_points)).astype(int)]
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


def _closest(distances: np.ndarray, share: float) -> np.ndarray:
    """Give the indices of the smallest finite distances, a share of them."""
    finite = np.flatnonzero(np.isfinite(distances))
    n = int(np.ceil(share * len(finite)))
    return finite if n == len(finite) else finite[np.argpartition(distances[finite], n - 1)[:n]]
