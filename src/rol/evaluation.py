"""Evaluation of a localization run: errors, classes, failures, and their files.

The measures of the paper's Tables II and III (Sec. IV-C): root mean square errors of position and heading,
the fractions of scans within three pairs of limits, and failures. The paper states no rule for failures;
`FailureRule` is one with parameters. Trajectories are written in the TUM format, which ``evo`` reads.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

if __package__:
    from .files import read_text, write_text
    from .geometry import check_fields, check_poses, relative_pose
else:  # this file was copied and is imported by its own name
    from files import read_text, write_text
    from geometry import check_fields, check_poses, relative_pose

CLASSES = ((1.0, 2.0), (2.0, 5.0), (5.0, 10.0))  # limits of Table III: position [m], heading [deg]
KITTI_LENGTHS_M = tuple(100.0 * k for k in range(1, 9))  # segments of the KITTI odometry benchmark [m]


class EvaluationError(ValueError):
    """A trajectory or file that cannot be evaluated; the message names the file and the fault."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses, per scan.

    Attributes
    ----------
    position_m : array, shape (n,)
        Distance between estimate and ground truth [m].
    longitudinal_m, lateral_m : array, shape (n,)
        Error ahead (+) or behind, and to the left (+) or right, in the true radar frame [m].
    yaw_rad : array, shape (n,)
        Estimated minus true heading in [-pi, pi) [rad].
    """

    position_m: np.ndarray
    longitudinal_m: np.ndarray
    lateral_m: np.ndarray
    yaw_rad: np.ndarray


def pose_errors(estimate: np.ndarray, truth: np.ndarray) -> PoseErrors:
    """Compute the errors of estimated poses, scan by scan.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].

    Returns
    -------
    errors : PoseErrors

    Raises
    ------
    EvaluationError
        If the lengths differ or there is no pose.
    """
    estimate, truth = check_pair(estimate, truth)
    ahead, left, turned = relative_pose(truth, estimate).T
    return PoseErrors(np.hypot(ahead, left), ahead, left, turned)


def rmse(values: np.ndarray) -> float:
    """Compute the root mean square of errors.

    Parameters
    ----------
    values : array, shape (n,)
        Errors of any unit; n at least one.

    Returns
    -------
    rmse : float
        In the same unit.
    """
    return float(np.sqrt(np.mean(np.square(values))))


def fraction_within(errors: PoseErrors, max_position_m: float, max_yaw_deg: float) -> float:
    """Compute the fraction of scans within both limits.

    Parameters
    ----------
    errors : PoseErrors
        From `pose_errors`.
    max_position_m, max_yaw_deg : float
        Limits of position [m] and heading [deg]; an error equal to a limit is outside.

    Returns
    -------
    fraction : float
        Between 0 and 1.

    Notes
    -----
    Yin et al. 2020, Table III.
    """
    inside = (errors.position_m < max_position_m) & (np.abs(np.rad2deg(errors.yaw_rad)) < max_yaw_deg)
    return float(np.mean(inside))


@dataclass(frozen=True)
class FailureRule:
    """Rule of a failure: an error above a limit for a time without a break.

    The paper counts failures without a definition. Beyond 20 m the walls of another street are closer than
    the correct ones, and with a heading error of 45 deg no street matches, so a filter recovers only by
    chance. A shorter excursion may be caused by a passing lorry, hence the five seconds.

    Attributes
    ----------
    max_position_m : float
        Largest position error [m].
    max_yaw_rad : float
        Largest heading error [rad].
    seconds : float
        Time over which every scan must be beyond a limit [s].

    Raises
    ------
    EvaluationError
        If a value is out of its range; the message names it.
    """

    max_position_m: float = 20.0
    max_yaw_rad: float = float(np.deg2rad(45.0))
    seconds: float = 5.0

    def __post_init__(self) -> None:
        allowed = {"(0, inf]": "max_position_m max_yaw_rad", "[0, inf]": "seconds"}
        check_fields(self, allowed, EvaluationError)


@dataclass
class FailureMonitor:
    """Monitor of a run with ground truth: records failures and returns the true pose to reset to.

    A ``reset_callback`` of `rol.mcl.localize`; it replaces the manual resets of the paper.

    Attributes
    ----------
    stamps_us : array, shape (n,)
        Times of the scans [us].
    truth : array, shape (n, 3)
        Ground-truth poses T_map_radar [m, m, rad].
    rule : FailureRule
        Rule of a failure.
    failures : list of int
        Scans after which the run was reset.
    """

    stamps_us: np.ndarray
    truth: np.ndarray
    rule: FailureRule = FailureRule()
    failures: list[int] = field(default_factory=list)
    beyond_since_us: int | None = None

    def __call__(self, index: int, pose: np.ndarray) -> np.ndarray | None:
        """Check one estimate; return the true pose if the run has just failed, else None."""
        ahead, left, turned = relative_pose(self.truth[index], pose)
        if np.hypot(ahead, left) <= self.rule.max_position_m and abs(turned) <= self.rule.max_yaw_rad:
            self.beyond_since_us = None
            return None
        stamp_us = int(self.stamps_us[index])
        if self.beyond_since_us is None:
            self.beyond_since_us = stamp_us
        if stamp_us - self.beyond_since_us < self.rule.seconds * 1e6:
            return None
        self.failures.append(index)
        self.beyond_since_us = None
        return self.truth[index]


def summarize(
    estimate: np.ndarray,
    truth: np.ndarray,
    *,
    method: str,
    session: str,
    failures: int,
    update_ms_median: float,
    seed: int,
) -> dict[str, str | int | float]:
    """Compute the metrics of one run.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    method, session : str
        Names.
    failures : int
        Number of failures.
    update_ms_median : float
        Median time of a filter update [ms].
    seed : int
        Seed of the run.

    Returns
    -------
    metrics : dict
        The keys of ``METRICS``; fractions between 0 and 1.

    Notes
    -----
    Yin et al. 2020, Tables II and III.
    """
    errors = pose_errors(estimate, truth)
    fractions = {f"within_{m:.0f}m_{deg:.0f}deg": fraction_within(errors, m, deg) for m, deg in CLASSES}
    return {
        "method": method,
        "session": session,
        "n_scans": len(errors.position_m),
        "failures": int(failures),
        "rmse_m": rmse(errors.position_m),
        "rmse_yaw_deg": rmse(np.rad2deg(errors.yaw_rad)),
        **fractions,
        "update_ms_median": float(update_ms_median),
        "seed": int(seed),
    }


@dataclass(frozen=True)
class DriftReport:
    """Drift of odometry over segments of several lengths.

    Attributes
    ----------
    lengths_m : array, shape (k,)
        Lengths, of those requested, for which the path is long enough [m].
    n_segments : array of int, shape (k,)
        Segments of each.
    translation_pct : array, shape (k,)
        Mean position error at their end, as a percentage of their length.
    rotation_deg_per_100m : array, shape (k,)
        Mean absolute heading error at their end [deg per 100 m].
    mean_translation_pct, mean_rotation_deg_per_100m : float
        Means over all segments of all lengths, the benchmark's two numbers; NaN without a segment.
    """

    lengths_m: np.ndarray
    n_segments: np.ndarray
    translation_pct: np.ndarray
    rotation_deg_per_100m: np.ndarray
    mean_translation_pct: float
    mean_rotation_deg_per_100m: float


def drift_by_length(
    estimate: np.ndarray, truth: np.ndarray, lengths_m: tuple[float, ...] = KITTI_LENGTHS_M
) -> DriftReport:
    """Compute the drift of odometry as the KITTI benchmark does.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses in any two frames [m, m, rad].
    lengths_m : tuple of float
        Lengths of the segments along the true path [m]; one starts at every tenth pose and ends at the first
        pose at this distance. Lengths that exceed the path are left out.

    Returns
    -------
    report : DriftReport
        Lengths and the errors of each.

    Raises
    ------
    EvaluationError
        If the lengths differ or there is no pose.
    """
    estimate, truth = check_pair(estimate, truth)
    errors = [_segment_errors(estimate, truth, length) for length in lengths_m]
    is_kept = np.array([len(error) > 0 for error in errors], dtype=bool)
    kept = [error for error in errors if len(error)]
    means = np.array([error.mean(axis=0) for error in kept]).reshape(-1, 2)
    overall = np.concatenate(kept).mean(axis=0) if kept else np.full(2, np.nan)
    n_segments = np.array([len(error) for error in kept], dtype=int)
    return DriftReport(np.array(lengths_m)[is_kept], n_segments, *means.T, *map(float, overall))


def write_tum(path: Path | str, stamps_us: np.ndarray, poses: np.ndarray) -> None:
    """Write a trajectory in the TUM format: time [s], x y z [m], quaternion x y z w; z and tilt are zero.

    Parameters
    ----------
    path : Path or str
        File to write, atomically.
    stamps_us : array of int, shape (n,)
        Increasing times [us].
    poses : array, shape (n, 3)
        Poses (x, y, yaw) [m, m, rad].

    Raises
    ------
    EvaluationError
        If lengths differ, times do not increase, or a value is not finite.
    """
    stamps_us, poses = np.asarray(stamps_us), np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    _check_trajectory(path, stamps_us, poses)
    rows = (
        f"{us // 10**6}.{us % 10**6:06d} {x:.6f} {y:.6f} 0 0 0 {np.sin(yaw / 2):.9f} {np.cos(yaw / 2):.9f}\n"
        for us, (x, y, yaw) in zip(stamps_us.tolist(), poses.tolist(), strict=True)
    )
    write_text(path, "".join(rows))


def read_tum(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Read a planar trajectory in the TUM format.

    Parameters
    ----------
    path : Path or str
        File to read; lines that start with # are skipped.

    Returns
    -------
    stamps_us : array of int64, shape (n,)
        Times [us].
    poses : array, shape (n, 3)
        Poses (x, y, yaw) [m, m, rad]; height and tilt are ignored.

    Raises
    ------
    EvaluationError
        If a line does not have eight numbers, a quaternion is not a unit quaternion (within 0.01), a value is
        not finite, times do not increase by 1 us or more, or they are not seconds.
    """
    rows = []
    for number, line in enumerate(read_text(path, EvaluationError).splitlines(), start=1):
        words = line.partition("#")[0].split()
        if words and len(words) != 8:
            raise EvaluationError(f"{path}: line {number} has {len(words)} values instead of 8")
        try:
            rows += [[float(word) for word in words]] if words else []
        except ValueError as error:
            raise EvaluationError(f"{path}: line {number}: {error}") from error
        norm = np.linalg.norm(rows[-1][4:]) if words else 1.0
        if abs(norm - 1.0) > 0.01:
            raise EvaluationError(f"{path}: line {number}: norm of the quaternion is {norm:.3g}, not 1")
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    poses = np.stack([table[:, 1], table[:, 2], 2.0 * np.arctan2(table[:, 6], table[:, 7])], axis=1)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    _check_trajectory(path, table[:, 0], poses)
    if np.abs(table[:, 0]).max() > 1e11:  # 3000 years; times in ms are above that
        raise EvaluationError(f"{path}: time {table[:, 0].max():.0f} cannot be in seconds")
    stamps_us = np.round(table[:, 0] * 1e6).astype(np.int64)
    _check_trajectory(path, stamps_us, poses)
    return stamps_us, poses


