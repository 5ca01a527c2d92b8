"""A trajectory along given poses, and traffic along it: parked, oncoming, leading and following vehicles.

The poses are those of a real session, 4 a second; between them the car moves smoothly. World frame: that of
the poses (x, y, yaw) [m, m, rad].
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from rol_sim.drive.town_loop import POSE_STEP_US, Trajectory
from rol_sim.drive.traffic import TRACK_STEP_US, Traffic
from rol_sim.world.mesh import Mesh, merge_meshes, move_mesh
from rol_sim.world.vehicles import (
    MOVING_KINDS,
    PARKED_KINDS,
    build_cyclist,
    build_pedestrian,
    build_vehicle,
    draw_kind,
)

MARGIN_US = 1_000_000  # the trajectory begins so long before the first scan and ends so long after the last
LANE_M = 3.2  # from the middle of one lane to that of the other; oncoming traffic is on the right
KERB_M = 2.6  # from the middle of the lane to a vehicle parked at the left kerb
SLOT_M = 6.3
CATALOGUE = 24  # so many different vehicles drive about


def interpolate_trajectory(stamps_us: np.ndarray, poses: np.ndarray) -> Trajectory:
    """Interpolate a smooth trajectory through given poses.

    Parameters
    ----------
    stamps_us : array, shape (n,)
        Times of the poses, ascending [us]; at least two.
    poses : array, shape (n, 3)
        Poses (x, y, yaw).

    Returns
    -------
    trajectory : Trajectory
        200 poses a second, from one second before the first pose to one second after the last; there the car
        goes on as it went.
    """
    seconds, yaw = (stamps_us - stamps_us[0]) * 1e-6, np.unwrap(poses[:, 2])
    spline = CubicSpline(seconds, np.column_stack([poses[:, :2], yaw]))
    first = int(stamps_us[0]) - MARGIN_US
    count = (int(stamps_us[-1]) + MARGIN_US - first) // POSE_STEP_US + 1
    times = first + POSE_STEP_US * np.arange(count, dtype=np.int64)
    at = (times - stamps_us[0]) * 1e-6
    inside = np.clip(at, 0.0, seconds[-1])
    velocity = spline(inside, 1)
    dense = spline(inside) + (at - inside)[:, None] * velocity
    speeds = velocity[:, 0] * np.cos(dense[:, 2]) + velocity[:, 1] * np.sin(dense[:, 2])
    progress = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(dense[:, :2], axis=0).T))])
    return Trajectory(times, dense, speeds, progress)


class _DrivenPath:
    """Path of a trajectory, parameterized by arc length; straight beyond both ends.

    Parameters
    ----------
    trajectory : Trajectory
        The trajectory.
    spacing : float
        Distance between the points kept [m].
    """

    def __init__(self, trajectory: Trajectory, spacing: float = 1.0) -> None:
        n = max(int(trajectory.progress[-1] / spacing), 1) + 1
        self.arc = np.linspace(0.0, max(trajectory.progress[-1], 1e-3), n)
        index = np.minimum(np.searchsorted(trajectory.progress, self.arc), len(trajectory.progress) - 1)
        self.poses = trajectory.poses[index]

    def place(self, s: np.ndarray, offset: np.ndarray | float) -> np.ndarray:
        """Return poses beside the line.

        Parameters
        ----------
        s : array, shape (n,)
            Arc length [m].
        offset : float or array, shape (n,)
            Distance to the left of the line [m].

        Returns
        -------
        poses : array, shape (n, 3)
            Places and the direction of the line, yaw running on without wrapping.
        """
        at = np.clip(s, self.arc[0], self.arc[-1])
        x, y, yaw = (np.interp(at, self.arc, self.poses[:, k]) for k in range(3))
        beyond, c, sn = np.asarray(s) - at, np.cos(yaw), np.sin(yaw)
        return np.stack([x + beyond * c - offset * sn, y + beyond * sn + offset * c, yaw], axis=-1)


def park_vehicles(
    trajectory: Trajectory,
    taken: np.ndarray,
    rng: np.random.Generator,
    *,
    parked_share: float,
    first_object: int,
) -> Mesh:
    """Park vehicles at both kerbs, where the map is free and away from the path.

    Parameters
    ----------
    trajectory : Trajectory
        The trajectory.
    taken : array, shape (n, 2)
        Occupied cells of the map [m].
    rng : numpy.random.Generator
        Draws them.
    parked_share : float
        Fraction of the free places that are taken, in runs of five places.
    first_object : int
        Object number of the first vehicle.

    Returns
    -------
    mesh : Mesh
        The vehicles; empty if there is none.
    """
    path, meshes = _DrivenPath(trajectory), []
    s = np.arange(0.5 * SLOT_M, path.arc[-1], SLOT_M)
    things, lane = cKDTree(taken), cKDTree(path.poses[:, :2])
    for offset in (KERB_M, -LANE_M - KERB_M):
        runs = np.repeat(rng.random(len(s) // 5 + 1), 5)[: len(s)] < parked_share
        slots = path.place(s[runs], offset + rng.normal(0.0, 0.1, runs.sum()))
        slots[:, 2] += np.pi * (offset < 0.0) + rng.normal(0.0, 0.03, len(slots))
        ahead = 1.7 * np.stack([np.cos(slots[:, 2]), np.sin(slots[:, 2])], axis=-1)
        is_free = np.ones(len(slots), dtype=bool)
        for part in (-1.0, 0.0, 1.0):
            middle = slots[:, :2] + part * ahead
            is_free &= (things.query(middle)[0] > 1.1) & (lane.query(middle)[0] > 2.3)
        for slot in slots[is_free]:
            body = build_vehicle(draw_kind(PARKED_KINDS, rng), rng)
            meshes.append(move_mesh(body, slot, 0.0, first_object + len(meshes)))
    return merge_meshes(meshes)


def plan_encounters(
    trajectory: Trajectory, rng: np.random.Generator, *, vehicles_per_min: float, people_per_min: float
) -> Traffic:
    """Draw traffic along a recorded trajectory: oncoming, leading and following vehicles, people on foot.

    Parameters
    ----------
    trajectory : Trajectory
        The trajectory.
    rng : numpy.random.Generator
        Draws everything.
    vehicles_per_min, people_per_min : float
        How many vehicles come towards the car, and how many people it passes, a minute.

    Returns
    -------
    traffic : Traffic
        Each body is there while it is near.
    """
    path, bodies = _DrivenPath(trajectory), _draw_catalogue(rng)
    walkers = [build_pedestrian(rng) for _ in range(6)]
    movers: list[tuple[Mesh, int, np.ndarray]] = []
    for stamp in _draw_times(trajectory, vehicles_per_min, 2.5, rng):
        movers.append((bodies[int(rng.integers(CATALOGUE))], *_oncoming(trajectory, path, stamp, rng)))
    for sign in (1.0, -1.0):
        for begin, end in _draw_spans(trajectory, rng):
            track = _same_way(trajectory, path, begin, end, sign, rng)
            movers.append((bodies[int(rng.integers(CATALOGUE))], begin, track))
    for stamp in _draw_times(trajectory, people_per_min, 0.5, rng):
        movers.append((walkers[int(rng.integers(6))], *_on_foot(trajectory, path, stamp, rng)))
    meshes, begins, tracks = zip(*movers, strict=True) if movers else ((), (), ())
    return Traffic(tuple(meshes), np.array(begins, dtype=np.int64), tuple(tracks))


def _draw_catalogue(rng: np.random.Generator) -> list[Mesh]:
    return [
        build_cyclist(rng) if k % 8 == 7 else build_vehicle(draw_kind(MOVING_KINDS, rng), rng)
        for k in range(CATALOGUE)
    ]


def _draw_times(
    trajectory: Trajectory, per_min: float, least_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Times of a Poisson process, neighbours at least some seconds apart, shape (n,), int64 [us]."""
    if per_min <= 0.0:
        return np.zeros(0, dtype=np.int64)
    span_s, gap_s = (trajectory.stamps_us[-1] - trajectory.stamps_us[0]) * 1e-6, 60.0 / per_min
    gaps = least_s + rng.exponential(max(gap_s - least_s, 0.1), int(2 * span_s / gap_s) + 20)
    at = np.cumsum(gaps) - least_s
    return trajectory.stamps_us[0] + (at[at < span_s] * 1e6).astype(np.int64)


