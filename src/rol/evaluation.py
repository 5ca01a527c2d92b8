"""Judging a localization run: errors, classes, failures, and the files that hold them.

The measures of the paper's Tables II and III (Sec. IV-C): root mean square errors of position and heading,
the shares of scans within three pairs of limits, and failures, for which the paper gives no rule and this
file one with parameters. Trajectories are written in the TUM format, which ``evo`` reads.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

try:
    from .files import read_text, write_text
    from .geometry import check_fields, check_poses, relative_pose, wrap_angle
except ImportError:  # this file was copied on its own
    from files import read_text, write_text
    from geometry import check_fields, check_poses, relative_pose, wrap_angle

CLASSES = ((1.0, 2.0), (2.0, 5.0), (5.0, 10.0))  # limits of Table III: position [m], heading [deg]
KITTI_LENGTHS_M = tuple(100.0 * k for k in range(1, 9))  # stretches of the KITTI odometry benchmark [m]
NEES_95 = 7.814727903251179  # 95 % of a chi-square distribution of three degrees of freedom lie below


class EvaluationError(ValueError):
    """Raised for trajectories and files that cannot be judged; names the file and the fault."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses, per scan.

    Attributes
    ----------
    position_m : array, shape (n,)
        Distance between estimate and truth [m].
    longitudinal_m, lateral_m : array, shape (n,)
        Estimate ahead of (+) or behind the truth, and left (+) or right of it, in the true radar frame [m].
    yaw_rad : array, shape (n,)
        Estimated minus true heading in [-pi, pi) [rad].
    """

    position_m: np.ndarray
    longitudinal_m: np.ndarray
    lateral_m: np.ndarray
    yaw_rad: np.ndarray


def pose_errors(estimate: np.ndarray, truth: np.ndarray) -> PoseErrors:
    """Compare estimated with true poses, scan by scan.

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
    estimate, truth = _check_pair(estimate, truth)
    ahead, left, turned = relative_pose(truth, estimate).T
    return PoseErrors(np.hypot(ahead, left), ahead, left, turned)


def rmse(values: np.ndarray) -> float:
    """Give the root mean square of errors.

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


def share_within(errors: PoseErrors, max_position_m: float, max_yaw_deg: float) -> float:
    """Give the share of scans within both limits.

    Parameters
    ----------
    errors : PoseErrors
        From `pose_errors`.
    max_position_m, max_yaw_deg : float
        Limits of position [m] and heading [deg]; an error equal to a limit is outside.

    Returns
    -------
    share : float
        Between 0 and 1. Yin et al. 2020, Table III.
    """
    inside = (errors.position_m < max_position_m) & (np.abs(np.rad2deg(errors.yaw_rad)) < max_yaw_deg)
    return float(np.mean(inside))


@dataclass(frozen=True)
class FailureRule:
    """When a run counts as failed: too far off for too long.

    The paper counts failures without saying what one is. Beyond 20 m another street's walls lie nearer than
    the right ones, and with the heading 45 deg off no street fits, so a filter comes back only by luck; a
    shorter excursion may be a passing lorry, hence the five seconds.

    Attributes
    ----------
    max_position_m : float
        Position error above which a scan is off [m].
    max_yaw_rad : float
        Heading error above which a scan is off [rad].
    seconds : float
        Time over which every scan must be off [s].

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
class FailureWatch:
    """Watch a run with the truth at hand; on a failure, note the scan and give the true pose to restart from.

    To be passed to `rol.mcl.localize` as its supervisor: the person who, in the paper, set the state by hand.

    Attributes
    ----------
    stamps_us : array, shape (n,)
        Times of the scans [us].
    truth : array, shape (n, 3)
        True poses T_map_radar [m, m, rad].
    rule : FailureRule
        What counts as a failure.
    failures : list of int
        Scans after which the run was restarted, filled while watching.
    """

    stamps_us: np.ndarray
    truth: np.ndarray
    rule: FailureRule = FailureRule()
    failures: list[int] = field(default_factory=list)
    off_since_us: int | None = None

    def __call__(self, index: int, pose: np.ndarray) -> np.ndarray | None:
        """Judge one estimate; give the true pose if the run has just failed, else None."""
        ahead, left, turned = relative_pose(self.truth[index], pose)
        if np.hypot(ahead, left) <= self.rule.max_position_m and abs(turned) <= self.rule.max_yaw_rad:
            self.off_since_us = None
            return None
        stamp_us = int(self.stamps_us[index])
        if self.off_since_us is None:
            self.off_since_us = stamp_us
        if stamp_us - self.off_since_us < self.rule.seconds * 1e6:
            return None
        self.failures.append(index)
        self.off_since_us = None
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
    """Gather the figures of one run.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    method, session : str
        Names.
    failures : int
        Restarts.
    update_ms_median : float
        Median time of a filter update [ms].
    seed : int
        Seed of the run.

    Returns
    -------
    metrics : dict
        The keys that `write_metrics` wants; shares between 0 and 1. Yin et al. 2020, Tables II and III.
    """
    errors = pose_errors(estimate, truth)
    shares = {f"within_{m:.0f}m_{deg:.0f}deg": share_within(errors, m, deg) for m, deg in CLASSES}
    return {
        "method": method,
        "session": session,
        "n_scans": len(errors.position_m),
        "failures": int(failures),
        "rmse_m": rmse(errors.position_m),
        "rmse_yaw_deg": rmse(np.rad2deg(errors.yaw_rad)),
        **shares,
        "update_ms_median": float(update_ms_median),
        "seed": int(seed),
    }


