"""Localization that notices when it is lost, says so, and finds the pose again, without the truth and without a hand.

Two questions are asked of every scan. *Does it fit better here than it would by chance?* The excess of a cloud at the
estimate (`rol_beyond.search.measure_excess`), averaged over two seconds, is held against what it is at a right pose. *Does it
fit better elsewhere?* When the answer to the first is doubtful, poses around are searched for with the clouds of the
last seconds, and each good one becomes a rival: a small filter of its own that follows the car. A rival that fits
better than the estimate, scan after scan and on scans that had no part in finding it, takes its place.

A wrong place may fit well for seconds (a street is like itself farther on), so nothing is decided on one scan. And a
car that stands sees the same false points again and again, so once the filter has been sure of its place, only scans
that were made on the move can make it doubt.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rol.geometry import check_fields, check_poses, first_of_cells, wrap_angle

if TYPE_CHECKING:
    from rol.mcl import MapGrid, MclSettings, MclUpdate

Move = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class RecoverySettings:
    """When to doubt, where to search, and when to believe; each default gives its reason.

    Attributes
    ----------
    level : float
        Median excess of a scan at its right pose, see `measure_level`; the limits below are shares of it.
    doubt, lost : float
        Below these shares of the level, rivals are looked for, and the filter says that it is lost. At right poses of
        the real route, 5 % of the averages over two seconds fall below 0.6 and 1 % below 0.3; 20 m and 20 deg off,
        95 % are below 0.2.
    scans : int
        Scans that are averaged. 8: two seconds.
    trial : int
        Scans over which a rival must have been followed. 12: three seconds.
    margin, trusted_margin : float
        By this share of the level, on average over the trial, it must fit better than the estimate; the second where
        the estimate has been in good health before.
    unique, far_unique : float
        And by this share better than every other rival: a street that is like itself gives no answer, so wait. The
        second holds for rivals from far, of which there are many more.
    trust_m : float
        After so long a way in good health an estimate is trusted, until a rival takes its place [m].
    moved_m : float
        A scan counts, for an estimate that has been in good health, when the car has moved so far since the last one
        that did [m].
    window, window_m : int, float
        Clouds that are laid together for a search, and the way over which they may reach [m]. 16: in four seconds the
        odometry turns by less than a degree.
    pause, trusted_pause, far_pause : int
        Scans between two searches: near, near while the estimate is trusted, and far.
    max_range_m : float
        Points farther off than this are left out of a search: the heading is not known well enough for them [m].
    reach_m, reach_yaw : float
        Where is searched, about the estimate [m, rad].
    far_after : int
        After so many scans in a row of being lost the search goes far, until a place is trusted. 120: half a minute.
    far_m : float
        Reach of the far search, in all headings [m].
    n_rivals, n_far_rivals : int
        Rivals at most, near and far.
    rival_particles : int
        Particles of each.
    workers : int
        Threads of a search.
    still_m, still_share : float
        While a step is shorter than this [m], a scan weighs with this share of the exponent: a car that stands sees the
        same false points again and again, and its scans are one witness rather than many.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    level: float
    doubt: float = 0.5
    lost: float = 0.35
    scans: int = 8
    trial: int = 12
    margin: float = 0.25
    trusted_margin: float = 0.5
    unique: float = 0.1
    far_unique: float = 0.25
    trust_m: float = 4.0
    moved_m: float = 0.5
    window: int = 16
    window_m: float = 20.0
    pause: int = 2
    trusted_pause: int = 12
    far_pause: int = 20
    max_range_m: float = 40.0
    reach_m: float = 30.0
    reach_yaw: float = float(np.deg2rad(30.0))
    far_after: int = 120
    far_m: float = 300.0
    n_rivals: int = 20
    n_far_rivals: int = 100
    rival_particles: int = 50
    workers: int = 1
    still_m: float = 0.05
    still_share: float = 0.25

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "level window_m reach_m far_m",
            "(0, inf]": "max_range_m",
            "[-inf, 1]": "doubt lost",  # minus infinity: never
            "[0, inf]": "margin trusted_margin unique far_unique trust_m moved_m still_m",
            "[1, inf)": "scans trial n_rivals n_far_rivals rival_particles workers",
            "[2, inf)": "window",
            "[0, inf)": "pause trusted_pause far_pause far_after",
            "(0, 3.15]": "reach_yaw",  # all headings are pi
            "(0, 1]": "still_share",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class Rivals:
    """Poses that may be right, each a small filter.

    Attributes
    ----------
    particles : array, shape (h, k, 3)
        Particles of each [m, m, rad].
    weights : array, shape (h, k)
        Their weights, which sum to one for each rival.
    scores : array, shape (h, t)
        Excess of the last scans, the latest last; NaN before the rival was found.
    """

    particles: np.ndarray
    weights: np.ndarray
    scores: np.ndarray

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def poses(self) -> np.ndarray:
        """Weighted means of the particles, shape (h, 3) [m, m, rad]."""
        yaws = np.arctan2(
            *(np.sum(self.weights * f(self.particles[..., 2]), axis=1) for f in (np.sin, np.cos))
        )
        return np.column_stack([np.einsum("hk,hkd->hd", self.weights, self.particles[..., :2]), yaws])

    @property
    def ages(self) -> np.ndarray:
        """Scans for which each was followed, shape (h,); not more than are kept."""
        return np.isfinite(self.scores).sum(axis=1)

    @property
    def means(self) -> np.ndarray:
        """Mean excess of each, shape (h,)."""
        return np.nansum(self.scores, axis=1) / np.maximum(self.ages, 1)

    def keep(self, chosen: np.ndarray) -> Rivals:
        """Give some of them, chosen by a mask or by numbers."""
        return Rivals(self.particles[chosen], self.weights[chosen], self.scores[chosen])


