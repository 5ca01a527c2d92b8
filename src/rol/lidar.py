"""The lidar room: bring sweeps into the radar frame, take the ground away, crop.

Points are arrays whose first columns are x, y, z [m]; further columns (intensity, label) travel along
untouched. Heights are taken in the radar frame, which spins level about 2 m above the road; the vehicle frame
of the data set is pitched 0.05 rad against it, so a threshold there would cut the ground at a slant.
"""

from __future__ import annotations

import numpy as np

try:
    from .geometry import transform_points_3d
except ImportError:  # this file was copied on its own
    from geometry import transform_points_3d


def relate_sensors(T_vehicle_a: np.ndarray, T_vehicle_b: np.ndarray) -> np.ndarray:
    """Give the transform from one sensor to another out of two extrinsics.

    Parameters
    ----------
    T_vehicle_a, T_vehicle_b : array, shape (4, 4)
        Places of both sensors in the vehicle.

    Returns
    -------
    T_a_b : array, shape (4, 4)
        Maps points of sensor b into sensor a.
    """
    return np.linalg.inv(np.asarray(T_vehicle_a, dtype=np.float64)) @ np.asarray(
        T_vehicle_b, dtype=np.float64
    )


def sweep_to_radar(points: np.ndarray, T_radar_lidar: np.ndarray) -> np.ndarray:
    """Map a sweep into the radar frame.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        Points in the lidar frame [m].
    T_radar_lidar : array, shape (4, 4)
        Calibration; `relate_sensors` of the two extrinsics.

    Returns
    -------
    points : array, same shape, float64
        Points in the radar frame [m]; further columns as they were.

    Notes
    -----
    Yin et al. 2020, Sec. III-A: "align the lidar data on the radar coordinate by calibration results".
    """
    points = _check_points(points)
    moved = points.astype(np.float64)
    moved[:, :3] = transform_points_3d(np.asarray(T_radar_lidar, dtype=np.float64), moved[:, :3])
    return moved


def remove_ground(points: np.ndarray, min_height: float = -1.5, max_height: float = np.inf) -> np.ndarray:
    """Keep the points between two heights.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        Points in the radar frame [m]; the road lies about 2 m below.
    min_height, max_height : float
        Lowest and highest z kept, both included [m].

    Returns
    -------
    points : array, shape (m, 3) or more columns
        The points kept, in their order; points whose z is not a number are dropped.

    Notes
    -----
    Yin et al. 2020, Sec. III-A: "a height threshold on original 3D lidar point cloud". The paper gives no number.
    """
    points = _check_points(points)
    if min_height > max_height:
        raise ValueError(f"heights: min_height {min_height} lies above max_height {max_height}")
    return points[(points[:, 2] >= min_height) & (points[:, 2] <= max_height)]


def crop_range(points: np.ndarray, max_range: float = 64.0, min_range: float = 0.0) -> np.ndarray:
    """Keep the points within a ring around the sensor, measured in the plane.

    Parameters
    ----------
    points : array, shape (n, 2) or more columns
        Points [m].
    max_range, min_range : float
        Outer and inner radius, both included [m].

    Returns
    -------
    points : array, shape (m, 2) or more columns
        The points kept, in their order; points that are not numbers are dropped.

    Notes
    -----
    Yin et al. 2020, Sec. IV-C: "Only the points near to the radar sensor (<= 64 m)".
    """
    points = np.asarray(points)
    ranges = np.hypot(points[:, 0], points[:, 1])
    return points[(ranges <= max_range) & (ranges >= min_range)]


def threshold_losses(
    heights: np.ndarray, is_ground: np.ndarray, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Count what a height threshold removes of the ground and of everything else.

    Parameters
    ----------
    heights : array, shape (n,)
        z in the radar frame [m].
    is_ground : array, shape (n,), bool
        Which points are ground in truth.
    thresholds : array, shape (k,)
        Values of ``min_height`` to try [m].

    Returns
    -------
    ground_removed, objects_removed : array, shape (k,)
        Shares in 0..1 of the ground points and of the other points that lie below each threshold; nan where
        there are none of the kind.
    """
    heights, is_ground = np.asarray(heights, dtype=np.float64), np.asarray(is_ground, dtype=bool)
    if heights.shape != is_ground.shape:
        raise ValueError(f"{heights.shape} heights for {is_ground.shape} labels")
    shares = []
    for kind in (np.sort(heights[is_ground]), np.sort(heights[~is_ground])):
        below = np.searchsorted(kind, np.asarray(thresholds, dtype=np.float64), side="left")
        shares.append(below / len(kind) if len(kind) else np.full(len(below), np.nan))
    return shares[0], shares[1]


def _check_points(points: np.ndarray) -> np.ndarray:
    """Refuse arrays that do not hold x, y, z in their columns."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points: expected shape (n, 3) or more columns, got {points.shape}")
    return points
