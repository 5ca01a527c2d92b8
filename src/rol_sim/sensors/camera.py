"""Render pictures of the simulated world: a plan from above and a view from a pose. No sensor uses them."""

from __future__ import annotations

import numpy as np

from rol_sim.world.mesh import Material

# Red, green, blue of each `mesh.Material` by name, between 0 and 1.
PAINT = {
    "NONE": (0.86, 0.91, 0.96),
    "GROUND": (0.62, 0.62, 0.63),
    "PAVEMENT": (0.78, 0.76, 0.73),
    "GRASS": (0.66, 0.74, 0.52),
    "KERB": (0.80, 0.79, 0.76),
    "FACADE": (0.76, 0.54, 0.44),
    "GLASS": (0.36, 0.45, 0.54),
    "ROOF": (0.60, 0.40, 0.34),
    "WALL": (0.66, 0.58, 0.50),
    "METAL": (0.35, 0.38, 0.42),
    "VEHICLE": (0.26, 0.42, 0.66),
    "HEDGE": (0.35, 0.50, 0.26),
    "TREE_CROWN": (0.42, 0.58, 0.32),
    "TREE_TRUNK": (0.40, 0.30, 0.22),
    "PERSON": (0.80, 0.35, 0.25),
}
PLAN_HEIGHT_M = 60.0  # where the rays of a plan start
VIEW_SHAPE, VIEW_RAD = (300, 720), np.deg2rad(80.0)  # rows and columns of a view, and its horizontal angle
LIGHT = np.array([-0.35, 0.45, 0.82])  # unit vector to the sun


def _paint_table() -> np.ndarray:
    """Return the colour of every material, shape (n_materials, 3), grey where none is set."""
    table = np.full((max(Material) + 1, 3), 0.6)
    for material in Material:
        table[material] = PAINT.get(material.name, (0.6, 0.6, 0.6))
    return table


def plan_rays(centre: np.ndarray, half_m: float, pixel_m: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Aim rays straight down on a grid of places.

    Parameters
    ----------
    centre : array-like, shape (2,)
        Middle of the plan [m].
    half_m, pixel_m : float
        Half the edge of the plan and the edge of a pixel [m].

    Returns
    -------
    rays : array, shape (n * n, 6), float32
        Origins and directions.
    shape : tuple of int
        (n, n): row 0 at the largest y, column 0 at the smallest x.
    """
    offsets = np.arange(-half_m + 0.5 * pixel_m, half_m, pixel_m)
    x, y = np.meshgrid(centre[0] + offsets, centre[1] - offsets)
    rays = np.zeros((x.size, 6), dtype=np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x.ravel(), y.ravel(), PLAN_HEIGHT_M, -1.0
    return rays, x.shape


def view_rays(pose: np.ndarray, height: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Aim the rays of a pinhole camera that looks level along a pose.

    Parameters
    ----------
    pose : array-like, shape (3,)
        Place and direction of view (x, y, yaw) [m, m, rad].
    height : float
        Height of the camera [m].

    Returns
    -------
    rays : array, shape (rows * width, 6), float32
        Origins and unit directions.
    shape : tuple of int
        (rows, width).
    """
    rows, width = VIEW_SHAPE
    focal = 0.5 * width / np.tan(0.5 * VIEW_RAD)
    left, up = np.meshgrid(
        (0.5 * width - 0.5 - np.arange(width)) / focal, (0.45 * rows - np.arange(rows)) / focal
    )
    c, s = np.cos(pose[2]), np.sin(pose[2])
    directions = np.stack([c - s * left, s + c * left, up], axis=-1).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to((pose[0], pose[1], height), directions.shape)
    return np.hstack([origins, directions]).astype(np.float32), (rows, width)


def render(scene: object, rays: np.ndarray, shape: tuple[int, int], haze_m: float = 250.0) -> np.ndarray:
    """Render first hits with sunlight, cast shadows and haze.

    Parameters
    ----------
    scene : rol_sim.world.scene.Scene
        The scene.
    rays : array, shape (n, 6), float32
        From `plan_rays` or `view_rays`.
    shape : tuple of int
        Rows and columns, n in all.
    haze_m : float
        Distance at which two thirds of the colour is the sky's [m].

    Returns
    -------
    picture : array, shape (rows, columns, 3)
        Colours between 0 and 1.
    """
    hits = scene.cast(rays)
    is_hit = np.isfinite(hits.t)
    places = rays[is_hit, :3] + rays[is_hit, 3:] * hits.t[is_hit, None] + 0.02 * hits.normals[is_hit]
    to_sun = np.broadcast_to(LIGHT / np.linalg.norm(LIGHT), places.shape)
    in_shadow = np.isfinite(scene.cast(np.hstack([places, to_sun]).astype(np.float32)).t)
    lit = np.clip(hits.normals[is_hit] @ to_sun[0], 0.0, 1.0) * np.where(in_shadow, 0.15, 1.0)
    table = _paint_table()
    colours = table[hits.material]
    sky = table[0]
    clear = np.exp(-hits.t[is_hit, None] / haze_m)
    colours[is_hit] = clear * colours[is_hit] * (0.45 + 0.6 * lit[:, None]) + (1.0 - clear) * sky
    return np.clip(colours, 0.0, 1.0).reshape(*shape, 3)
