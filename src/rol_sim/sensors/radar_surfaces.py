"""Scattering of a 77 GHz radar by surfaces: diffuse, specular, corners, and transmission through leaves.

World frame as in `rol_sim.world.scene`, metres. Every half metre of a wall has a reflectivity of its own,
the same whenever it is seen, so that scans of one place resemble each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rol.compiled import compiled
from rol.geometry import check_fields
from rol_sim.world.mesh import Material

CELL = 0.5  # grain of the world along a surface [m]: what a brick pier, a drain pipe, a window frame take up
MOST_CELLS = 12  # cells that may answer between two neighbouring rays
ASPECT = np.deg2rad(4.0)  # incidence over which a cell answers alike
MOST_LATER, LATER_POWER = 8, 4.0  # echoes of the clutter tail: how many at most, and of what power each
WEAKEST = 0.05  # echoes of less power drown in the noise


@dataclass(frozen=True)
class Surface:
    """Scattering of a material.

    Attributes
    ----------
    diffuse : float
        Power scattered back from a surface that fills the beam, at normal incidence; a perfect scatterer has
        1.
    slope : float
        Power of the cosine of incidence that the diffuse part follows.
    specular, lobe_deg : float
        Height and half width (1/e) [deg] of the lobe of surfaces seen square on.
    corner, corner_fraction : float
        Mean power of corners, which scatter at every incidence, and the fraction of cells that hold one.
    mirror : float
        Fraction of power mirrored onwards.
    passes : float
        Fraction of power that goes straight through.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    diffuse: float
    slope: float = 1.0
    specular: float = 0.0
    lobe_deg: float = 2.0
    corner: float = 0.0
    corner_fraction: float = 0.0
    mirror: float = 0.0
    passes: float = 0.0

    def __post_init__(self) -> None:
        allowed = {
            "[0, inf)": "diffuse slope specular corner",
            "(0, 90]": "lobe_deg",
            "[0, 1]": "corner_fraction mirror passes",
        }
        check_fields(self, allowed)


# By the names of `mesh.Material`. Set so that brightness shares, ring by ring, come near those of real scans.
SURFACES = {
    "GROUND": Surface(4e-4, 0.5),
    "PAVEMENT": Surface(4e-4, 0.5),
    "GRASS": Surface(4e-3, 0.5),
    "KERB": Surface(0.02, 1.0, 0.2, 6.0),
    "FACADE": Surface(0.55, 0.15, 8.0, 0.7, 7.0, 0.33, 0.13),
    "GLASS": Surface(0.05, 1.0, 15.0, 0.7, 7.0, 0.2, 0.17, 0.3),
    "ROOF": Surface(0.05, 1.0, 2.0, 4.0),
    "WALL": Surface(0.55, 0.15, 6.0, 1.0, 7.0, 0.3, 0.1),
    "METAL": Surface(0.8, 0.3, 6.0, 3.0, 5.0, 0.2, 0.1),
    "VEHICLE": Surface(0.2, 0.7, 20.0, 2.0, 8.0, 0.25, 0.12),
    "HEDGE": Surface(0.1, 0.5, passes=0.5),
    "TREE_CROWN": Surface(0.09, 0.3, passes=0.7),
    "TREE_TRUNK": Surface(0.4, 0.3, 1.0, 10.0),
    "PERSON": Surface(0.2, 0.5),
}
OTHER_SURFACE = Surface(0.05)


def surface_table(changed: dict[str, Surface]) -> np.ndarray:
    """Tabulate the constants of all materials by material number.

    Parameters
    ----------
    changed : dict
        Name of a material -> `Surface` that replaces the usual one.

    Returns
    -------
    table : array, shape (256, 8), float32
        The fields of `Surface` in order; the lobe in [rad].
    """
    table = np.zeros((256, 8), dtype=np.float32)
    for material in Material:
        s = {**SURFACES, **changed}.get(material.name, OTHER_SURFACE)
        lobe = np.deg2rad(s.lobe_deg)
        table[material] = (
            s.diffuse,
            s.slope,
            s.specular,
            lobe,
            s.corner,
            s.corner_fraction,
            s.mirror,
            s.passes,
        )
    return table


