"""Houses and gardens along the streets: their places, without overlap, and their triangles.

A footprint is a row (x, y, yaw, half length, half width) of a rectangle in the plan [m, m, rad, m, m].
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rol.geometry import compose, transform_points
from rol_sim.world.mesh import Material, Mesh, move_mesh
from rol_sim.world.shapes import build_block, build_house, build_railing, build_wall
from rol_sim.world.streets import Street, StreetPlan


@dataclass
class Builder:
    """Collects what has been built: meshes, footprints, and the plants and driveways that sessions add.

    Attributes
    ----------
    plan : StreetPlan
        The streets and the land.
    meshes : list of Mesh
        What stands the same in every session; the place in the list is the object number.
    footprints : array, shape (n, 5)
        Ground that is taken.
    hedges : list of (4,) arrays
        x, y, yaw of one end and length [m].
    driveways : list of (3,) arrays
        Poses of vehicles that may stand off the street.
    """

    plan: StreetPlan
    meshes: list[Mesh] = field(default_factory=list)
    footprints: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))
    hedges: list[np.ndarray] = field(default_factory=list)
    driveways: list[np.ndarray] = field(default_factory=list)

    def add(self, mesh: Mesh, pose: np.ndarray, sink: float = 0.0) -> None:
        """Set a body down on the land."""
        z = float(self.plan.ground(np.asarray(pose)[None, :2])[0]) - sink
        self.meshes.append(move_mesh(mesh, pose, z, object_id=len(self.meshes)))

    def take(self, footprint: np.ndarray) -> None:
        """Mark ground as taken."""
        self.footprints = np.vstack([self.footprints, footprint])

    def is_free(self, footprint: np.ndarray, clearance: float) -> bool:
        """Whether ground is not taken and at least `clearance` metres from every kerb."""
        if overlaps(footprint, self.footprints).any():
            return False
        x, y, yaw, a, b = footprint
        middle = float(self.plan.clearance(np.array([[x, y]]))[0])
        if middle < clearance or middle > clearance + np.hypot(a, b):
            return middle >= clearance
        u, v = np.linspace(-a, a, max(3, int(a))), np.linspace(-b, b, max(3, int(b)))
        corners = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        points = transform_points(np.array([x, y, yaw]), corners)
        return bool((self.plan.clearance(points) >= clearance).all())


def overlaps(footprint: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Find which rectangles overlap one rectangle (separating axes).

    Parameters
    ----------
    footprint : array, shape (5,)
        The one rectangle.
    others : array, shape (n, 5)
        The other rectangles.

    Returns
    -------
    is_overlapping : array, shape (n,), bool
        True where the ground is shared; touching does not count.
    """
    delta = others[:, :2] - footprint[:2]
    reach = np.hypot(others[:, 3], others[:, 4]) + np.hypot(footprint[3], footprint[4])
    is_near = np.einsum("ij,ij->i", delta, delta) < reach**2
    is_overlapping = np.zeros(len(others), dtype=bool)
    if not is_near.any():
        return is_overlapping
    delta, others = delta[is_near], others[is_near]
    is_apart = np.zeros(len(others), dtype=bool)
    for yaw in (np.full(len(others), footprint[2]), others[:, 2]):
        for angle in (yaw, yaw + 0.5 * np.pi):
            axis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            reach = np.zeros(len(others))
            for rectangle in (np.broadcast_to(footprint, others.shape), others):
                turn = angle - rectangle[:, 2]
                reach += np.abs(np.cos(turn)) * rectangle[:, 3] + np.abs(np.sin(turn)) * rectangle[:, 4]
            is_apart |= np.abs((delta * axis).sum(axis=1)) >= reach - 1e-9
    is_overlapping[is_near] = ~is_apart
    return is_overlapping