METRICS = {
    "method": str,
    "session": str,
    "n_scans": int,
    "failures": int,
    "rmse_m": float,
    "rmse_yaw_deg": float,
    "within_1m_2deg": float,
    "within_2m_5deg": float,
    "within_5m_10deg": float,
    "update_ms_median": float,
    "seed": int,
}


def write_metrics(path: Path | str, metrics: dict[str, str | int | float]) -> None:
    """Write the metrics of one run as JSON.

    Parameters
    ----------
    path : Path or str
        File to write, atomically.
    metrics : dict
        From `summarize`: exactly the keys of ``METRICS``.

    Raises
    ------
    EvaluationError
        If a key is missing, unknown, or of another type, or a number is not finite.
    """
    _check_metrics(path, metrics)
    write_text(path, json.dumps(metrics, indent=2) + "\n")


def read_metrics(path: Path | str) -> dict[str, str | int | float]:
    """Read the metrics of one run.

    Parameters
    ----------
    path : Path or str
        A ``metrics.json``.

    Returns
    -------
    metrics : dict
        The keys of ``METRICS``.

    Raises
    ------
    EvaluationError
        If the file is no JSON, or its keys or values are not those of a run.
    """
    try:
        metrics = json.loads(read_text(path))
    except ValueError as error:
        raise EvaluationError(f"{path}: not a whole json file ({error})") from error
    _check_metrics(path, metrics)
    return metrics