class SurfaceHits(NamedTuple):
    """Hits of radar rays on surfaces.

    Attributes
    ----------
    points, directions, normals : array, shape (n, 3)
        Where rays hit [m], unit directions, unit normals.
    cosines, objects : array, shape (n,)
        Cosine of incidence, object number.
    surfaces : array, shape (n, 8)
        Rows of `surface_table`.
    headings : array, shape (n, 3)
        Unit direction in which each ray left the radar.
    ranges, weights : array, shape (n,)
        Length of the path so far [m], power that a perfect scatterer would return.
    is_direct : array, shape (n,), bool
        False for rays that were mirrored.
    """

    points: np.ndarray
    directions: np.ndarray
    normals: np.ndarray
    cosines: np.ndarray
    objects: np.ndarray
    surfaces: np.ndarray
    headings: np.ndarray
    ranges: np.ndarray
    weights: np.ndarray
    is_direct: np.ndarray


class Echoes(NamedTuple):
    """Echoes of surface hits.

    Attributes
    ----------
    turns : array, shape (m,), float32
        How far to the left of its ray's heading each echo lies [rad].
    ranges, powers : array, shape (m,), float32
        Range [m] and power.
    sources : array, shape (m,), int32
        Which hit each echo comes from.
    """

    turns: np.ndarray
    ranges: np.ndarray
    powers: np.ndarray
    sources: np.ndarray


@compiled
def scatter(hits, ray_spacing, tail_fraction, tail_m):  # pragma: no cover (compiled)
    """Compute the echoes of surface hits.

    Where neighbouring rays hit a wall farther apart than a cell, every cell between them answers. Each hit is
    followed by a clutter tail: weaker echoes at longer ranges.

    Parameters
    ----------
    hits : SurfaceHits
        The hits, n of them.
    ray_spacing : float
        Angle between neighbouring rays [rad].
    tail_fraction, tail_m : float
        Power of the clutter tail relative to the surface's, and its mean length [m].

    Returns
    -------
    echoes : Echoes
        m echoes, in the order of the hits.
    """
    most = len(hits.ranges) * (MOST_CELLS + MOST_LATER)
    echoes = Echoes(
        np.empty(most, dtype=np.float32),
        np.empty(most, dtype=np.float32),
        np.empty(most, dtype=np.float32),
        np.empty(most, dtype=np.int32),
    )
    count = 0
    for i in range(len(hits.ranges)):
        nx, ny, along, half = _footprint(hits, i, ray_spacing)
        count, power = _scatter_cells(hits, i, (nx, ny, along, half), echoes, count)
        if power * tail_fraction > WEAKEST:
            count = _add_clutter_tail(hits, i, along, power * tail_fraction, tail_m, echoes, count)
    return Echoes(echoes.turns[:count], echoes.ranges[:count], echoes.powers[:count], echoes.sources[:count])


# The three functions below are inlined, since passing tuples of arrays costs a count of references for each.
@compiled(inline="always")
def _footprint(hits, i, ray_spacing):  # pragma: no cover (compiled)
    """Normal in the plane, coordinate along the surface, and half the width [m] that a ray represents."""
    x, y = hits.points[i, 0], hits.points[i, 1]
    nx, ny = hits.normals[i, 0], hits.normals[i, 1]
    upright = np.hypot(nx, ny)
    along, half = x + 0.37 * y, 0.0
    if upright > 0.3:
        nx, ny = nx / upright, ny / upright
        along = -ny * x + nx * y
        facing = abs(hits.directions[i, 0] * nx + hits.directions[i, 1] * ny)
        half = min(0.5 * hits.ranges[i] * ray_spacing / max(facing, 0.02), 0.5 * CELL * (MOST_CELLS - 1))
    return nx, ny, along, half


