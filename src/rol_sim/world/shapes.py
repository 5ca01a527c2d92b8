"""Bodies of the town as triangles: houses, plants, vehicles, street furniture.

Every function returns a `Mesh` in the object's own frame: origin on the ground, x along the object's length
(a house: along its front), y to the left (a house: out of its front door), z up, metres. `move_mesh` sets it
down in the town.
"""

from __future__ import annotations

import numpy as np

from rol_sim.world.mesh import Material, Mesh, make_mesh, merge_meshes


def build_quads(corners: np.ndarray, material: np.ndarray | int) -> Mesh:
    """Build two triangles from every four corners.

    Parameters
    ----------
    corners : array, shape (n, 4, 3)
        Corners in turn around each quadrangle [m].
    material : int or array, shape (n,)
        `Material` of each quadrangle.

    Returns
    -------
    mesh : Mesh
        2 n triangles.
    """
    corners = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 3)
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.stack([first + (0, 1, 2), first + (0, 2, 3)], axis=1)
    material = np.broadcast_to(np.asarray(material), len(corners))
    return make_mesh(corners.reshape(-1, 3), triangles, np.repeat(material, 2))


def build_box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, material: int) -> Mesh:
    """Build a closed box between two corners [m]."""
    x, y, z = np.meshgrid([x0, x1], [y0, y1], [z0, z1], indexing="ij")
    corners = np.stack([x, y, z], axis=-1).reshape(8, 3)  # corner number = 4 ix + 2 iy + iz
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return build_quads(corners[faces], material)


def build_cylinder(
    radius: float, z0: float, z1: float, material: int, sides: int = 8, lean: float = 0.0
) -> Mesh:
    """Build an upright pole with a lid; `lean` moves its top forward [m]."""
    angle = 2.0 * np.pi * np.arange(sides + 1) / sides
    foot = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides + 1, z0)], axis=1)
    top = foot + (lean, 0.0, z1 - z0)
    shaft = build_quads(np.stack([foot[:-1], foot[1:], top[1:], top[:-1]], axis=1), material)
    middle = np.vstack([top[:-1], [[lean, 0.0, z1]]])
    lid = [[sides, i, (i + 1) % sides] for i in range(sides)]
    return merge_meshes([shaft, make_mesh(middle, lid, material)])


