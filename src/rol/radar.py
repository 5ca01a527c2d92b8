"""The radar room: polar scan to Cartesian image, peaks to points, motion and Doppler correction.

A scan is an array of half-dB power codes, one row per azimuth, one column per range bin. Azimuths are in our
convention, counter-clockwise positive; the radar turns clockwise, so they decrease from row to row. Bin ``b``
lies at the range ``(b + 0.5) * range_resolution + range_offset``. In an image row 0 is farthest forward (x)
and column 0 farthest left (y); coordinates are those of pixel centres: ``x = ((width - 1) / 2 - row) *
pixel_size`` and y alike with the column.
"""

from __future__ import annotations

import cv2
import numpy as np

try:
    from .geometry import exp
except ImportError:  # this file was copied on its own
    from geometry import exp

# The data set's own kit: 0.0432 m per bin. Three independent measurements on real scans agree on the second
# pair.
KIT_RANGE_RESOLUTION, KIT_RANGE_OFFSET = 0.0432, 0.0
MEASURED_RANGE_RESOLUTION, MEASURED_RANGE_OFFSET = 0.0438, -0.31
DOPPLER_SECONDS = 0.049  # a target ahead reads nearer by this time multiplied by the closing speed
SCAN_SECONDS = 0.25  # one turn
MAX_GAP = 2.5  # rows farther apart than this many mean steps: nothing was measured between them
TABLE_STEPS = 64  # entries per row of the table for unevenly spaced azimuths
_CODE_POWER = 10.0 ** (np.arange(256) / 20.0)  # a code is half a decibel


def polar_to_cartesian(
    codes: np.ndarray,
    azimuths: np.ndarray,
    *,
    range_resolution: float = KIT_RANGE_RESOLUTION,
    range_offset: float = KIT_RANGE_OFFSET,
    pixel_size: float = 0.25,
    width: int = 512,
    interpolate_crossover: bool = True,
    twist: np.ndarray | tuple[float, float, float] | None = None,
    scan_seconds: float = SCAN_SECONDS,
    doppler_seconds: float = 0.0,
) -> np.ndarray:
    """Resample a polar scan into a Cartesian image around the radar.

    Without a twist this is the convention of the data set's own kit, bilinear in range and azimuth. With a
    twist every pixel is taken from where the turning beam saw that place, so the image shows the world in the
    radar frame at mid-scan.

    Parameters
    ----------
    codes : array, shape (a, b)
        Power codes 0..255, one row per azimuth.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows, decreasing, not wrapped [rad]. A pixel is interpolated between
        the two rows next to its bearing; in gaps wider than ``MAX_GAP`` mean steps the image is 0.
    range_resolution, range_offset : float
        Length of a bin and shift of all ranges [m].
    pixel_size : float
        Edge of a pixel [m].
    width : int
        Number of rows and of columns of the image.
    interpolate_crossover : bool
        Wrap one row at each end, so that the seam between last and first row is interpolated as well.
    twist : array-like, shape (3,), optional
        Constant body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s]; None for no correction.
    scan_seconds : float
        Time of one turn, spread evenly over the rows [s]; used with a twist.
    doppler_seconds : float
        Ranges read nearer by this time multiplied by the closing speed [s]; used with a twist.

    Returns
    -------
    image : array, shape (width, width), float32
        Power in [0, 1]; 0 beyond the last bin.

    Raises
    ------
    ValueError
        If shapes disagree, the codes are no power codes, or the azimuths do not decrease within one turn.

    Notes
    -----
    Input of the generator in Yin et al. 2020, Sec. III-A; 512 pixels of 0.25 m: Sec. IV-A.
    """
    codes, azimuths = check_scan(codes, azimuths)
    half = (width - 1) / 2.0 * pixel_size
    axis = np.linspace(half, -half, width, dtype=np.float32)
    x, y = np.repeat(axis[:, None], width, axis=1), np.repeat(axis[None, :], width, axis=0)
    first, step = np.mod(-azimuths[0], 2.0 * np.pi), (azimuths[0] - azimuths[-1]) / (len(azimuths) - 1)
    n_turn = 2.0 * np.pi / step  # rows of an evenly spaced scan; `rows` counts those up to the last lines
    clockwise = np.arctan2(-y, x)
    np.add(clockwise, np.float32(2.0 * np.pi), out=clockwise, where=clockwise < 0.0)
    rows = (clockwise - np.float32(first)) / np.float32(step)
    np.add(rows, np.float32(n_turn), out=rows, where=rows < -1.0)  # scans that do not begin ahead
    if twist is None:
        ranges = np.sqrt(x * x + y * y)
    else:
        ranges, rows = _beam_at_places(x, y, rows, len(codes), step, twist, scan_seconds, doppler_seconds)
    table = _row_table(azimuths, step)
    if table is not None:
        rows = table.take(((rows + np.float32(1.0)) * np.float32(TABLE_STEPS)).astype(np.intp), mode="clip")
    bins = np.maximum((ranges - range_offset - range_resolution / 2.0) / range_resolution, 0.0).astype(
        np.float32
    )
    used = codes[:, : int(bins.max()) + 2].astype(np.float32) * np.float32(1.0 / 255.0)
    if interpolate_crossover:
        used = np.concatenate([used[-1:], used, used[:1]])
        rows = rows + np.float32(1.0)
    return cv2.remap(used, bins, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)


