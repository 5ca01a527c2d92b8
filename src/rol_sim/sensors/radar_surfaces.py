"""How surfaces answer a 77 GHz radar: diffuse, mirror-like, with corners, or veiled by leaves.

World frame as in `scene`, metres. The world has a fixed grain: every half metre of a wall answers in its own
way, and in the same way whenever it is looked at, so that scans of one place resemble each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rol.compiled import compiled
from rol.geometry import check_fields
from rol_sim.world.mesh import Material

CELL = 0.5  # grain of the world along a surface [m]: what a brick pier, a drain pipe, a window frame take up
MOST_CELLS = 12  # cells that may answer between two neighbouring rays
ASPECT = np.deg2rad(4.0)  # incidence over which a cell answers alike
MOST_LATER, LATER_POWER = 8, 4.0  # echoes that came a longer way: how many at most, and of what power each
WEAKEST = 0.05  # echoes of less power drown in the noise


@dataclass(frozen=True)
class Surface:
    """How a material answers the radar.

    Attributes
    ----------
    diffuse : float
        Power scattered back from a surface that fills the beam, at normal incidence; a perfect scatterer has
        1.
    slope : float
        Power of the cosine of incidence that the diffuse part follows.
    specular, lobe_deg : float
        Height and half width (1/e) [deg] of the lobe of surfaces seen square on.
    corner, corner_share : float
        Mean power of corners, that answer at every incidence, and the share of cells that hold one.
    mirror : float
        Share of power mirrored onwards.
    passes : float
        Share of power that goes straight through.

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
    corner_share: float = 0.0
    mirror: float = 0.0
    passes: float = 0.0

    def __post_init__(self) -> None:
        allowed = {
            "[0, inf)": "diffuse slope specular corner",
            "(0, 90]": "lobe_deg",
            "[0, 1]": "corner_share mirror passes",
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
    """Put the constants of all materials into a table by material number.

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
        table[material] = (s.diffuse, s.slope, s.specular, lobe, s.corner, s.corner_share, s.mirror, s.passes)
    return table


@compiled
def scatter(
    points,
    directions,
    normals,
    cosines,
    objects,
    surfaces,
    headings,
    totals,
    weights,
    is_direct,
    spacing,
    haze,
    clutter_tail_m,
):  # pragma: no cover (compiled)
    """Turn hits into echoes; between rays that hit a wall farther apart than a cell, every cell answers.

    Parameters
    ----------
    points, directions, normals : array, shape (n, 3)
        Where rays hit [m], unit directions, unit normals.
    cosines, objects : array, shape (n,)
        Cosine of incidence, object number.
    surfaces : array, shape (n, 8)
        Rows of `surface_table`.
    headings : array, shape (n, 3)
        Unit direction in which each ray left the radar.
    totals, weights : array, shape (n,)
        Length of the way so far [m], power that a perfect scatterer would give.
    is_direct : array, shape (n,), bool
        False for rays that were mirrored.
    spacing : float
        Angle between neighbouring rays [rad].
    haze, clutter_tail_m : float
        Share of power, and mean length [m], of the later echoes that follow a surface.

    Returns
    -------
    turns : array, shape (m,)
        How far to the left of its ray's heading each echo lies [rad].
    ranges, powers : array, shape (m,)
        Range [m] and power.
    sources : array, shape (m,), int32
        Which hit each echo comes from.
    """
    n = len(totals)
    turns, ranges = (
        np.empty(n * (MOST_CELLS + MOST_LATER), dtype=np.float32),
        np.empty(n * (MOST_CELLS + MOST_LATER), dtype=np.float32),
    )
    powers, sources = (
        np.empty(n * (MOST_CELLS + MOST_LATER), dtype=np.float32),
        np.empty(n * (MOST_CELLS + MOST_LATER), dtype=np.int32),
    )
    count = 0
    for i in range(n):
        number, z = int(objects[i]), int(np.floor(points[i, 2]))
        nx, ny = normals[i, 0], normals[i, 1]
        upright = np.hypot(nx, ny)
        s, half = points[i, 0] + 0.37 * points[i, 1], 0.0
        if upright > 0.3:
            nx, ny = nx / upright, ny / upright
            s = -ny * points[i, 0] + nx * points[i, 1]
            facing = abs(directions[i, 0] * nx + directions[i, 1] * ny)
            half = min(0.5 * totals[i] * spacing / max(facing, 0.02), 0.5 * CELL * (MOST_CELLS - 1))
        middle, together = int(np.floor(s / CELL)), 0.0
        first, last, share = middle, middle + 1, 1.0
        is_spread = is_direct[i] and 2.0 * half > CELL
        if is_spread:
            first, last = int(np.ceil((s - half) / CELL - 0.5)), int(np.ceil((s + half) / CELL - 0.5))
            share = CELL / (2.0 * half)
        for cell in range(first, last):
            power = weights[i] * share * _answer(surfaces[i], cosines[i], number, cell, z)
            together += power
            if power < WEAKEST:
                continue
            turns[count], ranges[count], powers[count], sources[count] = 0.0, totals[i], power, i
            if is_spread:
                step = (cell + 0.2 + 0.6 * _hash_unit(number, cell, z, 6)) * CELL - s
                turns[count], ranges[count] = _step_aside(headings[i], totals[i], -step * ny, step * nx)
            count += 1
        if together * haze > WEAKEST:
            n_later = min(MOST_LATER, 1 + int(together * haze / LATER_POWER))
            for k in range(n_later):
                turns[count] = 0.06 * (_hash_unit(number, middle, z, 7 + 3 * k) - 0.5)
                ranges[count] = totals[i] + clutter_tail_m * _hash_exponential(number, middle, z, 8 + 3 * k)
                later = together * haze / n_later * _hash_exponential(number, middle, z, 9 + 3 * k) ** 3 / 6.0
                powers[count], sources[count] = later, i
                count += 1
    return turns[:count], ranges[:count], powers[:count], sources[:count]


@compiled
def _step_aside(heading, total, dx, dy):  # pragma: no cover (compiled)
    """Turn and range of a place (dx, dy) beside the end of a way of given heading and length."""
    x, y = total * heading[0], total * heading[1]
    turn = np.arctan2(x * dy - y * dx, x * (x + dx) + y * (y + dy))
    return turn, np.sqrt((x + dx) ** 2 + (y + dy) ** 2 + (total * heading[2]) ** 2)


@compiled
def _answer(surface, cosine, number, cell, z):  # pragma: no cover (compiled)
    """Backscatter of one cell of the world, as a share of a perfect scatterer's.

    A cell has a strength of its own, times one that changes every few degrees of incidence: seen from ten metres on, a
    wall glints elsewhere.
    """
    aspect = int(np.arccos(min(cosine, 1.0)) / ASPECT)
    diffuse = (
        surface[0] * max(cosine, 1e-3) ** surface[1]
        * _hash_exponential(number, cell, z, 3) * _hash_exponential(number, cell + 7919 * aspect, z, 10)
    )  # fmt: skip
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
