"""Localization of real radar scans on a real lidar map, from starts that are wrong by a given amount."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.geometry import check_fields, compose, relative_pose
from rol.mcl import MclSettings
from rol.pipeline import RadarLocalizer
from rol.pix2pix import TrainedNetwork
from rol_beyond.front_ends import evaluate_on_map
from rol_beyond.local_map_odometry import LocalMapOdometry
from rol_beyond.motion import MotionModel
from rol_beyond.pipeline import RobustLocalizer
from rol_beyond.recovery import RecoveringFilter, RecoverySettings
from rol_beyond.robust import settings_for
from rol_data.rall import RealScan, group_scans

# Chosen by the errors on Oxford's eleven public scans.
FIRST_PARTICLES, MAX_PARTICLES = 40_000, 5000  # at the first scan, and later
EVEN_M = 2.0  # radius within which points share their weight [m]
SIGMAS = (0.1, 0.05, float(np.deg2rad(0.3)))  # of an odometry increment [m, m, rad]
LIMITS = (0.6, 0.6)  # aimed at [m, deg]
FrontEnd = Callable[[Any], np.ndarray]  # takes a scan and returns its points as recorded, shape (n, 2) [m]
FROM_SCAN = 4  # scan, counted from 1, from which on runs are judged


@dataclass(frozen=True)
class LocalizerSettings:
    """Settings of the robust localizer.

    Attributes
    ----------
    filter : MclSettings
        Of the particle filter.
    recovery : RecoverySettings
        Of detection and relocalization.
    density_radius_m : float
        As in `rol_beyond.pipeline.RobustLocalizer`.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    filter: MclSettings
    recovery: RecoverySettings
    density_radius_m: float

    def __post_init__(self) -> None:
        check_fields(self, {"[0, inf)": "density_radius_m"})


def settings_for_scans() -> LocalizerSettings:
    """Return the settings chosen by the errors on the eleven scans: many particles at first, fewer later."""
    filter_settings = settings_for(
        "robust",
        n_particles=FIRST_PARTICLES,
        max_particles=MAX_PARTICLES,
        motion=MotionModel(sigma_stationary=SIGMAS, sigma_base=SIGMAS, sigma_per_metre=(0.03, 0.03, 0.0)),
        start_spread_m=4.0,
        start_spread_yaw_rad=float(np.deg2rad(4.0)),
    )
    recovery = RecoverySettings(reference_contrast=0.239)  # with sampled points, 80 % of them within 1 m
    return LocalizerSettings(filter_settings, recovery, EVEN_M)


def wrong_starts(off_m: float, off_deg: float, n_directions: int) -> np.ndarray:
    """Return start poses off in all directions, each with both signs of the turn.

    Parameters
    ----------
    off_m, off_deg : float
        Distance and angle to the true pose [m, deg].
    n_directions : int
        Number of directions; the first is straight ahead.

    Returns
    -------
    offsets : array, shape (2 * n_directions, 3)
        Start in the true radar frame [m, m, rad]; the first is ahead and turned to the left.
    """
    angles = 2.0 * np.pi * np.arange(n_directions) / n_directions
    turn = np.deg2rad(off_deg)
    return np.array([(off_m * np.cos(a), off_m * np.sin(a), s * turn) for a in angles for s in (1, -1)])


def cache_front_end(front_end: FrontEnd) -> FrontEnd:
    """Cache the points of each scan for all starts."""
    known: dict[int, np.ndarray] = {}

    def points_of(scan: Any) -> np.ndarray:
        if scan.stamp_us not in known:
            known[scan.stamp_us] = front_end(scan)
        return known[scan.stamp_us]

    return points_of


def crop_map(
    map_points: np.ndarray, map_tree: cKDTree, poses: np.ndarray, reach_m: float = 120.0
) -> np.ndarray:
    """Keep the points of a map near some poses, shape (n, 2) [m], in their order."""
    around = np.unique(np.concatenate(map_tree.query_ball_point(poses[:, :2], reach_m)))
    return map_points[around.astype(int)]


