"""The robust method from scan to pose: front end, local-map odometry, and the filter with recovery."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rol.pipeline import LocalizedScan
from rol_beyond.front_ends import resample_by_density
from rol_beyond.local_map_odometry import LocalMapOdometry
from rol_beyond.recovery import RecoveringFilter


class RobustLocalizer:
    """Localize radar scans on a lidar map, one at a time, with recovery.

    It has the ``step`` of `rol.pipeline.RadarLocalizer`.

    Parameters
    ----------
    robust_filter : RecoveringFilter
        Map, start and settings.
    front_end : callable
        Takes a scan and returns its points as recorded in the radar frame, shape (n, 2) [m]; for instance by
        `rol_beyond.front_ends.generate_points`.
    density_radius_m : float
        Radius of `rol_beyond.front_ends.resample_by_density` for the points given to the filter [m]; 0 leaves
        them as they are.
    odometry : LocalMapOdometry, optional
        With other settings than the default.
    """

    def __init__(
        self,
        robust_filter: RecoveringFilter,
        front_end: Callable[[Any], np.ndarray],
        *,
        density_radius_m: float = 0.0,
        odometry: LocalMapOdometry | None = None,
    ) -> None:
        self.robust_filter, self.front_end, self.density_radius_m = robust_filter, front_end, density_radius_m
        self.odometry = odometry or LocalMapOdometry()

    def step(self, scan: Any) -> LocalizedScan:
        """Localize one scan.

        The filter gets the points compensated for the velocity that the odometry finds in them. Those of
        the first scan are not compensated.

        Parameters
        ----------
        scan : RadarScan
            From `rol.oxford.load_radar`; any object with ``stamp_us`` that the front end accepts.

        Returns
        -------
        result : LocalizedScan
            ``update`` is a `rol_beyond.recovery.RecoveryUpdate`.
        """
        points, increment = self.front_end(scan), None
        found = self.odometry.step(points, scan.stamp_us)
        if found is not None:
            # The points, not the image: a network runs once, and the RMSE on real scans is not larger.
            points, increment = self.odometry.deskew(points, found.twist), found.T_target_source
        used = points
        if self.density_radius_m:
            used = resample_by_density(points, self.density_radius_m, self.robust_filter.rng)
        update = self.robust_filter.step(used, increment)
        return LocalizedScan(update.pose, update.covariance, points, update)
