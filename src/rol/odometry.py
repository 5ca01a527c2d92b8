"""Odometry by registration: 2D point-to-point ICP between successive clouds, and a better way.

The motion u of the filter (paper, Sec. III-B): the cloud of one scan is aligned to the cloud of the scan
before. A result ``T_target_source`` maps points of the source into the target's frame; with the earlier scan
as the target it is the step of the car, seen from where it was. `chain` is the paper's way. Beside it stands the
book's own, `local_map_odometry`: each cloud is aligned to those of the last metres, corrected for the car's motion
during the turn of the radar and for Doppler, with the velocity that comes out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

try:
    from .geometry import check_fields, check_poses, compose, relative_pose, transform_points, wrap_angle
except ImportError:  # this file was copied on its own
    from geometry import check_fields, check_poses, compose, relative_pose, transform_points, wrap_angle


_FIRST_REACH = (6.0, 0.8, np.deg2rad(4.0))  # of a search for the first motion [m, m, rad]
_REACH = (2.0, 0.8, np.deg2rad(8.0))  # of one for a later motion, up to half a second long


class OdometryError(ValueError):
    """Raised for clouds that are no clouds: wrong shape, or values that are not finite."""


@dataclass(frozen=True)
class IcpResult:
    """Outcome of one registration.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the source in the target [m, m, rad]; the initial guess where nothing could be matched.
    n_matched : int
        Pairs in the last fit.
    rmse_m : float
        Root mean square distance of these pairs [m]; NaN without pairs.
    iterations : int
        Fits made.
    converged : bool
        True when the last fits moved less than the tolerance; False also for clouds too small to be matched.
    """

    T_target_source: np.ndarray
    n_matched: int
    rmse_m: float
    iterations: int
    converged: bool


def check_cloud(points: np.ndarray, name: str) -> np.ndarray:
    """Check that an array is a finite cloud.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m]; n may be zero.
    name : str
        What the cloud is called in the message.

    Returns
    -------
    points : array, shape (n, 2)
        The same values as float64.

    Raises
    ------
    OdometryError
        If the shape is another one or a value is not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise OdometryError(f"{name}: expected points of shape (n, 2), got {points.shape}")
    if not np.isfinite(points).all():
        raise OdometryError(f"{name}: point {int(np.argwhere(~np.isfinite(points))[0, 0])} is not finite")
    return points


def fit_rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Find the rigid motion that brings paired points together with least squares.

    Parameters
    ----------
    source, target : array, shape (n, 2)
        Points [m]; row i of one belongs to row i of the other; n at least 2.

    Returns
    -------
    T_target_source : array, shape (3,)
        The minimizer of the sum of squared distances [m, m, rad]. In the plane the SVD solution of Arun et
        al. has this closed form: the heading is the angle of (sum of dot products, sum of cross products).
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    x, y = target_mean - transform_points((0.0, 0.0, yaw), source_mean[None])[0]
    return np.array([x, y, yaw])


