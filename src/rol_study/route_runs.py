"""Runs of the filter over the real route with drawn points: what chapter 09 shows and `workflow/measure_route.py` repeats.

Map, true poses and odometry are the authors' own; the points of each scan are drawn from the map at the true pose
(`rol_study.sampled_points`). What a filter has to know beforehand, the worth of the odometry and how well a scan fits at a
right pose, is learnt from another session.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rol.evaluation import FailureRule
    from rol.mcl import MapGrid, MclSettings
    from rol_beyond.motion import MotionModel
    from rol_beyond.recovery import RecoverySettings, RecoveryUpdate
    from rol_study.route import RecoveryTrial, Route, RouteRun
    from rol_study.sampled_points import FrontEnd, VisiblePoints

CELL_M = 0.25  # of the filter's grid: the pixel of the real map


@dataclass(frozen=True)
class Stage:
    """Everything that a run over one session needs, made once.

    Attributes
    ----------
    route : Route
        The session.
    map_points : array, shape (m, 2)
        The real map [m].
    front_end : FrontEnd
        What the points are like.
    sight : VisiblePoints
        What of the map can be seen from each true pose.
    parts : array, shape (3,)
        Parts of near points, points beside and false ones that have the front end's shares over the whole session.
    model : MotionModel
        Of the odometry, learnt from the session `teacher`.
    teacher : str
        Its number; "" where there is no other session.
    level : float
        How much better than by chance a scan fits at its right pose, learnt from that session; where there is none,
        `rol_study.route.published_level`.
    grid : MapGrid
        Of the method `rol`.
    """

    route: Route
    map_points: np.ndarray
    front_end: FrontEnd
    sight: VisiblePoints
    parts: np.ndarray
    model: MotionModel
    teacher: str
    level: float
    grid: MapGrid


def set_stage(
    real_root: Path | str,
    number: str,
    front_end: FrontEnd,
    *,
    max_scans: int = 0,
    n_level: int = 300,
    settings: MclSettings | None = None,
) -> Stage:
    """Load a session and the map, look around from all poses, and learn from another session.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Of the session, such as "02".
    front_end : FrontEnd
        What the points are to be like.
    max_scans : int
        Use only the first so many scans, 0 for all.
    n_level : int
        Scans of the other session from which the level is learnt.
    settings : MclSettings, optional
        Of the filter that the level is for; those of the method `rol` if not given.

    Returns
    -------
    stage : Stage

    Raises
    ------
    rol_data.rall.RallError, rol_study.route.RouteError
        If the files are missing or at fault.
    """
    from rol.mcl import build_grid, settings_for
    from rol_data.rall import MAP_PATH, MAP_SHAPE, load_map_points
    from rol_study.route import Route, learn_from_others, load_route
    from rol_study.sampled_points import find_visible_points

    map_points = load_map_points(Path(real_root, MAP_PATH), MAP_SHAPE)
    route = load_route(real_root, number, map_points)
    sample = route.truth[np.linspace(0, len(route.truth) - 1, 200).astype(int)]
    parts = _find_parts(map_points, sample, front_end)
    if max_scans:
        route = Route(number, route.truth[:max_scans], route.steps[: max_scans - 1])
    model, teacher, poses = learn_from_others(real_root, number, map_points)
    poses = poses[np.linspace(0, len(poses) - 1, min(n_level, len(poses))).astype(int)]
    grid = build_grid(map_points, settings or settings_for("rol"))
    level = _learn_level(map_points, poses, front_end, grid)
    sight = find_visible_points(map_points, route.truth)
    return Stage(route, map_points, front_end, sight, parts, model, teacher, level, grid)


def _learn_level(map_points: np.ndarray, poses: np.ndarray, front_end: FrontEnd, grid: MapGrid) -> float:
    """Learn from another session's true poses how well a scan fits at a right one; without them, what is published."""
    from rol_beyond.recovery import measure_level
    from rol_study.route import published_level
    from rol_study.sampled_points import find_visible_points, sample_points

    if not len(poses):
        return published_level(front_end.share_1m)
    sight, rng = find_visible_points(map_points, poses), np.random.default_rng(0)
    return measure_level(sample_points(map_points, poses, sight, front_end, rng), poses, grid)