def build_street_side(builder: Builder, street: Street, side: int, rng: np.random.Generator) -> None:
    """Line one side of a street with houses and front gardens; fills the builder.

    Parameters
    ----------
    builder : Builder
        Takes the houses (changed in place).
    street : Street
        The street.
    side : int
        +1 left, -1 right of the centre line.
    rng : numpy.random.Generator
        Draws everything.
    """
    length, s = float(street.arc[-1]), float(rng.uniform(6.0, 10.0))
    drift = float(rng.normal(0.0, 0.5))
    while s < length - 6.0:
        width = float(rng.uniform(5.0, 9.0) if street.style == "terrace" else rng.uniform(8.0, 14.0))
        drift = 0.8 * drift + float(rng.normal(0.0, 0.35))
        setback = max(
            0.15, street.setback + drift + (float(rng.uniform(2.0, 5.0)) if rng.random() < 0.1 else 0.0)
        )
        if street.style == "mixed" and rng.random() < 0.2:
            width = float(rng.uniform(14.0, 22.0))
        built = _build_plot(builder, street, side, s, width, setback, rng)
        if not built:
            s += 2.0
        elif rng.random() < {"terrace": 0.75, "villas": 0.1, "mixed": 0.35}[street.style]:
            s += width
        else:
            gap = float(rng.uniform(1.0, 7.0))
            if rng.random() < 0.5:
                _add_barrier(builder, street, side, s + width, gap, setback + 1.0, 1.8, rng)
            s += width + gap


def _build_plot(
    builder: Builder,
    street: Street,
    side: int,
    s: float,
    width: float,
    setback: float,
    rng: np.random.Generator,
) -> bool:
    depth = float(rng.uniform(7.0, 11.0))
    height = float(
        rng.choice([4.9, 5.6, 7.8, 8.8, 11.0], p=[0.25, 0.35, 0.2, 0.12, 0.08]) + rng.uniform(-0.4, 0.4)
    )
    front = street.place(s + 0.5 * width, side * (street.half_width + builder.plan.pavement_width + setback))
    front[2] += np.pi if side > 0 else 0.0
    middle = compose(front, np.array([0.0, -0.5 * depth, 0.0]))
    footprint = np.array([*middle, 0.5 * width, 0.5 * depth])
    if not builder.is_free(footprint, builder.plan.pavement_width + 0.1):
        return False
    builder.take(footprint)
    builder.add(build_house(width, depth, height, rng), front, sink=0.2)
    if setback > 1.4:
        opening = float(rng.uniform(1.2, 3.2))
        first = rng.random() < 0.5
        height = float(rng.choice([0.7, 1.0, 1.4, 1.9]))
        _add_barrier(
            builder, street, side, s + (opening if first else 0.0), width - opening, 0.15, height, rng
        )
        if setback > 5.0 and opening > 2.0 and street.style != "terrace":
            at = street.place(
                s + (0.5 * opening if first else width - 0.5 * opening), side * (street.half_width + 4.8)
            )
            builder.driveways.append(at + (0.0, 0.0, 0.5 * np.pi))
    if rng.random() < 0.7:
        back = compose(front, np.array([-0.5 * width, -depth - float(rng.uniform(5.0, 11.0)), 0.0]))
        _add_piece(builder, back, width, float(rng.uniform(1.5, 2.0)), rng)
    if rng.random() < 0.5:
        flank = compose(front, np.array([0.5 * width, -depth - 8.0, 0.5 * np.pi]))
        _add_piece(builder, flank, 7.5, float(rng.uniform(1.5, 2.0)), rng)
    return True


def _add_barrier(
    builder: Builder,
    street: Street,
    side: int,
    s: float,
    length: float,
    back: float,
    height: float,
    rng: np.random.Generator,
) -> None:
    """A piece of wall, hedge or railing along the street, `back` metres behind the pavement."""
    if length < 0.8 or rng.random() < 0.12:
        return
    start = street.place(s, side * (street.half_width + builder.plan.pavement_width + back))
    end = street.place(s + length, side * (street.half_width + builder.plan.pavement_width + back))
    yaw = np.arctan2(end[1] - start[1], end[0] - start[0])
    _add_piece(builder, np.array([start[0], start[1], yaw]), float(np.hypot(*(end - start)[:2])), height, rng)


