"""Read the scans of a session's lidar map, and the simulator's poses of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from rol.evaluation import read_tum
from rol.lidar import crop_range, remove_ground
from rol.maps import thin_points
from rol.oxford import Session, compose_odometry, load_radar_odometry, open_session
from rol.pairs import AlignedScan, load_lidar_points


@dataclass(frozen=True)
class MappingScans:
    """Aligned scans of a session with their poses.

    Attributes
    ----------
    drive : Session
        The session.
    alignment : DataFrame
        Its n scans: rows of ``alignment.csv``.
    poses : array, shape (n, 3)
        Poses at mid-scan by the session's odometry, its start at zero [m, m, rad].
    path_m : array, shape (n,)
        Length of the path so far [m].
    chosen : array of int, shape (k,)
        Scans that go into the map.
    """

    drive: Session
    alignment: pd.DataFrame
    poses: np.ndarray
    path_m: np.ndarray
    chosen: np.ndarray


def read_mapping_scans(
    root: str | Path, alignment_path: str | Path, step_m: float, max_scans: int = 0
) -> MappingScans:
    """Read the aligned scans of a session and choose those that go into its map.

    Parameters
    ----------
    root : path
        Folder of the session.
    alignment_path : path
        Its ``alignment.csv``.
    step_m : float
        One scan is chosen per this length of the path [m].
    max_scans : int
        Use only the first scans; 0 for all.

    Returns
    -------
    scans : MappingScans
    """
    drive = open_session(Path(root))
    table = pd.read_csv(alignment_path)[: max_scans or None]
    stamps_us, _, poses = compose_odometry(load_radar_odometry(drive.odometry_path))
    poses = poses[np.searchsorted(stamps_us, table.radar_stamp_us)]
    path_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    chosen = np.flatnonzero(np.diff(np.floor(path_m / step_m), prepend=-1.0))
    return MappingScans(drive, table, poses, path_m, chosen)


def read_clouds(
    scans: MappingScans, *, min_height: float, max_range: float, cell: float
) -> Iterator[np.ndarray]:
    """Read the lidar points of the chosen scans, motion-compensated and without ground.

    Parameters
    ----------
    scans : MappingScans
        The scans.
    min_height, max_range : float
        Lowest z and largest range of the points kept, in the radar frame [m].
    cell : float
        Points are averaged per cell of this side [m].

    Yields
    ------
    points : array, shape (n, 2), float32
        Points of both sweeps of one scan in the radar frame at mid-scan [m].
    """
    for index in scans.chosen:
        scan = AlignedScan.from_row(scans.alignment.iloc[index])
        sweeps = scan.left_stamp_us, scan.right_stamp_us
        points = load_lidar_points(scans.drive, *sweeps, mid_stamp_us=scan.mid_stamp_us, twist=scan.twist)
        points = crop_range(remove_ground(points, min_height), max_range)
        yield thin_points(points[:, :2], cell)[0].astype(np.float32)


def read_simulated_poses(scans: MappingScans) -> np.ndarray | None:
    """Read the simulator's poses of the scans; None for a real session.

    Parameters
    ----------
    scans : MappingScans
        The scans.

    Returns
    -------
    poses : array, shape (n, 3), or None
        Poses at mid-scan, in the frame of the simulated town [m, m, rad].
    """
    path = scans.drive.root / "truth.tum"
    if not path.is_file():
        return None
    stamps_us, poses = read_tum(path)
    return poses[np.searchsorted(stamps_us, scans.alignment.radar_stamp_us)]
