"""Localization that detects and reports when it is lost, and relocalizes without manual resets.

Two tests are made with every scan. First, does the scan match better at the estimate than by chance? The
score contrast (`rol_beyond.search.score_contrast`), averaged over two seconds, is normalized by its value at
correct poses. Second, does it match better elsewhere? When the normalized score is low, poses around the
estimate are searched with the scans of the last seconds. Each good one becomes a hypothesis, a small particle
filter of its own. A hypothesis that matches better than the estimate over several scans, none of which was
used to find it, replaces the estimate.

A wrong place may match for seconds, as streets repeat themselves, so no decision is based on one scan. A
stationary vehicle observes the same false points again and again. So once an estimate is trusted, only scans
taken while moving count against it.

Off the map no point matches, and the odometry alone would move the estimate away without end. The estimate is
held at the distance from the map's extent at which the radar still sees the map, and the filter reports that
it is lost. The particles go on by odometry, so a vehicle that leaves the map and returns needs no search. The
paper's filter has no such limit: when it is lost, its evaluation counts a failure and resets it
(`rol.evaluation.FailureMonitor`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from rol.geometry import check_fields, check_pose, check_poses, first_of_cells, wrap_angle
from rol.mcl import (
    MapGrid,
    MclSettings,
    MclUpdate,
    ParticleFilter,
    count_matches,
    log_weights,
    normalize_weights,
    predict,
    update,
)
from rol_beyond.likelihood_field import build_likelihood_field
from rol_beyond.motion import MotionModel
from rol_beyond.resampling import resample_systematic
from rol_beyond.search import (
    SearchSettings,
    merge_clouds,
    remove_ego_static_points,
    score_contrast,
    search_poses,
    suppress_neighbours,
)


@dataclass(frozen=True)
class DetectionSettings:
    """Thresholds on the normalized score of the estimate.

    Attributes
    ----------
    search_below, lost_below : float
        Normalized scores below which hypotheses are searched, and below which the filter reports that it is
        lost. At correct poses on the real route 5 % of the averages over two seconds are below 0.6 and 1 %
        below 0.3; 20 m and 20 deg off, 95 % are below 0.2. Minus infinity switches a test off.
    n_scans : int
        Scans averaged. 8: two seconds.
    trust_m : float
        After this distance with a high score an estimate is trusted, until a hypothesis replaces it [m].
    moved_m : float
        A scan counts, for a trusted estimate, when the vehicle has moved this far since the last one that did
        [m].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    search_below: float = 0.5
    lost_below: float = 0.35
    n_scans: int = 8
    trust_m: float = 4.0
    moved_m: float = 0.5

    def __post_init__(self) -> None:
        allowed = {
            "[-inf, 1]": "search_below lost_below",
            "[1, inf)": "n_scans",
            "[0, inf]": "trust_m moved_m",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class RelocalizationSettings:
    """Window and schedule of the searches for hypotheses.

    Attributes
    ----------
    n_clouds, length_m : int, float
        Scans merged for a search, and the distance over which they may extend [m]. 16: in four seconds the
        odometry drifts by less than one degree.
    max_range_m : float
        Points farther away are left out, as the heading is too uncertain for them [m].
    pause, trusted_pause, far_pause : int
        Scans between two searches: near, near while the estimate is trusted, and far. They are longer for a
        window that takes longer to search, see `shortest_pause`.
    reach_m, reach_yaw : float
        Half the extent of the near search around the estimate [m, rad].
    far_after : int
        After this number of scans in a row with a score below ``lost_below`` the search is far, until an
        estimate is trusted. 120: half a minute.
    far_reach_m : float
        Half the extent of the far search, in all headings [m].
    workers : int
        Threads of a search.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    n_clouds: int = 16
    length_m: float = 20.0
    max_range_m: float = 40.0
    pause: int = 2
    trusted_pause: int = 12
    far_pause: int = 20
    reach_m: float = 30.0
    reach_yaw: float = float(np.deg2rad(30.0))
    far_after: int = 120
    far_reach_m: float = 300.0
    workers: int = 1

    def __post_init__(self) -> None:
        allowed = {
            "[2, inf)": "n_clouds",
            "(0, inf)": "length_m reach_m far_reach_m",
            "(0, inf]": "max_range_m",
            "[0, inf)": "pause trusted_pause far_pause far_after",
            "(0, 3.15]": "reach_yaw",
            "[1, inf)": "workers",
        }
        check_fields(self, allowed)


def shortest_pause(settings: RelocalizationSettings, is_far: bool) -> int:
    """Compute the number of scans between two searches at which a lost filter stays faster than the radar.

    The cost of a search grows with the area that its window and the cloud cover, and with the number of
    headings; a far search also refines a fixed number of poses. It is computed from the settings and not
    measured while the filter runs, so the same scans always give the same estimates.

    Parameters
    ----------
    settings : RelocalizationSettings
        Windows.
    is_far : bool
        Whether the far search is meant.

    Returns
    -------
    pause : int
        2 scans for the near window of 30 m and 30 deg, and 16 for the far one of 300 m.

    Notes
    -----
    Measured on one core of a virtual machine with two: a near search takes 0.21 s, a far one 2.5 s, and
    following 73 hypotheses 0.04 s per second of data. With the default pauses, 2 and 20 scans, a lost filter
    needs about half a second per second of data. As a far search takes as long as ten scans, an application
    has to keep the scans that arrive meanwhile.
    """
    range_m = min(settings.max_range_m, 64.0) + settings.length_m
    if is_far:
        return int(np.ceil(8.0 + 8.0 * ((settings.far_reach_m + range_m) / 360.0) ** 2))
    n_headings = settings.reach_yaw / np.deg2rad(30.0)
    return int(np.ceil(2.0 * ((settings.reach_m + range_m) / 90.0) ** 2 * n_headings - 1e-9))


@dataclass(frozen=True)
class ConfirmationSettings:
    """Hypotheses, and the tests that one passes before it replaces the estimate.

    Attributes
    ----------
    n_scans : int
        Scans over which a hypothesis is followed first. 12: three seconds.
    margin, trusted_margin : float
        Fraction of the reference contrast by which it must match better than the estimate, on average over
        these scans; the second value for a trusted estimate.
    uniqueness, far_uniqueness : float
        Fraction by which it must match better than every other hypothesis: in a repetitive street there is no
        decision yet. The second value for far hypotheses, of which there are many more.
    n_hypotheses, n_far_hypotheses : int
        Largest number of hypotheses, near and far.
    n_particles : int
        Particles of each.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    n_scans: int = 12
    margin: float = 0.25
    trusted_margin: float = 0.5
    uniqueness: float = 0.1
    far_uniqueness: float = 0.25
    n_hypotheses: int = 20
    n_far_hypotheses: int = 100
    n_particles: int = 50

    def __post_init__(self) -> None:
        allowed = {
            "[1, inf)": "n_scans n_hypotheses n_far_hypotheses n_particles",
            "[0, inf]": "margin trusted_margin uniqueness far_uniqueness",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class RecoverySettings:
    """Settings of `RecoveringFilter`.

    Attributes
    ----------
    reference_contrast : float
        Median score contrast of a scan at its correct pose, see `measure_reference_contrast`.
    stationary_m : float
        An increment shorter than this is that of a stationary vehicle [m].
    stationary_weight : float
        Factor on the exponent of Eq. 8 for a stationary vehicle, whose scans show the same false points again
        and again and are not independent.
    max_outside_m : float
        Largest distance of the estimate from the map's extent, in x and in y [m]. 64: the range of the radar.
    detection, relocalization, confirmation
        See their classes.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    reference_contrast: float
    stationary_m: float = 0.05
    stationary_weight: float = 0.25
    max_outside_m: float = 64.0
    detection: DetectionSettings = field(default_factory=DetectionSettings)
    relocalization: RelocalizationSettings = field(default_factory=RelocalizationSettings)
    confirmation: ConfirmationSettings = field(default_factory=ConfirmationSettings)

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "reference_contrast",
            "[0, inf]": "stationary_m max_outside_m",
            "(0, 1]": "stationary_weight",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class Hypotheses:
    """Alternative poses, each a small particle filter.

    Attributes
    ----------
    particles : array, shape (h, k, 3)
        Particles of each [m, m, rad].
    weights : array, shape (h, k)
        Their weights, which sum to one for each hypothesis.
    scores : array, shape (h, t)
        Score contrast of the last scans, the latest last; NaN before the hypothesis was found.
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
        """Scans for which each was followed, shape (h,); at most as many as scores are kept."""
        return np.isfinite(self.scores).sum(axis=1)

    @property
    def means(self) -> np.ndarray:
        """Mean score contrast of each, shape (h,)."""
        return np.nansum(self.scores, axis=1) / np.maximum(self.ages, 1)

    def keep(self, chosen: np.ndarray) -> Hypotheses:
        """Select some of them by a mask or by indices."""
        return Hypotheses(self.particles[chosen], self.weights[chosen], self.scores[chosen])

    def predict(self, increment: np.ndarray, motion: MotionModel, rng: np.random.Generator) -> Hypotheses:
        """Move all particles by an odometry increment (Eq. 7)."""
        if not len(self):
            return self
        moved = predict(self.particles.reshape(-1, 3), increment, motion, rng)
        return replace(self, particles=moved.reshape(self.particles.shape))

    def update(
        self, points: np.ndarray, grid: MapGrid, exponent: float, rng: np.random.Generator
    ) -> tuple[Hypotheses, np.ndarray]:
        """Weight and resample the particles of each by one scan; also return the score contrasts (h,)."""
        if not len(self) or not len(points):
            return self, np.zeros(len(self))
        h, k, _ = self.particles.shape
        sums = count_matches(self.particles.reshape(-1, 3), points, grid)
        logs = log_weights(sums.reshape(h, k), exponent)
        weights = np.array([normalize_weights(*row)[0] for row in zip(logs, self.weights, strict=True)])
        updated = Hypotheses(self.particles.copy(), weights, self.scores)
        contrasts = score_contrast(updated.poses, points, grid)
        for i in np.flatnonzero(1.0 / np.sum(weights**2, axis=1) < 0.5 * k):
            updated.particles[i] = updated.particles[i, resample_systematic(weights[i], rng)]
            weights[i] = 1.0 / k
        return updated, contrasts

    def record(self, contrasts: np.ndarray) -> Hypotheses:
        """Append the score contrasts of one scan, shape (h,)."""
        return replace(self, scores=np.column_stack([self.scores[:, 1:], contrasts]))

    def without_duplicates(self, pose: np.ndarray) -> Hypotheses:
        """Remove hypotheses that have converged to the estimate or to a better hypothesis."""
        if not len(self):
            return self
        known, rank = np.vstack([pose[None], self.poses]), np.append(np.inf, self.means)
        order = np.argsort(-rank, kind="stable")
        kept = suppress_neighbours(known, order, len(known), (1.0, np.deg2rad(3.0)))
        return self.keep(np.array(sorted(kept)[1:], dtype=int) - 1)

    def add(self, found: np.ndarray, pose: np.ndarray, n: int, rng: np.random.Generator) -> Hypotheses:
        """Add new poses, up to n in all, in place of the worst; not the estimate, nor known hypotheses."""
        known = np.vstack([pose[None], self.poses])
        away = np.abs(found[:, None] - known[None])
        away[..., 2] = np.abs(wrap_angle(away[..., 2]))
        is_new = ~((away[..., :2] < 1.5).all(axis=-1) & (away[..., 2] < np.deg2rad(4.0))).any(axis=1)
        fresh = check_poses(found[is_new], "found poses")
        k, t = self.particles.shape[1], self.scores.shape[1]
        spread = 0.3, 0.3, np.deg2rad(0.7)
        particles = fresh[:, None] + rng.standard_normal((len(fresh), k, 3)) * spread
        weights, scores = np.full((len(fresh), k), 1.0 / k), np.full((len(fresh), t), np.nan)
        old = self.keep(np.argsort(-self.means, kind="stable")[: max(n // 2, n - len(fresh))])
        pairs = (old.particles, particles), (old.weights, weights), (old.scores, scores)
        return Hypotheses(*(np.concatenate([a, b[: n - len(old)]]) for a, b in pairs))


def no_hypotheses(settings: ConfirmationSettings) -> Hypotheses:
    """Create an empty set of hypotheses."""
    k, t = settings.n_particles, settings.n_scans
    return Hypotheses(np.zeros((0, k, 3)), np.zeros((0, k)), np.zeros((0, t)))


@dataclass(frozen=True)
class RecoveryUpdate:
    """Estimate after one scan, with its assessment.

    Attributes
    ----------
    filter : MclUpdate
        The particle filter's update.
    score_contrast : float
        Score contrast of the scan at the estimate.
    normalized_score : float
        Its average over the last scans, divided by the reference contrast: about 1 at a correct pose.
    is_lost : bool
        The filter reports that the estimate may be wrong.
    n_hypotheses : int
        Hypotheses followed.
    n_particles : int
        Particles of the filter and of the hypotheses.
    was_replaced : bool
        A hypothesis replaces the estimate after this scan.
    """

    filter: MclUpdate
    score_contrast: float
    normalized_score: float
    is_lost: bool
    n_hypotheses: int
    n_particles: int
    was_replaced: bool

    @property
    def pose(self) -> np.ndarray:
        """Estimate T_map_radar, shape (3,) [m, m, rad]."""
        return self.filter.pose

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of (x, y, yaw), shape (3, 3) [m, m, rad]."""
        return self.filter.covariance


def measure_reference_contrast(clouds: Iterable[np.ndarray], poses: np.ndarray, grid: MapGrid) -> float:
    """Measure the median score contrast of scans at correct poses.

    Parameters
    ----------
    clouds : iterable of array, shape (m, 2)
        Scans of another session than the one to be localized, in the radar frame [m].
    poses : array, shape (n, 3)
        Their poses T_map_radar [m, m, rad].
    grid : MapGrid
        That of the filter.

    Returns
    -------
    reference_contrast : float

    Raises
    ------
    ValueError
        If the scans match no better than by chance: wrong poses, or the wrong map.
    """
    pairs = zip(clouds, check_poses(poses), strict=True)
    found = [score_contrast(check_pose(pose, "poses")[None], cloud, grid)[0] for cloud, pose in pairs]
    median = float(np.median(found)) if found else 0.0
    if median <= 0.0:
        raise ValueError(
            f"reference contrast: {median:.3f} at the given poses; the scans match by chance only"
        )
    return median


class RecoveringFilter(ParticleFilter):
    """Particle filter with failure detection and relocalization, given one scan at a time.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad]; it may be wrong.
    settings : MclSettings
        Of the filter, such as ``rol_beyond.robust.settings_for("robust", motion=MotionModel())``. The motion
        may be a `MotionModel`, and the resampling a `KldResampling`.
    recovery : RecoverySettings
        Detection, search and confirmation.
    rng : numpy.random.Generator
        Random generator.
    is_start_known : bool
        False: the start is only the centre of the ``far_reach_m`` in which the vehicle is, its heading
        unknown.
    grid : MapGrid, optional
        ``settings.measurement.build_grid(map_points)``, if it is available.
    """

    def __init__(
        self,
        map_points: np.ndarray,
        start: np.ndarray,
        settings: MclSettings,
        recovery: RecoverySettings,
        rng: np.random.Generator,
        is_start_known: bool = True,
        grid: MapGrid | None = None,
    ) -> None:
        self.map_points, self.recovery = map_points, recovery
        self.coarse_grid: MapGrid | None = None
        exponent = recovery.stationary_weight * settings.measurement.exponent
        self.stationary = replace(settings, measurement=replace(settings.measurement, exponent=exponent))
        grid = settings.measurement.build_grid(map_points) if grid is None else grid
        low, high = map_points.min(axis=0), map_points.max(axis=0)
        self.bounds = low - recovery.max_outside_m, high + recovery.max_outside_m
        super().__init__(grid, start, settings, rng)
        self.is_far = not is_start_known

    def reset(self, pose: np.ndarray) -> None:
        """Start again at a pose [m, m, rad]."""
        super().reset(pose)
        recovery = self.recovery
        self.hypotheses = no_hypotheses(recovery.confirmation)
        n_clouds = recovery.relocalization.n_clouds
        self.clouds, self.increments = deque(maxlen=n_clouds), deque(maxlen=n_clouds - 1)
        self.scores = deque(maxlen=max(recovery.detection.n_scans, recovery.confirmation.n_scans))
        self.is_far, self.is_trusted, self.is_held, self.n_lost = False, False, False, 0
        # Scans since the last search; distances since the last search, the last scan that counted, a low
        # score.
        self.since_search, self.searched_m, self.moved_m, self.high_score_m = 10**6, 1e9, 0.0, 0.0

    def step(self, points: np.ndarray, increment: np.ndarray | None = None) -> RecoveryUpdate:
        """Process one scan.

        Parameters
        ----------
        points : array, shape (m, 2)
            Points of the scan in the radar frame [m].
        increment : array-like, shape (3,), optional
            Pose of this scan in the last one [m, m, rad]; none for the first scan.

        Returns
        -------
        result : RecoveryUpdate
        """
        length = np.inf if increment is None else self._predict(increment)
        settings = self.settings if length > self.recovery.stationary_m else self.stationary
        result = self._hold(update(self.particles, self.weights, points, self.grid, settings, self.rng))
        contrast = self._observe(result, points, settings.measurement.exponent)
        winner = self._find_winner()
        assessed = self._assess(result, contrast, winner)
        self.particles, self.weights = result.next_particles, result.next_weights
        if winner is not None:
            self._promote(winner)
        elif self.is_far or assessed.normalized_score < self.recovery.detection.search_below:
            self._search(result.pose)
        else:
            is_young = self.hypotheses.ages < self.recovery.confirmation.n_scans
            self.hypotheses = self.hypotheses.keep(is_young)
        return assessed

    def _predict(self, increment: np.ndarray) -> float:
        """Move all particles, record the motion, and return its length [m]."""
        motion = self.settings.motion
        self.particles = predict(self.particles, increment, motion, self.rng)
        self.increments.append(mean_increment(increment, motion))
        length = float(np.hypot(*self.increments[-1][:2]))
        self.moved_m += length
        self.high_score_m += length
        self.searched_m += length
        self.hypotheses = self.hypotheses.predict(increment, motion, self.rng)
        return length

    def _hold(self, result: MclUpdate) -> MclUpdate:
        """Move an estimate far outside the map to the nearest position within the bounds."""
        position = np.clip(result.pose[:2], *self.bounds)
        self.is_held = not np.array_equal(position, result.pose[:2])
        return replace(result, pose=np.append(position, result.pose[2])) if self.is_held else result

    def _observe(self, result: MclUpdate, points: np.ndarray, exponent: float) -> float:
        """Record the scan and the score contrasts of the estimate and of the hypotheses."""
        max_range_m = self.recovery.relocalization.max_range_m
        self.clouds.append(points[np.hypot(points[:, 0], points[:, 1]) < max_range_m])
        contrast = float(score_contrast(result.pose[None], points, self.grid)[0])
        self.hypotheses, contrasts = self.hypotheses.update(points, self.grid, exponent, self.rng)
        self.since_search += 1
        if not self.is_trusted or self.moved_m >= self.recovery.detection.moved_m:
            self._record(contrast, contrasts)
        self.hypotheses = self.hypotheses.without_duplicates(result.pose)
        return contrast

    def _record(self, contrast: float, of_hypotheses: np.ndarray) -> None:
        """Let a scan count for or against the estimate and the hypotheses."""
        detection, self.moved_m = self.recovery.detection, 0.0
        self.scores.append(contrast)
        self.hypotheses = self.hypotheses.record(of_hypotheses)
        score = self.normalized_score
        if len(self.scores) < detection.n_scans or score < detection.search_below:
            self.high_score_m = 0.0
        self.is_trusted = self.is_trusted or self.high_score_m > detection.trust_m
        self.n_lost = self.n_lost + 1 if score < detection.lost_below else 0
        is_lost_for_long = self.n_lost > self.recovery.relocalization.far_after
        self.is_far = (self.is_far and not self.is_trusted) or is_lost_for_long

    @property
    def normalized_score(self) -> float:
        """Mean score contrast of the last scans that counted, divided by the reference contrast."""
        last = list(self.scores)[-self.recovery.detection.n_scans :]
        return float(np.mean(last)) / self.recovery.reference_contrast

    def _assess(self, result: MclUpdate, contrast: float, winner: int | None) -> RecoveryUpdate:
        """Assess the estimate."""
        is_low = self.normalized_score < self.recovery.detection.lost_below
        return RecoveryUpdate(
            filter=result,
            score_contrast=contrast,
            normalized_score=self.normalized_score,
            is_lost=self.is_far or self.is_held or is_low or self._find_leader() is not None,
            n_hypotheses=len(self.hypotheses),
            n_particles=len(result.particles) + self.hypotheses.weights.size,
            was_replaced=winner is not None,
        )

    def _leads(self) -> np.ndarray:
        """Compute by how much each hypothesis matches better than the estimate, on average, shape (h,)."""
        n_scans = self.hypotheses.scores.shape[1]
        own = np.array(self.scores)[-n_scans:]
        gaps = self.hypotheses.scores - np.concatenate([np.full(n_scans - len(own), np.nan), own])
        return np.nansum(gaps, axis=1) / np.maximum(np.isfinite(gaps).sum(axis=1), 1)

    def _find_leader(self) -> int | None:
        """Find the best hypothesis followed for a third of the scans that beats the estimate, if any."""
        if not len(self.hypotheses):
            return None
        leads = self._leads()
        leads[self.hypotheses.ages < self.recovery.confirmation.n_scans // 3] = -np.inf
        best = int(np.argmax(leads))
        return best if leads[best] > 0.0 else None

    def _find_winner(self) -> int | None:
        """Find the hypothesis that replaces the estimate: confirmed, better, unique, with a high score."""
        limits, leader = self.recovery.confirmation, self._find_leader()
        if leader is None or self.hypotheses.ages[leader] < limits.n_scans:
            return None
        means, reference = self.hypotheses.means, self.recovery.reference_contrast
        confirmed = np.flatnonzero(self.hypotheses.ages >= limits.n_scans)
        order = confirmed[np.argsort(-means[confirmed], kind="stable")]
        best, others = int(order[0]), means[order[1:]]
        margin = limits.trusted_margin if self.is_trusted else limits.margin
        uniqueness = limits.far_uniqueness if self.is_far else limits.uniqueness
        is_better = self._leads()[best] > margin * reference
        is_unique = len(others) == 0 or means[best] - others[0] > uniqueness * reference
        is_high = means[best] > self.recovery.detection.lost_below * reference
        return best if is_better and is_unique and is_high else None

    def _promote(self, winner: int) -> None:
        """Replace the filter's particles and scores by those of a hypothesis."""
        particles, weights = self.hypotheses.particles[winner], self.hypotheses.weights[winner]
        n = max(getattr(self.settings.resampling, "min_particles", 0), len(particles))
        chosen = self.rng.choice(len(particles), n, p=weights)
        self.particles, self.weights = particles[chosen], np.full(n, 1.0 / n)
        self.scores.extend(self.hypotheses.scores[winner].tolist())
        self.hypotheses = no_hypotheses(self.recovery.confirmation)
        self.is_far, self.is_trusted, self.n_lost, self.high_score_m = False, False, 0, 0.0

    def _is_search_due(self) -> bool:
        """Check pause and number of scans since the last search, and the distance before a far search."""
        settings, detection = self.recovery.relocalization, self.recovery.detection
        pause = settings.trusted_pause if self.is_trusted else settings.pause
        pause = settings.far_pause if self.is_far else pause
        pause = max(pause, shortest_pause(settings, self.is_far))
        if self.since_search < pause or len(self.clouds) < detection.n_scans:
            return False
        return not self.is_far or self.searched_m >= detection.moved_m * detection.n_scans

    def _search(self, pose: np.ndarray) -> None:
        """Search for hypotheses if a search is due, and follow the new ones beside the best of the old."""
        if not self._is_search_due():
            return
        self.since_search, self.searched_m = 0, 0.0
        clouds, increments = self._last_clouds()
        clouds = remove_ego_static_points(clouds, increments)
        points = first_of_cells(merge_clouds(clouds, increments), self.grid.cell)
        settings, confirmation = self.recovery.relocalization, self.recovery.confirmation
        if self.is_far:
            n, coarse = confirmation.n_far_hypotheses, self._build_coarse_grid()
            window = {"reach_m": settings.far_reach_m, "yaw_step": np.deg2rad(2.0), "n_refined": 9000}
        else:
            n, coarse = confirmation.n_hypotheses, self.grid
            window = {"reach_m": settings.reach_m, "reach_yaw": settings.reach_yaw}
        window = SearchSettings(**window, n_best=n, workers=settings.workers)
        found, _ = search_poses(points, coarse, self.grid, pose, window)
        self.hypotheses = self.hypotheses.add(found, pose, n, self.rng)

    def _build_coarse_grid(self) -> MapGrid:
        """Build, once, the likelihood field of the far search: a wide Gaussian on wide cells."""
        if self.coarse_grid is None:
            self.coarse_grid = build_likelihood_field(self.map_points, 0.45, 1.0)
        return self.coarse_grid

    def _last_clouds(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the scans of the last metres, two seconds at least, and the increments between them."""
        increments = list(self.increments)[-(len(self.clouds) - 1) :]
        driven = np.cumsum([np.hypot(step[0], step[1]) for step in increments[::-1]])
        length_m = self.recovery.relocalization.length_m
        n = max(int(np.searchsorted(driven, length_m)) + 1, self.recovery.detection.n_scans)
        is_cut = n <= len(increments)
        return list(self.clouds)[-n:], increments[len(increments) - n + 1 :] if is_cut else increments


def mean_increment(increment: np.ndarray, motion: MotionModel) -> np.ndarray:
    """Compute the median of 256 sampled increments, with a fixed seed.

    Parameters
    ----------
    increment : array, shape (3,)
        Odometry [m, m, rad].
    motion : MotionModel
        Its distribution.

    Returns
    -------
    increment : array, shape (3,)
        Typical increment [m, m, rad].

    Notes
    -----
    ``motion.mean`` is exact. It differs from this by 12 mm and 5 mm (RMS, forward and left) and changes the
    RMSE over 1,500 scans of the real route by up to 1.4 mm, so the reference results would have to be
    renewed.
    """
    return np.median(predict(np.zeros((256, 3)), increment, motion, np.random.default_rng(0)), axis=0)
