"""Systematic resampling, and a number of particles that follows their spread (KLD-sampling)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rol.geometry import check_fields
from rol.mcl import MclError, check_weights, pick_indices, resample_multinomial

BIN = (0.25, 0.25, np.deg2rad(2.0))  # of the histogram of the belief: x, y, yaw [m, m, rad]
KL_BOUND = 0.05  # on the Kullback-Leibler distance between the belief and the particles
QUANTILE = 2.33  # of the standard normal distribution: the bound holds with a probability of 99 %


@dataclass(frozen=True)
class KldResampling:
    """Resampling with an adaptive number of particles; a `rol.mcl.MclSettings.resampling`.

    Attributes
    ----------
    ess_fraction : float
        Resample when the effective sample size falls below this fraction of the particles.
    min_particles, max_particles : int
        Bounds of the number of particles, see `kld_sample_size`.
    scheme : str
        "systematic" or "multinomial".

    Raises
    ------
    rol.mcl.MclError
        If a value is out of its range; the message names it.
    """

    ess_fraction: float = 0.5
    min_particles: int = 200
    max_particles: int = 1000
    scheme: str = "systematic"

    def __post_init__(self) -> None:
        allowed = {
            "[0, 1]": "ess_fraction",
            "[1, inf)": "min_particles max_particles",
            ("multinomial", "systematic"): "scheme",
        }
        check_fields(self, allowed, MclError)

    def draw(self, particles: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw as many particles by their weights as their spread requires, shape (k, 3)."""
        resample = {"multinomial": resample_multinomial, "systematic": resample_systematic}[self.scheme]
        n = kld_sample_size(particles[resample(weights, rng)])
        return particles[resample(weights, rng, int(np.clip(n, self.min_particles, self.max_particles)))]


def resample_systematic(weights: np.ndarray, rng: np.random.Generator, n: int | None = None) -> np.ndarray:
    """Draw n indices by systematic (low-variance) resampling.

    Parameters
    ----------
    weights : array, shape (m,)
        Weights, of any positive total.
    rng : numpy.random.Generator
        Random generator.
    n : int, optional
        Number of draws; as many as there are weights if not given.

    Returns
    -------
    indices : array of int, shape (n,)
        Particles to keep; index i occurs n * w_i times on average, and never differs from that by a full
        copy.
    """
    n = len(weights) if n is None else n
    return pick_indices(check_weights(weights), (np.arange(n) + rng.random()) / n)


def kld_sample_size(particles: np.ndarray) -> int:
    """Compute the number of particles that represents a belief with the spread of these.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Particles of equal weight (x, y, yaw) [m, m, rad].

    Returns
    -------
    n : int
        At least one.

    Notes
    -----
    Fox 2003, "Adapting the sample size in particle filters through KLD-sampling", Eq. 7.
    """
    cells = np.floor(particles / BIN).astype(np.int64)
    cells -= cells.min(axis=0)
    sides = cells.max(axis=0) + 1
    k = len(np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2])) - 1
    if k == 0:
        return 1
    part = 2.0 / (9.0 * k)
    return int(np.ceil(k / (2.0 * KL_BOUND) * (1.0 - part + np.sqrt(part) * QUANTILE) ** 3))
