"""Experiments on the real route with sampled points: runs of the filters, kidnapping, global localization.

Map, ground truth and odometry are the authors' own; the points of each scan are sampled from the map at the
true pose (`rol_study.sampled_points`). What a filter needs beforehand, the motion model and the reference
contrast, is calibrated on another session.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from rol.evaluation import FailureMonitor, FailureRule, pose_errors
from rol.geometry import compose, relative_pose
from rol.mcl import MapGrid, MclSettings, ParticleFilter, localize
from rol.radar import ScanMotion, compensate_points
from rol_beyond.motion import MotionModel, gate_odometry
from rol_beyond.recovery import (
    RecoveringFilter,
    RecoverySettings,
    RecoveryUpdate,
    measure_reference_contrast,
)
from rol_beyond.robust import settings_for
from rol_data.rall import load_map
from rol_study.filter_runs import FilterRun, find_failures, run_filter, run_registration
from rol_study.oxford_route import (
    SCAN_US,
    RouteSession,
    calibrate_on_another,
    load_session,
    published_reference_contrast,
)
from rol_study.sampled_points import (
    FrontEnd,
    SampledPointsError,
    VisiblePoints,
    find_visible_points,
    measure_fractions,
    sample_points,
    solve_mixture,
)

N_REFERENCE = 300  # scans of the other session on which the reference contrast is measured
CELL_M = 0.25  # of the filters' grids: the pixel of the real map


@dataclass(frozen=True)
class RouteExperiment:
    """Everything that a run over one session needs.

    Attributes
    ----------
    session : RouteSession
        The session.
    map_points : array, shape (m, 2)
        The real map [m].
    front_end : FrontEnd
        Properties of the sampled points.
    visible : VisiblePoints
        Points of the map visible from each true pose.
    mixture_poses, calibration_poses : array, shape (k, 3)
        Ground-truth poses of the whole session, for `parts`, and of the other one, for `reference_contrast`
        [m, m, rad].
    parts : array, shape (3,)
        Parts of near points, points beside and false ones that have the front end's precision over the whole
        session.
    motion : MotionModel
        Calibrated on the session `calibration_session`.
    calibration_session : str
        Its number; "" where there is no other session.
    reference_contrast : float
        Score contrast of a scan at its correct pose, measured on that session; where there is none,
        `rol_study.oxford_route.published_reference_contrast`.
    grid : MapGrid
        Of the method `robust`.
    """

    session: RouteSession
    map_points: np.ndarray
    front_end: FrontEnd
    visible: VisiblePoints
    mixture_poses: np.ndarray
    calibration_poses: np.ndarray
    parts: np.ndarray
    motion: MotionModel
    calibration_session: str
    reference_contrast: float
    grid: MapGrid


def prepare_experiment(
    real_root: Path | str,
    number: str,
    front_end: FrontEnd,
    *,
    place: str = "oxford",
    odometry: str = "rall",
    max_scans: int = 0,
    settings: MclSettings | None = None,
) -> RouteExperiment:
    """Load a session and the map, find the visible points of all poses, and calibrate on another session.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session, such as "02".
    front_end : FrontEnd
        Properties of the sampled points.
    place, odometry : str
        See `rol_study.oxford_route.load_session`; the motion model is calibrated on the same odometry.
    max_scans : int
        Use only the first scans, 0 for all.
    settings : MclSettings, optional
        Of the filter that the reference contrast is for; those of the method `robust` if not given.

    Returns
    -------
    experiment : RouteExperiment

    Raises
    ------
    rol_data.rall.RallError, rol_study.oxford_route.RouteError
        If the files are missing or faulty.
    """
    map_points = load_map(real_root, place)
    session = load_session(real_root, number, map_points, place, odometry)
    mixture_poses = _choose(session.truth, 200)
    if max_scans:
        session = session.part(0, max_scans)
    motion, other, poses = calibrate_on_another(real_root, number, map_points, place, odometry)
    grid = (settings or settings_for("robust")).measurement.build_grid(map_points)
    visible = find_visible_points(map_points, session.truth)
    own = session, map_points, front_end, visible, mixture_poses, _choose(poses, N_REFERENCE)
    return change_front_end(RouteExperiment(*own, np.ones(3) / 3, motion, other, 0.0, grid), front_end)


def prepare_sessions(
    real_root: Path | str, numbers: Iterable[str], front_end: FrontEnd, **options: object
) -> tuple[dict[str, RouteExperiment], dict[str, str]]:
    """Prepare the experiments of several sessions.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    numbers : iterable of str
        Sessions, such as "02".
    front_end : FrontEnd
        Properties of the sampled points.
    **options
        See `prepare_experiment`.

    Returns
    -------
    experiments : dict of str to RouteExperiment
        By session.
    left_out : dict of str to str
        Sessions from whose map points of this quality cannot be sampled, with the reason.
    """
    experiments, left_out = {}, {}
    for number in numbers:
        try:
            experiments[number] = prepare_experiment(real_root, number, front_end, **options)
        except SampledPointsError as fault:
            left_out[number] = str(fault)
    return experiments, left_out


def _choose(poses: np.ndarray, n: int) -> np.ndarray:
    """Choose n poses evenly, or all if there are fewer."""
    return poses[np.linspace(0, len(poses) - 1, min(n, len(poses))).astype(int)]


def change_front_end(experiment: RouteExperiment, front_end: FrontEnd) -> RouteExperiment:
    """Return the same experiment with the points of another front end.

    Parameters
    ----------
    experiment : RouteExperiment
        Session, map and calibration.
    front_end : FrontEnd
        Properties of the sampled points.

    Returns
    -------
    experiment : RouteExperiment
        With the parts and the reference contrast that belong to the front end.

    Raises
    ------
    rol_study.sampled_points.SampledPointsError
        If no mixture of points has the front end's fractions on this map.
    """
    e = experiment
    parts = _find_parts(e.map_points, e.mixture_poses, front_end)
    reference = _measure_reference(e.map_points, e.calibration_poses, front_end, e.grid)
    return replace(e, front_end=front_end, parts=parts, reference_contrast=reference)


def _measure_reference(
    map_points: np.ndarray, poses: np.ndarray, front_end: FrontEnd, grid: MapGrid
) -> float:
    """Measure the reference contrast at another session's poses; without them return the published one."""
    if not len(poses):
        return published_reference_contrast(front_end.fraction_1m)
    visible, rng = find_visible_points(map_points, poses), np.random.default_rng(0)
    clouds = sample_points(map_points, poses, visible, front_end, rng)
    return measure_reference_contrast(clouds, poses, grid)