def lay_facade(
    start: np.ndarray, end: np.ndarray, z0: float, z1: float, *, windows: int, recess: float = 0.12
) -> tuple[np.ndarray, np.ndarray]:
    """Lay out an outer wall with rows of windows; the outside lies to the right, seen from start to end.

    Parameters
    ----------
    start, end : array, shape (2,)
        Ends of the wall on the ground [m].
    z0, z1 : float
        Foot and top [m]; a row of windows for every whole 2.7 m.
    windows : int
        Windows per row; 0 makes a blind wall.
    recess : float
        How far the panes lie behind the wall [m].

    Returns
    -------
    corners : array, shape (n, 4, 3)
        Quadrangles of wall, panes and reveals [m].
    materials : array, shape (n,)
        FACADE or GLASS.
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / max(length, 1e-9)
    inward = np.array([-along[1], along[0]])
    s, z = _window_grid(length, z0, z1, windows)
    n, m = len(s) - 1, len(z) - 1
    i, j = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    is_pane = (i % 2 == 1) & (j % 2 == 1)
    # Corners of the wall's grid, on its face [0] and set back [1]: a pane joins four of the latter, a reveal
    # two of each.
    grid = np.empty((2, n + 1, m + 1, 3))
    for layer, depth in enumerate((0.0, recess)):
        grid[layer, ..., :2] = (start + s[:, None] * along + depth * inward)[:, None]
    grid[..., 2] = z
    u, v = i[:, None] + (0, 1, 1, 0), j[:, None] + (0, 0, 1, 1)
    cells = grid[is_pane[:, None].astype(int), u, v]
    face, back = grid[0, u[is_pane], v[is_pane]], cells[is_pane]
    after = [1, 2, 3, 0]
    reveals = np.stack([face, face[:, after], back[:, after], back], axis=2).reshape(-1, 4, 3)
    materials = np.full(len(cells) + len(reveals), int(Material.FACADE))
    materials[: len(cells)][is_pane] = Material.GLASS
    return np.concatenate([cells, reveals]), materials


def _window_grid(length: float, z0: float, z1: float, windows: int) -> tuple[np.ndarray, np.ndarray]:
    """Where walls and windows take turns along the wall and upwards."""
    pitch = length / max(windows, 1)
    centres = (np.arange(windows) + 0.5) * pitch
    half = min(0.55, 0.3 * pitch)
    s = np.concatenate([[0.0], np.stack([centres - half, centres + half], axis=1).ravel(), [length]])
    sills = 2.7 * np.arange(int(z1 / 2.7) if windows else 0) + 0.85
    z = np.concatenate([[z0], np.stack([sills, sills + 1.4], axis=1).ravel(), [z1]])
    return s, z


def build_block(
    x0: float, x1: float, y0: float, y1: float, height: float, rise: float, *, windows: float = 2.4
) -> Mesh:
    """Build a house body: four outer walls and a gable roof with its ridge along x.

    Parameters
    ----------
    x0, x1, y0, y1 : float
        Footprint [m]; y1 is the front.
    height, rise : float
        Height of the eaves, and of the ridge above them (0: flat roof) [m].
    windows : float
        Distance between windows at front and back [m]; the sides have about half as many.

    Returns
    -------
    mesh : Mesh
        The body, standing 1 m deep in the ground.
    """
    front, side = max(1, int((x1 - x0) / windows)), int((y1 - y0) / (2.5 * windows))
    foot = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    walls = [
        lay_facade(foot[k], foot[(k + 1) % 4], -1.0, height, windows=side if k % 2 else front)
        for k in range(4)
    ]
    middle, over = 0.5 * (y0 + y1), 0.3 if rise > 0 else 0.0
    low = height - over * rise / max(0.5 * (y1 - y0), 1e-6)
    left, right = [x0, middle, height + rise], [x1, middle, height + rise]  # ends of the ridge
    roof = [[[x0, y, low], [x1, y, low], right, left] for y in (y0 - over, y1 + over)]
    gables = [[[top[0], y0, height], [top[0], y1, height], top, top] for top in (left, right)]
    corners = np.concatenate([quads for quads, _ in walls] + [np.array(roof + gables)])
    topping = [Material.ROOF, Material.ROOF, Material.FACADE, Material.FACADE]
    return build_quads(corners, np.concatenate([materials for _, materials in walls] + [topping]))


def build_house(width: float, depth: float, height: float, rng: np.random.Generator) -> Mesh:
    """Build a house whose front centre is the origin, with a bay, porch, recess or wing at random.

    Parameters
    ----------
    width, depth, height : float
        Front, depth and eaves height [m].
    rng : numpy.random.Generator
        Draws roof, bay, porch, recess, rear wing and chimney.

    Returns
    -------
    mesh : Mesh
        The house; it reaches from y = +1.2 (bay) to y = -depth - 3 (rear wing) at most.
    """
    half, rise = 0.5 * width, float(rng.uniform(1.5, 3.5)) if rng.random() < 0.8 else 0.0
    parts, split = [], half
    if width > 8.0 and rng.random() < 0.45:  # a part of the front stands back
        split = float(rng.uniform(-0.2, 0.3)) * width
        back = float(rng.uniform(0.8, 2.5))
        parts.append(
            build_block(split, half, -depth, -back, height * float(rng.uniform(0.8, 1.0)), 0.8 * rise)
        )
    parts.append(build_block(-half, split, -depth, 0.0, height, rise))
    if rng.random() < 0.5:
        bay, out = float(rng.uniform(1.8, 2.8)), float(rng.uniform(0.5, 1.1))
        x = float(rng.uniform(-half + 0.3, max(split - bay - 0.3, -half + 0.31)))
        tall = height if rng.random() < 0.3 else min(2.9, height)
        parts.append(build_block(x, min(x + bay, split), -0.1, out, tall, 0.0, windows=1.1))
    if rng.random() < 0.4:
        x = float(rng.uniform(-half, half - 1.6))
        parts += [build_box(x + dx, x + dx + 0.2, -0.1, 1.0, -0.5, 2.4, Material.FACADE) for dx in (0.0, 1.4)]
        parts.append(build_box(x, x + 1.6, -0.1, 1.2, 2.4, 2.6, Material.ROOF))
    if rng.random() < 0.6:
        x = float(rng.uniform(-half, half - 3.5))
        parts.append(
            build_block(x, x + 3.5, -depth - float(rng.uniform(1.5, 3.0)), -depth, min(3.0, height), 0.0)
        )
    if rise:
        x = -half + 0.4
        parts.append(
            build_box(x, x + 0.7, -0.55 * depth, -0.45 * depth, height, height + rise + 1.2, Material.FACADE)
        )
    return merge_meshes(parts)


def build_wall(length: float, height: float, thickness: float, material: int) -> Mesh:
    """Build a straight wall from the origin along x, half a metre deep in the ground [m]."""
    return build_box(0.0, length, -0.5 * thickness, 0.5 * thickness, -0.5, height, material)


def build_railing(length: float, height: float) -> Mesh:
    """Build an iron railing from the origin along x: bars every 0.25 m and two rails [m]."""
    x = np.arange(0.0, length, 0.25)
    turn = np.deg2rad(45.0)  # bars are crossed strips, so they show from every side
    parts = []
    for dx, dy in (
        (0.015 * np.cos(turn), 0.015 * np.sin(turn)),
        (0.015 * np.cos(turn), -0.015 * np.sin(turn)),
    ):
        low = np.column_stack([x - dx, np.full_like(x, -dy), np.full_like(x, -0.2)])
        step = np.array([2 * dx, 2 * dy, 0.0])
        up = np.array([0.0, 0.0, height + 0.2])
        parts.append(
            build_quads(np.stack([low, low + step, low + step + up, low + up], axis=1), Material.METAL)
        )
    for z in (0.15, height - 0.1):
        parts.append(
            build_quads(
                [[[0, 0, z], [length, 0, z], [length, 0, z + 0.05], [0, 0, z + 0.05]]], Material.METAL
            )
        )
    return merge_meshes(parts)


def build_hedge(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """Build a hedge from the origin along x: a closed body whose skin is bumpy by about 0.1 m [m]."""
    n = max(2, round(length / 0.6) + 1)
    x = np.linspace(0.0, length, n)
    profile = np.array([[-0.5, -0.3], [-0.55, 0.5], [-0.35, 1.0], [0.35, 1.0], [0.55, 0.5], [0.5, -0.3]])
    ring = np.empty((n, 6, 3))
    ring[..., 0] = x[:, None]
    ring[..., 1] = profile[:, 0] * width
    ring[..., 2] = np.where(profile[:, 1] > 0, profile[:, 1] * height, profile[:, 1])
    ring += rng.normal(0.0, 0.07, ring.shape)
    sides = np.stack([ring[:-1, :-1], ring[1:, :-1], ring[1:, 1:], ring[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    ends = np.concatenate([ring[[0, -1]][:, [0, 1, 4, 5]], ring[[0, -1]][:, [1, 2, 3, 4]]])
    return build_quads(np.concatenate([sides, ends]), Material.HEDGE)


def build_tree(
    trunk_radius: float,
    crown_base: float,
    crown_radius: float,
    height: float,
    density: float,
    rng: np.random.Generator,
) -> Mesh:
    """Build a tree: a leaning trunk, and a crown of loose flakes through which part of the rays pass.

    Parameters
    ----------
    trunk_radius, crown_base, crown_radius, height : float
        Dimensions [m].
    density : float
        Mean number of flakes that a ray meets on its way through the middle of the crown.
    rng : numpy.random.Generator
        Draws the flakes.

    Returns
    -------
    mesh : Mesh
        TREE_TRUNK and TREE_CROWN.
    """
    half = 0.5 * (height - crown_base)
    # A triangle of side a shows 0.217 a^2 to a ray on average; the density fixes how many are needed.
    side = 0.7
    count = int(density * np.pi * crown_radius * half / (0.217 * side**2))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lumps = 1.0 + 0.18 * np.sin(3.0 * np.arctan2(direction[:, 1], direction[:, 0]) + rng.uniform(0.0, 6.0))
    shell = rng.uniform(0.15, 1.0, count) ** (1.0 / 2.5) * lumps
    centre = direction * shell[:, None] * (crown_radius, crown_radius, half) + (0.0, 0.0, crown_base + half)
    a, b = rng.normal(size=(2, count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b -= a * np.einsum("ij,ij->i", a, b)[:, None]
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    corners = centre[:, None] + side / np.sqrt(3.0) * (
        np.cos(angles)[:, None] * a[:, None] + np.sin(angles)[:, None] * b[:, None]
    )
    crown = make_mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.TREE_CROWN)
    lean = float(rng.normal(0.0, 0.15))
    trunk = build_cylinder(trunk_radius, -0.3, crown_base + 0.7 * half, Material.TREE_TRUNK, lean=lean)
    return merge_meshes([trunk, crown])
