"""A submap of real lidar sweeps: placed along the official odometry, accumulated, and registered onto the published map.

The sweeps are those of the left HDL-32E around the eleven real radar scans of `rol_data.rall.load_scans`. A `.bin` holds
the points in the order in which they were fired, but neither their times nor the meaning of the sweep's stamp, so the
position of the stamp within the sweep is an argument.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from rol.geometry import compose, exp, log, relative_pose, transform_points
from rol.lidar import crop_range, relate_sensors, remove_ground, sweep_to_radar
from rol.maps import accumulate_map
from rol.oxford import (
    EXTRINSICS,
    RadarOdometry,
    compose_odometry,
    load_radar_odometry,
    load_timestamps,
    load_velodyne_binary,
)
from rol.radar import deskew_points
from rol_data.rall import SCANS_PATH

SWEEPS_PATH = Path("oxford_car_visualiser2/data")  # below the folder of the real data
SENSOR = "velodyne_left"
SWEEP_SECONDS = 0.05  # one turn of the HDL-32E
STAMP_POSITION = 0.5  # of a sweep's stamp within its turn: 0 the beginning, 1 the end


class SubmapError(ValueError):
    """Raised for sweeps that cannot be placed; the message names the file and the fault."""


@dataclass(frozen=True, eq=False)
class PlacedSweeps:
    """Sweeps without the ground, and where they were recorded.

    Attributes
    ----------
    stamps_us : array, shape (n,), int64
        Names of the sweeps [us].
    clouds : list of array, shape (m, 2)
        Points in the radar frame at the stamp, motion compensated [m].
    poses : array, shape (n, 3)
        Pose of the radar at each stamp, in the frame of the first [m, m, rad].
    odometry_stamps_us, odometry_poses : array, shape (k,) and (k, 3)
        Names of the radar scans of the whole odometry [us], and their poses at mid-scan in the same frame.
    """

    stamps_us: np.ndarray
    clouds: list[np.ndarray]
    poses: np.ndarray
    odometry_stamps_us: np.ndarray
    odometry_poses: np.ndarray

    def scan_poses(self, stamps_us: Iterable[int]) -> np.ndarray:
        """Give the poses of radar scans at mid-scan, shape (j, 3); a SubmapError for a scan without odometry."""
        row = {int(stamp): i for i, stamp in enumerate(self.odometry_stamps_us)}
        missing = [stamp for stamp in stamps_us if int(stamp) not in row]
        if missing:
            raise SubmapError(f"radar odometry: has no pose for scan {missing[0]}")
        return self.odometry_poses[[row[int(stamp)] for stamp in stamps_us]]


def interpolate_odometry(odometry: RadarOdometry, stamps_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the odometry at given times with constant velocity between scans.

    Parameters
    ----------
    odometry : RadarOdometry
        From `rol.oxford.load_radar_odometry`.
    stamps_us : array, shape (n,)
        Times [us].

    Returns
    -------
    poses : array, shape (n, 3)
        Poses in the frame of the odometry's first scan [m, m, rad].
    twists : array, shape (n, 3)
        Body velocities [m/s, m/s, rad/s].

    Raises
    ------
    SubmapError
        If a time lies outside the odometry.
    """
    _, mids, poses = compose_odometry(odometry)
    stamps = np.asarray(stamps_us, dtype=np.int64)
    if len(stamps) == 0 or stamps.min() < mids[0] or stamps.max() > mids[-1]:
        span = f"{stamps.min()} .. {stamps.max()}" if len(stamps) else "none"
        raise SubmapError(f"{odometry.path}: covers {mids[0]} .. {mids[-1]} us, but the sweeps are {span}")
    i = np.clip(np.searchsorted(mids, stamps, side="right") - 1, 0, len(mids) - 2)
    twists = log(odometry.increments[i]) / (np.diff(mids)[i] / 1e6)[:, None]
    return compose(poses[i], exp(twists, (stamps - mids[i]) / 1e6)), twists


def load_cloud(
    path: Path,
    twist: np.ndarray,
    *,
    stamp_position: float = STAMP_POSITION,
    min_height: float = -1.5,
    max_range: float = 64.0,
) -> np.ndarray:
    """Read one sweep, compensate the motion, and remove the ground.

    Parameters
    ----------
    path : Path
        The `.bin`.
    twist : array, shape (3,)
        Body velocity of the radar [m/s, m/s, rad/s].
    stamp_position : float
        Position of the stamp within the sweep: 0 the beginning, 0.5 the middle, 1 the end.
    min_height, max_range : float
        Lowest z and largest range of the points kept, in the radar frame [m].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame at the sweep's stamp [m].

    Raises
    ------
    rol.oxford.OxfordError
        If the file is missing or at fault.
    """
    points = load_velodyne_binary(path)
    seconds = (np.arange(len(points)) / len(points) - stamp_position) * SWEEP_SECONDS
    points = sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[SENSOR]))[:, :3]
    points = deskew_points(points, seconds, twist)
    return crop_range(remove_ground(points, min_height), max_range)[:, :2]


