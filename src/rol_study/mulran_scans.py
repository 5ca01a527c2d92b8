"""Radar scans of MulRan against a lidar keyframe of the same moment, and on RaLL's map of the place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from rol.geometry import relative_pose, transform_points_3d
from rol.lidar import crop_range, remove_ground
from rol.maps import Registration, register_maps
from rol.similarity import fraction_within, nn_distances
from rol_beyond.augmentation import rotate_points
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M
from rol_data import mulran
from rol_study.real_scans import WRONG_HEADINGS

# Stages of `rol.maps.register_maps` for a single cloud near its pose: all points at once, from 6 m down.
CLOUD_STAGES = ((np.inf, 6.0, 2.0, 0.5), (np.inf, 2.0, 0.5, 0.25))


def keyframe_points(path: Path | str, max_range_m: float = 100.0) -> np.ndarray:
    """Read a keyframe, transform it into the radar frame, and remove the ground.

    Parameters
    ----------
    path : path
        A `.pcd`, see `rol_data.mulran.load_cloud`.
    max_range_m : float
        Points farther away are dropped [m].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m].
    """
    cloud = transform_points_3d(mulran.radar_from_lidar(), mulran.load_cloud(path))
    return crop_range(remove_ground(cloud), max_range_m, MIN_RANGE_M)[:, :2]


def evaluate_on_keyframe(points: Mapping[str, np.ndarray], keyframe: np.ndarray) -> pd.DataFrame:
    """Compare the points of front ends with a keyframe, and with the keyframe turned.

    Parameters
    ----------
    points : mapping of str to array, shape (n, 2)
        Front end -> points in the radar frame [m].
    keyframe : array, shape (m, 2)
        Lidar points in the radar frame, without the ground [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per front end: ``points``, ``n``, ``share_1m``, ``share_2m`` (precision), ``reached_1m`` (recall, of the
        lidar points within the range of the images), ``chance_1m``, ``chance_2m``.
    """
    near, rows = crop_range(keyframe, MAX_RANGE_M, MIN_RANGE_M), []
    for name, cloud in points.items():
        away = nn_distances(cloud, keyframe)
        turned = [nn_distances(rotate_points(cloud, turn), keyframe) for turn in WRONG_HEADINGS]
        chance = {f"chance_{r}m": np.mean([fraction_within(d, r) for d in turned]) for r in (1, 2)}
        fractions = {f"share_{r}m": fraction_within(away, r) for r in (1, 2)}
        reached = fraction_within(nn_distances(near, cloud), 1.0)
        rows.append({"points": name, "n": len(cloud), **fractions, "reached_1m": reached, **chance})
    return pd.DataFrame(rows)


def register_cloud(cloud: np.ndarray, map_points: np.ndarray, pose: np.ndarray) -> Registration:
    """Register one cloud to the surroundings of a pose, see `rol.maps.register_maps`.

    Parameters
    ----------
    cloud : array, shape (n, 2)
        Points in the radar frame [m].
    map_points : array, shape (m, 2)
        Points of the map [m].
    pose : array, shape (3,)
        Initial guess T_map_radar [m, m, rad].

    Returns
    -------
    registration : Registration
        ``T_target_source`` is T_map_radar.
    """
    near = map_points[np.abs(map_points - pose[:2]).max(axis=1) < 150.0]
    return register_maps(cloud, near, pose, stages=CLOUD_STAGES)


def find_pose_frame(
    clouds: Sequence[np.ndarray], poses: np.ndarray, map_points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find where the radar is in the frame of published poses: register lidar clouds to the map.

    Parameters
    ----------
    clouds : sequence of array, shape (n, 2)
        Lidar clouds in the radar frame, without the ground [m].
    poses : array, shape (k, 3)
        Published poses at the times of the clouds [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map [m].

    Returns
    -------
    T_pose_radar : array, shape (k, 3)
        Pose of the radar in the frame of each published pose [m, m, rad].
    fraction_1m : array, shape (k,)
        Fraction of each cloud within 1 m of the map.
    """
    found = [register_cloud(cloud, map_points, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    placed = np.array([registration.T_target_source for registration in found])
    return relative_pose(poses, placed), np.array([registration.fraction_1m for registration in found])
