"""Build a 3D world from a flat lidar map: each occupied cell becomes an upright piece of surface.

A map holds places, not heights or materials. Both are guessed from the
neighbourhood: long and straight is a wall or a house front, scattered is vegetation, small and lonely is a
pole or a vehicle. Each session sees the world with some changes against the map. World frame:
that of the map, z up from the road [m].
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rol.compiled import compiled
from rol.geometry import check_grid
from rol_sim.world.mesh import Material, Mesh, make_mesh, merge_meshes

LINK_M = 0.8  # cells nearer than this belong together ...
ROW_LINK_M, ROW_BEND = (
    1.6,
    np.deg2rad(25.0),
)  # ... in a straight row also across gaps, if it goes on so straight
REACH_M, STRIP_M = 3.0, 0.3  # length and half width of the strips in which rows are looked for, to each side
N_WAYS = 36  # directions over half a turn
ROW_CELLS, ROW_CONTRAST = (
    8,
    2.4,
)  # a row has so many cells in its strip, and so many times the mean of all strips
HOUSE_M, BARRIER_M = 9.0, 2.5  # lengths from which a straight row is a house front, and a wall
LONELY_CELLS = 4  # a group of so few cells is a pole
VEHICLE_M = (1.2, 5.5)  # sizes of lonely groups that are vehicles
GROUND_TILE_M = 8.0
PLANT_SPREAD_M = 0.25  # how far leaves and twigs are from where they were, standard deviation


class Kind(IntEnum):
    """Class of a map cell."""

    FACADE = 0
    WALL = 1
    PLANT = 2
    POLE = 3
    VEHICLE = 4


@dataclass(frozen=True)
class Cells:
    """Occupied cells of a map and their classes.

    Attributes
    ----------
    points : array, shape (n, 2)
        Places; those of straight rows are moved onto their line [m].
    headings : array, shape (n,)
        Direction of the row that a cell belongs to [rad].
    kinds : array, shape (n,), uint8
        `Kind` of each cell.
    groups : array, shape (n,), int64
        Number of the connected group that it belongs to: one house front, one hedge, one pole.
    """

    points: np.ndarray
    headings: np.ndarray
    kinds: np.ndarray
    groups: np.ndarray

    def take(self, index: np.ndarray) -> Cells:
        """Select cells by index."""
        return Cells(self.points[index], self.headings[index], self.kinds[index], self.groups[index])


def classify_cells(points: np.ndarray) -> Cells:
    """Classify the occupied cells of a map by their neighbourhoods.

    Parameters
    ----------
    points : array, shape (n, 2)
        Middles of the occupied cells [m].

    Returns
    -------
    cells : Cells
        In the same order.

    Raises
    ------
    ValueError
        If the map is empty, not finite or too large for a grid.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"map: expected a finite array (n, 2) with at least one point, got {points.shape}")
    order, cell_of, starts = _sort_into_cells(points, REACH_M)
    counts, n_near = _count_strips(points, order, cell_of, starts, REACH_M, STRIP_M, N_WAYS)
    best = counts.argmax(axis=1)
    in_row = counts[np.arange(len(points)), best]
    is_straight = (in_row >= ROW_CELLS) & (in_row > ROW_CONTRAST * counts.mean(axis=1))
    ways = np.pi * best / N_WAYS
    headings, on_line = _fit_strips(points, order, cell_of, starts, REACH_M, STRIP_M, ways)
    groups = _link(points, headings, is_straight)
    size, count = _group_sizes(points, groups)
    kinds = np.full(len(points), Kind.PLANT, dtype=np.uint8)
    kinds[is_straight & (size >= BARRIER_M)] = Kind.WALL
    kinds[is_straight & (size >= HOUSE_M)] = Kind.FACADE
    is_lonely = n_near <= count + 2
    kinds[~is_straight & is_lonely & (count <= LONELY_CELLS)] = Kind.POLE
    is_car = (size >= VEHICLE_M[0]) & (size <= VEHICLE_M[1]) & (count > LONELY_CELLS)
    kinds[is_lonely & is_car & (kinds == Kind.PLANT)] = Kind.VEHICLE
    is_row = kinds <= Kind.WALL
    return Cells(np.where(is_row[:, None], on_line, points), headings, kinds, groups)


def crop_cells(cells: Cells, places: np.ndarray, radius: float, *, clear_m: float = 0.0) -> Cells:
    """Keep the cells within a radius of any place, shape (m, 2), and not nearer than `clear_m` [m]."""
    gaps = cKDTree(places).query(cells.points, distance_upper_bound=radius)[0]
    return cells.take(np.flatnonzero(np.isfinite(gaps) & (gaps >= clear_m)))