def error_figures(errors: PoseErrors) -> dict[str, float]:
    """Give figures of a run beyond those of the paper: medians, and the errors along and across the way.

    Parameters
    ----------
    errors : PoseErrors
        From `pose_errors`.

    Returns
    -------
    figures : dict
        ``median_m`` and ``median_yaw_deg`` of the absolute errors, ``rmse_longitudinal_m`` and
        ``rmse_lateral_m`` in the true radar frame. Not part of ``metrics.json``.
    """
    return {
        "median_m": float(np.median(errors.position_m)),
        "median_yaw_deg": float(np.median(np.abs(np.rad2deg(errors.yaw_rad)))),
        "rmse_longitudinal_m": rmse(errors.longitudinal_m),
        "rmse_lateral_m": rmse(errors.lateral_m),
    }


def pose_nees(estimate: np.ndarray, truth: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Give the normalized estimation error squared of poses: how large an error is beside its own covariance.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    covariances : array, shape (n, 3, 3)
        Covariances of (x, y, yaw) in the map frame, of each estimate [m, m, rad].

    Returns
    -------
    nees : array, shape (n,)
        e' C^-1 e with e = estimate - truth, its heading in [-pi, pi). Mean 3 where covariances are honest.

    Raises
    ------
    EvaluationError
        If lengths differ, or a covariance is not finite, symmetric and positive definite; names its index.
    """
    estimate, truth = _check_pair(estimate, truth)
    covariances = _check_covariances(covariances, len(estimate))
    errors = estimate - truth
    errors[:, 2] = wrap_angle(errors[:, 2])
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def consistency(estimate: np.ndarray, truth: np.ndarray, covariances: np.ndarray) -> dict[str, float]:
    """Judge whether covariances tell the errors: an honest filter has a mean NEES of 3 and 95 % within the bound.

    Parameters
    ----------
    estimate, truth, covariances
        As in `pose_nees`.

    Returns
    -------
    figures : dict
        ``mean_nees``, above 3 for a filter too sure of itself, and ``within_95``, the share of poses whose NEES lies
        below ``NEES_95`` (0..1).

    Raises
    ------
    EvaluationError
        As in `pose_nees`.
    """
    nees = pose_nees(estimate, truth, covariances)
    return {"mean_nees": float(np.mean(nees)), "within_95": float(np.mean(nees <= NEES_95))}


@dataclass(frozen=True)
class DriftReport:
    """Drift of odometry over stretches of several lengths.

    Attributes
    ----------
    lengths_m : array, shape (k,)
        Lengths for which the way is long enough, of those asked for [m].
    n_stretches : array of int, shape (k,)
        Stretches of each.
    translation_pct : array, shape (k,)
        Mean position error at their end, in per cent of their length.
    rotation_deg_per_100m : array, shape (k,)
        Mean heading error at their end, without its sign [deg per 100 m].
    mean_translation_pct, mean_rotation_deg_per_100m : float
        Means over all stretches of all lengths, the benchmark's two numbers; NaN without a stretch.
    """

    lengths_m: np.ndarray
    n_stretches: np.ndarray
    translation_pct: np.ndarray
    rotation_deg_per_100m: np.ndarray
    mean_translation_pct: float
    mean_rotation_deg_per_100m: float


def drift_by_length(
    estimate: np.ndarray, truth: np.ndarray, lengths_m: tuple[float, ...] = KITTI_LENGTHS_M
) -> DriftReport:
    """Measure the drift of odometry in the full form of the KITTI benchmark.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses in any two frames [m, m, rad].
    lengths_m : tuple of float
        Lengths of the stretches along the true way [m]; one starts at every tenth pose and ends at the first pose so
        far on. Those that the way is too short for are left out.

    Returns
    -------
    report : DriftReport
        Which lengths remain, and the errors of each.

    Raises
    ------
    EvaluationError
        If the lengths differ or there is no pose.
    """
    estimate, truth = _check_pair(estimate, truth)
    errors = [_stretch_errors(estimate, truth, length) for length in lengths_m]
    is_kept = np.array([len(error) > 0 for error in errors], dtype=bool)
    kept = [error for error in errors if len(error)]
    means = np.array([error.mean(axis=0) for error in kept]).reshape(-1, 2)
    overall = np.concatenate(kept).mean(axis=0) if kept else np.full(2, np.nan)
    n_stretches = np.array([len(error) for error in kept], dtype=int)
    return DriftReport(np.array(lengths_m)[is_kept], n_stretches, *means.T, *map(float, overall))


def drift(estimate: np.ndarray, truth: np.ndarray, lengths_m: tuple[float, ...] = (100.0, 200.0)) -> float:
    """Give the drift of odometry as one number, see `drift_by_length`.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses in any two frames [m, m, rad].
    lengths_m : tuple of float
        Lengths of the stretches along the true way [m]; one starts at every tenth pose.

    Returns
    -------
    drift : float
        Mean over stretches of the end's position error over the stretch's length; NaN if the way is too
        short.

    Raises
    ------
    EvaluationError
        If the lengths differ or there is no pose.
    """
    return drift_by_length(estimate, truth, lengths_m).mean_translation_pct / 100.0


def write_tum(path: Path | str, stamps_us: np.ndarray, poses: np.ndarray) -> None:
    """Write a trajectory in the TUM format: time [s], x y z [m], quaternion x y z w, z and the tilt zero.

    Parameters
    ----------
    path : Path or str
        File to write; it appears whole or not at all.
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
        File to read; lines that begin with # are skipped.

    Returns
    -------
    stamps_us : array of int64, shape (n,)
        Times [us].
    poses : array, shape (n, 3)
        Poses (x, y, yaw) [m, m, rad]; height and tilt are left out.

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
    if np.abs(table[:, 0]).max() > 1e11:  # 3000 years; today's time in ms is above that
        raise EvaluationError(f"{path}: time {table[:, 0].max():.0f} cannot be in seconds")
    stamps_us = np.round(table[:, 0] * 1e6).astype(np.int64)
    _check_trajectory(path, stamps_us, poses)
    return stamps_us, poses


METRICS = {
    "method": str, "session": str, "n_scans": int, "failures": int, "rmse_m": float, "rmse_yaw_deg": float,
    "within_1m_2deg": float, "within_2m_5deg": float, "within_5m_10deg": float, "update_ms_median": float,
    "seed": int,
}  # fmt: skip


def write_metrics(path: Path | str, metrics: dict[str, str | int | float]) -> None:
    """Write the figures of one run as json.

    Parameters
    ----------
    path : Path or str
        File to write; it appears whole or not at all.
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
    """Read the figures of one run.

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
        If the file is no json, or its keys or values are not those of a run.
    """
    try:
        metrics = json.loads(read_text(path))
    except ValueError as error:
        raise EvaluationError(f"{path}: not a whole json file ({error})") from error
    _check_metrics(path, metrics)
    return metrics


def _check_pair(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check that there are poses, and as many estimated as true ones."""
    estimate, truth = check_poses(estimate, "estimate"), check_poses(truth, "truth")
    if estimate.shape != truth.shape or len(estimate) == 0:
        raise EvaluationError(f"{len(estimate)} estimated poses for {len(truth)} true ones")
    return estimate, truth


def _check_covariances(covariances: np.ndarray, n: int) -> np.ndarray:
    """Check that there are n covariances, finite, symmetric and positive definite."""
    covariances = np.asarray(covariances, dtype=np.float64)
    if covariances.shape != (n, 3, 3):
        raise EvaluationError(f"covariances: expected shape ({n}, 3, 3), got {covariances.shape}")
    checks = {
        "finite": lambda c: np.isfinite(c).all(axis=(1, 2)),
        "symmetric": lambda c: np.isclose(c, c.transpose(0, 2, 1), rtol=1e-6, atol=1e-12).all(axis=(1, 2)),
        "positive definite": lambda c: np.linalg.eigvalsh(c) @ (1.0, 0.0, -1e-15) > 0.0,  # beyond rounding
    }
    for quality, check in checks.items():
        is_good = check(covariances)
        if not is_good.all():
            raise EvaluationError(f"covariances: matrix at index {int(np.argmin(is_good))} is not {quality}")
    return covariances


def _stretch_errors(estimate: np.ndarray, truth: np.ndarray, length_m: float) -> np.ndarray:
    """Errors at the end of stretches of one length, shape (n, 2): position [%], heading [deg per 100 m]."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    first = np.arange(0, len(way), 10)
    last = np.searchsorted(way, way[first] + length_m)
    first, last = first[last < len(way)], last[last < len(way)]
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
