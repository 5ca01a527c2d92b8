"""What odometry is worth: a model of its scale, its noise and its outliers, learnt from a drive whose truth is known.

Radar odometry errs in ways that a filter can know. It is short where the length of a range bin is taken too small,
a turn moves the sensor sideways when it stands before the axle, errors of one step resemble those of the next,
and now and then a step is plainly wrong. Steps are poses (x, y, yaw) of a scan in the one before [m, m, rad].
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from rol.geometry import check_fields, check_poses, compose, wrap_angle

LEAST_NOISE = (0.02, 0.01, np.deg2rad(0.1))  # of a car that is taken to stand: it may creep [m, m, rad]


@dataclass(frozen=True)
class MotionModel:
    """How a true step follows from the odometry's; the defaults trust the odometry and are wide.

    Attributes
    ----------
    matrix, still_matrix : tuple of tuple of float, shape (3, 3)
        True step = matrix @ odometry step, on average; the second for steps of less than ``still_m``.
    still : tuple of float, shape (3,)
        Standard deviations of such a step (forward, left, yaw) [m, m, rad].
    driving, moving : tuple of float, shape (3,)
        Those of a longer one, and what is added to them for each metre of it [m, m, rad] and [m/m, m/m, rad/m].
    outlier_share, outlier_scale : float
        Share of the steps that err so many times as much.
    still_m : float
        Length below which a car counts as standing [m]. 0.08: of the real odometry's steps while the car stands, 99 %
        are shorter.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    still_matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    still: tuple[float, float, float] = (0.05, 0.05, 0.006)
    driving: tuple[float, float, float] = (0.05, 0.05, 0.004)
    moving: tuple[float, float, float] = (0.05, 0.02, 0.0)
    outlier_share: float = 0.02
    outlier_scale: float = 10.0
    still_m: float = 0.08

    def __post_init__(self) -> None:
        allowed = {
            "(-inf, inf)": "matrix still_matrix",
            "[0, inf)": "still driving moving outlier_scale still_m",
            "[0, 1]": "outlier_share",
        }
        check_fields(self, allowed)