def _find_parts(map_points: np.ndarray, poses: np.ndarray, front_end: FrontEnd) -> np.ndarray:
    """Find the parts of the kinds of points that have the front end's precision on average over poses."""
    visible, rng = find_visible_points(map_points, poses), np.random.default_rng(0)
    kinds = measure_fractions(map_points, poses, visible, front_end, rng)
    return solve_mixture(kinds, front_end.fraction_1m, front_end.fraction_2m)


def sample_session(experiment: RouteExperiment, seed: int) -> list[np.ndarray]:
    """Sample the points of all scans of a session.

    Parameters
    ----------
    experiment : RouteExperiment
        Session, map and front end.
    seed : int
        Of the points.

    Returns
    -------
    clouds : list of array, shape (m, 2)
        One per scan, in the radar frame [m].
    """
    rng, e = np.random.default_rng([seed, int(experiment.session.number)]), experiment
    return list(sample_points(e.map_points, e.session.truth, e.visible, e.front_end, rng, e.parts))


def run_method(
    experiment: RouteExperiment,
    method: str,
    clouds: Sequence[np.ndarray],
    seed: int,
    *,
    rule: FailureRule | None = None,
    recovery: RecoverySettings | None = None,
    **changes: object,
) -> FilterRun:
    """Run a method over the session, started at the ground truth.

    Parameters
    ----------
    experiment : RouteExperiment
        Session, map and calibration.
    method : str
        "paper" and "registration" (`run_registration`) are reset to the ground truth after each failure;
        "robust" is never reset.
    clouds : sequence of array, shape (m, 2)
        Points of each scan [m].
    seed : int
        Of the particles.
    rule : FailureRule, optional
        When a run has failed.
    recovery : RecoverySettings, optional
        Of the method `robust`, if they differ from the defaults.
    **changes
        Settings that differ from the method's own, see `rol_beyond.robust.settings_for`.

    Returns
    -------
    run : FilterRun
    """
    session, map_points = experiment.session, experiment.map_points
    increments, rule = session.increments, rule or FailureRule()
    monitor = FailureMonitor(session.stamps_us, session.truth, rule)
    if method == "registration":
        return run_registration(increments, clouds, map_points, monitor)
    rng, start = np.random.default_rng([seed, int(session.number), 1]), session.truth[0]
    settings = settings_for(method, **{"cell_m": CELL_M, **changes})
    if method == "paper":
        grid = settings.measurement.build_grid(map_points)
        return run_filter(ParticleFilter(grid, start, settings, rng), increments, clouds, monitor)
    settings = replace(settings, motion=experiment.motion)
    recovery = recovery or RecoverySettings(experiment.reference_contrast)
    robust_filter = RecoveringFilter(map_points, start, settings, recovery, rng)
    run = run_filter(robust_filter, gate_odometry(increments), clouds)
    return replace(run, failures=find_failures(session.stamps_us, run.poses, session.truth, rule))


