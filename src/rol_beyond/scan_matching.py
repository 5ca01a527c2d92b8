"""Scan matching that goes beyond the paper: a correlative search for the initial guess, and scan-to-map ICP.

Nearest neighbours pull two clouds of thick strokes together wherever they overlap already, so ICP stays close
to its initial guess. `correlative_scan_match` evaluates a window of candidate poses instead.
`scan_to_map_icp` registers every scan to the map without a filter; the paper rules this out (Sec. III-B), and
it is compared with the filter here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from rol.geometry import check_fields, check_number, check_points, check_pose, compose
from rol.odometry import IcpResult, IcpSettings, OdometryError, choose_evenly, icp_2d, sort_cloud

_MAX_CELLS = 10**8  # of the grid of a search: 400 MB


def correlative_scan_match(
    source: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    window: tuple[float, float, float] = (2.0, 0.8, np.deg2rad(4.0)),
    cell: float = 0.125,
    max_points: int = 600,
) -> np.ndarray:
    """Match two clouds by evaluating candidate poses in a window, on a coarse grid and then on a fine one.

    The score of a candidate is the number of source points that fall on marked cells of the target. It is
    largest at the true motion, also where ICP would stay close to its initial guess.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m].
    guess : array-like, shape (3,)
        Centre of the window [m, m, rad].
    window : tuple of float
        Half the extent of the window in x, y [m] and heading [rad].
    cell : float
        Side of the cells in which the target is marked, each with its neighbours [m].
    max_points : int
        Of a larger source this many points are used, evenly spaced.

    Returns
    -------
    pose : array, shape (3,)
        Best T_target_source, of equally good ones the nearest to the guess; the guess itself for an empty
        cloud. Candidates are 0.4 m and 1 deg apart, then, within a fifth of the window, 0.08 m and 0.2 deg.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite, a setting is out of its range, or the
        clouds extend so far that the grid would need more than 400 MB.
    """
    check_number("window", window, "[0, 100]", tuple, OdometryError)
    check_number("cell", cell, "(0, inf)", float, OdometryError)
    check_number("max_points", max_points, "[1, inf)", int, OdometryError)
    source = check_points(source, "source cloud", error=OdometryError)
    target = check_points(target, "target cloud", error=OdometryError)
    best = check_pose(guess, "initial guess").copy()
    if min(len(source), len(target)) == 0:
        return best
    source = choose_evenly(source, max_points)
    target = _crop_target(source, target, best, window, cell)
    if len(target) == 0:
        return best
    # Points of an image then lie at the centres of cells.
    corner = target.min(axis=0) - 3.5 * cell
    marked = np.zeros(np.ceil((target.max(axis=0) - corner) / cell).astype(int) + 4, dtype=np.int32)
    u, v = np.floor((target - corner) / cell).astype(int).T
    # A cell next to a point scores one, a cell at a point two.
    for n_cells in (2, 1):
        for i, j in np.ndindex(2 * n_cells + 1, 2 * n_cells + 1):
            marked[u + i - n_cells, v + j - n_cells] = 3 - n_cells
    for scale in (1.0, 0.2):
        offsets = _offsets(scale * np.array(window), scale * np.array([0.4, 0.4, np.deg2rad(1.0)]))
        candidates = best + offsets
        best = candidates[np.argmax(_score(candidates, source, marked, corner, cell))]
    return best


@dataclass(frozen=True)
class ScanToMapSettings:
    """Settings of `scan_to_map_icp`.

    Attributes
    ----------
    range_m : float
        Map points farther from the initial guess than this are ignored [m].
    min_inlier_ratio : float
        A registration that does not converge, or in which a smaller fraction of the points is matched, is
        rejected. Accepting all of them was worse on 2,000 scans of the real route.
    icp : IcpSettings
        Settings of the registration.

    Raises
    ------
    OdometryError
        If a value is out of its range; the message names it.
    """

    range_m: float = 75.0
    min_inlier_ratio: float = 0.2
    icp: IcpSettings = field(default_factory=IcpSettings)

    def __post_init__(self) -> None:
        check_fields(self, {"(0, inf]": "range_m", "[0, 1]": "min_inlier_ratio"}, OdometryError)


def scan_to_map_icp(
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    start: np.ndarray,
    reset_callback: Callable[[int, np.ndarray], np.ndarray | None] | None = None,
    settings: ScanToMapSettings = ScanToMapSettings(),
) -> Iterator[IcpResult]:
    """Localize by registering each cloud to the map, from the last pose and the odometry increment.

    Parameters
    ----------
    increments : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (n, 2)
        Cloud of each scan in the radar frame [m].
    map_points : array, shape (m, 2)
        Map [m].
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    reset_callback : callable, optional
        As in `rol.mcl.localize`: a pose that it returns is the start of the next scan.
    settings : ScanToMapSettings
        Range, rejection and ICP.

    Yields
    ------
    result : IcpResult
        One per scan, the pose T_map_radar as ``T_target_source``. Where the registration is rejected this is
        the initial guess, the last pose moved by the increment, and ``converged`` is False. Yin et al. 2020,
        Sec. III-B.

    Raises
    ------
    OdometryError
        If there are too few increments, or a cloud has another shape or a value that is not finite.
    """
    target, pose, increments = sort_cloud(map_points, "map"), check_pose(start, "start"), iter(increments)
    for index, cloud in enumerate(clouds):
        increment = np.zeros(3) if index == 0 else next(increments, None)
        if increment is None:
            raise OdometryError(f"no odometry increment for scan {index}: one fewer than clouds are needed")
        guess = compose(pose, increment)
        near = target._replace(around=(float(guess[0]), float(guess[1]), float(settings.range_m) ** 2))
        result = icp_2d(cloud, near, guess, settings.icp)
        n_used = min(len(cloud), settings.icp.max_points)
        if not result.converged or result.n_matched < settings.min_inlier_ratio * n_used:
            result = replace(result, T_target_source=guess, converged=False)
        yield result
        restart = reset_callback(index, result.T_target_source) if reset_callback else None
        pose = result.T_target_source if restart is None else check_pose(restart, "restart")


def _crop_target(
    source: np.ndarray, target: np.ndarray, guess: np.ndarray, window: tuple[float, float, float], cell: float
) -> np.ndarray:
    """Discard target points too far from the source; raise if the rest is too wide for a grid."""
    longest = np.hypot(*source.T).max() + 1.2 * np.hypot(*window[:2]) + 4.0 * cell
    target = target[np.hypot(*(target - guess[:2]).T) <= longest]
    sides = np.ptp(target, axis=0) if len(target) else np.zeros(2)
    if np.prod(sides / cell + 8.0) > _MAX_CELLS:
        raise OdometryError(
            f"source and target cloud: points extend over {sides[0]:.0f} m x {sides[1]:.0f} m, too far for cells of "
            f"{cell} m; remove stray points"
        )
    return target


def _offsets(window: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Offsets on a grid around zero, the nearest to zero first, shape (n, 3)."""
    axes = [k * np.arange(-round(r / k), round(r / k) + 1) for r, k in zip(window, step, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.argsort(np.abs(grid / step).sum(axis=1), kind="stable")]


def _score(
    poses: np.ndarray, points: np.ndarray, marked: np.ndarray, corner: np.ndarray, cell: float
) -> np.ndarray:
    """Sum the marks of the cells under the points at each pose, shape (n,)."""
    c, s = np.cos(poses[:, 2:]) / cell, np.sin(poses[:, 2:]) / cell
    x, y = ((poses[:, :2] - corner) / cell).T
    u = (x[:, None] + c * points[:, 0] - s * points[:, 1]).astype(np.int32)
    v = (y[:, None] + s * points[:, 0] + c * points[:, 1]).astype(np.int32)
    # The outermost cells are never marked.
    np.clip(u, 0, marked.shape[0] - 1, out=u)
    np.clip(v, 0, marked.shape[1] - 1, out=v)
    return marked[u, v].sum(axis=1)
