"""Convert polar radar scans: to a Cartesian image, to peaks and points, with motion compensation.

A scan is an array of power in steps of half a decibel, one row per azimuth, one column per range bin.
Azimuths are counter-clockwise positive; the radar turns clockwise, so they decrease from row to row. In an
image row 0 is farthest forward (x) and column 0 farthest left (y); coordinates are those of pixel centres:
``x = ((width - 1) / 2 - row) * pixel_size``, and y alike with the column.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

if __package__:
    from .geometry import check_fields, check_pose, exp
else:  # this file was copied and is imported by its own name
    from geometry import check_fields, check_pose, exp

DOPPLER_SECONDS = 0.049  # a target ahead reads nearer by this time multiplied by the closing speed
SCAN_SECONDS = 0.25  # one turn
MAX_GAP = 2.5  # in wider gaps between rows, in mean row spacings, nothing was measured
TABLE_STEPS = 64  # entries per row of the table for unevenly spaced azimuths


@dataclass(frozen=True)
class RangeCalibration:
    """Range of the bins of a scan: ``(bin + 0.5) * resolution_m + offset_m``.

    Attributes
    ----------
    resolution_m, offset_m : float
        Length of a bin, and offset of all ranges [m].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    resolution_m: float
    offset_m: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, {"(0, inf)": "resolution_m", "(-inf, inf)": "offset_m"})


SDK = RangeCalibration(0.0432)  # of the data set's SDK
MEASURED = RangeCalibration(0.0438, -0.31)  # of three independent measurements on real scans


@dataclass(frozen=True, eq=False)
class ScanMotion:
    """Motion of the radar during a scan.

    Attributes
    ----------
    twist : array-like, shape (3,)
        Constant body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    scan_seconds : float
        Time of one turn, spread evenly over the rows [s].
    doppler_seconds : float
        Ranges read nearer by this time multiplied by the closing speed [s].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    twist: np.ndarray | tuple[float, float, float]
    scan_seconds: float = SCAN_SECONDS
    doppler_seconds: float = DOPPLER_SECONDS

    def __post_init__(self) -> None:
        check_fields(self, {"(0, inf)": "scan_seconds", "(-inf, inf)": "doppler_seconds"})
        check_pose(self.twist, "twist")


def polar_to_cartesian(
    power: np.ndarray,
    azimuths: np.ndarray,
    *,
    calibration: RangeCalibration = SDK,
    pixel_size: float = 0.25,
    width: int = 512,
    motion: ScanMotion | None = None,
) -> np.ndarray:
    """Resample a polar scan into a Cartesian image around the radar.

    Without motion this is the convention of the data set's SDK, bilinear in range and azimuth. With motion
    every pixel is taken from where the turning beam saw that place, so the image shows the world in the radar
    frame at mid-scan.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps, one row per azimuth.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows, decreasing, not wrapped [rad]. A pixel is interpolated between
        the two rows next to its bearing; in gaps wider than ``MAX_GAP`` mean steps the image is 0.
    calibration : RangeCalibration
        Range of the bins.
    pixel_size : float
        Edge of a pixel [m].
    width : int
        Number of rows and of columns of the image.
    motion : ScanMotion, optional
        Motion to compensate; None for none.

    Returns
    -------
    image : array, shape (width, width), float32
        Power in [0, 1]; 0 beyond the last bin.

    Raises
    ------
    ValueError
        If shapes disagree, the power is not uint8, or the azimuths do not decrease within one turn.

    Notes
    -----
    Input of the generator in Yin et al. 2020, Sec. III-A; 512 pixels of 0.25 m: Sec. IV-A.
    """
    power, azimuths = check_scan(power, azimuths)
    half = (width - 1) / 2.0 * pixel_size
    axis = np.linspace(half, -half, width, dtype=np.float32)
    x, y = np.repeat(axis[:, None], width, axis=1), np.repeat(axis[None, :], width, axis=0)
    first, step = np.mod(-azimuths[0], 2.0 * np.pi), (azimuths[0] - azimuths[-1]) / (len(azimuths) - 1)
    n_turn = 2.0 * np.pi / step  # rows of an evenly spaced scan; `rows` counts those up to the last lines
    clockwise = np.arctan2(-y, x)
    np.add(clockwise, np.float32(2.0 * np.pi), out=clockwise, where=clockwise < 0.0)
    rows = (clockwise - np.float32(first)) / np.float32(step)
    np.add(rows, np.float32(n_turn), out=rows, where=rows < -1.0)  # scans that do not begin ahead
    if motion is None:
        ranges = np.sqrt(x * x + y * y)
    else:
        ranges, rows = _beam_at_places(x, y, rows, len(power), step, motion)
    table = _row_table(azimuths, step)
    if table is not None:
        rows = table.take(((rows + np.float32(1.0)) * np.float32(TABLE_STEPS)).astype(np.intp), mode="clip")
    near, length = calibration.offset_m, calibration.resolution_m
    bins = np.maximum((ranges - near - length / 2.0) / length, 0.0).astype(np.float32)
    used = power[:, : int(bins.max()) + 2].astype(np.float32) * np.float32(1.0 / 255.0)
    # One row more at each end, so that the seam between last and first row is interpolated as well.
    used, rows = np.concatenate([used[-1:], used, used[:1]]), rows + np.float32(1.0)
    return cv2.remap(used, bins, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)


def deskew_points(
    points: np.ndarray, seconds: np.ndarray, twist: np.ndarray | tuple[float, float, float]
) -> np.ndarray:
    """Move points seen at different times into the sensor frame at the reference time.

    Parameters
    ----------
    points : array, shape (n, 2) or (n, 3)
        Each point in the frame at its own time [m]; z stays as it is.
    seconds : array, shape (n,)
        Times relative to the reference time [s].
    twist : array-like, shape (3,)
        Constant body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].

    Returns
    -------
    points : array, same shape
        The points in the frame at the reference time [m].
    """
    points = np.asarray(points, dtype=np.float64)
    poses = exp(check_pose(twist, "twist"), seconds)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    moved = points.copy()
    moved[:, 0] = c * points[:, 0] - s * points[:, 1] + poses[:, 0]
    moved[:, 1] = s * points[:, 0] + c * points[:, 1] + poses[:, 1]
    return moved


def doppler_shift(
    azimuths: np.ndarray, velocity: np.ndarray | tuple[float, ...], doppler_seconds: float = DOPPLER_SECONDS
) -> np.ndarray:
    """Compute the range error of a stationary target due to the radar's velocity.

    Parameters
    ----------
    azimuths : array, shape (n,)
        Counter-clockwise bearings of the targets [rad].
    velocity : array-like, shape (2,) or more
        Velocity of the radar (vx, vy, ...), such as a twist [m/s].
    doppler_seconds : float
        Range error per closing speed [s].

    Returns
    -------
    shift : array, shape (n,)
        Range read minus true range; negative ahead of a radar that moves forward [m].
    """
    return -doppler_seconds * (velocity[0] * np.cos(azimuths) + velocity[1] * np.sin(azimuths))


def azimuth_times(n_rows: int, scan_seconds: float = SCAN_SECONDS) -> np.ndarray:
    """Compute the time of every row relative to mid-scan.

    The stamps inside a file come in bursts of 16, so evenly spread times are more accurate.

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


