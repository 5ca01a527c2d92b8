"""Write the files of an Oxford Radar RobotCar session, such that `rol.oxford` reads them back.

Every writer refuses with an `OxfordError` what its reader would refuse; the message names the file and the
fault. Poses and points are in the project's frames (x forward, y left, z up) and are turned into Oxford's
here.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from rol.files import write_bytes, write_text
from rol.oxford import (
    AXES_SIGNS,
    GPS_COLUMNS,
    INS_COLUMNS,
    N_AZIMUTHS,
    N_BINS,
    N_LASERS,
    ODOMETRY_COLUMNS,
    OxfordError,
    RadarOdometry,
    RadarScan,
    VelodyneRaw,
    check_binary,
    check_increasing,
    check_odometry,
    check_radar,
    check_table,
    check_velodyne,
    column_type,
)


def _write_png(path: Path | str, image: np.ndarray) -> None:
    """Encode a grey image fast: level 2 and filter `sub` give the size of the real files in 20 ms a scan."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, 2, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    is_done, data = cv2.imencode(".png", image, options)
    if not is_done:
        raise OxfordError(f"{path}: image of shape {image.shape} cannot be encoded")
    write_bytes(path, data.tobytes())


def _cast(path: Path | str, name: str, values: np.ndarray, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
    """Return values in the file's type; refuse another shape or a value that the type cannot hold."""
    values = np.asarray(values)
    if values.shape != shape:
        raise OxfordError(f"{path}: {name}: expected shape {shape}, got {values.shape}")
    with np.errstate(invalid="ignore"):
        cast = values.astype(dtype)
    if not np.array_equal(cast, values, equal_nan=True):
        raise OxfordError(f"{path}: {name}: a value does not fit into {np.dtype(dtype).name}")
    return cast


def save_radar(path: Path | str, scan: RadarScan) -> None:
    """Write one radar scan as `rol.oxford.load_radar` returns it, bit for bit; an OxfordError if not."""
    rows = (N_AZIMUTHS,)
    stamps = _cast(path, "row_stamps_us", scan.row_stamps_us, np.int64, rows)
    counters = _cast(path, "counters", scan.counters, np.uint16, rows)
    valid = _cast(path, "valid", scan.valid, np.uint8, rows)
    power = _cast(path, "power", scan.power, np.uint8, (N_AZIMUTHS, N_BINS))
    check_radar(path, RadarScan(stamps, counters, valid, power))
    header = [stamps.astype("<i8")[:, None].view(np.uint8), counters.astype("<u2")[:, None].view(np.uint8)]
    _write_png(path, np.concatenate([*header, valid[:, None], power], axis=1))


def save_velodyne_raw(path: Path | str, raw: VelodyneRaw) -> None:
    """Write a raw sweep as `rol.oxford.load_velodyne_raw` reads it, bit for bit; an OxfordError if not."""
    n = np.size(raw.stamps_us)
    if n == 0:
        raise OxfordError(f"{path}: sweep without a firing")
    intensities = _cast(path, "intensities", raw.intensities, np.uint8, (N_LASERS, n))
    ranges = _cast(path, "ranges", raw.ranges, np.uint16, (N_LASERS, n))
    angles = _cast(path, "angles", raw.angles, np.uint16, (n,))
    stamps = _cast(path, "stamps_us", raw.stamps_us, np.int64, (n,))
    check_velodyne(path, VelodyneRaw(intensities, ranges, angles, stamps))
    words = ranges.T.astype("<u2", order="C"), angles.astype("<u2")[:, None], stamps.astype("<i8")[:, None]
    columns = np.concatenate([intensities.T, *(word.view(np.uint8) for word in words)], axis=1)  # (n, 106)
    _write_png(path, np.ascontiguousarray(columns.T))


def save_velodyne_binary(path: Path | str, points: np.ndarray) -> None:
    """Write points (n, 4), float32, as `rol.oxford.load_velodyne_binary` reads them, or raise its error."""
    points = np.asarray(points, dtype="<f4")
    if points.ndim != 2 or points.shape[1] != 4 or len(points) == 0:
        raise OxfordError(f"{path}: expected points of shape (n, 4) with n > 0, got {points.shape}")
    check_binary(path, points)
    write_bytes(path, np.ascontiguousarray((points * np.float32([1, -1, -1, 1])).T).tobytes())


def save_timestamps(path: Path | str, stamps_us: np.ndarray, valid: np.ndarray | None = None) -> None:
    """Write increasing stamps (n,) [us] and flags (n,), by default all true, as a `*.timestamps` file."""
    stamps = np.asarray(stamps_us, dtype=np.int64)
    flags = np.ones(stamps.shape, dtype=bool) if valid is None else np.asarray(valid, dtype=bool)
    if stamps.ndim != 1 or len(stamps) == 0 or flags.shape != stamps.shape:
        raise OxfordError(
            f"{path}: expected n > 0 stamps and as many flags, got {stamps.shape}, {flags.shape}"
        )
    check_increasing(path, stamps, first_line=1)
    lines = [f"{stamp} {flag:d}\n" for stamp, flag in zip(stamps.tolist(), flags.tolist(), strict=True)]
    write_text(path, "".join(lines))


def _save_table(path: Path | str, table: pd.DataFrame, columns: list[str], stamp_digits: int = 0) -> None:
    """Write a table as Oxford does: six decimals, first column padded with zeros to `stamp_digits`."""
    check_table(path, table, columns)
    counts = [name for name in columns if column_type(name) is np.int64]
    fields = {name: _cast(path, name, table[name].to_numpy(), np.int64, (len(table),)) for name in counts}
    fields[columns[0]] = [f"{stamp:0{stamp_digits}d}" for stamp in fields[columns[0]].tolist()]
    text = table.assign(**fields).to_csv(index=False, float_format="%.6f", lineterminator="\n")
    write_text(path, text)


def save_gps(path: Path | str, table: pd.DataFrame) -> None:
    """Write `gps/gps.csv` from a table as `rol.oxford.load_gps` returns it, times padded to 19 digits."""
    _save_table(path, table, GPS_COLUMNS, stamp_digits=19)


def save_ins(path: Path | str, table: pd.DataFrame) -> None:
    """Write `gps/ins.csv` from a table as `rol.oxford.load_ins` returns it, times padded to 19 digits."""
    _save_table(path, table, INS_COLUMNS, stamp_digits=19)


def save_radar_odometry(path: Path | str, odometry: RadarOdometry) -> None:
    """Write `gt/radar_odometry.csv`, six decimals; what was read is written back byte for byte."""
    o, n = odometry, len(odometry.increments_6dof)
    mid = (o.source_stamps_us, o.destination_stamps_us)
    first = (o.source_radar_stamps_us, o.destination_radar_stamps_us)
    mid, first = ([_cast(path, "stamps", stamps, np.int64, (n,)) for stamps in pair] for pair in (mid, first))
    increments = _cast(path, "increments_6dof", o.increments_6dof, np.float64, (n, 6)) * AXES_SIGNS
    check_odometry(path, RadarOdometry(*mid, *first, increments))
    values = zip(ODOMETRY_COLUMNS, [*mid, *increments.T, *first], strict=True)
    _save_table(path, pd.DataFrame(dict(values)), ODOMETRY_COLUMNS)
