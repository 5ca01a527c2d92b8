"""Local-map odometry: register each scan to a map of the last metres, with motion compensation.

Beyond the paper, which registers each scan to the one before (`rol.odometry.scan_to_scan_icp`). The points of
a scan are compensated for the vehicle's motion during the turn of the radar and for the Doppler effect, with
the velocity that the registration itself yields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rol.compiled import compiled
from rol.geometry import (
    check_fields,
    check_points,
    check_pose,
    compose,
    exp,
    log,
    relative_pose,
    transform_points,
    wrap_angle,
)
from rol.odometry import (
    IcpResult,
    OdometryError,
    SortedCloud,
    cell_index,
    choose_evenly,
    pair_points,
    sort_cloud,
)
from rol.radar import ScanMotion, compensate_points
from rol_beyond.scan_matching import correlative_scan_match

_FIRST_WINDOW = (6.0, 0.8, np.deg2rad(4.0))  # search window for the first motion [m, m, rad]
_WINDOW = (2.0, 0.8, np.deg2rad(8.0))  # for a later motion over up to half a second [m, m, rad]


@dataclass(frozen=True)
class MapSettings:
    """Settings of the local map.

    Attributes
    ----------
    length_m : float
        Keyframes farther from the vehicle than this are removed [m]. 20: 10 to 80 m drift alike, and a short
        map is fast.
    keyframe_m, keyframe_rad : float
        A keyframe is added after this distance or rotation since the last one [m, rad].
    cell_m : float
        The map has one point, the mean, per cell of this side [m]. 0.5: two pixels of an image.
    min_views : int
        Cells seen by fewer keyframes are left out once there are three keyframes: false points rarely fall
        twice onto one place. With half of all points false, 1 drifts four times as much as 2.
    line_radius_m, line_ratio : float
        A map point lies on a line when the variance of its neighbours within the radius [m] across their main
        direction is less than this fraction of the variance along it.
    along_weight : float
        Weight of a squared distance along such a line, relative to one across it. 0.05: with 1, point to
        point, the longitudinal errors are a quarter larger.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    length_m: float = 20.0
    keyframe_m: float = 1.0
    keyframe_rad: float = 0.05
    cell_m: float = 0.5
    min_views: int = 2
    line_radius_m: float = 1.5
    line_ratio: float = 0.1
    along_weight: float = 0.05

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "length_m cell_m line_radius_m",
            "[0, inf)": "keyframe_m keyframe_rad line_ratio along_weight",
            "[1, inf)": "min_views",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class RobustIcpSettings:
    """Settings of `register_robust`.

    Attributes
    ----------
    start_scale_m, end_scale_m : float
        Distance at which a pair has a quarter of the full weight; it falls from the first value to the second
        by a fifth per fit [m].
    max_iterations : int
        Largest number of fits.
    tolerance : float
        Stop when the scale has reached ``end_scale_m`` and a fit moves less than this [m, and rad at 30 m].
    min_matched : int
        With fewer pairs the registration stops and ``converged`` is False.
    max_points : int
        Of a larger source this many points are used, evenly spaced.
    rounds : int
        Registrations per scan, each with the points compensated for the velocity that the one before found.
        2: with 1 the drift is twice as large, and a third changes nothing.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    start_scale_m: float = 2.0
    end_scale_m: float = 0.5
    max_iterations: int = 30
    tolerance: float = 1e-3
    min_matched: int = 10
    max_points: int = 1000
    rounds: int = 2

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "start_scale_m end_scale_m",
            "[0, inf)": "tolerance",
            "[1, inf)": "max_iterations min_matched max_points rounds",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class PlausibilitySettings:
    """Limits beyond which a motion is rejected.

    Attributes
    ----------
    min_inlier_ratio : float
        Smallest fraction of a scan's points within ``end_scale_m`` of the local map. 0.2: it is 0.05 for
        scans of false points only, and above 0.35 with half of them false.
    max_acceleration : float
        Largest change of velocity, in any direction [m/s2]. 10: full braking.
    max_yaw_rate : float
        Largest yaw rate [rad/s]. 1.5: a tight turn at 15 km/h has 1.
    patience_s : float
        After this time without an accepted motion the local map is started again [s].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    min_inlier_ratio: float = 0.2
    max_acceleration: float = 10.0
    max_yaw_rate: float = 1.5
    patience_s: float = 3.0

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf]": "max_acceleration max_yaw_rate",
            "[0, inf]": "patience_s",
            "[0, 1]": "min_inlier_ratio",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class LocalMapSettings:
    """Settings of `local_map_odometry`.

    Attributes
    ----------
    map : MapSettings
        The local map.
    icp : RobustIcpSettings
        Registration to it.
    plausibility : PlausibilitySettings
        Rejection of motions.

    Raises
    ------
    ValueError
        If a part is of another class; the message names it.
    """

    map: MapSettings = field(default_factory=MapSettings)
    icp: RobustIcpSettings = field(default_factory=RobustIcpSettings)
    plausibility: PlausibilitySettings = field(default_factory=PlausibilitySettings)

    def __post_init__(self) -> None:
        check_fields(self, {})