@compiled(inline="always")
def _scatter_cells(hits, i, footprint, echoes, count):  # pragma: no cover (compiled)
    """Append the echoes of the cells in a hit's footprint; returns the new count and their total power."""
    nx, ny, along, half = footprint
    number, z = int(hits.objects[i]), int(np.floor(hits.points[i, 2]))
    first = int(np.floor(along / CELL))
    last, fraction, total = first + 1, 1.0, 0.0
    is_spread = hits.is_direct[i] and 2.0 * half > CELL
    if is_spread:
        first = int(np.ceil((along - half) / CELL - 0.5))
        last = int(np.ceil((along + half) / CELL - 0.5))
        fraction = CELL / (2.0 * half)
    for cell in range(first, last):
        power = hits.weights[i] * fraction * _answer(hits.surfaces[i], hits.cosines[i], number, cell, z)
        total += power
        if power < WEAKEST:
            continue
        echoes.powers[count], echoes.sources[count] = power, i
        echoes.turns[count], echoes.ranges[count] = 0.0, hits.ranges[i]
        if is_spread:
            step = (cell + 0.2 + 0.6 * _hash_unit(number, cell, z, 6)) * CELL - along
            turn, length = _step_aside(hits.headings[i], hits.ranges[i], -step * ny, step * nx)
            echoes.turns[count], echoes.ranges[count] = turn, length
        count += 1
    return count, total


@compiled(inline="always")
def _add_clutter_tail(hits, i, along, power, tail_m, echoes, count):  # pragma: no cover (compiled)
    """Append the echoes that took a longer path, of a given total power; returns the new count."""
    number, z = int(hits.objects[i]), int(np.floor(hits.points[i, 2]))
    cell = int(np.floor(along / CELL))
    n_later = min(MOST_LATER, 1 + int(power / LATER_POWER))
    for k in range(n_later):
        echoes.turns[count] = 0.06 * (_hash_unit(number, cell, z, 7 + 3 * k) - 0.5)
        delay_m = tail_m * _hash_exponential(number, cell, z, 8 + 3 * k)
        echoes.ranges[count] = hits.ranges[i] + delay_m
        echoes.powers[count] = power / n_later * _hash_exponential(number, cell, z, 9 + 3 * k) ** 3 / 6.0
        echoes.sources[count] = i
        count += 1
    return count


@compiled
def _step_aside(heading, total, dx, dy):  # pragma: no cover (compiled)
    """Turn and range of a place (dx, dy) beside the end of a path of given heading and length."""
    x, y = total * heading[0], total * heading[1]
    turn = np.arctan2(x * dy - y * dx, x * (x + dx) + y * (y + dy))
    return turn, np.sqrt((x + dx) ** 2 + (y + dy) ** 2 + (total * heading[2]) ** 2)


@compiled
def _answer(surface, cosine, number, cell, z):  # pragma: no cover (compiled)
    """Backscatter of one cell of the world, as a fraction of a perfect scatterer's.

    A cell has a strength of its own, times one that changes every few degrees of incidence: seen from ten
    metres on, a wall glints elsewhere.
    """
    aspect = int(np.arccos(min(cosine, 1.0)) / ASPECT)
    diffuse = (
        surface[0]
        * max(cosine, 1e-3) ** surface[1]
        * _hash_exponential(number, cell, z, 3)
        * _hash_exponential(number, cell + 7919 * aspect, z, 10)
    )
    specular, corner = 0.0, 0.0
    if surface[2] > 0.0:
        tilt = 0.03 * (_hash_unit(number, cell, z, 1) + _hash_unit(number, cell, z, 2) - 1.0)
        angle = np.arccos(min(cosine, 1.0)) + tilt
        specular = surface[2] * np.exp(-((angle / surface[3]) ** 2))
    if surface[5] > 0.0 and _hash_unit(number, cell, z, 4) < surface[5]:
        glint = _hash_exponential(number, cell, z, 5) * _hash_exponential(number, cell + 7919 * aspect, z, 11)
        corner = surface[4] * glint * min(1.0, 4.0 * cosine)
    return diffuse + specular + corner


@compiled
def _hash_exponential(a, b, c, salt):  # pragma: no cover (compiled)
    """An exponential variate of mean 1, a function of its arguments alone."""
    return -np.log(1.0 - 0.9999 * _hash_unit(a, b, c, salt))


@compiled
def _hash_unit(a, b, c, salt):  # pragma: no cover (compiled)
    """A number in [0, 1) that looks random but depends on nothing but its arguments."""
    h = (
        np.uint64(a * 73856093)
        ^ np.uint64(b * 19349663)
        ^ np.uint64(c * 83492791)
        ^ np.uint64(salt * 49979687)
    )
    h = (h ^ (h >> np.uint64(31))) * np.uint64(0x7FB5D329728EA185)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x81DADEF4BC2DD44D)
    return np.float64((h ^ (h >> np.uint64(33))) >> np.uint64(11)) / 9007199254740992.0
