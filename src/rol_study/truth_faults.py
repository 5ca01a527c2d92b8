"""Find faulty segments of a ground truth by comparing its increments with those of the odometry.

A few published ground truths stop or jump while the vehicle moves on. No estimate can follow them, so
results are given with and without these scans. The rule compares ground truth and odometry only; it sees no
estimate.
"""

from __future__ import annotations

import numpy as np

from rol.geometry import check_poses, relative_pose

MIN_LIMIT_M = 0.3  # 4.3 km/h within a quarter of a second [m]
STANDING_M = 0.05  # a step of the ground truth shorter than this is none [m]


def find_faulty_steps(
    truth: np.ndarray, increments: np.ndarray, *, n_sigmas: float = 10.0, half_window: int = 3
) -> np.ndarray:
    """Mark the increments of a ground truth that contradict an even odometry.

    A step from one scan to the next is faulty if

    - it differs in length from the odometry increment, corrected for scale, by more than ``n_sigmas`` times
      the robust standard deviation of this difference over the moving vehicle (and more than
      ``MIN_LIMIT_M``), or by more than half of that where the ground truth has stopped, and
    - the odometry increment differs by less than half of that from the median of its neighbours, so that it
      is not an outlier of the odometry.

    Scale and standard deviation are medians over the session itself, so neither a scale error of the odometry
    nor its noise nor the faulty steps change the rule.

    Parameters
    ----------
    truth : array, shape (n, 3)
        Ground-truth poses [m, m, rad].
    increments : array, shape (n - 1, 3)
        Odometry increments between them [m, m, rad].
    n_sigmas : float
        Limit in standard deviations. At 10, about 0.5 m, the CFEAR-3 odometry of sessions 01 and 02
        contradicts the ground truth at each marked step, too, by at least 0.4 m.
    half_window : int
        Neighbours on each side.

    Returns
    -------
    is_faulty : array of bool, shape (n - 1,)
        None for a session without 20 increments of more than 0.5 m, from which a scale could be estimated.

    Raises
    ------
    ValueError
        If there is not one increment between each two poses.
    """
    truth, increments = check_poses(truth, "ground truth"), check_poses(increments, "odometry")
    if len(increments) != len(truth) - 1:
        raise ValueError(f"{len(increments)} odometry increments for {len(truth)} poses")
    steps = relative_pose(truth[:-1], truth[1:])
    true_m, measured_m = (np.hypot(rows[:, 0], rows[:, 1]) for rows in (steps, increments))
    is_moving = (measured_m > 0.5) & (true_m > 0.5)
    if is_moving.sum() < 20:
        return np.zeros(len(increments), dtype=bool)
    gaps = true_m - measured_m * np.median(true_m[is_moving] / measured_m[is_moving])
    limit = max(n_sigmas * 1.4826 * float(np.median(np.abs(gaps[is_moving]))), MIN_LIMIT_M)
    padded = np.pad(measured_m, half_window, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half_window + 1)
    is_even = np.abs(measured_m - np.median(windows, axis=1)) < 0.5 * limit
    return (np.abs(gaps) > np.where(true_m < STANDING_M, 0.5 * limit, limit)) & is_even


def find_faulty_scans(truth: np.ndarray, increments: np.ndarray, *, max_gap: int = 8) -> np.ndarray:
    """Mark the scans whose ground truth is faulty: those at a faulty step,
    and those shortly between two of them.

    Between a segment in which the ground truth has stopped and the jump that ends it, single steps may look
    right while the poses are still wrong.

    Parameters
    ----------
    truth, increments
        As for `find_faulty_steps`.
    max_gap : int
        Right steps between two faulty ones, up to this number, are marked with them; 8 are two seconds.

    Returns
    -------
    is_faulty : array of bool, shape (n,)
    """
    steps = np.flatnonzero(find_faulty_steps(truth, increments))
    is_faulty = np.zeros(len(truth), dtype=bool)
    for first, last in group_steps(steps, max_gap):
        is_faulty[first : last + 2] = True
    return is_faulty


def group_steps(steps: np.ndarray, max_gap: int = 8) -> list[tuple[int, int]]:
    """Group steps with at most `max_gap` others between them,
    as pairs of the first and the last step of each group."""
    if not len(steps):
        return []
    parts = np.split(steps, np.flatnonzero(np.diff(steps) > max_gap + 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]