def check_pair(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check that the numbers of estimated and true poses, shape (n, 3), are equal and above zero."""
    estimate, truth = check_poses(estimate, "estimate"), check_poses(truth, "truth")
    if estimate.shape != truth.shape or len(estimate) == 0:
        raise EvaluationError(f"{len(estimate)} estimated poses for {len(truth)} true ones")
    return estimate, truth


def _segment_errors(estimate: np.ndarray, truth: np.ndarray, length_m: float) -> np.ndarray:
    """Compute errors at the ends of segments of one length, shape (n, 2) [%, deg per 100 m]."""
    path_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    first = np.arange(0, len(path_m), 10)
    last = np.searchsorted(path_m, path_m[first] + length_m)
    first, last = first[last < len(path_m)], last[last < len(path_m)]
    ends = (relative_pose(poses[first], poses[last]) for poses in (truth, estimate))
    x, y, yaw = relative_pose(*ends).T
    return np.stack([np.hypot(x, y), np.rad2deg(np.abs(yaw))], axis=1) * (100.0 / length_m)


def _check_metrics(path: Path | str, metrics: dict[str, str | int | float]) -> None:
    """Check keys, types and finiteness."""
    if not isinstance(metrics, dict) or set(metrics) != set(METRICS):
        odd = sorted(set(metrics) ^ set(METRICS)) if isinstance(metrics, dict) else metrics
        raise EvaluationError(f"{path}: keys missing or unknown: {odd}")
    for key, kind in METRICS.items():
        value = metrics[key]
        if not isinstance(value, (kind, int) if kind is float else kind) or isinstance(value, bool):
            raise EvaluationError(f"{path}: {key} is {value!r}, expected {kind.__name__}")
        if kind is float and not np.isfinite(value):
            raise EvaluationError(f"{path}: {key} is not finite")


def _check_trajectory(path: Path | str, stamps: np.ndarray, poses: np.ndarray) -> None:
    """Check that times increase, belong to poses, and that all is finite; positions count from one."""
    if len(stamps) != len(poses):
        raise EvaluationError(f"{path}: {len(stamps)} times for {len(poses)} poses")
    if len(poses) == 0:
        raise EvaluationError(f"{path}: no pose")
    is_bad = ~(np.isfinite(poses).all(axis=1) & np.isfinite(stamps.astype(np.float64)))
    if is_bad.any():
        raise EvaluationError(f"{path}: pose {int(np.argmax(is_bad)) + 1} is not finite")
    is_late = np.diff(stamps) <= 0
    if is_late.any():
        raise EvaluationError(f"{path}: times do not increase at pose {int(np.argmax(is_late)) + 2}")
