"""Real routes: lidar maps, ground-truth poses and radar odometry of Oxford, the paper's place, and of MulRan.

The paper's back end can be run on its own sessions: map, ground truth and odometry are public. Only the
measurement, the generated lidar points, is not, so it is an argument of the experiments
(`rol_study.route_experiments`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rol.geometry import relative_pose
from rol_beyond.motion import MIN_SIGMAS, MotionModel, calibrate_motion
from rol_data.cfear import FILES, find_cfear, load_cfear_increments
from rol_data.rall import find_place, load_odometry, load_poses
from rol_study.truth_faults import find_faulty_scans

SCAN_US = 250_000  # scans are 4 Hz; the published files have no timestamps
REACH_M = 64.0  # range of the radar: largest distance of a pose from the map's extent
ODOMETRIES = ("rall", "cfear", "true")  # the authors', CFEAR-3, and the increments of the ground truth
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
        Radar odometry: pose of each scan in the one before [m, m, rad].
    place : str
        One of ``rol_data.rall.PLACES``.
    odometry : str
        Where the increments come from, one of `ODOMETRIES`.
    is_faulty : array of bool, shape (n,), optional
        Scans whose ground truth the authors' odometry contradicts, see `rol_study.truth_faults`; none known
        if not given.
    """

    number: str
    truth: np.ndarray
    increments: np.ndarray
    place: str = "oxford"
    odometry: str = "rall"
    is_faulty: np.ndarray | None = None

    @property
    def stamps_us(self) -> np.ndarray:
        """Times of the scans for a rate of exactly 4 Hz, shape (n,) [us]."""
        return np.arange(len(self.truth), dtype=np.int64) * SCAN_US

    @property
    def true_increments(self) -> np.ndarray:
        """True motion between the scans, shape (n - 1, 3) [m, m, rad]."""
        return relative_pose(self.truth[:-1], self.truth[1:])

    def part(self, first: int, last: int | None = None) -> RouteSession:
        """Cut out the scans from `first` to before `last`, or to the end."""
        truth = self.truth[first:last]
        is_faulty = None if self.is_faulty is None else self.is_faulty[first:last]
        increments = self.increments[first : first + len(truth) - 1]
        return replace(self, truth=truth, increments=increments, is_faulty=is_faulty)


def list_sessions(real_root: Path | str, place: str = "oxford", odometry: str = "rall") -> list[str]:
    """List the numbers of the sessions with both poses and odometry, in order.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.
    place : str
        One of ``rol_data.rall.PLACES``.
    odometry : str
        One of `ODOMETRIES`.

    Returns
    -------
    numbers : list of str
        Such as "01".

    Raises
    ------
    RouteError, rol_data.rall.RallError
        If the odometry or the place is unknown.
    """
    files = find_place(place)
    before, after = Path(files.poses).name.split("{}")
    names = [
        path.name.removeprefix(before).removesuffix(after)
        for path in Path(real_root, files.poses).parent.glob(f"{before}*{after}")
    ]
    return sorted(name for name in names if _has_odometry(real_root, place, name, odometry))


def select_sessions(
    real_root: Path | str, session: str, place: str = "oxford", odometry: str = "rall"
) -> list[str]:
    """Return the numbers of the sessions that a chapter runs on.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    session : str
        A number, or "all": the paper's four sessions of Oxford (02, 07, 08, 10) and, of another place, all
        but the session that its map was made from. A session that is not at hand is left out of "all".
    place, odometry : str
        As for `list_sessions`.

    Returns
    -------
    numbers : list of str

    Raises
    ------
    RouteError
        If the session named is not at hand; the message lists those that are.
    rol_data.rall.RallError
        If the place is unknown.
    """
    files, numbers = find_place(place), list_sessions(real_root, place, odometry)
    if session == "all":
        main = files.main_sessions or [number for number in numbers if number != files.mapping_session]
        return [number for number in numbers if number in main]
    if session not in numbers:
        there = ", ".join(numbers) or "none"
        wanted = f"no {session!r} with {odometry} odometry at hand"
        raise RouteError(f"session: {place} has {wanted}; there are: {there}")
    return [session]