def _find_parts(map_points: np.ndarray, poses: np.ndarray, front_end: FrontEnd) -> np.ndarray:
    """Find the parts of the kinds of points that have the front end's shares on average over poses."""
    from rol_study.sampled_points import find_visible_points, measure_fractions, solve_mixture

    kinds = measure_fractions(
        map_points, poses, find_visible_points(map_points, poses), front_end, np.random.default_rng(0)
    )
    return solve_mixture(kinds, front_end.share_1m, front_end.share_2m)


def draw_session(stage: Stage, seed: int) -> list[np.ndarray]:
    """Draw the clouds of the whole session.

    Parameters
    ----------
    stage : Stage
        See there.
    seed : int
        Of the points.

    Returns
    -------
    clouds : list of array, shape (m, 2)
        One per scan, in the radar frame [m].
    """
    from rol_study.sampled_points import sample_points

    rng = np.random.default_rng([seed, int(stage.route.number)])
    drawing = sample_points(
        stage.map_points, stage.route.truth, stage.sight, stage.front_end, rng, stage.parts
    )
    return list(drawing)


def run_method(
    stage: Stage,
    method: str,
    clouds: Sequence[np.ndarray],
    seed: int,
    *,
    rule: FailureRule | None = None,
    recovery: RecoverySettings | None = None,
    **changes: object,
) -> RouteRun:
    """Run a method over the session, started at the truth.

    Parameters
    ----------
    stage : Stage
        See there.
    method : str
        "paper", "rol" or "registration", see `rol_study.route.run_paper`, `run_rol` and `run_registration` there.
    clouds : sequence of array, shape (m, 2)
        One cloud per scan [m].
    seed : int
        Of the particles.
    rule : FailureRule, optional
        What counts as a failure.
    recovery : RecoverySettings, optional
        Of the method `rol`, if it is to watch itself otherwise than by default.
    **changes
        Settings that differ from the method's own, see `rol.mcl.settings_for`.

    Returns
    -------
    run : RouteRun
    """
    from rol.mcl import build_grid, settings_for
    from rol_beyond.recovery import RecoverySettings
    from rol_study.route import run_paper, run_registration, run_rol

    if method == "registration":
        return run_registration(stage.route, clouds, stage.map_points, rule)
    rng = np.random.default_rng([seed, int(stage.route.number), 1])
    settings = settings_for(method, **{"cell_m": CELL_M, **changes})
    if method == "paper":
        return run_paper(stage.route, clouds, build_grid(stage.map_points, settings), settings, rng, rule)
    recovery, grid = recovery or RecoverySettings(stage.level), build_grid(stage.map_points, settings)
    return run_rol(stage.route, clouds, grid, stage.map_points, settings, recovery, stage.model, rng, rule)


def run_from(
    stage: Stage, first: int, start: np.ndarray, n_scans: int, seed: int, *, is_start_known: bool
) -> tuple[list[RecoveryUpdate], list[np.ndarray]]:
    """Run the method `rol` from some scan on, beginning at a pose that is not the true one.

    Parameters
    ----------
    stage : Stage
        See there.
    first, n_scans : int
        First scan, and how many at most; a run from an unknown start ends two seconds after the filter has declared
        its pose found.
    start : array, shape (3,)
        Where it is told to begin [m, m, rad].
    seed : int
        Of points and particles.
    is_start_known : bool
        False: it is told that the start is only the middle of where it may be.

    Returns
    -------
    updates : list of RecoveryUpdate
        One per scan.
    clouds : list of array, shape (m, 2)
        Their points [m].

    Raises
    ------
    ValueError
        If the session has no such first scan.
    """
    from rol.mcl import settings_for
    from rol_beyond.motion import mover, screen_steps
    from rol_beyond.recovery import RecoverySettings, localize_with_recovery
    from rol_study.sampled_points import VisiblePoints, sample_points

    _check_first(stage, first)
    poses, rng = stage.route.truth[first : first + n_scans], np.random.default_rng([seed, first])
    starts = stage.sight.starts[first : first + len(poses) + 1]
    sight = VisiblePoints(stage.sight.points[starts[0] : starts[-1]], starts - starts[0])
    drawing = sample_points(stage.map_points, poses, sight, stage.front_end, rng, stage.parts)
    updates, clouds, n_found = [], [], 0

    def keep_clouds() -> Iterator[np.ndarray]:
        for cloud in drawing:
            clouds.append(cloud)
            yield cloud

    filtering = localize_with_recovery(
        screen_steps(stage.route.steps[first:]), keep_clouds(), stage.map_points, start, settings_for("rol"),
        RecoverySettings(stage.level), mover(stage.model), rng, is_start_known=is_start_known, grid=stage.grid,
    )  # fmt: skip
    for update in filtering:
        updates.append(update)
        n_found = 0 if update.is_lost else n_found + 1
        if not is_start_known and n_found > 8:
            break
    return updates, clouds