def _sort_into_cells(points: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort points into square cells: their order, each one's cell, and the start of each cell."""
    shape = check_grid(np.floor(np.ptp(points, axis=0) / side) + 1, points, "map", n_bytes=32)
    cell_of = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    flat = cell_of[:, 0] * shape[1] + cell_of[:, 1]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(shape[0] * shape[1] + 1))
    return order, cell_of, np.stack([starts[:-1], starts[1:]], axis=-1).reshape(*shape, 2)


@compiled
def _count_strips(points, order, cell_of, starts, reach, half, n_ways):  # pragma: no cover (compiled)
    """Count the neighbours in a strip through each point, for n directions over half a turn."""
    counts = np.ones((len(points), n_ways), dtype=np.int16)
    n_near = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        row, column = cell_of[i]
        for r in range(max(row - 1, 0), min(row + 2, starts.shape[0])):
            for c in range(max(column - 1, 0), min(column + 2, starts.shape[1])):
                for k in range(starts[r, c, 0], starts[r, c, 1]):
                    dx, dy = points[order[k], 0] - points[i, 0], points[order[k], 1] - points[i, 1]
                    distance = np.hypot(dx, dy)
                    if distance > reach:
                        continue
                    n_near[i] += 1
                    if order[k] == i:
                        continue
                    middle = np.arctan2(dy, dx) * n_ways / np.pi
                    width = n_ways / 2.0 if distance <= half else np.arcsin(half / distance) * n_ways / np.pi
                    for way in range(int(np.ceil(middle - width)), int(np.ceil(middle + width))):
                        counts[i, way % n_ways] += 1
    return counts, n_near


@compiled
def _fit_strips(points, order, cell_of, starts, reach, half, ways):  # pragma: no cover (compiled)
    """Fit a line to the neighbours in each point's strip: its heading [rad], and the point moved onto it."""
    headings, moved = ways.copy(), points.copy()
    for i in range(len(points)):
        row, column = cell_of[i]
        cosine, sine = np.cos(ways[i]), np.sin(ways[i])
        n, u, v, uu, uv = 0, 0.0, 0.0, 0.0, 0.0
        for r in range(max(row - 1, 0), min(row + 2, starts.shape[0])):
            for c in range(max(column - 1, 0), min(column + 2, starts.shape[1])):
                for k in range(starts[r, c, 0], starts[r, c, 1]):
                    dx, dy = points[order[k], 0] - points[i, 0], points[order[k], 1] - points[i, 1]
                    along, across = cosine * dx + sine * dy, cosine * dy - sine * dx
                    if dx * dx + dy * dy <= reach * reach and abs(across) <= half:
                        n, u, v = n + 1, u + along, v + across
                        uu, uv = uu + along * along, uv + along * across
        u, v = u / n, v / n
        slope = (uv / n - u * v) / max(uu / n - u * u, 1e-9)
        headings[i] += np.arctan(slope)
        moved[i, 0] -= (v - slope * u) * sine
        moved[i, 1] += (v - slope * u) * cosine
    return headings, moved


def _link(points: np.ndarray, headings: np.ndarray, is_straight: np.ndarray) -> np.ndarray:
    """Number the connected groups: cells of straight rows in one direction, and the rest."""
    a, b = cKDTree(points).query_pairs(ROW_LINK_M, output_type="ndarray").T
    same_way = np.abs(np.sin(headings[a] - headings[b])) < np.sin(ROW_BEND)
    near = np.hypot(*(points[a] - points[b]).T) < LINK_M
    linked = np.where(is_straight[a], same_way, near) & (is_straight[a] == is_straight[b])
    a, b = a[linked], b[linked]
    links = coo_array((np.ones(len(a), dtype=bool), (a, b)), shape=(len(points),) * 2)
    return connected_components(links, directed=False)[1].astype(np.int64)


