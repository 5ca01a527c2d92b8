"""The front ends: from one polar radar scan to points, by a network or by a detector of peaks, and how good they are.

All points are in the radar frame, x forward, y left [m], at mid-scan if a twist is given. Detectors and networks
get the same scan and the same motion, so that what they find can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from rol.pix2pix import TrainedNetwork

DETECTORS = ("k-strongest", "cfar")
MIN_RANGE_M = 2.5  # nearer than this the radar sees its own leakage [m]
MAX_RANGE_M = 64.0  # the images end there [m]
K_STRONGEST, MIN_CODE = 12, 70  # peaks per azimuth, and the weakest code that counts, 35 dB


def translate_scan(
    network: TrainedNetwork,
    codes: np.ndarray,
    azimuths: np.ndarray,
    twist: Sequence[float] | None = None,
    *,
    points: dict[str, Any] | None = None,
    min_range_m: float = MIN_RANGE_M,
    bf16: bool = False,
    headings: int | None = None,
    **changes: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn a polar scan into fake lidar points.

    Parameters
    ----------
    network : TrainedNetwork
        The network.
    codes, azimuths : array, shape (a, b) and (a,)
        Power codes, and counter-clockwise bearings of the rows [rad].
    twist : sequence of float, optional
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s]; without it motion is not corrected.
    points : dict, optional
        ``threshold`` and ``thin`` where they differ from the network's own.
    min_range_m : float
        Points nearer than this are dropped [m].
    bf16 : bool
        Multiply in bfloat16, see `rol.pix2pix.has_bf16`.
    headings : int, optional
        Quarter turns to average, see `rol.pix2pix.generate`; the network's own number if not given.
    **changes
        Settings of the image that differ from the network's, such as ``range_resolution`` of another radar.

    Returns
    -------
    points : array, shape (n, 2)
        Fake lidar points [m].
    radar_image, fake_image : array, shape (w, w), uint8
        What the network got and gave.

    Notes
    -----
    Yin et al. 2020, Eq. 5.
    """
    from rol.bev import image_to_points
    from rol.pairs import PairSettings
    from rol.pix2pix import generate
    from rol_beyond.scan_pairs import turned_radar_image

    changes["motion"] = "none" if twist is None else "corrected"
    settings = PairSettings.from_dict({**network.settings, **changes})
    radar = turned_radar_image(codes, azimuths, 0.0, twist or (0.0, 0.0, 0.0), settings)
    fake = generate(network.generator, radar, bf16=bf16, headings=headings)
    how = {**network.points, **(points or {}), "min_range": min_range_m}
    size = {"pixel_size": settings.pixel_size, "max_range": settings.max_range}
    return image_to_points(fake, **how, **size), radar, fake


def detect_points(
    codes: np.ndarray,
    azimuths: np.ndarray,
    twist: Sequence[float] | None = None,
    *,
    detector: str = "k-strongest",
    min_range_m: float = MIN_RANGE_M,
    max_range_m: float = MAX_RANGE_M,
    range_resolution: float | None = None,
    range_offset: float | None = None,
    **settings: Any,
) -> np.ndarray:
    """Turn a polar scan into points without a network.

    Parameters
    ----------
    codes, azimuths : array, shape (a, b) and (a,)
        Power codes, and counter-clockwise bearings of the rows [rad].
    twist : sequence of float, optional
        As in `translate_scan`.
    detector : str
        "k-strongest": the strongest 12 peaks of every azimuth from code 70 on; "cfar": peaks that stand out
        from what surrounds them in range.
    min_range_m, max_range_m : float
        Points nearer or farther are dropped [m].
    range_resolution, range_offset : float, optional
        Length of a bin and shift of all ranges [m]; those measured for Oxford's radar if not given.
    **settings
        More for `rol.radar.find_peaks` (``k``, ``min_code``) or `rol_beyond.detectors.cfar_peaks`.

    Returns
    -------
    points : array, shape (n, 2)
        Peaks [m].

    Raises
    ------
    ValueError
        If there is no such detector, or the scan is refused by `rol.radar.check_scan`.
    """
    from rol import radar
    from rol_beyond.detectors import cfar_peaks

    codes, azimuths = radar.check_scan(codes, azimuths)
    resolution = radar.MEASURED.resolution_m if range_resolution is None else range_resolution
    offset = radar.MEASURED.offset_m if range_offset is None else range_offset
    min_bin = max(int(np.ceil((min_range_m - offset) / resolution - 0.5)), 0)
    if detector == "k-strongest":
        kept = {"k": K_STRONGEST, "min_code": MIN_CODE, **settings}
        rows, bins = radar.find_peaks(codes, kept["k"], kept["min_code"], min_bin)
    elif detector == "cfar":
        rows, bins = cfar_peaks(codes, min_bin=min_bin, **settings)
    else:
        raise ValueError(f"detector: {detector!r} is none of {', '.join(DETECTORS)}")
    return radar.peaks_to_points(
        rows, bins, azimuths, max_range_m=max_range_m, calibration=radar.RangeCalibration(resolution, offset),
        motion=None if twist is None else radar.ScanMotion(twist),
    )  # fmt: skip


def even_out(points: np.ndarray, radius_m: float, rng: np.random.Generator) -> np.ndarray:
    """Draw as many points again, each the less often the more others lie near it: a front counts by its length then.

    Parameters
    ----------
    points : array, shape (n, 2)
        Cloud [m].
    radius_m : float
        Points nearer to one another than this share their weight [m].
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    points : array, shape (n, 2)
        Points of the cloud, some of them several times.
    """
    from scipy.spatial import cKDTree

    from rol.mcl import resample_systematic

    if len(points) == 0:
        return points
    crowd = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return points[resample_systematic(1.0 / crowd, rng)]


def judge_on_map(points: np.ndarray, T_map_radar: np.ndarray, map_tree: cKDTree) -> dict[str, float | int]:
    """Say how near the points of a scan lie to a lidar map, at the scan's pose.

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
    shares : dict
        ``n`` points, ``share_1m`` and ``share_2m`` of them within 1 m and 2 m of a point of the map (0..1, nan
        without points).

    Notes
    -----
    The paper's measure (Sec. IV-B) with the map in the place of the lidar scan. What moves, and what has come
    since the map was made, counts as wrong here.
    """
    from rol.geometry import transform_points
    from rol.similarity import share_within

    distances = map_tree.query(transform_points(T_map_radar, points))[0] if len(points) else np.zeros(0)
    return {
        "n": len(points),
        "share_1m": share_within(distances, 1.0),
        "share_2m": share_within(distances, 2.0),
    }
