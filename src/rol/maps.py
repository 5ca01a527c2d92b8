"""Point maps: accumulate the clouds of a session, register one map to another.

The paper's ground truth (Sec. IV-A): each session starts at the origin, its lidar clouds are accumulated
along its own odometry, and its map is registered to the map of the first session. The registration, composed
with the session's poses, transforms them into the first map's frame.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

if __package__:
    from .files import write_bytes
    from .geometry import check_grid, check_points, check_pose, check_poses, compose, transform_points
    from .odometry import IcpSettings, icp_2d
else:  # this file was copied and is imported by its own name
    from files import write_bytes
    from geometry import check_grid, check_points, check_pose, check_poses, compose, transform_points
    from odometry import IcpSettings, icp_2d


_WAITING_POINTS = 50_000  # number of points that are added to a map at once


class MapError(ValueError):
    """A map without points, a damaged file, or clouds that do not match their poses."""


def thin_points(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Average the points of each grid cell.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m].
    cell : float
        Side of a cell [m].

    Returns
    -------
    means : array, shape (m, 2)
        One point per occupied cell, ordered by cell [m].
    cells : array of int, shape (m, 2)
        Indices of these cells; cell (i, j) spans (i .. i + 1, j .. j + 1) * cell.
    """
    cells, inverse, counts = _unique_cells(points, cell)
    sums = np.stack([np.bincount(inverse, points[:, k], len(counts)) for k in range(2)], axis=1)
    return sums / counts[:, None], cells


def accumulate_map(
    clouds: Iterable[np.ndarray], poses: np.ndarray, cell: float = 0.25, min_hits: int = 2
) -> np.ndarray:
    """Accumulate clouds at their poses and keep the cells that several of them hit.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        One cloud per pose, each in its own frame [m]; clouds may be empty.
    poses : array, shape (k, 3)
        Pose of each cloud in the map [m, m, rad].
    cell : float
        Side of a map cell [m].
    min_hits : int
        Number of clouds, not points, that must hit a cell; 2 removes moving objects and single detections.

    Returns
    -------
    points : array, shape (m, 2)
        One point per kept cell, the mean of its points [m].

    Raises
    ------
    MapError
        If the numbers of clouds and poses differ, a point is not finite, or no cell is kept.

    Notes
    -----
    Yin et al. 2020, Sec. IV-A.
    """
    poses, n_clouds, waiting, n_waiting = check_poses(poses), 0, [], 0
    end_mark = np.iinfo(np.int64).max
    cells = [np.array([end_mark]), np.zeros(1), np.zeros(1), np.zeros(1, np.int32)]
    for i, cloud in enumerate(clouds):
        if i >= len(poses):
            raise MapError(f"more clouds than the {len(poses)} poses")
        cloud = check_points(cloud, f"cloud {i}", error=MapError)
        waiting.append(thin_points(transform_points(poses[i], cloud), cell)[0])
        n_clouds, n_waiting = n_clouds + 1, n_waiting + len(waiting[-1])
        if n_waiting > _WAITING_POINTS:  # memory grows with the map, not with the clouds
            _add_points(cells, np.concatenate(waiting), cell)
            waiting, n_waiting = [], 0
    if n_clouds != len(poses):
        raise MapError(f"{n_clouds} clouds for {len(poses)} poses")
    _add_points(cells, np.concatenate([np.zeros((0, 2)), *waiting]), cell)
    _, *sums, hits = cells
    is_kept = hits >= max(min_hits, 1)
    if not is_kept.any():
        raise MapError(f"the map is empty: no cell is hit by {min_hits} of {len(poses)} clouds")
    return np.stack([values[is_kept] for values in sums], axis=1) / hits[is_kept, None]


def _add_points(cells: list[np.ndarray], points: np.ndarray, cell: float) -> None:
    """Add points to their cells (in place): keys in increasing order, sums of x and of y, numbers of points.

    The arrays are replaced one by one, so that only one of them exists twice at a time; the last cell is an
    end mark.
    """
    indices = np.floor(points / cell).astype(np.int64)
    own = (indices[:, 0] << 32) + indices[:, 1]
    found = np.unique(own)
    at = np.searchsorted(cells[0], found)
    is_new = cells[0][at] != found
    for k, values in enumerate((found[is_new], 0.0, 0.0, 0)):
        cells[k] = np.insert(cells[k], at[is_new], values)
    places = np.searchsorted(cells[0], own)
    for k, values in enumerate((points[:, 0], points[:, 1], 1), start=1):
        np.add.at(cells[k], places, values)


@dataclass(frozen=True)
class Registration:
    """Registration of one map to another.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the source map in the target map [m, m, rad].
    fraction_1m : float
        Fraction of the source's points within 1 m of a target point.
    median_m : float
        Median nearest distance from source to target [m].
    converged : bool
        Whether the last stage converged.
    stages : tuple of (float, float, float, array)
        Per stage: radius around the start [m], largest distance of a pair [m], RMSE of the pairs [m],
        resulting pose.
    """

    T_target_source: np.ndarray
    fraction_1m: float
    median_m: float
    converged: bool
    stages: tuple[tuple[float, float, float, np.ndarray], ...]


# Radius around the source's start, largest and smallest limit of pair distances, cell of the averaging [m].
STAGES = ((100.0, 20.0, 5.0, 1.0), (200.0, 10.0, 3.0, 1.0), (np.inf, 6.0, 2.0, 0.5), (np.inf, 2.0, 0.5, 0.25))


