"""Pair radar scans with lidar sweeps: association in time, aligned images, and folders of images.

A pair is a radar image and a lidar image, both uint8 with the sensor in the middle: row 0 farthest forward,
column 0 farthest left, pixel centres. A folder of pairs holds ``radar/<us>.png`` and ``lidar/<us>.png``,
named by the radar's stamp, ``settings.json`` from the start and ``pairs.json`` once all pairs are there. A
folder of generated lidar images holds ``<us>.png`` and ``fake.json`` in the same way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

if __package__:
    from .bev import image_to_points, normalize_image, points_to_image
    from .files import ImageFolder, write_bytes
    from .geometry import check_fields, log
    from .lidar import crop_range, relate_sensors, remove_ground, sweep_to_radar
    from .oxford import EXTRINSICS, RadarOdometry, Session, load_radar, load_sweep
    from .radar import (
        DOPPLER_SECONDS,
        MEASURED,
        RangeCalibration,
        ScanMotion,
        compensate_points,
        deskew_points,
        polar_to_cartesian,
    )
else:  # this file was copied and is imported by its own name
    from bev import image_to_points, normalize_image, points_to_image
    from files import ImageFolder, write_bytes
    from geometry import check_fields, log
    from lidar import crop_range, relate_sensors, remove_ground, sweep_to_radar
    from oxford import EXTRINSICS, RadarOdometry, Session, load_radar, load_sweep
    from radar import (
        DOPPLER_SECONDS,
        MEASURED,
        RangeCalibration,
        ScanMotion,
        compensate_points,
        deskew_points,
        polar_to_cartesian,
    )

FORMAT = 2  # of the pairs; raise it when the same settings give other images
SIDES = ("radar", "lidar")
MOTIONS = ("none", "corrected")


# ---- association in time ----


def associate_nearest(
    stamps_us: np.ndarray, other_stamps_us: np.ndarray, max_gap_us: int = 50_000
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest other time for every time.

    Parameters
    ----------
    stamps_us : array, shape (n,)
        Query times [us].
    other_stamps_us : array, shape (m,)
        Strictly increasing times to choose from [us].
    max_gap_us : int
        Larger gaps are no match [us].

    Returns
    -------
    index : array, shape (n,), int64
        Index of the nearest other time, the earlier of two equally near; -1 where the gap is too large.
    gap_us : array, shape (n,), int64
        Nearest other time minus own time, also for those without a match [us].

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


def estimate_twists(odometry: RadarOdometry) -> np.ndarray:
    """Estimate the radar's velocity at every scan from the odometry increments.

    Parameters
    ----------
    odometry : RadarOdometry
        ``increments`` (n, 3) [m, m, rad] and the mid-scan times ``destination_stamps_us`` and
        ``source_stamps_us`` (n,) [us].

    Returns
    -------
    twists : array, shape (n + 1, 3)
        Body velocity (vx, vy, yaw rate) at each scan [m/s, m/s, rad/s]: between two increments the mean,
        weighted so that it holds at the scan itself; at the ends that of the one increment.

    Raises
    ------
    ValueError
        If there is no increment, one takes no time, or they are not consecutive.
    """
    increments = np.asarray(odometry.increments, dtype=np.float64)
    later, earlier = np.asarray(odometry.source_stamps_us), np.asarray(odometry.destination_stamps_us)
    if len(increments) == 0:
        raise ValueError("odometry: no increment to take a velocity from")
    if (later <= earlier).any() or (later[:-1] != earlier[1:]).any():
        raise ValueError("odometry: increments do not form one chain forward in time")
    seconds = (later - earlier) / 1e6
    rates = log(increments) / seconds[:, None]
    weight = (seconds[1:] / (seconds[:-1] + seconds[1:]))[:, None]
    return np.concatenate([rates[:1], weight * rates[:-1] + (1.0 - weight) * rates[1:], rates[-1:]])


def usable_stamps(session: Session, sensor: str) -> np.ndarray:
    """List the frames of a sensor that can be read: listed, not flagged 0, with a file.

    Parameters
    ----------
    session : Session
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