def _check_first(stage: Stage, first: int) -> None:
    """Refuse a first scan that the session does not have; a negative one would count from its end."""
    if not 0 <= first < len(stage.route.truth):
        n_scans = len(stage.route.truth)
        raise ValueError(f"first: {first} is no scan of session {stage.route.number}, which has {n_scans}")


def kidnap(stage: Stage, first: int, seed: int, *, n_scans: int = 60) -> tuple[RecoveryTrial, list, list]:
    """Begin at a pose that is 20 m and 20 deg off, in the firm belief that it is right.

    Parameters
    ----------
    stage : Stage
        See there.
    first : int
        Scan at which it happens.
    seed : int
        Of the direction, the points and the particles.
    n_scans : int
        How long to watch.

    Returns
    -------
    trial : RecoveryTrial
        How it went.
    updates, clouds : list
        See `run_from`.

    Raises
    ------
    ValueError
        If the session has no such first scan.
    """
    from rol_study.route import displace, judge_recovery

    _check_first(stage, first)
    start = displace(
        stage.route.truth[first], 20.0, np.deg2rad(20.0), np.random.default_rng([seed, first, 2])
    )
    begin = perf_counter()
    updates, clouds = run_from(stage, first, start, n_scans, seed, is_start_known=True)
    trial = judge_recovery(updates, stage.route.truth[first:], perf_counter() - begin)
    return trial, updates, clouds


def start_anywhere(
    stage: Stage, first: int, seed: int, *, within_m: float = 300.0, n_scans: int = 480
) -> tuple[RecoveryTrial, list, list]:
    """Begin with no more than a circle within which the car is, its heading unknown.

    Parameters
    ----------
    stage : Stage
        See there.
    first : int
        Scan at which it begins.
    seed : int
        Of the circle, the points and the particles.
    within_m : float
        Radius of the circle; the car is anywhere in it with equal probability [m].
    n_scans : int
        How long to watch at most; two minutes.

    Returns
    -------
    trial : RecoveryTrial
        How it went.
    updates, clouds : list
        See `run_from`.

    Raises
    ------
    ValueError
        If the session has no such first scan.
    """
    from rol_study.route import displace, judge_recovery

    _check_first(stage, first)
    rng = np.random.default_rng([seed, first, 3])
    start = displace(stage.route.truth[first], within_m * np.sqrt(rng.random()), 0.0, rng)
    start[2] = rng.uniform(-np.pi, np.pi)
    begin = perf_counter()
    updates, clouds = run_from(stage, first, start, n_scans, seed, is_start_known=False)
    trial = judge_recovery(updates, stage.route.truth[first:], perf_counter() - begin)
    return trial, updates, clouds


def add_outliers(route: Route, share: float, rng: np.random.Generator) -> Route:
    """Spoil some steps of the odometry by half a metre to two metres in any direction, and up to 5 deg.

    Parameters
    ----------
    route : Route
        The session.
    share : float
        Share of the steps.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    route : Route
        The same with other steps.
    """
    steps, chosen = route.steps.copy(), rng.random(len(route.steps)) < share
    n = int(chosen.sum())
    angles, lengths = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.5, 2.0, n)
    steps[chosen] += np.column_stack([
        lengths * np.cos(angles), lengths * np.sin(angles), np.deg2rad(rng.uniform(-5.0, 5.0, n))
    ])  # fmt: skip
    return replace(route, steps=steps)
