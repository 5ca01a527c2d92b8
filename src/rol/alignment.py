"""The alignment room: which sweeps go with which scan, and how far the two images of a pair are apart.

Both images have the sensor in the middle, row 0 farthest forward, column 0 farthest left. A shift tells where
the radar shows what the lidar shows: positive rows lie behind, positive columns to the right, positive ranges
farther out.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np


def usable_stamps(session: Any, sensor: str) -> np.ndarray:
    """List the frames of a sensor that can be read: listed, not flagged 0, and with a file.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.
    sensor : str
        "radar", "velodyne_left" or "velodyne_right".

    Returns
    -------
    stamps_us : array, shape (n,), int64
        Their stamps [us].

    Raises
    ------
    ValueError
        If there is no such frame; the message names the folder.
    """
    listed = {
        "radar": session.radar_stamps_us,
        "velodyne_left": session.left_stamps_us,
        "velodyne_right": session.right_stamps_us,
    }[sensor]
    folder = session.root / sensor
    there = {p.stem for p in folder.iterdir() if p.suffix in (".png", ".bin")} if folder.is_dir() else set()
    kept = [stamp for stamp in (() if listed is None else listed.tolist()) if str(stamp) in there]
    if not kept:
        raise ValueError(f"{folder}: no usable frame of {sensor}; a pair needs the radar and a lidar")
    return np.array(kept, dtype=np.int64)


def usable_sweeps(session: Any) -> dict[str, np.ndarray]:
    """List the usable sweeps of the lidars that a session has.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.

    Returns
    -------
    sweeps_us : dict of array, int64
        "left", "right" or both -> stamps of the sweeps [us], as of `usable_stamps`.

    Raises
    ------
    ValueError
        If neither lidar has a usable sweep; the message names the folders.
    """
    found, faults = {}, []
    for side in ("left", "right"):
        try:
            found[side] = usable_stamps(session, f"velodyne_{side}")
        except ValueError as error:
            faults.append(str(error))
    if not found:
        raise ValueError("; ".join(faults))
    return found


def align_scans(
    radar_us: np.ndarray,
    mid_us: np.ndarray,
    twists: np.ndarray,
    sweeps_us: dict[str, np.ndarray],
    *,
    motion: str = "none",
    max_gap_us: int = 50_000,
) -> dict[str, np.ndarray]:
    """Find the sweeps of every scan; scans that lack the sweep of a lidar are left out.

    Parameters
    ----------
    radar_us, mid_us : array, shape (n,)
        Stamps of the scans and their times at mid-scan [us].
    twists : array, shape (n, 3)
        Body velocities [m/s, m/s, rad/s].
    sweeps_us : dict of array
        Stamps of the sweeps [us] by lidar, "left", "right" or both, as from `usable_sweeps`.
    motion : str
        "none" takes the sweeps nearest to the scan's stamp, "corrected" those nearest to mid-scan.
    max_gap_us : int
        Largest gap allowed [us].

    Returns
    -------
    columns : dict of arrays, shape (p,)
        The columns of ``alignment.csv``; stamps [us], gaps (sweep minus scan) [ms], velocities [m/s, rad/s].
        A lidar that the session does not have has no columns.

    Raises
    ------
    ValueError
        If no lidar or an unknown one is given, or no scan has its sweeps within `max_gap_us`; the message gives
        the smallest gap of each lidar.

    Notes
    -----
    Yin et al. 2020, Sec. III-A, is "none".
    """
    from .pairs import associate_nearest

    if motion not in ("none", "corrected"):
        raise ValueError(f"motion must be 'none' or 'corrected', not {motion!r}")
    if not sweeps_us or not sweeps_us.keys() <= {"left", "right"}:
        raise ValueError(f"sweeps_us must have the keys 'left', 'right' or both, not {list(sweeps_us)}")
    reference = radar_us if motion == "none" else mid_us
    matches = {side: associate_nearest(reference, us, max_gap_us) for side, us in sweeps_us.items()}
    kept = np.all([index >= 0 for index, _ in matches.values()], axis=0)
    if not kept.any():
        least = ", ".join(
            f"{side} {(np.abs(gap) / 1e3).min(initial=np.inf):g} ms" for side, (_, gap) in matches.items()
        )
        place = "its stamp" if motion == "none" else "mid-scan"
        raise ValueError(
            f"motion {motion!r}: no scan has its sweeps within {max_gap_us / 1000:g} ms of {place};"
            f" the smallest gaps are {least}"
        )
    columns = {"radar_stamp_us": radar_us[kept], "mid_stamp_us": mid_us[kept]}
    for side, (index, _) in matches.items():
        columns[f"{side}_stamp_us"] = sweeps_us[side][index[kept]]
    for side, (_, gap_us) in matches.items():
        columns[f"{side}_gap_ms"] = gap_us[kept] / 1000.0
    for i, name in enumerate(("vx_mps", "vy_mps", "yaw_rate_radps")):
        columns[name] = twists[kept, i]
    return columns


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

    The radar's slow brightness is taken off and the lidar's pixels are blurred a little, so that edges
    decide.

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
    """Read the best shift off every row of a correlation table.

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


def _vertex(three: np.ndarray) -> float:
    """Place of a parabola's vertex through values at -1, 0, 1."""
    left, middle, right = (float(v) for v in three)
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def _sharpen(radar_image: np.ndarray, blind_px: float) -> np.ndarray:
    """Take the mean of 8 m around off each pixel, so that streaks and fall-off do not count."""
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