def _group_sizes(points: np.ndarray, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal of the box around each point's group [m], and the number of cells in it."""
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    low = np.minimum.reduceat(points[order], starts)
    high = np.maximum.reduceat(points[order], starts)
    return np.hypot(*(high - low).T)[groups], np.bincount(groups)[groups]


def change_cells(
    cells: Cells,
    rng: np.random.Generator,
    *,
    missing_fraction: float = 0.05,
    plant_spread_m: float = PLANT_SPREAD_M,
) -> Cells:
    """Remove and move cells, as time since the map was made would.

    Parameters
    ----------
    cells : Cells
        The map as it was.
    rng : numpy.random.Generator
        Draws the changes.
    missing_fraction : float
        Fraction of the poles, vehicles and plants that are gone, whole groups of them. Walls and fronts stay,
        but a fifth of this fraction of their cells is hidden or open: doors, gates.
    plant_spread_m : float
        How far leaves and twigs are from where they were, standard deviation [m].

    Returns
    -------
    cells : Cells
        What is left.
    """
    n_groups = int(cells.groups.max(initial=-1)) + 1
    is_row = cells.kinds <= Kind.WALL
    gone = rng.random(n_groups)[cells.groups] < missing_fraction
    open_ = rng.random(len(cells.points)) < 0.2 * missing_fraction
    kept = cells.take(np.flatnonzero(np.where(is_row, ~open_, ~gone)))
    shift = rng.normal(0.0, plant_spread_m, kept.points.shape) * (kept.kinds == Kind.PLANT)[:, None]
    return Cells(kept.points + shift, kept.headings, kept.kinds, kept.groups)


def draw_unmapped(cells: Cells, rng: np.random.Generator, *, fraction: float = 0.1) -> Cells:
    """Draw objects that a map does not show: posts, bins, shrubs.

    Parameters
    ----------
    cells : Cells
        The whole map.
    rng : numpy.random.Generator
        Draws the objects.
    fraction : float
        Groups drawn, as a fraction of the groups of the map. Each stands some metres from a mapped cell,
        seven in ten a lonely post, the others shrubs of four to twelve cells.

    Returns
    -------
    cells : Cells
        What stands there besides; the group numbers follow those of the map.
    """
    first = int(cells.groups.max(initial=-1)) + 1
    n = round(fraction * len(np.unique(cells.groups)))
    anchors = cells.points[rng.integers(len(cells.points), size=n)] + rng.normal(0.0, 3.0, (n, 2))
    is_post = rng.random(n) < 0.7
    sizes = np.where(is_post, 1, rng.integers(4, 13, n))
    owner = np.repeat(np.arange(n), sizes)
    points = anchors[owner] + rng.normal(0.0, 0.35, (len(owner), 2)) * ~is_post[owner, None]
    kinds = np.where(is_post, Kind.POLE, Kind.PLANT).astype(np.uint8)[owner]
    return Cells(points, rng.uniform(0.0, np.pi, len(owner)), kinds, first + owner)


def join_cells(first: Cells, second: Cells) -> Cells:
    """Concatenate two sets of cells; their group numbers are kept."""
    return Cells(*(np.concatenate([getattr(first, f.name), getattr(second, f.name)]) for f in fields(Cells)))


def build_pieces(cells: Cells, seed: int, *, leaf_density: float = 1.0) -> Mesh:
    """Build upright surfaces from the cells of a map.

    Parameters
    ----------
    cells : Cells
        What stands where.
    seed : int
        Draws heights and shapes; those of a group are the same however many of its cells are given.
    leaf_density : float
        Leaves on the plants, 1 is usual.

    Returns
    -------
    mesh : Mesh
        FACADE 4 to 9 m and WALL 1.3 to 2.8 m high, TREE_CROWN flakes above a HEDGE-like foot, METAL poles,
        VEHICLE faces; the object number is that of the group.
    """
    builders = {
        Kind.FACADE: _build_rows,
        Kind.WALL: _build_rows,
        Kind.PLANT: _build_plants,
        Kind.POLE: _build_poles,
        Kind.VEHICLE: _build_vehicle_sides,
    }
    meshes = []
    for kind, build in builders.items():
        own = cells.take(np.flatnonzero(cells.kinds == kind))
        if len(own.points):
            meshes.append(build(own, kind, seed, leaf_density))
    return merge_meshes(meshes)


def _draw(numbers: np.ndarray, seed: int, salt: int) -> np.ndarray:
    """Numbers in [0, 1) that depend on the given whole numbers alone."""
    h = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64((seed * 0x1000193 + salt * 0x85EBCA6B) & 0xFFFFFFFFFFFF)
    for shift, factor in ((31, 0x7FB5D329728EA185), (27, 0x81DADEF4BC2DD44D)):
        h = (h ^ (h >> np.uint64(shift))) * np.uint64(factor)
    return (h ^ (h >> np.uint64(33))).astype(np.float64) / 2.0**64


def _cell_numbers(points: np.ndarray) -> np.ndarray:
    """A whole number for every place, the same whichever cells are at hand."""
    u = np.floor(points / 0.25).astype(np.int64)
    return (u[:, 0] * 0x1F123BB5 + u[:, 1] * 0x5851F42D).astype(np.uint64)


def _build_rows(cells: Cells, kind: Kind, seed: int, leaf_density: float) -> Mesh:
    """Upright strips along the row; neighbours overlap, so that a row of cells is closed."""
    low, high = (4.0, 9.0) if kind == Kind.FACADE else (1.3, 2.8)
    top = low + (high - low) * _draw(cells.groups, seed, 1)
    material = Material.FACADE if kind == Kind.FACADE else Material.WALL
    return _build_strips(cells.points, cells.headings, 0.27, -0.2, top, material, cells.groups)


def _build_vehicle_sides(cells: Cells, kind: Kind, seed: int, leaf_density: float) -> Mesh:
    top = 1.4 + 0.8 * _draw(cells.groups, seed, 2) ** 3
    return _build_strips(cells.points, cells.headings, 0.25, 0.2, top, Material.VEHICLE, cells.groups)


def _build_poles(cells: Cells, kind: Kind, seed: int, leaf_density: float) -> Mesh:
    """Two crossed strips: a slim pole that is seen from all sides."""
    radius = 0.04 + 0.08 * _draw(cells.groups, seed, 3)
    top = 1.0 + 5.0 * _draw(cells.groups, seed, 4)
    turn = np.pi * _draw(cells.groups, seed, 5)
    halves = [
        _build_strips(cells.points, turn + quarter, radius, 0.0, top, Material.METAL, cells.groups)
        for quarter in (0.0, 0.5 * np.pi)
    ]
    return merge_meshes(halves)


def _build_plants(cells: Cells, kind: Kind, seed: int, leaf_density: float) -> Mesh:
    """Flakes of leaves, up to two for every metre of height, turned at random."""
    numbers = _cell_numbers(cells.points)
    height = 0.8 + 4.5 * _draw(cells.groups, seed, 6) * _draw(numbers, seed, 7)
    meshes = []
    for layer in range(8):
        here = np.flatnonzero(
            (0.6 * layer < height) & (_draw(numbers, seed, 20 + layer) < 0.5 * leaf_density)
        )
        side = 0.15 + 0.25 * _draw(numbers[here], seed, 30 + layer)
        z = 0.6 * (layer + _draw(numbers[here], seed, 40 + layer))
        away = 0.3 * (np.stack([_draw(numbers[here], seed, 50 + layer + 10 * k) for k in (0, 1)], 1) - 0.5)
        turn = np.pi * _draw(numbers[here], seed, 70 + layer)
        material = Material.HEDGE if layer == 0 else Material.TREE_CROWN
        meshes.append(
            _build_strips(
                cells.points[here] + away, turn, side, z, z + 2.0 * side, material, cells.groups[here]
            )
        )
    return merge_meshes(meshes)


def _build_strips(
    points: np.ndarray,
    headings: np.ndarray,
    half: np.ndarray | float,
    low: np.ndarray | float,
    high: np.ndarray | float,
    material: int,
    groups: np.ndarray,
) -> Mesh:
    """Upright rectangles, `half` to both sides of each point along its heading, from `low` to `high` [m]."""
    n = len(points)
    step = np.broadcast_to(half, n)[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    low, high = np.broadcast_to(low, n), np.broadcast_to(high, n)
    left, right = points - step, points + step
    corners = np.stack(
        [
            np.column_stack([left, low]),
            np.column_stack([right, low]),
            np.column_stack([right, high]),
            np.column_stack([left, high]),
        ],
        axis=1,
    )
    first = 4 * np.arange(n)[:, None]
    triangles = np.stack([first + (0, 1, 2), first + (0, 2, 3)], axis=1)
    return make_mesh(corners.reshape(-1, 3), triangles.reshape(-1, 3), material, np.repeat(groups, 2))


def build_ground(places: np.ndarray, radius: float, object_id: int = -2) -> Mesh:
    """Lay flat ground within a radius of some places: tiles of 8 m.

    Parameters
    ----------
    places : array, shape (m, 2)
        Places, such as the poses of a trajectory [m].
    radius : float
        How far the ground reaches [m].
    object_id : int
        Object number of the ground.

    Returns
    -------
    mesh : Mesh
        GROUND at z = 0.
    """
    side, reach = GROUND_TILE_M, int(np.ceil(radius / GROUND_TILE_M))
    tiles = np.unique(np.floor(np.asarray(places)[:, :2] / side).astype(np.int64), axis=0)
    around = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    around = around[np.hypot(*around.T) <= reach]
    tiles = np.unique((tiles[:, None] + around[None]).reshape(-1, 2), axis=0)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = side * (tiles[:, None] + square[None]).reshape(-1, 2)
    first = 4 * np.arange(len(tiles))[:, None]
    triangles = np.stack([first + (0, 1, 2), first + (0, 2, 3)], axis=1).reshape(-1, 3)
    return make_mesh(
        np.column_stack([corners, np.zeros(len(corners))]), triangles, Material.GROUND, object_id
    )
