"""Count what a height threshold removes, by the true materials of simulated lidar points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rol.bev import points_to_image
from rol.lidar import crop_range, ground_removal_tradeoff, relate_sensors, remove_ground, sweep_to_radar
from rol.oxford import EXTRINSICS, LIDARS
from rol_sim.session.labels import label_sweep, list_labels
from rol_sim.world.mesh import GROUND_MATERIALS


@dataclass(frozen=True)
class GroundRemoval:
    """Effect of height thresholds on labelled sweeps; all values nan, and n_sweeps 0, without labels.

    Attributes
    ----------
    n_sweeps : int
        Labelled sweeps.
    ground_removed, objects_removed : array, shape (k,)
        Fractions of the ground points and of all other points below each threshold tried.
    at_threshold : tuple of three float
        At the threshold in use: fraction removed of the ground points, of the other points, and of the
        pixels that the other points occupy.
    ground_range_m : array, shape (n,)
        Distances of the ground points in the plane [m].
    """

    n_sweeps: int
    ground_removed: np.ndarray
    objects_removed: np.ndarray
    at_threshold: tuple[float, float, float]
    ground_range_m: np.ndarray


def read_labelled_sweeps(
    folder: Path | str, max_range: float, max_sweeps: int = 60
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Read the sweeps of a session whose true materials were written.

    Parameters
    ----------
    folder : path
        Folder of the session; a real one has no labels.
    max_range : float
        Farthest points kept [m].
    max_sweeps : int
        Of a longer session about this many sweeps are read, evenly spaced.

    Yields
    ------
    points : array, shape (n, 4)
        x, y, z [m] in the radar frame and intensity.
    is_ground : array, shape (n,), bool
        True for points on road, pavement, kerb or grass.
    """
    sweeps = [(sensor, int(stamp)) for sensor in LIDARS for stamp in list_labels(folder, sensor)]
    for sensor, stamp in sweeps[:: len(sweeps) // max_sweeps + 1]:
        points, materials = label_sweep(folder, sensor, stamp)
        points = sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[sensor]))
        points = crop_range(np.column_stack([points, np.isin(materials, GROUND_MATERIALS)]), max_range)
        yield points[:, :-1], points[:, -1] > 0


def measure_ground_removal(
    sweeps: Iterable[tuple[np.ndarray, np.ndarray]], min_height: float, thresholds: np.ndarray
) -> GroundRemoval:
    """Measure what height thresholds remove from labelled sweeps.

    Parameters
    ----------
    sweeps : iterable of (points, is_ground)
        As from `read_labelled_sweeps`.
    min_height : float
        Threshold in use, z in the radar frame [m].
    thresholds : array, shape (k,)
        Thresholds to try [m].

    Returns
    -------
    removal : GroundRemoval
    """
    heights, labels, ranges, pixels = [np.zeros(0)], [np.zeros(0, dtype=bool)], [np.zeros(0)], np.zeros(2)
    for points, is_ground in sweeps:
        heights.append(points[:, 2])
        labels.append(is_ground)
        ranges.append(np.hypot(*points[is_ground, :2].T))
        objects = points[~is_ground]
        for i, cloud in enumerate((objects, remove_ground(objects, min_height))):
            pixels[i] += np.count_nonzero(points_to_image(cloud))
    both = np.concatenate(heights), np.concatenate(labels)
    used = [float(fraction[0]) for fraction in ground_removal_tradeoff(*both, [min_height])]
    used.append(float(1.0 - pixels[1] / pixels[0]) if pixels[0] else float("nan"))
    curves = ground_removal_tradeoff(*both, thresholds)
    return GroundRemoval(len(heights) - 1, *curves, tuple(used), np.concatenate(ranges))
