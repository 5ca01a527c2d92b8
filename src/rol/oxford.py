"""Read a session of the Oxford Radar RobotCar data set: radar, lidars, odometry, GPS and INS.

Oxford's frames have y to the right and z down; the readers turn them into x forward, y left, z up, yaw
counter-clockwise. Stamps are int64 microseconds. A file that is missing, truncated, rotated or inconsistent
raises `OxfordError`; the message names the file and the fault. Nothing is repaired silently.

Data set: Barnes et al. 2020, "The Oxford Radar RobotCar Dataset"; used in Yin et al. 2020, Sec. IV-A.
"""

from __future__ import annotations

import io
import os
import re
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

if __package__:
    from .files import read_text
    from .geometry import accumulate_increments, check_points, transform_from_euler
else:  # this file was copied and is imported by its own name
    from files import read_text
    from geometry import accumulate_increments, check_points, transform_from_euler

# Radar PNG: one row per azimuth; header bytes before the power bins.
N_AZIMUTHS, N_BINS, N_HEADER = 400, 3768, 11
COUNTS_PER_TURN = 5600  # encoder counts of one radar turn, clockwise from straight ahead
N_LASERS, N_VELODYNE_ROWS = 32, 106  # HDL-32E
RANGE_UNIT = 0.002  # metres per count of a raw Velodyne range
FIRE_HEIGHT = 0.090805  # metres from the base of the HDL-32E up to the centre of its lasers
# Angle of each laser of the HDL-32E below the horizon [rad], in the row order of the raw file.
ELEVATIONS_DOWN = np.array(
    [-0.1862, -0.1628, -0.1396, -0.1164, -0.0930, -0.0698, -0.0466, -0.0232, 0.0, 0.0232, 0.0466]
    + [0.0698, 0.0930, 0.1164, 0.1396, 0.1628, 0.1862, 0.2094, 0.2327, 0.2560, 0.2793, 0.3025]
    + [0.3259, 0.3491, 0.3723, 0.3957, 0.4189, 0.4421, 0.4655, 0.4887, 0.5119, 0.5353]
)
MAX_TURN_US = 500_000  # a radar turn takes 0.25 s and a sweep 0.05 s; a longer one is a fault
MAX_NAME_GAP_US = 100_000  # a sweep's name may lie this far outside the times of its firings

LIDARS = ("velodyne_left", "velodyne_right")
SENSORS = ("radar", *LIDARS)
# x y z [m] roll pitch yaw [rad] in the vehicle frame (y right, z down), as in the SDK's extrinsics files.
OXFORD_EXTRINSICS = {
    "radar": (-0.71813, 0.12, -0.54479, 0.0, 0.05, 0.0),
    "velodyne_left": (-0.60072, -0.34077, -0.26837, -0.0053948, -0.041998, -3.1337),
    "velodyne_right": (-0.61153, 0.55676, -0.27023, 0.0027052, -0.041999, -3.1357),
}
# Signs of x y z roll pitch yaw: y right, z down to y left, z up, and back.
AXES_SIGNS = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
# T_vehicle_sensor of each sensor, 4 x 4, in our convention.
EXTRINSICS = {k: transform_from_euler(*(AXES_SIGNS * values)) for k, values in OXFORD_EXTRINSICS.items()}

ODOMETRY_COLUMNS = ["source_timestamp", "destination_timestamp", "x", "y", "z", "roll", "pitch", "yaw"]
ODOMETRY_COLUMNS += ["source_radar_timestamp", "destination_radar_timestamp"]
GPS_COLUMNS = ["timestamp", "num_satellites", "latitude", "longitude", "altitude", "latitude_sigma"]
GPS_COLUMNS += ["longitude_sigma", "altitude_sigma", "northing", "easting", "down", "utm_zone"]
INS_COLUMNS = ["timestamp", "ins_status", "latitude", "longitude", "altitude", "northing", "easting", "down"]
INS_COLUMNS += ["utm_zone", "velocity_north", "velocity_east", "velocity_down", "roll", "pitch", "yaw"]


class OxfordError(ValueError):
    """Raised for files and sessions that contradict the description of the data set; names file and fault."""


# ---- bytes ----


def _read_bytes(path: Path | str) -> bytes:
    """Read a whole file; a missing or empty one is an OxfordError."""
    try:
        data = Path(path).read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise OxfordError(f"{path}: file is missing") from error
    if not data:
        raise OxfordError(f"{path}: file is empty")
    return data


