"""The whole method on a session of real radar: network, points, odometry and both filters on the real map.

Everything is read scan by scan, and the generated points, which cost nearly all of the time, are kept in
files, so a run that was stopped goes on. Memory does not grow with the number of scans, but for the poses.

There are two kinds of sessions. The radar images of the paper's Seq01 have ground truth in the frame of the
map. A folder in Oxford's layout has official odometry in a frame of its own: the start is found by global
localization, and the official trajectory is fitted rigidly to the estimate, to be compared with it.
"""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from rol.evaluation import FailureMonitor, FailureRule
from rol.files import read_marker, write_bytes, write_text
from rol.geometry import compose
from rol.mcl import ParticleFilter
from rol.odometry import fit_rigid, scan_to_scan_icp, stack_increments
from rol.oxford import compose_odometry, load_radar, load_radar_odometry, open_session
from rol.pairs import usable_stamps
from rol.pix2pix import TrainedNetwork
from rol_beyond.front_ends import generate_points, resample_by_density
from rol_beyond.local_map_odometry import local_map_odometry
from rol_beyond.motion import MotionModel, gate_odometry
from rol_beyond.recovery import (
    RecoveringFilter,
    RecoverySettings,
    RelocalizationSettings,
    measure_reference_contrast,
)
from rol_beyond.robust import settings_for
from rol_data.rall import image_to_scan, load_radar_images, load_scans
from rol_study.filter_runs import FilterRun, run_filter
from rol_study.oxford_route import SCAN_US

CELL_M = 0.25  # of the filters' grids: the pixel of the real map
EVEN_M = 2.0  # points nearer to one another than this share their weight, as in chapter 10 [m]
N_FOUND = 8  # scans in a row, two seconds, after which a start counts as found
CHUNK = 50  # scans of a file of points
Report = Callable[[str], None]


class EndToEndError(ValueError):
    """Raised where a session cannot be run or judged; names the folder and the fault."""


@dataclass(frozen=True)
class RadarSession:
    """Radar scans in the order of time, with what is known of their poses.

    Attributes
    ----------
    name : str
        Name of the session.
    stamps_us : array of int, shape (n,)
        Times of the scans [us].
    load_scan : callable
        Takes an index and returns the scan, with ``power`` and ``azimuths``.
    truth : array, shape (n, 3), or None
        Ground truth T_map_radar [m, m, rad].
    official : array, shape (n, 3), or None
        Trajectory of the official odometry, in any frame [m, m, rad].
    """

    name: str
    stamps_us: np.ndarray
    load_scan: Callable[[int], Any]
    truth: np.ndarray | None = None
    official: np.ndarray | None = None


def open_images(real_root: Path | str, number: str = "02", max_scans: int = 0) -> RadarSession:
    """Open the radar images of a session of the real route.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    number : str
        Session.
    max_scans : int
        Use only the first scans, 0 for all.

    Returns
    -------
    session : RadarSession
        Scans a quarter of a second apart, since the images have no times; ``truth`` is known.

    Raises
    ------
    rol_data.rall.RallError
        If images or poses are missing or at fault.
    """
    images = load_radar_images(real_root, number)
    truth = images.truth[: max_scans or None]
    stamps_us = np.arange(len(truth), dtype=np.int64) * SCAN_US
    return RadarSession(
        f"seq{number}", stamps_us, lambda k: image_to_scan(images[k], int(stamps_us[k])), truth
    )


def open_oxford(folder: Path | str, max_scans: int = 0) -> RadarSession:
    """Open the raw radar scans of a folder in Oxford's layout, without lidar and without a pose on the map.

    Parameters
    ----------
    folder : path
        Holds ``radar``, ``radar.timestamps`` and ``gt/radar_odometry.csv``.
    max_scans : int
        Use only the first scans, 0 for all.

    Returns
    -------
    session : RadarSession
        The scans with a file and a pose of the official odometry; ``official`` is known.

    Raises
    ------
    EndToEndError
        If fewer than two scans have both, or one between them is missing.
    rol.oxford.OxfordError
        If a file is missing or at fault.
    """
    session = open_session(folder)
    stamps, _, poses = compose_odometry(load_radar_odometry(session.odometry_path))
    is_there = np.isin(stamps, usable_stamps(session, "radar"))
    used = np.flatnonzero(is_there)
    if len(used) < 2:
        raise EndToEndError(
            f"{folder}: {len(used)} scans have a file and a pose of {session.odometry_path.name}"
        )
    inside = slice(used[0], used[-1] + 1)
    if not is_there[inside].all():
        gap = int(stamps[inside][np.argmin(is_there[inside])])
        raise EndToEndError(f"{session.radar_path(gap)}: missing between scans that are there")
    stamps, poses = (values[inside][: max_scans or None] for values in (stamps, poses))
    return RadarSession(
        session.name, stamps, lambda k: load_radar(session.radar_path(stamps[k])), official=poses
    )