def undistort_points(
    points: np.ndarray, stamps_s: np.ndarray, twist: np.ndarray | tuple[float, float, float]
) -> np.ndarray:
    """Move points seen at different times into the sensor frame at the reference time.

    Parameters
    ----------
    points : array, shape (n, 2) or (n, 3)
        Each point in the frame at its own time [m]; z stays as it is.
    stamps_s : array, shape (n,)
        Times relative to the reference time [s].
    twist : array-like, shape (3,)
        Constant body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].

    Returns
    -------
    points : array, same shape
        The points in the frame at the reference time [m].
    """
    points = np.asarray(points, dtype=np.float64)
    poses = exp(twist, stamps_s)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    moved = points.copy()
    moved[:, 0] = c * points[:, 0] - s * points[:, 1] + poses[:, 0]
    moved[:, 1] = s * points[:, 0] + c * points[:, 1] + poses[:, 1]
    return moved


def doppler_shift(
    azimuths: np.ndarray, velocity: np.ndarray | tuple[float, ...], doppler_seconds: float = DOPPLER_SECONDS
) -> np.ndarray:
    """Give by how much a resting target reads too far because the radar moves.

    Parameters
    ----------
    azimuths : array, shape (n,)
        Counter-clockwise bearings of the targets [rad].
    velocity : array-like, shape (2,) or more
        Velocity of the radar (vx, vy, ...), a twist will do [m/s].
    doppler_seconds : float
        Range error per closing speed [s].

    Returns
    -------
    shift : array, shape (n,)
        Range read minus true range; negative ahead of a radar that drives forward [m].
    """
    return -doppler_seconds * (velocity[0] * np.cos(azimuths) + velocity[1] * np.sin(azimuths))


def row_seconds(n_rows: int, scan_seconds: float = SCAN_SECONDS) -> np.ndarray:
    """Give the time of every row relative to mid-scan.

    The stamps inside a file come in bursts of 16, so evenly spread times are the better guess.

    Parameters
    ----------
    n_rows : int
        Rows of the scan.
    scan_seconds : float
        Time of one turn [s].

    Returns
    -------
    seconds : array, shape (n_rows,)
        Times from ``-scan_seconds / 2`` on [s].
    """
    return (np.arange(n_rows) / n_rows - 0.5) * scan_seconds


def compensate_points(
    points: np.ndarray,
    twist: np.ndarray | tuple[float, float, float],
    *,
    scan_seconds: float = SCAN_SECONDS,
    doppler_seconds: float = DOPPLER_SECONDS,
) -> np.ndarray:
    """Move points found in a scan as recorded to where they are at mid-scan.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame, each as it was seen when the beam passed it [m].
    twist : array-like, shape (3,)
        Constant body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    scan_seconds, doppler_seconds : float
        As in `polar_to_cartesian` [s].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame at mid-scan, without motion and Doppler shift [m].

    Notes
    -----
    A turn begins straight ahead and goes clockwise. Oxford's scans begin 0.8 deg later, which is 0.6 ms.
    """
    points = np.asarray(points, dtype=np.float64)
    bearings, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    ranges = ranges - doppler_shift(bearings, twist, doppler_seconds)
    seconds = (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * scan_seconds
    seen = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=1)
    return undistort_points(seen, seconds, twist)


