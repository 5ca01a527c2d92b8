"""Bodies that differ between sessions: cars, vans, buses, bicycles, people, and the furniture of the street.

Frames as in `rol_sim.world.shapes`: origin on the ground in the middle of the body, x forward, y left, z up,
metres.
"""

from __future__ import annotations

import numpy as np

from rol_sim.world.mesh import Material, Mesh, merge_meshes
from rol_sim.world.shapes import build_box, build_cylinder, build_quads

# Side views (x, z), clockwise from the lower front corner, before scaling by length and height; the two
# numbers after them are the first and the last corner of the glazed part.
_PROFILES = {
    "car": (
        [
            (0.49, 0.17),
            (0.50, 0.45),
            (0.47, 0.52),
            (0.27, 0.63),
            (0.12, 0.98),
            (-0.22, 1.00),
            (-0.40, 0.66),
            (-0.49, 0.62),
            (-0.50, 0.20),
        ],
        3,
        6,
    ),
    "estate": (
        [
            (0.49, 0.17),
            (0.50, 0.45),
            (0.47, 0.52),
            (0.27, 0.62),
            (0.12, 0.97),
            (-0.40, 1.00),
            (-0.48, 0.60),
            (-0.50, 0.50),
            (-0.50, 0.20),
        ],
        3,
        6,
    ),
    "van": (
        [
            (0.49, 0.14),
            (0.50, 0.38),
            (0.46, 0.48),
            (0.36, 0.54),
            (0.25, 0.98),
            (0.10, 1.00),
            (-0.49, 1.00),
            (-0.50, 0.60),
            (-0.50, 0.16),
        ],
        3,
        4,
    ),
    "lorry": (
        [
            (0.49, 0.12),
            (0.50, 0.35),
            (0.50, 0.45),
            (0.49, 0.75),
            (0.27, 0.78),
            (0.26, 1.00),
            (-0.50, 1.00),
            (-0.50, 0.60),
            (-0.50, 0.25),
        ],
        2,
        3,
    ),
    "bus": (
        [
            (0.49, 0.10),
            (0.50, 0.30),
            (0.50, 0.35),
            (0.49, 0.90),
            (0.48, 1.00),
            (-0.49, 1.00),
            (-0.50, 0.90),
            (-0.50, 0.35),
            (-0.50, 0.12),
        ],
        2,
        6,
    ),
}
_SIZES = {  # length, width, height [m] and their spread
    "car": ((4.1, 1.75, 1.45), 0.06),
    "estate": ((4.6, 1.82, 1.55), 0.06),
    "van": ((5.2, 1.98, 2.2), 0.08),
    "lorry": ((7.5, 2.35, 3.1), 0.08),
    "bus": ((10.2, 2.5, 3.0), 0.04),
}
PARKED_KINDS = (("car", 0.58), ("estate", 0.28), ("van", 0.14))
MOVING_KINDS = (("car", 0.5), ("estate", 0.2), ("van", 0.14), ("lorry", 0.06), ("bus", 0.1))


def build_vehicle(kind: str, rng: np.random.Generator) -> Mesh:
    """Build a motor vehicle of a kind, its size drawn about the kind's mean.

    Parameters
    ----------
    kind : str
        "car", "estate", "van", "lorry" or "bus".
    rng : numpy.random.Generator
        Draws the size.

    Returns
    -------
    mesh : Mesh
        VEHICLE body with GLASS panes.
    """
    (length, width, height), spread = _SIZES[kind]
    length, width, height = np.array([length, width, height]) * np.clip(
        rng.normal(1.0, spread, 3), 0.85, 1.15
    )
    profile, glass_from, glass_to = _PROFILES[kind]
    x, z = np.array(profile).T * [[length], [height]]
    belt = 0.6 * height
    half = 0.5 * width * np.where(z > belt, 0.86 if kind in ("car", "estate") else 0.97, 1.0)
    left, right = np.column_stack([x, half, z]), np.column_stack([x, -half, z])
    n = len(x)
    is_glass = np.zeros(n, dtype=bool)
    is_glass[[glass_from, glass_to - 1]] = True  # windscreen and rear window; the roof between them is metal
    hull = np.stack([left, np.roll(left, -1, axis=0), np.roll(right, -1, axis=0), right], axis=1)
    parts = [build_quads(hull, np.where(is_glass, Material.GLASS, Material.VEHICLE))]
    for side in (left, right):
        middle = np.array([0.0, side[:, 1].mean(), belt])
        fan = np.stack([np.broadcast_to(middle, (n, 3)), side, np.roll(side, -1, axis=0)], axis=1)
        upper = (side[:, 2] > belt) & (np.roll(side[:, 2], -1) > belt)
        glazed = upper & (kind != "lorry") & (kind != "van")
        parts.append(build_quads(fan[:, [0, 1, 2, 2]], np.where(glazed, Material.GLASS, Material.VEHICLE)))
    for axle in (0.31 * length, -0.29 * length):  # wheels close the gap under the body in part
        for y in (0.5 * width - 0.2, -0.5 * width):
            parts.append(build_box(axle - 0.3, axle + 0.3, y, y + 0.2, 0.0, 0.55, Material.VEHICLE))
    return merge_meshes(parts)


