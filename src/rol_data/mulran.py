"""Read MulRan (Kim et al. 2020): polar scans of a Navtech CIR204-H, keyframe clouds of an Ouster OS1-64,
and calibration.

The form of the scans is Oxford's with other numbers: 3360 bins, times in nanoseconds. Two scans of KAIST03
come with sparolab/referee and 21 keyframe clouds of the same drive with gisbi-kim/SC-A-LOAM; RaLL has a map
and poses of the place. Frames: x forward, y left, z up [m], except for the lidar, which faces backward.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rol.files import read_text
from rol.geometry import transform_from_euler
from rol.oxford import COUNTS_PER_TURN
from rol_data import rall

os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # it prints when it is imported

SCANS_PATH = Path("referee/cpp/examples")  # this and the others: below the folder of the real data
KEYFRAMES_PATH = Path("SC-A-LOAM/utils/sample_data/KAIST03")
KAIST_MAP_PATH = Path("RaLL/data/maps/MulRan/png/laser_map_kaist.png")
KAIST_POSES_PATH = Path("RaLL/data/gt_poses/MulRan/pose_kaist_03.txt")
KAIST_SHAPE, KAIST_CORNER = (4000, 4000), (500.0, 200.0)  # as `rol_data.rall.MAP_SHAPE` and `MAP_CORNER`
N_AZIMUTHS, N_BINS, N_HEADER = 400, 3360, 11
RANGE_RESOLUTION = 0.0595238  # length of a bin [m], as the data set states it: 200 m / 3360
MAX_TURN_NS = 500_000_000
# Pose of radar and lidar in the vehicle, x y z [m] roll pitch yaw [rad], as the data set states them.
RADAR_EXTRINSICS = (1.50, -0.04, 1.97, 0.0, 0.0, float(np.deg2rad(0.9)))
LIDAR_EXTRINSICS = (1.7042, -0.021, 1.8047, *(float(np.deg2rad(v)) for v in (0.0001, 0.0003, 179.6654)))


class MulranError(ValueError):
    """Raised for a file of MulRan that is missing or not what it should be; names file and fault."""


@dataclass(frozen=True, eq=False)
class MulranScan:
    """One turn of the radar.

    Attributes
    ----------
    path : Path
        The file.
    row_stamps_ns : array, shape (400,), int64
        Time of each row [ns].
    power, azimuths : array, shape (400, 3360) and (400,)
        Power in half-dB steps, and counter-clockwise bearings of the rows, decreasing [rad].
    """

    path: Path
    row_stamps_ns: np.ndarray
    power: np.ndarray
    azimuths: np.ndarray


def load_scan(path: Path | str) -> MulranScan:
    """Read one radar scan.

    Parameters
    ----------
    path : path
        8-bit grey PNG of 400 rows and 3371 columns: time in ns (8 bytes), encoder count (2), flag (1), 3360
        bins.

    Returns
    -------
    scan : MulranScan

    Raises
    ------
    MulranError
        If the file is missing, no such image, or has no header: times that are not those of one turn, or
        counts that do not go once around.
    """
    path = Path(path)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise MulranError(f"{path}: missing or not an image")
    shape = (N_AZIMUTHS, N_HEADER + N_BINS)
    if image.shape != shape or image.dtype != np.uint8:
        is_bare = image.shape == (N_AZIMUTHS, N_BINS)
        hint = "; the 11 columns of the header are missing" if is_bare else ""
        raise MulranError(f"{path}: expected a grey image of {shape}, got {image.dtype} {image.shape}{hint}")
    stamps = np.ascontiguousarray(image[:, :8]).view("<i8").ravel()
    counts = np.ascontiguousarray(image[:, 8:10]).view("<u2").ravel().astype(np.int64)
    steps = np.diff(counts) % COUNTS_PER_TURN
    if (
        (np.diff(stamps) < 0).any()
        or stamps[0] <= 0
        or not 0 < int(stamps[-1]) - int(stamps[0]) < MAX_TURN_NS
    ):
        raise MulranError(
            f"{path}: no header: the row times {stamps[0]} .. {stamps[-1]} ns are not those of one turn"
        )
    if counts.max() >= COUNTS_PER_TURN or (steps == 0).any() or steps.sum() >= COUNTS_PER_TURN:
        raise MulranError(f"{path}: no header: the encoder counts do not go clockwise once around")
    power = np.ascontiguousarray(image[:, N_HEADER:])
    if not power.any():
        raise MulranError(f"{path}: holds no power")
    azimuths = -2.0 * np.pi / COUNTS_PER_TURN * np.cumsum(np.concatenate([counts[:1], steps]))
    return MulranScan(path, stamps, power, azimuths)


def load_scans(real_root: Path | str) -> list[MulranScan]:
    """Read all scans below the folder of the real data, in the order of time; none if it holds none."""
    paths = sorted((Path(real_root) / SCANS_PATH).glob("[!.]*.png"))
    return sorted((load_scan(path) for path in paths), key=lambda scan: int(scan.row_stamps_ns[0]))


def load_keyframes(real_root: Path | str) -> tuple[np.ndarray, list[Path]]:
    """List the keyframe clouds and their times.

    Parameters
    ----------
    real_root : path
        Folder of the real data.

    Returns
    -------
    seconds : array, shape (n,)
        Times of the keyframes whose clouds are there [s].
    paths : list of Path
        Their clouds.

    Raises
    ------
    MulranError
        If the list of times is missing or at fault, a cloud has no time, or there is no cloud.
    """
    folder = Path(real_root) / KEYFRAMES_PATH
    listing = folder / "times.txt"
    if not listing.is_file():
        raise MulranError(f"{listing}: missing")
    try:
        seconds = np.array([float(line) for line in read_text(listing, MulranError).split()])
    except ValueError as error:
        raise MulranError(f"{listing}: not a list of times ({error})") from error
    paths = sorted((folder / "Scans").glob("[!.]*.pcd"))
    if not paths:
        raise MulranError(f"{folder / 'Scans'}: holds no cloud")
    numbers = [int(path.stem) if path.stem.isdecimal() else -1 for path in paths]
    for path, number in zip(paths, numbers, strict=True):
        if not 0 <= number < len(seconds):
            raise MulranError(f"{path}: has no time in {listing}")
    return seconds[numbers], paths


def load_cloud(path: Path | str) -> np.ndarray:
    """Read a keyframe cloud in the lidar frame.

    Parameters
    ----------
    path : path
        A `.pcd`.

    Returns
    -------
    points : array, shape (n, 3)
        Points in the lidar frame, which faces backward [m].

    Raises
    ------
    MulranError
        If the file is missing, truncated or holds no points.
    """
    import open3d

    path = Path(path)
    if not path.is_file():
        raise MulranError(f"{path}: missing")
    if not _is_whole(path.read_bytes()):  # Open3D would fill up what is missing
        raise MulranError(f"{path}: truncated, or no cloud")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        points = np.asarray(open3d.io.read_point_cloud(str(path), format="pcd").points)
    if len(points) == 0 or not np.isfinite(points).all():
        raise MulranError(f"{path}: holds no points, or not finite ones")
    return points


def _is_whole(content: bytes) -> bool:
    """Check whether a .pcd holds as many points as its header states."""
    head, _, rest = content.partition(b"\nDATA ")
    kind, _, body = rest.partition(b"\n")
    stated = {name: values for name, *values in map(bytes.split, head.splitlines()) if values}
    try:
        (n,) = map(int, stated[b"POINTS"])
        counts = stated.get(b"COUNT", [b"1"] * len(stated[b"SIZE"]))
        size = sum(int(a) * int(b) for a, b in zip(stated[b"SIZE"], counts, strict=True))
    except (KeyError, ValueError):
        return False
    if kind.strip() == b"ascii":
        return len(body.splitlines()) >= n
    if kind.strip() == b"binary_compressed":
        return len(body) >= 8 + int.from_bytes(body[:4], "little")
    return len(body) >= n * size


def radar_from_lidar() -> np.ndarray:
    """Compute the pose of the lidar in the radar frame from the calibration, shape (4, 4)."""
    radar, lidar = (transform_from_euler(*values) for values in (RADAR_EXTRINSICS, LIDAR_EXTRINSICS))
    return np.linalg.inv(radar) @ lidar


def load_kaist_map(real_root: Path | str) -> np.ndarray:
    """Read RaLL's map of KAIST, shape (n, 2) [m]; a fault raises `rol_data.rall.RallError`."""
    points = rall.load_map_points(Path(real_root) / KAIST_MAP_PATH, KAIST_SHAPE)
    return points + (np.array(KAIST_CORNER) - rall.MAP_CORNER)