def find_peaks(
    codes: np.ndarray, k: int = 12, min_code: int = 60, min_bin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Find the k strongest local maxima along range in every row.

    Parameters
    ----------
    codes : array, shape (a, b)
        Power codes.
    k : int
        Peaks kept per row at most.
    min_code : int
        Weakest code kept.
    min_bin : int
        Nearest bin kept.

    Returns
    -------
    rows, bins : array, shape (n,)
        Indices of the peaks, by row, the strongest of a row first; equal codes nearest first.

    Raises
    ------
    ValueError
        If the codes are not uint8.
    """
    codes = _check_codes(codes)
    is_peak = codes >= max(min_code, 1)
    is_peak[:, 1:] &= codes[:, 1:] > codes[:, :-1]  # of a plateau the first bin counts
    is_peak[:, :-1] &= codes[:, :-1] >= codes[:, 1:]
    is_peak[:, :min_bin] = False
    rows, bins = np.nonzero(is_peak)
    order = np.lexsort((bins, -codes[rows, bins].astype(np.int64), rows))
    rows, bins = rows[order], bins[order]
    rank = np.arange(len(rows)) - np.searchsorted(rows, rows)
    return rows[rank < k], bins[rank < k]


def cfar_peaks(
    codes: np.ndarray,
    *,
    guard_bins: int = 12,
    train_bins: int = 40,
    threshold_db: float = 12.0,
    min_bin: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Find local maxima along range that stand out from what surrounds them (cell-averaging CFAR).

    Parameters
    ----------
    codes : array, shape (a, b)
        Power codes in half decibels.
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
        If the codes are not uint8, a width is not positive or a row is too short for the window.

    Notes
    -----
    Cells at the ends of a row take the floor from the side they have. The floor is a mean of powers, not of
    decibels, as in the classical detector.
    """
    codes, reach = _check_codes(codes), guard_bins + train_bins
    if guard_bins < 0 or train_bins < 1 or codes.shape[1] <= 2 * reach:
        raise ValueError(
            f"CFAR: guard {guard_bins} and train {train_bins} bins do not fit codes {codes.shape}"
        )
    sums = np.cumsum(_CODE_POWER[codes], axis=1, dtype=np.float64)
    sums = np.concatenate([np.zeros((len(codes), 1)), sums], axis=1)
    edges = np.clip(
        np.arange(codes.shape[1])[:, None] + (-reach, -guard_bins, guard_bins + 1, reach + 1),
        0,
        codes.shape[1],
    )
    n_cells = (edges[:, 1] - edges[:, 0]) + (edges[:, 3] - edges[:, 2])
    floor = (
        sums[:, edges[:, 1]] - sums[:, edges[:, 0]] + sums[:, edges[:, 3]] - sums[:, edges[:, 2]]
    ) / n_cells
    found = _CODE_POWER[codes] > floor * 10.0 ** (threshold_db / 10.0)
    found[:, 1:] &= codes[:, 1:] > codes[:, :-1]  # of a plateau the first bin counts
    found[:, :-1] &= codes[:, :-1] >= codes[:, 1:]
    found[:, :min_bin] = False
    rows, bins = np.nonzero(found)
    return rows, bins


def peaks_to_points(
    rows: np.ndarray,
    bins: np.ndarray,
    azimuths: np.ndarray,
    *,
    max_range_m: float = np.inf,
    range_resolution: float = KIT_RANGE_RESOLUTION,
    range_offset: float = KIT_RANGE_OFFSET,
    twist: np.ndarray | tuple[float, float, float] | None = None,
    scan_seconds: float = SCAN_SECONDS,
    doppler_seconds: float = 0.0,
) -> np.ndarray:
    """Turn peaks of a polar scan into points.

    Parameters
    ----------
    rows, bins : array, shape (n,)
        Indices of the peaks.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of all rows [rad].
    max_range_m : float
        Points farther away are dropped [m].
    range_resolution, range_offset : float
        Length of a bin and shift of all ranges [m].
    twist : array-like, shape (3,), optional
        Body velocity; with it the points are moved to mid-scan [m/s, m/s, rad/s].
    scan_seconds, doppler_seconds : float
        As in `polar_to_cartesian`; used with a twist [s].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m].

    Raises
    ------
    ValueError
        If the azimuths do not decrease within one turn.
    """
    azimuths = _check_azimuths(azimuths)
    ranges, bearings = (bins + 0.5) * range_resolution + range_offset, azimuths[rows]
    if twist is not None:
        ranges = ranges - doppler_shift(bearings, twist, doppler_seconds)
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=1)[ranges <= max_range_m]
    if twist is None:
        return points
    return undistort_points(
        points, row_seconds(len(azimuths), scan_seconds)[rows[ranges <= max_range_m]], twist
    )