def _has_odometry(real_root: Path | str, place: str, number: str, odometry: str) -> bool:
    """Check that the odometry of a session exists."""
    if odometry not in ODOMETRIES:
        raise RouteError(f"odometry: {odometry!r} is unknown; there are {', '.join(ODOMETRIES)}")
    if odometry == "cfear":
        return place == "oxford" and number in FILES and find_cfear(real_root, number).is_file()
    return odometry == "true" or Path(real_root, find_place(place).odometry.format(number)).is_file()


def load_session(
    real_root: Path | str,
    number: str,
    map_points: np.ndarray,
    place: str = "oxford",
    odometry: str = "rall",
) -> RouteSession:
    """Read one session of a route and check that its parts belong together.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session, such as "02".
    map_points : array, shape (m, 2)
        The map, from `rol_data.rall.load_map` [m].
    place : str
        One of ``rol_data.rall.PLACES``.
    odometry : str
        One of `ODOMETRIES`.

    Returns
    -------
    session : RouteSession
        Where the odometry has a row more or fewer than there are increments between the poses,
        `match_increments` decides what is left out.

    Raises
    ------
    RouteError
        If the number of odometry rows differs by more than one, a pose is farther from the map's extent than
        the radar's range, or the odometry is unknown.
    rol_data.rall.RallError, rol_data.cfear.CfearError
        If a file is missing or has anything but rows of finite numbers, or the place is unknown.
    """
    poses_path = Path(real_root, find_place(place).poses.format(number))
    path, is_faulty = Path(real_root, find_place(place).odometry.format(number)), None
    truth = _load_poses_on(map_points, poses_path)
    increments = relative_pose(truth[:-1], truth[1:])
    if odometry == "rall" or _has_odometry(real_root, place, number, "rall"):
        truth, increments = match_increments(truth, load_odometry(path), path, poses_path)
        is_faulty = find_faulty_scans(truth, increments)
    if odometry == "cfear":
        if place != "oxford":
            raise RouteError(f"odometry: CFEAR's is published for Oxford only, not for {place}")
        increments = load_cfear_increments(find_cfear(real_root, number), len(truth))
        truth = truth[: len(increments) + 1]
    elif odometry == "true":
        increments = relative_pose(truth[:-1], truth[1:])
    elif odometry != "rall":
        raise RouteError(f"odometry: {odometry!r} is unknown; there are {', '.join(ODOMETRIES)}")
    return RouteSession(number, truth, increments, place, odometry, is_faulty).part(0, len(truth))


def _load_poses_on(map_points: np.ndarray, path: Path) -> np.ndarray:
    """Read ground-truth poses and check that the radar can see the map from each, shape (n, 3)."""
    poses = load_poses(path)
    low, high = map_points.min(axis=0) - REACH_M, map_points.max(axis=0) + REACH_M
    is_outside = ((poses[:, :2] < low) | (poses[:, :2] > high)).any(axis=1)
    if is_outside.any():
        row = int(np.argmax(is_outside))
        found = ", ".join(f"{value:.1f}" for value in poses[row, :2])
        raise RouteError(f"{path}: pose {row + 1} at ({found}) m is outside the map")
    return poses