def icp_2d(
    source: np.ndarray,
    target: np.ndarray,
    init: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    max_distance: float = 3.0,
    min_distance: float = 1.0,
    trim: float = 0.9,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
    min_matched: int = 10,
    max_points: int = 1000,
) -> IcpResult:
    """Align one cloud to another by iterating nearest neighbours and rigid fits.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m].
    init : array-like, shape (3,)
        First guess of T_target_source [m, m, rad].
    max_distance, min_distance : float
        Pairs further apart than a limit are dropped; the limit falls from the one to the other by a fifth at
        each iteration, so that the first fits can pull from afar and the last ones see no false neighbours
        [m].
    trim : float
        Share of the remaining pairs, the closest, that is kept.
    max_iterations : int
        Fits at most.
    tolerance : float
        Stop when the limit has reached ``min_distance`` and a fit moves less than this [m, and rad at 30 m].
    min_matched : int
        Fewer pairs than this cannot be trusted: stop with ``converged`` False.
    max_points : int
        Of a larger source only so many points are used, evenly chosen; the target is used whole. On clouds of
        3,000 points the steps are as good with 1,000, in a quarter of the time.

    Returns
    -------
    result : IcpResult
        For empty or too small clouds the initial guess, ``converged`` False.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite. Yin et al. 2020, Sec. III-B, below Eq. 7.
    """
    source, target = check_cloud(source, "source cloud"), check_cloud(target, "target cloud")
    pose, limit = check_poses(init, "initial guess").copy(), max_distance
    if min(len(source), len(target)) < min_matched:
        return IcpResult(pose, 0, float("nan"), 0, False)
    if len(source) > max_points:
        source = source[np.linspace(0, len(source) - 1, max_points).astype(int)]
    tree, n_matched, rmse_m = cKDTree(target), 0, float("nan")
    for iteration in range(1, max_iterations + 1):
        moved = transform_points(pose, source)
        distances, neighbours = tree.query(moved, distance_upper_bound=limit)
        pairs = _closest(distances, trim)
        n_matched = len(pairs)
        if n_matched < min_matched or np.ptp(moved[pairs], axis=0).max() == 0.0:
            return IcpResult(pose, n_matched, rmse_m, iteration - 1, False)
        rmse_m = float(np.sqrt(np.mean(distances[pairs] ** 2)))
        change = fit_rigid(moved[pairs], target[neighbours[pairs]])
        pose, last = compose(change, pose), pose
        shift = np.hypot(*(pose - last)[:2]) + 30.0 * abs(change[2])
        if limit <= min_distance and shift < tolerance:
            return IcpResult(pose, n_matched, rmse_m, iteration, True)
        limit = max(0.8 * limit, min_distance)
    return IcpResult(pose, n_matched, rmse_m, max_iterations, False)


def search_motion(
    source: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    reach: tuple[float, float, float] = (2.0, 0.8, np.deg2rad(4.0)),
    cell: float = 0.125,
    max_points: int = 600,
) -> np.ndarray:
    """Find a first guess for ICP by trying motions about a given one: first in coarse steps, then in fine ones.

    Nearest neighbours pull a cloud of thick strokes wherever it overlaps already, and it stays near the first
    guess. How many points fall onto the other cloud has its greatest value at the true motion.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Clouds in their own frames [m].
    guess : array-like, shape (3,)
        Middle of the search [m, m, rad].
    reach : tuple of float
        How far to search to each side in x, y [m] and heading [rad].
    cell : float
        Side of the cells in which the target is marked, each with its neighbours [m].
    max_points : int
        Of a larger source only so many points are used, evenly chosen.

    Returns
    -------
    pose : array, shape (3,)
        The best T_target_source, of equally good ones the nearest to the guess; the guess itself for an empty
        cloud. It is tried in steps of 0.4 m and 1 deg, then, within a
        fifth of the reach, of 0.08 m and 0.2 deg.

    Raises
    ------
    OdometryError
        If a cloud has another shape or a value that is not finite.
    """
    source, target = check_cloud(source, "source cloud"), check_cloud(target, "target cloud")
    best = check_poses(guess, "initial guess").copy()
    if min(len(source), len(target)) == 0:
        return best
    source = source[np.linspace(0, len(source) - 1, min(len(source), max_points)).astype(int)]
    corner = target.min(axis=0) - 3.5 * cell  # points of an image then lie in the middle of cells
    marked = np.zeros(np.ceil((target.max(axis=0) - corner) / cell).astype(int) + 4, dtype=np.int32)
    u, v = np.floor((target - corner) / cell).astype(int).T
    for reach_cells in (2, 1):  # near a point is worth one, at a point two
        for i, j in np.ndindex(2 * reach_cells + 1, 2 * reach_cells + 1):
            marked[u + i - reach_cells, v + j - reach_cells] = 3 - reach_cells
    for share in (1.0, 0.2):  # the second time within a fifth of the reach, in steps a fifth as long
        offsets = _offsets(share * np.array(reach), share * np.array([0.4, 0.4, np.deg2rad(1.0)]))
        candidates = best + offsets
        best = candidates[np.argmax(_count_marked(candidates, source, marked, corner, cell))]
    return best