def k_strongest_peaks(
    codes: np.ndarray,
    azimuths: np.ndarray,
    k: int = 12,
    min_code: int = 60,
    min_range_m: float = 2.5,
    *,
    max_range_m: float = np.inf,
    range_resolution: float = KIT_RANGE_RESOLUTION,
    range_offset: float = KIT_RANGE_OFFSET,
    twist: np.ndarray | tuple[float, float, float] | None = None,
    scan_seconds: float = SCAN_SECONDS,
    doppler_seconds: float = 0.0,
) -> np.ndarray:
    """Turn a scan into points without a network: the k strongest peaks of every azimuth.

    Parameters
    ----------
    codes : array, shape (a, b)
        Power codes.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows [rad].
    k, min_code : int
        Peaks per row at most, and the weakest code kept (60 is 30 dB).
    min_range_m, max_range_m : float
        Points nearer or farther are dropped; the leakage ends about 2.5 m [m].
    range_resolution, range_offset : float
        Length of a bin and shift of all ranges [m].
    twist : array-like, shape (3,), optional
        Body velocity; with it the points are moved to mid-scan [m/s, m/s, rad/s].
    scan_seconds, doppler_seconds : float
        As in `polar_to_cartesian`; used with a twist [s].

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m].

    Raises
    ------
    ValueError
        If `check_scan` refuses the scan.
    """
    codes, azimuths = check_scan(codes, azimuths)
    min_bin = int(np.ceil((min_range_m - range_offset) / range_resolution - 0.5))
    rows, bins = find_peaks(codes, k, min_code, max(min_bin, 0))
    return peaks_to_points(
        rows, bins, azimuths, max_range_m=max_range_m, range_resolution=range_resolution, range_offset=range_offset,
        twist=twist, scan_seconds=scan_seconds, doppler_seconds=doppler_seconds,
    )  # fmt: skip


