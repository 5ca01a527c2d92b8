"""Likelihood field: a Gaussian of the distance to the map instead of the threshold of Eq. 9."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from rol.geometry import check_fields
from rol.mcl import MapGrid, MclError, tabulate_distances

_HALF_DENSITY = 0.6  # mean score around a cell at which its own score is halved, as a fraction of the best


@dataclass(frozen=True)
class LikelihoodField:
    """Likelihood of a scan by the distances of its points to the map; a `rol.mcl.MclSettings.measurement`.

    Attributes
    ----------
    exponent : float
        lambda of Eq. 8, as in `rol.mcl.Measurement`. 20 was chosen with sampled points on the real route.
    sigma_m : float
        Standard deviation of the Gaussian [m]. 0.2: on the real route 0.3 has a tenth more error, and with
        0.45 the pose is lost in dense map regions.
    density_radius_m : float
        Points in dense map regions are down-weighted by the map within this distance, see
        `build_likelihood_field` [m]; 0 weights all alike. With 2 the pose slips far less along a street of
        hedges on the real route, where points match at many places.
    cell_m : float
        Side of a grid cell [m].

    Raises
    ------
    rol.mcl.MclError
        If a value is out of its range; the message names it.
    """

    exponent: float = 20.0
    sigma_m: float = 0.2
    density_radius_m: float = 2.0
    cell_m: float = 0.25

    def __post_init__(self) -> None:
        allowed = {"(0, inf)": "exponent sigma_m cell_m", "[0, inf)": "density_radius_m"}
        check_fields(self, allowed, MclError)

    def build_grid(self, map_points: np.ndarray) -> MapGrid:
        """Build the grid of a map, shape (m, 2) [m], once per map."""
        return build_likelihood_field(map_points, self.sigma_m, self.cell_m, self.density_radius_m)


def build_likelihood_field(
    map_points: np.ndarray, sigma: float = 0.2, cell: float = 0.25, density_radius_m: float = 0.0
) -> MapGrid:
    """Tabulate a Gaussian of the distance to the map, divided by the density of the map.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    sigma : float
        Standard deviation of the Gaussian [m].
    cell : float
        Side of a cell [m].
    density_radius_m : float
        Half the side of the square around each cell over which the density is averaged [m]; 0: no division.

    Returns
    -------
    grid : MapGrid
        exp(-d^2 / 2 sigma^2) in 255 steps, 0 from three sigma on. With ``density_radius_m`` it is divided by
        1 + c / 0.6, with its mean c over the square: in a hedge nearly every place is matched, and a match
        there is little evidence.
    """
    squares = (np.arange(4096) + 0.5) / 4096 * 9.0
    scores = np.round(255.0 * np.exp(-0.5 * squares)).astype(np.uint8)
    values, origin = tabulate_distances(map_points, cell, 3.0 * sigma, scores)
    n_cells = round(density_radius_m / cell)
    return MapGrid(_divide_by_density(values, n_cells) if density_radius_m else values, origin, cell, 255)


def _divide_by_density(values: np.ndarray, n_cells: int) -> np.ndarray:
    """Divide each value by one plus the mean around it, in units of ``_HALF_DENSITY`` of the best."""
    density = uniform_filter(values, 2 * n_cells + 1, output=np.float32, mode="constant")
    density /= np.float32(255.0 * _HALF_DENSITY)
    density += 1.0
    return np.round(np.divide(values, density, out=density), out=density).astype(np.uint8)
