"""The real Oxford route: the authors' lidar map, ground-truth poses and radar odometry.

The paper's back end can be run on its own sessions: map, ground truth and odometry are public. Only the measurement, the
generated lidar points, is not, so it is an argument of the experiments (`rol_study.route_experiments`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rol.geometry import relative_pose
from rol_beyond.motion import MotionModel, calibrate_motion
from rol_data.rall import ODOMETRY_PATH, POSES_PATH, load_odometry, load_poses

SCAN_US = 250_000  # scans are 4 Hz; the published files have no timestamps
REACH_M = 64.0  # range of the radar: largest distance of a pose from the map's extent
PUBLISHED_CONTRASTS = (
    (0.40, 0.50, 0.65, 0.80),  # precision at 1 m of a front end
    (0.048, 0.100, 0.172, 0.239),  # reference contrast measured on session 01
)


class RouteError(ValueError):
    """Raised where poses, odometry and map do not belong together; names the file and the fault."""


@dataclass(frozen=True)
class RouteSession:
    """One session of the route.

    Attributes
    ----------
    number : str
        Number in the file names, such as "02".
    truth : array, shape (n, 3)
        Ground-truth poses T_map_radar [m, m, rad].
    increments : array, shape (n - 1, 3)
        The authors' radar odometry: pose of each scan in the one before [m, m, rad].
    """

    number: str
    truth: np.ndarray
    increments: np.ndarray

    @property
    def stamps_us(self) -> np.ndarray:
        """Times of the scans for a rate of exactly 4 Hz, shape (n,) [us]."""
        return np.arange(len(self.truth), dtype=np.int64) * SCAN_US

    @property
    def true_increments(self) -> np.ndarray:
        """True motion between the scans, shape (n - 1, 3) [m, m, rad]."""
        return relative_pose(self.truth[:-1], self.truth[1:])


def list_sessions(real_root: Path | str) -> list[str]:
    """List the numbers of the sessions with both poses and odometry, in order.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.

    Returns
    -------
    numbers : list of str
        Such as "01".
    """
    names = [path.stem.removeprefix("pose_xy_") for path in Path(real_root, POSES_PATH).glob("pose_xy_*.txt")]
    return sorted(name for name in names if Path(real_root, ODOMETRY_PATH, f"seq{name}_odom.txt").is_file())


def load_session(real_root: Path | str, number: str, map_points: np.ndarray) -> RouteSession:
    """Read one session of the route and check that its parts belong together.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session, such as "02".
    map_points : array, shape (m, 2)
        The map, from `rol_data.rall.load_map_points` [m].

    Returns
    -------
    session : RouteSession
        Where the odometry has one row too many, as in two of the published files, the last is left out.

    Raises
    ------
    RouteError
        If the number of odometry rows differs otherwise, or a pose is farther from the map's extent than the radar's
        range.
    rol_data.rall.RallError
        If a file is missing or has anything but rows of three finite numbers.
    """
    poses_path = Path(real_root, POSES_PATH, f"pose_xy_{number}.txt")
    odometry_path = Path(real_root, ODOMETRY_PATH, f"seq{number}_odom.txt")
    truth, increments = load_poses(poses_path), load_odometry(odometry_path)
    n_needed = len(truth) - 1
    if len(increments) not in (n_needed, len(truth)):
        found = f"{len(increments)} increments for the {len(truth)} poses of {poses_path.name}"
        raise RouteError(f"{odometry_path}: {found}; {n_needed} needed")
    low, high = map_points.min(axis=0) - REACH_M, map_points.max(axis=0) + REACH_M
    is_outside = ((truth[:, :2] < low) | (truth[:, :2] > high)).any(axis=1)
    if is_outside.any():
        row = int(np.argmax(is_outside))
        place = ", ".join(f"{value:.1f}" for value in truth[row, :2])
        raise RouteError(f"{poses_path}: pose {row + 1} at ({place}) m is outside the map")
    return RouteSession(number, truth, increments[:n_needed])


def published_motion() -> MotionModel:
    """Give the motion model calibrated on session 01, rounded, for a folder without that session.

    Returns
    -------
    model : MotionModel
        The authors' increments are 1.5 % short; the radar is 1.2 m ahead of the axle, so a turn moves it sideways; a
        stationary vehicle seems to turn.
    """
    return MotionModel(
        matrix=((1.0155, -0.0757, 0.0791), (0.0030, 0.0736, 1.2125), (-0.0001, 0.0040, 1.0142)),
        stationary_matrix=((0.2743, 0.0, 0.0), (0.0, 0.0029, 0.0), (0.0, 0.0, 0.1139)),
        sigma_stationary=(0.0457, 0.01, 0.0017),
        sigma_base=(0.1152, 0.0395, 0.0069),
        sigma_per_metre=(0.107, 0.0, 0.0),
    )


def published_reference_contrast(precision_1m: float) -> float:
    """Give the reference contrast measured on session 01, for a folder without that session.

    Parameters
    ----------
    precision_1m : float
        Fraction of the points within 1 m of the map, of a front end with sampled points.

    Returns
    -------
    reference_contrast : float
        That of the method `robust`, see `rol_beyond.recovery.measure_reference_contrast`, with sampled points at the
        ground-truth poses of session 01: rounded, for four front ends, linearly interpolated, and beyond them that of the
        nearest.
    """
    return float(np.interp(precision_1m, *PUBLISHED_CONTRASTS))


def calibrate_on_another(
    real_root: Path | str, number: str, map_points: np.ndarray
) -> tuple[MotionModel, str, np.ndarray]:
    """Calibrate the motion model on another session: the mapping session 01 or, for itself, the next one.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session to be localized; it is not used for calibration.
    map_points : array, shape (m, 2)
        The map [m].

    Returns
    -------
    model : MotionModel
        `published_motion` where there is no other session.
    calibration_session : str
        Number of the session used, or "".
    poses : array, shape (n, 3)
        Its ground-truth poses; none where there is no other session [m, m, rad].
    """
    others = [name for name in list_sessions(real_root) if name != number]
    if not others:
        return published_motion(), "", np.zeros((0, 3))
    other = load_session(real_root, others[0], map_points)
    return calibrate_motion(other.increments, other.true_increments), other.number, other.truth