@dataclass(frozen=True)
class RecoveryUpdate:
    """One scan's estimate, and what the filter thinks of it.

    Attributes
    ----------
    filter : MclUpdate
        The filter's own update; its ``pose`` is the estimate.
    covariance : array, shape (3, 3)
        Of the estimate (x, y, yaw) in the map frame [m, rad].
    excess : float
        How much better than by chance the cloud fits at the estimate.
    health : float
        Its average over the last scans as a share of the level: about 1 where all is well.
    is_lost : bool
        The filter does not vouch for this estimate.
    n_rivals : int
        Rivals that are followed.
    n_particles : int
        Particles of the filter and of its rivals.
    was_replaced : bool
        A rival took over after this scan.
    """

    filter: MclUpdate
    covariance: np.ndarray
    excess: float
    health: float
    is_lost: bool
    n_rivals: int
    n_particles: int
    was_replaced: bool


def measure_level(clouds: Iterable[np.ndarray], poses: np.ndarray, grid: MapGrid) -> float:
    """Measure the median excess of clouds at poses that are known to be right.

    Parameters
    ----------
    clouds : iterable of array, shape (m, 2)
        Clouds in the radar frame [m], of a drive other than the one to be localized.
    poses : array, shape (n, 3)
        Their poses T_map_radar [m, m, rad].
    grid : MapGrid
        That of the filter.

    Returns
    -------
    level : float

    Raises
    ------
    ValueError
        If the clouds fit no better than by chance: wrong poses, or the wrong map.
    """
    from rol_beyond.search import measure_excess

    found = [measure_excess(pose[None], cloud, grid)[0] for cloud, pose in zip(clouds, poses, strict=True)]
    level = float(np.median(found)) if found else 0.0
    if level <= 0.0:
        raise ValueError(f"level: the clouds exceed chance by {level:.3f} at the poses given, so not at all")
    return level


