"""Transform lidar sweeps into the radar frame, remove the ground, and crop the range.

Points are arrays whose first columns are x, y, z [m]; further columns (intensity, label) are kept. Heights
are those in the radar frame, which is level and about 2 m above the road; the vehicle frame of the data set
is pitched by 0.05 rad against it, so a height threshold there would be inclined against the ground.
"""

from __future__ import annotations

import numpy as np

if __package__:
    from .geometry import transform_points_3d
else:  # this file was copied and is imported by its own name
    from geometry import transform_points_3d


def relate_sensors(T_vehicle_a: np.ndarray, T_vehicle_b: np.ndarray) -> np.ndarray:
    """Compute the transform between two sensors from their extrinsics.

    Parameters
    ----------
    T_vehicle_a, T_vehicle_b : array, shape (4, 4)
        Poses of both sensors in the vehicle.

    Returns
    -------
    T_a_b : array, shape (4, 4)
        Maps points of sensor b into sensor a.
    """
    T_a_vehicle = np.linalg.inv(np.asarray(T_vehicle_a, dtype=np.float64))
    return T_a_vehicle @ np.asarray(T_vehicle_b, dtype=np.float64)


def sweep_to_radar(points: np.ndarray, T_radar_lidar: np.ndarray) -> np.ndarray:
    """Transform a sweep into the radar frame.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        Points in the lidar frame [m].
    T_radar_lidar : array, shape (4, 4)
        Calibration; `relate_sensors` of the two extrinsics.

    Returns
    -------
    points : array, same shape, float64
        Points in the radar frame [m]; further columns unchanged.

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
    Yin et al. 2020, Sec. III-A: "a height threshold on original 3D lidar point cloud". The paper gives no
    number.
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


def ground_removal_tradeoff(
    heights: np.ndarray, is_ground: np.ndarray, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute which fractions of ground and of object points a height threshold removes.

    Parameters
    ----------
    heights : array, shape (n,)
        z in the radar frame [m].
    is_ground : array, shape (n,), bool
        True for points labelled as ground.
    thresholds : array, shape (k,)
        Values of ``min_height`` to try [m].

    Returns
    -------
    ground_removed, objects_removed : array, shape (k,)
        Fractions, 0..1, of the ground points and of the other points below each threshold; nan if there are
        no points of the kind.
    """
    heights, is_ground = np.asarray(heights, dtype=np.float64), np.asarray(is_ground, dtype=bool)
    if heights.shape != is_ground.shape:
        raise ValueError(f"{heights.shape} heights for {is_ground.shape} labels")
    fractions = []
    for kind in (np.sort(heights[is_ground]), np.sort(heights[~is_ground])):
        below = np.searchsorted(kind, np.asarray(thresholds, dtype=np.float64), side="left")
        fractions.append(below / len(kind) if len(kind) else np.full(len(below), np.nan))
    return fractions[0], fractions[1]


def _check_points(points: np.ndarray) -> np.ndarray:
    """Check that the first columns can be x, y, z; values need not be finite."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points: expected shape (n, 3) or more columns, got {points.shape}")
    return points