def usable_sweeps(session: Session) -> dict[str, np.ndarray]:
    """List the usable sweeps of the lidars that a session has.

    Parameters
    ----------
    session : Session
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
    """Find the sweeps of every scan; scans without a sweep of each lidar are left out.

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
        If no lidar or an unknown one is given, or no scan has its sweeps within `max_gap_us`; the message
        gives the smallest gap of each lidar.

    Notes
    -----
    Yin et al. 2020, Sec. III-A, is "none".
    """
    _check_motion(motion)
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


# ---- aligned pairs ----


@dataclass(frozen=True)
class AlignedScan:
    """A radar scan with the sweeps that belong to it.

    Attributes
    ----------
    radar_stamp_us : int
        Stamp of the scan [us].
    left_stamp_us, right_stamp_us : int or None
        Stamps of the two sweeps [us]; None for a lidar that the session does not have.
    mid_stamp_us : int, optional
        Time of mid-scan [us]; 125 ms after the scan's stamp if not given.
    twist : tuple of float, optional
        Body velocity of the radar [m/s, m/s, rad/s]; needed for motion compensation.
    """

    radar_stamp_us: int
    left_stamp_us: int | None
    right_stamp_us: int | None
    mid_stamp_us: int | None = None
    twist: tuple[float, float, float] | None = None

    @classmethod
    def from_row(cls, row: Any) -> AlignedScan:
        """Read a row (mapping) with the columns of `align_scans`."""
        lidars = [row[name] if (name := f"{side}_stamp_us") in row else None for side in ("left", "right")]
        lidars = [None if stamp is None else int(stamp) for stamp in lidars]
        twist = tuple(float(row[name]) for name in ("vx_mps", "vy_mps", "yaw_rate_radps"))
        return cls(int(row["radar_stamp_us"]), *lidars, int(row["mid_stamp_us"]), twist)


@dataclass(frozen=True)
class PairSettings:
    """Settings of pairs of images.

    Attributes
    ----------
    motion : str
        "none" takes scan and sweeps as they are, as the paper does; "corrected" brings both to mid-scan and
        corrects the Doppler shift.
    range_resolution, range_offset : float
        Length of a bin and offset of all ranges of the radar [m].
    doppler_seconds : float
        Ranges read nearer by this time multiplied by the closing speed [s]; used with "corrected".
    min_height, max_range : float
        Lowest z and largest range of the lidar points kept, in the radar frame [m].
    width, pixel_size : int, float
        Pixels along an edge, and the edge of a pixel [m].

    Raises
    ------
    ValueError
        If the motion is unknown or a value is out of its range; the message names it.
    """

    motion: str = "none"
    range_resolution: float = MEASURED.resolution_m
    range_offset: float = MEASURED.offset_m
    doppler_seconds: float = DOPPLER_SECONDS
    min_height: float = -1.5
    max_range: float = 64.0
    width: int = 512
    pixel_size: float = 0.25

    def __post_init__(self) -> None:
        _check_motion(self.motion)
        allowed = {
            "(0, inf)": "range_resolution pixel_size",
            "(0, inf]": "max_range",
            "(-inf, inf)": "range_offset doppler_seconds",
            "[-inf, inf)": "min_height",
            "[1, inf)": "width",
        }
        check_fields(self, allowed)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> PairSettings:
        """Take the settings that a dict holds, such as the header of weights; the others get defaults."""
        return cls(**{field.name: values[field.name] for field in fields(cls) if field.name in values})


def load_lidar_points(
    session: Session,
    left_stamp_us: int | None,
    right_stamp_us: int | None,
    *,
    mid_stamp_us: int | None = None,
    twist: np.ndarray | Sequence[float] | None = None,
) -> np.ndarray:
    """Load one sweep of each lidar and transform them into the radar frame.

    Parameters
    ----------
    session : Session
        The session.
    left_stamp_us, right_stamp_us : int or None
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
    if twist is not None and mid_stamp_us is None:
        raise ValueError("a twist needs mid_stamp_us, the time to move the points to")
    stamps = {"velodyne_left": left_stamp_us, "velodyne_right": right_stamp_us}
    sweeps = [(sensor, stamp) for sensor, stamp in stamps.items() if stamp is not None]
    if not sweeps:
        raise ValueError(f"{session.name}: left_stamp_us and right_stamp_us are None; one lidar is needed")
    clouds = []
    for sensor, stamp in sweeps:
        points, stamps_us = load_sweep(session, sensor, int(stamp))
        points = sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[sensor]))
        if twist is not None:
            points[:, :3] = deskew_points(points[:, :3], (stamps_us - int(mid_stamp_us)) / 1e6, twist)
        clouds.append(points)
    return np.concatenate(clouds)


