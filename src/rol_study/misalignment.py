"""Measure how far the radar image and the lidar image of a pair are shifted against each other.

Both images have the sensor in the middle, row 0 farthest forward, column 0 farthest left. A shift is where
the radar shows what the lidar shows: positive rows lie behind, positive columns to the right, positive ranges
farther out.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import pandas as pd

from rol.oxford import Session
from rol.pairs import AlignedScan, PairSettings, build_pair


def measure_misalignment(
    radar_image: np.ndarray, lidar_image: np.ndarray, max_shift_px: int = 8, *, blind_px: float = 12.0
) -> tuple[float, float]:
    """Measure the shift of a radar image against the lidar image of the same place.

    Parameters
    ----------
    radar_image, lidar_image : array, shape (h, h)
        Power, and occupancy.
    max_shift_px : int
        Largest shift looked for in each direction [pixels].
    blind_px : float
        Radius around the sensor that is left out: there the radar shows its own leakage [pixels].

    Returns
    -------
    drow, dcol : float
        Shift at which both correlate best, to a fraction of a pixel; nan where the lidar image is empty or
        the best shift lies on the border of the search.
    """
    surface = correlate_images(radar_image, lidar_image, max_shift_px, blind_px=blind_px)
    row, col = np.unravel_index(int(np.argmax(surface)), surface.shape)
    if not surface.any() or not (0 < row < 2 * max_shift_px and 0 < col < 2 * max_shift_px):
        return float("nan"), float("nan")
    drow = row + _vertex(surface[row - 1 : row + 2, col]) - max_shift_px
    dcol = col + _vertex(surface[row, col - 1 : col + 2]) - max_shift_px
    return float(drow), float(dcol)


def correlate_images(
    radar_image: np.ndarray, lidar_image: np.ndarray, max_shift_px: int = 8, *, blind_px: float = 12.0
) -> np.ndarray:
    """Correlate two images over all small shifts.

    The local mean of the radar is subtracted and the lidar's pixels are blurred slightly, so that edges
    dominate.

    Parameters
    ----------
    radar_image, lidar_image : array, shape (h, h)
        Power, and occupancy.
    max_shift_px : int
        Largest shift in each direction [pixels].
    blind_px : float
        Radius around the sensor that is left out [pixels].

    Returns
    -------
    surface : array, shape (2 * max_shift_px + 1, 2 * max_shift_px + 1)
        Correlation in -1..1; the middle is no shift. All zero where an image is empty.
    """
    radar, lidar = _sharpen(radar_image, blind_px), _soften(lidar_image, blind_px)
    padded = cv2.copyMakeBorder(radar, *(4 * [max_shift_px]), cv2.BORDER_CONSTANT, value=0.0)
    scale = float(np.linalg.norm(radar) * np.linalg.norm(lidar))
    if scale == 0.0:
        return np.zeros((2 * max_shift_px + 1, 2 * max_shift_px + 1))
    size = 2 * max_shift_px + 1
    # The lidar image slides over the padded radar image: its first place is a shift by -max_shift_px.
    return cv2.matchTemplate(padded, lidar, cv2.TM_CCORR).reshape(size, size).astype(np.float64) / scale


def correlate_ranges(
    radar_image: np.ndarray,
    lidar_image: np.ndarray,
    band_edges_m: np.ndarray,
    max_shift_m: float = 2.0,
    *,
    pixel_size: float = 0.25,
    range_step: float = 0.125,
) -> tuple[np.ndarray, np.ndarray]:
    """Correlate two images along range, band by band; the tables of many scans may be added up.

    Parameters
    ----------
    radar_image, lidar_image : array, shape (h, h)
        Power, and occupancy.
    band_edges_m : array, shape (k + 1,)
        Edges of the range bands, increasing [m].
    max_shift_m : float
        Largest shift outwards and inwards [m].
    pixel_size, range_step : float
        Edge of a pixel, and step along range [m].

    Returns
    -------
    shifts_m : array, shape (s,)
        Shifts of the radar outwards [m].
    table : array, shape (k, s)
        Sum over lidar hits of the radar's sharpened power at hit plus shift.
    """
    edges = np.asarray(band_edges_m, dtype=np.float64)
    n_shift = round(max_shift_m / range_step)
    ranges = np.arange(edges[0] - max_shift_m, edges[-1] + max_shift_m, range_step)
    bearings = np.arange(0.0, 2.0 * np.pi, np.deg2rad(0.45))
    middle = (radar_image.shape[0] - 1) / 2.0
    rows = (middle - np.outer(np.cos(bearings), ranges) / pixel_size).astype(np.float32)
    cols = (middle - np.outer(np.sin(bearings), ranges) / pixel_size).astype(np.float32)
    radar = cv2.remap(_sharpen(radar_image, 0.0), cols, rows, cv2.INTER_LINEAR)
    lidar = cv2.remap(_soften(lidar_image, 0.0), cols, rows, cv2.INTER_LINEAR) * ranges.astype(np.float32)
    inner = slice(n_shift, len(ranges) - n_shift)
    bands = np.searchsorted(edges, ranges[inner], side="right") - 1
    table = np.zeros((len(edges) - 1, 2 * n_shift + 1))
    for i, shift in enumerate(range(-n_shift, n_shift + 1)):
        moved = radar[:, inner.start + shift : inner.stop + shift]
        per_range = np.einsum("br,br->r", lidar[:, inner], moved, dtype=np.float64)
        kept = (bands >= 0) & (bands < len(edges) - 1)
        table[:, i] = np.bincount(bands[kept], per_range[kept], minlength=len(edges) - 1)
    return np.arange(-n_shift, n_shift + 1) * range_step, table


def best_shifts(shifts: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Find the best shift of every row of a correlation table.

    Parameters
    ----------
    shifts : array, shape (s,)
        Evenly spaced shifts.
    table : array, shape (k, s)
        Correlation of each row at these shifts.

    Returns
    -------
    best : array, shape (k,)
        Vertex of the parabola through the three best neighbours; nan where the row is flat or its best value
        lies at an end.
    """
    best = np.full(len(table), np.nan)
    for i, row in enumerate(np.asarray(table, dtype=np.float64)):
        j = int(np.argmax(row))
        if 0 < j < len(row) - 1 and row[j] > row.min():
            best[i] = shifts[j] + _vertex(row[j - 1 : j + 2]) * (shifts[1] - shifts[0])
    return best