def displace(pose: np.ndarray, distance_m: float, turn: float, rng: np.random.Generator) -> np.ndarray:
    """Displace a pose by a distance in a random direction, and turn it to a random side.

    Parameters
    ----------
    pose : array, shape (3,)
        Pose [m, m, rad].
    distance_m, turn : float
        Distance [m] and angle [rad].
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    pose : array, shape (3,)
    """
    angle = rng.uniform(-np.pi, np.pi)
    there = compose(pose, np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), 0.0]))
    return there + np.array([0.0, 0.0, turn * rng.choice([-1.0, 1.0])])


@dataclass(frozen=True)
class RecoveryTrial:
    """Result of a run that began at a wrong pose.

    Attributes
    ----------
    found_s : float
        Time after which the estimate was correct, and stayed so for two seconds [s]; infinite if it never
        was.
    told_share : float
        Fraction of the scans with a wrong estimate, after the first two seconds, at which the filter reported
        that it was lost; NaN if there were none.
    error_m : float
        Position error at the end [m].
    is_lost_at_end : bool
        The filter reported at the last scan that it was lost.
    n_particles : int
        Largest number of particles.
    seconds : float
        Wall-clock time [s].
    """

    found_s: float
    told_share: float
    error_m: float
    is_lost_at_end: bool
    n_particles: int
    seconds: float


def first_lasting(is_right: np.ndarray, n_stay: int = 8) -> float:
    """Find the time from which on an array of bool, one per scan, is true for `n_stay` scans [s];
    infinite if it never is."""
    is_long = len(is_right) >= n_stay
    stays = np.convolve(is_right, np.ones(n_stay), "valid") > n_stay - 0.5 if is_long else np.zeros(1)
    return float(np.argmax(stays) * SCAN_US * 1e-6) if stays.any() else float("inf")


