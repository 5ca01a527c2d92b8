"""The town: streets, houses, gardens and terrain, drawn once, and the differences between sessions.

`build_town` draws what stays. `add_session_objects` adds what a session finds: parked vehicles, the leaves of
its season, cut hedges, changed street furniture. Both are determined by the generator they are given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rol.geometry import transform_points
from rol_sim.world.houses import Builder, build_landmarks, build_sheds, build_street_side, find_free_plot
from rol_sim.world.mesh import Material, Mesh, make_mesh, merge_meshes, move_mesh
from rol_sim.world.shapes import build_hedge, build_quads, build_tree
from rol_sim.world.streets import Street, StreetPlan, build_plan
from rol_sim.world.vehicles import PARKED_KINDS, build_furniture, build_vehicle, draw_kind


@dataclass(frozen=True)
class Town:
    """What stays the same in all sessions, and the places of what changes.

    Attributes
    ----------
    plan : StreetPlan
        Streets, loop, land.
    mesh : Mesh
        Land, kerbs, houses, walls, railings.
    trees : array, shape (n, 6)
        x, y, trunk radius, crown base, crown radius, height [m].
    hedges : array, shape (n, 5)
        x, y, yaw of one end, length, height [m].
    slots : array, shape (n, 3)
        Poses where vehicles may be parked.
    furniture : tuple of (kind, pose)
        Street furniture.
    footprints : array, shape (n, 5)
        Rectangles of the buildings: x, y, yaw, half length, half width.
    """

    plan: StreetPlan
    mesh: Mesh
    trees: np.ndarray
    hedges: np.ndarray
    slots: np.ndarray
    furniture: tuple[tuple[str, np.ndarray], ...]
    footprints: np.ndarray


def build_town(rng: np.random.Generator, *, loop_length: float = 600.0, relief: float = 1.0) -> Town:
    """Draw a town.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws everything; the same generator state gives the same town.
    loop_length : float
        Length of the loop of streets that sessions drive along [m].
    relief : float
        How far the land away from the loop rises and falls [m].

    Returns
    -------
    town : Town
        The town, centred near the origin.
    """
    plan = build_plan(rng, loop_length=loop_length, relief=relief)
    builder = Builder(plan)
    green = build_landmarks(builder, rng)
    for street in plan.streets:
        for side in (1, -1):
            build_street_side(builder, street, side, rng)
    build_sheds(builder, 170, rng)
    trees = _plant_trees(builder, green, rng)
    slots = [_mark_parking(plan, street, side, rng) for street in plan.streets for side in (1, -1)]
    furniture = [piece for street in plan.streets for piece in _furnish(plan, street, rng)]
    hedges = np.array([[*hedge, rng.uniform(0.9, 2.1)] for hedge in builder.hedges]).reshape(-1, 5)
    land = merge_meshes([_build_land(plan, rng), _build_pavements(plan)])
    mesh = merge_meshes([move_mesh(land, (0.0, 0.0, 0.0), object_id=-2), *builder.meshes])
    slots = np.concatenate([*slots, np.array(builder.driveways).reshape(-1, 3)])
    return Town(plan, mesh, trees, hedges, slots, tuple(furniture), builder.footprints)


def add_session_objects(
    town: Town,
    rng: np.random.Generator,
    *,
    parked_share: float = 0.6,
    leaf_density: float = 1.0,
    changed_share: float = 0.08,
) -> Mesh:
    """Draw the objects of one session in the town, in addition to the permanent ones.

    Parameters
    ----------
    town : Town
        The town.
    rng : numpy.random.Generator
        Draws the session.
    parked_share : float
        Fraction of the parking places that are taken, 0 .. 1.
    leaf_density : float
        Leaves on the trees, 1 is usual.
    changed_share : float
        Fraction of hedges cut and of street furniture moved, removed or added.

    Returns
    -------
    mesh : Mesh
        Parked vehicles, plants, furniture; object numbers go on after those of the town.
    """
    number = int(town.mesh.objects.max()) + 1
    bodies: list[tuple[Mesh, np.ndarray]] = []
    for slot in town.slots[rng.random(len(town.slots)) < parked_share]:
        flip = np.pi if rng.random() < 0.2 else 0.0
        jitter = rng.normal(0.0, 1.0, 3) * (0.25, 0.08, np.deg2rad(1.5))
        bodies.append(
            (build_vehicle(draw_kind(PARKED_KINDS, rng), rng), slot + (0.0, 0.0, flip) + _aside(slot, jitter))
        )
    for x, y, trunk, base, radius, height in town.trees:
        spread, tall, leaves = np.clip(rng.normal(1.0, 0.1, 3), 0.75, 1.25)
        crown = build_tree(trunk, base, radius * spread, height * tall, leaf_density * leaves * 1.3, rng)
        bodies.append((crown, np.array([x, y, 0.0])))
    for x, y, yaw, length, height in town.hedges:
        tall = float(rng.uniform(0.6, 0.8) if rng.random() < 3.0 * changed_share else rng.uniform(0.95, 1.08))
        bodies.append(
            (
                build_hedge(length, 0.8 * float(rng.uniform(0.85, 1.15)), height * tall, rng),
                np.array([x, y, yaw]),
            )
        )
    for kind, pose in town.furniture:
        if rng.random() >= changed_share:
            bodies.append((build_furniture(kind, rng), pose))
    for _ in range(int(changed_share * len(town.furniture))):
        street = town.plan.streets[int(rng.integers(len(town.plan.streets)))]
        side = 1 if rng.random() < 0.5 else -1
        at = street.place(float(rng.uniform(8.0, street.arc[-1] - 8.0)), side * (street.half_width + 0.7))
        bodies.append(
            (build_furniture(str(rng.choice(["bin", "sign", "cones", "cabinet"])), rng), _towards(at, side))
        )
    z = town.plan.ground(np.array([pose[:2] for _, pose in bodies]).reshape(-1, 2))
    return merge_meshes(
        [move_mesh(m, p, h, number + i) for i, ((m, p), h) in enumerate(zip(bodies, z, strict=True))]
    )


def _aside(slot: np.ndarray, jitter: np.ndarray) -> np.ndarray:
    c, s = np.cos(slot[2]), np.sin(slot[2])
    return np.array([c * jitter[0] - s * jitter[1], s * jitter[0] + c * jitter[1], jitter[2]])


def _towards(pose: np.ndarray, side: int) -> np.ndarray:
    """Turn a piece of furniture so that its y axis points at the carriageway."""
    return pose + (0.0, 0.0, np.pi if side > 0 else 0.0)


def _far_from_junctions(plan: StreetPlan, points: np.ndarray, distance: float) -> np.ndarray:
    gaps = np.linalg.norm(points[:, None, :2] - plan.junctions[None], axis=2)
    return gaps.min(axis=1) > distance


def _plant_trees(builder: Builder, green: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    plan, places = builder.plan, []
    for street in plan.streets:
        for side in (1, -1):
            if street.trees:
                s = np.cumsum(rng.uniform(0.7, 1.4, 40) * street.trees)
                at = street.place(s[s < street.arc[-1] - 9.0], side * (street.half_width + 0.7))[:, :2]
                places.append(at[_far_from_junctions(plan, at, 10.0) & (plan.clearance(at) > 0.4)])
    street_trees = np.concatenate([np.zeros((0, 2)), *places])
    in_green = rng.uniform(-1.0, 1.0, (14, 2)) * green[3:]
    garden = [find_free_plot(builder, 1.2, 1.2, 2.8, 30.0, rng, tries=4) for _ in range(170)]
    garden_trees = np.array([g[:2] for g in garden if g is not None]).reshape(-1, 2)
    if green[3] > 0:
        garden_trees = np.concatenate([garden_trees, transform_points(green[:3], in_green)])
    xy = np.concatenate([street_trees, garden_trees])
    n, on_street = len(xy), np.arange(len(xy)) < len(street_trees)
    radius = np.where(on_street, rng.uniform(1.3, 2.4, n), rng.uniform(1.2, 3.8, n))
    base = np.where(on_street, rng.uniform(2.2, 3.2, n), rng.uniform(0.6, 2.5, n))
    height = base + radius * rng.uniform(1.6, 2.4, n)
    return np.column_stack([xy, rng.uniform(0.1, 0.3, n), base, radius, height])


def _mark_parking(plan: StreetPlan, street: Street, side: int, rng: np.random.Generator) -> np.ndarray:
    s = 12.0 + np.cumsum(rng.uniform(5.6, 6.4, 60))
    s = s[s < street.arc[-1] - 12.0]
    runs = (
        np.repeat(rng.random(len(s) // 3 + 1), 3)[: len(s)] < street.parking
    )  # three places share one marking
    at = street.place(s[runs], side * (street.half_width - 1.05)).reshape(-1, 3)
    at[:, 2] += 0.0 if side > 0 else np.pi
    return at[_far_from_junctions(plan, at, 12.0)] if len(at) else at


def _furnish(plan: StreetPlan, street: Street, rng: np.random.Generator) -> list[tuple[str, np.ndarray]]:
    pieces, length = [], float(street.arc[-1])
    for kind, spacing, back in (
        ("lamp", 27.0, 0.45),
        ("sign", 38.0, 0.5),
        ("bin", 70.0, 1.6),
        ("cabinet", 110.0, 1.7),
        ("post_box", 190.0, 0.6),
        ("shelter", 210.0, 1.2),
    ):
        s = float(rng.uniform(0.2, 1.0)) * spacing
        while s < length - 7.0:
            side = 1 if rng.random() < 0.5 else -1
            at = street.place(s, side * (street.half_width + back))
            if s > 7.0 and plan.clearance(at[None, :2])[0] > 0.5 * back:
                pieces.append((kind, _towards(at, side)))
            s += spacing * float(rng.uniform(0.7, 1.3))
    if street.on_loop and rng.random() < 0.6:
        for s in (7.5, length - 7.5):
            for side in (1, -1):
                at = street.place(s, side * (street.half_width + 0.5))
                if plan.clearance(at[None, :2])[0] > 0.25:
                    pieces.append(("signal", _towards(at, side)))
    if rng.random() < 0.35:
        first, side = float(rng.uniform(8.0, 14.0)), 1 if rng.random() < 0.5 else -1
        for s in first + 1.6 * np.arange(int(rng.integers(4, 9))):
            at = street.place(float(s), side * (street.half_width + 0.35))
            if s < length - 8.0 and plan.clearance(at[None, :2])[0] > 0.2:
                pieces.append(("bollard", at))
    return pieces


def _build_land(
    plan: StreetPlan, rng: np.random.Generator, spacing: float = 2.0, margin: float = 45.0
) -> Mesh:
    points = np.concatenate([street.centre for street in plan.streets])
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    x, y = np.arange(x0, x1, spacing), np.arange(y0, y1, spacing)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    flat = xy.reshape(-1, 2)
    rough = np.where(plan.clearance(flat) < 2.0, 0.008, 0.04) * rng.normal(size=len(flat))
    corners = np.column_stack([flat, plan.ground(flat) + rough]).reshape(*xy.shape[:2], 3)
    cells = np.stack(
        [corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], axis=2
    ).reshape(-1, 4, 3)
    middle = cells[:, :, :2].mean(axis=1)
    return build_quads(cells, np.where(plan.clearance(middle) < 1.0, Material.GROUND, Material.GRASS))


def _build_pavements(plan: StreetPlan) -> Mesh:
    """Raised footways with upright kerbs; left out where they would cross a carriageway."""
    parts = [make_mesh(np.zeros((0, 3)), np.zeros((0, 3)), 0)]
    for street in plan.streets:
        s = np.arange(0.0, street.arc[-1], 1.0)
        for side in (1, -1):
            kerb = street.place(s, np.full(len(s), side * street.half_width))[:, :2]
            back = street.place(s, np.full(len(s), side * (street.half_width + plan.pavement_width)))[:, :2]
            z = plan.ground(kerb)
            foot, top = np.column_stack([kerb, z - 0.1]), np.column_stack([kerb, z + plan.kerb_height])
            rear = np.column_stack([back, plan.ground(back) + plan.kerb_height])
            is_edge = plan.clearance(kerb) > -0.15
            is_wide = is_edge & (plan.clearance(back) > 0.3)
            edge, wide = is_edge[:-1] & is_edge[1:], is_wide[:-1] & is_wide[1:]
            faces = np.stack([foot[:-1], foot[1:], top[1:], top[:-1]], axis=1)[edge]
            slabs = np.stack([top[:-1], top[1:], rear[1:], rear[:-1]], axis=1)[wide]
            parts += [build_quads(faces, Material.KERB), build_quads(slabs, Material.PAVEMENT)]
    return merge_meshes(parts)