def _read_text(path: Path | str) -> str:
    """Read a text file; one that is missing, empty or not UTF-8 is an OxfordError."""
    _read_bytes(path)
    text = read_text(path, OxfordError)
    if not text:
        raise OxfordError(f"{path}: file is empty")
    return text


def _is_whole_png(data: bytes) -> bool:
    """Walk the chunks of a PNG from its header to its end and compare their checksums."""
    position, kind = 8, b""
    if data[8:16] != b"\x00\x00\x00\rIHDR":
        return False
    while kind != b"IEND":
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        checksum = zlib.crc32(memoryview(data)[position + 4 : end])
        if end + 4 > len(data) or checksum != int.from_bytes(data[end : end + 4], "big"):
            return False
        kind, position = data[position + 4 : position + 8], end + 4
    return True


def _read_png(path: Path | str, height: int, width: int | None) -> np.ndarray:
    """Decode an 8-bit grey PNG of a known size (width None: any), checked before the decoder sees it."""
    data = _read_bytes(path)
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise OxfordError(f"{path}: not a PNG file")
    if not _is_whole_png(data):
        raise OxfordError(f"{path}: PNG is truncated or damaged ({len(data)} bytes)")
    columns, rows = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if (data[24], data[25]) != (8, 0):
        found = f"bit depth {data[24]}, PNG colour type {data[25]}"
        raise OxfordError(f"{path}: not an 8-bit grey image ({found})")
    if rows != height or columns != (width or columns):
        is_rotated = columns == height and rows == (width or rows)
        hint = "; the image is rotated by 90 deg" if is_rotated else ""
        size = f"{height} x {width or 'N'}"
        raise OxfordError(f"{path}: expected {size} pixels (rows x columns), got {rows} x {columns}{hint}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (rows, columns):
        raise OxfordError(f"{path}: PNG cannot be decoded")
    return image


# ---- radar scans ----


@dataclass(frozen=True, eq=False)
class RadarScan:
    """One turn of the radar as stored in its file.

    Attributes
    ----------
    row_stamps_us : array, shape (400,), int64
        Time of each azimuth row [us]; the first one names the file.
    counters : array, shape (400,), uint16
        Encoder count 0..5599 of each row, clockwise seen from above, 0 straight ahead.
    valid : array, shape (400,), uint8
        Raw flag byte: 255 measured, anything else interpolated from neighbouring rows.
    power : array, shape (400, 3768), uint8
        Power in steps of half a decibel, along range.
    """

    row_stamps_us: np.ndarray
    counters: np.ndarray
    valid: np.ndarray
    power: np.ndarray

    @property
    def stamp_us(self) -> int:
        """Time of the first row [us], the scan's name."""
        return int(self.row_stamps_us[0])

    @property
    def azimuths(self) -> np.ndarray:
        """Azimuths of the rows, shape (400,) [rad], counter-clockwise: from 0 down to -2 pi, not wrapped."""
        steps = np.diff(self.counters.astype(np.int64)) % COUNTS_PER_TURN
        return np.cumsum(np.concatenate([self.counters[:1], steps])) * (-2.0 * np.pi / COUNTS_PER_TURN)


def check_radar(path: Path | str, scan: RadarScan) -> None:
    """Raise an OxfordError for a scan that contradicts itself or the file's name."""
    stamps = scan.row_stamps_us
    is_empty = ~scan.power.any(axis=1) | (stamps == 0)
    if is_empty.any():
        fault = f"{is_empty.sum()} all-zero azimuths (no power or no time)"
        raise OxfordError(f"{path}: {fault}, first in row {int(np.argmax(is_empty))}")
    is_back = stamps[1:] < stamps[:-1]
    if is_back.any():
        raise OxfordError(f"{path}: row stamps out of order at row {int(np.argmax(is_back)) + 1}")
    if stamps[0] < 0 or int(stamps[-1]) - int(stamps[0]) > MAX_TURN_US:
        raise OxfordError(f"{path}: row stamps {stamps[0]} .. {stamps[-1]} us are not those of one turn")
    steps = np.diff(scan.counters.astype(np.int64)) % COUNTS_PER_TURN
    if scan.counters.max() >= COUNTS_PER_TURN or (steps == 0).any() or steps.sum() >= COUNTS_PER_TURN:
        limit = COUNTS_PER_TURN - 1
        raise OxfordError(f"{path}: sweep counters do not go clockwise once around (0..{limit})")
    name = Path(path).stem
    if name.isdecimal() and int(name) != scan.stamp_us:
        raise OxfordError(f"{path}: the first row's stamp {scan.stamp_us} is not the file's name")


def load_radar(path: Path | str) -> RadarScan:
    """Read one radar scan, `radar/<us>.png`.

    Parameters
    ----------
    path : path
        8-bit grey PNG of 400 rows and 3779 columns; a name of digits must be the first row's stamp.

    Returns
    -------
    scan : RadarScan
        Content of the file; rows flagged as interpolated are kept, see `valid`.

    Raises
    ------
    OxfordError
        If the file is missing, truncated, of another shape, rotated by 90 deg, has azimuths without power or
        time, times or counters out of order, or a name that is not its first stamp.
    """
    image = _read_png(path, N_AZIMUTHS, N_HEADER + N_BINS)
    stamps = np.ascontiguousarray(image[:, :8]).view("<i8").ravel()
    counters = np.ascontiguousarray(image[:, 8:10]).view("<u2").ravel()
    scan = RadarScan(stamps, counters, image[:, 10].copy(), np.ascontiguousarray(image[:, N_HEADER:]))
    check_radar(path, scan)
    return scan


# ---- lidar sweeps ----


@dataclass(frozen=True, eq=False)
class VelodyneRaw:
    """One turn of an HDL-32E as stored in the raw file: 32 lasers times N firings.

    Attributes
    ----------
    intensities : array, shape (32, N), uint8
        Intensity of each return.
    ranges : array, shape (32, N), uint16
        Range in units of 2 mm; 0 where nothing came back.
    angles : array, shape (N,), uint16
        Angle of each firing in hundredths of a degree, clockwise seen from above, 0 to the lidar's left.
    stamps_us : array, shape (N,), int64
        Time of each firing [us]; in Oxford's files every 12th is a packet's own, the others are interpolated.
    """

    intensities: np.ndarray
    ranges: np.ndarray
    angles: np.ndarray
    stamps_us: np.ndarray


def check_velodyne(path: Path | str, raw: VelodyneRaw) -> None:
    """Raise an OxfordError for a sweep that contradicts itself or the file's name."""
    stamps = raw.stamps_us
    if (stamps <= 0).any():
        raise OxfordError(f"{path}: firing without a time stamp in column {int(np.argmax(stamps <= 0))}")
    first, last = int(stamps[0]), int(stamps[-1])
    if last < first or int(stamps.max()) - int(stamps.min()) > MAX_TURN_US:
        raise OxfordError(f"{path}: stamps {first} .. {last} us are not those of one sweep")
    if raw.angles.max() >= 36_000:
        raise OxfordError(f"{path}: angle {raw.angles.max()} lies outside 0..35999 hundredths of a degree")
    name = Path(path).stem
    if name.isdecimal() and not first - MAX_NAME_GAP_US <= int(name) <= last + MAX_NAME_GAP_US:
        raise OxfordError(f"{path}: the firings' stamps {first} .. {last} us are not near the file's name")


def load_velodyne_raw(path: Path | str) -> VelodyneRaw:
    """Read one raw lidar sweep, `velodyne_left/<us>.png` or `velodyne_right/<us>.png`.

    Parameters
    ----------
    path : path
        8-bit grey PNG of 106 rows: 32 intensity, 64 range, 2 angle, 8 time; one column per firing.

    Returns
    -------
    raw : VelodyneRaw
        Content of the file.

    Raises
    ------
    OxfordError
        If the file is missing, truncated, of another shape, rotated by 90 deg, or holds firings without a
        time, times that are not those of one sweep or not near the file's name, or impossible angles.
    """
    columns = _read_png(path, N_VELODYNE_ROWS, None).T  # (N, 106)
    intensities, ranges, angles, stamps = map(np.ascontiguousarray, np.split(columns, [32, 96, 98], axis=1))
    angles, stamps = angles.view("<u2").ravel(), stamps.view("<i8").ravel()
    raw = VelodyneRaw(intensities.T, ranges.view("<u2").T, angles, stamps)
    check_velodyne(path, raw)
    return raw


def velodyne_raw_to_points(raw: VelodyneRaw, min_range_m: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Convert a raw sweep into points in the lidar's frame.

    Parameters
    ----------
    raw : VelodyneRaw
        Sweep of N firings.
    min_range_m : float
        Returns at this range or nearer are dropped [m]; 1.0 as in the SDK.

    Returns
    -------
    points : array, shape (n, 4), float32
        x, y, z [m] in the lidar frame (x forward, y left, z up) and intensity, firing after firing.
    stamps_us : array, shape (n,), int64
        Time of each point [us]. The vehicle's motion is not compensated.
    """
    ranges = raw.ranges.T * RANGE_UNIT  # (N, 32)
    is_kept = ranges > min_range_m
    firings, lasers = np.nonzero(is_kept)
    r, angles = ranges[is_kept], np.deg2rad(raw.angles * 0.01)
    level = r * np.cos(ELEVATIONS_DOWN)[lasers]
    points = np.empty((len(r), 4), dtype=np.float32)
    points[:, 0] = level * np.sin(angles)[firings]
    points[:, 1] = level * np.cos(angles)[firings]
    points[:, 2] = FIRE_HEIGHT - r * np.sin(ELEVATIONS_DOWN)[lasers]
    points[:, 3] = raw.intensities.T[is_kept]
    return points, raw.stamps_us[firings]


def check_binary(path: Path | str, points: np.ndarray) -> None:
    """Raise an OxfordError for points that are not finite or whose intensity is not a byte's.

    A file that lost whole points has heights in place of its first intensities; these are fractions.
    """
    check_points(points, str(path), columns=4, error=OxfordError)
    if points[:, 3].min() < 0 or points[:, 3].max() > 255 or (points[:, 3] % 1.0).any():
        fault = "the intensities lie outside 0..255 or are fractions; truncated?"
        raise OxfordError(f"{path}: not four rows x, y, z, intensity: {fault}")


def load_velodyne_binary(path: Path | str) -> np.ndarray:
    """Read one lidar sweep from `<sensor>/<us>.bin`.

    Parameters
    ----------
    path : path
        float32, four rows: all x, all y, all z (y right, z down), all intensities.

    Returns
    -------
    points : array, shape (n, 4), float32
        x, y, z [m] in the lidar frame (x forward, y left, z up) and intensity. The file holds no times.

    Raises
    ------
    OxfordError
        If the file is missing or empty, its size is not four rows, or a value is not finite or no intensity.
    """
    data = _read_bytes(path)
    if len(data) % 16:
        raise OxfordError(f"{path}: {len(data)} bytes are not four rows of float32; the file is truncated")
    points = np.frombuffer(data, dtype="<f4").reshape(4, -1).T * np.float32([1, -1, -1, 1])
    check_binary(path, points)
    return np.ascontiguousarray(points)


# ---- text files ----


def check_increasing(path: Path | str, stamps: np.ndarray, first_line: int) -> None:
    """Raise an OxfordError where stamps do not increase; the first one is in line `first_line`."""
    is_wrong = stamps[1:] <= stamps[:-1]
    if is_wrong.any():
        i = int(np.argmax(is_wrong))
        where = f"line {i + 1 + first_line}"
        raise OxfordError(f"{path}: stamps out of order in {where}: {stamps[i]}, then {stamps[i + 1]} us")


def load_timestamps(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Read `radar.timestamps`, `velodyne_left.timestamps` or `velodyne_right.timestamps`.

    Parameters
    ----------
    path : path
        Text file, one `<microseconds> <valid flag>` per line.

    Returns
    -------
    stamps_us : array, shape (n,), int64
        Strictly increasing times [us].
    valid : array, shape (n,), bool
        False where the flag is 0: the frame is listed, but not to be used.

    Raises
    ------
    OxfordError
        If the file is missing or empty, a line is not a stamp and a flag 0 or 1, or stamps do not increase.
    """
    lines = [" ".join(line.split()) for line in _read_text(path).splitlines()]
    for number, line in enumerate(lines, 1):
        if not re.fullmatch(r"\d{1,18} [01]", line, re.ASCII):
            raise OxfordError(f"{path}: line {number} is not '<microseconds> <0 or 1>': {line!r:.60}")
    stamps = np.array([int(line[:-2]) for line in lines], dtype=np.int64)
    check_increasing(path, stamps, first_line=1)
    return stamps, np.array([line[-1] == "1" for line in lines], dtype=bool)


def column_type(name: str) -> type:
    """Return the type of a column of Oxford's csv files."""
    if name in ("ins_status", "utm_zone"):
        return str
    return np.int64 if "timestamp" in name or name == "num_satellites" else np.float64


def check_table(path: Path | str, table: pd.DataFrame, columns: list[str]) -> None:
    """Raise an OxfordError for other columns, no row, values missing or not finite, or unordered times."""
    if list(table.columns) != columns or len(table) == 0:
        fault = f"no rows, or wrong columns (missing: {', '.join(c for c in columns if c not in table) or 'none'})"
        raise OxfordError(f"{path}: {fault}; expected {','.join(columns)}")
    for name in columns:
        values = table[name]
        is_float = column_type(name) is np.float64
        is_bad = ~np.isfinite(values.to_numpy()) if is_float else values.isna().to_numpy()
        if is_bad.any():
            raise OxfordError(f"{path}: line {int(np.argmax(is_bad)) + 2}: {name} is missing or not finite")
    check_increasing(path, table[columns[0]].to_numpy(np.int64), first_line=2)


def _load_table(path: Path | str, columns: list[str]) -> pd.DataFrame:
    """Read one of Oxford's csv files with known columns."""
    text = _read_text(path)
    lines = text.splitlines()
    there = Counter(lines[0].split(","))
    odd = {"missing": Counter(columns) - there, "unknown or doubled": there - Counter(columns)}
    faults = [f"{kind} columns: {', '.join(names.elements())}" for kind, names in odd.items() if names]
    if faults:
        raise OxfordError(f"{path}: {'; '.join(faults)}")
    if not text.endswith("\n"):
        raise OxfordError(f"{path}: the last line is cut off (no line end): {lines[-1][-60:]!r}")
    for number, line in enumerate(lines, 1):
        if line.count(",") != len(columns) - 1:
            raise OxfordError(f"{path}: line {number} has {line.count(',') + 1} fields, not {len(columns)}")
    types = {name: column_type(name) for name in columns}
    try:
        table = pd.read_csv(io.StringIO(text), dtype=types)
    except (ValueError, OverflowError) as error:
        raise OxfordError(f"{path}: a value is missing or not a number: {error}") from error
    check_table(path, table, columns)
    return table


def load_gps(path: Path | str) -> pd.DataFrame:
    """Read `gps/gps.csv`, a 5 Hz GPS receiver.

    Parameters
    ----------
    path : path
        The csv file.

    Returns
    -------
    table : pandas.DataFrame
        The file's columns as they are: timestamp [us] int64, num_satellites, latitude and longitude [deg],
        altitude [m], sigmas [m], northing, easting, down [m], utm_zone.

    Raises
    ------
    OxfordError
        If the file is missing or cut off, lacks a column or a value, or times do not increase.
    """
    return _load_table(path, GPS_COLUMNS)


def load_ins(path: Path | str) -> pd.DataFrame:
    """Read `gps/ins.csv`, GPS and inertial sensors fused.

    Parameters
    ----------
    path : path
        The csv file.

    Returns
    -------
    table : pandas.DataFrame
        The file's columns as they are: timestamp [us] int64, ins_status, latitude and longitude [deg],
        altitude, northing, easting, down [m], utm_zone, velocity_north, _east, _down [m/s], and roll, pitch,
        yaw [rad] of the y-right, z-down vehicle in north-east-down, so yaw is clockwise from north.

    Raises
    ------
    OxfordError
        If the file is missing or cut off, lacks a column or a value, or times do not increase.
    """
    return _load_table(path, INS_COLUMNS)


# ---- radar odometry ----


@dataclass(frozen=True, eq=False)
class RadarOdometry:
    """Radar odometry of the data set.

    Increment i is `T_destination_source`: the pose of the later scan (source) in the earlier one
    (destination).

    Attributes
    ----------
    source_stamps_us, destination_stamps_us : array, shape (n,), int64
        Mid-scan times [us], 122 to 128 ms after the scans' first rows.
    source_radar_stamps_us, destination_radar_stamps_us : array, shape (n,), int64
        First-row times [us], the names of the scans.
    increments_6dof : array, shape (n, 6)
        x, y, z [m], roll, pitch, yaw [rad]; z, roll and pitch are zero in Oxford's files.
    path : str
        File, for messages.
    """

    source_stamps_us: np.ndarray
    destination_stamps_us: np.ndarray
    source_radar_stamps_us: np.ndarray
    destination_radar_stamps_us: np.ndarray
    increments_6dof: np.ndarray
    path: str = "radar odometry"

    @property
    def increments(self) -> np.ndarray:
        """Increments in the plane, shape (n, 3): x, y, yaw [m, m, rad]."""
        return self.increments_6dof[:, [0, 1, 5]]


def check_odometry(path: Path | str, odometry: RadarOdometry) -> None:
    """Raise an OxfordError for increments that run backward in time, or times outside their scans."""
    o = odometry
    mid = np.stack([o.source_stamps_us, o.destination_stamps_us])
    first = np.stack([o.source_radar_stamps_us, o.destination_radar_stamps_us])
    is_outside = ((mid < first) | (mid > first + MAX_TURN_US)).any(axis=0)
    faults = {
        "the source is not later than the destination": (mid[0] <= mid[1]) | (first[0] <= first[1]),
        "a frame's time lies outside its radar scan": is_outside,
    }
    for fault, is_bad in faults.items():
        if is_bad.any():
            raise OxfordError(f"{path}: line {int(np.argmax(is_bad)) + 2}: {fault}")


def load_radar_odometry(path: Path | str) -> RadarOdometry:
    """Read `gt/radar_odometry.csv`.

    A session of n scans has n - 2 rows. They connect its scans 0 to n - 2 without a gap, so every scan but
    the last has a pose (2019-01-10-11-46-21: 8867 stamps, 8865 rows, 8866 poses).

    Parameters
    ----------
    path : path
        The csv file: source, the later frame, seen from destination; y right, yaw clockwise.

    Returns
    -------
    odometry : RadarOdometry
        Increments with y left and yaw counter-clockwise: y, z, pitch and yaw change their sign.

    Raises
    ------
    OxfordError
        If the file is missing or cut off, lacks a column or a value, times do not increase, a source is not
        later than its destination, or a frame's time lies outside its scan.
    """
    table = _load_table(path, ODOMETRY_COLUMNS)
    stamps = (table[name].to_numpy(np.int64) for name in ODOMETRY_COLUMNS if "timestamp" in name)
    increments = table[ODOMETRY_COLUMNS[2:8]].to_numpy(np.float64) * AXES_SIGNS
    odometry = RadarOdometry(*stamps, increments, str(path))
    check_odometry(path, odometry)
    return odometry


def compose_odometry(
    odometry: RadarOdometry, start: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compose the increments into the radar's trajectory.

    Parameters
    ----------
    odometry : RadarOdometry
        n increments, each one starting where the previous one ends.
    start : array-like, shape (3,)
        Pose of the first scan [m, m, rad].

    Returns
    -------
    radar_stamps_us : array, shape (n + 1,), int64
        First-row times [us], the names of the scans.
    mid_stamps_us : array, shape (n + 1,), int64
        Mid-scan times [us], at which the poses hold.
    poses : array, shape (n + 1, 3)
        T_start_radar of every scan (x, y, yaw) [m, m, rad].

    Raises
    ------
    OxfordError
        If there is a gap between two increments.
    """
    o = odometry
    is_gap = o.destination_radar_stamps_us[1:] != o.source_radar_stamps_us[:-1]
    is_gap |= o.destination_stamps_us[1:] != o.source_stamps_us[:-1]
    if is_gap.any():
        i = int(np.argmax(is_gap))
        end, begin = o.source_radar_stamps_us[i], o.destination_radar_stamps_us[i + 1]
        raise OxfordError(f"{o.path}: gap before line {i + 3}: from scan {end} to scan {begin}")
    radar_stamps = np.concatenate([o.destination_radar_stamps_us[:1], o.source_radar_stamps_us])
    mid_stamps = np.concatenate([o.destination_stamps_us[:1], o.source_stamps_us])
    return radar_stamps, mid_stamps, accumulate_increments(o.increments, start)


# ---- a whole session ----


@dataclass(frozen=True, eq=False)
class Session:
    """One session on disk, from `open_session`.

    Attributes
    ----------
    root : Path
        The session's folder.
    name : str
        The folder's name.
    radar_stamps_us : array, shape (n,), int64
        Names of the scans [us]. Stamps flagged 0 are left out, here and below.
    left_stamps_us, right_stamps_us : array, shape (m,), int64, or None
        Names of the left and right lidar's sweeps [us]; None if the session has no such lidar.
    """

    root: Path
    name: str
    radar_stamps_us: np.ndarray
    left_stamps_us: np.ndarray | None
    right_stamps_us: np.ndarray | None

    @property
    def odometry_path(self) -> Path:
        """Path of `gt/radar_odometry.csv`."""
        return self.root / "gt" / "radar_odometry.csv"

    @property
    def gps_path(self) -> Path:
        """Path of `gps/gps.csv`."""
        return self.root / "gps" / "gps.csv"

    @property
    def ins_path(self) -> Path:
        """Path of `gps/ins.csv`."""
        return self.root / "gps" / "ins.csv"

    def radar_path(self, stamp_us: int) -> Path:
        """Return the path of the scan of a stamp [us]."""
        return self.root / "radar" / f"{int(stamp_us)}.png"

    def sweep_path(self, sensor: str, stamp_us: int) -> Path:
        """Return the path of a lidar's sweep, the .png or else the .bin; an OxfordError without either."""
        if sensor not in LIDARS:
            raise OxfordError(f"{self.root}: no lidar is called {sensor!r}; there are {', '.join(LIDARS)}")
        if (self.left_stamps_us if sensor == "velodyne_left" else self.right_stamps_us) is None:
            raise OxfordError(f"{self.root}: the session has no {sensor} ({sensor}.timestamps is missing)")
        paths = [self.root / sensor / f"{int(stamp_us)}{suffix}" for suffix in (".png", ".bin")]
        for path in paths:
            if path.is_file():
                return path
        raise OxfordError(f"{paths[0]}: file is missing, and so is {paths[1].name}")


def list_sessions(sessions_root: Path | str) -> list[str]:
    """List the names of the sessions in a folder, sorted: its subfolders that hold a `radar.timestamps`."""
    return sorted(path.parent.name for path in Path(sessions_root).glob("*/radar.timestamps"))


def open_session(path: Path | str) -> Session:
    """Open a session folder.

    Parameters
    ----------
    path : path
        Folder that holds `radar/` and `radar.timestamps`; lidars may be missing. A simulated session
        (its name begins with `sim-`) must hold the `session.json` that its maker writes last.

    Returns
    -------
    session : Session
        Paths and stamps; no image is read yet.

    Raises
    ------
    OxfordError
        If there is no such session or it is incomplete; the message lists the sessions beside it.
    """
    root = Path(os.path.abspath(path))
    files = ["radar.timestamps"] + (["session.json"] if root.name.startswith("sim-") else [])
    missing = [] if (root / "radar").is_dir() else ["radar"]
    missing += [name for name in files if not (root / name).is_file()]
    if missing:
        fault = f"incomplete session, {', '.join(missing)} missing" if root.is_dir() else "no such session"
        others = ", ".join(name for name in list_sessions(root.parent) if name != root.name) or "none"
        raise OxfordError(f"{path}: {fault}; sessions beside it: {others}")
    listings = [Path(path) / f"{sensor}.timestamps" for sensor in SENSORS]
    loaded = [load_timestamps(listing) if listing.is_file() else None for listing in listings]
    return Session(Path(path), root.name, *(None if pair is None else pair[0][pair[1]] for pair in loaded))


def load_sweep(session: Session, sensor: str, stamp_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Read a lidar sweep of a session in the format that is present.

    Parameters
    ----------
    session : Session
        The session.
    sensor : str
        `velodyne_left` or `velodyne_right`.
    stamp_us : int
        The sweep's name [us].

    Returns
    -------
    points : array, shape (n, 4), float32
        x, y, z [m] in the lidar frame (x forward, y left, z up) and intensity.
    stamps_us : array, shape (n,), int64
        Time of each point [us]; a .bin holds no times, so all its points get the sweep's name.

    Raises
    ------
    OxfordError
        If the session has no such lidar or sweep, or its file is at fault.
    """
    path = session.sweep_path(sensor, stamp_us)
    if path.suffix == ".png":
        return velodyne_raw_to_points(load_velodyne_raw(path))
    points = load_velodyne_binary(path)
    return points, np.full(len(points), int(stamp_us), dtype=np.int64)


def _describe(path: Path, items: np.ndarray | list, what: str) -> list[str]:
    """Format '<path>: <count> <what>, the first: <item>'; an empty list for no items."""
    return [f"{path}: {len(items)} {what}, the first: {items[0]}"] if len(items) else []


def _find_sensor_faults(session: Session, sensor: str) -> list[str]:
    """Compare a sensor's list of stamps with its files; name flags of 0 and gaps."""
    listing, folder = session.root / f"{sensor}.timestamps", session.root / sensor
    found = ((listing, "file", listing.is_file()), (folder, "folder", folder.is_dir()))
    absent = [(path, kind) for path, kind, is_there in found if not is_there]
    if absent:
        return [f"{path}: {f'not a {kind}' if path.exists() else 'missing'}" for path, kind in absent]
    stamps, valid = load_timestamps(listing)
    entries = [entry for entry in os.scandir(folder) if entry.name[0] != "."]
    sizes = {entry.name: entry.is_file() and entry.stat().st_size for entry in entries}
    suffixes = (".png",) if sensor == "radar" else (".png", ".bin")
    frames = {name for name in sizes if name.endswith(suffixes) and name[:-4].isdecimal() and len(name) < 23}
    on_disk = np.unique(np.array([int(name[:-4]) for name in frames], dtype=np.int64))
    intervals = np.diff(stamps)
    # A session may hold only the sweeps that scans need, 0.1 and 0.15 s apart in turn; the radar skips no
    # turn.
    longest = (1.5 if sensor == "radar" else 3.5) * np.median(intervals) if len(intervals) else 0.0
    is_gap = intervals > longest
    gaps = [f"{t / 1e6:.3f} s after {s}" for t, s in zip(intervals[is_gap], stamps[:-1][is_gap], strict=True)]
    return [
        *_describe(listing, stamps[~valid], "stamps flagged 0, not to be used"),
        *_describe(listing, gaps, "gaps between frames"),
        *_describe(folder, stamps[valid & ~np.isin(stamps, on_disk)], "stamps without a file"),
        *_describe(folder, np.setdiff1d(on_disk, stamps), "files without a stamp"),
        *_describe(folder, sorted(set(sizes) - frames), "files that are no frame"),
        *_describe(folder, sorted(name for name in frames if sizes[name] == 0), "empty files"),
    ]


def _find_cover_faults(session: Session) -> list[str]:
    """Name the scans that the sweeps of a lidar do not cover in time."""
    scans, faults = session.radar_stamps_us, []
    for sensor, stamps in zip(LIDARS, (session.left_stamps_us, session.right_stamps_us), strict=True):
        if stamps is not None:
            nearest = np.searchsorted(stamps, [scans - MAX_NAME_GAP_US, scans + MAX_NAME_GAP_US])
            bare = scans[nearest[0] == nearest[1]]
            faults += _describe(session.root / sensor, bare, "scans without a sweep near")
    return faults


def _find_odometry_faults(session: Session) -> list[str]:
    """Compare the scans with the odometry: every scan but the last should have a pose."""
    path, scans = session.odometry_path, session.radar_stamps_us
    stamps, _, _ = compose_odometry(load_radar_odometry(path))
    late, inside = scans[scans > stamps[-1]], scans[(scans >= stamps[0]) & (scans <= stamps[-1])]
    late, bare = late if len(late) > 1 else [], inside[~np.isin(inside, stamps)]
    return [
        *_describe(path, scans[scans < stamps[0]], "scans before the first pose"),
        *_describe(path, late, "scans after the last pose, the ground truth ends early"),
        *_describe(path, bare, "scans without a pose within the ground truth's span"),
        *_describe(path, stamps[~np.isin(stamps, scans)], "poses without a scan in radar.timestamps"),
    ]


def check_session(session: Session) -> list[str]:
    """Check a session for the faults that users of the data set meet, without decoding images.

    Parameters
    ----------
    session : Session
        The session.

    Returns
    -------
    faults : list of str
        One sentence per fault, naming the file; empty without faults. Checked: a sensor that is missing,
        stamps flagged 0, stamps without a file and files without a stamp, empty files, gaps between frames,
        scans without a sweep within 0.1 s, odometry that is missing, broken or ends early, gps.csv or ins.csv
        missing or broken.
    """
    faults = [fault for sensor in SENSORS for fault in _find_sensor_faults(session, sensor)]
    faults += _find_cover_faults(session)
    try:
        faults += _find_odometry_faults(session)
    except OxfordError as error:
        faults.append(str(error))
    for load, path in ((load_gps, session.gps_path), (load_ins, session.ins_path)):
        try:
            load(path)
        except OxfordError as error:
            faults.append(str(error))
    return faults
