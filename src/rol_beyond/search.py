"""Global localization: exhaustive search of a pose on the map by FFT correlation.

The match of a cloud at every place of a grid, in one heading, is the correlation of two images, the map's and
the cloud's, and is computed with one Fourier transform each. Its cost does not depend on the number of
points, so the clouds of several seconds, merged by odometry, are matched as fast as that of one scan.

The score is not the number of points near the map but its contrast to chance: in a dense region points match
in any heading, so the mean match over all headings is subtracted. The difference is called the *score
contrast*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from rol.geometry import check_fields, check_grid, check_pose, compose, invert, transform_points, wrap_angle
from rol.mcl import MapGrid, count_matches

SAME_M = 0.35  # a point this close to one of another scan has kept its place in the radar frame
MOVED_M = 0.3  # scans from positions closer to each other are not compared
N_BY_CHANCE = 1  # of the four neighbouring scans a point may coincide with so many
OTHER_HEADINGS = np.deg2rad(np.arange(20.0, 341.0, 20.0))  # relative to a pose; points match there by chance


@dataclass(frozen=True)
class SearchSettings:
    """Settings of `search_poses`.

    Attributes
    ----------
    reach_m, reach_yaw : float
        Half the extent of the search in x and y [m] and in heading [rad].
    yaw_step : float
        Step between headings [rad].
    n_refined, n_best : int
        Poses that are refined, and poses that are returned.
    separation_m, separation_yaw : float
        Of poses closer to each other than this in x, y and heading only the best is returned [m, rad].
    max_points : int
        Of a larger cloud this many points are used in the refinement, evenly spaced.
    workers : int
        Threads.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    reach_m: float
    reach_yaw: float = np.pi
    yaw_step: float = float(np.deg2rad(1.0))
    n_refined: int = 100
    n_best: int = 20
    separation_m: float = 2.0
    separation_yaw: float = float(np.deg2rad(6.0))
    max_points: int = 1000
    workers: int = 1

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "reach_m yaw_step separation_m separation_yaw",
            "(0, 3.15]": "reach_yaw",
            "[1, inf)": "n_refined n_best max_points workers",
        }
        check_fields(self, allowed)


def merge_clouds(clouds: Sequence[np.ndarray], increments: Sequence[np.ndarray]) -> np.ndarray:
    """Merge the clouds of successive scans in the frame of the last one.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Clouds, each in its own frame [m].
    increments : sequence of array, shape (3,)
        Pose of each cloud's frame in the one before, one fewer than clouds [m, m, rad].

    Returns
    -------
    cloud : array, shape (n, 2)
        All points [m].
    """
    pose, merged = np.zeros(3), [np.asarray(clouds[-1], dtype=np.float64)]
    for cloud, increment in zip(clouds[-2::-1], increments[::-1], strict=True):
        pose = compose(pose, invert(increment))
        merged.append(transform_points(pose, cloud))
    return np.concatenate(merged)


