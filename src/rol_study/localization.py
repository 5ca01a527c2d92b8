"""Localization runs on one session: clouds of each kind, the filter, and registration without a filter.

The clouds come from the results of chapters 02 to 05. A run keeps the estimates, diagnostics and times of all
scans, but not the particles, so that its memory stays small on a long session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, MutableSequence, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pandas as pd

from rol.bev import image_to_points
from rol.evaluation import (
    FailureMonitor,
    PoseErrors,
    pose_errors,
    read_metrics,
    read_tum,
    summarize,
    write_metrics,
    write_tum,
)
from rol.files import write_text
from rol.mcl import MclUpdate, ParticleFilter, localize
from rol.oxford import load_radar, open_session
from rol.pairs import read_image, read_points
from rol_beyond.front_ends import detect_points
from rol_beyond.scan_matching import scan_to_map_icp

POINT_SOURCES = {  # name -> label; "corrected": at mid-scan
    "raw": "raw radar peaks",
    "fake": "generated points",
    "real": "lidar points",
    "raw-corrected": "raw radar peaks, compensated",
    "fake-corrected": "generated points, compensated",
    "real-corrected": "lidar points, compensated",
}
FAST_MPS = 4.0  # speed above which `heading_bias_deg` counts a scan [m/s]
DIAGNOSTICS = {  # column of steps.csv -> field of MclUpdate
    "ess": "ess",
    "spread_m": "spread_m",
    "spread_yaw_rad": "spread_yaw_rad",
    "match_share": "inlier_ratio",
    "n_points": "n_points",
    "is_informed": "measurement_used",
}
_WITHOUT_PARTICLES = dict.fromkeys(("particles", "weights", "next_particles", "next_weights"))


def read_clouds(
    source: str, session: str, stamps_us: np.ndarray, in_dir: Path | str, sessions_root: Path | str
) -> Iterator[np.ndarray]:
    """Read the cloud of each scan of a session, one after the other.

    Parameters
    ----------
    source : str
        Kind of points, one of `POINT_SOURCES`: peaks of the radar, points of the generated images, or lidar
        points of the pairs; motion-compensated if it ends in "-corrected".
    session : str
        Name of the session.
    stamps_us : array of int, shape (n,)
        Times of the scans [us].
    in_dir : path
        Results of chapters 02 to 05.
    sessions_root : path
        Folder of the sessions, for the polar scans.

    Returns
    -------
    clouds : iterator of array, shape (m, 2)
        Points in the radar frame [m].

    Raises
    ------
    ValueError
        If there is no such source.
    """
    if source not in POINT_SOURCES:
        raise ValueError(f"points_source is {source!r}, expected one of {', '.join(POINT_SOURCES)}")
    kind, _, corrected = source.partition("-")
    stamps = np.asarray(stamps_us).tolist()
    table = pd.read_csv(Path(in_dir, "alignment", session, "alignment.csv")).set_index("radar_stamp_us")
    twists = table.loc[stamps, ["vx_mps", "vy_mps", "yaw_rate_radps"]].to_numpy()
    if kind == "fake":
        return read_points(Path(in_dir, "fake", session), stamps, twists if corrected else None)
    if kind == "raw":
        folder = open_session(Path(sessions_root, session))
        scans = (load_radar(folder.radar_path(us)) for us in stamps)
        return (
            detect_points(scan.power, scan.azimuths, tuple(twist) if corrected else None)
            for scan, twist in zip(scans, twists, strict=True)
        )
    images = Path(in_dir, source.replace("real", "pairs"), session, "lidar")
    return (image_to_points(read_image(images / f"{us}.png")) for us in stamps)


@dataclass(frozen=True)
class FilterRun:
    """One run over a session.

    Attributes
    ----------
    poses : array, shape (n, 3)
        Estimates T_map_radar [m, m, rad].
    failures : list of int
        Scans after which the run was reset.
    updates : list of MclUpdate
        Diagnostics of each scan, without particles; none for a run without a filter.
    times_ms : list of float
        Time of each scan [ms].
    """

    poses: np.ndarray
    failures: list[int]
    updates: list[MclUpdate]
    times_ms: list[float]

    def summarize(self, truth: np.ndarray, method: str, session: str, seed: int) -> dict:
        """Compute the metrics of the run by `rol.evaluation.summarize`."""
        median_ms = float(np.median(self.times_ms))
        names = {"method": method, "session": session, "seed": seed, "failures": len(self.failures)}
        return summarize(self.poses, truth, update_ms_median=median_ms, **names)


def run_filter(
    particle_filter: ParticleFilter,
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    monitor: FailureMonitor,
    particles: MutableSequence | None = None,
) -> FilterRun:
    """Run a filter over the scans of a session; after a failure it is reset to the ground truth.

    Parameters
    ----------
    particle_filter : ParticleFilter
        Filter at the first pose.
    increments : iterable of array, shape (3,)
        Odometry between successive scans [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    monitor : FailureMonitor
        Records failures and resets the filter.
    particles : mutable sequence, optional
        The particles of each scan are appended to it, such as a `rol.array_file.ArrayFile`.

    Returns
    -------
    run : FilterRun
    """
    updates, times_ms = [], []
    begin = perf_counter()
    for update in localize(particle_filter, increments, clouds, monitor):
        times_ms.append(1000.0 * (perf_counter() - begin))
        updates.append(replace(update, **_WITHOUT_PARTICLES))
        if particles is not None:
            particles.append(update.particles)
        begin = perf_counter()
    poses = np.array([update.pose for update in updates])
    return FilterRun(poses, monitor.failures, updates, times_ms)


def run_registration(
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    start: np.ndarray,
    monitor: FailureMonitor,
) -> FilterRun:
    """Register each cloud to the map by ICP, without a filter; after a failure from the ground truth.

    Parameters
    ----------
    increments : iterable of array, shape (3,)
        Odometry between successive scans [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    map_points : array, shape (k, 2)
        Map [m].
    start : array, shape (3,)
        Pose at the first scan [m, m, rad].
    monitor : FailureMonitor
        Records failures and resets the pose.

    Returns
    -------
    run : FilterRun
    """
    poses, times_ms = [], []
    begin = perf_counter()
    for result in scan_to_map_icp(increments, clouds, map_points, start, monitor):
        times_ms.append(1000.0 * (perf_counter() - begin))
        poses.append(result.T_target_source)
        begin = perf_counter()
    return FilterRun(np.array(poses), monitor.failures, [], times_ms)


def compare_with_registration(
    clouds: Sequence[np.ndarray],
    increments: np.ndarray,
    map_points: np.ndarray,
    new_filter: Callable[[int], ParticleFilter],
    new_monitor: Callable[[], FailureMonitor],
    seeds: Iterable[int],
) -> Iterator[tuple[str, int, FilterRun]]:
    """Localize one kind of points by the filter, for several seeds, and by registration to the map alone.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    increments : array, shape (n - 1, 3)
        Odometry from the same points [m, m, rad].
    map_points : array, shape (k, 2)
        Map [m].
    new_filter : callable
        Makes the filter of a seed.
    new_monitor : callable
        Makes a monitor.
    seeds : iterable of int
        Seeds of the filter, at least one.

    Yields
    ------
    way : str
        "filter" or "ICP on the map".
    seed : int
        Seed of the run; registration has none and carries the first.
    run : FilterRun
        The run.
    """
    seeds = list(seeds)
    for seed in seeds:
        yield "filter", seed, run_filter(new_filter(seed), increments, clouds, new_monitor())
    monitor = new_monitor()
    registered = run_registration(increments, clouds, map_points, monitor.truth[0], monitor)
    yield "ICP on the map", seeds[0], registered


def heading_bias_deg(poses: np.ndarray, truth: np.ndarray, speed_mps: np.ndarray) -> float:
    """Compute the mean heading error of the scans above `FAST_MPS`.

    Parameters
    ----------
    poses, truth : array, shape (n, 3)
        Estimates and ground truth [m, m, rad].
    speed_mps : array, shape (n,)
        Speed of the vehicle [m/s].

    Returns
    -------
    bias_deg : float
        Positive to the left [deg]; NaN without such a scan.
    """
    errors = np.rad2deg(pose_errors(poses, truth).yaw_rad[np.asarray(speed_mps) > FAST_MPS])
    return float(errors.mean()) if len(errors) else float("nan")


def write_run(
    folder: Path | str, run: FilterRun, stamps_us: np.ndarray, truth: np.ndarray, metrics: dict
) -> None:
    """Write the files of one run: ``trajectory.tum``, ``truth.tum``, ``steps.csv`` and ``metrics.json``.

    Parameters
    ----------
    folder : path
        Folder of the run.
    run : FilterRun
        The run.
    stamps_us : array of int, shape (n,)
        Times of the scans [us].
    truth : array, shape (n, 3)
        Ground truth [m, m, rad].
    metrics : dict
        Metrics of the run.
    """
    folder, errors = Path(folder), pose_errors(run.poses, truth)
    steps = pd.DataFrame({"radar_stamp_us": stamps_us, "speed_mps": speed_of(stamps_us, truth)})
    steps["update_ms"] = run.times_ms
    for name in ("position_m", "longitudinal_m", "lateral_m", "yaw_rad"):
        steps[name] = getattr(errors, name)
    for name, field in DIAGNOSTICS.items():
        steps[name] = [getattr(update, field) for update in run.updates]
    steps["is_restarted"] = np.isin(np.arange(len(steps)), run.failures)
    write_tum(folder / "trajectory.tum", stamps_us, run.poses)
    write_tum(folder / "truth.tum", stamps_us, truth)
    write_text(folder / "steps.csv", steps.to_csv(index=False))
    write_metrics(folder / "metrics.json", metrics)


@dataclass(frozen=True)
class StoredRun:
    """Results of one session and method, as chapter 07 writes them.

    Attributes
    ----------
    metrics : dict
        Metrics of the first seed.
    truth, estimate : array, shape (n, 3)
        Ground truth and estimates T_map_radar of that seed [m, m, rad].
    errors : PoseErrors
        Their errors.
    steps : DataFrame
        One row per scan: ``steps.csv`` with the true ``yaw_rate_degps``.
    seeds, sources : DataFrame
        Metrics of all seeds, and of the kinds of points.
    """

    metrics: dict
    truth: np.ndarray
    estimate: np.ndarray
    errors: PoseErrors
    steps: pd.DataFrame
    seeds: pd.DataFrame
    sources: pd.DataFrame


def read_run(folder: Path | str) -> StoredRun:
    """Read the results of one session and method.

    Parameters
    ----------
    folder : path
        Folder that chapter 07 wrote.

    Returns
    -------
    run : StoredRun

    Raises
    ------
    rol.evaluation.EvaluationError, OSError
        If a file is missing or damaged; the message names it.
    """
    folder = Path(folder)
    stamps_us, truth = read_tum(folder / "truth.tum")
    estimate = read_tum(folder / "trajectory.tum")[1]
    steps, seeds, sources = (pd.read_csv(folder / f"{name}.csv") for name in ("steps", "seeds", "sources"))
    yaw_rate = np.gradient(np.unwrap(truth[:, 2]), stamps_us / 1e6)
    steps["yaw_rate_degps"] = np.rad2deg(yaw_rate)
    errors = pose_errors(estimate, truth)
    metrics = read_metrics(folder / "metrics.json")
    return StoredRun(metrics, truth, estimate, errors, steps, seeds, sources)


def speed_of(stamps_us: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Compute the speed at each pose by central differences, shape (n,) [m/s].

    Parameters
    ----------
    stamps_us : array of int, shape (n,)
        Times [us], n at least two.
    poses : array, shape (n, 3)
        Poses [m, m, rad].

    Returns
    -------
    speed_mps : array, shape (n,)
        Speed [m/s].
    """
    seconds = (stamps_us - stamps_us[0]) / 1e6
    return np.hypot(*np.gradient(poses[:, :2], seconds, axis=0).T)


def mean_over_seeds(seeds: pd.DataFrame, column: str, scale: float = 1.0, digits: int = 2) -> str:
    """Format the mean and standard deviation of a metric over seeds, such as "4.06 ± 0.69"."""
    values = scale * seeds[column]
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


def errors_by_motion(steps: pd.DataFrame, turning_degps: float = 3.0) -> pd.DataFrame:
    """Compute the errors of slow and fast scans, and of straight segments and turns.

    Parameters
    ----------
    steps : DataFrame
        One row per scan: ``speed_mps``, ``yaw_rate_degps``, ``position_m``, ``longitudinal_m``,
        ``lateral_m`` and ``yaw_rad``.
    turning_degps : float
        Yaw rate from which a scan counts as turning [deg/s].

    Returns
    -------
    table : DataFrame
        Rows "all", "slow", "fast" (above the median speed), "straight" and "turning"; columns ``n``,
        ``rmse_m``, ``longitudinal_m``, ``lateral_m``, ``rmse_yaw_deg``, all but ``n`` root mean squares.
    """
    is_fast = steps.speed_mps > steps.speed_mps.median()
    is_turning = steps.yaw_rate_degps.abs() >= turning_degps
    parts = {
        "all": is_fast | ~is_fast,
        "slow": ~is_fast,
        "fast": is_fast,
        "straight": ~is_turning,
        "turning": is_turning,
    }
    squares = pd.DataFrame(
        {
            "rmse_m": steps.position_m**2,
            "longitudinal_m": steps.longitudinal_m**2,
            "lateral_m": steps.lateral_m**2,
            "rmse_yaw_deg": np.rad2deg(steps.yaw_rad) ** 2,
        }
    )
    rows = {name: {"n": int(part.sum()), **np.sqrt(squares[part].mean())} for name, part in parts.items()}
    return pd.DataFrame.from_dict(rows, orient="index").astype({"n": int})