def chain(
    clouds: Iterable[np.ndarray],
    first_guess: np.ndarray | None = None,
    *,
    search: bool = False,
    **settings: float,
) -> Iterator[IcpResult]:
    """Register each cloud to the one before, guessing that the car goes on as it went.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m].
    first_guess : array, shape (3,), optional
        Guess of the first step [m, m, rad]; standing still if not given.
    search : bool
        Improve each guess by `search_motion` before ICP: not in the paper.
    **settings
        Of `icp_2d`.

    Yields
    ------
    result : IcpResult
        One fewer than clouds: the pose of each scan in the one before. Where the registration cannot be made,
        an empty cloud for instance, the step is the guess (constant velocity) and ``n_matched`` is below
        ``min_matched``.
    """
    clouds = iter(clouds)
    guess = np.zeros(3) if first_guess is None else check_poses(first_guess, "first guess")
    target = next(clouds, None)
    for source in clouds:
        start = search_motion(source, target, guess) if search else guess
        result = icp_2d(source, target, start, **settings)
        yield result
        guess, target = result.T_target_source, source


def steps_of(results: Iterable[IcpResult]) -> np.ndarray:
    """Stack the steps of a chain.

    Parameters
    ----------
    results : iterable of IcpResult
        From `chain`.

    Returns
    -------
    steps : array, shape (n, 3)
        Step i is the pose of scan i + 1 in scan i [m, m, rad].
    """
    steps = [result.T_target_source for result in results]
    return np.array(steps).reshape(-1, 3)


def follow_map(
    steps: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    start: np.ndarray,
    supervisor: Callable[[int, np.ndarray], np.ndarray | None] | None = None,
    *,
    reach_m: float = 75.0,
    min_share: float = 0.2,
    max_points: int = 1000,
    **settings: float,
) -> Iterator[IcpResult]:
    """Follow the pose on a map by ICP alone, without a filter: each cloud is registered from the last pose and the step.

    Parameters
    ----------
    steps : iterable of array, shape (3,)
        Odometry between successive scans, one fewer than clouds [m, m, rad].
    clouds : iterable of array, shape (n, 2)
        Cloud of each scan in the radar frame [m].
    map_points : array, shape (m, 2)
        The map [m].
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    supervisor : callable, optional
        As in `rol.mcl.localize`: a pose that it returns is where the next scan begins.
    reach_m : float
        Map points farther from the guess than this are left out [m].
    min_share : float
        A registration that does not come to rest, or ends with a smaller share of the points in pairs, is not believed.
        To take it all the same was worse on 2,000 scans of the real route.
    max_points, **settings
        Of `icp_2d`.

    Yields
    ------
    result : IcpResult
        One per scan, the pose T_map_radar as ``T_target_source``. Where the registration is not believed it is the
        guess, the last pose moved by the step, and ``converged`` is False. Yin et al. 2020, Sec. III-B.

    Raises
    ------
    OdometryError
        If there are fewer steps than clouds ask for, or a cloud is none.
    """
    map_points = check_cloud(map_points, "map")
    tree, pose, steps = cKDTree(map_points), check_poses(start, "start"), iter(steps)
    for index, cloud in enumerate(clouds):
        step = np.zeros(3) if index == 0 else next(steps, None)
        if step is None:
            raise OdometryError(f"no odometry step to scan {index}: one fewer than clouds are needed")
        guess = compose(pose, step)
        near = map_points[tree.query_ball_point(guess[:2], reach_m)]
        result = icp_2d(cloud, near, guess, max_points=max_points, **settings)
        if not result.converged or result.n_matched < min_share * min(len(cloud), max_points):
            result = replace(result, T_target_source=guess, converged=False)
        yield result
        restart = supervisor(index, result.T_target_source) if supervisor else None
        pose = result.T_target_source if restart is None else check_poses(restart, "restart")


