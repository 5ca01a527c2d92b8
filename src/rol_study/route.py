"""The real Oxford route: the authors' lidar map, true poses and radar odometry, and what a filter makes of them.

The paper's back end can be run on its own sessions today: the map, the poses that it was judged by and the odometry that
moved its particles are public, only the measurement, the fake lidar points, is not. So it is an argument here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from rol.geometry import compose, relative_pose

if TYPE_CHECKING:
    from rol.evaluation import FailureRule
    from rol.mcl import MapGrid, MclSettings
    from rol_beyond.motion import MotionModel
    from rol_beyond.recovery import RecoverySettings, RecoveryUpdate

SCAN_US = 250_000  # scans are 4 Hz; the published files hold no times
REACH_M = 64.0  # of the radar, by which a pose may lie beside the map
PUBLISHED_LEVELS = (
    (0.40, 0.50, 0.65, 0.80),  # shares of the points within 1 m of the map
    (0.048, 0.100, 0.172, 0.239),  # what session 01 teaches of them, see `published_level`
)


class RouteError(ValueError):
    """Raised where poses, odometry and map do not belong together; names the file and the fault."""


@dataclass(frozen=True)
class Route:
    """One session of the route.

    Attributes
    ----------
    number : str
        Of the files, such as "02".
    truth : array, shape (n, 3)
        True poses T_map_radar [m, m, rad].
    steps : array, shape (n - 1, 3)
        The authors' radar odometry: pose of each scan in the one before [m, m, rad].
    """

    number: str
    truth: np.ndarray
    steps: np.ndarray

    @property
    def stamps_us(self) -> np.ndarray:
        """Times of the scans as if they had come at 4 Hz exactly, shape (n,) [us]."""
        return np.arange(len(self.truth), dtype=np.int64) * SCAN_US

    @property
    def true_steps(self) -> np.ndarray:
        """True motion between the scans, shape (n - 1, 3) [m, m, rad]."""
        return relative_pose(self.truth[:-1], self.truth[1:])


def list_routes(real_root: Path | str) -> list[str]:
    """List the numbers of the sessions whose poses and odometry are both there, in order.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.

    Returns
    -------
    numbers : list of str
        Such as "01".
    """
    from rol_data.rall import ODOMETRY_PATH, POSES_PATH

    names = [path.stem.removeprefix("pose_xy_") for path in Path(real_root, POSES_PATH).glob("pose_xy_*.txt")]
    return sorted(name for name in names if Path(real_root, ODOMETRY_PATH, f"seq{name}_odom.txt").is_file())


def load_route(real_root: Path | str, number: str, map_points: np.ndarray) -> Route:
    """Read one session of the route and check that its parts belong together.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Of the session, such as "02".
    map_points : array, shape (m, 2)
        The map, from `rol_data.rall.load_map_points` [m].

    Returns
    -------
    route : Route
        Where the odometry has one row more than there are steps, as in two of the published files, the last is left
        out.

    Raises
    ------
    RouteError
        If there are fewer or more odometry rows than that, or a pose is farther off the map's extent than the radar
        sees.
    rol_data.rall.RallError
        If a file is missing or holds anything but rows of three finite numbers.
    """
    from rol_data.rall import ODOMETRY_PATH, POSES_PATH, load_odometry, load_poses

    poses_path = Path(real_root, POSES_PATH, f"pose_xy_{number}.txt")
    odometry_path = Path(real_root, ODOMETRY_PATH, f"seq{number}_odom.txt")
    truth, steps = load_poses(poses_path), load_odometry(odometry_path)
    if len(steps) not in (len(truth) - 1, len(truth)):
        raise RouteError(
            f"{odometry_path}: {len(steps)} steps for the {len(truth)} poses of {poses_path.name}; {len(truth) - 1} needed"
        )
    low, high = map_points.min(axis=0) - REACH_M, map_points.max(axis=0) + REACH_M
    is_outside = ((truth[:, :2] < low) | (truth[:, :2] > high)).any(axis=1)
    if is_outside.any():
        row = int(np.argmax(is_outside))
        place = ", ".join(f"{value:.1f}" for value in truth[row, :2])
        raise RouteError(f"{poses_path}: pose {row + 1} at ({place}) m is outside the map")
    return Route(number, truth, steps[: len(truth) - 1])


def published_motion() -> MotionModel:
    """Give what session 01 teaches of the authors' published odometry, rounded, for a folder that lacks that session.

    Returns
    -------
    model : MotionModel
        The steps are 1.5 % short; the sensor stands 1.2 m ahead of the axle, so a turn moves it sideways; a standing
        car seems to turn.
    """
    from rol_beyond.motion import MotionModel

    return MotionModel(
        matrix=((1.0155, -0.0757, 0.0791), (0.0030, 0.0736, 1.2125), (-0.0001, 0.0040, 1.0142)),
        still_matrix=((0.2743, 0.0, 0.0), (0.0, 0.0029, 0.0), (0.0, 0.0, 0.1139)),
        still=(0.0457, 0.01, 0.0017),
        driving=(0.1152, 0.0395, 0.0069),
        moving=(0.107, 0.0, 0.0),
    )


def published_level(share_1m: float) -> float:
    """Give what session 01 teaches of a right pose, for a folder that lacks that session.

    Parameters
    ----------
    share_1m : float
        Share of the points within 1 m of the map, of a front end that is drawn as in chapter 09.

    Returns
    -------
    level : float
        How much better than by chance a scan fits at its right pose by the settings of the method `rol`, see
        `rol_beyond.recovery.measure_level`: that of drawn points at the true poses of session 01, rounded, for four front
        ends, between them on straight lines, and beyond them that of the nearest.
    """
    return float(np.interp(share_1m, *PUBLISHED_LEVELS))


def learn_from_others(
    real_root: Path | str, number: str, map_points: np.ndarray
) -> tuple[MotionModel, str, np.ndarray]:
    """Learn what the odometry is worth from another session: the mapping session 01 or, for itself, the next one.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session that is to be localized; nothing is learnt from it.
    map_points : array, shape (m, 2)
        The map [m].

    Returns
    -------
    model : MotionModel
        `published_motion` where there is no other session.
    teacher : str
        Number of the session that taught, or "".
    poses : array, shape (n, 3)
        Its true poses, at which the front end may be learnt too; none where there is no other session [m, m, rad].
    """
    from rol_beyond.motion import learn_motion

    others = [name for name in list_routes(real_root) if name != number]
    if not others:
        return published_motion(), "", np.zeros((0, 3))
    teacher = load_route(real_root, others[0], map_points)
    return learn_motion(teacher.steps, teacher.true_steps), teacher.number, teacher.truth


@dataclass(frozen=True)
class RouteRun:
    """What one run of a filter over a session left, scan by scan.

    Attributes
    ----------
    poses : array, shape (n, 3)
        Estimates T_map_radar [m, m, rad].
    covariances : array, shape (n, 3, 3)
        Of the particles about them [m, rad].
    failures : list of int
        Scans at which the rule of failures was broken.
    is_lost : array of bool, shape (n,)
        The filter said that it was lost; never said by the method `paper`.
    health : array, shape (n,)
        See `rol_beyond.recovery.RecoveryUpdate`; NaN for the method `paper`.
    n_particles : array of int, shape (n,)
        Particles.
    update_ms : array, shape (n,)
        Time of each update [ms].
    """

    poses: np.ndarray
    covariances: np.ndarray
    failures: list[int]
    is_lost: np.ndarray
    health: np.ndarray
    n_particles: np.ndarray
    update_ms: np.ndarray


def run_paper(
    route: Route,
    clouds: Iterable[np.ndarray],
    grid: MapGrid,
    settings: MclSettings,
    rng: np.random.Generator,
    rule: FailureRule | None = None,
) -> RouteRun:
    """Run the paper's filter: started at the truth, and set back to it by hand after a failure.

    Parameters
    ----------
    route : Route
        The session.
    clouds : iterable of array, shape (m, 2)
        One cloud per scan [m].
    grid : MapGrid
        From `rol.mcl.build_grid` with the settings.
    settings : MclSettings
        Of `rol.mcl.settings_for`.
    rng : numpy.random.Generator
        Source of randomness.
    rule : FailureRule, optional
        When a run has failed.

    Returns
    -------
    run : RouteRun
        Yin et al. 2020, Sec. III-B and IV-C.
    """
    from rol.evaluation import FailureRule, FailureWatch
    from rol.mcl import localize
    from rol_beyond.recovery import covariance_of

    watch = FailureWatch(route.stamps_us, route.truth, rule or FailureRule())
    filtering = localize(route.steps, clouds, grid, route.truth[0], settings, rng, watch)
    rows, times = _gather(filtering, lambda u: (u.pose, covariance_of(u), False, np.nan, len(u.particles)))
    return RouteRun(*rows[:2], watch.failures, *rows[2:], times)


def run_rol(
    route: Route,
    clouds: Iterable[np.ndarray],
    grid: MapGrid,
    map_points: np.ndarray,
    settings: MclSettings,
    recovery: RecoverySettings,
    model: MotionModel,
    rng: np.random.Generator,
    rule: FailureRule | None = None,
) -> RouteRun:
    """Run the book's filter: started at the truth, never set back.

    Parameters
    ----------
    route, clouds, grid, settings, rng, rule
        As for `run_paper`; a failure that goes on counts again each time that the rule is broken anew.
    map_points : array, shape (m, 2)
        The map [m].
    recovery : RecoverySettings
        See there.
    model : MotionModel
        Of the odometry, learnt from another session.

    Returns
    -------
    run : RouteRun
    """
    from rol.evaluation import FailureRule, FailureWatch
    from rol_beyond.motion import mover, screen_steps
    from rol_beyond.recovery import localize_with_recovery

    watch = FailureWatch(route.stamps_us, route.truth, rule or FailureRule())
    filtering = localize_with_recovery(
        screen_steps(route.steps),
        clouds,
        map_points,
        route.truth[0],
        settings,
        recovery,
        mover(model),
        rng,
        grid=grid,
    )
    rows, times = _gather(
        filtering, lambda u: (u.filter.pose, u.covariance, u.is_lost, u.health, u.n_particles)
    )
    for index, pose in enumerate(rows[0]):
        watch(index, pose)
    return RouteRun(*rows[:2], watch.failures, *rows[2:], times)


def run_registration(
    route: Route,
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    rule: FailureRule | None = None,
    **settings: float,
) -> RouteRun:
    """Register each cloud on the map by ICP, without a filter: what the paper sets aside.

    Started at the truth, each scan from the pose of the one before moved by the odometry; set back to the truth after a
    failure, as in `run_paper`.

    Parameters
    ----------
    route, clouds, rule
        As for `run_paper`.
    map_points : array, shape (m, 2)
        The map [m].
    **settings
        Of `rol_beyond.scan_matching.scan_to_map_icp`.

    Returns
    -------
    run : RouteRun
        ``is_lost`` marks the scans whose registration was not believed; there are no covariances, no health and no
        particles (NaN, NaN and 0). Yin et al. 2020, Sec. III-B.
    """
    from rol.evaluation import FailureRule, FailureWatch
    from rol_beyond.scan_matching import scan_to_map_icp

    watch = FailureWatch(route.stamps_us, route.truth, rule or FailureRule())
    registering = scan_to_map_icp(route.steps, clouds, map_points, route.truth[0], watch, **settings)
    nothing = np.full((3, 3), np.nan)
    rows, times = _gather(registering, lambda r: (r.T_target_source, nothing, not r.converged, np.nan, 0))
    return RouteRun(*rows[:2], watch.failures, *rows[2:], times)


def _gather(filtering: Iterable, read: Callable) -> tuple[list[np.ndarray], np.ndarray]:
    """Run a filter to its end; give what is read from each update as arrays, and the time of each [ms]."""
    rows, times, begin = [], [], perf_counter()
    for update in filtering:
        times.append(1000.0 * (perf_counter() - begin))
        rows.append(read(update))
        begin = perf_counter()
    return [np.array(column) for column in zip(*rows, strict=True)], np.array(times)


def displace(pose: np.ndarray, distance_m: float, turn: float, rng: np.random.Generator) -> np.ndarray:
    """Carry a pose off by a distance in any direction, and turn it to either side.

    Parameters
    ----------
    pose : array, shape (3,)
        Pose [m, m, rad].
    distance_m, turn : float
        How far [m], and by what angle [rad].
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    pose : array, shape (3,)
    """
    angle = rng.uniform(-np.pi, np.pi)
    there = compose(pose, np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), 0.0]))
    return there + np.array([0.0, 0.0, turn * rng.choice([-1.0, 1.0])])


@dataclass(frozen=True)
class RecoveryTrial:
    """How a filter that began at a wrong place fared.

    Attributes
    ----------
    found_s : float
        Time after which the estimate was right, and stayed so for two seconds [s]; infinite if it never was.
    told_share : float
        Share of the scans with a wrong estimate, after the first two seconds, at which it said that it was lost; NaN
        if there were none.
    error_m : float
        Position error at the end [m].
    is_lost_at_end : bool
        It said so at the last scan.
    n_particles : int
        The most particles at any time.
    seconds : float
        Time on the clock that it took [s].
    """

    found_s: float
    told_share: float
    error_m: float
    is_lost_at_end: bool
    n_particles: int
    seconds: float


def judge_recovery(
    updates: Sequence[RecoveryUpdate],
    truth: np.ndarray,
    seconds: float = 0.0,
    *,
    limits: tuple[float, float] = (1.0, np.deg2rad(5.0)),
    stay: int = 8,
) -> RecoveryTrial:
    """Judge how the pose was found.

    Parameters
    ----------
    updates : sequence of RecoveryUpdate
        From `rol_beyond.recovery.localize_with_recovery`.
    truth : array, shape (n, 3)
        True poses of the same scans [m, m, rad].
    seconds : float
        Time on the clock, to be noted [s].
    limits : tuple of float
        An estimate is right within these [m, rad].
    stay : int
        For so many scans; two seconds.

    Returns
    -------
    trial : RecoveryTrial
    """
    poses = np.array([update.filter.pose for update in updates])
    off = relative_pose(truth[: len(poses)], poses)
    distance = np.hypot(off[:, 0], off[:, 1])
    is_right = (distance < limits[0]) & (np.abs(off[:, 2]) < limits[1])
    is_lost = np.array([update.is_lost for update in updates])
    stays = np.convolve(is_right, np.ones(stay), "valid") > stay - 0.5 if len(poses) >= stay else np.zeros(1)
    wrong = ~is_right[stay:]
    return RecoveryTrial(
        float(np.argmax(stays) * SCAN_US * 1e-6) if stays.any() else float("inf"),
        float(is_lost[stay:][wrong].mean()) if wrong.any() else float("nan"),
        float(distance[-1]),
        bool(is_lost[-1]),
        int(max(update.n_particles for update in updates)),
        seconds,
    )