def _grid(trajectory: Trajectory, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Times every 50 ms within the trajectory [us], and the car's arc length then [m]."""
    begin = max(int(begin), int(trajectory.stamps_us[0]))
    end = max(min(int(end), int(trajectory.stamps_us[-1])), begin + 2 * TRACK_STEP_US)
    stamps = np.arange(begin, end, TRACK_STEP_US, dtype=np.int64)
    return stamps, np.interp(
        stamps - trajectory.stamps_us[0], trajectory.stamps_us - trajectory.stamps_us[0], trajectory.progress
    )


def _oncoming(
    trajectory: Trajectory, path: _DrivenPath, meet_us: int, rng: np.random.Generator
) -> tuple[int, np.ndarray]:
    speed, offset = float(rng.uniform(5.5, 7.5)), -LANE_M + float(rng.normal(0.0, 0.25))
    stamps, progress = _grid(trajectory, meet_us - 20e6, meet_us + 20e6)
    at_meeting = np.interp(meet_us - stamps[0], stamps - stamps[0], progress)
    poses = path.place(at_meeting - speed * (stamps - meet_us) * 1e-6, offset)
    return int(stamps[0]), poses + (0.0, 0.0, np.pi)


def _draw_spans(trajectory: Trajectory, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Times during which somebody is there, about half of the trajectory [us]."""
    spans, now = [], int(trajectory.stamps_us[0] - rng.uniform(0.0, 40e6))
    while now < trajectory.stamps_us[-1]:
        end = now + int(rng.uniform(20e6, 60e6))
        if end > trajectory.stamps_us[0]:
            spans.append((max(now, int(trajectory.stamps_us[0])), end))
        now = end + int(rng.uniform(20e6, 60e6))
    return spans


def _same_way(
    trajectory: Trajectory, path: _DrivenPath, begin: int, end: int, sign: float, rng: np.random.Generator
) -> np.ndarray:
    """A vehicle ahead (+1) or behind (-1), 9 m away at least; it comes and goes at 60 m."""
    stamps, progress = _grid(trajectory, begin, end)
    along = np.linspace(-1.0, 1.0, len(stamps))
    gap = 9.0 + float(rng.uniform(0.0, 9.0)) + 45.0 * np.abs(along) ** 6
    gap += 1.5 * np.sin((stamps - begin) * 1e-6 / 3.0)
    return path.place(progress + sign * gap, float(rng.normal(0.0, 0.2)))


def _on_foot(
    trajectory: Trajectory, path: _DrivenPath, meet_us: int, rng: np.random.Generator
) -> tuple[int, np.ndarray]:
    stamps, progress = _grid(trajectory, meet_us - 15e6, meet_us + 15e6)
    at_meeting = float(np.interp(meet_us - stamps[0], stamps - stamps[0], progress))
    walked = float(rng.choice([-1.3, 0.0, 1.3], p=[0.4, 0.2, 0.4])) * (stamps - meet_us) * 1e-6
    offset = 3.6 + float(rng.uniform(0.0, 1.0)) if rng.random() < 0.6 else -7.0 - float(rng.uniform(0.0, 1.0))
    return int(stamps[0]), path.place(at_meeting + walked, offset)