def evaluate_recovery(
    updates: Sequence[RecoveryUpdate],
    truth: np.ndarray,
    seconds: float = 0.0,
    *,
    limits: tuple[float, float] = (1.0, np.deg2rad(5.0)),
    n_stay: int = 8,
) -> RecoveryTrial:
    """Evaluate how the pose was found.

    Parameters
    ----------
    updates : sequence of RecoveryUpdate
        From `rol_beyond.recovery.RecoveringFilter`.
    truth : array, shape (n, 3)
        Ground-truth poses of the same scans [m, m, rad].
    seconds : float
        Wall-clock time, to be recorded [s].
    limits : tuple of float
        An estimate is correct within these [m, rad].
    n_stay : int
        For this number of scans; two seconds.

    Returns
    -------
    trial : RecoveryTrial
    """
    poses = np.array([update.pose for update in updates])
    off = relative_pose(truth[: len(poses)], poses)
    distance = np.hypot(off[:, 0], off[:, 1])
    is_right = (distance < limits[0]) & (np.abs(off[:, 2]) < limits[1])
    is_lost = np.array([update.is_lost for update in updates])
    wrong = ~is_right[n_stay:]
    return RecoveryTrial(
        found_s=first_lasting(is_right, n_stay),
        told_share=float(is_lost[n_stay:][wrong].mean()) if wrong.any() else float("nan"),
        error_m=float(distance[-1]),
        is_lost_at_end=bool(is_lost[-1]),
        n_particles=int(max(update.n_particles for update in updates)),
        seconds=seconds,
    )


def run_from(
    experiment: RouteExperiment, start: np.ndarray, rng: np.random.Generator, *, is_start_known: bool
) -> tuple[list[RecoveryUpdate], list[np.ndarray]]:
    """Run the method `robust` from a pose that is not the true one.

    Parameters
    ----------
    experiment : RouteExperiment
        Scans, map and calibration. A run from an unknown start ends two seconds after the filter has reported
        that it is not lost.
    start : array, shape (3,)
        Start pose given to the filter [m, m, rad].
    rng : numpy.random.Generator
        Random generator of points and particles.
    is_start_known : bool
        False: the filter treats the start only as the centre of the search.

    Returns
    -------
    updates : list of RecoveryUpdate
        One per scan.
    clouds : list of array, shape (m, 2)
        Their points [m].
    """
    e, updates, clouds, n_found = experiment, [], [], 0
    sampling = sample_points(e.map_points, e.session.truth, e.visible, e.front_end, rng, e.parts)

    def keep_clouds() -> Iterator[np.ndarray]:
        for cloud in sampling:
            clouds.append(cloud)
            yield cloud

    settings, recovery = settings_for("robust", motion=e.motion), RecoverySettings(e.reference_contrast)
    robust_filter = RecoveringFilter(e.map_points, start, settings, recovery, rng, is_start_known, e.grid)
    for update in localize(robust_filter, gate_odometry(e.session.increments), keep_clouds()):
        updates.append(update)
        n_found = 0 if update.is_lost else n_found + 1
        if not is_start_known and n_found > 8:
            break
    return updates, clouds


def cut_scans(experiment: RouteExperiment, first: int, n_scans: int) -> RouteExperiment:
    """Cut at most `n_scans` scans out of a session, with the points visible from them.

    Raises
    ------
    ValueError
        If the session has no such first scan; a negative one would count from its end.
    """
    session, visible = experiment.session, experiment.visible
    n = len(session.truth)
    if not 0 <= first < n:
        raise ValueError(f"first: {first} is no scan of session {session.number}, which has {n}")
    starts = visible.starts[first : first + n_scans + 1]
    visible = VisiblePoints(visible.points[starts[0] : starts[-1]], starts - starts[0])
    return replace(experiment, session=session.part(first, first + n_scans), visible=visible)


def run_displaced(
    experiment: RouteExperiment, start: np.ndarray, clouds: Iterable[np.ndarray], seed: int
) -> np.ndarray:
    """Run the method `paper` without resets from a pose that is not the true one.

    Parameters
    ----------
    experiment : RouteExperiment
        Session, and the grid of the method `paper`.
    start : array, shape (3,)
        Start pose given to the filter [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan [m].
    seed : int
        Of the particles.

    Returns
    -------
    errors_m : array, shape (n,)
        Position errors [m].
    """
    session, rng = experiment.session, np.random.default_rng([seed, int(experiment.session.number), 1])
    particle_filter = ParticleFilter(experiment.grid, start, settings_for("paper", cell_m=CELL_M), rng)
    poses = [update.pose for update in localize(particle_filter, session.increments, clouds)]
    return pose_errors(np.array(poses), session.truth).position_m


