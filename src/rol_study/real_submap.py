"""A submap of real lidar sweeps, placed along the official odometry and registered onto the published map.

The sweeps are those of the left HDL-32E around the eleven real radar scans of `rol_data.rall.load_scans`. A
`.bin` holds no times; those of the points follow from their bearings. A stamp is the beginning of a sweep,
as `rol_study.real_pairs` finds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.evaluation import pose_errors
from rol.geometry import compose, exp, invert, log, relative_pose, transform_points
from rol.lidar import crop_range, remove_ground
from rol.maps import accumulate_map, register_maps, residuals_along, to_first_map
from rol.oxford import (
    RadarOdometry,
    compose_odometry,
    load_radar_odometry,
    load_timestamps,
)
from rol.radar import deskew_points
from rol_beyond.augmentation import rotate_points
from rol_data.oxford_pairs import Sweep, load_sweep_points
from rol_data.rall import SCANS_PATH

SWEEPS_PATH = Path("oxford_car_visualiser2/data")  # below the folder of the real data
SENSOR = "velodyne_left"
MIN_HITS = 20  # sweeps that must hit a cell: those of one second, longer than a moving vehicle covers it
# Stages of `rol.maps.register_maps` for a segment near its place.
SEGMENT_STAGES = ((np.inf, 2.0, 0.5, 0.25), (np.inf, 1.0, 0.3, 0.25))


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
        """Return the poses of radar scans at mid-scan, shape (j, 3);
        a SubmapError for a scan without odometry."""
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


def load_placed_sweeps(real_root: Path | str) -> PlacedSweeps:
    """Read all listed sweeps, compensate the motion, and place them along the official odometry.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.

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
    clouds = []
    for stamp, twist in zip(stamps[valid].tolist(), twists, strict=True):
        sweep = Sweep(folder / "binaries" / f"{stamp}.bin", SENSOR, stamp)
        points, seconds = load_sweep_points(sweep)
        points = deskew_points(points[:, :3], seconds, twist)
        clouds.append(crop_range(remove_ground(points))[:, :2])
    scan_stamps, _, scan_poses = compose_odometry(odometry)
    scan_poses = relative_pose(poses[0], scan_poses)
    return PlacedSweeps(stamps[valid], clouds, relative_pose(poses[0], poses), scan_stamps, scan_poses)


