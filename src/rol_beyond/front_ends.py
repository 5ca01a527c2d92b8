"""Front ends: from a polar radar scan to points by a network or a peak detector, and their evaluation.

All points are in the radar frame, x forward, y left [m], at mid-scan if a twist is given. Detectors and
networks get the same scan and the same motion, so that their points can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from rol.bev import image_to_points
from rol.geometry import transform_points
from rol.pairs import PairSettings
from rol.radar import MEASURED, RangeCalibration, ScanMotion, check_scan, find_peaks, peaks_to_points
from rol.similarity import fraction_within
from rol_beyond.augmentation import rotated_radar_image
from rol_beyond.detectors import cfar_peaks
from rol_beyond.resampling import resample_systematic

if TYPE_CHECKING:
    from rol.pix2pix import TrainedNetwork

DETECTORS = ("k-strongest", "cfar")
MIN_RANGE_M = 2.5  # the radar's own leakage is nearer than this [m]
MAX_RANGE_M = 64.0  # radius of the images [m]
K_STRONGEST = 12  # peaks per azimuth
MIN_POWER = 70  # weakest power that counts: 35 dB in half-dB steps


def generate_points(
    network: TrainedNetwork,
    power: np.ndarray,
    azimuths: np.ndarray,
    twist: Sequence[float] | None = None,
    *,
    min_range_m: float = MIN_RANGE_M,
    bf16: bool = False,
    tta_rotations: int | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Generate lidar points from a polar scan by a network.

    Parameters
    ----------
    network : TrainedNetwork
        The network; ``settings`` and ``points`` apply, replace them for another radar or another threshold.
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    twist : sequence of float, optional
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s]; without it there is no motion compensation.
    min_range_m : float
        Points nearer than this are discarded [m].
    bf16 : bool
        Compute in bfloat16, see `rol.pix2pix.has_bf16`.
    tta_rotations : int, optional
        Quarter turns to average, see `rol.pix2pix.generate`; the network's own number if not given.

    Returns
    -------
    points : array, shape (n, 2)
        Generated points [m].
    radar_image, generated_image : array, shape (w, w), uint8
        Input and output of the network.

    Notes
    -----
    Yin et al. 2020, Eq. 5.
    """
    from rol.pix2pix import generate

    motion = "none" if twist is None else "corrected"
    settings = PairSettings.from_dict({**network.settings, "motion": motion})
    radar = rotated_radar_image(power, azimuths, 0.0, twist or (0.0, 0.0, 0.0), settings)
    generated = generate(network.generator, radar, bf16=bf16, tta_rotations=tta_rotations)
    size = {"pixel_size": settings.pixel_size, "max_range": settings.max_range}
    return image_to_points(generated, **network.points, min_range=min_range_m, **size), radar, generated


def detect_points(
    power: np.ndarray,
    azimuths: np.ndarray,
    twist: Sequence[float] | None = None,
    *,
    detector: str = "k-strongest",
    range_limits_m: tuple[float, float] = (MIN_RANGE_M, MAX_RANGE_M),
    calibration: RangeCalibration = MEASURED,
    **settings: Any,
) -> np.ndarray:
    """Detect points in a polar scan without a network.

    Parameters
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    twist : sequence of float, optional
        As in `generate_points`.
    detector : str
        "k-strongest": the 12 strongest peaks of every azimuth with a power of 70 or more; "cfar": peaks above
        the mean power of their surroundings in range.
    range_limits_m : tuple of float
        Smallest and largest range of a point [m].
    calibration : RangeCalibration
        Range of the bins; the one measured for Oxford's radar if not given.
    **settings
        More for `rol.radar.find_peaks` (``k``, ``min_power``) or `rol_beyond.detectors.cfar_peaks`.

    Returns
    -------
    points : array, shape (n, 2)
        Peaks [m].

    Raises
    ------
    ValueError
        If there is no such detector, or the scan is refused by `rol.radar.check_scan`.
    """
    power, azimuths = check_scan(power, azimuths)
    nearest = (range_limits_m[0] - calibration.offset_m) / calibration.resolution_m - 0.5
    min_bin = max(int(np.ceil(nearest)), 0)
    if detector == "k-strongest":
        kept = {"k": K_STRONGEST, "min_power": MIN_POWER, **settings}
        rows, bins = find_peaks(power, min_bin=min_bin, **kept)
    elif detector == "cfar":
        rows, bins = cfar_peaks(power, min_bin=min_bin, **settings)
    else:
        raise ValueError(f"detector: {detector!r} is none of {', '.join(DETECTORS)}")
    motion = None if twist is None else ScanMotion(twist)
    how = {"max_range_m": range_limits_m[1], "calibration": calibration, "motion": motion}
    return peaks_to_points(rows, bins, azimuths, **how)


def resample_by_density(points: np.ndarray, radius_m: float, rng: np.random.Generator) -> np.ndarray:
    """Resample a cloud with weights inverse to the local density, so that a wall counts by its length.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud [m].
    radius_m : float
        Radius within which neighbours are counted [m].
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    points : array, shape (n, 2)
        Points of the cloud, some of them several times.
    """
    if len(points) == 0:
        return points
    n_neighbours = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return points[resample_systematic(1.0 / n_neighbours, rng)]


def evaluate_on_map(points: np.ndarray, T_map_radar: np.ndarray, map_tree: cKDTree) -> dict[str, float | int]:
    """Compute the precision of a scan's points against a lidar map.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame [m].
    T_map_radar : array, shape (3,)
        Pose of the radar in the frame of the map [m, m, rad].
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].

    Returns
    -------
    precision : dict
        ``n`` points, ``share_1m`` and ``share_2m``: the fractions within 1 m and 2 m of a map point
        (0..1, nan without points).

    Notes
    -----
    The paper's measure (Sec. IV-B) with the map instead of the lidar scan. Moving objects, and changes since
    the map was made, count as wrong.
    """
    distances = map_tree.query(transform_points(T_map_radar, points))[0] if len(points) else np.zeros(0)
    fractions = {f"share_{r}m": fraction_within(distances, float(r)) for r in (1, 2)}
    return {"n": len(points), **fractions}
