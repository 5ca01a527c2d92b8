"""The plan of the town: a loop of streets with junctions and side streets, and the terrain.

All plan coordinates are metres in the town frame: x, y in the plane, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

# Corners of the loop and the streets that leave it, before the plan is stretched, bent, mirrored and turned.
# Eight corners with turns of 20 to 80 degrees. Side streets: (corner or place between two, direction,
# length).
_CORNERS = np.array(
    [
        [0.0, 0.0],
        [96.0, -16.0],
        [186.0, 8.0],
        [206.0, 84.0],
        [132.0, 122.0],
        [62.0, 96.0],
        [4.0, 106.0],
        [-16.0, 82.0],
    ]
)
_SIDE_STREETS = (
    (0.0, 195.0, 105.0),
    (0.0, 262.0, 95.0),
    (1.0, 275.0, 105.0),
    (2.0, -4.0, 110.0),
    (2.0, 300.0, 90.0),
    (2.5, 16.0, 95.0),
    (3.0, 50.0, 105.0),
    (4.0, 95.0, 110.0),
    (5.0, 100.0, 100.0),
    (6.0, 105.0, 95.0),
    (7.45, 175.0, 100.0),
)
_CROSS_STREETS = ((1.0, 5.0), (3.45, 1.55))


@dataclass(frozen=True)
class Street:
    """One street.

    Attributes
    ----------
    centre : array, shape (n, 2)
        Centre line, a point about every half metre [m].
    half_width : float
        From the centre line to the kerb [m].
    style : str
        What stands along it: "terrace", "villas" or "mixed".
    setback : float
        Usual distance from the pavement to the fronts [m].
    trees : float
        Usual distance between street trees, 0 for none [m].
    parking : float
        Fraction of the kerb that is marked for parking, 0 .. 1.
    on_loop : bool
        Whether the sessions' route runs along it.
    """

    centre: np.ndarray
    half_width: float
    style: str
    setback: float
    trees: float
    parking: float
    on_loop: bool

    @property
    def arc(self) -> np.ndarray:
        """Arc length at every point of the centre line, shape (n,) [m]."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.centre, axis=0), axis=1))])

    def place(self, s: np.ndarray | float, offset: np.ndarray | float) -> np.ndarray:
        """Return poses beside the centre line.

        Parameters
        ----------
        s : float or array, shape (k,)
            Arc length [m].
        offset : float or array, shape (k,)
            Distance to the left of the centre line [m].

        Returns
        -------
        poses : array, shape (k, 3) or (3,)
            Place and direction of the street there (x, y, yaw).
        """
        arc = self.arc
        x, y = (np.interp(s, arc, self.centre[:, i]) for i in (0, 1))
        ahead, behind = np.minimum(np.asarray(s) + 1.0, arc[-1]), np.maximum(np.asarray(s) - 1.0, 0.0)
        dx, dy = (
            np.interp(ahead, arc, self.centre[:, i]) - np.interp(behind, arc, self.centre[:, i])
            for i in (0, 1)
        )
        yaw = np.arctan2(dy, dx)
        return np.stack(
            [x - offset * np.sin(yaw), y + offset * np.cos(yaw), yaw + 0.0 * np.asarray(offset)], axis=-1
        )