def match_increments(
    poses: np.ndarray, increments: np.ndarray, path: Path, poses_path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Match odometry increments to the poses of a session where one of them has a row too many.

    Parameters
    ----------
    poses : array, shape (n, 3)
        Ground truth [m, m, rad].
    increments : array, shape (k, 3)
        Odometry as in the file [m, m, rad].
    path, poses_path : Path
        Files of the odometry and of the ground truth, for the message.

    Returns
    -------
    poses : array, shape (m, 3)
        All poses where k >= n - 1. For k = n - 2 the odometry lacks a scan that the ground truth has: that is
        a pose which exactly repeats the one before it between two steps of more than half a metre, as in
        DCC03. It is left out or, where no pose repeats, the last one.
    increments : array, shape (m - 1, 3)
        Without the last row where k = n, as in two files of Oxford.

    Raises
    ------
    RouteError
        For any other number of increments.
    """
    n_needed = len(poses) - 1
    if abs(len(increments) - n_needed) > 1:
        found = f"{len(increments)} increments for the {len(poses)} poses of {poses_path.name}"
        raise RouteError(f"{path}: {found}; {n_needed} needed, or one more or fewer")
    if len(increments) < n_needed:
        lengths_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        before, at, after = lengths_m[:-2], lengths_m[1:-1], lengths_m[2:]
        repeats = np.flatnonzero((at < 1e-6) & (before > 0.5) & (after > 0.5)) + 2
        poses = np.delete(poses, repeats[0] if len(repeats) else -1, axis=0)
    return poses, increments[: len(poses) - 1]


def published_motion() -> MotionModel:
    """Return the motion model calibrated on session 01, rounded, for a folder without that session.

    Returns
    -------
    model : MotionModel
        The authors' increments are 1.5 % short; the radar is 1.2 m ahead of the axle, so a turn moves it
        sideways; a stationary vehicle seems to turn.
    """
    return MotionModel(
        matrix=((1.0155, -0.0757, 0.0791), (0.0030, 0.0736, 1.2125), (-0.0001, 0.0040, 1.0142)),
        stationary_matrix=((0.2743, 0.0, 0.0), (0.0, 0.0029, 0.0), (0.0, 0.0, 0.1139)),
        sigma_stationary=(0.0457, 0.01, 0.0017),
        sigma_base=(0.1152, 0.0395, 0.0069),
        sigma_per_metre=(0.107, 0.0, 0.0),
    )


def published_reference_contrast(precision_1m: float) -> float:
    """Return the reference contrast measured on session 01, for a folder without that session.

    Parameters
    ----------
    precision_1m : float
        Fraction of the points within 1 m of the map, of a front end with sampled points.

    Returns
    -------
    reference_contrast : float
        That of the method `robust`, see `rol_beyond.recovery.measure_reference_contrast`, with sampled points
        at the ground-truth poses of session 01: rounded, for four front ends, linearly interpolated, and
        beyond them that of the nearest.
    """
    return float(np.interp(precision_1m, *PUBLISHED_CONTRASTS))


def exact_motion() -> MotionModel:
    """Return the motion model of the true increments: no correction,
    and the least noise that keeps the particles apart."""
    sigmas = tuple(map(float, MIN_SIGMAS))
    return MotionModel(sigma_stationary=sigmas, sigma_base=sigmas, sigma_per_metre=(0.0, 0.0, 0.0))


def calibrate_on_another(
    real_root: Path | str,
    number: str,
    map_points: np.ndarray,
    place: str = "oxford",
    odometry: str = "rall",
) -> tuple[MotionModel, str, np.ndarray]:
    """Calibrate the motion model on another session of the place: the mapping session 01 or, for itself,
    the next one.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session to be localized; it is not used for calibration.
    map_points : array, shape (m, 2)
        The map [m].
    place, odometry : str
        As for `load_session`; the model is that of this odometry. That of the true increments is
        `exact_motion`.

    Returns
    -------
    model : MotionModel
        Where there is no other session, `published_motion` for the authors' odometry of Oxford, else
        `MotionModel` with its defaults.
    calibration_session : str
        Number of the session used, or "".
    poses : array, shape (n, 3)
        Its ground-truth poses; none where there is no other session [m, m, rad].
    """
    others = [name for name in list_sessions(real_root, place, odometry) if name != number]
    if not others:
        is_published = (place, odometry) == ("oxford", "rall")
        model = published_motion() if is_published else MotionModel()
        return exact_motion() if odometry == "true" else model, "", np.zeros((0, 3))
    other = load_session(real_root, others[0], map_points, place, odometry)
    is_true = odometry == "true"
    model = exact_motion() if is_true else calibrate_motion(other.increments, other.true_increments)
    return model, other.number, other.truth