def _add_piece(
    builder: Builder, start: np.ndarray, length: float, height: float, rng: np.random.Generator
) -> None:
    kind = str(rng.choice(["wall", "hedge", "railing"], p=[0.5, 0.35, 0.15]))
    middle = compose(start, np.array([0.5 * length, 0.0, 0.0]))
    if not builder.is_free(np.array([*middle, 0.5 * length, 0.1]), builder.plan.pavement_width - 0.6):
        return
    if kind == "hedge":
        builder.hedges.append(np.array([*start, length]))
    elif kind == "railing":
        builder.add(build_railing(length, min(height, 1.3)), start)
    else:
        pieces = max(1, int(length / 6.0))  # short pieces follow the land
        for i in range(pieces):
            at = compose(start, np.array([i * length / pieces, 0.0, 0.0]))
            builder.add(build_wall(length / pieces, height, 0.24, Material.WALL), at)


def build_landmarks(builder: Builder, rng: np.random.Generator) -> np.ndarray:
    """Set a church and two large halls, and keep a green free; fills the builder.

    Parameters
    ----------
    builder : Builder
        Takes the buildings (changed in place).
    rng : numpy.random.Generator
        Draws where.

    Returns
    -------
    green : array, shape (5,)
        Footprint of the green.
    """
    church = find_free_plot(builder, 13.0, 6.0, 6.0, 14.0, rng)
    if church is not None:
        builder.add(build_block(-13.0, 6.0, -6.0, 6.0, 9.0, 5.0, windows=4.0), church[:3], sink=0.2)
        builder.add(build_block(6.0, 13.0, -3.5, 3.5, 21.0, 0.0, windows=3.5), church[:3], sink=0.2)
    for a, b, height in ((16.0, 9.0, 7.0), (12.0, 10.0, 12.0)):
        hall = find_free_plot(builder, a, b, 4.0, 12.0, rng)
        if hall is not None:
            builder.add(build_block(-a, a, -b, b, height, 0.0, windows=3.5), hall[:3], sink=0.2)
    green = find_free_plot(builder, 17.0, 12.0, 2.2, 4.5, rng)
    return np.zeros(5) if green is None else green


def build_sheds(builder: Builder, count: int, rng: np.random.Generator) -> None:
    """Fill back yards and the outskirts with sheds, garages and houses off the street; fills the builder."""
    for _ in range(count):
        a, b = float(rng.uniform(1.5, 6.0)), float(rng.uniform(1.5, 4.0))
        place = find_free_plot(builder, a, b, 9.0, 60.0, rng, tries=6)
        if place is not None:
            height = float(rng.uniform(2.2, 3.2) if a * b < 12.0 else rng.uniform(4.0, 8.0))
            builder.add(build_block(-a, a, -b, b, height, float(rng.uniform(0.0, 2.0))), place[:3], sink=0.2)


def find_free_plot(
    builder: Builder,
    a: float,
    b: float,
    nearest: float,
    farthest: float,
    rng: np.random.Generator,
    tries: int = 300,
) -> np.ndarray | None:
    """Take free ground for a rectangle whose nearest point is `nearest` to `farthest` metres from a kerb.

    Parameters
    ----------
    builder : Builder
        Where to look; the ground found is marked as taken.
    a, b : float
        Half length and half width of the rectangle [m].
    nearest, farthest : float
        Distance of its nearest long side to a kerb, about [m].
    rng : numpy.random.Generator
        Draws the places that are tried.
    tries : int
        Places tried before giving up.

    Returns
    -------
    footprint : array, shape (5,), or None
        Where it lies, parallel to a street; None if no free plot was found.
    """
    streets = builder.plan.streets
    for _ in range(tries):
        street = streets[int(rng.integers(len(streets)))]
        side = 1 if rng.random() < 0.5 else -1
        back = float(rng.uniform(nearest, farthest)) + b
        pose = street.place(float(rng.uniform(0.0, street.arc[-1])), side * (street.half_width + back))
        footprint = np.array([*pose, a, b])
        if builder.is_free(footprint, nearest):
            builder.take(footprint)
            return footprint
    return None
