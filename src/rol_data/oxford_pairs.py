"""Find real pairs: raw Oxford radar scans with lidar sweeps of the same moment,
in any layout below a folder.

Public repositories hold pieces of the data set in layouts of their own: scans in one folder, sweeps in
another, a list of stamps one level higher, one lidar instead of two. Files are recognized by their name
(16 digits, a stamp in microseconds) and by their form, and each sweep is assigned to a lidar by its folder or
by the list of stamps that names it. What belongs nowhere is left out and reported in `RealPairs.faults`; a
file that is damaged raises.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path

import numpy as np

from rol.lidar import relate_sensors, sweep_to_radar
from rol.oxford import (
    EXTRINSICS,
    FIRE_HEIGHT,
    LIDARS,
    N_AZIMUTHS,
    N_BINS,
    N_HEADER,
    N_LASERS,
    N_VELODYNE_ROWS,
    OxfordError,
    compose_odometry,
    load_radar_odometry,
    load_timestamps,
    load_velodyne_binary,
    load_velodyne_raw,
    velodyne_raw_to_points,
)
from rol.pairs import estimate_twists

SCAN_PATTERNS = ("**/[0-9]*.png",)
SWEEP_PATTERNS = ("**/[0-9]*.bin", "**/[0-9]*.png")
TURN_US = 250_000  # of the radar
MID_SCAN_US = 125_000  # from a scan's stamp to its middle, where no odometry gives it
SWEEP_SECONDS = 0.05  # one turn of the lidar
LASER_SPACING = 0.0232  # between the elevations of neighbouring lasers [rad]
STAMP_DIGITS = 16  # of a stamp in microseconds, years 2001 to 2286


@dataclass(frozen=True)
class Sweep:
    """A file with a lidar sweep.

    Attributes
    ----------
    path : Path
        The file, .png (raw, with the time of each firing) or .bin (without).
    lidar : str
        "velodyne_left" or "velodyne_right".
    stamp_us : int
        Its name [us].
    """

    path: Path
    lidar: str
    stamp_us: int


@dataclass(frozen=True, eq=False)
class PairedScan:
    """A file with a radar scan during whose turn sweeps were taken.

    Attributes
    ----------
    path : Path
        The file.
    stamp_us, mid_us : int
        Its name, the time of the first row, and mid-scan [us].
    twist : tuple of float, or None
        Body velocity [m/s, m/s, rad/s] by the official odometry beside the scans; None where that does not
        cover the scan.
    pose : array, shape (3,), or None
        Pose at mid-scan in the frame of that odometry [m, m, rad].
    odometry_path : Path or None
        The odometry's file.
    """

    path: Path
    stamp_us: int
    mid_us: int
    twist: tuple[float, float, float] | None
    pose: np.ndarray | None
    odometry_path: Path | None


@dataclass(frozen=True)
class RealPairs:
    """Real scans and sweeps that belong together.

    Attributes
    ----------
    scans : list of PairedScan
        Scans with at least one sweep inside their turn, in the order of time.
    sweeps : list of Sweep
        All sweeps that are listed (or in a folder without a list), in the order of time.
    faults : list of str
        One sentence for each thing left out, naming the file or folder.
    """

    scans: list[PairedScan]
    sweeps: list[Sweep]
    faults: list[str]

    def turn(self, scan: PairedScan) -> list[Sweep]:
        """List the sweeps whose stamps lie inside the turn of a scan, of all lidars."""
        return self._between(scan.stamp_us, scan.stamp_us + TURN_US)

    def nearest(self, time_us: int, max_gap_us: int = 50_000) -> list[Sweep]:
        """List the sweep of each lidar that is nearest to a time, if it is near enough."""
        near = self._between(time_us - max_gap_us, time_us + max_gap_us + 1)
        own = [[sweep for sweep in near if sweep.lidar == lidar] for lidar in LIDARS]
        return [min(sweeps, key=lambda sweep: abs(sweep.stamp_us - time_us)) for sweeps in own if sweeps]

    def _between(self, first_us: int, end_us: int) -> list[Sweep]:
        first, end = (
            bisect_left(self.sweeps, t, key=lambda sweep: sweep.stamp_us) for t in (first_us, end_us)
        )
        return self.sweeps[first:end]


def find_pairs(
    real_root: Path | str,
    scan_patterns: Sequence[str] = SCAN_PATTERNS,
    sweep_patterns: Sequence[str] = SWEEP_PATTERNS,
) -> RealPairs:
    """Find every raw radar scan below a folder with lidar sweeps inside its turn.

    Parameters
    ----------
    real_root : path
        Folder to look in.
    scan_patterns, sweep_patterns : sequence of str
        Where to look for the files below it, as patterns of `glob.glob`; everywhere but in hidden folders if
        not given.

    Returns
    -------
    pairs : RealPairs
        Empty without scans or sweeps. A sweep is in a folder `velodyne_left` or `velodyne_right`, or is named
        in the nearest list of that name (`velodyne_left.timestamps`) above it; where there is such a list, a
        sweep that it does not name or flags 0 is left out. Of two files with the same stamp and sensor the
        first path counts.

    Raises
    ------
    rol.oxford.OxfordError
        If a list of stamps or an odometry is at fault; the message names file and fault.
    """
    root = Path(real_root)
    size = (N_AZIMUTHS, N_HEADER + N_BINS)
    scan_files = _first_of_stamp(p for p in _find_frames(root, scan_patterns) if _png_size(p) == size)
    files = _find_frames(root, sweep_patterns)
    files = [path for path in files if path.suffix == ".bin" or _png_size(path)[0] == N_VELODYNE_ROWS]
    sweeps, faults = _assign_sweeps(files, root)
    stamps = np.array([sweep.stamp_us for sweep in sweeps], dtype=np.int64)
    is_paired = {stamp: _has_any(stamps, stamp, stamp + TURN_US) for stamp in scan_files}
    kept = sorted(stamp for stamp, is_kept in is_paired.items() if is_kept)
    faults += _cover_faults(scan_files, is_paired, stamps)
    scans, odometry_faults = _describe_scans([scan_files[stamp] for stamp in kept])
    return RealPairs(scans, sweeps, faults + odometry_faults)


def load_sweep_points(sweep: Sweep, span_s: float = SWEEP_SECONDS) -> tuple[np.ndarray, np.ndarray]:
    """Read a sweep into the radar frame, with the time of each point.

    Parameters
    ----------
    sweep : Sweep
        The file.
    span_s : float
        Duration of the sweep [s], used for .bin files only: these hold no times, so a point's time is the
        stamp plus this duration multiplied by `firing_fractions`.

    Returns
    -------
    points : array, shape (n, 4)
        x, y, z [m] and intensity in the radar frame.
    seconds : array, shape (n,)
        Time of each point after the sweep's stamp [s].

    Raises
    ------
    rol.oxford.OxfordError
        If the file is damaged.
    """
    if sweep.path.suffix == ".png":
        points, stamps_us = velodyne_raw_to_points(load_velodyne_raw(sweep.path))
        seconds = (stamps_us - sweep.stamp_us) / 1e6
    else:
        points = load_velodyne_binary(sweep.path)
        seconds = span_s * firing_fractions(points)
    return sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[sweep.lidar])), seconds


def firing_fractions(points: np.ndarray) -> np.ndarray:
    """Compute from its bearing when within the sweep each point of an HDL-32E was fired.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        Points in the lidar frame (y left), laser after laser as in Oxford's .bin files, or firing after
        firing; in either case those of one laser in the order of time [m].

    Returns
    -------
    fractions : array, shape (n,)
        Part of the turn between the first firing and the point's, 0..1.

    Notes
    -----
    The lidar turns clockwise at a constant rate. Where a sweep is a little longer than a turn, the points of
    its last degrees get the time of the first ones.
    """
    clockwise = _clockwise(points)
    return np.mod(clockwise - sweep_start(points), 2.0 * np.pi) / (2.0 * np.pi) if len(points) else clockwise


def sweep_start(points: np.ndarray) -> float:
    """Find the bearing of the first firing of a sweep.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        As in `firing_fractions`, at least one.

    Returns
    -------
    start : float
        Bearing, clockwise from the lidar's x axis [rad]: the median over the first points of the lasers.
    """
    clockwise = _clockwise(points)
    elevation = np.arctan2(points[:, 2] - FIRE_HEIGHT, np.hypot(points[:, 0], points[:, 1]))
    changes = np.flatnonzero(np.abs(np.diff(elevation)) > LASER_SPACING / 2.0) + 1
    if len(changes) > 4 * N_LASERS:  # firing after firing
        return float(clockwise[0])
    first = clockwise[np.concatenate([[0], changes])]
    around = np.angle(np.exp(1j * (first - first[0])))
    return float(first[0] + np.median(around))


# ---- files ----


def _clockwise(points: np.ndarray) -> np.ndarray:
    return -np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)


def _find_frames(root: Path, patterns: Sequence[str]) -> list[Path]:
    """List the files that patterns match and whose names are stamps;
    folders that are links are searched as well."""
    names = {name for pattern in patterns for name in glob(pattern, root_dir=root, recursive=True)}
    paths = sorted(root / name for name in names)
    return [p for p in paths if p.stem.isdecimal() and len(p.stem) == STAMP_DIGITS and p.is_file()]


def _png_size(path: Path) -> tuple[int, int]:
    """Read the rows and columns of a PNG from its header; (0, 0) of another file."""
    if path.suffix != ".png":
        return 0, 0
    with path.open("rb") as file:
        head = file.read(24)
    if len(head) < 24 or head[12:16] != b"IHDR":
        return 0, 0
    return int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")


def _first_of_stamp(paths: Iterable[Path]) -> dict[int, Path]:
    """Map stamps to paths; of several paths with the same stamp the first in alphabetical order."""
    return {int(path.stem): path for path in sorted(paths, reverse=True)}


def _assign_sweeps(files: list[Path], root: Path) -> tuple[list[Sweep], list[str]]:
    """Assign each file to a lidar; list what is left out."""
    by_folder, faults = defaultdict(list), []
    for path in files:
        by_folder[path.parent].append(path)
    found: dict[tuple[str, int], Path] = {}
    for folder, paths in by_folder.items():
        lists, left_out, seen = _find_lists(folder, root), [], set()
        for path in paths:
            stamp = int(path.stem)
            lidar = next((name for name, (_, listed) in lists.items() if stamp in listed), None)
            if lidar is None and folder.name in LIDARS and not lists:
                lidar = folder.name
            if lidar is None:
                left_out.append(path)
            else:
                found.setdefault((lidar, stamp), path)
                seen.add(stamp)
        names = " or ".join(path.name for path, _ in lists.values())
        reason = f"that are not in {names}" if names else "without a velodyne_*.timestamps that names them"
        faults += _count(folder, left_out, f"sweeps {reason}, left out")
        for path, listed in lists.values():
            faults += _count(path, sorted(listed - seen), "stamps without a file, left out")
    sweeps = [Sweep(path, lidar, stamp) for (lidar, stamp), path in found.items()]
    return sorted(sweeps, key=lambda sweep: (sweep.stamp_us, sweep.lidar)), faults


def _find_lists(folder: Path, root: Path) -> dict[str, tuple[Path, set[int]]]:
    """Find the nearest list of stamps of each lidar in a folder or above it: its path and its valid stamps.

    A folder that is called like a lidar has the list of that lidar alone.
    """
    lists = {}
    for lidar in [folder.name] if folder.name in LIDARS else LIDARS:
        above = [folder, *folder.parents]
        for place in above[: above.index(root) + 1]:
            path = place / f"{lidar}.timestamps"
            if path.is_file():
                stamps, is_valid = load_timestamps(path)
                lists[lidar] = path, set(stamps[is_valid].tolist())
                break
    return lists


def _has_any(stamps: np.ndarray, first: int, end: int) -> bool:
    """Check whether sorted stamps have one in a half-open interval."""
    return bool(np.diff(np.searchsorted(stamps, [first, end]))[0])


def _cover_faults(scans: dict[int, Path], is_paired: dict[int, bool], sweeps: np.ndarray) -> list[str]:
    """Name the folders of scans without a sweep inside their turn, with the times of both."""
    bare = defaultdict(list)
    for stamp, path in sorted(scans.items()):
        if not is_paired[stamp]:
            bare[path.parent].append(stamp)
    span = f"the sweeps span {sweeps[0]} to {sweeps[-1]}" if len(sweeps) else "there are no sweeps"
    return [
        _count(folder, stamps, f"scans without a sweep inside their turn ({span})")[0]
        for folder, stamps in bare.items()
    ]


def _count(path: Path, items: list, what: str) -> list[str]:
    """Format '<path>: <count> <what>, the first: <item>'; an empty list for no items."""
    first = items[0].name if items and isinstance(items[0], Path) else items[0] if items else ""
    return [f"{path}: {len(items)} {what}; the first: {first}"] if items else []


def _describe_scans(paths: list[Path]) -> tuple[list[PairedScan], list[str]]:
    """Look up mid-scan time, velocity and pose of scans in the odometry beside them;
    name odometry with gaps."""
    known: dict[Path | None, dict[int, tuple]] = {None: {}}
    scans, faults = [], []
    for path in paths:
        places = [folder / "gt" / "radar_odometry.csv" for folder in (path.parent, path.parent.parent)]
        odometry = next((place for place in places if place.is_file()), None)
        if odometry not in known:
            known[odometry], fault = _load_motion(odometry)
            faults += [f"{fault}; velocities are unknown"] if fault else []
        stamp = int(path.stem)
        mid, twist, pose = known[odometry].get(stamp, (stamp + MID_SCAN_US, None, None))
        scans.append(PairedScan(path, stamp, mid, twist, pose, odometry if twist else None))
    return scans, faults


def _load_motion(path: Path) -> tuple[dict[int, tuple], str]:
    """Read mid-scan time, velocity and pose of every scan of an odometry;
    none and the fault if it has a gap."""
    odometry = load_radar_odometry(path)
    try:
        stamps, mids, poses = compose_odometry(odometry)
    except OxfordError as error:
        return {}, str(error)
    twists = [tuple(float(value) for value in twist) for twist in estimate_twists(odometry)]
    rows = zip(stamps.tolist(), mids.tolist(), twists, poses, strict=True)
    return {stamp: (mid, twist, pose) for stamp, mid, twist, pose in rows}, ""