@dataclass(frozen=True)
class StreetPlan:
    """All streets, the loop for the route, and the lie of the land.

    Attributes
    ----------
    streets : tuple of Street
        The streets; those of the loop come first, in order.
    loop : array, shape (n, 2)
        Closed centre line of the loop, corners not rounded, a point about every half metre [m].
    junctions : array, shape (k, 2)
        Where streets meet [m].
    waves : array, shape (w, 4)
        The land's long waves: wave vector x, y [rad/m], phase [rad], height [m].
    pavement_width, kerb_height : float
        Of all pavements [m].
    """

    streets: tuple[Street, ...]
    loop: np.ndarray
    junctions: np.ndarray
    waves: np.ndarray
    pavement_width: float = 2.0
    kerb_height: float = 0.12
    _by_width: dict[float, cKDTree] = field(repr=False, default_factory=dict)
    _loop_tree: cKDTree = field(repr=False, default=None)

    def __post_init__(self) -> None:
        for half_width in sorted({street.half_width for street in self.streets}):
            lines = [street.centre for street in self.streets if street.half_width == half_width]
            self._by_width[half_width] = cKDTree(np.concatenate(lines))
        object.__setattr__(self, "_loop_tree", cKDTree(self.loop))

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance from points to the nearest kerb; negative on a carriageway, inf beyond 20 to 30 m.

        Parameters
        ----------
        points : array, shape (n, 2)
            Points [m].

        Returns
        -------
        clearance : array, shape (n,)
            Distance [m].
        """
        gaps = [
            tree.query(points, distance_upper_bound=30.0)[0] - half for half, tree in self._by_width.items()
        ]
        return np.min(gaps, axis=0)

    def ground(self, points: np.ndarray) -> np.ndarray:
        """Height of the land at points: level along the loop, gently rising and falling away from it.

        Parameters
        ----------
        points : array, shape (n, 2)
            Points [m].

        Returns
        -------
        z : array, shape (n,)
            Height [m].
        """
        points = np.asarray(points, dtype=float)
        far = np.clip((self._loop_tree.query(points)[0] - 5.0) / 22.0, 0.0, 1.0)
        wave = np.sin(points @ self.waves[:, :2].T + self.waves[:, 2]) @ self.waves[:, 3]
        return wave * (0.04 + 0.96 * far * far * (3.0 - 2.0 * far))


def build_plan(rng: np.random.Generator, *, loop_length: float = 600.0, relief: float = 1.0) -> StreetPlan:
    """Draw the plan of a town.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws bends, widths, styles, mirror image, direction and the lie of the land.
    loop_length : float
        Length of the loop along its centre lines [m].
    relief : float
        How far the land away from the loop rises and falls [m].

    Returns
    -------
    plan : StreetPlan
        The plan, the loop's centre near the origin.
    """
    corners = _CORNERS + rng.uniform(-6.0, 6.0, _CORNERS.shape)
    mirror, turn = rng.random() < 0.5, float(rng.uniform(0.0, 2.0 * np.pi))
    edges = [
        _bend(corners[i], corners[(i + 1) % len(corners)], float(rng.uniform(-9.0, 9.0)))
        for i in range(len(corners))
    ]
    lines = [(line, True) for line in edges]
    for place, heading, length in _SIDE_STREETS:
        start, angle = _on_loop(edges, place), np.deg2rad(heading + rng.uniform(-12.0, 12.0))
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        lines.append((_bend(start, end, float(rng.uniform(-12.0, 12.0))), False))
    for a, b in _CROSS_STREETS[: 1 + int(rng.random() < 0.4)]:
        lines.append((_bend(_on_loop(edges, a), _on_loop(edges, b), float(rng.uniform(-8.0, 8.0))), False))
    loop = np.concatenate([line[:-1] for line in edges])
    closed = np.vstack([loop, loop[:1]])
    scale = loop_length / float(np.linalg.norm(np.diff(closed, axis=0), axis=1).sum())
    c, s = np.cos(turn), np.sin(turn)
    to_town = scale * np.diag([1.0, -1.0 if mirror else 1.0]) @ np.array([[c, s], [-s, c]])
    middle = corners.mean(axis=0)
    streets = tuple(_dress_street((line - middle) @ to_town, on_loop, rng) for line, on_loop in lines)
    ends = np.array(
        [_on_loop(edges, p) for p in sorted({*range(len(corners)), *(side[0] for side in _SIDE_STREETS)})]
    )
    count = 6
    wavelength, heading = rng.uniform(60.0, 160.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    k = 2.0 * np.pi / wavelength
    waves = np.column_stack(
        [
            k * np.cos(heading),
            k * np.sin(heading),
            rng.uniform(0.0, 2.0 * np.pi, count),
            np.full(count, relief / np.sqrt(count)),
        ]
    )
    return StreetPlan(streets, (loop - middle) @ to_town, (ends - middle) @ to_town, waves)


def _dress_street(centre: np.ndarray, on_loop: bool, rng: np.random.Generator) -> Street:
    style = str(rng.choice(["terrace", "villas", "mixed"], p=[0.4, 0.3, 0.3]))
    setback = {
        "terrace": rng.uniform(0.2, 2.5),
        "villas": rng.uniform(4.0, 8.0),
        "mixed": rng.uniform(1.0, 5.0),
    }[style]
    half_width = float(rng.choice([4.8, 5.1, 5.4] if on_loop else [3.3, 3.6, 3.9, 4.2]))
    trees = float(rng.uniform(11.0, 22.0)) if rng.random() < 0.45 else 0.0
    return Street(centre, half_width, style, float(setback), trees, float(rng.uniform(0.35, 0.85)), on_loop)


def _bend(start: np.ndarray, end: np.ndarray, bow: float, spacing: float = 0.5) -> np.ndarray:
    """Points every half metre on a curve from start to end that leaves the straight line by `bow` metres."""
    length = float(np.linalg.norm(end - start))
    u = np.linspace(0.0, 1.0, max(2, int(np.ceil(length / spacing)) + 1))
    across = np.array([-(end - start)[1], (end - start)[0]]) / length
    return start + u[:, None] * (end - start) + (bow * np.sin(np.pi * u) ** 2)[:, None] * across


def _on_loop(edges: list[np.ndarray], place: float) -> np.ndarray:
    """Corner number plus the fraction of the distance to the next corner -> point."""
    edge = edges[int(place) % len(edges)]
    return edge[round((place % 1.0) * (len(edge) - 1))]