def compensate_points(points: np.ndarray, motion: ScanMotion) -> np.ndarray:
    """Compensate the motion of points found in a scan as recorded.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame, each as it was seen when the beam passed it [m].
    motion : ScanMotion
        Motion to compensate.

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
    ranges = ranges - doppler_shift(bearings, motion.twist, motion.doppler_seconds)
    seconds = (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * motion.scan_seconds
    seen = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=1)
    return deskew_points(seen, seconds, motion.twist)


def find_peaks(
    power: np.ndarray, k: int = 12, min_power: int = 60, min_bin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Find the k strongest local maxima along range in every row.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps.
    k : int
        Largest number of peaks per row.
    min_power : int
        Lowest power of a peak (60 is 30 dB).
    min_bin : int
        Nearest bin kept.

    Returns
    -------
    rows, bins : array, shape (n,)
        Indices of the peaks, by row, the strongest of a row first; equal ones nearest first.

    Raises
    ------
    ValueError
        If the power is not uint8.
    """
    power = check_power(power)
    is_peak = power >= max(min_power, 1)
    is_peak[:, 1:] &= power[:, 1:] > power[:, :-1]  # of a plateau the first bin counts
    is_peak[:, :-1] &= power[:, :-1] >= power[:, 1:]
    is_peak[:, :min_bin] = False
    rows, bins = np.nonzero(is_peak)
    order = np.lexsort((bins, -power[rows, bins].astype(np.int64), rows))
    rows, bins = rows[order], bins[order]
    rank = np.arange(len(rows)) - np.searchsorted(rows, rows)
    return rows[rank < k], bins[rank < k]


def peaks_to_points(
    rows: np.ndarray,
    bins: np.ndarray,
    azimuths: np.ndarray,
    *,
    max_range_m: float = np.inf,
    calibration: RangeCalibration = SDK,
    motion: ScanMotion | None = None,
) -> np.ndarray:
    """Convert peaks of a polar scan into points.

    Parameters
    ----------
    rows, bins : array, shape (n,)
        Indices of the peaks.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of all rows [rad].
    max_range_m : float
        Points farther away are dropped [m].
    calibration : RangeCalibration
        Range of the bins.
    motion : ScanMotion, optional
        Motion to compensate; None for none.

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m], at mid-scan if motion is compensated.

    Raises
    ------
    ValueError
        If the azimuths do not decrease within one turn.
    """
    azimuths = _check_azimuths(azimuths)
    ranges, bearings = (bins + 0.5) * calibration.resolution_m + calibration.offset_m, azimuths[rows]
    if motion is not None:
        ranges = ranges - doppler_shift(bearings, motion.twist, motion.doppler_seconds)
    is_near = ranges <= max_range_m
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=1)[is_near]
    if motion is None:
        return points
    seconds = azimuth_times(len(azimuths), motion.scan_seconds)[rows[is_near]]
    return deskew_points(points, seconds, motion.twist)


