"""Finding a pose on a map without knowing where one is: every place and heading within reach is tried.

How well a cloud fits at every place of a lattice, in one heading, is the correlation of two pictures, the map's and the
cloud's, and comes from one Fourier transform each. The cost does not depend on the number of points, so the clouds of
several seconds, laid together by odometry, are searched for as quickly as that of one scan.

What counts is not how many points fall near the map but how many more than would by chance: in a dense place points fit
in any heading. So the fit in all headings, on average, is taken off: what is left is called the *excess*.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from rol.geometry import check_grid, check_poses, compose, invert, transform_points, wrap_angle

if TYPE_CHECKING:
    from rol.mcl import MapGrid

TURNS = np.deg2rad(np.arange(20.0, 341.0, 20.0))  # headings beside the own one, in which points fit by chance


def join_clouds(clouds: Sequence[np.ndarray], steps: Sequence[np.ndarray]) -> np.ndarray:
    """Lay the clouds of successive scans together in the frame of the last one.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Clouds, each in its own frame [m].
    steps : sequence of array, shape (3,)
        Pose of each cloud's frame in the one before, one fewer than clouds [m, m, rad].

    Returns
    -------
    cloud : array, shape (n, 2)
        All points [m].
    """
    pose, joined = np.zeros(3), [np.asarray(clouds[-1], dtype=np.float64)]
    for cloud, step in zip(clouds[-2::-1], steps[::-1], strict=True):
        pose = compose(pose, invert(step))
        joined.append(transform_points(pose, cloud))
    return np.concatenate(joined)


def drop_riders(
    clouds: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
    *,
    radius_m: float = 0.35,
    moved_m: float = 0.3,
    n_allowed: int = 1,
) -> list[np.ndarray]:
    """Leave out points that ride with the car: they stand where they stood while the car went on.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Clouds of successive scans, each in its own frame [m].
    steps : sequence of array, shape (3,)
        Motion between them, one fewer than clouds [m, m, rad].
    radius_m : float
        A point has stayed when another scan has one so near, in the frame of the radar [m].
    moved_m : float
        Scans that the car made nearer together than this are not compared [m].
    n_allowed : int
        In so many of the four neighbouring scans a point may have stayed by chance.

    Returns
    -------
    clouds : list of array, shape (k, 2)
        The other points.
    """
    way = np.concatenate([[0.0], np.cumsum([np.hypot(step[0], step[1]) for step in steps])])
    trees, kept = [cKDTree(cloud) for cloud in clouds], []
    for i, cloud in enumerate(clouds):
        n_stayed = np.zeros(len(cloud), dtype=int)
        for j in (i - 2, i - 1, i + 1, i + 2):
            if 0 <= j < len(clouds) and abs(way[j] - way[i]) > moved_m and len(cloud):
                n_stayed += trees[j].query(cloud, distance_upper_bound=radius_m)[0] < radius_m
        kept.append(cloud[n_stayed <= n_allowed])
    return kept


def measure_excess(poses: np.ndarray, points: np.ndarray, grid: MapGrid) -> np.ndarray:
    """Measure how much better a cloud fits at poses than it does there in other headings.

    Parameters
    ----------
    poses : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    points : array, shape (m, 2)
        Cloud in the radar frame [m].
    grid : MapGrid
        What a point is worth, from `rol.mcl.build_grid`.

    Returns
    -------
    excess : array, shape (n,)
        Mean worth of a point, minus its mean over headings at least 20 deg away; between -1 and 1, about 0 where the
        cloud fits by chance, 0 for a cloud without points.
    """
    from rol.mcl import count_matches

    if len(points) == 0:
        return np.zeros(len(poses))
    turned = np.repeat(poses[:, None], len(TURNS) + 1, axis=1)
    turned[:, 1:, 2] += TURNS
    sums = count_matches(turned.reshape(-1, 3), points, grid.values, grid.origin, grid.cell)
    sums = sums.reshape(len(poses), -1) / (len(points) * grid.best)
    return sums[:, 0] - sums[:, 1:].mean(axis=1)


class Lattice:
    """Excess of a cloud at every place of a square lattice about a centre, for one heading at a time.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud in the radar frame [m]; at least one point.
    grid : MapGrid
        Map; its cells are the lattice's steps.
    centre : array, shape (2,)
        Middle of the lattice [m].
    reach_m : float
        How far it reaches to each side [m].
    workers : int
        Threads.

    Raises
    ------
    ValueError
        If the cloud reaches so far that no memory holds the lattice.
    """

    def __init__(
        self, points: np.ndarray, grid: MapGrid, centre: np.ndarray, reach_m: float, workers: int = 1
    ) -> None:
        self.points, self.cell, self.workers = points, grid.cell, workers
        self.n_reach = int(np.ceil(reach_m / grid.cell))
        self.n_range = int(np.ceil(np.hypot(*points.T).max() / grid.cell)) + 1
        half, middle = (
            self.n_reach + self.n_range,
            np.floor((centre - grid.origin) / grid.cell).astype(int),
        )
        crop = np.zeros(check_grid((2 * half + 1,) * 2, points, "cloud", n_bytes=4), dtype=np.float32)
        low, high = np.maximum(middle - half, 0), np.minimum(middle + half + 1, grid.values.shape)
        if (high > low).all():
            part = grid.values[low[0] : high[0], low[1] : high[1]]
            a, b = low - middle + half
            crop[a : a + part.shape[0], b : b + part.shape[1]] = part / np.float32(grid.best)
        self.shape = [fft.next_fast_len(len(crop), real=True)] * 2
        self.map_spectrum = fft.rfft2(crop, self.shape, workers=workers)
        self.corner = grid.origin + (middle - self.n_reach + 0.5) * grid.cell  # place of [0, 0]
        self.chance = self._fit(np.deg2rad(np.arange(0.0, 360.0, 7.5)))

    def excess(self, yaw: float) -> np.ndarray:
        """Give the excess in one heading [rad] at all places, shape (s, s)."""
        return self._fit([yaw]) - self.chance

    def place(self, cells: np.ndarray) -> np.ndarray:
        """Give the places of cells of the lattice, shape (k, 2) [m]."""
        return self.corner + cells * self.cell

    def _fit(self, yaws: Sequence[float] | np.ndarray) -> np.ndarray:
        """Mean worth of a point at all places, averaged over headings."""
        size, picture = 2 * self.n_reach + 1, np.zeros(self.shape[0] * self.shape[1])
        for yaw in yaws:
            turned = transform_points((0.0, 0.0, yaw), self.points)
            cells = np.floor(turned / self.cell + 0.5).astype(np.int64) + self.n_range
            picture += np.bincount(cells[:, 0] * self.shape[1] + cells[:, 1], minlength=len(picture))
        picture = (picture / (len(yaws) * len(self.points))).astype(np.float32).reshape(self.shape)
        spectrum = self.map_spectrum * np.conj(fft.rfft2(picture, workers=self.workers))
        return fft.irfft2(spectrum, self.shape, workers=self.workers)[:size, :size]


def search_poses(
    points: np.ndarray,
    coarse: MapGrid,
    fine: MapGrid,
    centre: np.ndarray,
    reach_m: float,
    reach_yaw: float = np.pi,
    *,
    yaw_step: float = np.deg2rad(1.0),
    n_looked_at: int = 100,
    n_best: int = 20,
    apart: tuple[float, float] = (2.0, np.deg2rad(6.0)),
    max_points: int = 1000,
    workers: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the poses at which a cloud exceeds chance most, among all within reach.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud in the radar frame [m].
    coarse, fine : MapGrid
        Map for the search of every place, and for a closer look at the best of them. They may be the same; with
        cells of 1 m instead of 0.25 m, 300 m are searched as quickly as 75 m, and less surely.
    centre : array, shape (3,)
        Middle of what is searched [m, m, rad].
    reach_m, reach_yaw : float
        How far to search to each side in x and y [m] and in heading [rad].
    yaw_step : float
        Step between headings [rad].
    n_looked_at, n_best : int
        Poses that are looked at closely, and poses that are given.
    apart : tuple of float
        Of poses nearer together than this, in x and y [m] and in heading [rad], only the best is given.
    max_points : int
        Of a larger cloud so many points are used in the closer look, evenly chosen.
    workers : int
        Threads.

    Returns
    -------
    poses : array, shape (k, 3)
        The best first [m, m, rad]; none for a cloud without points.
    excess : array, shape (k,)
        See `measure_excess`.
    """
    centre = check_poses(centre, "centre of the search")
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    n_yaws = max(int(np.ceil(reach_yaw / yaw_step)), 1)
    yaws = centre[2] + np.arange(-n_yaws, n_yaws + 1) * (reach_yaw / n_yaws)
    yaws = yaws[:-1] if reach_yaw >= np.pi else yaws  # the last is the first again
    lattice, found = Lattice(points, coarse, centre[:2], reach_m, workers), []
    for yaw in yaws:
        excess = lattice.excess(yaw)
        peaks, heights = _pick_peaks(excess, max(n_looked_at // 4, 10), max(round(apart[0] / coarse.cell), 1))
        found.append(np.column_stack([lattice.place(peaks), np.full(len(peaks), yaw), heights]))
    found = np.concatenate(found)
    rough = found[np.argsort(-found[:, 3], kind="stable")[:n_looked_at], :3]
    few = points[np.linspace(0, len(points) - 1, min(len(points), max_points)).astype(int)]
    poses = _look_closer(rough, few, fine, coarse.cell / 4.0, yaw_step / 4.0)
    excess = measure_excess(poses, few, fine)
    kept = keep_apart(poses, np.argsort(-excess, kind="stable"), n_best, apart)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses[kept], excess[kept]


def _pick_peaks(values: np.ndarray, n: int, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the highest cell of each square block of cells, and of these the n highest, (k, 2), with their values."""
    size = -(-len(values) // block)
    padded = np.full((size * block, size * block), -np.inf, dtype=values.dtype)
    padded[: len(values), : len(values)] = values
    blocks = (
        padded.reshape(size, block, size, block).transpose(0, 2, 1, 3).reshape(size * size, block * block)
    )
    inside, which = blocks.argmax(axis=1), np.arange(size * size)
    heights = blocks[which, inside]
    order = np.argsort(-heights, kind="stable")[:n]
    rows, columns = np.divmod(inside, block)
    cells = np.column_stack([which // size * block + rows, which % size * block + columns])
    return cells[order], heights[order]


def _look_closer(
    poses: np.ndarray, points: np.ndarray, grid: MapGrid, step_m: float, step_yaw: float
) -> np.ndarray:
    """Move each pose to the best of a lattice about it of two steps to each side, in all three directions."""
    from rol.mcl import count_matches

    offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tried = poses[:, None] + offsets * (step_m, step_m, step_yaw)
    sums = count_matches(tried.reshape(-1, 3), points, grid.values, grid.origin, grid.cell)
    best = sums.reshape(len(poses), -1).argmax(axis=1)
    return tried[np.arange(len(poses)), best]


def keep_apart(poses: np.ndarray, order: np.ndarray, n: int, apart: tuple[float, float]) -> list[int]:
    """Go through poses in an order, and keep those that are not near one kept before.

    Parameters
    ----------
    poses : array, shape (k, 3)
        Poses [m, m, rad].
    order : array of int
        Numbers of the poses, the first to be kept first.
    n : int
        How many to keep at most.
    apart : tuple of float
        Two poses nearer together than this, in x and y [m] and in heading [rad], are the same.

    Returns
    -------
    kept : list of int
        Numbers of those kept, in the order given.
    """
    kept: list[int] = []
    for i in order:
        away = poses[kept] - poses[i]
        is_near = (np.abs(away[:, :2]) < apart[0]).all(axis=1) & (np.abs(wrap_angle(away[:, 2])) < apart[1])
        if not is_near.any():
            kept.append(int(i))
        if len(kept) == n:
            break
    return kept