@dataclass
class _State:
    """What is carried from scan to scan."""

    particles: np.ndarray
    weights: np.ndarray
    rivals: Rivals
    clouds: deque
    steps: deque
    scores: deque
    since_search: int = 10**6
    n_lost: int = 0
    is_far: bool = False
    is_trusted: bool = False
    moved_m: float = 0.0
    well_m: float = 0.0
    searched_m: float = 1e9
    coarse: MapGrid | None = None


def localize_with_recovery(
    steps: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    start: np.ndarray,
    settings: MclSettings,
    recovery: RecoverySettings,
    move: Move,
    rng: np.random.Generator,
    *,
    is_start_known: bool = True,
    grid: MapGrid | None = None,
) -> Iterator[RecoveryUpdate]:
    """Run the filter scan by scan, watch over it, and find the pose again where it was lost.

    Parameters
    ----------
    steps : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Cloud of each scan in the radar frame [m].
    map_points : array, shape (m, 2)
        Points of the map [m].
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad]; it may be wrong.
    settings : MclSettings
        Of the filter, see `rol.mcl.settings_for`.
    recovery : RecoverySettings
        See there.
    move : callable
        Moves particles by a step, such as `rol_beyond.motion.sample_motion` with a learnt model.
    rng : numpy.random.Generator
        Source of randomness.
    is_start_known : bool
        False: the start is no more than the middle of the ``far_m`` within which the car is, its heading unknown.
    grid : MapGrid, optional
        `rol.mcl.build_grid` of the map and the settings, if it is at hand.

    Yields
    ------
    result : RecoveryUpdate
        One per scan.

    Raises
    ------
    rol.mcl.MclError
        If there are fewer steps than clouds ask for, or an input is no cloud, no pose or no map.
    """
    from rol.mcl import MclError, build_grid, sample_particles, update

    grid = build_grid(map_points, settings) if grid is None else grid
    spreads = settings.start_spread_m, settings.start_spread_yaw_rad
    particles = sample_particles(start, settings.n_particles, *spreads, rng)
    state, steps = _begin(particles, recovery, is_start_known), iter(steps)
    calm = replace(settings, exponent=recovery.still_share * settings.exponent)
    for index, points in enumerate(clouds):
        step = np.zeros(3) if index == 0 else next(steps, None)
        if step is None:
            raise MclError(f"no odometry step to scan {index}: one fewer than clouds are needed")
        length = _move_all(state, step, move, rng) if index > 0 else np.inf
        used = settings if length > recovery.still_m else calm
        result = update(index, state.particles, state.weights, points, grid, used, rng)
        told, winner = _watch(state, result, points, grid, used, recovery, rng)
        yield told
        state.particles, state.weights = result.next_particles, result.next_weights
        if winner is not None:
            _enthrone(state, winner, settings, rng)
        elif told.health < recovery.doubt or state.is_far:
            _search(state, result.pose, map_points, grid, recovery, rng)
        else:
            state.rivals = state.rivals.keep(state.rivals.ages < recovery.trial)


def _move_all(state: _State, step: np.ndarray, move: Move, rng: np.random.Generator) -> float:
    """Move the filter's particles and those of its rivals, note how far the car went, and give it [m]."""
    state.particles = move(state.particles, step, rng)
    state.steps.append(move_mean(step, move))
    length = float(np.hypot(*state.steps[-1][:2]))
    state.moved_m += length
    state.well_m += length
    state.searched_m += length
    state.rivals = _move_rivals(state.rivals, step, move, rng)
    return length