def check_scan(codes: np.ndarray, azimuths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Refuse a scan that is transposed, turns the wrong way round, or does not hold power codes.

    Parameters
    ----------
    codes : array, shape (a, b), uint8
        Power codes, one row per azimuth.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows, decreasing by less than one turn in all [rad].

    Returns
    -------
    codes, azimuths : array
        The same as arrays, azimuths as float64.

    Raises
    ------
    ValueError
        If shapes disagree, the codes are not uint8, or the azimuths do not decrease within one turn.
    """
    codes, azimuths = np.asarray(codes), np.asarray(azimuths, dtype=np.float64)
    if codes.ndim != 2 or azimuths.shape != codes.shape[:1] or len(codes) < 2:
        is_turned = codes.ndim == 2 and azimuths.shape == codes.shape[1:]
        hint = "; the codes are transposed" if is_turned else ""
        raise ValueError(
            f"scan: expected codes (a, b) and azimuths (a,), got {codes.shape} and {azimuths.shape}{hint}"
        )
    return _check_codes(codes), _check_azimuths(azimuths)


def _check_codes(codes: np.ndarray) -> np.ndarray:
    """Refuse arrays that hold no power codes, such as power in 0..1."""
    codes = np.asarray(codes)
    if codes.ndim != 2 or codes.dtype != np.uint8:
        raise ValueError(
            f"scan: expected power codes 0..255 of shape (a, b) as uint8, got {codes.dtype} {codes.shape}"
        )
    return codes


def _check_azimuths(azimuths: np.ndarray) -> np.ndarray:
    """Refuse azimuths that rise, such as clockwise ones, or go on beyond one turn."""
    azimuths = np.asarray(azimuths, dtype=np.float64)
    steps = np.diff(azimuths)
    if not (steps < 0.0).all():
        row = int(np.argmin(steps < 0.0)) + 1
        raise ValueError(f"scan: azimuths must decrease (counter-clockwise positive), row {row} does not")
    if not azimuths[0] - azimuths[-1] < 2.0 * np.pi:
        turned = np.rad2deg(azimuths[0] - azimuths[-1])
        raise ValueError(f"scan: azimuths must lie within one turn, they decrease by {turned:.1f} deg")
    return azimuths


def _row_table(azimuths: np.ndarray, step: float) -> np.ndarray | None:
    """Tabulate the row of unevenly spaced azimuths at the rows of evenly spaced ones; None if all are even.

    Entry i belongs to row ``(i + 0.5) / TABLE_STEPS - 1`` of a scan with the same first azimuth and the mean step.
    The nearest entry is off by at most half an entry, 1/128 of a row.
    """
    n, n_turn = len(azimuths), 2.0 * np.pi / step
    own = np.concatenate([azimuths[-1:] + 2.0 * np.pi, azimuths, azimuths[:1] - 2.0 * np.pi])
    own = (azimuths[0] - own) / step
    gaps, numbers = np.diff(own), np.arange(-1.0, n + 1.0)
    if np.abs(own - numbers).max() < 1e-3:
        return None
    even = (np.arange(int((n_turn + 1.0) * TABLE_STEPS) + 1) + 0.5) / TABLE_STEPS - 1.0
    even = np.where(even < own[0], even + n_turn, even)
    gap = np.clip(np.searchsorted(own, even, side="right") - 1, 0, n)
    rows = np.interp(even, own, numbers)
    return np.where(gaps[gap] > MAX_GAP, -2.0, rows).astype(np.float32)  # -2: no row, so no power


def _beam_at_places(
    x: np.ndarray,
    y: np.ndarray,
    rows: np.ndarray,
    n_rows: int,
    step: float,
    twist: np.ndarray | tuple[float, float, float],
    scan_seconds: float,
    doppler_seconds: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Find range and row at which the moving radar saw places given in the frame at mid-scan.

    The row tells the time, the time the pose, the pose the row: three rounds of this settle, since the beam
    turns much faster than places move across it.
    """
    vx, vy, yaw_rate = (np.float32(v) for v in twist)
    first_rows = rows
    for _ in range(3):
        t = (rows / np.float32(n_rows) - np.float32(0.5)) * np.float32(scan_seconds)
        yaw = yaw_rate * t
        c, s, half = np.cos(yaw), np.sin(yaw), np.float32(0.5) * yaw
        # Within one turn yaw stays small, so the chord stands for the arc (below 1 mm for a car).
        dx, dy = x - t * (vx - vy * half), y - t * (vx * half + vy)
        seen_x, seen_y = c * dx + s * dy, c * dy - s * dx
        # The bearing's change is small except next to the radar, so no wrap can make the row jump.
        turned = cv2.phase(x * seen_x + y * seen_y, x * seen_y - y * seen_x)
        turned = np.where(turned > np.pi, turned - np.float32(2.0 * np.pi), turned)
        rows = first_rows - turned / np.float32(step)
    ranges = np.sqrt(seen_x * seen_x + seen_y * seen_y)
    closing = (vx * seen_x + vy * seen_y) / np.maximum(ranges, np.float32(1e-6))
    return ranges - np.float32(doppler_seconds) * closing, np.mod(rows, np.float32(2.0 * np.pi / step))