def build_submap(
    sweeps: PlacedSweeps,
    left_out_us: Iterable[int] = (),
    gap_s: float = 1.0,
    *,
    cell: float = 0.25,
    min_hits: int = MIN_HITS,
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


def register_segments(
    sweeps: PlacedSweeps, map_points: np.ndarray, T_map_submap: np.ndarray, edges: Sequence[int]
) -> pd.DataFrame:
    """Register segments of the sweeps to a map, each on its own.

    Parameters
    ----------
    sweeps : PlacedSweeps
        From `load_placed_sweeps`.
    map_points : array, shape (m, 2)
        Points of the map [m].
    T_map_submap : array, shape (3,)
        Registration of the whole submap, the initial guess [m, m, rad].
    edges : sequence of int
        Indices of the first sweep of each segment, and of the end of the last.

    Returns
    -------
    table : pandas.DataFrame
        One row per segment: ``first``, ``last`` sweep, ``speed_mps``, and the motion from the pose of the
        whole submap to that of the segment in the vehicle's frame at mid-segment: ``forward_m``, ``left_m``,
        ``heading_deg``.
    """
    rows = []
    for first, end in pairwise(edges):
        segment = accumulate_map(sweeps.clouds[first:end], sweeps.poses[first:end], min_hits=2)
        found = register_maps(segment, map_points, T_map_submap, stages=SEGMENT_STAGES)
        middle = sweeps.poses[(first + end) // 2]
        motion = relative_pose(compose(T_map_submap, middle), compose(found.T_target_source, middle))
        length_m = np.hypot(*np.diff(sweeps.poses[first:end, :2], axis=0).T).sum()
        seconds = (sweeps.stamps_us[end - 1] - sweeps.stamps_us[first]) / 1e6
        moved = {"forward_m": motion[0], "left_m": motion[1], "heading_deg": np.rad2deg(motion[2])}
        rows.append({"first": first, "last": end - 1, "speed_mps": length_m / seconds, **moved})
    return pd.DataFrame(rows)


@dataclass(frozen=True, eq=False)
class Changes:
    """Differences between a submap and an older map near a path.

    Attributes
    ----------
    same, new : array, shape (n, 2)
        Points of the submap that are near the older map, and those that are not [m].
    confirmed, gone, hidden : array, shape (m, 2)
        Points of the older map that the lidar met, those that it saw past, and the others [m].
    """

    same: np.ndarray
    new: np.ndarray
    confirmed: np.ndarray
    gone: np.ndarray
    hidden: np.ndarray


def find_changes(
    submap: np.ndarray,
    map_points: np.ndarray,
    clouds: Sequence[np.ndarray],
    poses: np.ndarray,
    *,
    reach_m: float = 30.0,
    radius_m: float = 1.0,
) -> Changes:
    """Find what has changed near a path since a map was made.

    Parameters
    ----------
    submap, map_points : array, shape (n, 2) and (m, 2)
        Submap and older map in one frame [m].
    clouds : sequence of array, shape (k, 2)
        Sweeps without the ground, each in its own frame [m].
    poses : array, shape (j, 3)
        Their poses in the map [m, m, rad].
    reach_m : float
        Points farther from all poses are left out [m].
    radius_m : float
        A point of the submap is new if no map point is within this radius; a map point is gone if most of the
        sweeps that say anything about it saw past it by more than this, and confirmed if most of them met it
        [m].

    Returns
    -------
    changes : Changes
        A map point about which no sweep says anything is hidden.
    """
    path = cKDTree(poses[:, :2])
    submap, map_points = (points[path.query(points)[0] < reach_m] for points in (submap, map_points))
    is_new = cKDTree(map_points).query(submap)[0] > radius_m
    past, met = count_sightings(map_points, clouds, poses, radius_m).T
    is_gone, is_there = past > met, (met >= past) & (met > 0)
    hidden = map_points[~is_gone & ~is_there]
    return Changes(submap[~is_new], submap[is_new], map_points[is_there], map_points[is_gone], hidden)


def sharpest_angle(angles: np.ndarray, counts: np.ndarray) -> float:
    """Find the minimum of the parabola through the counts of `measure_sharpness`,
    in the unit of the angles."""
    square, slope, _ = np.polyfit(angles, counts, 2)
    return float(-slope / (2.0 * square))


def measure_sharpness(
    sweeps: PlacedSweeps, angles: np.ndarray, every: int = 8, cell: float = 0.25
) -> np.ndarray:
    """Count the cells that a submap occupies when all sweeps are rotated by the same angle.

    With a wrong rotation between lidar and odometry, a wall seen from several poses is drawn several times,
    so the right rotation needs the fewest cells.

    Parameters
    ----------
    sweeps : PlacedSweeps
        From `load_placed_sweeps`.
    angles : array, shape (k,)
        Counter-clockwise rotations of the sweeps about the radar [rad].
    every : int
        Use every so many-th sweep.
    cell : float
        Side of a cell [m].

    Returns
    -------
    counts : array, shape (k,), int
        Number of occupied cells.
    """
    clouds, poses = sweeps.clouds[::every], sweeps.poses[::every]
    rotated = (([rotate_points(cloud, angle) for cloud in clouds]) for angle in angles)
    return np.array([len(accumulate_map(turned, poses, cell, min_hits=1)) for turned in rotated])


def count_sightings(
    points: np.ndarray, clouds: Iterable[np.ndarray], poses: np.ndarray, margin_m: float = 1.0
) -> np.ndarray:
    """Count how often the lidar saw past map points, and how often it met them.

    A point counts as seen past when all returns in its direction (one degree) are farther away than the point
    by more than the margin. Points closer behind something are hidden, and directions without a return say
    nothing.

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
        Number of sweeps that saw past each point, and of those that had their nearest return within the
        margin of it.
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
    """Compute the bearing in whole degrees, 0..359, and the range of each point [m]."""
    degrees = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    return np.floor(degrees).astype(int) % 360, np.hypot(points[:, 0], points[:, 1])


@dataclass(frozen=True, eq=False)
class RegisteredSubmap:
    """A submap registered to the map, and its poses of the radar scans.

    Attributes
    ----------
    sweeps : PlacedSweeps
        The sweeps.
    points : array, shape (m, 2)
        The submap, in the frame of the map [m].
    path : array, shape (n, 3)
        Poses of the sweeps on the map [m, m, rad].
    T_map_submap : array, shape (3,)
        Registration from the first start [m, m, rad].
    spread_m : float
        Largest distance between the registrations from all starts [m].
    residuals_m : array, shape (k,)
        Median distance to the map of every eighth sweep [m].
    differences : array, shape (s, 4)
        Registered minus given poses of the radar scans: forward, left, distance [m], heading [deg].
    """

    sweeps: PlacedSweeps
    points: np.ndarray
    path: np.ndarray
    T_map_submap: np.ndarray
    spread_m: float
    residuals_m: np.ndarray
    differences: np.ndarray


def register_submap(
    real_root: Path | str,
    stamps_us: Sequence[int],
    poses: np.ndarray,
    map_points: np.ndarray,
    offsets: np.ndarray,
    min_hits: int = MIN_HITS,
) -> RegisteredSubmap:
    """Accumulate all sweeps, register the submap from several starts, and compare it with given poses.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    stamps_us : sequence of int
        Names of radar scans [us].
    poses : array, shape (s, 3)
        Their poses on the map; the first, moved by the offsets, is the initial guess [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map around them [m].
    offsets : array, shape (k, 3)
        Starts in the frame of the first pose [m, m, rad].
    min_hits : int
        As in `build_submap`.

    Returns
    -------
    registered : RegisteredSubmap

    Raises
    ------
    SubmapError
        If the odometry does not cover the sweeps or has no pose for a scan.
    """
    sweeps = load_placed_sweeps(real_root)
    submap, own = build_submap(sweeps, min_hits=min_hits), sweeps.scan_poses(stamps_us)
    starts = compose(compose(poses[0], offsets), invert(own[0]))
    found = np.array([register_maps(submap, map_points, start).T_target_source for start in starts])
    path = to_first_map(found[0], sweeps.poses)
    errors = pose_errors(to_first_map(found[0], own), poses)
    sides = errors.longitudinal_m, errors.lateral_m, errors.position_m, np.rad2deg(errors.yaw_rad)
    return RegisteredSubmap(
        sweeps,
        transform_points(found[0], submap),
        path,
        found[0],
        float(np.hypot(*(found - found[0])[:, :2].T).max()),
        residuals_along(sweeps.clouds[::8], path[::8], map_points),
        np.column_stack(sides),
    )


def describe_submap(
    registered: RegisteredSubmap | None,
    segments: pd.DataFrame | None,
    changes: Changes | None,
    sharpest_deg: float = np.nan,
) -> dict[str, float]:
    """Name the results on a submap for a text; NaN without one.

    Parameters
    ----------
    registered, segments, changes
        From `register_submap`, `register_segments` and `find_changes`.
    sharpest_deg : float
        From `sharpest_angle` [deg].

    Returns
    -------
    numbers : dict
        ``submap_s`` and ``submap_m``, duration and length of the path;
        ``submap_residual_m``, median distance of sweeps to the map; ``segment_low_m`` and ``segment_high_m``,
        smallest and largest shift forward of segments; ``submap_off_m`` and ``submap_worst_m``, mean and
        largest distance to the given poses, ``submap_deg``, their mean heading difference; ``changed_new``
        and ``changed_gone`` [%]; ``sharpest_deg``.
    """
    names = ["submap_s", "submap_m", "submap_residual_m", "segment_low_m"]
    names += ["segment_high_m", "submap_off_m", "submap_worst_m", "submap_deg"]
    names += ["changed_new", "changed_gone", "sharpest_deg"]
    if registered is None:
        return dict.fromkeys(names, np.nan)
    forward, (distance, heading) = segments.forward_m, registered.differences.T[2:]
    n_new, n_gone = len(changes.new), len(changes.gone)
    seconds, steps = np.ptp(registered.sweeps.stamps_us) / 1e6, np.diff(registered.path[:, :2], axis=0)
    values = [seconds, np.hypot(*steps.T).sum()]
    values += [np.median(registered.residuals_m), forward.min(), forward.max()]
    values += [distance.mean(), distance.max(), heading.mean()]
    values += [100 * n_new / (n_new + len(changes.same)), 100 * n_gone / (n_gone + len(changes.confirmed))]
    return dict(zip(names, [*map(float, values), sharpest_deg], strict=True))