def localize_from_starts(
    scans: Sequence[RealScan],
    front_end: FrontEnd,
    map_points: np.ndarray,
    starts: np.ndarray,
    settings: LocalizerSettings,
    seeds: Sequence[int],
) -> np.ndarray:
    """Localize consecutive scans on a map from several starts.

    Parameters
    ----------
    scans : sequence of RealScan
        The scans, in the order of time.
    front_end : callable
        Takes a scan and returns its points, see `cache_front_end`.
    map_points : array, shape (m, 2)
        Points of the map [m].
    starts : array, shape (s, 3)
        Poses T_map_radar with which the filter begins [m, m, rad].
    settings : LocalizerSettings
        Of the localizer.
    seeds : sequence of int
        Seeds of the runs from each start.

    Returns
    -------
    poses : array, shape (s * len(seeds), len(scans), 3)
        Estimates, the runs of one start after the other [m, m, rad].
    """
    grid = settings.filter.measurement.build_grid(map_points)
    odometry = LocalMapOdometry()  # it does not depend on the start
    motions = {scan.stamp_us: odometry.step(front_end(scan), scan.stamp_us) for scan in scans}
    shared = SimpleNamespace(step=lambda points, stamp_us: motions[stamp_us], deskew=odometry.deskew)
    runs = []
    for start in starts:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            recovering = RecoveringFilter(
                map_points, start, settings.filter, settings.recovery, rng, grid=grid
            )
            how = {"density_radius_m": settings.density_radius_m, "odometry": shared}
            localizer = RobustLocalizer(recovering, front_end, **how)
            runs.append([localizer.step(scan).pose for scan in scans])
    return np.array(runs)


@dataclass(frozen=True, eq=False)
class Drive:
    """Consecutive scans with the map around them.

    Attributes
    ----------
    scans : list of RealScan
        The scans, in the order of time.
    truth : array, shape (k, 3)
        Their poses [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map near them [m].
    """

    scans: list[RealScan]
    truth: np.ndarray
    map_points: np.ndarray

    def seconds(self) -> np.ndarray:
        """Times of the scans after the first, shape (k,) [s]."""
        return np.array([scan.stamp_us - self.scans[0].stamp_us for scan in self.scans]) / 1e6


def split_drives(scans: Sequence[RealScan], map_points: np.ndarray, map_tree: cKDTree | None) -> list[Drive]:
    """Divide scans where more than a second passes between two, and crop the map; none without scans."""
    drives = []
    for rows in group_scans([scan.stamp_us for scan in scans]):
        group = [scans[i] for i in rows]
        truth = np.array([scan.pose for scan in group])
        drives.append(Drive(group, truth, crop_map(map_points, map_tree, truth)))
    return drives


@dataclass(frozen=True, eq=False)
class Localized:
    """Estimates of a front end from several starts, see `localize_drives`.

    Attributes
    ----------
    drives : list of Drive
        The scans.
    poses : list of array, shape (s, k, 3)
        Estimates of every run [m, m, rad], one array per drive.
    """

    drives: list[Drive]
    poses: list[np.ndarray]

    @property
    def errors(self) -> list[np.ndarray]:
        """Errors of every run [m, deg], shape (s, k, 2), one array per drive."""
        pairs = zip(self.poses, self.drives, strict=True)
        return [position_and_heading_errors(poses, drive.truth) for poses, drive in pairs]

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of the errors, see `summarize_starts`."""
        return summarize_starts(self.errors, FROM_SCAN, LIMITS)

    def first_run(self) -> dict[int, np.ndarray]:
        """Estimates from the first start by the scans' stamps."""
        pairs = zip(self.drives, self.poses, strict=True)
        return {
            scan.stamp_us: pose
            for drive, poses in pairs
            for scan, pose in zip(drive.scans, poses[0], strict=True)
        }


def localize_drives(
    drives: Sequence[Drive],
    front_ends: Mapping[str, FrontEnd],
    offsets: np.ndarray,
    settings: LocalizerSettings,
    seeds: Sequence[int],
) -> dict[str, Localized]:
    """Localize drives with several front ends from several starts.

    Parameters
    ----------
    drives : sequence of Drive
        From `split_drives`.
    front_ends : mapping of str to callable
        Front ends by name, see `cache_front_end`.
    offsets : array, shape (s, 3)
        Starts in the frame of the first true pose, from `wrong_starts` [m, m, rad].
    settings, seeds
        As in `localize_from_starts`.

    Returns
    -------
    localized : dict of Localized
        By front end.
    """
    return {
        name: Localized(
            list(drives),
            [
                localize_from_starts(
                    drive.scans, front, drive.map_points, compose(drive.truth[0], offsets), settings, seeds
                )
                for drive in drives
            ],
        )
        for name, front in front_ends.items()
    }


def worst_of_paper(drives: Sequence[Drive], network: TrainedNetwork, seed: int) -> float:
    """Run the paper's method from the true first pose of each drive; largest distance to the true poses [m],
    NaN without drives."""
    worst = np.nan
    for drive in drives:
        rng = np.random.default_rng(seed)
        localizer = RadarLocalizer(drive.map_points, network, drive.truth[0], rng=rng)
        found = np.array([localizer.step(scan).pose for scan in drive.scans])
        worst = np.fmax(worst, position_and_heading_errors(found, drive.truth)[:, 0].max())
    return float(worst)