@dataclass(frozen=True)
class LocalMap:
    """Points to register to, with the weight of an offset from each.

    Attributes
    ----------
    cloud : SortedCloud
        Points, shape (n, 2) [m].
    information : array, shape (n, 2, 2)
        Matrix M per point: an offset d has the squared error d' M d. Identity, or smaller along a line.
    """

    cloud: SortedCloud
    information: np.ndarray


@dataclass(frozen=True)
class LocalMapIncrement:
    """Motion from one scan to the next.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the scan in the one before, both at mid-scan [m, m, rad].
    twist : array, shape (3,)
        Body velocity (vx, vy, yaw rate) as `deskew_cloud` needs it; constant since the last accepted motion
        [m/s, m/s, rad/s].
    inlier_ratio : float
        Fraction of the scan's points near the local map at the pose tried last; 0 where none could be tried.
    fault : str
        Empty for an accepted motion; otherwise why it was rejected, and the increment is that of constant
        velocity.
    """

    T_target_source: np.ndarray
    twist: np.ndarray
    inlier_ratio: float
    fault: str


def deskew_cloud(points: np.ndarray, twist: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Compensate the points of one scan for motion and the Doppler effect, see `rol.radar.compensate_points`.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points as read off a scan, each in the radar frame at its own time [m].
    twist : array-like, shape (3,)
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame at mid-scan [m].
    """
    return compensate_points(check_points(points, "cloud", error=OdometryError), ScanMotion(twist))


def build_local_map(clouds: Sequence[np.ndarray], settings: MapSettings) -> LocalMap | None:
    """Merge the clouds of the keyframes, one point per cell, and compute the information matrices.

    Parameters
    ----------
    clouds : sequence of array, shape (n, 2)
        Clouds of the keyframes in one frame [m].
    settings : MapSettings
        Cells, views and lines.

    Returns
    -------
    local_map : LocalMap or None
        None without a point.
    """
    points = np.concatenate([np.zeros((0, 2)), *clouds])
    if len(points) == 0:
        return None
    owners = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    cells = np.floor((points - points.min(axis=0)) / settings.cell_m).astype(np.int64)
    _, cells = np.unique(cells @ (2**31, 1), return_inverse=True)
    seen = np.zeros((cells.max() + 1, len(clouds)), dtype=bool)
    seen[cells, owners] = True
    means = np.stack([np.bincount(cells, column) for column in points.T], axis=1)
    means /= np.bincount(cells)[:, None]
    kept = means[seen.sum(axis=1) >= min(settings.min_views, (len(clouds) + 1) // 2)]
    if len(kept) == 0:
        return None
    line = float(settings.line_radius_m), float(settings.line_ratio), float(settings.along_weight)
    cloud = sort_cloud(kept, "local map")
    return LocalMap(cloud, information_matrices(cloud, *line))


def register_robust(
    source: np.ndarray,
    local_map: LocalMap,
    init: np.ndarray | tuple[float, float, float],
    settings: RobustIcpSettings,
) -> IcpResult:
    """Register a cloud to a local map by Gauss-Newton with the robust kernel of Geman and McClure.

    Parameters
    ----------
    source : array, shape (n, 2)
        Cloud in its own frame [m].
    local_map : LocalMap
        From `build_local_map`.
    init : array-like, shape (3,)
        Initial guess of T_map_source [m, m, rad].
    settings : RobustIcpSettings
        Scales, iterations and limits.

    Returns
    -------
    result : IcpResult
        ``T_target_source`` in the frame of the map; ``n_matched`` and ``rmse_m`` of the pairs within
        ``end_scale_m``; ``converged`` False, and the pose of the last fit, where too few points match.

    Raises
    ------
    OdometryError
        If the cloud has another shape or a value that is not finite.

    Notes
    -----
    A pair with the residual d has the squared error e = d' M d, with M of its map point, and the weight
    1 / (1 + e / scale^2)^2 in each step. A point on a line constrains the motion along the line only weakly.
    """
    source = check_points(source, "source cloud", error=OdometryError)
    pose = check_pose(init, "initial guess").copy()
    scale = settings.start_scale_m
    source, n_matched, rmse_m = choose_evenly(source, settings.max_points), 0, float("nan")
    for iteration in range(1, settings.max_iterations + 1):
        equations, n_paired, n_matched, error = _normal_equations(
            pose, source, local_map.cloud, local_map.information, (scale, settings.end_scale_m)
        )
        change = _solve(equations)
        if n_paired < settings.min_matched or change is None:
            return IcpResult(pose, n_matched, rmse_m, iteration - 1, False)
        rmse_m = float(np.sqrt(error / n_matched)) if n_matched else float("nan")
        pose = np.append(pose[:2] + change[:2], wrap_angle(pose[2] + change[2]))
        shift = np.hypot(*change[:2]) + 30.0 * abs(change[2])
        if scale <= settings.end_scale_m and shift < settings.tolerance:
            return IcpResult(pose, n_matched, rmse_m, iteration, True)
        scale = max(0.8 * scale, settings.end_scale_m)
    return IcpResult(pose, n_matched, rmse_m, settings.max_iterations, False)


def local_map_odometry(
    clouds: Iterable[np.ndarray],
    stamps_us: np.ndarray,
    settings: LocalMapSettings = LocalMapSettings(),
    *,
    deskew: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = deskew_cloud,
    first_twist: np.ndarray | None = None,
) -> Iterator[LocalMapIncrement]:
    """Estimate odometry by registering each cloud to a local map.

    Each motion is predicted from the one before. An implausible one, or one with too few matches, is repeated
    from an initial guess of `correlative_scan_match`. If that fails too, the increment is that of constant
    velocity and its ``fault`` is set.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m]; empty ones are allowed.
    stamps_us : array of int, shape (m,)
        Increasing times of the scans [us], one per cloud.
    settings : LocalMapSettings
        Map, registration and plausibility.
    deskew : callable, optional
        Takes a cloud and a twist and returns the cloud at mid-scan: `deskew_cloud` for points as read off
        scans, None for points that are compensated already.
    first_twist : array, shape (3,), optional
        Body velocity at the first scan [m/s, m/s, rad/s]; searched for, up to about 24 m/s, if not given.

    Yields
    ------
    increment : LocalMapIncrement
        One fewer than clouds: the pose of each scan in the one before; `rol.odometry.stack_increments` stacks
        them.

    Raises
    ------
    OdometryError
        If times do not increase or do not match the number of clouds, or if a cloud has another shape or a
        value that is not finite.
    """
    stamps_us = _check_stamps(stamps_us)
    odometry, n_clouds = LocalMapOdometry(settings, deskew=deskew, first_twist=first_twist), 0
    for cloud in clouds:
        if n_clouds == len(stamps_us):
            raise OdometryError(f"{n_clouds} stamps, but more clouds")
        increment = odometry.step(cloud, int(stamps_us[n_clouds]))
        if increment is not None:
            yield increment
        n_clouds += 1
    if n_clouds < len(stamps_us):
        raise OdometryError(f"{len(stamps_us)} stamps for {n_clouds} clouds")


class LocalMapOdometry:
    """Local-map odometry that is given one scan at a time; its frame is that of the first scan.

    Parameters
    ----------
    settings : LocalMapSettings
        Map, registration and plausibility.
    deskew, first_twist
        As for `local_map_odometry`.
    """

    def __init__(
        self,
        settings: LocalMapSettings = LocalMapSettings(),
        *,
        deskew: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = deskew_cloud,
        first_twist: np.ndarray | None = None,
    ) -> None:
        self.settings = settings
        self.fine = replace(settings.icp, start_scale_m=settings.icp.end_scale_m)
        self.deskew = deskew or (lambda cloud, twist: cloud)
        self.is_twist_known = first_twist is not None
        self.twist = check_pose(first_twist, "first twist") if self.is_twist_known else np.zeros(3)
        self.pose, self.n_scans, self.stamp_us = np.zeros(3), 0, 0

    def step(self, cloud: np.ndarray, stamp_us: int) -> LocalMapIncrement | None:
        """Estimate the motion from the last scan to this one.

        Parameters
        ----------
        cloud : array, shape (n, 2)
            Points of the scan in its own frame [m].
        stamp_us : int
            Time of the scan [us].

        Returns
        -------
        increment : LocalMapIncrement or None
            None for the first scan.

        Raises
        ------
        OdometryError
            If the time does not increase, or the cloud has another shape or a value that is not finite.
        """
        cloud = check_points(cloud, f"cloud {self.n_scans}", error=OdometryError)
        seconds, increment = (stamp_us - self.stamp_us) / 1e6, None
        if self.n_scans == 0:
            self._begin(cloud)
        elif seconds <= 0.0:
            raise OdometryError(f"stamps do not increase at index {self.n_scans}")
        else:
            increment = self._follow(cloud, seconds)
        self.n_scans, self.stamp_us = self.n_scans + 1, stamp_us
        return increment

    def _begin(self, cloud: np.ndarray) -> None:
        """Start a local map with a cloud, which is deskewed again until the first accepted motion."""
        self.anchor: tuple[np.ndarray, np.ndarray] | None = (self.pose, cloud)
        self.keyframes: list[tuple[np.ndarray, np.ndarray]] = []
        self.local_map: LocalMap | None = None
        # The last accepted pose, and the time since then.
        self.accepted_pose, self.blind_s = self.pose, 0.0

    def _follow(self, cloud: np.ndarray, seconds: float) -> LocalMapIncrement:
        """Estimate the motion to the next scan."""
        self.blind_s += seconds
        last_pose = self.pose
        guess = self.pose = compose(last_pose, exp(self.twist, seconds))
        is_easy = self.is_twist_known and self.blind_s <= 0.5
        for is_searched in (False, True) if is_easy else (True,):
            pose, inlier_ratio = self._register(cloud, guess, is_searched)
            fault = self._find_fault(self._twist_to(pose), inlier_ratio)
            if not fault:
                self._accept(pose, cloud)
                break
        if fault and (self.anchor is not None or self.blind_s > self.settings.plausibility.patience_s):
            self.is_twist_known = False
            self._begin(cloud)
        return LocalMapIncrement(relative_pose(last_pose, self.pose), self.twist, inlier_ratio, fault)

    def _register(self, cloud: np.ndarray, guess: np.ndarray, is_searched: bool) -> tuple[np.ndarray, float]:
        """Register and deskew in turns; return the pose and the inlier ratio."""
        pose, twist, inlier_ratio, settings = guess, self.twist, 0.0, self.settings.icp
        for _ in range(settings.rounds):
            source, local_map = self.deskew(cloud, twist), self._map_at(twist)
            if local_map is None or len(source) < settings.min_matched:
                return guess, 0.0
            if is_searched and settings is self.settings.icp:
                target = local_map.cloud.points
                pose = correlative_scan_match(source, target, guess, window=self._window(), max_points=300)
            result = register_robust(source, local_map, pose, settings)
            pose, settings = result.T_target_source, self.fine
            twist = self._twist_to(pose)
            inlier_ratio = result.n_matched / min(len(source), settings.max_points)
        return pose, inlier_ratio

    def _twist_to(self, pose: np.ndarray) -> np.ndarray:
        """Compute the velocity from the last accepted pose to this one."""
        return log(relative_pose(self.accepted_pose, pose)) / self.blind_s

    def _window(self) -> tuple[float, float, float]:
        """Return the search window, which grows with the time since the last accepted motion."""
        if not self.is_twist_known:
            return _FIRST_WINDOW
        x, y, yaw = _WINDOW
        growth = min(max(2.0 * self.blind_s, 1.0), 3.0)
        return x * growth, y * growth, yaw * growth

    def _accept(self, pose: np.ndarray, cloud: np.ndarray) -> None:
        """Continue from an accepted pose, with the velocity that leads there."""
        self.twist = self._twist_to(pose)
        self.pose, self.accepted_pose = pose, pose
        self.is_twist_known, self.blind_s = True, 0.0
        self._add_keyframe(cloud)

    def _map_at(self, twist: np.ndarray) -> LocalMap | None:
        """Return the local map; deskew it with this velocity while it is one cloud of uncertain velocity."""
        if self.anchor is None:
            return self.local_map
        return build_local_map([self._place(*self.anchor, twist)], self.settings.map)

    def _place(self, pose: np.ndarray, cloud: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """Deskew a cloud and transform it into the frame of the first scan."""
        return transform_points(pose, self.deskew(cloud, twist))

    def _find_fault(self, twist: np.ndarray, inlier_ratio: float) -> str:
        """Describe why a motion is implausible; empty if it is plausible."""
        limits = self.settings.plausibility
        if inlier_ratio < limits.min_inlier_ratio:
            return f"{100.0 * inlier_ratio:.0f} % of the points match"
        acceleration = np.hypot(*(twist - self.twist)[:2]) / self.blind_s
        if self.is_twist_known and acceleration > limits.max_acceleration:
            return f"acceleration of {acceleration:.0f} m/s2"
        if abs(twist[2]) > limits.max_yaw_rate:
            return f"yaw rate of {twist[2]:.1f} rad/s"
        return ""

    def _add_keyframe(self, cloud: np.ndarray) -> None:
        """Add a keyframe if the vehicle has moved, and remove distant ones."""
        settings = self.settings.map
        if self.anchor is not None:
            self.keyframes = [(self.anchor[0], self._place(*self.anchor, self.twist))]
        moved = relative_pose(self.keyframes[-1][0], self.pose)
        is_new = np.hypot(*moved[:2]) >= settings.keyframe_m or abs(moved[2]) >= settings.keyframe_rad
        if is_new:
            self.keyframes.append((self.pose, self._place(self.pose, cloud, self.twist)))
        if is_new or self.anchor is not None:
            self.keyframes = [
                (pose, points)
                for pose, points in self.keyframes
                if np.hypot(*(pose - self.pose)[:2]) <= settings.length_m
            ]
            self.local_map = build_local_map([points for _, points in self.keyframes], settings)
            self.anchor = None


def _check_stamps(stamps_us: np.ndarray) -> np.ndarray:
    """Check that times are one-dimensional and increase."""
    stamps_us = np.asarray(stamps_us)
    if stamps_us.ndim != 1:
        raise OdometryError(f"stamps: expected shape (m,), got {stamps_us.shape}")
    is_late = np.diff(stamps_us) <= 0
    if is_late.any():
        raise OdometryError(f"stamps do not increase at index {int(np.argmax(is_late)) + 1}")
    return stamps_us


@compiled
def information_matrices(cloud, radius, ratio, along_weight):
    """Compute information matrices, shape (n, 2, 2), of map points from the shape of their surroundings."""
    matrices = np.empty((len(cloud.points), 2, 2))
    for k in range(len(matrices)):
        n, xx, yy, xy = _spread_about(cloud, cloud.points[k], radius, 12)
        unequal = np.hypot(xx - yy, 2.0 * xy)
        is_line = n >= 5 and xx + yy - unequal < ratio * (xx + yy + unequal)
        heading, freed = np.arctan2(2.0 * xy, xx - yy) / 2.0, 1.0 - along_weight if is_line else 0.0
        c, s = np.cos(heading), np.sin(heading)
        matrices[k, 0, 0], matrices[k, 1, 1] = 1.0 - freed * c * c, 1.0 - freed * s * s
        matrices[k, 0, 1] = matrices[k, 1, 0] = -freed * c * s
    return matrices


@compiled
def _spread_about(target, centre, radius, most):
    """Compute (n, xx, yy, xy): number and covariance of the ``most`` nearest points within a radius."""
    near, n, x, y, xx, yy, xy = _find_near(target, centre, radius), 0, 0.0, 0.0, 0.0, 0.0, 0.0
    bound = np.partition(near[:, 2], most - 1)[most - 1] if len(near) > most else np.inf
    for k in range(len(near)):
        if near[k, 2] <= bound:
            u, v = near[k, 0], near[k, 1]
            n, x, y, xx, yy, xy = n + 1, x + u, y + v, xx + u * u, yy + v * v, xy + u * v
    x, y = x / n, y / n
    return n, xx / n - x * x, yy / n - y * y, xy / n - x * y


@compiled
def _find_near(target, centre, radius):
    """Collect offsets and squared distances (u, v, square) of the points within a radius, shape (n, 3)."""
    points, starts, _ = target
    width, found, n = np.int64(np.sqrt(len(starts) - 1)), np.empty((32, 3)), 0
    i, j = cell_index(centre[0] - radius), cell_index(centre[1] - radius)
    for p in range(i, min(cell_index(centre[0] + radius) + 1, i + width)):
        for q in range(j, min(cell_index(centre[1] + radius) + 1, j + width)):
            cell = (p & (width - 1)) * width + (q & (width - 1))
            for k in range(starts[cell], starts[cell + 1]):
                u, v = points[k, 0] - centre[0], points[k, 1] - centre[1]
                if u * u + v * v < radius * radius:
                    if n == len(found):
                        found = np.concatenate((found, found))
                    found[n, 0], found[n, 1], found[n, 2] = u, v, u * u + v * v
                    n += 1
    return found[:n]


@compiled
def _normal_equations(pose, source, target, information, scales):
    """Sum the weighted normal equations over all pairs within three times the first scale.

    Returns the Hessian for (x, y, yaw about the source's origin) next to the gradient, shape (3, 4); the
    number of pairs; the number of pairs closer than the second scale, and the sum of their errors.
    """
    moved, matched, _ = pair_points(pose, source, target, (3.0 * scales[0]) ** 2)
    sums, n_near, near_error = np.zeros((3, 4)), 0, 0.0
    for k in range(len(moved)):
        a, b = moved[k, 0] - pose[0], moved[k, 1] - pose[1]
        x, y = moved[k, 0] - target.points[matched[k], 0], moved[k, 1] - target.points[matched[k], 1]
        xx, xy, yy = (
            information[matched[k], 0, 0],
            information[matched[k], 0, 1],
            information[matched[k], 1, 1],
        )
        error = xx * x * x + 2.0 * xy * x * y + yy * y * y
        if error < scales[1] ** 2:
            n_near, near_error = n_near + 1, near_error + error
        weight = 1.0 / (1.0 + error / scales[0] ** 2) ** 2
        for column, (u, v) in enumerate(((1.0, 0.0), (0.0, 1.0), (-b, a), (x, y))):
            p, q = weight * (xx * u + xy * v), weight * (xy * u + yy * v)
            sums[0, column] += p
            sums[1, column] += q
            sums[2, column] += a * q - b * p
    return sums, len(moved), n_near, near_error


def _solve(equations: np.ndarray) -> np.ndarray | None:
    """Solve for the motion (x, y, yaw) that minimizes the weighted errors; None if it is not constrained."""
    values, directions = np.linalg.eigh(equations[:, :3])
    return None if values[0] <= 1e-12 * values[2] else -directions @ (equations[:, 3] @ directions / values)