def learn_motion(
    steps: np.ndarray, true_steps: np.ndarray, *, window: int = 16, caution: float = 2.0
) -> MotionModel:
    """Learn the model from steps whose truth is known.

    The matrix is fitted to sums over windows of steps, so that it holds over a way and not for a step alone; the noise
    is the spread of such sums per step, so that errors which go on from step to step count as what they become. Windows
    with a gross error are left out; how often and how far a step errs grossly is too rare to be learnt from one drive,
    and stays what `MotionModel` states.

    Parameters
    ----------
    steps, true_steps : array, shape (n, 3)
        What the odometry says and what is true [m, m, rad]; n at least two windows.
    window : int
        Steps that are summed up; over 16 steps, four seconds, errors are independent.
    caution : float
        The noise is taken so many times as large as it was found: another day's odometry errs otherwise, and errors
        are larger where the car brakes. With 2 the spread on the real route is wider than the error (chapter 09).

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
    is_gross, is_still = (
        _find_gross(steps, true_steps),
        np.hypot(steps[:, 0], steps[:, 1]) < MotionModel.still_m,
    )
    is_good = _window_sums(is_gross[:, None].astype(np.float64), window)[:, 0] == 0.0
    if not is_good.any():
        raise ValueError(f"motion: a gross error in every window of {window} steps")
    told, true = _window_sums(steps, window)[is_good], _window_sums(true_steps, window)[is_good]
    matrix = np.linalg.lstsq(told, true, rcond=None)[0].T
    still_matrix = _fit_still(steps[is_still & ~is_gross], true_steps[is_still & ~is_gross])
    errors = true_steps - np.where(is_still[:, None], steps @ still_matrix.T, steps @ matrix.T)
    lengths = np.hypot(steps[:, :1], steps[:, 1:2])
    stood = _window_sums(is_still[:, None].astype(np.float64), window)[is_good, 0] / window
    length = _window_sums(lengths, window)[is_good, 0] / window
    errors = caution * _window_sums(errors, window)[is_good] / np.sqrt(window)
    noise = _fit_noise(errors, length, stood)
    rows = [tuple(tuple(float(v) for v in row) for row in fitted) for fitted in (matrix, still_matrix)]
    return MotionModel(*rows, *noise)


def _fit_still(steps: np.ndarray, true_steps: np.ndarray) -> np.ndarray:
    """Matrix of steps that hardly go anywhere, each part for itself; the identity where there are too few of them."""
    if len(steps) < 20:
        return np.eye(3)
    return np.diag(np.sum(steps * true_steps, axis=0) / np.maximum(np.sum(steps**2, axis=0), 1e-12))


def _find_gross(steps: np.ndarray, true_steps: np.ndarray) -> np.ndarray:
    """Mark steps that err eight times as much as is usual, in any of their parts."""
    errors = true_steps - steps @ np.linalg.lstsq(steps, true_steps, rcond=None)[0]
    return (np.abs(errors) > 8.0 * 1.4826 * np.median(np.abs(errors), axis=0) + 1e-9).any(axis=1)


def _fit_noise(errors: np.ndarray, length: np.ndarray, stood: np.ndarray) -> list[tuple[float, ...]]:
    """Spread of errors when standing, when driving, and what a metre adds to that; `stood` is a share of the window."""

    def spread(chosen: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(errors[chosen] ** 2, axis=0)) if chosen.sum() > 4 else otherwise

    everywhere, drove = np.sqrt(np.mean(errors**2, axis=0)), stood < 0.5
    is_fast = drove & (length > np.median(length[drove])) if drove.any() else drove
    still = np.maximum(spread(stood == 1.0, everywhere), LEAST_NOISE)
    fast = spread(is_fast, everywhere)
    slow = spread(drove & ~is_fast, fast)
    middle = [float(length[chosen].mean()) if chosen.any() else 0.0 for chosen in (drove & ~is_fast, is_fast)]
    moving = np.maximum(fast - slow, 0.0) / max(middle[1] - middle[0], 0.1)
    driving = np.maximum(slow - moving * middle[0], 0.3 * slow)
    return [tuple(map(float, values)) for values in (still, driving, moving)]


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
    step = check_poses(step, "odometry step")
    is_still = np.hypot(step[..., :1], step[..., 1:2]) < model.still_m
    corrected = np.where(is_still, step @ np.array(model.still_matrix).T, step @ np.array(model.matrix).T)
    corrected[..., 2] = wrap_angle(corrected[..., 2])
    return corrected


def screen_steps(
    steps: Iterable[np.ndarray],
    *,
    max_change: tuple[float, float] = (0.6, np.deg2rad(2.5)),
    patience: int = 3,
) -> Iterator[np.ndarray]:
    """Replace steps that no car can make after the one before by that one: going on as it went errs less.

    Parameters
    ----------
    steps : iterable of array, shape (3,)
        Odometry [m, m, rad].
    max_change : tuple of float
        Change from one step to the next, forward [m] and in heading [rad], beyond which a step is not believed. At 4 Hz
        0.6 m are an acceleration of 10 m/s2, full braking, and 2.5 deg more than twice what a car at a bend's entry
        does.
    patience : int
        After so many steps in a row that are not believed the next one is: then it was the one before them that erred.

    Yields
    ------
    step : array, shape (3,)
        As many as given.
    """
    last, n_refused = None, 0
    for step in steps:
        step = check_poses(step, "odometry step")
        if last is not None and n_refused < patience:
            change = abs(step[0] - last[0]), abs(float(wrap_angle(step[2] - last[2])))
            if change[0] > max_change[0] or change[1] > max_change[1]:
                n_refused += 1
                yield last.copy()
                continue
        last, n_refused = step, 0
        yield step


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
    mean, length = correct_step(step, model), np.hypot(step[0], step[1])
    is_still = length < model.still_m
    sigmas = np.array(model.still if is_still else model.driving) + (not is_still) * length * np.array(
        model.moving
    )
    scale = np.where(rng.random(len(particles)) < model.outlier_share, model.outlier_scale, 1.0)
    return compose(particles, mean + rng.standard_normal((len(particles), 3)) * sigmas * scale[:, None])


def mover(model: MotionModel) -> Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]:
    """Give `sample_motion` with a model, as `rol.mcl.localize` and `rol_beyond.recovery.localize_with_recovery` ask for it.

    Parameters
    ----------
    model : MotionModel
        Of the odometry.

    Returns
    -------
    move : callable
        Takes particles, a step and a generator, gives the moved particles.
    """

    def move(particles: np.ndarray, step: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return sample_motion(particles, step, model, rng)

    return move
