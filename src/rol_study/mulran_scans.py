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
from rol.maps import thin_points
from rol.pix2pix import TrainedNetwork
from rol.radar import MEASURED, RangeCalibration
from rol.similarity import fraction_within, nn_distances
from rol_beyond.augmentation import rotate_points
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M, detect_points
from rol_data import mulran, rall
from rol_study.real_scans import WRONG_HEADINGS, Generate, front_end_points

OFFSETS_M = (-0.6, -0.45, MEASURED.offset_m, -0.15, 0.0)  # that are compared [m]
OFFSET_M = MEASURED.offset_m  # of the ranges, as on Oxford's radar; the data set states none [m]
MIN_HEIGHT_M = -1.0  # of lidar points, in the radar frame: the street rises ahead of the vehicle [m]
STARTS_M = (-1.5, 0.0, 1.5)  # along the vehicle, of the fits to the map [m]
MAP_SIGMA_M = 0.4  # of these fits [m]


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
    return crop_range(remove_ground(cloud, MIN_HEIGHT_M), max_range_m, MIN_RANGE_M)[:, :2]


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
        One row per front end: ``points``, ``n``, ``share_1m``, ``share_2m`` (precision), ``reached_1m``
        (recall, of the lidar points within the range of the images), ``chance_1m``, ``chance_2m``.
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


def fit_cloud(
    points: np.ndarray,
    reference: np.ndarray,
    sigma_m: float = 0.3,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, float]:
    """Fit points to reference points by a small rigid motion.

    Parameters
    ----------
    points, reference : array, shape (n, 2) and (m, 2)
        Points [m].
    sigma_m : float
        Standard deviation of the Gaussian of the distances that is maximized [m].
    start : tuple of float
        Initial guess of the motion [m, m, rad].

    Returns
    -------
    motion : array, shape (3,)
        Motion of the points (forward, left, counter-clockwise) [m, m, rad].
    score : float
        Mean Gaussian of the distances to the reference, 0..1.
    """
    tree = cKDTree(reference)

    def cost(motion: np.ndarray) -> float:
        away = tree.query(transform_points(motion, points), distance_upper_bound=5.0 * sigma_m)[0]
        return -float(np.mean(np.exp(-0.5 * (away / sigma_m) ** 2)))

    simplex = np.asarray(start) + np.vstack([np.zeros(3), np.diag([0.3, 0.3, 0.01])])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4}
    found = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
    return found.x, -float(found.fun)


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


def find_pose_frame(clouds: Sequence[np.ndarray], poses: np.ndarray, map_points: np.ndarray) -> np.ndarray:
    """Find where the radar is in the frame of published poses: fit lidar clouds to the map.

    A street hardly constrains the position along it, so the fit begins at several positions and the best one
    counts.

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
    """
    frames = []
    for cloud, pose in zip(clouds, poses, strict=True):
        around = crop_range(transform_points(invert(pose), map_points), 110.0)
        thinned = thin_points(cloud, 0.5)[0]
        fits = [fit_cloud(thinned, around, MAP_SIGMA_M, (forward, 0.0, 0.0)) for forward in STARTS_M]
        frames.append(max(fits, key=lambda fit: fit[1])[0])
    return np.array(frames)


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
        Points of the map in the radar frame at the pose of the fitted keyframe [m].
    precision : pandas.DataFrame
        By front end, means over the scans: `evaluate_on_keyframe`, and ``share_1m_map``, ``share_2m_map``,
        ``chance_1m_map``, ``chance_2m_map`` on the map.
    frame : array, shape (j, 3)
        Pose of the radar in the frame of the published poses, by keyframe [m, m, rad].
    offsets : pandas.DataFrame
        By range offset [m]: ``score`` of the raw peaks fitted to the keyframe, and the motion of the fit,
        ``forward_m``, ``left_m``, ``turn_deg``; means over the scans.
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
            motion, score = fit_cloud(peaks, keyframe)
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
    frame = find_pose_frame(keyframes, published, map_points)
    near = transform_points(invert(compose(published[0], frame[0])), map_points)
    near = crop_range(near, 150.0)
    on_keyframe = pd.concat([evaluate_on_keyframe(found, keyframes[0]) for found in points])
    on_map = pd.concat([evaluate_on_keyframe(found, near) for found in points])
    means = [table.groupby("points", sort=False).mean() for table in (on_keyframe, on_map)]
    precision = means[0].join(means[1].drop(columns=["n", "reached_1m"]).add_suffix("_map"))
    offsets = fit_range_offsets(scans, keyframes[0], OFFSETS_M)
    return MulranStudy(points, keyframes[0], near, precision, frame, offsets)


def describe_mulran(study: MulranStudy | None, network: str) -> dict[str, float]:
    """Name the results of `evaluate_mulran` for a text; NaN without a study.

    Parameters
    ----------
    study : MulranStudy or None
        The results.
    network : str
        Front end of ``mulran_1m``; ``mulran_raw_1m`` is of the raw peaks.

    Returns
    -------
    numbers : dict
        Precision at 1 m near the keyframe [%]; ``mulran_turn_deg`` (clockwise) of the raw peaks fitted to it;
        ``best_offset_m``; pose of the radar in the frame of the published poses: ``frame_first_m`` behind at
        the scans, and medians while driving of ``frame_forward_m`` behind, ``frame_left_m``, ``frame_deg``.
    """
    names = ["mulran_1m", "mulran_raw_1m", "mulran_turn_deg", "best_offset_m"]
    names += ["frame_first_m", "frame_forward_m", "frame_left_m", "frame_deg"]
    if study is None:
        return dict.fromkeys(names, np.nan)
    driving = np.median(study.frame[1:], axis=0)
    values = [*(100 * study.precision.share_1m[[network, "raw"]])]
    values += [-study.offsets.turn_deg[OFFSET_M], study.offsets.score.idxmax()]
    values += [-study.frame[0, 0], -driving[0], driving[1], np.rad2deg(driving[2])]
    return dict(zip(names, map(float, values), strict=True))


def tabulate_mulran(study: MulranStudy) -> pd.DataFrame:
    """Tabulate the precision of `evaluate_mulran` in percent, near the keyframe and on the map,
    and the number of points, by front end."""
    kinds = {"1 m": "share_1m", "2 m": "share_2m", "chance, 1 m": "chance_1m"}
    columns = {title: 100 * study.precision[kind] for title, kind in kinds.items()}
    columns |= {f"map, {title}": 100 * study.precision[f"{kind}_map"] for title, kind in kinds.items()}
    return pd.DataFrame({**columns, "number": study.precision.n})