def radar_to_image(
    power: np.ndarray,
    azimuths: np.ndarray,
    twist: np.ndarray | Sequence[float] | None,
    settings: PairSettings,
) -> np.ndarray:
    """Resample a polar scan into the radar image of a pair.

    Parameters
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        The scan, as in `rol.radar.polar_to_cartesian`.
    twist : array-like, shape (3,), or None
        Body velocity [m/s, m/s, rad/s], used with motion "corrected".
    settings : PairSettings
        Settings of the image.

    Returns
    -------
    image : array, shape (width, width), uint8
        Power 0..255.

    Raises
    ------
    ValueError
        If the motion is "corrected" and there is no twist.
    """
    if settings.motion == "corrected" and twist is None:
        raise ValueError("motion 'corrected' needs a twist")
    is_corrected = settings.motion == "corrected"
    image = polar_to_cartesian(
        power,
        azimuths,
        calibration=RangeCalibration(settings.range_resolution, settings.range_offset),
        pixel_size=settings.pixel_size,
        width=settings.width,
        motion=ScanMotion(twist, doppler_seconds=settings.doppler_seconds) if is_corrected else None,
    )
    return np.rint(image * 255.0).astype(np.uint8)


def build_pair(
    session: Session, aligned: AlignedScan, settings: PairSettings | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Build the aligned radar and lidar image of one scan.

    Parameters
    ----------
    session : Session
        The session.
    aligned : AlignedScan
        The scan and its sweeps.
    settings : PairSettings, optional
        Settings of the images; the defaults if not given.

    Returns
    -------
    radar_image, lidar_image : array, shape (width, width), uint8
        Power 0..255, and occupancy 0 or 255.

    Raises
    ------
    ValueError
        If the motion is "corrected" and there is no twist.

    Notes
    -----
    Yin et al. 2020, Sec. III-A; the paper does not compensate motion ("none").
    """
    settings = settings or PairSettings()
    scan = load_radar(session.radar_path(aligned.radar_stamp_us))
    radar_image = radar_to_image(scan.power, scan.azimuths, aligned.twist, settings)
    mid_us = aligned.radar_stamp_us + 125_000 if aligned.mid_stamp_us is None else aligned.mid_stamp_us
    twist = aligned.twist if settings.motion == "corrected" else None
    sweeps = aligned.left_stamp_us, aligned.right_stamp_us
    points = load_lidar_points(session, *sweeps, mid_stamp_us=mid_us, twist=twist)
    points = crop_range(remove_ground(points, settings.min_height), settings.max_range)
    size = {name: getattr(settings, name) for name in ("width", "pixel_size", "max_range")}
    return radar_image, points_to_image(points, **size)


# ---- folders of images ----


def pair_folder(folder: str | Path) -> ImageFolder:
    """Return the folder of the pairs of one session."""
    return ImageFolder(folder, "pairs.json", SIDES)


def generated_folder(folder: str | Path) -> ImageFolder:
    """Return the folder of the generated lidar images of one session."""
    return ImageFolder(folder, "fake.json")


def save_image(path: str | Path, image: np.ndarray) -> None:
    """Write a grey image (h, w), uint8, as PNG, whole or not at all."""
    if image.dtype != np.uint8 or image.ndim != 2:
        raise ValueError(f"{path}: expected a uint8 image (h, w), got {image.dtype} {image.shape}")
    write_bytes(path, cv2.imencode(".png", image)[1].tobytes())


def read_image(path: str | Path) -> np.ndarray:
    """Read a grey PNG.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    image : array, shape (h, w), uint8
        The image.

    Raises
    ------
    ValueError
        If the file is missing or holds no grey image of 8 bits; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: the image is missing")
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"{path}: not a readable grey image of 8 bits")
    return image


def save_pair(folder: str | Path, stamp_us: int, radar_image: np.ndarray, lidar_image: np.ndarray) -> None:
    """Write both images (h, w), uint8, of the pair of a radar stamp [us] into a folder of pairs."""
    for side, image in zip(SIDES, (radar_image, lidar_image), strict=True):
        save_image(pair_folder(folder).path(stamp_us, side), image)


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
    paths = [pair_folder(folder).path(stamp_us, side) for side in SIDES]
    radar_image, lidar_image = (read_image(path) for path in paths)
    if radar_image.shape != lidar_image.shape:
        raise ValueError(f"{paths[1]}: lidar image {lidar_image.shape}, radar image {radar_image.shape}")
    return radar_image, lidar_image


