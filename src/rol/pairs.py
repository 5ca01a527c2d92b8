"""The pairs room: which sweep belongs to which scan, one aligned pair of images, and pairs as files.

A pair is a radar image and a lidar image, both uint8 with the sensor in the middle (axes as in the bird's-eye
room: row 0 farthest forward, column 0 farthest left, pixel centres). On disk a folder holds
``radar/<us>.png`` and ``lidar/<us>.png``, named by the radar's stamp, ``settings.json`` from the start and
``pairs.json`` once all is there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

try:
    from .files import prepare_images, read_text, write_bytes, write_text
    from .geometry import log
except ImportError:  # this file was copied on its own
    from files import prepare_images, read_text, write_bytes, write_text
    from geometry import log

SIDES = ("radar", "lidar")


def associate_nearest(
    stamps_us: np.ndarray, other_stamps_us: np.ndarray, max_gap_us: int = 50_000
) -> tuple[np.ndarray, np.ndarray]:
    """Find for every time the nearest of some other times.

    Parameters
    ----------
    stamps_us : array, shape (n,)
        Times asked about [us].
    other_stamps_us : array, shape (m,)
        Strictly increasing times to choose from [us].
    max_gap_us : int
        Gaps above this are no match [us].

    Returns
    -------
    index : array, shape (n,), int64
        Index of the nearest other time, the earlier of two equally near; -1 where the gap is too large.
    gap_us : array, shape (n,), int64
        Nearest other time minus own time, given for the refused ones too [us].

    Raises
    ------
    ValueError
        If there is nothing to choose from or the other times do not increase.

    Notes
    -----
    Yin et al. 2020, Sec. III-A: "the nearest lidar scan of each radar by timestamps".
    """
    stamps, others = np.asarray(stamps_us, dtype=np.int64), np.asarray(other_stamps_us, dtype=np.int64)
    if len(others) == 0:
        raise ValueError("no other stamps to choose the nearest from")
    if (np.diff(others) <= 0).any():
        raise ValueError(f"other stamps do not increase at index {int(np.argmax(np.diff(others) <= 0)) + 1}")
    after = np.searchsorted(others, stamps).clip(1, max(len(others) - 1, 1))
    after = np.minimum(after, len(others) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(stamps - others[before] <= others[after] - stamps, before, after)
    gap_us = others[index] - stamps
    return np.where(np.abs(gap_us) <= max_gap_us, index, -1), gap_us


def estimate_twists(odometry: Any) -> np.ndarray:
    """Estimate the radar's velocity at every scan from the steps between scans.

    Parameters
    ----------
    odometry : rol.oxford.RadarOdometry
        ``steps`` (n, 3) with the later scan in the earlier one [m, m, rad] and the times of both at mid-scan,
        ``destination_stamps_us`` and ``source_stamps_us`` (n,) [us].

    Returns
    -------
    twists : array, shape (n + 1, 3)
        Body velocity (vx, vy, yaw rate) of each scan of the chain [m/s, m/s, rad/s]: between two steps the
        mean, weighted so that it holds at the scan itself, at the ends the one step there is.

    Raises
    ------
    ValueError
        If there is no step, a step takes no time, or the steps are not one chain.
    """
    steps = np.asarray(odometry.increments, dtype=np.float64)
    later, earlier = np.asarray(odometry.source_stamps_us), np.asarray(odometry.destination_stamps_us)
    if len(steps) == 0:
        raise ValueError("odometry: no step to take a velocity from")
    if (later <= earlier).any() or (later[:-1] != earlier[1:]).any():
        raise ValueError("odometry: steps do not form one chain forward in time")
    seconds = (later - earlier) / 1e6
    rates = log(steps) / seconds[:, None]
    weight = (seconds[1:] / (seconds[:-1] + seconds[1:]))[:, None]
    return np.concatenate([rates[:1], weight * rates[:-1] + (1.0 - weight) * rates[1:], rates[-1:]])


def job_of_row(row: Any) -> dict[str, Any]:
    """Turn a row of ``alignment.csv`` into the arguments of `build_pair` that change from pair to pair.

    Parameters
    ----------
    row : mapping
        Row with the columns of `rol.alignment.align_scans`.

    Returns
    -------
    job : dict
        ``radar_stamp``, ``left_stamp``, ``right_stamp``, ``mid_stamp_us`` [us] and ``twist`` [m/s, m/s,
        rad/s]. The stamp of a lidar that has no column is None.
    """
    job: dict[str, Any] = {"radar_stamp": int(row["radar_stamp_us"])}
    for name in ("left", "right"):
        job[f"{name}_stamp"] = int(row[f"{name}_stamp_us"]) if f"{name}_stamp_us" in row else None
    twist = tuple(float(row[name]) for name in ("vx_mps", "vy_mps", "yaw_rate_radps"))
    return {**job, "mid_stamp_us": int(row["mid_stamp_us"]), "twist": twist}


def load_lidar_points(
    session: Any,
    left_stamp: int | None,
    right_stamp: int | None,
    *,
    mid_stamp_us: int | None = None,
    twist: np.ndarray | Sequence[float] | None = None,
) -> np.ndarray:
    """Load one sweep of each lidar and transform them into the radar frame.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.
    left_stamp, right_stamp : int or None
        Stamps of the two sweeps [us]; None for a lidar that the session does not have.
    mid_stamp_us : int, optional
        Time at which the radar frame is meant; needed with a twist [us].
    twist : array-like, shape (3,), optional
        Body velocity of the radar. With it each point is moved from its own time to ``mid_stamp_us``.

    Returns
    -------
    points : array, shape (n, 4)
        x, y, z [m] and intensity of the sweeps in the radar frame, the left one first.

    Raises
    ------
    ValueError
        If there is a twist and no ``mid_stamp_us``, or no sweep of either lidar.
    """
    from .lidar import relate_sensors, sweep_to_radar
    from .oxford import EXTRINSICS, load_sweep
    from .radar import deskew_points

    if twist is not None and mid_stamp_us is None:
        raise ValueError("a twist needs mid_stamp_us, the time to move the points to")
    stamps = {"velodyne_left": left_stamp, "velodyne_right": right_stamp}
    sweeps = [(sensor, stamp) for sensor, stamp in stamps.items() if stamp is not None]
    if not sweeps:
        raise ValueError(f"{session.name}: left_stamp and right_stamp are None; one lidar is needed")
    clouds = []
    for sensor, stamp in sweeps:
        points, stamps_us = load_sweep(session, sensor, int(stamp))
        points = sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[sensor]))
        if twist is not None:
            points[:, :3] = deskew_points(points[:, :3], (stamps_us - int(mid_stamp_us)) / 1e6, twist)
        clouds.append(points)
    return np.concatenate(clouds)


def build_pair(
    session: Any,
    radar_stamp: int,
    left_stamp: int | None,
    right_stamp: int | None,
    *,
    motion: str = "none",
    mid_stamp_us: int | None = None,
    twist: np.ndarray | Sequence[float] | None = None,
    range_resolution: float = 0.0438,
    range_offset: float = -0.31,
    doppler_seconds: float = 0.049,
    min_height: float = -1.5,
    max_range: float = 64.0,
    width: int = 512,
    pixel_size: float = 0.25,
) -> tuple[np.ndarray, np.ndarray]:
    """Build the aligned radar and lidar image of one scan.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.
    radar_stamp, left_stamp, right_stamp : int
        Stamps of the scan and of its two sweeps [us]; None for a lidar that the session does not have.
    motion : str
        "none" takes scan and sweeps as they are; "corrected" brings both to mid-scan, the scan with its
        Doppler shift taken out.
    mid_stamp_us : int, optional
        Time of mid-scan [us]; 125 ms after the scan's stamp if not given.
    twist : array-like, shape (3,), optional
        Body velocity of the radar [m/s, m/s, rad/s]; "corrected" needs it.
    range_resolution, range_offset, doppler_seconds : float
        As in `rol.radar.polar_to_cartesian`.
    min_height, max_range : float
        Lowest z and largest range of the lidar points kept, in the radar frame [m].
    width, pixel_size : int, float
        Pixels along an edge, and the edge of a pixel [m].

    Returns
    -------
    radar_image, lidar_image : array, shape (width, width), uint8
        Power 0..255, and occupancy 0 or 255.

    Notes
    -----
    Yin et al. 2020, Sec. III-A; the paper corrects no motion ("none").
    """
    from .bev import points_to_image
    from .lidar import crop_range, remove_ground
    from .oxford import load_radar
    from .radar import RangeCalibration, ScanMotion, polar_to_cartesian

    if motion not in ("none", "corrected"):
        raise ValueError(f"motion must be 'none' or 'corrected', not {motion!r}")
    if motion == "corrected" and twist is None:
        raise ValueError("motion 'corrected' needs a twist")
    twist = twist if motion == "corrected" else None
    mid_stamp_us = int(radar_stamp) + 125_000 if mid_stamp_us is None else int(mid_stamp_us)
    scan = load_radar(session.radar_path(int(radar_stamp)))
    power = polar_to_cartesian(
        scan.power,
        scan.azimuths,
        calibration=RangeCalibration(range_resolution, range_offset),
        pixel_size=pixel_size,
        width=width,
        motion=None if twist is None else ScanMotion(twist, doppler_seconds=doppler_seconds),
    )
    points = load_lidar_points(session, left_stamp, right_stamp, mid_stamp_us=mid_stamp_us, twist=twist)
    points = crop_range(remove_ground(points, min_height), max_range)
    lidar_image = points_to_image(points, width=width, pixel_size=pixel_size, max_range=max_range)
    return np.rint(power * 255.0).astype(np.uint8), lidar_image


def save_pair(folder: str | Path, stamp_us: int, radar_image: np.ndarray, lidar_image: np.ndarray) -> None:
    """Write both images of a pair as PNG, each whole or not at all.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.
    stamp_us : int
        Stamp of the radar scan [us].
    radar_image, lidar_image : array, shape (h, w), uint8
        The images.
    """
    for side, image in zip(SIDES, (radar_image, lidar_image), strict=True):
        path = _image_path(folder, side, stamp_us)
        if image.dtype != np.uint8 or image.ndim != 2:
            raise ValueError(f"{path}: expected a uint8 image (h, w), got {image.dtype} {image.shape}")
        write_bytes(path, cv2.imencode(".png", image)[1].tobytes())


def load_pair(folder: str | Path, stamp_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Read both images of a pair.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.
    stamp_us : int
        Stamp of the radar scan [us].

    Returns
    -------
    radar_image, lidar_image : array, shape (h, w), uint8
        The images.

    Raises
    ------
    ValueError
        If a file is missing or no image, or if the two differ in size; the message names the file.
    """
    images = []
    for side in SIDES:
        path = _image_path(folder, side, stamp_us)
        if not path.is_file():
            raise ValueError(f"{path}: the {side} image of this pair is missing")
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        if image is None or image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"{path}: not a readable grey image of 8 bits")
        images.append(image)
    if images[0].shape != images[1].shape:
        raise ValueError(f"{path}: lidar image {images[1].shape}, radar image {images[0].shape}")
    return images[0], images[1]


