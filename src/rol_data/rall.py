"""Read lidar maps, ground truth and radar odometry of Oxford and MulRan sessions, and single scans.

The paper's first author published them with a later work (Yin et al., "RaLL", T-ITS 2021), of the paper's own
sessions and of three places of MulRan (Kim et al., ICRA 2020), see `PLACES`. The files lie in a folder that
is called `real_root`, in the layout of the public repositories, see `data/README.md`. All poses are
(x, y, yaw) in the frame of the map [m, m, rad], y left, yaw counter-clockwise.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rol.files import read_text
from rol.geometry import log, relative_pose
from rol.oxford import RadarScan, compose_odometry, load_radar, load_radar_odometry
from rol.pairs import estimate_twists
from rol.radar import SDK, RangeCalibration

MAP_PATH = Path("RaLL/data/maps/RobotCar/png/oxford_laser_map.png")
POSES_PATH = Path("RaLL/data/gt_poses/RobotCar")
ODOMETRY_PATH = Path("RaLL/data/odom/RobotCar")
IMAGES_PATH = Path("RaLL/radar_scans")  # not in the repository, whose README links the images of session 02
SCANS_PATH = Path("RadarSLAMPy/data/tiny")
POSED_SCANS_PATH = Path("radar-localization/test")  # scans of session 01, whose ground truth is published
SESSION_01_PATH = Path("RadarSLAMPy/data/full_seq_1")  # official odometry of session 01
SCAN_POSES_PATH = Path("oxford_scan_map_poses.csv")  # in no public repository, so it comes with the book
MAP_CELL = 0.25  # side of a pixel of the map [m]
# Of the published image; x at the upper edge of the first row, y at the left edge of the first column [m].
MAP_SHAPE, MAP_CORNER = (8000, 8000), (1500.0, 800.0)
IMAGE_WIDTH, IMAGE_PIXEL = 512, 0.25  # of the radar images [pixels, m]
ROW_COUNTS = 13 + 14 * np.arange(400)  # encoder counts of a scan's rows


class RallError(ValueError):
    """Raised for a file of the real data that is missing or not what it should be; names file and fault."""


@dataclass(frozen=True)
class Place:
    """Files of one place: a lidar map, and sessions with ground truth and odometry.

    Attributes
    ----------
    map_path : Path
        Image of the map, 0.25 m per pixel.
    map_shape : tuple of int
        Its rows and columns.
    map_corner : tuple of float
        x at the upper edge of the first row, y at the left edge of the first column [m].
    poses, odometry : str
        Paths of a session's files, with its number for ``{}``.
    main_sessions : tuple of str
        Sessions that stand for the place when none is named; empty: all but the mapping session.
    mapping_session : str
        Session that the map was made from: its first pose is the origin of the map.
    """

    map_path: Path
    map_shape: tuple[int, int]
    map_corner: tuple[float, float]
    poses: str
    odometry: str
    main_sessions: tuple[str, ...] = ()
    mapping_session: str = "01"


def _mulran(name: str, shape: tuple[int, int], corner: tuple[float, float]) -> Place:
    """Describe a place of MulRan; the names of its odometry files are capitalized."""
    title = name.upper() if name == "dcc" else name.capitalize()
    path = Path(f"RaLL/data/maps/MulRan/png/laser_map_{name}.png")
    poses = f"RaLL/data/gt_poses/MulRan/pose_{name}_{{}}.txt"
    return Place(path, shape, corner, poses, f"RaLL/data/odom/MulRan/{title}{{}}_odom.txt")


PLACES = {
    "oxford": Place(
        MAP_PATH,
        MAP_SHAPE,
        MAP_CORNER,
        f"{POSES_PATH.as_posix()}/pose_xy_{{}}.txt",
        f"{ODOMETRY_PATH.as_posix()}/seq{{}}_odom.txt",
        main_sessions=("02", "07", "08", "10"),  # Seq01 to Seq04 of the paper
    ),
    "kaist": _mulran("kaist", (4000, 4000), (500.0, 200.0)),
    "dcc": _mulran("dcc", (3200, 3275), (600.0, 200.0)),
    "riverside": _mulran("riverside", (8800, 8800), (1800.0, 1100.0)),
}


def find_place(name: str) -> Place:
    """Look up a place by its name, one of `PLACES`; raises `RallError` for another name."""
    if name not in PLACES:
        raise RallError(f"place: {name!r} is unknown; there are {', '.join(PLACES)}")
    return PLACES[name]


@dataclass(frozen=True)
class RealScan:
    """A real radar scan whose pose on the real map is known.

    Attributes
    ----------
    path : Path
        The file.
    stamp_us : int
        Time of its first row [us].
    power, azimuths : array, shape (400, b) and (400,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    pose : array, shape (3,)
        Pose of the radar at mid-scan in the frame of the map [m, m, rad].
    twist : tuple of float, or None
        Body velocity [m/s, m/s, rad/s]; None if unknown.
    """

    path: Path
    stamp_us: int
    power: np.ndarray
    azimuths: np.ndarray
    pose: np.ndarray
    twist: tuple[float, float, float] | None


def real_folder(given: str | Path = "") -> Path:
    """Return the folder of the real data, whatever it holds.

    Parameters
    ----------
    given : path
        Folder of the real data; if empty, the environment variable ``ROL_REAL_ROOT``, else ``data/real``.

    Returns
    -------
    root : Path
        The folder; it may be missing.

    Raises
    ------
    RallError
        If a folder is given and does not exist.
    """
    if given and not Path(given).is_dir():
        raise RallError(f"real_root: there is no folder {given}")
    return Path(given or os.environ.get("ROL_REAL_ROOT") or "data/real")


def find_real_root(given: str | Path = "", place: str = "oxford") -> Path | None:
    """Find the folder of the real data, if it holds the lidar map of a place.

    Parameters
    ----------
    given : path
        As in `real_folder`, which may raise.
    place : str
        A name of `PLACES`.

    Returns
    -------
    root : Path or None
        The folder, or None if it does not hold the lidar map of the place.

    Raises
    ------
    RallError
        If a folder is given and does not exist, or the place is unknown.
    """
    root, map_path = real_folder(given), find_place(place).map_path
    return root if (root / map_path).is_file() else None


def find_scan_poses(real_root: Path | str) -> Path:
    """Find the file with the map poses of single scans: under `real_root`, else the one in `data`."""
    own = Path(real_root) / SCAN_POSES_PATH
    return own if own.is_file() else Path("data") / SCAN_POSES_PATH


def load_map(real_root: Path | str, place: str = "oxford") -> np.ndarray:
    """Read the lidar map of a place.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `find_real_root`.
    place : str
        One of `PLACES`.

    Returns
    -------
    points : array, shape (n, 2)
        See `load_map_points`.

    Raises
    ------
    RallError
        If the place is unknown, or the file is missing or faulty.
    """
    files = find_place(place)
    return load_map_points(Path(real_root, files.map_path), files.map_shape, files.map_corner)


def load_map_points(
    path: Path | str, shape: tuple[int, int] | None = None, corner: tuple[float, float] = MAP_CORNER
) -> np.ndarray:
    """Read a lidar map, an image of occupied cells.

    Parameters
    ----------
    path : path
        PNG of 0.25 m per pixel, zero for free, 255 for occupied; x points up and y to the left.
    shape : tuple of int, optional
        Rows and columns that the image must have, such as ``MAP_SHAPE``; any if not given.
    corner : tuple of float
        x at the upper edge of the first row, y at the left edge of the first column [m].

    Returns
    -------
    points : array, shape (n, 2)
        Centres of the occupied cells in the map frame [m].

    Raises
    ------
    RallError
        If the file is missing, no grey image, of another size, with other values, or empty.
    """
    path = Path(path)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise RallError(f"{path}: missing or not an image")
    if image.ndim != 2:
        raise RallError(f"{path}: expected one grey channel, got shape {image.shape}")
    if shape is not None and image.shape != shape:
        raise RallError(f"{path}: {image.shape} pixels instead of {shape}, so their places are not known")
    is_odd = (image != 0) & (image != 255)
    if is_odd.any():
        raise RallError(f"{path}: holds the value {image[is_odd][0]}; 0 is free and 255 occupied")
    rows, columns = np.nonzero(image)
    if len(rows) == 0:
        raise RallError(f"{path}: the map holds no occupied cell")
    x, y = corner
    return np.column_stack([x - MAP_CELL * (rows + 0.5), y - MAP_CELL * (columns + 0.5)])


def load_poses(path: Path | str) -> np.ndarray:
    """Read the ground truth of a session in the frame of the map.

    Parameters
    ----------
    path : path
        Such as `pose_xy_NN.txt`: x, y, yaw, one row per radar scan.

    Returns
    -------
    poses : array, shape (n, 3)
        Poses of the radar at mid-scan [m, m, rad].

    Raises
    ------
    RallError
        If the file is missing, or a row does not hold three finite numbers.
    """
    return _load_rows(path)


def load_odometry(path: Path | str) -> np.ndarray:
    """Read the authors' radar odometry, ICP between generated clouds.

    Parameters
    ----------
    path : path
        Such as `seqNN_odom.txt`: dx, dy, dyaw in the body frame; row i moves scan i to scan i + 1.

    Returns
    -------
    increments : array, shape (n, 3)
        Odometry increments [m, m, rad]. Some files hold one row more or fewer than there are increments
        between the poses, see `rol_study.oxford_route.match_increments`.

    Raises
    ------
    RallError
        If the file is missing, or a row does not hold three finite numbers.
    """
    return _load_rows(path)


def load_scan_poses(path: Path | str) -> dict[int, np.ndarray]:
    """Read the map poses of single radar scans.

    Parameters
    ----------
    path : path
        `oxford_scan_map_poses.csv`: timestamp_us, x_m, y_m, yaw_rad under a line of names.

    Returns
    -------
    poses : dict
        Time of the scan's first row [us] -> pose at mid-scan, shape (3,).

    Raises
    ------
    RallError
        If the file is missing or a row is at fault.
    """
    path, poses = Path(path), {}
    if not path.is_file():
        raise RallError(f"{path}: missing")
    lines = read_text(path, RallError).splitlines()
    if [word.strip() for word in lines[:1]] != ["timestamp_us,x_m,y_m,yaw_rad"]:
        raise RallError(f"{path}: columns are {','.join(lines[:1])!r}, expected timestamp_us,x_m,y_m,yaw_rad")
    for number, line in enumerate(lines[1:], start=2):
        words = line.split(",")
        try:
            poses[int(words[0])] = np.array([float(word) for word in words[1:4]])
        except ValueError as error:
            raise RallError(f"{path}: line {number}: {error}") from error
        if len(words) != 4 or not np.isfinite(poses[int(words[0])]).all():
            raise RallError(f"{path}: line {number}: expected timestamp_us,x_m,y_m,yaw_rad, all finite")
    return poses


def load_scans(real_root: Path | str) -> list[RealScan]:
    """Read all real radar scans with a known pose on the map.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `find_real_root`.

    Returns
    -------
    scans : list of RealScan
        In the order of time: every scan under ``RadarSLAMPy/data/tiny/radar`` with a row in
        ``oxford_scan_map_poses.csv``, see `find_scan_poses`. The velocity is that of the official odometry
        beside the scans; outside its span, that between the poses of neighbours less than a second away, if
        there is one.

    Raises
    ------
    RallError
        If the poses are missing or at fault, or none of the scans is there.
    rol.oxford.OxfordError
        If a scan or the odometry is at fault.
    """
    folder, poses = Path(real_root) / SCANS_PATH / "radar", load_scan_poses(find_scan_poses(real_root))
    paths = [path for stamp in sorted(poses) if (path := folder / f"{stamp}.png").is_file()]
    if not paths:
        raise RallError(f"{folder}: holds none of the {len(poses)} scans of {SCAN_POSES_PATH}")
    official = _official_twists(folder.parent / "gt" / "radar_odometry.csv")
    return _load_with_poses(paths, poses, {**_twists_between(poses), **official}, SCAN_POSES_PATH)


def load_posed_scans(real_root: Path | str) -> list[RealScan]:
    """Read the real radar scans of session 01, whose poses on the map are published.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `find_real_root`.

    Returns
    -------
    scans : list of RealScan
        Every scan under ``radar-localization/test`` in the order of time, none if there is none. Row i of
        ``pose_xy_01.txt`` is the pose of scan i of the official odometry, at mid-scan; the velocity is that
        of the official odometry.

    Raises
    ------
    RallError
        If a scan is not in the odometry or has no row in the ground truth; the message names both files and
        their lengths.
    rol.oxford.OxfordError
        If a scan or the odometry is at fault.
    """
    paths = sorted((Path(real_root) / POSED_SCANS_PATH).glob("[!.]*.png"))
    if not paths:
        return []
    odometry = Path(real_root) / SESSION_01_PATH / "gt" / "radar_odometry.csv"
    poses_path = Path(real_root) / POSES_PATH / "pose_xy_01.txt"
    stamps, truth = compose_odometry(load_radar_odometry(odometry))[0].tolist(), load_poses(poses_path)
    poses = dict(zip(stamps, truth, strict=False))
    known = f"the {len(stamps)} scans of {odometry} with the {len(truth)} poses of {poses_path}"
    return _load_with_poses(paths, poses, _official_twists(odometry), known)


def _load_with_poses(
    paths: Sequence[Path],
    poses: Mapping[int, np.ndarray],
    twists: Mapping[int, tuple[float, float, float]],
    known: Path | str,
) -> list[RealScan]:
    """Read scans and look up pose and velocity by their stamps; `known` names the list of the poses."""
    scans = []
    for path in paths:
        scan = load_radar(path)
        stamp = scan.stamp_us
        if stamp not in poses:
            raise RallError(f"{path}: the scan is not among {known}")
        scans.append(RealScan(path, stamp, scan.power, scan.azimuths, poses[stamp], twists.get(stamp)))
    return scans


@dataclass(frozen=True)
class RadarImages(Sequence):
    """Cartesian radar images of a session with their poses, read one by one.

    Image k is ``<k + 1>.png``, shape (512, 512), uint8: x points up and y to the left, 0.25 m per pixel,
    power in half-dB steps as the data set's SDK resamples it.

    Attributes
    ----------
    folder : Path
        Folder of the images.
    truth : array, shape (n, 3)
        Ground truth T_map_radar of each image [m, m, rad].
    """

    folder: Path
    truth: np.ndarray

    def __len__(self) -> int:
        return len(self.truth)

    def __getitem__(self, index: int) -> np.ndarray:
        """Read one image; raise `RallError` if it is broken."""
        path = self.folder / f"{range(len(self))[index] + 1}.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.shape != (IMAGE_WIDTH, IMAGE_WIDTH) or image.dtype != np.uint8:
            raise RallError(f"{path}: not a whole grey image of {IMAGE_WIDTH} x {IMAGE_WIDTH} pixels")
        return image


def load_radar_images(real_root: Path | str, number: str = "02") -> RadarImages:
    """Open the radar images of a session and check all names and sizes.

    Parameters
    ----------
    real_root : path
        Folder of the real data; the images are ``RaLL/radar_scans/seq<number>/<n>.png``, n from 1, one per
        row of ``pose_xy_<number>.txt``.
    number : str
        Session.

    Returns
    -------
    images : RadarImages
        No pixel is read yet.

    Raises
    ------
    RallError
        If the folder or the poses are missing, a number is missing, there are more images than poses, or an
        image has another size or is not grey with 8 bits.
    """
    folder = Path(real_root, IMAGES_PATH, f"seq{number}")
    truth = load_poses(Path(real_root, POSES_PATH, f"pose_xy_{number}.txt"))
    if not folder.is_dir():
        raise RallError(f"{folder}: missing; the README of the repository HuanYin94/RaLL links the images")
    found = {int(path.stem) for path in folder.glob("*.png") if path.stem.isdecimal()}
    missing = sorted(set(range(1, len(truth) + 1)) - found)
    if missing:
        raise RallError(
            f"{folder}: {len(missing)} of {len(truth)} images missing, the first: {missing[0]}.png"
        )
    if len(found) > len(truth):
        raise RallError(f"{folder}: {len(found)} images for the {len(truth)} poses of session {number}")
    for index in range(len(truth)):
        _check_image_header(folder / f"{index + 1}.png")
    return RadarImages(folder, truth)


def image_to_scan(image: np.ndarray, stamp_us: int, calibration: RangeCalibration = SDK) -> RadarScan:
    """Resample a radar image into the polar scan from which it was made.

    The networks of this book expect another range calibration and compensated motion; both are applied to
    polar scans.

    Parameters
    ----------
    image : array, shape (512, 512), uint8
        From `load_radar_images`.
    stamp_us : int
        Time of the scan's first row [us].
    calibration : RangeCalibration
        Range of the bins that the image was made with. The SDK's: the authors' odometry is 1.5 % short, as
        with this one.

    Returns
    -------
    scan : RadarScan
        400 rows at the angles of Oxford's radar, with bins up to the image's corners; 0 outside the image.
        All rows are flagged as interpolated. Bilinear; on the eleven real scans the points of the network
        `unet` hardly differ from those of the scans as recorded (`book/oxford.md`).
    """
    bearings = -2.0 * np.pi / 5600.0 * ROW_COUNTS[:, None]
    n_bins = int((IMAGE_WIDTH * IMAGE_PIXEL / np.sqrt(2.0) - calibration.offset_m) / calibration.resolution_m)
    ranges = (np.arange(n_bins) + 0.5) * calibration.resolution_m + calibration.offset_m
    middle = (IMAGE_WIDTH - 1) / 2.0
    columns, rows = (middle - ranges / IMAGE_PIXEL * f(bearings) for f in (np.sin, np.cos))
    power = cv2.remap(image, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    stamps = stamp_us + np.arange(len(ROW_COUNTS)) * 625  # a quarter of a second for a turn
    return RadarScan(stamps, ROW_COUNTS.astype(np.uint16), np.zeros(len(ROW_COUNTS), np.uint8), power)


def _check_image_header(path: Path) -> None:
    """Check size and kind of a radar image by the first 26 bytes of its file."""
    with path.open("rb") as file:
        head = file.read(26)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 26:
        raise RallError(f"{path}: not a PNG file")
    width, height = (int.from_bytes(head[k : k + 4], "big") for k in (16, 20))
    if (width, height) != (IMAGE_WIDTH, IMAGE_WIDTH):
        raise RallError(f"{path}: {width} x {height} pixels instead of {IMAGE_WIDTH} x {IMAGE_WIDTH}")
    if (head[24], head[25]) != (8, 0):
        raise RallError(f"{path}: not grey with 8 bits")


def group_scans(stamps_us: Sequence[int], max_gap_s: float = 1.0) -> list[list[int]]:
    """Divide scans into groups without a long gap in time.

    Parameters
    ----------
    stamps_us : sequence of int
        Times of the scans [us], in order.
    max_gap_s : float
        Largest gap between scans of one group [s].

    Returns
    -------
    groups : list of list of int
        Indices of the scans of each group, in the order of time; none is empty.

    Raises
    ------
    RallError
        If the times do not increase.
    """
    groups: list[list[int]] = []
    for i, stamp in enumerate(stamps_us):
        gap_us = stamp - stamps_us[i - 1] if i else 0
        if i and gap_us <= 0:
            raise RallError(f"scan {i}: its time does not come after that of the scan before")
        if i and gap_us <= max_gap_s * 1e6:
            groups[-1].append(i)
        else:
            groups.append([i])
    return groups


def _official_twists(path: Path) -> dict[int, tuple[float, float, float]]:
    """Estimate the velocities of the official odometry by stamp; none if it is missing or has gaps."""
    if not path.is_file():
        return {}
    odometry = load_radar_odometry(path)
    try:
        stamps, twists = compose_odometry(odometry)[0].tolist(), estimate_twists(odometry)
    except ValueError:
        return {}
    return {stamp: tuple(map(float, twist)) for stamp, twist in zip(stamps, twists, strict=True)}


def _twists_between(poses: dict[int, np.ndarray]) -> dict[int, tuple[float, float, float]]:
    """Estimate the velocity of scans from the poses of their neighbours less than a second away."""
    stamps, found = sorted(poses), {}
    for i, stamp in enumerate(stamps):
        near = [other for other in stamps[max(i - 1, 0) : i + 2] if abs(other - stamp) < 1_000_000]
        if len(near) > 1:
            seconds = (near[-1] - near[0]) * 1e-6
            twist = log(relative_pose(poses[near[0]], poses[near[-1]])) / seconds
            found[stamp] = tuple(float(value) for value in twist)
    return found


def _load_rows(path: Path | str) -> np.ndarray:
    path = Path(path)
    if not path.is_file():
        raise RallError(f"{path}: missing")
    try:
        rows = np.loadtxt(read_text(path).splitlines(), ndmin=2)
    except ValueError as error:
        raise RallError(f"{path}: not a table of numbers: {error}") from error
    if rows.ndim != 2 or rows.shape[1:] != (3,) or len(rows) == 0:
        raise RallError(f"{path}: expected rows of three numbers, got shape {rows.shape}")
    if not np.isfinite(rows).all():
        raise RallError(f"{path}: row {int(np.argwhere(~np.isfinite(rows))[0, 0]) + 1} is not finite")
    return rows
