"""Data augmentation: training pairs made on demand from polar scans and lidar points, with random changes.

The rotation is applied before the scan is resampled and before the lidar points are rasterized. A rotated
pair is therefore as good as the recorded one: no pixel is interpolated twice, no corner is lost. Images as in
`rol.bev`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from rol.bev import normalize_image, points_to_image
from rol.files import write_bytes
from rol.lidar import crop_range, remove_ground
from rol.oxford import Session, load_radar
from rol.pairs import AlignedScan, PairSettings, load_lidar_points, radar_to_image

STEP_M = 0.05  # lidar points are kept once per cell of this edge


@dataclass(frozen=True)
class LidarClouds:
    """The lidar points of many scans, without the ground, in the radar frame.

    Attributes
    ----------
    points : array, shape (m, 2), int16
        All points, scan by scan, in units of `STEP_M`.
    starts : array, shape (n + 1,), int64
        Index of the first point of each scan.
    """

    points: np.ndarray
    starts: np.ndarray

    def cloud(self, index: int) -> np.ndarray:
        """Return the points of one scan, shape (k, 2) [m]."""
        return self.points[self.starts[index] : self.starts[index + 1]] * STEP_M


class ScanPairs:
    """Training pairs of one session, made from the polar scans and the lidar points.

    Parameters
    ----------
    session : Session
        The session.
    aligned : sequence of AlignedScan
        The scans.
    clouds : LidarClouds
        Their lidar points, from `gather_clouds`.
    settings : PairSettings
        Settings of the images.
    """

    def __init__(
        self, session: Session, aligned: Sequence[AlignedScan], clouds: LidarClouds, settings: PairSettings
    ) -> None:
        if len(aligned) != len(clouds.starts) - 1:
            raise ValueError(f"{session.name}: {len(aligned)} scans, but clouds of {len(clouds.starts) - 1}")
        self.session, self.aligned, self.clouds, self.settings = session, list(aligned), clouds, settings

    def __len__(self) -> int:
        return len(self.aligned)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a pair as it was recorded, see `draw`."""
        return self.draw(index, 0.0)

    def name(self, index: int) -> str:
        """Return the path of the scan."""
        return str(self.session.radar_path(self.aligned[index].radar_stamp_us))

    def draw(
        self,
        index: int,
        turn: float,
        gain_db: float = 0.0,
        n_streaks: int = 0,
        n_ghosts: int = 0,
        rng: np.random.Generator | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Create one pair with changes of the surroundings and of the radar.

        Parameters
        ----------
        index : int
            Which scan.
        turn : float
            Counter-clockwise rotation of the surroundings [rad].
        gain_db : float
            Added to all power above zero [dB].
        n_streaks, n_ghosts : int
            Streaks and ghosts added, see `add_streaks` and `add_ghosts`.
        rng : numpy.random.Generator, optional
            Draws streaks and ghosts; needed if there are any.

        Returns
        -------
        radar, lidar : array, shape (1, h, w), float32
            -1 for grey value 0 and for empty, +1 for 255 and for occupied.
        """
        scan = load_radar(self.session.radar_path(self.aligned[index].radar_stamp_us))
        power = apply_gain(scan.power, gain_db)
        if n_streaks + n_ghosts > 0:
            if rng is None:
                raise ValueError("streaks and ghosts need a random generator")
            power = add_ghosts(add_streaks(power, n_streaks, rng), n_ghosts, rng)
        radar = rotated_radar_image(power, scan.azimuths, turn, self.aligned[index].twist, self.settings)
        size = {name: getattr(self.settings, name) for name in ("width", "pixel_size", "max_range")}
        lidar = points_to_image(rotate_points(self.clouds.cloud(index), turn), **size)
        return normalize_image(radar[None]), normalize_image(lidar[None])


def rotate_points(points: np.ndarray, turn: float) -> np.ndarray:
    """Rotate points counter-clockwise about the radar, shape (n, 2) [m], angle [rad]."""
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s], [-s, c]])


def apply_gain(power: np.ndarray, gain_db: float) -> np.ndarray:
    """Add a gain [dB] to power in half-dB steps; zero stays zero, the rest stays above zero."""
    if gain_db == 0.0:
        return power
    table = np.clip(np.arange(256) + round(2.0 * gain_db), 1, 255).astype(np.uint8)
    table[0] = 0
    return table[power]


def add_streaks(power: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Add streaks to a scan: a few neighbouring rows that are bright at all ranges.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps.
    n : int
        Number of streaks.
    rng : numpy.random.Generator
        Draws bearing, width, level, slope, speckle and modulation of each.

    Returns
    -------
    power : array, shape (a, b), uint8
        A copy, nowhere darker than before.

    Notes
    -----
    The distributions were chosen from the eleven real scans: one to five rows, a level of 15 to 43 dB that
    falls by 1.5 to 5 dB per 13 m, speckle like that of other echoes, and in half of them echoes that repeat
    every few metres. Stronger real echoes remain, so the lidar image is unchanged.
    """
    power, (n_rows, n_bins) = power.copy(), power.shape
    bins = np.arange(n_bins, dtype=np.float32)
    for _ in range(n):
        row, half_width = int(rng.integers(n_rows)), rng.uniform(0.5, 2.2)
        begin, slope = rng.uniform(60.0, 600.0), rng.uniform(3.0, 10.0) / 300.0
        level = rng.uniform(30.0, 85.0) - slope * np.maximum(bins - begin, 0.0) - 12.0 * (bins < begin)
        if rng.random() < 0.5:
            beat = np.cos(np.pi * bins / rng.uniform(70.0, 350.0) + rng.uniform(0.0, np.pi)) ** 8
            level += rng.uniform(5.0, 25.0) * (beat - 0.5)
        for aside in range(-int(np.ceil(half_width)), int(np.ceil(half_width)) + 1):
            grain = np.interp(bins, bins[::5], 20.0 * np.log10(rng.gamma(0.6, 1.5, len(bins[::5])) + 1e-3))
            streak = level - 12.0 * (aside / half_width) ** 2 + grain
            here = (row + aside) % n_rows
            power[here] = np.maximum(power[here], np.clip(streak, 0.0, 250.0).astype(np.uint8))
    return power


def add_ghosts(power: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Add ghosts to a scan: copies of bright echoes at other places, as from multipath or from new vehicles.

    Parameters
    ----------
    power : array, shape (a, b), uint8
        Power in half-dB steps.
    n : int
        Number of ghosts.
    rng : numpy.random.Generator
        Draws the echo, its size, its new place and its attenuation.

    Returns
    -------
    power : array, shape (a, b), uint8
        A copy, nowhere darker than before.

    Notes
    -----
    The lidar sees no ghosts, and a map holds no vehicles, so the lidar image is unchanged.
    """
    found, (n_rows, n_bins) = power.copy(), power.shape
    rows, bins = np.nonzero(power[:, :1500:4] >= 70)  # within the image, 35 dB
    for _ in range(n if len(rows) else 0):
        one = int(rng.integers(len(rows)))
        half_rows, half_bins = int(rng.integers(1, 6)), int(rng.integers(10, 60))
        around = (rows[one] + np.arange(-half_rows, half_rows + 1)) % n_rows
        begin = int(np.clip(4 * bins[one] - half_bins, 0, n_bins - 2 * half_bins))
        patch = power[around, begin : begin + 2 * half_bins].astype(np.int64) - int(rng.integers(0, 25))
        there = (int(rng.integers(n_rows)) + np.arange(len(around))) % n_rows
        place = int(rng.integers(100, min(1400, n_bins - 2 * half_bins)))
        kept = found[there, place : place + 2 * half_bins]
        found[there, place : place + 2 * half_bins] = np.maximum(kept, np.maximum(patch, 0).astype(np.uint8))
    return found


def rotated_radar_image(
    power: np.ndarray, azimuths: np.ndarray, turn: float, twist: Sequence[float], settings: PairSettings
) -> np.ndarray:
    """Create the radar image of `rol.pairs.build_pair` from a scan with rotated surroundings.

    Parameters
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        The scan in half-dB steps, and counter-clockwise bearings of its rows [rad].
    turn : float
        Counter-clockwise rotation [rad].
    twist : sequence of float
        Body velocity (vx, vy, yaw rate) before the rotation [m/s, m/s, rad/s].
    settings : PairSettings
        Settings of the image.

    Returns
    -------
    image : array, shape (width, width), uint8
        Power 0..255.
    """
    c, s = np.cos(turn), np.sin(turn)
    vx, vy, rate = twist
    rotated = (c * vx - s * vy, s * vx + c * vy, rate)
    return radar_to_image(power, azimuths + turn, rotated, settings)


def gather_clouds(
    session: Session,
    aligned: Sequence[AlignedScan],
    path: str | Path,
    settings: PairSettings,
    *,
    workers: int = 1,
    report: Callable[[str], None] = lambda line: None,
) -> LidarClouds:
    """Read the lidar points of many scans once and keep them in a compact file.

    Parameters
    ----------
    session : Session
        The session.
    aligned : sequence of AlignedScan
        The scans.
    path : path
        File for the points, ``*.npz``; read instead if it exists with these scans and settings.
    settings : PairSettings
        ``motion``, ``min_height`` and ``max_range`` are used.
    workers : int
        Processes.
    report : callable
        Takes a line about the progress.

    Returns
    -------
    clouds : LidarClouds
        In the order of the scans.

    Raises
    ------
    ValueError
        If there is a file that `gather_clouds` did not write or that is not whole; the message names it.
    """
    path, about = Path(path), repr((settings, list(aligned)))
    if path.is_file():
        kept, points, starts = _read_clouds(path)
        if kept == about:
            return LidarClouds(points, starts)
    tasks, parts = [(session, one, settings) for one in aligned], []
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for part in pool.map(_gather_one, tasks, chunksize=8):
            parts.append(part)
            if len(parts) % 500 == 0:
                report(f"{session.name}: lidar points of {len(parts)} of {len(aligned)} scans")
    clouds = LidarClouds(np.concatenate(parts), np.cumsum([0, *map(len, parts)]))
    content = BytesIO()
    np.savez_compressed(content, points=clouds.points, starts=clouds.starts, about=about)
    write_bytes(path, content.getvalue())
    return clouds


def _read_clouds(path: Path) -> tuple[str, np.ndarray, np.ndarray]:
    """Read a file of `gather_clouds`: its scans and settings, points, and starts; refuse any other file."""
    try:
        with open(path, "rb") as file, np.load(file) as content:
            return str(content["about"]), content["points"], content["starts"]
    except (KeyError, TypeError, ValueError, EOFError, OSError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: not a whole file of lidar points ({error}); delete it") from error


def _gather_one(task: tuple[Session, AlignedScan, PairSettings]) -> np.ndarray:
    session, one, settings = task
    twist = one.twist if settings.motion == "corrected" else None
    sweeps = one.left_stamp_us, one.right_stamp_us
    points = load_lidar_points(session, *sweeps, mid_stamp_us=one.mid_stamp_us, twist=twist)
    points = crop_range(remove_ground(points, settings.min_height), settings.max_range + 0.25)
    return np.unique(np.rint(points[:, :2] / STEP_M).astype(np.int16), axis=0)


class JoinedPairs:
    """Concatenation of several sets of pairs.

    Parameters
    ----------
    parts : sequence
        Sets with `__len__`, `__getitem__`, `draw` and `name`, such as `ScanPairs`.
    """

    def __init__(self, parts: Sequence[Any]) -> None:
        self.parts, self.ends = list(parts), np.cumsum([len(part) for part in parts])

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def _find(self, index: int) -> tuple[Any, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        part = int(np.searchsorted(self.ends, index, side="right"))
        return self.parts[part], index - int(self.ends[part] - len(self.parts[part]))

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a pair as it was recorded."""
        part, place = self._find(index)
        return part[place]

    def draw(self, index: int, *changes: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return a pair with the changes that `ScanPairs.draw` names: turn, gain, streaks and ghosts."""
        part, place = self._find(index)
        return part.draw(place, *changes)

    def name(self, index: int) -> str:
        """Return the path of the scan of a pair."""
        part, place = self._find(index)
        return part.name(place)