def remove_ego_static_points(
    clouds: Sequence[np.ndarray], increments: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Remove points that keep their place in the radar frame while the vehicle moves.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Clouds of successive scans, each in its own frame [m].
    increments : sequence of array, shape (3,)
        Motion between them, one fewer than clouds [m, m, rad].

    Returns
    -------
    clouds : list of array, shape (k, 2)
        The other points.
    """
    lengths = [np.hypot(increment[0], increment[1]) for increment in increments]
    driven = np.concatenate([[0.0], np.cumsum(lengths)])
    trees, kept = [cKDTree(cloud) for cloud in clouds], []
    for i, cloud in enumerate(clouds):
        n_same = np.zeros(len(cloud), dtype=int)
        for j in (i - 2, i - 1, i + 1, i + 2):
            if 0 <= j < len(clouds) and abs(driven[j] - driven[i]) > MOVED_M and len(cloud):
                n_same += trees[j].query(cloud, distance_upper_bound=SAME_M)[0] < SAME_M
        kept.append(cloud[n_same <= N_BY_CHANCE])
    return kept


def score_contrast(poses: np.ndarray, points: np.ndarray, grid: MapGrid) -> np.ndarray:
    """Compute the mean score of a cloud at poses, minus that in other headings.

    Parameters
    ----------
    poses : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    points : array, shape (m, 2)
        Cloud in the radar frame [m].
    grid : MapGrid
        Map, from the measurement's ``build_grid``.

    Returns
    -------
    contrast : array, shape (n,)
        Mean score of a point, minus its mean over headings at least 20 deg away; between -1 and 1, about 0
        where the cloud matches by chance, 0 for a cloud without points.
    """
    if len(points) == 0:
        return np.zeros(len(poses))
    turned = np.repeat(poses[:, None], len(OTHER_HEADINGS) + 1, axis=1)
    turned[:, 1:, 2] += OTHER_HEADINGS
    sums = count_matches(turned.reshape(-1, 3), points, grid)
    sums = sums.reshape(len(poses), -1) / (len(points) * grid.best)
    return sums[:, 0] - sums[:, 1:].mean(axis=1)


class CorrelationGrid:
    """Score contrast of a cloud at every place of a square grid around a centre, for one heading at a time.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud in the radar frame [m]; at least one point.
    grid : MapGrid
        Map; its cells are the steps of the grid.
    centre : array, shape (2,)
        Centre of the grid [m].
    reach_m : float
        Half its extent [m].
    workers : int
        Threads.

    Raises
    ------
    ValueError
        If the cloud extends so far that the grid does not fit into memory.
    """

    def __init__(
        self, points: np.ndarray, grid: MapGrid, centre: np.ndarray, reach_m: float, workers: int = 1
    ) -> None:
        self.points, self.cell, self.workers = points, grid.cell, workers
        self.n_reach = int(np.ceil(reach_m / grid.cell))
        self.n_range = int(np.ceil(np.hypot(*points.T).max() / grid.cell)) + 1
        half = self.n_reach + self.n_range
        middle = np.floor((centre - grid.origin) / grid.cell).astype(int)
        crop = np.zeros(check_grid((2 * half + 1,) * 2, points, "cloud", n_bytes=4), dtype=np.float32)
        low, high = np.maximum(middle - half, 0), np.minimum(middle + half + 1, grid.values.shape)
        if (high > low).all():
            part = grid.values[low[0] : high[0], low[1] : high[1]]
            a, b = low - middle + half
            crop[a : a + part.shape[0], b : b + part.shape[1]] = part / np.float32(grid.best)
        self.shape = [fft.next_fast_len(len(crop), real=True)] * 2
        self.map_spectrum = fft.rfft2(crop, self.shape, workers=workers)
        self.corner = grid.origin + (middle - self.n_reach + 0.5) * grid.cell  # position of cell [0, 0]
        self.chance = self._correlate(np.deg2rad(np.arange(0.0, 360.0, 7.5)))

    def contrast(self, yaw: float) -> np.ndarray:
        """Compute the score contrast in one heading [rad] at all places, shape (s, s)."""
        return self._correlate([yaw]) - self.chance

    def position(self, cells: np.ndarray) -> np.ndarray:
        """Compute the positions of cells of the grid, shape (k, 2) [m]."""
        return self.corner + cells * self.cell

    def _correlate(self, yaws: Sequence[float] | np.ndarray) -> np.ndarray:
        """Compute the mean score of a point at all places, averaged over headings, shape (s, s)."""
        size, image = 2 * self.n_reach + 1, np.zeros(self.shape[0] * self.shape[1])
        for yaw in yaws:
            turned = transform_points((0.0, 0.0, yaw), self.points)
            cells = np.floor(turned / self.cell + 0.5).astype(np.int64) + self.n_range
            image += np.bincount(cells[:, 0] * self.shape[1] + cells[:, 1], minlength=len(image))
        image = (image / (len(yaws) * len(self.points))).astype(np.float32).reshape(self.shape)
        spectrum = self.map_spectrum * np.conj(fft.rfft2(image, workers=self.workers))
        return fft.irfft2(spectrum, self.shape, workers=self.workers)[:size, :size]


def search_poses(
    points: np.ndarray, coarse: MapGrid, fine: MapGrid, centre: np.ndarray, settings: SearchSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Find the poses with the largest score contrast within a window.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud in the radar frame [m].
    coarse, fine : MapGrid
        Map for the exhaustive search, and for the refinement of the best poses. They may be the same; with
        cells of 1 m instead of 0.25 m, 300 m are searched as fast as 75 m, but less reliably.
    centre : array, shape (3,)
        Centre of the window [m, m, rad].
    settings : SearchSettings
        Window, steps and numbers of poses.

    Returns
    -------
    poses : array, shape (k, 3)
        Best poses first [m, m, rad]; none for a cloud without points.
    contrast : array, shape (k,)
        See `score_contrast`.
    """
    centre = check_pose(centre, "centre of the search")
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    candidates = _search_coarsely(points, coarse, centre, settings)
    few = points[np.linspace(0, len(points) - 1, min(len(points), settings.max_points)).astype(int)]
    poses = _refine(candidates, few, fine, coarse.cell / 4.0, settings.yaw_step / 4.0)
    contrast = score_contrast(poses, few, fine)
    separation = settings.separation_m, settings.separation_yaw
    kept = suppress_neighbours(poses, np.argsort(-contrast, kind="stable"), settings.n_best, separation)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses[kept], contrast[kept]


def _search_coarsely(
    points: np.ndarray, grid: MapGrid, centre: np.ndarray, settings: SearchSettings
) -> np.ndarray:
    """Find the best poses over all places and headings of the window, shape (k, 3)."""
    n_yaws = max(int(np.ceil(settings.reach_yaw / settings.yaw_step)), 1)
    yaws = centre[2] + np.arange(-n_yaws, n_yaws + 1) * (settings.reach_yaw / n_yaws)
    # In a full turn the last heading equals the first.
    yaws = yaws[:-1] if settings.reach_yaw >= np.pi else yaws
    correlation = CorrelationGrid(points, grid, centre[:2], settings.reach_m, settings.workers)
    n_peaks, block = max(settings.n_refined // 4, 10), max(round(settings.separation_m / grid.cell), 1)
    found = []
    for yaw in yaws:
        peaks, heights = _find_peaks(correlation.contrast(yaw), n_peaks, block)
        found.append(np.column_stack([correlation.position(peaks), np.full(len(peaks), yaw), heights]))
    found = np.concatenate(found)
    return found[np.argsort(-found[:, 3], kind="stable")[: settings.n_refined], :3]


def _find_peaks(values: np.ndarray, n: int, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the n highest of the block maxima, with their values, shape (k, 2) and (k,)."""
    size = -(-len(values) // block)
    padded = np.full((size * block, size * block), -np.inf, dtype=values.dtype)
    padded[: len(values), : len(values)] = values
    blocks = padded.reshape(size, block, size, block)
    rows = blocks.max(axis=1)
    maxima = np.maximum.reduce([rows[..., k] for k in range(block)]).ravel()
    # Only those that can be among the n highest are sorted; equal ones stay in their order.
    n = min(n, len(maxima))
    high = np.flatnonzero(maxima >= np.partition(maxima, len(maxima) - n)[len(maxima) - n])
    which = high[np.argsort(-maxima[high], kind="stable")[:n]]
    inside = blocks[which // size, :, which % size].reshape(n, -1).argmax(axis=1)
    rows, columns = np.divmod(inside, block)
    return np.column_stack([which // size * block + rows, which % size * block + columns]), maxima[which]


def _refine(
    poses: np.ndarray, points: np.ndarray, grid: MapGrid, step_m: float, step_yaw: float
) -> np.ndarray:
    """Move each pose to the best of the poses within two steps in all three directions, shape (k, 3)."""
    offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tried = poses[:, None] + offsets * (step_m, step_m, step_yaw)
    sums = count_matches(tried.reshape(-1, 3), points, grid)
    best = sums.reshape(len(poses), -1).argmax(axis=1)
    return tried[np.arange(len(poses)), best]


def suppress_neighbours(
    poses: np.ndarray, order: np.ndarray, n: int, separation: tuple[float, float]
) -> list[int]:
    """Keep the poses, in an order, that are not close to one kept before (non-maximum suppression).

    Parameters
    ----------
    poses : array, shape (k, 3)
        Poses [m, m, rad].
    order : array of int
        Indices of the poses, the best first.
    n : int
        Largest number of poses kept.
    separation : tuple of float
        Two poses closer than this in x and y [m] and in heading [rad] are the same.

    Returns
    -------
    kept : list of int
        Indices of the poses kept, in the order given.
    """
    kept: list[int] = []
    for i in order:
        away = poses[kept] - poses[i]
        is_near = (np.abs(away[:, :2]) < separation[0]).all(axis=1)
        is_near &= np.abs(wrap_angle(away[:, 2])) < separation[1]
        if not is_near.any():
            kept.append(int(i))
        if len(kept) == n:
            break
    return kept