def _offsets(reach: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Motions on a grid around zero, the nearest to zero first, shape (n, 3)."""
    axes = [k * np.arange(-round(r / k), round(r / k) + 1) for r, k in zip(reach, step, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.argsort(np.abs(grid / step).sum(axis=1), kind="stable")]


def _count_marked(
    poses: np.ndarray, points: np.ndarray, marked: np.ndarray, corner: np.ndarray, cell: float
) -> np.ndarray:
    """How many points fall on marked cells from each pose, shape (n,)."""
    c, s = np.cos(poses[:, 2:]) / cell, np.sin(poses[:, 2:]) / cell
    x, y = ((poses[:, :2] - corner) / cell).T
    u = (x[:, None] + c * points[:, 0] - s * points[:, 1]).astype(np.int32)
    v = (y[:, None] + s * points[:, 0] + c * points[:, 1]).astype(np.int32)
    np.clip(u, 0, marked.shape[0] - 1, out=u)  # the rim is free
    np.clip(v, 0, marked.shape[1] - 1, out=v)
    return marked[u, v].sum(axis=1)


def _closest(distances: np.ndarray, share: float) -> np.ndarray:
    """Give the indices of the smallest finite distances, a share of them."""
    finite = np.flatnonzero(np.isfinite(distances))
    n = int(np.ceil(share * len(finite)))
    return finite if n == len(finite) else finite[np.argpartition(distances[finite], n - 1)[:n]]


# ---- not in the paper: registration to a local map -------------------------------------------------------------


@dataclass(frozen=True)
class LocalMapSettings:
    """Settings of `local_map_odometry`; each default gives its reason.

    Attributes
    ----------
    map_length_m : float
        Keyframes farther from the car than this are forgotten [m]. 20: 10 to 80 m drift alike, and a short map
        is quick.
    keyframe_m, keyframe_rad : float
        The local map gets a cloud after so much way or turning since the last one [m, rad].
    cell_m : float
        The local map keeps one point, the mean, per cell of this side [m]. 0.5: two pixels of an image.
    min_views : int
        A cell that fewer keyframes have seen is left out, once there are three of them: false points seldom fall
        twice onto one place. With half of all points false, 1 drifts four times as much as 2.
    line_radius_m, line_ratio : float
        A map point lies on a line when its neighbours within the radius [m] spread less across their main
        direction than this share of the variance along it.
    along_weight : float
        What a squared distance along such a line counts beside one across it. 0.05: with 1, point to point, steps
        err by a quarter more along the way.
    start_scale_m, end_scale_m : float
        Distance at which a pair counts a quarter; it falls from the one to the other by a fifth per fit [m].
    max_iterations, tolerance, min_matched, max_points
        As in `icp_2d`.
    rounds : int
        Registrations per scan, each with the cloud corrected for the velocity that the one before found. 2: with 1
        the drift is twice as large, and a third changes nothing.
    min_share : float
        Share of a cloud's points within ``end_scale_m`` of the local map below which a motion is not believed.
        0.2: 0.05 for clouds of nothing but false points, above 0.35 with half of them false.
    max_acceleration : float
        Change of velocity, in any direction, beyond which a motion is not believed [m/s2]. 10: full braking.
    max_yaw_rate : float
        Yaw rate beyond which a motion is not believed [rad/s]. 1.5: a tight turn at 15 km/h has 1.
    patience_s : float
        After so long without a motion that is believed the local map begins anew [s].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    map_length_m: float = 20.0
    keyframe_m: float = 1.0
    keyframe_rad: float = 0.05
    cell_m: float = 0.5
    min_views: int = 2
    line_radius_m: float = 1.5
    line_ratio: float = 0.1
    along_weight: float = 0.05
    start_scale_m: float = 2.0
    end_scale_m: float = 0.5
    max_iterations: int = 30
    tolerance: float = 1e-3
    min_matched: int = 10
    max_points: int = 1000
    rounds: int = 2
    min_share: float = 0.2
    max_acceleration: float = 10.0
    max_yaw_rate: float = 1.5
    patience_s: float = 3.0

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "map_length_m cell_m line_radius_m start_scale_m end_scale_m",
            "(0, inf]": "max_acceleration max_yaw_rate",
            "[0, inf)": "keyframe_m keyframe_rad line_ratio along_weight tolerance",
            "[0, inf]": "patience_s",
            "[1, inf)": "min_views max_iterations min_matched max_points rounds",
            "[0, 1]": "min_share",
        }
        check_fields(self, allowed)