def draw_kind(kinds: tuple[tuple[str, float], ...], rng: np.random.Generator) -> str:
    """Draw a kind of vehicle from a table of kinds and fractions."""
    names, shares = zip(*kinds, strict=True)
    return str(rng.choice(names, p=np.array(shares) / np.sum(shares)))


def build_cyclist(rng: np.random.Generator) -> Mesh:
    """Build a person on a bicycle."""
    lean = float(rng.uniform(0.1, 0.3))
    rider = build_cylinder(0.2, 0.8, float(rng.uniform(1.6, 1.8)), Material.PERSON, lean=lean)
    frame = build_box(-0.8, 0.8, -0.02, 0.02, 0.35, 0.75, Material.METAL)
    wheels = [build_box(x - 0.3, x + 0.3, -0.02, 0.02, 0.05, 0.65, Material.METAL) for x in (-0.55, 0.55)]
    return merge_meshes([rider, frame, *wheels])


def build_pedestrian(rng: np.random.Generator) -> Mesh:
    """Build a person on foot."""
    return build_cylinder(
        float(rng.uniform(0.18, 0.26)), 0.0, float(rng.uniform(1.5, 1.9)), Material.PERSON, sides=6
    )


def build_furniture(kind: str, rng: np.random.Generator) -> Mesh:
    """Build a piece of street furniture.

    Parameters
    ----------
    kind : str
        "lamp", "sign", "signal" (traffic light), "bollard", "bin", "post_box", "shelter", "cabinet", "cones".
    rng : numpy.random.Generator
        Draws dimensions.

    Returns
    -------
    mesh : Mesh
        The piece; x points along the street, y towards the carriageway.

    Raises
    ------
    ValueError
        If the kind is not known.
    """
    metal = Material.METAL
    if kind == "lamp":
        tall = float(rng.uniform(5.0, 8.0))
        arm = build_box(-0.06, 0.06, 0.0, 1.4, tall - 0.1, tall, metal)
        return merge_meshes(
            [build_cylinder(0.11, -0.3, 1.2, metal), build_cylinder(0.06, 1.2, tall, metal), arm]
        )
    if kind == "sign":
        top, half = float(rng.uniform(2.1, 2.8)), float(rng.uniform(0.25, 0.45))
        turn = np.deg2rad(rng.uniform(-25.0, 25.0))
        dx, dy = -half * np.sin(turn), half * np.cos(turn)
        plate = [[[-dx, -dy, top - 2 * half], [dx, dy, top - 2 * half], [dx, dy, top], [-dx, -dy, top]]]
        return merge_meshes([build_cylinder(0.04, -0.3, top, metal, sides=6), build_quads(plate, metal)])
    if kind == "signal":
        head = build_box(-0.15, 0.15, -0.15, 0.15, 2.3, 3.2, metal)
        return merge_meshes([build_cylinder(0.06, -0.3, 2.4, metal), head])
    if kind == "bollard":
        return build_cylinder(float(rng.uniform(0.06, 0.1)), -0.3, float(rng.uniform(0.9, 1.1)), metal)
    if kind == "bin":
        return build_cylinder(0.28, -0.1, 1.1, metal)
    if kind == "post_box":
        return build_cylinder(0.24, -0.1, 1.6, metal, sides=12)
    if kind == "cabinet":
        return build_box(-0.6, 0.6, -0.2, 0.2, -0.1, 1.2, metal)
    if kind == "cones":
        return merge_meshes(
            [build_box(x - 0.2, x + 0.2, -0.05, 0.05, 0.1, 1.0, metal) for x in (-3.0, -1.0, 1.0, 3.0)]
        )
    if kind == "shelter":
        back = build_quads(
            [[[-2.0, -0.6, 0.2], [2.0, -0.6, 0.2], [2.0, -0.6, 2.2], [-2.0, -0.6, 2.2]]], Material.GLASS
        )
        end = build_quads(
            [[[-2.0, -0.6, 0.2], [-2.0, 0.5, 0.2], [-2.0, 0.5, 2.2], [-2.0, -0.6, 2.2]]], Material.GLASS
        )
        posts = [build_box(x - 0.05, x + 0.05, -0.65, -0.55, -0.2, 2.4, metal) for x in (-2.0, 0.0, 2.0)]
        return merge_meshes([back, end, *posts, build_box(-2.1, 2.1, -0.7, 0.7, 2.35, 2.45, metal)])
    raise ValueError(f"unknown kind of street furniture: {kind!r}")
