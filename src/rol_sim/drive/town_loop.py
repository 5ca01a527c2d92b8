"""Plan a trajectory along the town's loop: the radar's pose at any microsecond.

The line keeps to the left of the carriageway, wanders a little and is rounded at corners; the speed respects
lateral and longitudinal acceleration; the car stands at the start and at some junctions. All in the town
frame (x, y, yaw).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rol.geometry import wrap_angle
from rol_sim.world.streets import StreetPlan

LATERAL_ACCELERATION = 1.8  # [m/s^2]
ACCELERATION, BRAKING = 1.3, 1.7  # [m/s^2]
POSE_STEP_US = 5_000  # true poses are kept at 200 Hz


@dataclass(frozen=True)
class Route:
    """The rounded centre line of the loop.

    Attributes
    ----------
    points : array, shape (n, 2)
        Evenly spaced points; the last one lies one spacing before the first [m].
    spacing : float
        Distance between neighbours along the line [m].
    junctions : array, shape (k,)
        Arc lengths at which the route passes junctions [m].
    lane_offset : float
        How far to the left of the line one drives [m].
    """

    points: np.ndarray
    spacing: float
    junctions: np.ndarray
    lane_offset: float = 0.9

    @property
    def length(self) -> float:
        """Length of the closed line [m]."""
        return len(self.points) * self.spacing

    def place(self, s: np.ndarray, offset: np.ndarray | float) -> np.ndarray:
        """Return points beside the route.

        Parameters
        ----------
        s : array, shape (n,)
            Arc length, any real number (the loop is closed) [m].
        offset : float or array, shape (n,)
            Distance to the left of the line [m].

        Returns
        -------
        poses : array, shape (n, 3)
            Place, and the direction of the route there (x, y, yaw).
        """
        u = np.asarray(s, dtype=float) / self.spacing % len(self.points)
        ahead = np.roll(self.points, -1, axis=0) - np.roll(self.points, 1, axis=0)
        knots = np.arange(len(self.points) + 1)
        x, y, dx, dy = (
            np.interp(u, knots, np.append(values, values[0]))
            for values in (self.points[:, 0], self.points[:, 1], ahead[:, 0], ahead[:, 1])
        )
        yaw = np.arctan2(dy, dx)
        return np.stack([x - offset * np.sin(yaw), y + offset * np.cos(yaw), yaw], axis=-1)


@dataclass(frozen=True)
class Trajectory:
    """Where the radar is, 200 times a second.

    Attributes
    ----------
    stamps_us : array, shape (n,), int64
        Times, evenly spaced [us].
    poses : array, shape (n, 3)
        Pose of the radar in the town (x, y, yaw); yaw runs on without wrapping.
    speeds : array, shape (n,)
        Forward speed [m/s].
    progress : array, shape (n,)
        Arc length along the route's centre line [m].
    """

    stamps_us: np.ndarray
    poses: np.ndarray
    speeds: np.ndarray
    progress: np.ndarray

    def pose(self, query_us: np.ndarray) -> np.ndarray:
        """Return the poses at any times of the trajectory.

        Parameters
        ----------
        query_us : array, shape (m,)
            Times, whole or fractional [us].

        Returns
        -------
        poses : array, shape (m, 3)
            Poses in the town (x, y, yaw), yaw in [-pi, pi).

        Raises
        ------
        ValueError
            If a time lies outside the trajectory.
        """
        t = self._seconds(query_us)
        knots = (self.stamps_us - self.stamps_us[0]) * 1e-6
        x, y, yaw = (np.interp(t, knots, self.poses[:, i]) for i in range(3))
        return np.stack([x, y, wrap_angle(yaw)], axis=-1)

    def velocity(self, query_us: np.ndarray) -> np.ndarray:
        """Return the velocities in the town at any times of the trajectory, shape (m, 2) [m/s]."""
        t = self._seconds(query_us)
        speed = np.interp(t, (self.stamps_us - self.stamps_us[0]) * 1e-6, self.speeds)
        yaw = self.pose(query_us)[:, 2]
        return np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=-1)

    def _seconds(self, query_us: np.ndarray) -> np.ndarray:
        query_us = np.asarray(query_us)
        is_outside = (query_us < self.stamps_us[0]) | (query_us > self.stamps_us[-1])
        if is_outside.any():
            span = f"{self.stamps_us[0]} .. {self.stamps_us[-1]}"
            raise ValueError(f"time {query_us[is_outside][0]} us lies outside the trajectory, {span} us")
        return (query_us - self.stamps_us[0]) * 1e-6


def build_route(plan: StreetPlan, *, rounding: float = 5.5, spacing: float = 0.25) -> Route:
    """Round the loop's corners.

    Parameters
    ----------
    plan : StreetPlan
        The town's streets.
    rounding : float
        Width of the smoothing along the line [m]; a right-angled corner gets a radius of 1.6 times this.
    spacing : float
        About the distance between the points of the route [m].

    Returns
    -------
    route : Route
        The rounded, evenly spaced, closed line.
    """
    points, gap = _space_evenly(plan.loop, spacing)
    for _ in range(3):  # points crowd in a smoothed corner; spaced anew, the next pass opens it further
        points = gaussian_filter1d(points, rounding / np.sqrt(3.0) / gap, axis=0, mode="wrap")
        points, gap = _space_evenly(points, spacing)
    nearest = [int(np.argmin(np.linalg.norm(points - junction, axis=1))) for junction in plan.junctions]
    return Route(points, gap, np.sort(np.array(nearest) * gap))


def plan_trajectory(
    route: Route,
    first_stamp_us: int,
    duration_s: float,
    rng: np.random.Generator,
    *,
    start_m: float = 20.0,
    cruise_mps: float = 7.5,
    n_stops: int = 2,
    stand_s: float = 1.5,
) -> Trajectory:
    """Plan a trajectory along the route.

    Parameters
    ----------
    route : Route
        The route.
    first_stamp_us : int
        Time of the first radar scan [us]; the trajectory begins one second before it.
    duration_s : float
        Time from the first scan to the end of the last; the trajectory ends one second after it [s].
    rng : numpy.random.Generator
        Draws wander, start offset, speed changes and where the car stops.
    start_m : float
        Where on the route the session starts, before its own offset of 1 to 4 m [m].
    cruise_mps : float
        Speed on free, straight road [m/s].
    n_stops : int
        Junctions at which the car waits for 2 to 5 s.
    stand_s : float
        Time for which the vehicle is stationary after the first scan began [s].

    Returns
    -------
    trajectory : Trajectory
        True poses at 200 Hz.

    Raises
    ------
    ValueError
        If a duration or the speed is not positive.
    """
    if duration_s <= 0 or cruise_mps <= 0:
        raise ValueError(f"drive: duration {duration_s} s and speed {cruise_mps} m/s must be positive")
    start = start_m + float(rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 4.0))
    reach = duration_s * cruise_mps * 1.3 + 40.0
    s = np.arange(start, start + reach, 0.1)
    line = route.place(s, route.lane_offset + _wander(s, start, rng))
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    yaw = np.unwrap(np.arctan2(np.gradient(line[:, 1]), np.gradient(line[:, 0])))
    curvature = gaussian_filter1d(np.abs(np.gradient(yaw, along)), 15)
    limit = cruise_mps * (1.0 + 0.12 * _ripple(s, 45.0, 120.0, rng))
    limit = np.minimum(limit, np.sqrt(LATERAL_ACCELERATION / np.maximum(curvature, 1e-4)))
    stops = _choose_stops(route, start, n_stops, rng, reach=5.0 * duration_s)
    times = _time_of_arrival(along, s, limit, stops, 1.0 + stand_s)
    count, spare = int((duration_s + 2.0) * 1e6 / POSE_STEP_US) + 1, 400
    grid = POSE_STEP_US * 1e-6 * np.arange(count + spare)
    travelled = np.interp(grid, times.ravel(), np.repeat(along, 2))
    travelled = gaussian_filter1d(travelled, 0.25e6 / POSE_STEP_US, mode="nearest")  # no sudden jerks
    speeds, travelled = np.gradient(travelled, POSE_STEP_US * 1e-6)[:count], travelled[:count]
    poses = np.stack([np.interp(travelled, along, v) for v in (line[:, 0], line[:, 1], yaw)], axis=-1)
    stamps = first_stamp_us - 1_000_000 + POSE_STEP_US * np.arange(count, dtype=np.int64)
    return Trajectory(stamps, poses, speeds, np.interp(travelled, along, s))


def _space_evenly(points: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    closed = np.vstack([points, points[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = round(arc[-1] / spacing)
    s = np.arange(count) * arc[-1] / count
    return np.stack([np.interp(s, arc, closed[:, i]) for i in range(2)], axis=-1), float(arc[-1] / count)


def _ripple(s: np.ndarray, shortest: float, longest: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth random curve over arc length, about -1 .. 1."""
    waves, phases = rng.uniform(shortest, longest, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    return np.sin(2.0 * np.pi * s[:, None] / waves + phases).sum(axis=1) / 3.0


def _wander(s: np.ndarray, start: float, rng: np.random.Generator) -> np.ndarray:
    """Sideways deviation: a bias of the day, slow wander, and pulling out from where the car stood."""
    pulling_out = float(rng.uniform(-0.5, 0.5)) * np.exp(-(((s - start) / 14.0) ** 2))
    return float(rng.uniform(-0.15, 0.15)) + 0.25 * _ripple(s, 35.0, 90.0, rng) + pulling_out


def _choose_stops(
    route: Route, start: float, count: int, rng: np.random.Generator, reach: float
) -> list[tuple[float, float]]:
    """Draw junctions to wait at: (arc length 9 m before the junction, waiting time)."""
    places = (route.junctions - 9.0 - start) % route.length
    places = places[(places > 25.0) & (places < reach)]
    chosen = rng.permutation(places)
    kept: list[float] = []
    for place in chosen:
        if len(kept) < count and all(abs(place - other) > 30.0 for other in kept):
            kept.append(float(place))
    return [(start + place, float(rng.uniform(2.0, 5.0))) for place in sorted(kept)]


def _time_of_arrival(
    along: np.ndarray, s: np.ndarray, limit: np.ndarray, stops: list[tuple[float, float]], stand_s: float
) -> np.ndarray:
    """Times of arrival and of departure at every point of the line, shape (n, 2), stationary at the start."""
    v = limit.copy()
    v[0] = 0.0
    wait = np.zeros(len(s))
    wait[0] = stand_s
    for place, seconds in stops:
        i = int(np.searchsorted(s, place))
        v[i], wait[i] = 0.0, seconds
    gap = np.diff(along)
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + 2.0 * ACCELERATION * gap[i - 1]))
    for i in range(len(v) - 2, -1, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2.0 * BRAKING * gap[i]))
    travel = gap / np.maximum(0.5 * (v[1:] + v[:-1]), 1e-3)
    arrival = np.concatenate([[0.0], np.cumsum(travel + wait[:-1])])
    return np.stack([arrival, arrival + wait], axis=-1)