@dataclass(frozen=True)
class LocalMap:
    """Points to register to, and how distances from each are measured.

    Attributes
    ----------
    tree : scipy.spatial.cKDTree
        Of the points, shape (n, 2) [m].
    metrics : array, shape (n, 2, 2)
        Weight M of an offset d from each point, which counts d' M d: the identity, or less along a line.
    """

    tree: cKDTree
    metrics: np.ndarray


@dataclass(frozen=True)
class LocalMapStep:
    """Motion from one scan to the next.

    Attributes
    ----------
    T_target_source : array, shape (3,)
        Pose of the scan in the one before, both at mid-scan [m, m, rad].
    twist : array, shape (3,)
        Body velocity (vx, vy, yaw rate), what `correct_cloud` wants; constant since the last motion that was
        believed [m/s, m/s, rad/s].
    match_share : float
        Share of the cloud's points near the local map at the pose tried last; 0 where none could be tried.
    fault : str
        Empty for a motion that is believed; else why not, and the step goes on at constant velocity.
    """

    T_target_source: np.ndarray
    twist: np.ndarray
    match_share: float
    fault: str


def correct_cloud(
    points: np.ndarray,
    twist: np.ndarray | tuple[float, float, float],
    *,
    scan_seconds: float | None = None,
    doppler_seconds: float | None = None,
) -> np.ndarray:
    """Move the points of one turn of the radar to mid-scan, and take out what Doppler adds to their ranges.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points as read off a scan: each in the radar frame at its own time, which its bearing tells, since the
        beam begins ahead and turns clockwise [m].
    twist : array-like, shape (3,)
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    scan_seconds, doppler_seconds : float, optional
        Time of a turn, and range error per closing speed [s]; those of `rol.radar` if not given.

    Returns
    -------
    points : array, shape (n, 2)
        The points in the radar frame at mid-scan [m].

    Notes
    -----
    What `rol.radar.polar_to_cartesian` does to an image when it gets a twist, here for points of an image that was
    made without. Wants ``radar.py`` beside this file.
    """
    try:
        from . import radar
    except ImportError:  # this file was copied on its own
        import radar
    points = check_cloud(points, "cloud")
    turn = radar.SCAN_SECONDS if scan_seconds is None else scan_seconds
    doppler = radar.DOPPLER_SECONDS if doppler_seconds is None else doppler_seconds
    bearings, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    nearer = radar.doppler_shift(bearings, twist, doppler) / np.maximum(ranges, 1e-9)
    seconds = (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * turn
    return radar.undistort_points(points * (1.0 - nearer)[:, None], seconds, twist)


def build_local_map(clouds: Sequence[np.ndarray], settings: LocalMapSettings) -> LocalMap | None:
    """Join clouds, keep one point per cell, and find those that lie on lines.

    Parameters
    ----------
    clouds : sequence of array, shape (n, 2)
        Clouds of the keyframes in one frame [m].
    settings : LocalMapSettings
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
    views = np.bincount(np.unique(cells * len(clouds) + owners) // len(clouds))
    means = np.stack([np.bincount(cells, column) for column in points.T], axis=1)
    means /= np.bincount(cells)[:, None]
    kept = means[views >= min(settings.min_views, (len(clouds) + 1) // 2)]
    tree = cKDTree(kept)
    return LocalMap(tree, _line_metrics(tree, settings)) if len(kept) else None


def register_robust(
    source: np.ndarray,
    local_map: LocalMap,
    init: np.ndarray | tuple[float, float, float],
    settings: LocalMapSettings,
) -> IcpResult:
    """Align a cloud to a local map with weights that fall with distance (Geman and McClure's kernel).

    Parameters
    ----------
    source : array, shape (n, 2)
        Cloud in its own frame [m].
    local_map : LocalMap
        From `build_local_map`.
    init : array-like, shape (3,)
        First guess of T_map_source [m, m, rad].
    settings : LocalMapSettings
        Scales, iterations, sizes.

    Returns
    -------
    result : IcpResult
        ``T_target_source`` in the frame of the map; ``n_matched`` and ``rmse_m`` of the pairs within
        ``end_scale_m``; ``converged`` False, and the pose as far as it came, where too little matches.

    Raises
    ------
    OdometryError
        If the cloud has another shape or a value that is not finite.

    Notes
    -----
    A pair with the residual d has the error e = d' M d, M being its map point's, and counts 1 / (1 + e / scale^2)^2 in
    each Gauss-Newton step. A line tells little of a motion along it; that is left to points on none.
    """
    source, pose = check_cloud(source, "source cloud"), check_poses(init, "initial guess").copy()
    scale = settings.start_scale_m
    if len(source) > settings.max_points:
        source = source[np.linspace(0, len(source) - 1, settings.max_points).astype(int)]
    n_matched, rmse_m = 0, float("nan")
    for iteration in range(1, settings.max_iterations + 1):
        moved, residuals, metrics = _find_pairs(transform_points(pose, source), local_map, 3.0 * scale)
        errors = np.einsum("ni,nij,nj->n", residuals, metrics, residuals)
        is_near = errors < settings.end_scale_m**2
        n_matched = int(is_near.sum())
        weights = (1.0 + errors / scale**2) ** -2.0
        change = _gauss_newton_step(moved - pose[:2], residuals, metrics, weights)
        if len(moved) < settings.min_matched or change is None:
            return IcpResult(pose, n_matched, rmse_m, iteration - 1, False)
        rmse_m = float(np.sqrt(np.mean(errors[is_near]))) if n_matched else float("nan")
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
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = correct_cloud,
    first_twist: np.ndarray | None = None,
) -> Iterator[LocalMapStep]:
    """Register each cloud to those of the last metres, corrected for the motion that this finds.

    The book's own odometry, beside the paper's `chain`. Each motion is guessed from the one before. One that no car
    makes, or with too few matches, is tried again from a searched guess (`search_motion`); if that does no better,
    the step goes on at constant velocity and says so.

    Parameters
    ----------
    clouds : iterable of array, shape (n, 2)
        Clouds of successive scans, each in its own frame [m]; empty ones may be among them.
    stamps_us : array of int, shape (m,)
        Increasing times of the scans [us], one per cloud.
    settings : LocalMapSettings
        See there.
    correct : callable, optional
        Takes a cloud and a twist and gives the cloud at mid-scan: `correct_cloud` for points as they were read off
        scans, None for points that are corrected already.
    first_twist : array, shape (3,), optional
        Body velocity at the first scan [m/s, m/s, rad/s]; searched for, up to some 24 m/s, if not given.

    Yields
    ------
    step : LocalMapStep
        One fewer than clouds: the pose of each scan in the one before; `steps_of` stacks them.

    Raises
    ------
    OdometryError
        If times do not increase or are more or fewer than clouds, or if a cloud has another shape or a value that is
        not finite. Not in the paper.
    """
    stamps_us = _check_stamps(stamps_us)
    track, n_clouds = _Track(settings, correct, first_twist), 0
    for cloud in clouds:
        if n_clouds == len(stamps_us):
            raise OdometryError(f"{n_clouds} stamps, but more clouds")
        cloud = check_cloud(cloud, f"cloud {n_clouds}")
        if n_clouds == 0:
            track.begin(cloud)
        else:
            yield track.follow(cloud, int(stamps_us[n_clouds] - stamps_us[n_clouds - 1]) / 1e6)
        n_clouds += 1
    if n_clouds < len(stamps_us):
        raise OdometryError(f"{len(stamps_us)} stamps for {n_clouds} clouds")


class _Track:
    """What `local_map_odometry` knows after a scan; its frame is that of the first scan."""

    def __init__(
        self,
        settings: LocalMapSettings,
        correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
        first_twist: np.ndarray | None,
    ) -> None:
        self.settings = settings
        self.fine = replace(settings, start_scale_m=settings.end_scale_m)
        self.correct = correct or (lambda cloud, twist: cloud)
        self.is_known = first_twist is not None  # whether the velocity is
        self.twist = check_poses(first_twist, "first twist") if self.is_known else np.zeros(3)
        self.pose = np.zeros(3)

    def begin(self, cloud: np.ndarray) -> None:
        """Begin a local map with a cloud; it is corrected anew until a motion from it is believed."""
        self.anchor: tuple[np.ndarray, np.ndarray] | None = (self.pose, cloud)
        self.keyframes: list[tuple[np.ndarray, np.ndarray]] = []
        self.local_map: LocalMap | None = None
        self.sure_pose, self.blind_s = self.pose, 0.0  # the last pose believed, and the time since then

    def follow(self, cloud: np.ndarray, seconds: float) -> LocalMapStep:
        """Find the motion to the next scan."""
        self.blind_s += seconds
        last_pose = self.pose
        guess = self.pose = compose(last_pose, _step_at(self.twist, seconds))
        is_easy = self.is_known and self.blind_s <= 0.5
        for is_searched in (False, True) if is_easy else (True,):
            pose, share = self._register(cloud, guess, is_searched)
            fault = self._find_fault(self._twist_to(pose), share)
            if not fault:
                self._believe(pose, cloud)
                break
        if fault and (self.anchor is not None or self.blind_s > self.settings.patience_s):
            self.is_known = False
            self.begin(cloud)
        return LocalMapStep(relative_pose(last_pose, self.pose), self.twist, share, fault)

    def _register(self, cloud: np.ndarray, guess: np.ndarray, is_searched: bool) -> tuple[np.ndarray, float]:
        """Register and correct in turns; the pose, and the share of points that match."""
        pose, twist, share, settings = guess, self.twist, 0.0, self.settings
        for _ in range(self.settings.rounds):
            source, local_map = self.correct(cloud, twist), self._map_at(twist)
            if local_map is None or len(source) < settings.min_matched:
                return guess, 0.0
            if is_searched and settings is self.settings:
                pose = search_motion(source, local_map.tree.data, guess, reach=self._reach(), max_points=300)
            result = register_robust(source, local_map, pose, settings)
            pose, settings = result.T_target_source, self.fine
            twist = self._twist_to(pose)
            share = result.n_matched / min(len(source), settings.max_points)
        return pose, share

    def _twist_to(self, pose: np.ndarray) -> np.ndarray:
        """Velocity that leads from the last pose believed to this one."""
        return _twist_over(relative_pose(self.sure_pose, pose), self.blind_s)

    def _reach(self) -> tuple[float, float, float]:
        """How far to search: the longer since a motion was believed, the farther."""
        if not self.is_known:
            return _FIRST_REACH
        x, y, yaw = _REACH
        growth = min(max(2.0 * self.blind_s, 1.0), 3.0)
        return x * growth, y * growth, yaw * growth

    def _believe(self, pose: np.ndarray, cloud: np.ndarray) -> None:
        """Go on from a pose found, with the velocity that leads there."""
        self.twist = self._twist_to(pose)
        self.pose, self.sure_pose = pose, pose
        self.is_known, self.blind_s = True, 0.0
        self._remember(cloud)

    def _map_at(self, twist: np.ndarray) -> LocalMap | None:
        """Give the local map; while it is but one cloud of unsure velocity, corrected for this one."""
        if self.anchor is None:
            return self.local_map
        return build_local_map([self._place(*self.anchor, twist)], self.settings)

    def _place(self, pose: np.ndarray, cloud: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """Correct a cloud and move it into the frame of the track."""
        return transform_points(pose, self.correct(cloud, twist))

    def _find_fault(self, twist: np.ndarray, share: float) -> str:
        """Say what makes a motion hard to believe, nothing if it is sound."""
        limits = self.settings
        if share < limits.min_share:
            return f"{100.0 * share:.0f} % of the points match"
        acceleration = np.hypot(*(twist - self.twist)[:2]) / self.blind_s
        if self.is_known and acceleration > limits.max_acceleration:
            return f"acceleration of {acceleration:.0f} m/s2"
        if abs(twist[2]) > limits.max_yaw_rate:
            return f"yaw rate of {twist[2]:.1f} rad/s"
        return ""

    def _remember(self, cloud: np.ndarray) -> None:
        """Add a cloud to the local map if the car has moved, and forget those left behind."""
        settings = self.settings
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
                if np.hypot(*(pose - self.pose)[:2]) <= settings.map_length_m
            ]
            self.local_map = build_local_map([points for _, points in self.keyframes], settings)
            self.anchor = None


def _step_at(twist: np.ndarray, seconds: float) -> np.ndarray:
    """Give the step at constant velocity; the chord stands for the arc, 0.1 % off at 0.15 rad."""
    return compose((0.0, 0.0, twist[2] * seconds / 2.0), np.append(twist[:2], twist[2] / 2.0) * seconds)


def _twist_over(step: np.ndarray, seconds: float) -> np.ndarray:
    """Give the velocity that makes a step in some time, the inverse of `_step_at`."""
    return np.append(compose((0.0, 0.0, -step[2] / 2.0), step)[:2], step[2]) / seconds


def _check_stamps(stamps_us: np.ndarray) -> np.ndarray:
    """Check that times increase."""
    stamps_us = np.asarray(stamps_us)
    if stamps_us.ndim != 1:
        raise OdometryError(f"stamps: expected shape (m,), got {stamps_us.shape}")
    is_late = np.diff(stamps_us) <= 0
    if is_late.any():
        raise OdometryError(f"stamps do not increase at index {int(np.argmax(is_late)) + 1}")
    return stamps_us


def _line_metrics(tree: cKDTree, settings: LocalMapSettings) -> np.ndarray:
    """Weights of offsets from each point of a map, by the shape of its surroundings, shape (n, 2, 2)."""
    points = tree.data
    near = {"k": min(12, len(points)), "distance_upper_bound": settings.line_radius_m}
    distances, neighbours = (values.reshape(len(points), -1) for values in tree.query(points, **near))
    is_near = np.isfinite(distances)
    offsets = points[np.where(is_near, neighbours, 0)] - points[:, None]
    offsets *= is_near[..., None]
    n = is_near.sum(axis=1)
    means = offsets.sum(axis=1) / n[:, None]
    xx, yy, xy = (
        np.sum(offsets[..., i] * offsets[..., j], axis=1) / n - means[:, i] * means[:, j]
        for i, j in ((0, 0), (1, 1), (0, 1))
    )
    unequal = np.hypot(xx - yy, 2.0 * xy)
    is_line = (n >= 5) & (xx + yy - unequal < settings.line_ratio * (xx + yy + unequal))
    heading = np.arctan2(2.0 * xy, xx - yy) / 2.0
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    freed = np.where(is_line, 1.0 - settings.along_weight, 0.0)
    return np.eye(2) - freed[:, None, None] * along[:, :, None] * along[:, None, :]


def _find_pairs(
    moved: np.ndarray, local_map: LocalMap, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair points with the map: the points that have a neighbour, their residuals, and its metrics."""
    distances, neighbours = local_map.tree.query(moved, distance_upper_bound=reach)
    is_paired = np.isfinite(distances)
    moved, neighbours = moved[is_paired], neighbours[is_paired]
    return moved, moved - local_map.tree.data[neighbours], local_map.metrics[neighbours]


def _gauss_newton_step(
    arms: np.ndarray, residuals: np.ndarray, metrics: np.ndarray, weights: np.ndarray
) -> np.ndarray | None:
    """Motion (x, y, yaw about the source's origin) that lowers the weighted errors most; None if it is not fixed."""
    jacobian = np.zeros((len(arms), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arms[:, 1], arms[:, 0]
    weighted = (weights[:, None, None] * (metrics @ jacobian)).reshape(-1, 3)
    hessian, gradient = weighted.T @ jacobian.reshape(-1, 3), weighted.T @ residuals.reshape(-1)
    return None if np.linalg.cond(hessian) > 1e12 else -np.linalg.solve(hessian, gradient)