def k_strongest_peaks(
    power: np.ndarray,
    azimuths: np.ndarray,
    k: int = 12,
    min_power: int = 60,
    *,
    range_limits_m: tuple[float, float] = (2.5, np.inf),
    calibration: RangeCalibration = SDK,
    motion: ScanMotion | None = None,
) -> np.ndarray:
    """Convert a scan into points without a network: the k strongest peaks of every azimuth.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows [rad].
    k, min_power : int
        As in `find_peaks`.
    range_limits_m : tuple of float
        Points nearer or farther are dropped; the leakage ends at about 2.5 m [m].
    calibration : RangeCalibration
        Range of the bins.
    motion : ScanMotion, optional
        Motion to compensate; None for none.

    Returns
    -------
    points : array, shape (n, 2)
        Points in the radar frame [m], at mid-scan if motion is compensated.

    Raises
    ------
    ValueError
        If `check_scan` refuses the scan.
    """
    power, azimuths = check_scan(power, azimuths)
    nearest, farthest = range_limits_m
    min_bin = int(np.ceil((nearest - calibration.offset_m) / calibration.resolution_m - 0.5))
    rows, bins = find_peaks(power, k, min_power, max(min_bin, 0))
    return peaks_to_points(rows, bins, azimuths, max_range_m=farthest, calibration=calibration, motion=motion)


def check_scan(power: np.ndarray, azimuths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check a scan: not transposed, turning the right way round, and holding power as uint8.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps, one row per azimuth.
    azimuths : array, shape (a,)
        Counter-clockwise bearings of the rows, decreasing by less than one turn in all [rad].

    Returns
    -------
    power, azimuths : array
        The same as arrays, azimuths as float64.

    Raises
    ------
    ValueError
        If shapes disagree, the power is not uint8, or the azimuths do not decrease within one turn.
    """
    power, azimuths = np.asarray(power), np.asarray(azimuths, dtype=np.float64)
    if power.ndim != 2 or azimuths.shape != power.shape[:1] or len(power) < 2:
        is_turned = power.ndim == 2 and azimuths.shape == power.shape[1:]
        hint = "; the power is transposed" if is_turned else ""
        shapes = f"{power.shape} and {azimuths.shape}"
        raise ValueError(f"scan: expected power (a, b) and azimuths (a,), got {shapes}{hint}")
    return check_power(power), _check_azimuths(azimuths)


def check_power(power: np.ndarray) -> np.ndarray:
    """Check that an array holds power in half-dB steps as uint8, shape (a, b); a ValueError if not."""
    power = np.asarray(power)
    if power.ndim != 2 or power.dtype != np.uint8:
        found = f"{power.dtype} {power.shape}"
        raise ValueError(f"scan: expected power 0..255 of shape (a, b) as uint8, got {found}")
    return power


def _check_azimuths(azimuths: np.ndarray) -> np.ndarray:
    """Check that azimuths decrease (clockwise ones rise) and stay within one turn."""
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

    Entry i belongs to row ``(i + 0.5) / TABLE_STEPS - 1`` of a scan with the same first azimuth and the mean
    step. The nearest entry is off by at most half an entry, 1/128 of a row.
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
    x: np.ndarray, y: np.ndarray, rows: np.ndarray, n_rows: int, step: float, motion: ScanMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Compute range and row at which the moving radar saw places given in the frame at mid-scan.

    The row gives the time, the time the pose, and the pose the row. Three iterations converge, since the beam
    turns much faster than places move across it.
    """
    vx, vy, yaw_rate = (np.float32(v) for v in motion.twist)
    first_rows = rows
    for _ in range(3):
        t = (rows / np.float32(n_rows) - np.float32(0.5)) * np.float32(motion.scan_seconds)
        yaw = yaw_rate * t
        c, s, half = np.cos(yaw), np.sin(yaw), np.float32(0.5) * yaw
        # Within one turn yaw is small, so the chord approximates the arc (error below 1 mm for a car).
        dx, dy = x - t * (vx - vy * half), y - t * (vx * half + vy)
        seen_x, seen_y = c * dx + s * dy, c * dy - s * dx
        # The bearing's change is small except next to the radar, so no wrap can make the row jump.
        turned = cv2.phase(x * seen_x + y * seen_y, x * seen_y - y * seen_x)
        turned = np.where(turned > np.pi, turned - np.float32(2.0 * np.pi), turned)
        rows = first_rows - turned / np.float32(step)
    ranges = np.sqrt(seen_x * seen_x + seen_y * seen_y)
    closing = (vx * seen_x + vy * seen_y) / np.maximum(ranges, np.float32(1e-6))
    return ranges - np.float32(motion.doppler_seconds) * closing, np.mod(rows, np.float32(2.0 * np.pi / step))
