"""Detectors of peaks in polar radar scans beyond the k strongest of `rol.radar`."""

from __future__ import annotations

import numpy as np

from rol.radar import check_power

_LINEAR_POWER = 10.0 ** (np.arange(256) / 20.0)  # of steps of half a decibel


def cfar_peaks(
    power: np.ndarray,
    *,
    guard_bins: int = 12,
    train_bins: int = 40,
    threshold_db: float = 12.0,
    min_bin: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Find local maxima along range by cell-averaging CFAR.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps.
    guard_bins, train_bins : int
        Bins left out next to the cell on either side, and bins beyond them whose mean power is the floor.
    threshold_db : float
        How far above the floor a cell must be [dB].
    min_bin : int
        Nearest bin kept.

    Returns
    -------
    rows, bins : array, shape (n,)
        Indices of the detections, by row, near ones first.

    Raises
    ------
    ValueError
        If the power is not uint8, a width is not positive or a row is too short for the window.

    Notes
    -----
    Cells at the ends of a row take the floor from the side they have. The floor is a mean of powers, not of
    decibels, as in the classical detector.
    """
    power, reach = check_power(power), guard_bins + train_bins
    if guard_bins < 0 or train_bins < 1 or power.shape[1] <= 2 * reach:
        raise ValueError(
            f"CFAR: guard {guard_bins} and train {train_bins} bins do not fit power {power.shape}"
        )
    linear = _LINEAR_POWER[power]
    sums = np.cumsum(linear, axis=1, dtype=np.float64)
    sums = np.concatenate([np.zeros((len(power), 1)), sums], axis=1)
    edges = np.clip(
        np.arange(power.shape[1])[:, None] + (-reach, -guard_bins, guard_bins + 1, reach + 1),
        0,
        power.shape[1],
    )
    n_cells = (edges[:, 1] - edges[:, 0]) + (edges[:, 3] - edges[:, 2])
    floor = (
        sums[:, edges[:, 1]] - sums[:, edges[:, 0]] + sums[:, edges[:, 3]] - sums[:, edges[:, 2]]
    ) / n_cells
    found = linear > floor * 10.0 ** (threshold_db / 10.0)
    found[:, 1:] &= power[:, 1:] > power[:, :-1]  # of a plateau the first bin counts
    found[:, :-1] &= power[:, :-1] >= power[:, 1:]
    found[:, :min_bin] = False
    rows, bins = np.nonzero(found)
    return rows, bins