def load_placed_sweeps(real_root: Path | str, stamp_position: float = STAMP_POSITION) -> PlacedSweeps:
    """Read all listed sweeps and place them along the official odometry.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.
    stamp_position : float
        As in `load_cloud`.

    Returns
    -------
    sweeps : PlacedSweeps
        The sweeps that `velodyne_left.timestamps` lists with flag 1; files that it does not list are ignored.

    Raises
    ------
    SubmapError
        If the odometry does not cover the sweeps.
    rol.oxford.OxfordError
        If a listed sweep or another file is missing or at fault.
    """
    folder = Path(real_root) / SWEEPS_PATH
    stamps, valid = load_timestamps(folder / f"{SENSOR}.timestamps")
    odometry = load_radar_odometry(Path(real_root) / SCANS_PATH / "gt" / "radar_odometry.csv")
    poses, twists = interpolate_odometry(odometry, stamps[valid])
    clouds = [
        load_cloud(folder / "binaries" / f"{stamp}.bin", twist, stamp_position=stamp_position)
        for stamp, twist in zip(stamps[valid], twists, strict=True)
    ]
    scan_stamps, _, scan_poses = compose_odometry(odometry)
    scan_poses = relative_pose(poses[0], scan_poses)
    return PlacedSweeps(stamps[valid], clouds, relative_pose(poses[0], poses), scan_stamps, scan_poses)


def build_submap(
    sweeps: PlacedSweeps,
    left_out_us: Iterable[int] = (),
    gap_s: float = 1.0,
    *,
    cell: float = 0.25,
    min_hits: int = 3,
) -> np.ndarray:
    """Accumulate sweeps into a submap.

    Parameters
    ----------
    sweeps : PlacedSweeps
        From `load_placed_sweeps`.
    left_out_us : iterable of int
        Times around which sweeps are left out, such as the middles of radar scans to be localized [us].
    gap_s : float
        Sweeps less than this from such a time are left out [s].
    cell, min_hits : float, int
        As in `rol.maps.accumulate_map`.

    Returns
    -------
    points : array, shape (m, 2)
        The submap in the frame of the first sweep [m].

    Raises
    ------
    SubmapError
        If no sweep is left.
    rol.maps.MapError
        If no cell is hit often enough.
    """
    left_out = np.array(list(left_out_us), dtype=np.int64)
    gaps_us = np.abs(sweeps.stamps_us[:, None] - left_out[None, :])
    kept = np.flatnonzero((gaps_us >= gap_s * 1e6).all(axis=1))
    if len(kept) == 0:
        raise SubmapError(f"all {len(sweeps.stamps_us)} sweeps are within {gap_s} s of a scan")
    return accumulate_map((sweeps.clouds[i] for i in kept), sweeps.poses[kept], cell, min_hits)


def find_free_points(
    points: np.ndarray, clouds: Iterable[np.ndarray], poses: np.ndarray, margin_m: float = 1.0
) -> np.ndarray:
    """Compute how often the lidar saw past map points that it should have met.

    A point counts as seen past when all returns in its direction (one degree) are farther away than the point by more
    than the margin. Points closer behind something are hidden, and directions without a return say nothing.

    Parameters
    ----------
    points : array, shape (m, 2)
        Points of the older map [m].
    clouds : iterable of array, shape (n, 2)
        Sweeps without the ground, each in its own frame [m].
    poses : array, shape (k, 3)
        Pose of each sweep in the map [m, m, rad].
    margin_m : float
        Smallest distance from the point to the nearest return behind it [m].

    Returns
    -------
    counts : array, shape (m, 2), int
        Number of sweeps that saw past each point, and of those that had their nearest return within the margin of it.
    """
    counts = np.zeros((len(points), 2), dtype=int)
    for cloud, pose in zip(clouds, poses, strict=True):
        nearest = np.full(360, np.inf)
        bearing, ranges = _to_polar(cloud)
        np.minimum.at(nearest, bearing, ranges)
        bearing, ranges = _to_polar(transform_points(relative_pose(pose, np.zeros(3)), points))
        behind_m = nearest[bearing] - ranges
        counts[:, 0] += np.isfinite(behind_m) & (behind_m > margin_m)
        counts[:, 1] += np.abs(behind_m) <= margin_m
    return counts


def _to_polar(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the bearing in whole degrees, 0..359, and the range of each point [m]."""
    degrees = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    return np.floor(degrees).astype(int) % 360, np.hypot(points[:, 0], points[:, 1])