class KeptClouds(Sequence):
    """Clouds of a session in files of 50 scans each, read one file at a time.

    Parameters
    ----------
    folder : path
        Folder of the files.
    n : int
        Number of clouds.
    """

    def __init__(self, folder: Path | str, n: int) -> None:
        self.folder, self.n = Path(folder), n
        self._read = lru_cache(maxsize=2)(self._read_file)

    def path(self, first: int) -> Path:
        """Name the file of the clouds from `first` on."""
        return self.folder / f"{first:06d}.npz"

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, index: int) -> np.ndarray:
        """Read one cloud, shape (m, 2) [m]."""
        index = range(self.n)[index]
        points, ends = self._read(index // CHUNK * CHUNK)
        k = index % CHUNK
        return points[ends[k - 1] if k else 0 : ends[k]].astype(np.float64)

    def write(self, first: int, clouds: list[np.ndarray], twists: np.ndarray) -> None:
        """Write the clouds of one file whole or not at all, with the velocities used for compensation."""
        ends, file = np.cumsum([len(cloud) for cloud in clouds]), io.BytesIO()
        np.savez(file, points=np.concatenate(clouds).astype(np.float32), ends=ends, twists=twists)
        write_bytes(self.path(first), file.getvalue())

    def holds(self, first: int, twists: np.ndarray) -> bool:
        """Check that the file from `first` on holds clouds compensated for these velocities, shape (k, 3)."""
        if not self.path(first).is_file():
            return False
        with np.load(self.path(first)) as data:
            return np.array_equal(data["twists"], twists, equal_nan=True)

    def _read_file(self, first: int) -> tuple[np.ndarray, np.ndarray]:
        with np.load(self.path(first)) as data:
            return data["points"], data["ends"]


def keep_points(
    session: RadarSession,
    network: TrainedNetwork,
    folder: Path | str,
    twists: np.ndarray | None = None,
    *,
    report: Report = lambda line: None,
    **options: Any,
) -> KeptClouds:
    """Generate the points of all scans, or those that a run before this one has not made.

    Parameters
    ----------
    session : RadarSession
        The session.
    network : TrainedNetwork
        From `rol.pix2pix.load_network`.
    folder : path
        Where the points are kept; points of another session, network or of other options are removed.
    twists : array, shape (n, 3), optional
        Body velocity at each scan; rows of NaN, or none at all, for scans as recorded [m/s, m/s, rad/s].
    report : callable
        Takes a line of text after each file.
    **options
        ``bf16`` and ``tta_rotations`` of `rol_beyond.front_ends.generate_points`.

    Returns
    -------
    clouds : KeptClouds
        One per scan, in the radar frame [m].
    """
    n = len(session.stamps_us)
    clouds = KeptClouds(folder, n)
    twists = np.full((n, 3), np.nan) if twists is None else twists
    _clear_others(clouds.folder, {"session": session.name, "network": _describe(network), **options})
    todo = [k for k in range(0, n, CHUNK) if not clouds.holds(k, twists[k : k + CHUNK])]
    n_todo, n_done, begin = sum(min(CHUNK, n - k) for k in todo), 0, perf_counter()
    for first in todo:
        own = twists[first : first + CHUNK]
        made = [_generate(session, network, first + k, twist, options) for k, twist in enumerate(own)]
        clouds.write(first, made, own)
        n_done += len(own)
        seconds = (perf_counter() - begin) / n_done
        left = f"{(n_todo - n_done) * seconds / 60.0:.0f} min left"
        report(f"{clouds.folder.name} points: {first + len(own)} of {n} scans, {seconds:.2f} s each, {left}")
    return clouds


def _generate(
    session: RadarSession, network: TrainedNetwork, index: int, twist: np.ndarray, options: dict[str, Any]
) -> np.ndarray:
    """Generate the points of one scan."""
    scan, known = session.load_scan(index), tuple(twist.tolist()) if np.isfinite(twist).all() else None
    return generate_points(network, scan.power, scan.azimuths, known, **options)[0]


def _clear_others(folder: Path, about: dict[str, Any]) -> None:
    """Remove points that depend on anything else from a folder, and describe those to come."""
    marker = folder / "settings.json"
    if read_marker(marker) == about:
        return
    for path in folder.glob("[0-9]*.npz"):
        path.unlink()
    write_text(marker, json.dumps(about, indent=1) + "\n")


def _describe(network: TrainedNetwork) -> str:
    """Compute a checksum of a network with its threshold and the settings of its images."""
    state, text = network.generator.state_dict(), repr((network.points, network.settings))
    return f"{zlib.crc32(b''.join([text.encode(), *(v.numpy().tobytes() for v in state.values())])):08x}"


@dataclass(frozen=True)
class Odometry:
    """Motion between the scans, from generated points.

    Attributes
    ----------
    scan_to_scan, local_map : array, shape (n - 1, 3)
        Increments of the paper's ICP, and of local-map odometry [m, m, rad].
    twists : array, shape (n, 3)
        Body velocity at each scan from the latter; NaN for the first [m/s, m/s, rad/s].
    """

    scan_to_scan: np.ndarray
    local_map: np.ndarray
    twists: np.ndarray


def estimate_odometry(
    clouds: Sequence[np.ndarray], stamps_us: np.ndarray, report: Report = lambda line: None
) -> Odometry:
    """Estimate the motion between scans by scan-to-scan ICP and by registration to a local map.

    Parameters
    ----------
    clouds : sequence of array, shape (m, 2)
        Points of the scans as recorded [m].
    stamps_us : array of int, shape (n,)
        Times of the scans [us].
    report : callable
        Takes a line of text.

    Returns
    -------
    odometry : Odometry
        Each velocity depends on no later scan.
    """
    n = len(stamps_us) - 1
    steps = stack_increments(_tell(scan_to_scan_icp(clouds), "scan-to-scan ICP", n, report))
    found = list(_tell(local_map_odometry(clouds, stamps_us), "local-map odometry", n, report))
    twists = [np.full(3, np.nan), *(increment.twist for increment in found)]
    return Odometry(steps, stack_increments(found), np.array(twists))


def _tell(items: Iterable, what: str, n: int, report: Report, every: int = 500) -> Iterator:
    """Pass items on, with a line of text now and then."""
    for k, item in enumerate(items, start=1):
        yield item
        if k % every == 0 or k == n:
            report(f"{what}: {k} of {n}")


def run_paper(
    session: RadarSession,
    odometry: Odometry,
    clouds: Sequence[np.ndarray],
    map_points: np.ndarray,
    seed: int,
    report: Report = lambda line: None,
) -> FilterRun:
    """Run the paper's filter from the true start, with a reset to the ground truth after each failure.

    Parameters
    ----------
    session : RadarSession
        With its ground truth.
    odometry : Odometry
        From `estimate_odometry`.
    clouds : sequence of array, shape (m, 2)
        Points of the scans as recorded [m].
    map_points : array, shape (m, 2)
        The map [m].
    seed : int
        Of the particles.
    report : callable
        Takes a line of text.

    Returns
    -------
    run : FilterRun
        Yin et al. 2020, Sec. III-B and IV-C.
    """
    settings, rng = settings_for("paper", cell_m=CELL_M), np.random.default_rng([seed, 1])
    grid = settings.measurement.build_grid(map_points)
    monitor = FailureMonitor(session.stamps_us, session.truth, FailureRule())
    particle_filter = ParticleFilter(grid, session.truth[0], settings, rng)
    points = _tell(clouds, "filter of the method paper", len(clouds), report)
    return run_filter(particle_filter, odometry.scan_to_scan, points, monitor)


def run_robust(
    session: RadarSession,
    odometry: Odometry,
    clouds: Sequence[np.ndarray],
    map_points: np.ndarray,
    seed: int,
    reference_contrast: float,
    report: Report = lambda line: None,
) -> FilterRun:
    """Run the robust filter without resets; without ground truth it begins with global localization.

    Parameters
    ----------
    session, odometry, map_points, seed, report
        As for `run_paper`.
    clouds : sequence of array, shape (m, 2)
        Compensated points of the scans [m].
    reference_contrast : float
        From `measure_contrast`.

    Returns
    -------
    run : FilterRun
        ``failures`` is empty, see `rol_study.filter_runs.find_failures`. The motion model is not calibrated:
        `rol_beyond.motion.MotionModel` with its wide noise.
    """
    settings, rng = settings_for("robust", motion=MotionModel()), np.random.default_rng([seed, 2])
    corners = map_points.min(axis=0), map_points.max(axis=0)
    is_known, middle = session.truth is not None, 0.5 * (corners[0] + corners[1])
    start = session.truth[0] if is_known else np.append(middle, 0.0)
    reach = RelocalizationSettings(far_reach_m=float(np.max(corners[1] - middle)))
    recovery = RecoverySettings(
        reference_contrast, relocalization=RelocalizationSettings() if is_known else reach
    )
    robust_filter = RecoveringFilter(map_points, start, settings, recovery, rng, is_known)
    even_rng = np.random.default_rng([seed, 3])
    even = (resample_by_density(cloud, EVEN_M, even_rng) for cloud in clouds)
    points = _tell(even, "filter of the method robust", len(clouds), report)
    return run_filter(robust_filter, gate_odometry(odometry.local_map), points)


def measure_contrast(real_root: Path | str, network: TrainedNetwork, map_points: np.ndarray) -> float:
    """Measure the reference contrast of a network on the real scans of another session.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    network : TrainedNetwork
        The network.
    map_points : array, shape (m, 2)
        The map [m].

    Returns
    -------
    reference_contrast : float
        Median over the eleven scans of `rol_data.rall.load_scans`, at the poses fitted for this book.
    """
    scans, grid = load_scans(real_root), settings_for("robust").measurement.build_grid(map_points)
    rng, poses = np.random.default_rng(0), np.array([scan.pose for scan in scans])
    points = (generate_points(network, scan.power, scan.azimuths, scan.twist)[0] for scan in scans)
    return measure_reference_contrast((resample_by_density(p, EVEN_M, rng) for p in points), poses, grid)


def find_start(run: FilterRun) -> int:
    """Find the scan from which the estimate counts: after it the filter was not lost for two seconds.

    Parameters
    ----------
    run : FilterRun
        Of the robust filter.

    Returns
    -------
    first : int
        Index of the scan.

    Raises
    ------
    EndToEndError
        If the filter was never found for so long.
    """
    n = len(run.is_lost)
    found = (
        np.convolve(~run.is_lost, np.ones(N_FOUND), "valid") > N_FOUND - 0.5 if n >= N_FOUND else np.zeros(1)
    )
    if not found.any():
        raise EndToEndError(
            f"the start was not found in {n} scans: the filter was never sure for {N_FOUND} in a row"
        )
    return int(np.argmax(found)) + N_FOUND - 1


def fit_official(official: np.ndarray, run: FilterRun, first: int, fraction: float = 0.8) -> np.ndarray:
    """Fit the official trajectory rigidly to the estimate.

    Parameters
    ----------
    official : array, shape (n, 3)
        Trajectory in any frame [m, m, rad].
    run : FilterRun
        Estimates.
    first : int
        First scan that counts.
    fraction : float
        Fraction of the scans, the closest ones, on which the last fits are made, so that scans at which the
        filter was lost hardly count.

    Returns
    -------
    truth : array, shape (n, 3)
        The trajectory in the frame of the map [m, m, rad]. A constant offset of the estimate cannot be seen
        with it.
    """
    source, target = official[first:], run.poses[first:, :2]
    chosen = np.flatnonzero(~run.is_lost[first:])
    for _ in range(20):
        fitted = compose(fit_rigid(source[chosen, :2], target[chosen]), source)
        distances = np.hypot(*(fitted[:, :2] - target).T)
        chosen = np.argsort(distances, kind="stable")[: max(int(fraction * len(source)), 2)]
    return compose(fit_rigid(source[chosen, :2], target[chosen]), official)


def with_fitted_truth(session: RadarSession, run: FilterRun, first: int) -> RadarSession:
    """Return a session whose ground truth is its official trajectory, fitted by `fit_official`."""
    return replace(session, truth=fit_official(session.official, run, first))
