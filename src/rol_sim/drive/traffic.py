"""Simulate traffic: oncoming and leading vehicles, side-street traffic, people on the pavements.

`plan_traffic` draws bodies and their poses over the session; `Traffic.meshes_at` sets them down at one time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rol.geometry import wrap_angle
from rol_sim.drive.town_loop import Route, Trajectory
from rol_sim.world.mesh import Mesh, merge_meshes, move_mesh
from rol_sim.world.streets import StreetPlan
from rol_sim.world.vehicles import MOVING_KINDS, build_cyclist, build_pedestrian, build_vehicle, draw_kind

TRACK_STEP_US = 50_000  # traffic is kept at 20 Hz
EDGE = 3.0  # a body stays that many steps before its first and after its last pose


@dataclass(frozen=True)
class Traffic:
    """Bodies on the move, each of them there for a while.

    Attributes
    ----------
    meshes : tuple of Mesh
        The bodies, each in its own frame.
    first_stamps_us : array, shape (m,), int64
        Time of each body's first pose; the others follow every 50 ms [us].
    tracks : tuple of array, shape (n_i, 3)
        Poses of each body in the world (x, y, yaw), yaw running on without wrapping; at least two. Before the
        first and after the last the body is not there.
    """

    meshes: tuple[Mesh, ...]
    first_stamps_us: np.ndarray
    tracks: tuple[np.ndarray, ...]

    def bodies_at(
        self, stamp_us: float, middle: np.ndarray, radius: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find who is near a place at one time.

        Parameters
        ----------
        stamp_us : float
            Time [us].
        middle : array, shape (2,) or more
            The place [m].
        radius : float
            Bodies farther away are left out [m].

        Returns
        -------
        numbers : array of int, shape (k,)
            Which bodies.
        poses : array, shape (k, 3)
            Where they are (x, y, yaw).
        velocities : array, shape (k, 2)
            Velocity of each in the world [m/s].
        """
        u = (stamp_us - self.first_stamps_us) / TRACK_STEP_US
        last = np.array([len(track) - 1 for track in self.tracks], dtype=np.int64)
        found = []
        for i in np.flatnonzero((u >= -EDGE) & (u <= last + EDGE)):
            k = min(max(int(u[i]), 0), last[i] - 1)
            step = self.tracks[i][k + 1] - self.tracks[i][k]
            pose = self.tracks[i][k] + min(max(u[i] - k, 0.0), 1.0) * step
            if np.hypot(*(pose[:2] - np.asarray(middle)[:2])) < radius:
                found.append((i, pose, step[:2] / (TRACK_STEP_US * 1e-6)))
        numbers, poses, velocities = zip(*found, strict=True) if found else ((), (), ())
        shapes = (-1,), (-1, 3), (-1, 2)
        values = np.array(numbers, dtype=np.int64), np.array(poses), np.array(velocities)
        return tuple(value.reshape(shape) for value, shape in zip(values, shapes, strict=True))

    def meshes_at(
        self,
        ground: Callable[[np.ndarray], np.ndarray],
        stamp_us: float,
        first_object: int,
        middle: np.ndarray,
        radius: float = 170.0,
    ) -> Mesh:
        """Set the bodies near a place down where they are at one time.

        Parameters
        ----------
        ground : callable
            Gives the height of the land at places, shape (n, 2) -> (n,) [m].
        stamp_us : float
            Time [us].
        first_object : int
            Object number of the first body; the others follow.
        middle : array, shape (2,)
            The place [m].
        radius : float
            Bodies farther away are left out [m].

        Returns
        -------
        mesh : Mesh
            The bodies; empty if there are none.
        """
        numbers, poses, _ = self.bodies_at(stamp_us, middle, radius)
        heights = ground(poses[:, :2])
        return merge_meshes(
            [
                move_mesh(self.meshes[i], pose, h, first_object + int(i))
                for i, pose, h in zip(numbers, poses, heights, strict=True)
            ]
        )


