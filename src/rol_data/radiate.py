"""Read pairs of a radar scan and a lidar sweep from RADIATE, recorded in bad weather (Sheeny et al. 2021).

The small sample that comes with its SDK holds 18 consecutive scans of a CTS350-X, the paper's radar, and the
nearest sweep of an HDL-32E, the paper's lidar, in fog. The radar's files differ from Oxford's: bins four
times as long, no stamps in the rows, another scale of power. Frame: that of the radar, x forward, y left, z
up [m].
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import yaml

from rol.files import read_text

PAIRS_PATH = Path("radiate_sdk/data/radiate/tiny_foggy")
CALIBRATION_PATH = Path("radiate_sdk/config/default-calib.yaml")
RANGE_RESOLUTION = 0.17361  # length of a bin [m], as the data set states it
N_AZIMUTHS, N_BINS = 400, 576


class RadiateError(ValueError):
    """Raised for a file of the pairs that is missing or not what it should be; names file and fault."""


@dataclass(frozen=True)
class RadiatePair:
    """A radar scan and the lidar sweep nearest in time.

    Attributes
    ----------
    radar_path, lidar_path : Path
        The files.
    power : array, shape (400, 576), uint8
        The scan, one row per azimuth, one column per range bin.
    points : array, shape (n, 4)
        The sweep in the radar frame: x, y, z [m], intensity. The vehicle's motion is not compensated.
    gap_s : float
        Time of the sweep after that of the scan, as the lists of times give both [s].
    """

    radar_path: Path
    lidar_path: Path
    power: np.ndarray
    points: np.ndarray
    gap_s: float


def radiate_azimuths() -> np.ndarray:
    """Return the bearings of the rows, counter-clockwise and so decreasing, shape (400,) [rad]."""
    return -2.0 * np.pi * np.arange(N_AZIMUTHS) / N_AZIMUTHS


def load_pairs(real_root: Path | str) -> list[RadiatePair]:
    """Read all pairs of the sample.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.

    Returns
    -------
    pairs : list of RadiatePair
        In the order of time.

    Raises
    ------
    RadiateError
        If a file is missing or at fault; the message names it.
    """
    folder = Path(real_root) / PAIRS_PATH
    lidar_place = _load_lidar_place(Path(real_root) / CALIBRATION_PATH)
    scans, sweeps = (_load_times(folder / f"{name}.txt") for name in ("Navtech_Polar", "velo_lidar"))
    radar_paths = sorted((folder / "Navtech_Polar").glob("[!.]*.png"))
    lidar_paths = {path.stem: path for path in (folder / "velo_lidar").glob("[!.]*.csv")}
    there = {number: seconds for number, seconds in sweeps.items() if number in lidar_paths}
    if not radar_paths or not there:
        raise RadiateError(f"{folder}: no scans or no sweeps with a time")
    pairs = []
    for path in radar_paths:
        if path.stem not in scans:
            raise RadiateError(f"{path}: has no time in {folder / 'Navtech_Polar.txt'}")
        nearest = min(there, key=lambda number: abs(there[number] - scans[path.stem]))
        points = _load_sweep(lidar_paths[nearest]) + np.append(lidar_place, 0.0)
        gap_s = there[nearest] - scans[path.stem]
        pairs.append(RadiatePair(path, lidar_paths[nearest], _load_power(path), points, gap_s))
    return pairs


def _load_times(path: Path) -> dict[str, float]:
    """Read the times of the files [s], by their numbers."""
    if not path.is_file():
        raise RadiateError(f"{path}: missing")
    found = re.findall(r"Frame: (\d+) Time: ([\d.]+)", read_text(path, RadiateError))
    if not found:
        raise RadiateError(f"{path}: holds no line 'Frame: NUMBER Time: SECONDS'")
    return {number: float(seconds) for number, seconds in found}


def _load_lidar_place(path: Path) -> np.ndarray:
    """Read the position of the lidar in the radar frame [m]; the file has x to the right, y forward."""
    try:
        place = yaml.safe_load(read_text(path))["lidar_calib"]["T"]
        right, forward, up = (float(value) for value in place)
    except (OSError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise RadiateError(f"{path}: holds no lidar_calib with T of three numbers ({error})") from error
    return np.array([forward, -right, up])


def _load_power(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (N_BINS, N_AZIMUTHS) or image.dtype != np.uint8:
        shape = None if image is None else image.shape
        raise RadiateError(f"{path}: expected a grey image of {N_BINS} x {N_AZIMUTHS}, got {shape}")
    return np.ascontiguousarray(image.T)


def _load_sweep(path: Path) -> np.ndarray:
    """Read a sweep and turn its axes: x forward, y left, z up, intensity."""
    try:
        table = pd.read_csv(path, header=None, dtype=np.float64).to_numpy()
    except (ValueError, pd.errors.ParserError) as error:
        raise RadiateError(f"{path}: not a table of numbers ({error})") from error
    if table.shape[1] != 5 or not np.isfinite(table).all():
        raise RadiateError(f"{path}: expected rows of five finite numbers, got shape {table.shape}")
    return np.column_stack([table[:, 1], -table[:, 0], table[:, 2], table[:, 3]])
