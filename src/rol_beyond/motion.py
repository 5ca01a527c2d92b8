"""Motion model of radar odometry: scale, noise and outliers, calibrated on a session with known ground truth.

The errors of radar odometry are partly systematic. It is short where the range resolution is assumed too
small, a turn moves the sensor sideways when it is mounted ahead of the axle, errors of successive increments
are correlated, and a few increments are plainly wrong. Increments are poses (x, y, yaw) of a scan in the one
before [m, m, rad].
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from rol.geometry import check_fields, check_pose, check_poses, wrap_angle

# Largest change between increments at 4 Hz, forward and in heading [m, rad]: an acceleration of 10 m/s2, full
# braking, and more than twice the change at the entry of a bend.
MAX_CHANGE = (0.6, np.deg2rad(2.5))
PATIENCE = 3  # after so many rejected increments in a row the next one is accepted: the reference was wrong
MIN_SIGMAS = (0.02, 0.01, np.deg2rad(0.1))  # of a stationary vehicle, which may creep [m, m, rad]


@dataclass(frozen=True)
class MotionModel:
    """Distribution of the true increment given a measured one; by default the odometry with wide noise.

    A `rol.mcl.MclSettings.motion`. Yin et al. 2020, Sec. III-B, Eq. 7, with calibrated noise.

    Attributes
    ----------
    matrix, stationary_matrix : tuple of tuple of float, shape (3, 3)
        Mean of the true increment = matrix @ measured increment; the second for increments shorter than
        ``stationary_m``.
    sigma_stationary : tuple of float, shape (3,)
        Standard deviations of such an increment (forward, left, yaw) [m, m, rad].
    sigma_base, sigma_per_metre : tuple of float, shape (3,)
        Those of a longer increment: a constant part, and a part per metre [m, m, rad] and [m/m, m/m, rad/m].
    outlier_fraction, outlier_scale : float
        Fraction of increments whose standard deviation is larger by this factor.
    stationary_m : float
        Length below which the vehicle counts as stationary [m]. 0.08: of the real odometry's increments of a
        stationary vehicle, 99 % are shorter.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    stationary_matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sigma_stationary: tuple[float, float, float] = (0.05, 0.05, 0.006)
    sigma_base: tuple[float, float, float] = (0.05, 0.05, 0.004)
    sigma_per_metre: tuple[float, float, float] = (0.05, 0.02, 0.0)
    outlier_fraction: float = 0.02
    outlier_scale: float = 10.0
    stationary_m: float = 0.08

    def __post_init__(self) -> None:
        allowed = {
            "(-inf, inf)": "matrix stationary_matrix",
            "[0, inf)": "sigma_stationary sigma_base sigma_per_metre outlier_scale stationary_m",
            "[0, 1]": "outlier_fraction",
        }
        check_fields(self, allowed)

    def mean(self, increment: np.ndarray) -> np.ndarray:
        """Compute the mean of the true increment.

        Parameters
        ----------
        increment : array, shape (..., 3)
            Odometry [m, m, rad].

        Returns
        -------
        increment : array, shape (..., 3)
            Corrected increment, yaw in [-pi, pi) [m, m, rad].
        """
        increment = check_poses(increment, "odometry increment")
        is_stationary = np.hypot(increment[..., :1], increment[..., 1:2]) < self.stationary_m
        slow, fast = (increment @ np.array(m).T for m in (self.stationary_matrix, self.matrix))
        corrected = np.where(is_stationary, slow, fast)
        corrected[..., 2] = wrap_angle(corrected[..., 2])
        return corrected

    def sample(self, increment: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw n increments, a fraction of them with the noise of an outlier.

        Parameters
        ----------
        increment : array, shape (3,)
            Odometry [m, m, rad].
        n : int
            Number of draws.
        rng : numpy.random.Generator
            Random generator.

        Returns
        -------
        increments : array, shape (n, 3)
            [m, m, rad].
        """
        mean, length = self.mean(increment), np.hypot(increment[0], increment[1])
        is_stationary = length < self.stationary_m
        sigmas = np.array(self.sigma_stationary if is_stationary else self.sigma_base)
        sigmas = sigmas + (not is_stationary) * length * np.array(self.sigma_per_metre)
        scale = np.where(rng.random(n) < self.outlier_fraction, self.outlier_scale, 1.0)
        return mean + rng.standard_normal((n, 3)) * sigmas * scale[:, None]


def calibrate_motion(
    increments: np.ndarray, true_increments: np.ndarray, *, window: int = 16, inflation: float = 2.0
) -> MotionModel:
    """Calibrate the motion model on increments with known ground truth.

    The matrix is fitted to sums over windows of increments, so that it holds over a distance and not for one
    increment only. The noise is the standard deviation of such sums per increment, so that correlated errors
    enter with their sum. Windows with an outlier are excluded; fraction and size of the outliers are too rare
    to be estimated from one session and keep the defaults of `MotionModel`.

    Parameters
    ----------
    increments, true_increments : array, shape (n, 3)
        Odometry and ground truth [m, m, rad]; n at least two windows.
    window : int
        Increments per window; over 16 increments, four seconds, errors are independent.
    inflation : float
        Factor on the standard deviations: the odometry of another day has other errors, and errors are larger
        where the vehicle brakes. With 2 the spread on the real route is wider than the error.

    Returns
    -------
    model : MotionModel

    Raises
    ------
    ValueError
        If the lengths differ, there are too few increments, or every window has an outlier.
    """
    increments = check_poses(increments, "odometry")
    truth = check_poses(true_increments, "true increments")
    if increments.shape != truth.shape or len(increments) < 2 * window:
        raise ValueError(
            f"motion: {len(increments)} increments for {len(truth)} true ones, at least {2 * window} needed"
        )
    is_outlier = _find_outliers(increments, truth)
    is_good = _window_sums(is_outlier[:, None].astype(np.float64), window)[:, 0] == 0.0
    if not is_good.any():
        raise ValueError(f"motion: an outlier in every window of {window} increments")
    is_stationary = np.hypot(increments[:, 0], increments[:, 1]) < MotionModel.stationary_m
    measured, true = _window_sums(increments, window)[is_good], _window_sums(truth, window)[is_good]
    matrix = np.linalg.lstsq(measured, true, rcond=None)[0].T
    is_used = is_stationary & ~is_outlier
    slow_matrix = _fit_stationary(increments[is_used], truth[is_used])
    errors = truth - np.where(is_stationary[:, None], increments @ slow_matrix.T, increments @ matrix.T)
    errors = inflation * _window_sums(errors, window)[is_good] / np.sqrt(window)
    lengths = np.hypot(increments[:, :1], increments[:, 1:2])
    stationary = _window_sums(is_stationary[:, None].astype(np.float64), window)[is_good, 0] / window
    length = _window_sums(lengths, window)[is_good, 0] / window
    noise = _fit_noise(errors, length, stationary)
    rows = [tuple(tuple(float(v) for v in row) for row in fitted) for fitted in (matrix, slow_matrix)]
    return MotionModel(*rows, *noise)


def _fit_stationary(increments: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Fit a diagonal matrix to increments of a stationary vehicle; the identity for fewer than 20."""
    if len(increments) < 20:
        return np.eye(3)
    return np.diag(np.sum(increments * truth, axis=0) / np.maximum(np.sum(increments**2, axis=0), 1e-12))


def _find_outliers(increments: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Mark increments with an error beyond eight robust standard deviations in any component, shape (n,)."""
    errors = truth - increments @ np.linalg.lstsq(increments, truth, rcond=None)[0]
    return (np.abs(errors) > 8.0 * 1.4826 * np.median(np.abs(errors), axis=0) + 1e-9).any(axis=1)


def _fit_noise(errors: np.ndarray, length: np.ndarray, stationary: np.ndarray) -> list[tuple[float, ...]]:
    """Fit the standard deviations of the model; `stationary` is a fraction of each window."""

    def spread(chosen: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(errors[chosen] ** 2, axis=0)) if chosen.sum() > 4 else otherwise

    everywhere, is_moving = np.sqrt(np.mean(errors**2, axis=0)), stationary < 0.5
    is_fast = is_moving & (length > np.median(length[is_moving])) if is_moving.any() else is_moving
    at_rest = np.maximum(spread(stationary == 1.0, everywhere), MIN_SIGMAS)
    fast = spread(is_fast, everywhere)
    slow = spread(is_moving & ~is_fast, fast)
    groups = is_moving & ~is_fast, is_fast
    middle = [float(length[chosen].mean()) if chosen.any() else 0.0 for chosen in groups]
    per_metre = np.maximum(fast - slow, 0.0) / max(middle[1] - middle[0], 0.1)
    base = np.maximum(slow - per_metre * middle[0], 0.3 * slow)
    return [tuple(map(float, values)) for values in (at_rest, base, per_metre)]


def _window_sums(values: np.ndarray, window: int) -> np.ndarray:
    """Sum over windows that overlap by half, shape (k, columns)."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (sums[window:] - sums[:-window])[:: max(window // 2, 1)]


def gate_odometry(increments: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Replace implausible increments by the last plausible one.

    Parameters
    ----------
    increments : iterable of array, shape (3,)
        Odometry at 4 Hz [m, m, rad].

    Yields
    ------
    increment : array, shape (3,)
        As many as given.
    """
    last, n_rejected = None, 0
    for increment in increments:
        increment = check_pose(increment, "odometry increment")
        if last is not None and n_rejected < PATIENCE:
            change = abs(increment[0] - last[0]), abs(float(wrap_angle(increment[2] - last[2])))
            if change[0] > MAX_CHANGE[0] or change[1] > MAX_CHANGE[1]:
                n_rejected += 1
                yield last.copy()
                continue
        last, n_rejected = increment, 0
        yield increment