def localize_alone(
    drives: Sequence[Drive],
    front_end: FrontEnd,
    offsets: np.ndarray,
    settings: LocalizerSettings,
    seed: int,
) -> np.ndarray:
    """Localize each scan of drives on its own, as recorded; errors, shape (n, s, 2) [m, deg]."""
    return np.array([
        localize_points(front_end(scan), scan.pose, drive.map_points, offsets, settings, seed)
        for drive in drives
        for scan in drive.scans
    ]).reshape(-1, len(offsets), 2)  # fmt: skip


def describe_runs(localized: Mapping[str, Localized]) -> dict[str, float]:
    """Name the errors of runs for a text.

    Parameters
    ----------
    localized : mapping of str to Localized
        "fake" (generated points) and "raw" (peaks) -> runs.

    Returns
    -------
    numbers : dict
        ``<front end>_worst_m`` and ``_worst_deg``: largest errors from `FROM_SCAN` on. NaN without runs.
    """
    numbers = {}
    for name in ("fake", "raw"):
        is_there = name in localized and localized[name].poses
        worst = localized[name].summary["worst"] if is_there else (np.nan, np.nan)
        numbers[f"{name}_worst_m"], numbers[f"{name}_worst_deg"] = map(float, worst)
    return numbers


def describe_alone(errors: np.ndarray) -> dict[str, float]:
    """Name the errors of `localize_alone` for a text: median ``lone_m``, and ``lone_met``, the percentage
    within `LIMITS`; NaN without scans."""
    table = pd.DataFrame(errors.reshape(-1, 2), columns=["m", "deg"])
    met = (table <= np.array(LIMITS)).all(axis=1).astype(float)
    return {"lone_m": table.m.median(), "lone_met": 100 * met.mean()}


def tabulate_runs(by_map: Mapping[str, Mapping[str, Localized]], labels: Mapping[str, str]) -> pd.DataFrame:
    """Tabulate the errors of runs on several maps.

    Parameters
    ----------
    by_map : mapping of str to mapping
        Map -> front end -> runs; without runs there are no rows.
    labels : mapping of str to str
        Front end -> label.

    Returns
    -------
    table : pandas.DataFrame
        One row per map and front end: ``map``, ``points``, medians at the first scan and the last, and the
        worst errors from `FROM_SCAN` on [m, deg].
    """
    rows = []
    for where, localized in by_map.items():
        for name, runs in localized.items():
            if runs.poses:
                summary = runs.summary
                rows.append((where, labels[name], *summary["median"][[0, -1]].ravel(), *summary["worst"]))
    columns = [f"{scan} [{unit}]" for scan in ("first scan", "last scan", "worst") for unit in ("m", "deg")]
    return pd.DataFrame(rows, columns=["map", "points", *columns])


def tabulate_scans(judged: pd.DataFrame, network: str, estimates: Mapping[int, np.ndarray]) -> pd.DataFrame:
    """Tabulate precision and estimated pose of every scan.

    Parameters
    ----------
    judged : pandas.DataFrame
        As of `rol_study.real_scans.evaluate_front_ends`.
    network : str
        Front end of the columns ``share_..._fake``.
    estimates : mapping
        Stamp [us] -> estimated pose [m, m, rad].

    Returns
    -------
    table : pandas.DataFrame
        ``timestamp_us``, ``share_1m_raw``, ``share_2m_raw``, ``share_1m_fake``, ``share_2m_fake``, ``x_m``,
        ``y_m``, ``yaw_rad``.
    """
    by_stamp = judged.set_index("timestamp_us")
    columns = {
        f"share_{r}m_{what}": by_stamp[by_stamp["points"] == front][f"share_{r}m"]
        for what, front in (("raw", "raw"), ("fake", network))
        for r in (1, 2)
    }
    table = pd.DataFrame(columns)
    table[["x_m", "y_m", "yaw_rad"]] = [estimates[stamp] for stamp in table.index]
    return table.reset_index()