def _watch(
    state: _State,
    result: MclUpdate,
    points: np.ndarray,
    grid: MapGrid,
    settings: MclSettings,
    recovery: RecoverySettings,
    rng: np.random.Generator,
) -> tuple[RecoveryUpdate, int | None]:
    """Hold the estimate against chance and against its rivals; say what to think of it, and which rival takes over."""
    from rol_beyond.search import measure_excess

    state.clouds.append(points[np.hypot(points[:, 0], points[:, 1]) < recovery.max_range_m])
    excess = float(measure_excess(result.pose[None], points, grid)[0])
    state.rivals, of_rivals = _weigh_rivals(state.rivals, points, grid, settings.exponent, rng)
    _note_excess(state, excess, of_rivals, recovery)
    state.rivals = _merge_rivals(state.rivals, result.pose)
    health = _health(state, recovery)
    state.is_far = (state.is_far and not state.is_trusted) or state.n_lost > recovery.far_after
    is_lost = state.is_far or health < recovery.lost or _best_rival(state, recovery) is not None
    winner, n_rivals = _decide(state, recovery), len(state.rivals)
    n_particles = len(result.particles) + state.rivals.weights.size
    covariance = covariance_of(result)
    told = RecoveryUpdate(
        result, covariance, excess, health, is_lost, n_rivals, n_particles, winner is not None
    )
    return told, winner


def move_mean(step: np.ndarray, move: Move) -> np.ndarray:
    """Give the mean motion of particles for a step of the odometry: that of many drawn with a fixed seed."""
    moved = move(np.zeros((256, 3)), step, np.random.default_rng(0))
    return np.median(moved, axis=0)


def covariance_of(result: MclUpdate) -> np.ndarray:
    """Give the covariance of an estimate: that of the weighted particles about it.

    Parameters
    ----------
    result : MclUpdate
        From `rol.mcl.update`.

    Returns
    -------
    covariance : array, shape (3, 3)
        Of (x, y, yaw) in the map frame [m, rad]; a centimetre and 0.05 deg at least, for particles may be all the same.
    """
    away = result.particles - result.pose
    away[:, 2] = wrap_angle(away[:, 2])
    return (away * result.weights[:, None]).T @ away + np.diag([1e-4, 1e-4, np.deg2rad(0.05) ** 2])


def _begin(particles: np.ndarray, recovery: RecoverySettings, is_start_known: bool) -> _State:
    n, k, t = len(particles), recovery.rival_particles, recovery.trial
    none = Rivals(np.zeros((0, k, 3)), np.zeros((0, k)), np.zeros((0, t)))
    window = deque(maxlen=recovery.window)
    return _State(
        particles, np.full(n, 1.0 / n), none, window, deque(maxlen=recovery.window - 1),
        deque(maxlen=max(recovery.scans, t)), is_far=not is_start_known,
    )  # fmt: skip


def _move_rivals(rivals: Rivals, step: np.ndarray, move: Move, rng: np.random.Generator) -> Rivals:
    """Move all particles of all rivals."""
    if not len(rivals):
        return rivals
    moved = move(rivals.particles.reshape(-1, 3), step, rng)
    return Rivals(moved.reshape(rivals.particles.shape), rivals.weights, rivals.scores)


def _weigh_rivals(
    rivals: Rivals, points: np.ndarray, grid: MapGrid, exponent: float, rng: np.random.Generator
) -> tuple[Rivals, np.ndarray]:
    """Weigh each rival's particles among themselves, resample where few hold all weight; give their excess, too."""
    from rol.mcl import count_matches, normalize_weights, resample_systematic, weigh
    from rol_beyond.search import measure_excess

    if not len(rivals) or not len(points):
        return rivals, np.zeros(len(rivals))
    h, k, _ = rivals.particles.shape
    sums = count_matches(rivals.particles.reshape(-1, 3), points, grid.values, grid.origin, grid.cell)
    logs = weigh(sums.reshape(h, k), exponent)
    weights = np.array([normalize_weights(*row)[0] for row in zip(logs, rivals.weights, strict=True)])
    weighed = Rivals(rivals.particles.copy(), weights, rivals.scores)
    excess = measure_excess(weighed.poses, points, grid)
    for i in np.flatnonzero(1.0 / np.sum(weights**2, axis=1) < 0.5 * k):
        weighed.particles[i] = weighed.particles[i, resample_systematic(weights[i], rng)]
        weights[i] = 1.0 / k
    return weighed, excess