def kidnap(
    experiment: RouteExperiment, first: int, seed: int, *, n_scans: int = 60
) -> tuple[RecoveryTrial, list, list]:
    """Start 20 m and 20 deg off, with a filter that assumes the start is correct (kidnapped robot).

    Parameters
    ----------
    experiment : RouteExperiment
        Session, map and calibration.
    first : int
        First scan.
    seed : int
        Of the direction, the points and the particles.
    n_scans : int
        Number of scans.

    Returns
    -------
    trial : RecoveryTrial
        Result.
    updates, clouds : list
        See `run_from`.

    Raises
    ------
    ValueError
        If the session has no such first scan.
    """
    part, begin = cut_scans(experiment, first, n_scans), perf_counter()
    truth, rng = part.session.truth, np.random.default_rng([seed, first, 2])
    start = displace(truth[0], 20.0, np.deg2rad(20.0), rng)
    updates, clouds = run_from(part, start, np.random.default_rng([seed, first]), is_start_known=True)
    return evaluate_recovery(updates, truth, perf_counter() - begin), updates, clouds


def localize_globally(
    experiment: RouteExperiment, first: int, seed: int, *, within_m: float = 300.0, n_scans: int = 480
) -> tuple[RecoveryTrial, list, list]:
    """Start with a circle that contains the position, and an unknown heading (global localization).

    Parameters
    ----------
    experiment : RouteExperiment
        Session, map and calibration.
    first : int
        First scan.
    seed : int
        Of the circle, the points and the particles.
    within_m : float
        Radius of the circle; the position is uniformly distributed in it [m].
    n_scans : int
        Largest number of scans; two minutes.

    Returns
    -------
    trial : RecoveryTrial
        Result.
    updates, clouds : list
        See `run_from`.

    Raises
    ------
    ValueError
        If the session has no such first scan.
    """
    part, begin = cut_scans(experiment, first, n_scans), perf_counter()
    truth, rng = part.session.truth, np.random.default_rng([seed, first, 3])
    start = displace(truth[0], within_m * np.sqrt(rng.random()), 0.0, rng)
    start[2] = rng.uniform(-np.pi, np.pi)
    updates, clouds = run_from(part, start, np.random.default_rng([seed, first]), is_start_known=False)
    return evaluate_recovery(updates, truth, perf_counter() - begin), updates, clouds


def add_outliers(session: RouteSession, fraction: float, rng: np.random.Generator) -> RouteSession:
    """Disturb a fraction of the increments by 0.5 m to 2 m in a random direction, and up to 5 deg.

    Parameters
    ----------
    session : RouteSession
        The session.
    fraction : float
        Fraction of the increments.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    session : RouteSession
        The same with other increments.
    """
    increments, chosen = session.increments.copy(), rng.random(len(session.increments)) < fraction
    n = int(chosen.sum())
    angles, lengths = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.5, 2.0, n)
    turns = np.deg2rad(rng.uniform(-5.0, 5.0, n))
    increments[chosen] += np.column_stack([lengths * np.cos(angles), lengths * np.sin(angles), turns])
    return replace(session, increments=increments)


def skew_by_motion(clouds: Iterable[np.ndarray], true_increments: np.ndarray) -> list[np.ndarray]:
    """Distort the points of each scan as the motion during the turn and the Doppler shift do without
    compensation.

    Parameters
    ----------
    clouds : iterable of array, shape (m, 2)
        Points of each of n scans in the radar frame at mid-scan [m].
    true_increments : array, shape (n - 1, 3)
        Motion from each scan to the next [m, m, rad].

    Returns
    -------
    clouds : list of array, shape (m, 2)
        `rol.radar.compensate_points` with the opposite motion, whose inverse it is to first order [m].
    """
    twists = true_increments[np.minimum(np.arange(len(true_increments) + 1), len(true_increments) - 1)]
    twists = twists / (SCAN_US * 1e-6)
    return [compensate_points(cloud, ScanMotion(-twist)) for cloud, twist in zip(clouds, twists, strict=True)]