def plan_traffic(
    plan: StreetPlan,
    route: Route,
    trajectory: Trajectory,
    rng: np.random.Generator,
    *,
    n_vehicles: int = 16,
    n_people: int = 14,
) -> Traffic:
    """Draw the traffic of a session.

    Parameters
    ----------
    plan : StreetPlan
        The streets.
    route : Route
        The loop; its traffic comes towards the car, leads or follows it.
    trajectory : Trajectory
        The car's own trajectory, so that nobody drives through it.
    rng : numpy.random.Generator
        Draws everything.
    n_vehicles, n_people : int
        How many vehicles (a tenth of them bicycles), and people on foot.

    Returns
    -------
    traffic : Traffic
        Who else is on the move.
    """
    stamps = np.arange(
        trajectory.stamps_us[0], trajectory.stamps_us[-1] + TRACK_STEP_US, TRACK_STEP_US, dtype=np.int64
    )
    seconds = (stamps - stamps[0]) * 1e-6
    n_oncoming = round(0.55 * n_vehicles)
    movers = _oncoming(route, seconds, n_oncoming, rng)
    n_same_way = min(2, n_vehicles - n_oncoming)
    for sign in (1.0, -1.0)[:n_same_way]:
        movers.append(_same_way(route, trajectory, stamps, seconds, sign, rng))
    side_streets = [street for street in plan.streets if not street.on_loop]
    for _ in range(n_vehicles - n_oncoming - n_same_way):
        street = side_streets[int(rng.integers(len(side_streets)))]
        speed, length = float(rng.uniform(3.0, 7.0)), float(street.arc[-1])
        way = np.clip(speed * (seconds - float(rng.uniform(-10.0, seconds[-1]))), 0.0, length - 20.0)
        inward = rng.random() < 0.5
        poses = street.place(length - 6.0 - way if inward else 14.0 + way, 0.0)
        movers.append((_draw_vehicle(rng), _unwrapped(poses, np.pi if inward else 0.0)))
    for _ in range(n_people):
        movers.append(_on_foot(plan, seconds, rng))
    begin = np.full(len(movers), stamps[0], dtype=np.int64)
    return Traffic(tuple(mesh for mesh, _ in movers), begin, tuple(track for _, track in movers))


def _draw_vehicle(rng: np.random.Generator) -> Mesh:
    return build_cyclist(rng) if rng.random() < 0.1 else build_vehicle(draw_kind(MOVING_KINDS, rng), rng)


def _unwrapped(poses: np.ndarray, turn: float) -> np.ndarray:
    return np.column_stack([poses[:, :2], np.unwrap(wrap_angle(poses[:, 2] + turn))])


def _oncoming(
    route: Route, seconds: np.ndarray, count: int, rng: np.random.Generator
) -> list[tuple[Mesh, np.ndarray]]:
    """Oncoming vehicles on the loop: one speed, at least 15 m apart, so they never collide."""
    speed, first = float(rng.uniform(4.5, 7.5)), float(rng.uniform(0.0, route.length))
    room = max(route.length / max(count, 1), 20.0)
    movers = []
    for i in range(min(count, int(route.length / 20.0))):
        slack = max(0.0, 0.5 * (room - 17.0))
        start = first + i * room + float(rng.uniform(-0.8, 0.8)) * slack
        s = start - speed * seconds + 2.0 * np.sin(seconds / 7.0 + first)
        poses = route.place(s, -route.lane_offset - 0.85)
        movers.append((_draw_vehicle(rng), _unwrapped(poses, np.pi)))
    return movers


def _same_way(
    route: Route,
    trajectory: Trajectory,
    stamps: np.ndarray,
    seconds: np.ndarray,
    sign: float,
    rng: np.random.Generator,
) -> tuple[Mesh, np.ndarray]:
    """A vehicle ahead (+1) or behind (-1) in the car's own lane, 13 m away at least and ever farther."""
    progress = np.interp(stamps - stamps[0], trajectory.stamps_us - stamps[0], trajectory.progress)
    gap = float(rng.uniform(13.0, 20.0)) + float(rng.uniform(0.1, 1.2)) * seconds
    poses = route.place(progress + sign * gap, route.lane_offset)
    return _draw_vehicle(rng), _unwrapped(poses, 0.0)


def _on_foot(plan: StreetPlan, seconds: np.ndarray, rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    street = plan.streets[int(rng.integers(len(plan.streets)))]
    side, length = 1 if rng.random() < 0.5 else -1, float(street.arc[-1])
    s = (
        float(rng.uniform(8.0, length - 8.0))
        + float(rng.choice([-1.3, 0.0, 1.3], p=[0.4, 0.2, 0.4])) * seconds
    )
    poses = street.place(np.clip(s, 7.0, length - 7.0), side * (street.half_width + 1.3))
    return build_pedestrian(rng), _unwrapped(poses, 0.0)