def _note_excess(state: _State, own: float, of_rivals: np.ndarray, recovery: RecoverySettings) -> None:
    """Count a scan for and against the estimate and its rivals, unless it is trusted and the car has hardly moved."""
    state.since_search += 1
    if state.is_trusted and state.moved_m < recovery.moved_m:
        return
    state.moved_m = 0.0
    state.scores.append(own)
    scores = np.column_stack([state.rivals.scores[:, 1:], of_rivals])
    state.rivals = Rivals(state.rivals.particles, state.rivals.weights, scores)
    health = _health(state, recovery)
    if len(state.scores) < recovery.scans or health < recovery.doubt:
        state.well_m = 0.0
    state.is_trusted = state.is_trusted or state.well_m > recovery.trust_m
    state.n_lost = state.n_lost + 1 if health < recovery.lost else 0


def _health(state: _State, recovery: RecoverySettings) -> float:
    """Mean excess of the last scans that counted, as a share of the level."""
    return float(np.mean(list(state.scores)[-recovery.scans :])) / recovery.level


def _merge_rivals(rivals: Rivals, pose: np.ndarray) -> Rivals:
    """Drop rivals that have come to where the estimate or a better rival is."""
    from rol_beyond.search import keep_apart

    if not len(rivals):
        return rivals
    known, worth = np.vstack([pose[None], rivals.poses]), np.append(np.inf, rivals.means)
    kept = keep_apart(known, np.argsort(-worth, kind="stable"), len(known), (1.0, np.deg2rad(3.0)))
    return rivals.keep(np.array(sorted(kept)[1:], dtype=int) - 1)


