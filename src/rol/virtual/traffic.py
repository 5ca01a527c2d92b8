"""Who else is on the move: oncoming and leading vehicles, side-street traffic, people on the pavements.

`plan_traffic` draws bodies and their poses over the session; `Traffic.meshes_at` sets them down at one time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

try:
    from ..geometry import wrap_angle
except ImportError:  # this file was copied on its own
    from geometry import wrap_angle

if TYPE_CHECKING:
    from .drive import Drive, Route
    from .mesh import Mesh
    from .streets import StreetPlan

STEP_US = 50_000  # traffic is kept at 20 Hz


@dataclass(frozen=True)
class Traffic:
    """Bodies on the move.

    Attributes
    ----------
    meshes : tuple of Mesh
        The bodies, each in its own frame.
    first_stamp_us : int
        Time of the first poses; the others follow every 50 ms [us].
    poses : array, shape (m, n, 3)
        Poses of the m bodies in the town (x, y, yaw), yaw running on without wrapping.
    """

    meshes: tuple[Mesh, ...]
    first_stamp_us: int
    poses: np.ndarray

    def poses_at(self, stamp_us: float) -> np.ndarray:
        """Give the poses of all bodies at one time [us], shape (m, 3); outside the session they stand."""
        last = self.poses.shape[1] - 1
        u = min(max((stamp_us - self.first_stamp_us) / STEP_US, 0.0), float(last))
        i = min(int(u), last - 1)
        return self.poses[:, i] + (u - i) * (self.poses[:, i + 1] - self.poses[:, i])

    def velocities_at(self, stamp_us: float) -> np.ndarray:
        """Give the velocities of all bodies in the town at one time [us], shape (m, 2) [m/s]."""
        step = self.poses_at(stamp_us + 0.5 * STEP_US) - self.poses_at(stamp_us - 0.5 * STEP_US)
        return step[:, :2] / (STEP_US * 1e-6)

    def meshes_at(
        self, plan: StreetPlan, stamp_us: float, first_object: int, middle: np.ndarray, radius: float = 170.0
    ) -> Mesh:
        """Set the bodies near a place down where they are at one time.

        Parameters
        ----------
        plan : StreetPlan
            For the height of the land.
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
        from .mesh import merge_meshes, move_mesh

        poses = self.poses_at(stamp_us)
        near = np.flatnonzero(np.hypot(*(poses[:, :2] - middle[:2]).T) < radius)
        z = plan.ground(poses[near, :2])
        return merge_meshes(
            [
                move_mesh(self.meshes[i], poses[i], h, first_object + int(i))
                for i, h in zip(near, z, strict=True)
            ]
        )


def plan_traffic(
    plan: StreetPlan,
    route: Route,
    drive: Drive,
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
    drive : Drive
        The car's own drive, so that nobody drives through it.
    rng : numpy.random.Generator
        Draws everything.
    n_vehicles, n_people : int
        How many vehicles (a tenth of them bicycles), and people on foot.

    Returns
    -------
    traffic : Traffic
        Who else is on the move.
    """
    stamps = np.arange(drive.stamps_us[0], drive.stamps_us[-1] + STEP_US, STEP_US, dtype=np.int64)
    seconds = (stamps - stamps[0]) * 1e-6
    n_oncoming = round(0.55 * n_vehicles)
    movers = _oncoming(route, seconds, n_oncoming, rng)
    n_same_way = min(2, n_vehicles - n_oncoming)
    for sign in (1.0, -1.0)[:n_same_way]:
        movers.append(_same_way(route, drive, stamps, seconds, sign, rng))
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
    poses = np.array([track for _, track in movers]).reshape(len(movers), len(stamps), 3)
    return Traffic(tuple(mesh for mesh, _ in movers), int(stamps[0]), poses)


def _draw_vehicle(rng: np.random.Generator) -> Mesh:
    from .vehicles import MOVING_KINDS, build_cyclist, build_vehicle, draw_kind

    return build_cyclist(rng) if rng.random() < 0.1 else build_vehicle(draw_kind(MOVING_KINDS, rng), rng)


def _unwrapped(poses: np.ndarray, turn: float) -> np.ndarray:
    return np.column_stack([poses[:, :2], np.unwrap(wrap_angle(poses[:, 2] + turn))])


def _oncoming(
    route: Route, seconds: np.ndarray, count: int, rng: np.random.Generator
) -> list[tuple[Mesh, np.ndarray]]:
    """Vehicles the other way round the loop: one speed, places at least 15 m apart, so they never meet."""
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
    route: Route, drive: Drive, stamps: np.ndarray, seconds: np.ndarray, sign: float, rng: np.random.Generator
) -> tuple[Mesh, np.ndarray]:
    """A vehicle ahead (+1) or behind (-1) in the car's own lane, 13 m away at least and ever farther."""
    progress = np.interp(stamps - stamps[0], drive.stamps_us - stamps[0], drive.progress)
    gap = float(rng.uniform(13.0, 20.0)) + float(rng.uniform(0.1, 1.2)) * seconds
    poses = route.place(progress + sign * gap, route.lane_offset)
    return _draw_vehicle(rng), _unwrapped(poses, 0.0)


def _on_foot(plan: StreetPlan, seconds: np.ndarray, rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    from .vehicles import build_pedestrian

    street = plan.streets[int(rng.integers(len(plan.streets)))]
    side, length = 1 if rng.random() < 0.5 else -1, float(street.arc[-1])
    s = (
        float(rng.uniform(8.0, length - 8.0))
        + float(rng.choice([-1.3, 0.0, 1.3], p=[0.4, 0.2, 0.4])) * seconds
    )
    poses = street.place(np.clip(s, 7.0, length - 7.0), side * (street.half_width + 1.3))
    return build_pedestrian(rng), _unwrapped(poses, 0.0)