def describe_pairs(session: Session, alignment_path: str | Path, settings: PairSettings) -> dict[str, Any]:
    """Collect everything that the pairs of a session depend on.

    Parameters
    ----------
    session : Session
        The session.
    alignment_path : path
        Its ``alignment.csv``.
    settings : PairSettings
        Settings of the images.

    Returns
    -------
    description : dict
        The settings, `FORMAT`, the session's name, and digests of the alignment and of ``session.json``
        (where there is one); JSON values only.
    """
    files, digests = {"made": session.root / "session.json", "alignment": Path(alignment_path)}, {}
    for name, path in files.items():
        data = path.read_bytes() if path.is_file() else b""
        digests[f"{name}_digest"] = hashlib.sha256(data).hexdigest()[:16]
    return {**asdict(settings), "format": FORMAT, "session": session.name, **digests}


def write_pairs(
    session: Session,
    folder: str | Path,
    aligned: Sequence[AlignedScan],
    settings: PairSettings | None = None,
    workers: int = 1,
) -> Iterator[int]:
    """Build and save pairs, in several processes if asked for.

    Parameters
    ----------
    session : Session
        The session.
    folder : path
        Folder of its pairs.
    aligned : sequence of AlignedScan
        The scans.
    settings : PairSettings, optional
        Settings of the images; the defaults if not given.
    workers : int
        Processes.

    Yields
    ------
    stamp_us : int
        Radar stamp of each pair written, in the order of the scans [us].
    """
    tasks = ((session, folder, one, settings) for one in aligned)
    if workers <= 1:
        yield from map(_write_one, tasks)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_write_one, tasks, chunksize=4)


def list_pairs(folder: str | Path) -> list[int]:
    """List the radar stamps of a complete folder of pairs, see `rol.files.ImageFolder.read`.

    Parameters
    ----------
    folder : path
        Folder of the pairs of one session.

    Returns
    -------
    stamps_us : list of int
        Radar stamps in the order of time [us].
    """
    return pair_folder(folder).read()["stamps_us"]


def read_points(
    folder: str | Path, stamps_us: Sequence[int], twists: Sequence[Sequence[float]] | None = None
) -> Iterator[np.ndarray]:
    """Read the generated points of scans, one scan after the other.

    Parameters
    ----------
    folder : path
        Complete folder of the generated images of one session. Its ``fake.json`` holds under ``points`` the
        arguments of `rol.bev.image_to_points`.
    stamps_us : sequence of int
        Radar stamps of the scans [us].
    twists : sequence of (vx, vy, yaw rate), optional
        Body velocity in each scan [m/s, m/s, rad/s]. With it points are moved to mid-scan, see
        `rol.radar.compensate_points`; points of motion-compensated images are left where they are.

    Yields
    ------
    points : array, shape (n, 2)
        Points in the radar frame [m].

    Raises
    ------
    ValueError
        If the folder is not complete or an image cannot be read; the message names the file.
    """
    images = generated_folder(folder)
    about = images.read()
    if "points" not in about:
        raise ValueError(f"{Path(folder) / images.listing}: the key 'points' is missing")
    if twists is None or about["settings"].get("pairs", {}).get("motion") == "corrected":
        twists = [None] * len(stamps_us)
    for stamp, twist in zip(stamps_us, twists, strict=True):
        points = image_to_points(read_image(images.path(stamp)), **about["points"])
        yield points if twist is None else compensate_points(points, ScanMotion(twist))


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
        """Return the path of the radar image of a pair."""
        return str(pair_folder(self.folder).path(self.stamps_us[index], "radar"))

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return radar and lidar image, float32 (1, h, w), -1 for grey value 0 and +1 for 255."""
        radar, lidar = load_pair(self.folder, self.stamps_us[index])
        return normalize_image(radar[None]), normalize_image(lidar[None])


def _write_one(task: tuple[Session, str | Path, AlignedScan, PairSettings | None]) -> int:
    session, folder, aligned, settings = task
    save_pair(folder, aligned.radar_stamp_us, *build_pair(session, aligned, settings))
    return aligned.radar_stamp_us


def _check_motion(motion: str) -> None:
    """Check the name of a treatment of motion."""
    if motion not in MOTIONS:
        raise ValueError(f"motion must be 'none' or 'corrected', not {motion!r}")