def _best_rival(state: _State, recovery: RecoverySettings) -> int | None:
    """Number of the best rival that has been followed for a third of a trial and fits better than the estimate."""
    if not len(state.rivals):
        return None
    lead = _leads(state)
    lead[state.rivals.ages < recovery.trial // 3] = -np.inf
    best = int(np.argmax(lead))
    return best if lead[best] > 0.0 else None


def _leads(state: _State) -> np.ndarray:
    """By how much each rival fits better than the estimate, on average over the scans that it was followed."""
    own = np.array(state.scores)[-state.rivals.scores.shape[1] :]
    own = np.concatenate([np.full(state.rivals.scores.shape[1] - len(own), np.nan), own])
    gaps = state.rivals.scores - own
    return np.nansum(gaps, axis=1) / np.maximum(np.isfinite(gaps).sum(axis=1), 1)


def _decide(state: _State, recovery: RecoverySettings) -> int | None:
    """Number of the rival that takes over, if any: followed long enough, plainly better, and itself in good health."""
    best = _best_rival(state, recovery)
    if best is None or state.rivals.ages[best] < recovery.trial:
        return None
    means, lead = state.rivals.means, _leads(state)
    ripe = np.flatnonzero(state.rivals.ages >= recovery.trial)
    order = ripe[np.argsort(-means[ripe], kind="stable")]
    best, others = int(order[0]), means[order[1:]]
    margin = recovery.trusted_margin if state.is_trusted else recovery.margin
    unique = recovery.far_unique if state.is_far else recovery.unique
    is_better = lead[best] > margin * recovery.level
    is_unique = len(others) == 0 or means[best] - others[0] > unique * recovery.level
    return best if is_better and is_unique and means[best] > recovery.lost * recovery.level else None


def _enthrone(state: _State, winner: int, settings: MclSettings, rng: np.random.Generator) -> None:
    """Let a rival's particles be the filter's, and its scores too."""
    n = max(settings.min_particles, state.rivals.particles.shape[1])
    chosen = rng.choice(state.rivals.particles.shape[1], n, p=state.rivals.weights[winner])
    state.particles, state.weights = state.rivals.particles[winner, chosen], np.full(n, 1.0 / n)
    state.scores.extend(state.rivals.scores[winner].tolist())
    state.rivals = state.rivals.keep(np.zeros(len(state.rivals), dtype=bool))
    state.is_far, state.is_trusted, state.n_lost, state.well_m = False, False, 0, 0.0


def _search(
    state: _State,
    pose: np.ndarray,
    map_points: np.ndarray,
    grid: MapGrid,
    recovery: RecoverySettings,
    rng: np.random.Generator,
) -> None:
    """Search for rivals, if it is time, and follow the new ones beside the best of the old."""
    from rol.mcl import build_distance_grid
    from rol_beyond.search import drop_riders, join_clouds, search_poses

    pause = recovery.trusted_pause if state.is_trusted else recovery.pause
    pause = recovery.far_pause if state.is_far else pause
    if state.since_search < pause or len(state.clouds) < recovery.scans:
        return
    if state.is_far and state.searched_m < recovery.moved_m * recovery.scans:
        return
    state.since_search, state.searched_m = 0, 0.0
    clouds, steps = _last_stretch(state, recovery)
    points = first_of_cells(join_clouds(drop_riders(clouds, steps), steps), grid.cell)
    n = recovery.n_far_rivals if state.is_far else recovery.n_rivals
    if state.is_far:
        how = {"reach_m": recovery.far_m, "yaw_step": np.deg2rad(2.0), "n_looked_at": 9000, "n_best": n}
        if state.coarse is None:
            state.coarse = build_distance_grid(map_points, 0.45, 1.0)  # a wide Gaussian for wide cells
        found, _ = search_poses(points, state.coarse, grid, pose, workers=recovery.workers, **how)
    else:
        how = {"reach_m": recovery.reach_m, "reach_yaw": recovery.reach_yaw, "n_best": n}
        found, _ = search_poses(points, grid, grid, pose, workers=recovery.workers, **how)
    state.rivals = _add_rivals(state.rivals, found, pose, n, recovery, rng)


def _last_stretch(state: _State, recovery: RecoverySettings) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Clouds of the last metres, two seconds at least, and the steps between them."""
    steps = list(state.steps)[-(len(state.clouds) - 1) :]
    way = np.cumsum([np.hypot(step[0], step[1]) for step in steps[::-1]])
    n = max(int(np.searchsorted(way, recovery.window_m)) + 1, recovery.scans)
    return list(state.clouds)[-n:], steps[len(steps) - n + 1 :] if n <= len(steps) else steps


def _add_rivals(
    rivals: Rivals,
    found: np.ndarray,
    pose: np.ndarray,
    n: int,
    recovery: RecoverySettings,
    rng: np.random.Generator,
) -> Rivals:
    """Add poses that are neither the estimate nor a rival already, and drop the worst of those that had their trial."""
    known = np.vstack([pose[None], rivals.poses])
    away = np.abs(found[:, None] - known[None])
    away[..., 2] = np.abs(wrap_angle(away[..., 2]))
    is_new = ~((away[..., :2] < 1.5).all(axis=-1) & (away[..., 2] < np.deg2rad(4.0))).any(axis=1)
    fresh = check_poses(found[is_new], "found poses")
    k, t = recovery.rival_particles, recovery.trial
    particles = fresh[:, None] + rng.standard_normal((len(fresh), k, 3)) * (0.3, 0.3, np.deg2rad(0.7))
    added = Rivals(particles, np.full((len(fresh), k), 1.0 / k), np.full((len(fresh), t), np.nan))
    order = np.argsort(-rivals.means, kind="stable")
    old = rivals.keep(order[: max(n // 2, n - len(fresh))])
    return Rivals(*(np.concatenate([getattr(old, name), getattr(added, name)[: n - len(old)]])
                    for name in ("particles", "weights", "scores")))  # fmt: skip
