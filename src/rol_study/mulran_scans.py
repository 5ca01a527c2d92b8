"""Radar scans of MulRan against a lidar keyframe of the same moment, and on RaLL's map of the place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from rol.geometry import compose, exp, invert, log, relative_pose, transform_points, transform_points_3d
from rol.lidar import crop_range, remove_ground
from rol.maps import Registration, register_maps
from rol.pix2pix import TrainedNetwork
from rol.radar import MEASURED, RangeCalibration
from rol.similarity import fraction_within, nn_distances
from rol_beyond.augmentation import rotate_points
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M, detect_points
from rol_data import mulran, rall
from rol_study.real_scans import WRONG_HEADINGS, Generate, front_end_points

OFFSETS_M = (-0.6, -0.45, MEASURED.offset_m, -0.15, 0.0)  # that are compared [m]
OFFSET_M = MEASURED.offset_m  # of the ranges, as on Oxford's radar; the data set states none [m]
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


def fit_radar(points: np.ndarray, keyframe: np.ndarray, sigma_m: float = 0.3) -> tuple[np.ndarray, float]:
    """Fit radar points to a keyframe by a rigid motion near zero: what the calibration leaves.

    Parameters
    ----------
    points, keyframe : array, shape (n, 2) and (m, 2)
        Points of radar and lidar in the radar frame of the calibration [m].
    sigma_m : float
        Standard deviation of the Gaussian of the distances that is maximized [m].

    Returns
    -------
    motion : array, shape (3,)
        Motion of the radar points (forward, left, counter-clockwise) [m, m, rad].
    score : float
        Mean Gaussian of the distances to the keyframe, 0..1.
    """
    tree = cKDTree(keyframe)

    def cost(motion: np.ndarray) -> float:
        away = tree.query(transform_points(motion, points), distance_upper_bound=10.0 * sigma_m)[0]
        return -float(np.mean(np.exp(-0.5 * (away / sigma_m) ** 2)))

    simplex = np.vstack([np.zeros(3), np.diag([0.3, 0.3, 0.01])])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4}
    found = minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)
    return found.x, -float(found.fun)


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


def poses_at(poses: np.ndarray, first_s: float, seconds: np.ndarray, period_s: float = 0.25) -> np.ndarray:
    """Interpolate poses without times, one per radar scan, assuming scans at a constant rate.

    Parameters
    ----------
    poses : array, shape (n, 3)
        Poses [m, m, rad].
    first_s : float
        Time of the first [s].
    seconds : array, shape (k,)
        Times asked for, within one period before the first pose and the last one [s].
    period_s : float
        Time between two poses [s].

    Returns
    -------
    poses : array, shape (k, 3)

    Raises
    ------
    ValueError
        If a time lies outside the poses.
    """
    rows = (np.asarray(seconds) - first_s) / period_s
    if rows.min() < -1.0 or rows.max() > len(poses) - 1:
        raise ValueError(
            f"{len(poses)} poses every {period_s} s do not cover the rows {rows.min():.0f} .. {rows.max():.0f}"
        )
    before = np.clip(np.floor(rows).astype(int), 0, len(poses) - 2)
    increments = log(relative_pose(poses[before], poses[before + 1]))
    return compose(poses[before], exp(increments, np.clip(rows - before, 0.0, 1.0)))


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


@dataclass(frozen=True, eq=False)
class MulranStudy:
    """Results of `evaluate_mulran`.

    Attributes
    ----------
    points : list of dict
        Front end -> points in the radar frame, shape (n, 2) [m]; one per scan.
    keyframe : array, shape (m, 2)
        Lidar points of the same moment in the radar frame [m].
    map_points : array, shape (k, 2)
        Points of the map in the radar frame at the pose of the registered keyframe [m].
    precision : pandas.DataFrame
        By front end, means over the scans: `evaluate_on_keyframe`, and ``share_1m_map``, ``share_2m_map``,
        ``chance_1m_map``, ``chance_2m_map`` on the map.
    frame : array, shape (j, 3)
        Pose of the radar in the frame of the published poses, by keyframe [m, m, rad].
    offsets : pandas.DataFrame
        By range offset [m]: ``score`` of the raw peaks fitted to the keyframe, and the motion of the fit, ``forward_m``,
        ``left_m``, ``turn_deg``; means over the scans.
    """

    points: list[dict[str, np.ndarray]]
    keyframe: np.ndarray
    map_points: np.ndarray
    precision: pd.DataFrame
    frame: np.ndarray
    offsets: pd.DataFrame


def fit_range_offsets(
    scans: Sequence[mulran.MulranScan], keyframe: np.ndarray, offsets_m: Sequence[float]
) -> pd.DataFrame:
    """Fit the raw peaks to a keyframe for several range offsets, see `MulranStudy`."""
    rows = []
    for offset in offsets_m:
        calibration = RangeCalibration(mulran.RANGE_RESOLUTION, offset)
        for scan in scans:
            peaks = detect_points(scan.power, scan.azimuths, calibration=calibration)
            motion, score = fit_radar(peaks, keyframe)
            moved = {"forward_m": motion[0], "left_m": motion[1], "turn_deg": np.rad2deg(motion[2])}
            rows.append({"offset_m": offset, "score": score, **moved})
    return pd.DataFrame(rows).groupby("offset_m").mean()


def evaluate_mulran(
    real_root: Path | str, networks: Mapping[str, TrainedNetwork], generate: Generate, every: int = 4
) -> MulranStudy:
    """Evaluate the scans of MulRan against the keyframe of the same moment and on RaLL's map.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    networks, generate
        As in `rol_study.real_scans.front_end_points`.
    every : int
        Register every so many-th keyframe to the map.

    Returns
    -------
    study : MulranStudy

    Raises
    ------
    rol_data.mulran.MulranError, rol_data.rall.RallError
        If a file is missing or at fault.
    """
    scans, (seconds, paths) = mulran.load_scans(real_root), mulran.load_keyframes(real_root)
    keyframes = [keyframe_points(path) for path in paths[::every]]
    calibration = RangeCalibration(mulran.RANGE_RESOLUTION, OFFSET_M)
    points = [
        front_end_points(scan.power, scan.azimuths, networks, generate, calibration=calibration)
        for scan in scans
    ]
    map_points = mulran.load_kaist_map(real_root)
    poses = rall.load_poses(Path(real_root) / mulran.KAIST_POSES_PATH)
    published = poses_at(poses, scans[0].row_stamps_ns.mean() / 1e9, seconds[::every])
    frame, _ = find_pose_frame(keyframes, published, map_points)
    near = transform_points(invert(compose(published[0], frame[0])), map_points)
    near = crop_range(near, 150.0)
    on_keyframe = pd.concat([evaluate_on_keyframe(found, keyframes[0]) for found in points])
    on_map = pd.concat([evaluate_on_keyframe(found, near) for found in points])
    means = [table.groupby("points", sort=False).mean() for table in (on_keyframe, on_map)]
    precision = means[0].join(means[1].drop(columns=["n", "reached_1m"]), rsuffix="_map")
    offsets = fit_range_offsets(scans, keyframes[0], OFFSETS_M)
    return MulranStudy(points, keyframes[0], near, precision, frame, offsets)
