"""Sample points from a lidar map at true poses, with the precision of a given front end.

The paper states two numbers of its front end, the fractions of its points within 1 m and 2 m of the lidar's
(Sec. IV-B). Here every scan is a mixture of three kinds of points with these two fractions:

- *near*: cells of the map that the radar could see from the true pose, with a small error;
- *beside*: points between 1 m and 2 m off the map, as of walls that are generated too thick or twice;
- *false*: anywhere within range. Some last one scan, some are static in the world for a while, some move with
  the car.

Maps are dense: about 30 % of the false points lie within 1 m of a map point and 47 % within 2 m on the real
route. So at the paper's fractions no more than one point in six is true.

All clouds are in the radar frame, x forward, y left [m].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from rol.compiled import compiled
from rol.geometry import check_fields, check_grid, check_poses, invert, transform_points

KINDS = ("near", "beside", "false")
BEYOND = (
    2.0 / 3.0
)  # of the points beyond 1 m of the map, this fraction is beyond 2 m, see `fraction_within_2m`


class SampledPointsError(ValueError):
    """No points can be sampled from the map or the poses, or no mixture has the given fractions."""


class DenseMapError(SampledPointsError):
    """The map is so dense that more points lie near it by chance than requested.

    Attributes
    ----------
    chance_1m, chance_2m : float
        Fractions of points thrown at random that lie within 1 m and 2 m of the map.
    least_2m : float
        Smallest fraction within 2 m that points with the fraction asked within 1 m can have; NaN where that
        is below ``chance_1m``.
    """

    def __init__(self, message: str, chance_1m: float, chance_2m: float, least_2m: float) -> None:
        super().__init__(message)
        self.chance_1m, self.chance_2m, self.least_2m = chance_1m, chance_2m, least_2m

    def __reduce__(self) -> tuple:
        """Pickle with all arguments, as the error may be raised in another process."""
        return type(self), (str(self), self.chance_1m, self.chance_2m, self.least_2m)


@dataclass(frozen=True)
class FrontEnd:
    """Properties of a front end's points.

    Attributes
    ----------
    fraction_1m, fraction_2m : float
        Fractions of the points within 1 m and 2 m of a point of the map; 0.4 and 0.6 are the paper's
        (Sec. IV-B).
    n_points : int
        Points of a scan. The paper gives no number.
    near_m : float
        Standard deviation of a near point's error in x and in y [m].
    persistent_fraction : float
        Fraction of the false points that last, half of them static in the world, half moving with the car.
    life_scans : float
        Mean lifetime of such a point in scans.
    min_range_m, max_range_m : float
        Range limits of the front end [m]; 64 m is the paper's.

    Raises
    ------
    SampledPointsError
        If a value is out of its range; the message names it.
    """

    fraction_1m: float = 0.40
    fraction_2m: float = 0.60
    n_points: int = 400
    near_m: float = 0.3
    persistent_fraction: float = 0.5
    life_scans: float = 8.0
    min_range_m: float = 2.5
    max_range_m: float = 64.0

    def __post_init__(self) -> None:
        allowed = {
            "[0, 1]": "fraction_1m fraction_2m persistent_fraction",
            "[0, inf)": "n_points near_m min_range_m",
            "[1, inf)": "life_scans",
            "(0, inf)": "max_range_m",
        }
        check_fields(self, allowed, SampledPointsError)


def fraction_within_2m(fraction_1m: float) -> float:
    """Return the fraction of points within 2 m of the map of real front ends with a fraction within 1 m.

    Parameters
    ----------
    fraction_1m : float
        Fraction of the points within 1 m of the map.

    Returns
    -------
    fraction_2m : float
        Rounded to two digits. Two thirds of the points beyond 1 m are beyond 2 m: with the paper's 40 % and
        60 % (Sec. IV-B), with the peaks of eleven real scans near the real map, 70 % and 80 %, and nearly
        with the points that a network generates from these scans, 80 % and 85 %.
    """
    return round(1.0 - BEYOND * (1.0 - fraction_1m), 2)


@dataclass(frozen=True)
class VisiblePoints:
    """Visible cells of a map from many poses.

    Attributes
    ----------
    points : array of int16, shape (m, 2)
        Visible cells in the radar frame [cm], pose after pose.
    starts : array of int64, shape (n + 1,)
        Pose i has the points ``starts[i] : starts[i + 1]``.
    """

    points: np.ndarray
    starts: np.ndarray

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, index: int) -> np.ndarray:
        """Return the points visible from pose `index`, shape (k, 2) [m]."""
        return self.points[self.starts[index] : self.starts[index + 1]] * 0.01


def find_visible_points(
    map_points: np.ndarray,
    poses: np.ndarray,
    *,
    cell: float = 0.25,
    max_range_m: float = 64.0,
    n_beams: int = 400,
    n_surfaces: int = 2,
    depth_m: float = 1.0,
) -> VisiblePoints:
    """Find the map cells that are visible from each pose, by casting beams.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    poses : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    cell : float
        Side of a cell of the occupancy grid [m].
    max_range_m : float
        Where a beam ends [m].
    n_beams : int
        Beams of a turn; 400 are the radar's azimuths.
    n_surfaces : int
        Surfaces that a beam hits before it ends: a radar sees through the first bush.
    depth_m : float
        Cells of a beam closer together than this belong to one surface [m].

    Returns
    -------
    visible : VisiblePoints
        Centres of the visible cells, each once per pose.

    Raises
    ------
    SampledPointsError
        If the map is empty, not finite or too large for a grid.
    """
    map_points, poses = np.asarray(map_points, dtype=np.float64), check_poses(poses)
    if len(map_points) == 0:
        raise SampledPointsError("the map holds no point")
    if not np.isfinite(map_points).all():
        raise SampledPointsError("the map holds a point that is not finite")
    corner = map_points.min(axis=0) - 0.5 * cell
    shape = np.floor((map_points.max(axis=0) - corner) / cell) + 1
    shape = check_grid(shape, map_points, "map", error=SampledPointsError)
    cells = np.floor((map_points - corner) / cell).astype(np.int64)
    occupied = np.zeros(shape, dtype=np.uint8)
    occupied[cells[:, 0], cells[:, 1]] = 1
    places = np.column_stack([(poses[:, :2] - corner) / cell, poses[:, 2]])
    reach, depth = max_range_m / cell, depth_m / cell
    seen = [_cast(occupied, u, v, yaw, n_beams, reach, n_surfaces, depth) for u, v, yaw in places]
    points = [np.rint(points * cell * 100.0).astype(np.int16) for points in seen]
    return VisiblePoints(np.concatenate(points), np.cumsum([0, *map(len, points)]))


@compiled
def _cast(occupied, u0, v0, yaw, n_beams, reach, n_surfaces, depth):
    """Cells visible from one pose, in its own frame and in cells, shape (k, 2)."""
    h, w = occupied.shape
    hits = np.empty(n_beams * 2 * n_surfaces * (int(depth) + 2), dtype=np.int64)
    n = 0
    for beam in range(n_beams):
        angle = 2.0 * np.pi * beam / n_beams
        c, s = np.cos(angle), np.sin(angle)
        surfaces, since, surface_at = 0, 1e9, 0.0
        for step in range(1, int(2 * reach)):
            r = 0.5 * step
            since += 0.5
            i, j = int(np.floor(u0 + r * c)), int(np.floor(v0 + r * s))
            if i < 0 or j < 0 or i >= h or j >= w or occupied[i, j] == 0:
                continue
            if since > depth:
                surfaces, surface_at = surfaces + 1, r
                if surfaces > n_surfaces:
                    break
            since = 0.0
            if r - surface_at < depth and n < len(hits):
                hits[n] = i * w + j
                n += 1
    cells = np.unique(hits[:n])
    points = np.empty((len(cells), 2))
    c, s = np.cos(yaw), np.sin(yaw)
    for k in range(len(cells)):
        u, v = cells[k] // w + 0.5 - u0, cells[k] % w + 0.5 - v0
        points[k, 0], points[k, 1] = c * u + s * v, c * v - s * u
    return points


def solve_mixture(fractions: np.ndarray, fraction_1m: float, fraction_2m: float) -> np.ndarray:
    """Solve for the mixture of the three kinds of points that has two given fractions.

    Parameters
    ----------
    fractions : array, shape (2, 3)
        Fraction of the points of each kind (columns: near, beside, false) within 1 m (first row) and 2 m of
        the map.
    fraction_1m, fraction_2m : float
        Fractions of the mixture.

    Returns
    -------
    weights : array, shape (3,)
        Weights of the kinds, in 0..1, of sum 1.

    Raises
    ------
    DenseMapError
        If points thrown at random lie near the map so often that a mixture would need fewer than none of the
        other kinds.
    SampledPointsError
        If no mixture has these fractions for another reason.
    """
    fractions = np.asarray(fractions, dtype=np.float64)
    weights = np.linalg.solve(np.vstack([fractions, np.ones(3)]), [fraction_1m, fraction_2m, 1.0])
    asked = f"{fraction_1m:.2f} within 1 m and {fraction_2m:.2f} within 2 m"
    if (weights < -1e-9).any():
        if weights[2] >= 0.0 and fraction_1m <= fractions[0, 0]:
            raise _dense_map(fractions, fraction_1m, asked)
        told = ", ".join(f"{kind} {weight:.2f}" for kind, weight in zip(KINDS, weights, strict=True))
        raise SampledPointsError(f"no mixture of points has {asked} here: it would need {told}")
    return np.clip(weights, 0.0, 1.0)


def _dense_map(fractions: np.ndarray, fraction_1m: float, asked: str) -> DenseMapError:
    """Create the error for a map with too many points near it by chance; arguments as for `solve_mixture`."""
    near, chance = fractions[:, 0], fractions[:, 2]
    false = (near[0] - fraction_1m) / (near[0] - chance[0])
    least_2m = near[1] + false * (chance[1] - near[1]) if fraction_1m >= chance[0] else float("nan")
    found = f"by chance {chance[0]:.2f} and {chance[1]:.2f} are"
    least = f"; with {fraction_1m:.2f} within 1 m at least {least_2m:.2f} are within 2 m"
    message = f"the map is too dense for points with {asked}: {found}{least if np.isfinite(least_2m) else ''}"
    return DenseMapError(message, *map(float, (*chance, least_2m)))


def measure_fractions(
    map_points: np.ndarray,
    poses: np.ndarray,
    visible: VisiblePoints,
    front_end: FrontEnd,
    rng: np.random.Generator,
    n_scans: int = 100,
) -> np.ndarray:
    """Measure the fractions of points of each kind near the map, by sampling at some of the poses.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    poses : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    visible : VisiblePoints
        Visible cells of these poses.
    front_end : FrontEnd
        Errors and reach.
    rng : numpy.random.Generator
        Source of randomness.
    n_scans : int
        Poses of the sample, evenly chosen.

    Returns
    -------
    fractions : array, shape (2, 3)
        For `solve_mixture`.

    Raises
    ------
    SampledPointsError
        If nothing of the map is visible from any of these poses.
    """
    tree, found = cKDTree(map_points), []
    for index in np.linspace(0, len(poses) - 1, min(n_scans, len(poses))).astype(int):
        if len(visible[index]):
            clouds = _sample_near(visible[index], 300, front_end, rng), _sample_anywhere(300, front_end, rng)
            near, false = (tree.query(transform_points(poses[index], cloud))[0] for cloud in clouds)
            found.append(
                [
                    [np.mean(near < 1.0), 0.0, np.mean(false < 1.0)],
                    [np.mean(near < 2.0), 1.0, np.mean(false < 2.0)],
                ]
            )
    if not found:
        raise SampledPointsError("nothing of the map is visible from any of the poses")
    return np.mean(found, axis=0)


def sample_points(
    map_points: np.ndarray,
    poses: np.ndarray,
    visible: VisiblePoints,
    front_end: FrontEnd,
    rng: np.random.Generator,
    mixture: np.ndarray | None = None,
) -> Iterator[np.ndarray]:
    """Sample the points of each scan of a trajectory, one scan after the other.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    poses : array, shape (n, 3)
        True poses T_map_radar [m, m, rad].
    visible : VisiblePoints
        Visible cells of these poses.
    front_end : FrontEnd
        Fractions, number of points, errors, range limits, and lifetime of false points.
    rng : numpy.random.Generator
        Source of randomness.
    mixture : array, shape (3,), optional
        Weights of the three kinds, from `solve_mixture`; computed at these poses if not given. For a segment
        of a trajectory pass those of the whole one: in a dense place, where false points lie near the map by
        chance, the segment's own mixture would hold hardly a true point.

    Yields
    ------
    points : array, shape (k, 2)
        Points in the radar frame [m], about ``n_points``; fewer where fewer cells are visible than near
        points are needed.

    Raises
    ------
    SampledPointsError
        If no mixture has the fractions on this map, see `solve_mixture`.
    """
    if mixture is None:
        kinds = measure_fractions(map_points, poses, visible, front_end, rng)
        mixture = solve_mixture(kinds, front_end.fraction_1m, front_end.fraction_2m)
    near, beside, false = (mixture * front_end.n_points).round().astype(int)
    n_kept = round(false * front_end.persistent_fraction)
    standing, riding, tree = np.zeros((0, 2)), np.zeros((0, 2)), cKDTree(map_points)
    for index, pose in enumerate(poses):
        seen = visible[index]
        standing = _renew(standing, pose, n_kept - n_kept // 2, front_end, rng)
        riding = _renew(riding, np.zeros(3), n_kept // 2, front_end, rng)
        again = np.concatenate([transform_points(invert(pose), standing), riding])
        yield np.concatenate(
            [
                _sample_near(seen, near, front_end, rng),
                _sample_beside(seen, beside, pose, tree, rng),
                again + rng.normal(0.0, 0.1, again.shape),
                _sample_anywhere(false - n_kept, front_end, rng),
            ]
        )


def _sample_near(seen: np.ndarray, n: int, front_end: FrontEnd, rng: np.random.Generator) -> np.ndarray:
    """Some of the visible cells, each with a small error."""
    chosen = rng.permutation(len(seen))[:n]
    return seen[chosen] + rng.normal(0.0, front_end.near_m, (len(chosen), 2))


def _sample_beside(
    seen: np.ndarray, n: int, pose: np.ndarray, tree: cKDTree, rng: np.random.Generator
) -> np.ndarray:
    """Points around visible cells, between 1 m and 2 m off the map."""
    if len(seen) == 0:
        return np.zeros((0, 2))
    tried = seen[rng.integers(len(seen), size=12 * n)] + rng.normal(0.0, 2.0, (12 * n, 2))
    away = tree.query(transform_points(pose, tried), distance_upper_bound=2.0)[0]
    return tried[(away >= 1.0) & (away < 2.0)][:n]


def _sample_anywhere(n: int, front_end: FrontEnd, rng: np.random.Generator) -> np.ndarray:
    """Points in any direction at any range, as dense along a beam near as far."""
    ranges = rng.uniform(front_end.min_range_m, front_end.max_range_m, n)
    angles = rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])


def _renew(
    points: np.ndarray, T_frame_radar: np.ndarray, n: int, front_end: FrontEnd, rng: np.random.Generator
) -> np.ndarray:
    """Remove lasting false points at random or out of range, and replace them by new ones."""
    ranges = np.hypot(*(points - T_frame_radar[:2]).T)
    lives = (rng.random(len(points)) < 1.0 - 1.0 / front_end.life_scans) & (ranges < front_end.max_range_m)
    fresh = _sample_anywhere(n - int(lives.sum()), front_end, rng)
    return np.concatenate([points[lives], transform_points(T_frame_radar, fresh)])