def measure_pairs(
    session: Session,
    alignments: Mapping[str, pd.DataFrame],
    settings: Mapping[str, PairSettings],
    band_edges_m: np.ndarray,
    max_shift_px: int = 16,
) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Measure the misalignment of the pairs of a session under several settings.

    Parameters
    ----------
    session : Session
        The session.
    alignments : mapping of str to DataFrame
        Motion of `rol.pairs.PairSettings` -> scans to measure, rows of `rol.pairs.align_scans`.
    settings : mapping of str to PairSettings
        Settings to compare, by name.
    band_edges_m : array, shape (k + 1,)
        Edges of range bands, increasing [m].
    max_shift_px : int
        Largest shift looked for in each direction [pixels].

    Returns
    -------
    shifts : DataFrame
        One row per setting and scan: ``option``, ``speed_mps``, ``drow``, ``dcol`` and ``shift_px``, the
        length of the shift; nan where no shift is found.
    radial_m : dict of array, shape (k,)
        Per motion-compensated setting the shift of the radar outwards in each range band [m].
    """
    rows, radial_m = [], {}
    for name, setting in settings.items():
        table = 0.0
        for _, line in alignments[setting.motion].iterrows():
            pair = build_pair(session, AlignedScan.from_row(line), setting)
            drow, dcol = measure_misalignment(*pair, max_shift_px=max_shift_px)
            rows.append((name, np.hypot(line.vx_mps, line.vy_mps), drow, dcol, np.hypot(drow, dcol)))
            if setting.motion == "corrected":
                shifts_m, sums = correlate_ranges(*pair, band_edges_m)
                table = table + sums
        if setting.motion == "corrected":
            radial_m[name] = best_shifts(shifts_m, table)
    return pd.DataFrame(rows, columns=["option", "speed_mps", "drow", "dcol", "shift_px"]), radial_m


def _vertex(three: np.ndarray) -> float:
    """Compute the vertex of the parabola through values at -1, 0, 1."""
    left, middle, right = (float(v) for v in three)
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def _sharpen(radar_image: np.ndarray, blind_px: float) -> np.ndarray:
    """Subtract the mean of 8 m around each pixel, so that streaks and fall-off do not count."""
    image = np.asarray(radar_image, dtype=np.float32)
    return _ring(image - cv2.blur(image, (33, 33), borderType=cv2.BORDER_REFLECT), blind_px)


def _soften(lidar_image: np.ndarray, blind_px: float) -> np.ndarray:
    """Blur occupied pixels by one pixel, so that the correlation has a smooth top."""
    image = (np.asarray(lidar_image) > 0).astype(np.float32)
    return _ring(cv2.GaussianBlur(image, (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT), blind_px)


def _ring(image: np.ndarray, blind_px: float) -> np.ndarray:
    """Set the pixels around the sensor to zero."""
    axis = np.arange(image.shape[0], dtype=np.float32) - (image.shape[0] - 1) / 2.0
    return np.where(np.hypot(axis[:, None], axis[None, :]) < blind_px, np.float32(0.0), image)