def describe_pairs(session: Any, alignment_path: str | Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Put down everything that the pairs of a session depend on.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.
    alignment_path : path
        Its ``alignment.csv``.
    settings : dict
        Arguments of `build_pair` that are the same for all pairs.

    Returns
    -------
    description : dict
        The settings, the session's name, and digests of ``session.json`` (where there is one), of the
        alignment and of the code; JSON values only.
    """
    rooms = [Path(__file__).with_name(f"{name}.py") for name in ("oxford", "radar", "lidar", "bev", "pairs")]
    files = {"made": [session.root / "session.json"], "alignment": [Path(alignment_path)], "code": rooms}
    digests = {}
    for name, paths in files.items():
        data = b"".join(path.read_bytes() for path in paths if path.is_file())
        digests[f"{name}_digest"] = hashlib.sha256(data).hexdigest()[:16]
    return {**settings, "session": session.name, **digests}


def prepare_pairs(folder: str | Path, settings: dict[str, Any]) -> set[int]:
    """Prepare a folder for pairs of these settings and list those it already holds.

    Pairs made with other settings are removed.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session; made if absent.
    settings : dict
        Everything the images depend on, JSON values only.

    Returns
    -------
    stamps_us : set of int
        Radar stamps of pairs that are complete [us].

    Raises
    ------
    ValueError
        If the folder is not empty and was not prepared by this function; nothing is removed.
    """
    return prepare_images(folder, settings, SIDES, "pairs.json")


def write_pairs(
    session: Any,
    folder: str | Path,
    jobs: Sequence[dict[str, Any]],
    settings: dict[str, Any],
    workers: int = 1,
) -> Iterator[int]:
    """Build and save pairs one after the other, or in several processes.

    Parameters
    ----------
    session : rol.oxford.Session
        The session.
    folder : path
        Folder of its pairs.
    jobs : sequence of dict
        Per pair ``radar_stamp``, ``left_stamp``, ``right_stamp`` and what else of `build_pair` changes from
        pair to pair.
    settings : dict
        Arguments of `build_pair` that are the same for all.
    workers : int
        Processes.

    Yields
    ------
    stamp_us : int
        Radar stamp of each pair written, in the order of the jobs [us].
    """
    tasks = ((session, folder, {**settings, **job}) for job in jobs)
    if workers <= 1:
        yield from map(_write_one, tasks)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_write_one, tasks, chunksize=4)


def finish_pairs(folder: str | Path, settings: dict[str, Any], stamps_us: Sequence[int]) -> None:
    """Write ``pairs.json``, which makes a folder of pairs whole; every pair must be there.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.
    settings : dict
        As given to `prepare_pairs`.
    stamps_us : sequence of int
        Radar stamps in the order of time [us].
    """
    for stamp in stamps_us:
        for side in SIDES:
            if not _image_path(folder, side, stamp).is_file():
                raise ValueError(f"{_image_path(folder, side, stamp)}: missing, the pairs are not complete")
    text = json.dumps(
        {"settings": settings, "stamps_us": [int(s) for s in stamps_us]}, indent=1, sort_keys=True
    )
    write_text(Path(folder) / "pairs.json", text)


def list_pairs(folder: str | Path) -> list[int]:
    """List the radar stamps of a complete folder of pairs.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.

    Returns
    -------
    stamps_us : list of int
        Radar stamps in the order of time [us].

    Raises
    ------
    ValueError
        If ``pairs.json`` is missing or broken; the message names it.
    """
    path = Path(folder) / "pairs.json"
    if not path.is_file():
        raise ValueError(f"{path}: missing; chapter 03 writes it when all pairs of the session are there")
    try:
        return [int(stamp) for stamp in json.loads(read_text(path))["stamps_us"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a list of pairs ({error})") from error


class PairDataset:
    """Pairs of one session as arrays for training; a map-style data set for torch's loader, without torch.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.
    stamps_us : sequence of int, optional
        Radar stamps to use; all of the folder if not given [us].
    """

    def __init__(self, folder: str | Path, stamps_us: Sequence[int] | None = None) -> None:
        self.folder = Path(folder)
        there = list_pairs(folder)
        self.stamps_us = there if stamps_us is None else [int(stamp) for stamp in stamps_us]
        if not set(self.stamps_us) <= set(there):
            raise ValueError(f"{self.folder}: holds no pair {min(set(self.stamps_us) - set(there))}")

    def __len__(self) -> int:
        return len(self.stamps_us)

    def name(self, index: int) -> str:
        """Name the radar image of a pair."""
        return str(_image_path(self.folder, "radar", self.stamps_us[index]))

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Give radar and lidar image, float32 (1, h, w), -1 for code 0 and +1 for code 255."""
        images = load_pair(self.folder, self.stamps_us[index])
        radar, lidar = (
            image[None].astype(np.float32) / np.float32(127.5) - np.float32(1.0) for image in images
        )
        return radar, lidar


def _write_one(task: tuple[Any, str | Path, dict[str, Any]]) -> int:
    session, folder, arguments = task
    save_pair(folder, arguments["radar_stamp"], *build_pair(session, **arguments))
    return int(arguments["radar_stamp"])


def _image_path(folder: str | Path, side: str, stamp_us: int) -> Path:
    return Path(folder) / side / f"{int(stamp_us)}.png"
