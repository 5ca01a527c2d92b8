"""What odometry is worth: a model of its scale, its noise and its outliers, learnt from a drive whose truth is known.

Radar odometry errs in ways that a filter can know. It is short where the length of a range bin is taken too small,
a turn moves the sensor sideways when it stands before the axle, errors of one step resemble those of the next,
and now and then a step is plainly wrong. Steps are poses (x, y, yaw) of a scan in the one before [m, m, rad].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

try:
    from .geometry import check_poses, compose, wrap_angle
except ImportError:  # this file was copied on its own
    from geometry import check_poses, compose, wrap_angle


@dataclass(frozen=True)
class MotionModel:
    """How a true step follows from the odometry's; the defaults trust the odometry and are wide.

    Attributes
    ----------
    matrix : tuple of tuple of float, shape (3, 3)
        True step = matrix @ odometry step, on average.
    still : tuple of float, shape (3,)
        Standard deviations of a step that goes nowhere (forward, left, yaw) [m, m, rad].
    moving : tuple of float, shape (3,)
        What is added to them for each metre of the step [m/m, m/m, rad/m].
    outlier_share, outlier_scale : float
        Share of the steps that err so many times as much.
    """

    matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    still: tuple[float, float, float] = (0.05, 0.05, 0.004)
    moving: tuple[float, float, float] = (0.05, 0.02, 0.002)
    outlier_share: float = 0.02
    outlier_scale: float = 10.0


def learn_motion(
    steps: np.ndarray,
    true_steps: np.ndarray,
    *,
    window: int = 16,
    outlier_share: float = 0.02,
    outlier_scale: float = 10.0,
) -> MotionModel:
    """Learn the model from steps whose truth is known.

    The matrix is fitted to sums over windows of steps, so that it holds over a way and not for a step alone; the noise
    is the spread of such sums per step, so that errors which go on from step to step count as what they become. Windows
    with a gross error are left out.

    Parameters
    ----------
    steps, true_steps : array, shape (n, 3)
        What the odometry says and what is true [m, m, rad]; n at least two windows.
    window : int
        Steps that are summed up; over 16 steps, four seconds, errors are independent.
    outlier_share, outlier_scale : float
        Of the model: too rare to be learnt from one drive, so they are stated.

    Returns
    -------
    model : MotionModel

    Raises
    ------
    ValueError
        If the lengths differ, there are too few steps, or gross errors everywhere.
    """
    steps, true_steps = check_poses(steps, "odometry"), check_poses(true_steps, "true steps")
    if steps.shape != true_steps.shape or len(steps) < 2 * window:
        raise ValueError(
            f"motion: {len(steps)} steps for {len(true_steps)} true ones, at least {2 * window} needed"
        )
    told, true = _window_sums(steps, window), _window_sums(true_steps, window)
    length = _window_sums(np.hypot(steps[:, :1], steps[:, 1:2]), window)[:, 0] / window
    rough = true_steps - steps @ np.linalg.lstsq(steps, true_steps, rcond=None)[0]
    is_gross = (np.abs(rough) > 8.0 * 1.4826 * np.median(np.abs(rough), axis=0) + 1e-9).any(axis=1)
    is_kept = _window_sums(is_gross[:, None].astype(np.float64), window)[:, 0] == 0.0
    if not is_kept.any():
        raise ValueError(f"motion: a gross error in every window of {window} steps")
    matrix = np.linalg.lstsq(told[is_kept], true[is_kept], rcond=None)[0].T
    errors = true - told @ matrix.T
    squares, is_still = errors**2 / window, length < 0.1
    still = np.sqrt(squares[is_kept & is_still].mean(axis=0)) if (is_kept & is_still).any() else np.zeros(3)
    spread = np.sqrt(squares[is_kept & ~is_still].mean(axis=0)) if (is_kept & ~is_still).any() else still
    moving = np.maximum(spread - still, 0.0) / max(float(length[is_kept].max()), 0.1)
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    return MotionModel(
        rows, tuple(map(float, still)), tuple(map(float, moving)), outlier_share, outlier_scale
    )


def _window_sums(values: np.ndarray, window: int) -> np.ndarray:
    """Sums over windows that overlap by half."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (sums[window:] - sums[:-window])[:: max(window // 2, 1)]


def correct_step(step: np.ndarray, model: MotionModel) -> np.ndarray:
    """Give the step that is meant by what the odometry says.

    Parameters
    ----------
    step : array, shape (..., 3)
        Odometry [m, m, rad].
    model : MotionModel
        Its model.

    Returns
    -------
    step : array, shape (..., 3)
        The most likely true step [m, m, rad].
    """
    corrected = check_poses(step, "odometry step") @ np.array(model.matrix).T
    corrected[..., 2] = wrap_angle(corrected[..., 2])
    return corrected


def sample_motion(
    particles: np.ndarray, step: np.ndarray, model: MotionModel, rng: np.random.Generator
) -> np.ndarray:
    """Move particles by a step of the odometry, each with a noise of its own.

    Parameters
    ----------
    particles : array, shape (n, 3)
        Poses at the last scan [m, m, rad].
    step : array, shape (3,)
        Odometry [m, m, rad].
    model : MotionModel
        Its model; a share of the particles takes the noise of an outlier.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    particles : array, shape (n, 3)
        Poses at this scan. Yin et al. 2020, Sec. III-B, Eq. 7, with a noise that is learnt.
    """
    mean = correct_step(step, model)
    sigmas = np.array(model.still) + np.hypot(mean[0], mean[1]) * np.array(model.moving)
    scale = np.where(rng.random(len(particles)) < model.outlier_share, model.outlier_scale, 1.0)
    return compose(particles, mean + rng.standard_normal((len(particles), 3)) * sigmas * scale[:, None])