def register_maps(
    source: np.ndarray,
    target: np.ndarray,
    init: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    stages: tuple[tuple[float, float, float, float], ...] = STAGES,
    max_iterations: int = 60,
) -> Registration:
    """Register one map to another by ICP, from near to far and from coarse to fine.

    Sessions that start at one place agree best there. The first stage uses only the points around the start,
    so that a heading error does not displace the far end of the map.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Maps in their own frames [m].
    init : array-like, shape (3,)
        Initial guess of T_target_source [m, m, rad]; zero for sessions with the same start.
    stages : tuple of (reach, max_distance, min_distance, cell)
        Radius around the source's origin, the decreasing limit of pair distances, cell of the averaging of
        both [m].
    max_iterations : int
        Largest number of iterations of each stage.

    Returns
    -------
    registration : Registration

    Raises
    ------
    MapError
        If a map is empty.

    Notes
    -----
    Yin et al. 2020, Sec. IV-A, "a precise ICP method".
    """
    for points, name in ((source, "source"), (target, "target")):
        if len(points) == 0:
            raise MapError(f"the {name} map is empty")
    pose, done, converged = check_pose(init, "initial guess"), [], False
    for reach, max_distance, min_distance, cell in stages:
        near = thin_points(source[np.hypot(source[:, 0], source[:, 1]) < reach], cell)[0]
        limits = {"max_distance": max_distance, "min_distance": min_distance, "tolerance": 1e-4}
        settings = IcpSettings(**limits, max_iterations=max_iterations, max_points=max(len(near), 1))
        result = icp_2d(near, thin_points(target, cell)[0], pose, settings)
        pose, converged = result.T_target_source, result.converged
        done.append((reach, max_distance, result.rmse_m, pose))
    near_m = cKDTree(target).query(transform_points(pose, source))[0]
    return Registration(pose, float(np.mean(near_m < 1.0)), float(np.median(near_m)), converged, tuple(done))


def to_first_map(T_map_session: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Transform a session's own poses into the frame of the first map.

    Parameters
    ----------
    T_map_session : array, shape (3,)
        Registration of the session's map [m, m, rad].
    poses : array, shape (n, 3)
        Poses T_session_radar [m, m, rad].

    Returns
    -------
    poses : array, shape (n, 3)
        Poses T_map_radar.

    Notes
    -----
    Yin et al. 2020, Sec. IV-A.
    """
    return compose(check_pose(T_map_session, "T_map_session"), check_poses(poses))


def residuals_along(clouds: Iterable[np.ndarray], poses: np.ndarray, map_points: np.ndarray) -> np.ndarray:
    """Compute the median distance of each cloud to a map.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        One cloud per pose, each in its own frame [m].
    poses : array, shape (k, 3)
        Pose of each cloud in the map [m, m, rad].
    map_points : array, shape (m, 2)
        The map [m].

    Returns
    -------
    medians : array, shape (k,)
        Median nearest distance of each cloud's points to the map [m]; NaN for an empty cloud.
    """
    if len(map_points) == 0:
        raise MapError("the map is empty")
    tree, medians = cKDTree(map_points), []
    for cloud, pose in zip(clouds, check_poses(poses), strict=True):
        distances = tree.query(transform_points(pose, cloud))[0] if len(cloud) else [np.nan]
        medians.append(float(np.median(distances)))
    return np.array(medians)


def save_map(path: Path | str, points: np.ndarray, T_map_session: np.ndarray) -> None:
    """Write a session's map, atomically.

    Parameters
    ----------
    path : Path or str
        An ``.npz`` to write.
    points : array, shape (m, 2)
        Points in the frame of the first map [m].
    T_map_session : array, shape (3,)
        Registration of the session's own frame [m, m, rad].

    Raises
    ------
    MapError
        If there is no point, a value is not finite, or the map extends over more than 100 km.
    """
    _check_map(path, points, T_map_session)
    content = io.BytesIO()
    np.savez_compressed(content, points=points, T_map_session=np.asarray(T_map_session, dtype=np.float64))
    write_bytes(path, content.getvalue())


def load_map(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Read a session's map.

    Parameters
    ----------
    path : Path or str
        An ``.npz`` from `save_map`.

    Returns
    -------
    points : array, shape (m, 2)
        Points in the frame of the first map [m].
    T_map_session : array, shape (3,)
        Registration of the session's own frame [m, m, rad].

    Raises
    ------
    MapError
        If the file is missing, truncated or no map, or the map extends over more than 100 km.
    """
    if not Path(path).is_file():
        raise MapError(f"{path}: missing")
    try:
        with open(path, "rb") as file, np.load(file) as content:
            points, T_map_session = content["points"], content["T_map_session"]
    except (KeyError, TypeError, ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise MapError(f"{path}: not a whole map file ({error})") from error
    _check_map(path, points, T_map_session)
    return points, T_map_session


def _check_map(path: Path | str, points: np.ndarray, T_map_session: np.ndarray) -> None:
    """Check that arrays are a map."""
    check_points(points, str(path), error=MapError)
    if len(points) == 0:
        raise MapError(f"{path}: the map is empty")
    check_pose(T_map_session, f"{path}: T_map_session", MapError)
    check_grid((1, 1), points, str(path), error=MapError)


def _unique_cells(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the distinct cells of points, the cell of each point, and the number of points of each cell."""
    keys, columns = (np.floor(points[:, k] / cell).astype(np.int64) for k in range(2))
    low = np.array([keys.min(), columns.min()] if len(points) else [0, 0])
    width = int(np.ptp(columns)) + 1 if len(points) else 1
    # In place, since a map of a long session is large.
    keys -= low[0]
    keys *= width
    keys += columns - low[1]
    del columns
    keys, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return np.stack([keys // width, keys % width], axis=1) + low, inverse, counts