def position_and_heading_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute the distance [m] and the angle [deg] to the true poses, shape (..., 2);
    leading axes broadcast."""
    x, y, yaw = np.moveaxis(relative_pose(truth, poses), -1, 0)
    return np.stack([np.hypot(x, y), np.rad2deg(np.abs(yaw))], axis=-1)


def summarize_starts(
    errors: Sequence[np.ndarray], first_scan: int, limits: Sequence[float]
) -> dict[str, Any]:
    """Summarize errors over runs from several starts.

    Parameters
    ----------
    errors : sequence of array, shape (s, k, 2)
        Errors of each group of scans [m, deg]; the groups may differ in length.
    first_scan : int
        Scan, counted from 1, from which on the runs are judged.
    limits : sequence of float
        Largest errors allowed [m, deg].

    Returns
    -------
    summary : dict
        ``median``: medians per scan, shape (k, 2); ``worst``: largest errors from ``first_scan`` on, shape
        (2,); ``met``: fraction of the runs that stay within the limits from then on. NaN where no group is
        long enough.
    """
    longest = max(e.shape[1] for e in errors)
    median = [
        np.median(np.concatenate([e[:, i] for e in errors if e.shape[1] > i]), axis=0) for i in range(longest)
    ]
    later = [e[:, first_scan - 1 :] for e in errors if e.shape[1] >= first_scan]
    worst = np.max([e.max(axis=(0, 1)) for e in later], axis=0) if later else np.full(2, np.nan)
    met = float(np.mean([(e <= limits).all(axis=(1, 2)) for e in later])) if later else np.nan
    return {"median": np.array(median), "worst": worst, "met": met}


def localize_points(
    points: np.ndarray,
    pose: np.ndarray,
    map_points: np.ndarray,
    offsets: np.ndarray,
    settings: LocalizerSettings,
    seed: int,
) -> np.ndarray:
    """Localize one cloud by one update of the filter from several starts.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame [m].
    pose : array, shape (3,)
        True pose [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    offsets : array, shape (s, 3)
        Starts in the true radar frame, from `wrong_starts` [m, m, rad].
    settings : LocalizerSettings
        Of the localizer.
    seed : int
        Seed of each run.

    Returns
    -------
    errors : array, shape (s, 2)
        Distance and angle to the true pose [m, deg].
    """
    scan = SimpleNamespace(stamp_us=0)
    starts = compose(pose, offsets)
    found = localize_from_starts([scan], lambda *_: points, map_points, starts, settings, [seed])
    return position_and_heading_errors(found[:, 0], pose)


def evaluate_turn(
    scan: RealScan,
    front_ends: Mapping[str, Callable[..., np.ndarray]],
    variants: Mapping[str, tuple[bool, float]],
    map_points: np.ndarray,
    localize: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> tuple[pd.DataFrame, dict[tuple[str, str], np.ndarray]]:
    """Evaluate a scan with and without motion compensation, and with turned azimuths.

    Parameters
    ----------
    scan : RealScan
        Scan with pose and twist.
    front_ends : mapping of str to callable
        By name; take a scan and a twist (vx, vy, yaw rate) or None [m/s, m/s, rad/s], and return points
        compensated for it, shape (n, 2) [m].
    variants : mapping of str to (bool, float)
        Name -> whether motion is compensated, and the angle added to the azimuths [rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    localize : callable
        Takes points, the true pose and the map and returns errors, shape (s, 2) [m, deg]; see
        `localize_points`.

    Returns
    -------
    table : pandas.DataFrame
        One row per variant and front end: fractions ``share_1m`` and ``share_2m`` at the true pose; medians
        ``m`` and ``deg`` and the largest ``worst_m`` of the errors.
    points : dict
        (variant, front end) -> points, shape (n, 2) [m].
    """
    points, rows, tree = {}, {}, cKDTree(map_points)
    for variant, (is_compensated, turn) in variants.items():
        turned = replace(scan, azimuths=scan.azimuths + turn)
        for name, make_points in front_ends.items():
            cloud = points[variant, name] = make_points(turned, scan.twist if is_compensated else None)
            errors = localize(cloud, scan.pose, map_points)
            shares = evaluate_on_map(cloud, scan.pose, tree)
            middle = dict(zip(("m", "deg"), np.median(errors, axis=0), strict=True))
            rows[variant, name] = {**shares, **middle, "worst_m": errors[:, 0].max()}
    return pd.DataFrame.from_dict(rows, orient="index").drop(columns="n"), points


def describe_turn(table: pd.DataFrame | None) -> dict[str, float]:
    """Name the median position errors of generated points of `evaluate_turn` for a text.

    ``recorded_fake_m`` and ``compensated_fake_m``; NaN for a variant that the table lacks, and without a
    table.
    """
    medians = {} if table is None else table.m.to_dict()
    return {f"{v}_fake_m": medians.get((v, "fake"), np.nan) for v in ("recorded", "compensated")}


def tabulate_turns(turns: Mapping[int, tuple[pd.DataFrame, Any]], labels: Mapping[str, str]) -> pd.DataFrame:
    """Tabulate the results of `evaluate_turn` of several scans.

    Parameters
    ----------
    turns : mapping
        Stamp of a scan [us] -> what `evaluate_turn` returns; at least one.
    labels : mapping of str to str
        Front end -> label.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan, variant and front end, the precision in percent.
    """
    table = pd.concat({stamp: found for stamp, (found, _) in turns.items()})
    table = table.rename_axis(["scan", "variant", "points"]).reset_index()
    table[["share_1m", "share_2m"]] *= 100
    table["points"] = table["points"].map(labels)
    names = ["within 1 m [%]", "within 2 m [%]", "median [m]", "median [deg]", "worst [m]"]
    return table.rename(
        columns=dict(zip(["share_1m", "share_2m", "m", "deg", "worst_m"], names, strict=True))
    )
