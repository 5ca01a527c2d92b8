"""The method of the paper on one screen: radar scans in, poses on a prior lidar map out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

if __package__:
    from .bev import image_to_points
    from .mcl import MclSettings, ParticleFilter
    from .odometry import icp_2d
    from .pairs import PairSettings, radar_to_image
    from .pix2pix import TrainedNetwork, generate
else:  # this file was copied and is imported by its own name
    from bev import image_to_points
    from mcl import MclSettings, ParticleFilter
    from odometry import icp_2d
    from pairs import PairSettings, radar_to_image
    from pix2pix import TrainedNetwork, generate

MIN_RANGE_M = 2.5  # closer points come from the radar's own leakage


@dataclass(frozen=True)
class LocalizedScan:
    """Pose of one scan.

    Attributes
    ----------
    pose : array, shape (3,)
        Estimate T_map_radar [m, m, rad].
    covariance : array, shape (3, 3)
        Of (x, y, yaw) in the map frame [m, m, rad].
    points : array, shape (n, 2)
        Generated points in the radar frame [m].
    update : MclUpdate
        Diagnostics of the filter.
    """

    pose: np.ndarray
    covariance: np.ndarray
    points: np.ndarray
    update: Any


def scan_to_points(network: TrainedNetwork, scan: Any) -> np.ndarray:
    """Generate lidar points from a radar scan.

    Parameters
    ----------
    network : TrainedNetwork
        From `rol.pix2pix.load_network`; it states the geometry of its images and its threshold.
    scan : RadarScan
        From `rol.oxford.load_radar`; any object with ``power``, shape (a, b) of uint8, and ``azimuths``,
        shape (a,) [rad].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m].

    Notes
    -----
    Yin et al. 2020, Sec. III-A, Eq. 5.
    """
    settings = PairSettings.from_dict({**network.settings, "motion": "none"})
    image = radar_to_image(scan.power, scan.azimuths, None, settings)
    extent = {"pixel_size": settings.pixel_size, "max_range": settings.max_range}
    return image_to_points(
        generate(network.generator, image), **network.points, **extent, min_range=MIN_RANGE_M
    )


class RadarLocalizer:
    """Localize radar scans on a lidar map, one at a time.

    As in the paper, motion during a scan is not compensated; `rol_beyond.pipeline.RobustLocalizer`
    compensates it.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    network : TrainedNetwork
        From `rol.pix2pix.load_network`.
    start : array-like, shape (3,)
        Pose T_map_radar at the first scan [m, m, rad].
    rng : numpy.random.Generator
        Random generator.
    settings : MclSettings, optional
        Settings of the filter; the paper's if not given.
    """

    def __init__(
        self,
        map_points: np.ndarray,
        network: TrainedNetwork,
        start: np.ndarray,
        *,
        rng: np.random.Generator,
        settings: MclSettings | None = None,
    ) -> None:
        settings = settings or MclSettings()
        grid = settings.measurement.build_grid(map_points)
        self.network, self.particle_filter = network, ParticleFilter(grid, start, settings, rng)
        self.last_points: np.ndarray | None = None
        self.increment = np.zeros(3)

    def step(self, scan: Any) -> LocalizedScan:
        """Localize one scan: image, generated points, ICP, then predict, weight, resample and estimate.

        Parameters
        ----------
        scan : RadarScan
            As for `scan_to_points`.

        Returns
        -------
        result : LocalizedScan

        Notes
        -----
        Yin et al. 2020, Sec. III.
        """
        points, increment = scan_to_points(self.network, scan), None
        if self.last_points is not None:
            # The initial guess of ICP is the last increment: constant velocity.
            increment = icp_2d(points, self.last_points, self.increment).T_target_source
            self.increment = increment
        self.last_points = points
        update = self.particle_filter.step(points, increment)
        return LocalizedScan(update.pose, update.covariance, points, update)
