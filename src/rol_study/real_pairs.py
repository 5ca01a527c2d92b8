"""Compare real radar scans with the lidar sweeps of the same moment: alignment, calibration, similarity.

Everything is in the radar frame, x forward, y left [m], and refers to a scan and its sweeps as
`rol_data.oxford_pairs.find_pairs` finds them. "Compensated" means that radar and lidar are brought to
mid-scan by the velocity of the official odometry and that the radar's Doppler shift is removed; "none" leaves
both as recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter, gaussian_filter1d, minimum_filter1d, uniform_filter1d
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from rol.bev import image_to_points, points_to_image
from rol.geometry import relative_pose, transform_points
from rol.lidar import crop_range, remove_ground
from rol.oxford import (
    RadarScan,
    compose_odometry,
    load_radar,
    load_radar_odometry,
    load_velodyne_binary,
)
from rol.pairs import PairSettings, radar_to_image
from rol.radar import DOPPLER_SECONDS, MEASURED, SCAN_SECONDS, RangeCalibration, deskew_points
from rol.similarity import fraction_within, nn_distances
from rol_beyond.front_ends import DETECTORS, detect_points, evaluate_on_map, generate_points
from rol_data.oxford_pairs import PairedScan, RealPairs, Sweep, load_sweep_points, sweep_start
from rol_study.misalignment import measure_misalignment

if TYPE_CHECKING:
    from rol.pix2pix import TrainedNetwork

MOTIONS = ("none", "compensated")
REFERENCES = ("nearest", "turn")  # sweeps that the lidar points come from
COLUMNS = ["timestamp_us", "front_end", "motion", "sweeps", "n_points", "n_lidar_points", "precision_1m"]
COLUMNS += ["precision_2m", "recall_1m", "recall_2m", "misalignment_forward_m", "misalignment_left_m"]
PIXEL_M = 0.25
OWN_VEHICLE_M = 4.0  # nearer lidar points may be on the vehicle itself [m]


# ---- one scan and its sweeps ----


@dataclass(frozen=True, eq=False)
class Pair:
    """A scan with its sweeps, motion-compensated or as recorded.

    Attributes
    ----------
    scan : PairedScan
        The scan's file.
    radar : RadarScan
        Its content.
    motion, sweeps : str
        One of `MOTIONS` and of `REFERENCES`.
    cloud : array, shape (n, 4)
        x, y, z [m], intensity of the sweeps, ground included.
    min_height, max_range : float
        Lowest height and largest range of the lidar points that are compared [m].
    """

    scan: PairedScan
    radar: RadarScan
    motion: str
    sweeps: str
    cloud: np.ndarray
    min_height: float = -1.5
    max_range: float = 64.0

    @property
    def twist(self) -> tuple[float, float, float] | None:
        """Velocity to compensate; None with motion "none"."""
        return self.scan.twist if self.motion == "compensated" else None

    @cached_property
    def objects(self) -> np.ndarray:
        """Points of the cloud without ground and within range, shape (n, 4)."""
        return crop_range(remove_ground(self.cloud, self.min_height), self.max_range)

    @cached_property
    def lidar_image(self) -> np.ndarray:
        """Occupancy image of the objects, shape (512, 512), uint8."""
        return points_to_image(self.objects, max_range=self.max_range)

    @cached_property
    def lidar_points(self) -> np.ndarray:
        """Centres of the occupied pixels, shape (m, 2) [m]."""
        return image_to_points(self.lidar_image, max_range=self.max_range)

    @cached_property
    def tops(self) -> np.ndarray:
        """Height above the ground of the highest point in the pixel of each of the lidar points,
        shape (m,) [m]."""
        height, forward, left = np.nan_to_num(fit_ground(self.cloud))
        around = np.clip(self.objects[:, :2], -15.0, 15.0)  # farther away the slope is not known
        ground = (height or -2.0) + around @ (forward, left)
        _, pixel = cKDTree(self.lidar_points).query(self.objects[:, :2])
        tops = np.full(len(self.lidar_points), -np.inf)
        np.maximum.at(tops, pixel, self.objects[:, 2] - ground)
        return tops

    @cached_property
    def radar_image(self) -> np.ndarray:
        """Radar image, shape (512, 512), uint8."""
        return self.image_with(MEASURED)

    def image_with(self, calibration: RangeCalibration) -> np.ndarray:
        """Compute the radar image with another calibration of range, shape (512, 512), uint8."""
        motion = "none" if self.twist is None else "corrected"
        ranges = {"range_resolution": calibration.resolution_m, "range_offset": calibration.offset_m}
        settings = PairSettings(motion, **ranges)
        return radar_to_image(self.radar.power, self.radar.azimuths, self.twist, settings)

    @cached_property
    def misalignment(self) -> tuple[float, float]:
        """Shift of the radar image against the lidar image, forward and left [m]; nan if not measurable."""
        rows, columns = measure_misalignment(self.radar_image, self.lidar_image, max_shift_px=16)
        return -PIXEL_M * rows, -PIXEL_M * columns


def load_scan_pairs(
    found: RealPairs, scan: PairedScan, min_height: float = -1.5, max_range: float = 64.0
) -> dict[tuple[str, str], Pair]:
    """Load a scan with its sweeps, in every way in which they are compared.

    Parameters
    ----------
    found : RealPairs
        What was found.
    scan : PairedScan
        One of its scans.
    min_height, max_range : float
        Lowest height and largest range of the lidar points that are compared [m].

    Returns
    -------
    pairs : dict
        (motion, sweeps) -> `Pair`. Motion "compensated" is left out where the velocity is unknown. Sweeps
        "nearest" are of each lidar the sweep nearest to the scan's stamp (the paper's rule), with
        compensation the one nearest to mid-scan; left out if none is within 50 ms. Sweeps "turn" are all with
        a stamp inside the scan's turn.

    Raises
    ------
    rol.oxford.OxfordError
        If a file is damaged; the message names file and fault.
    """
    radar, pairs = load_radar(scan.path), {}
    for motion in MOTIONS if scan.twist is not None else MOTIONS[:1]:
        twist = scan.twist if motion == "compensated" else None
        nearest = found.nearest(scan.stamp_us if twist is None else scan.mid_us)
        for sweeps, chosen in zip(REFERENCES, (nearest, found.turn(scan)), strict=True):
            if chosen:
                cloud = np.concatenate([load_cloud(sweep, scan, twist) for sweep in chosen])
                pairs[motion, sweeps] = Pair(scan, radar, motion, sweeps, cloud, min_height, max_range)
    return pairs


def load_cloud(sweep: Sweep, scan: PairedScan, twist: Sequence[float] | None = None) -> np.ndarray:
    """Load a sweep into the radar frame; with a velocity, each point is moved from its own time to mid-scan.

    Parameters
    ----------
    sweep, scan : Sweep, PairedScan
        The files.
    twist : sequence of float, optional
        Body velocity [m/s, m/s, rad/s]; without it the points stay as recorded.

    Returns
    -------
    points : array, shape (n, 4)
        x, y, z [m] and intensity.
    """
    points, seconds = load_sweep_points(sweep)
    if twist is not None:
        seconds = seconds + (sweep.stamp_us - scan.mid_us) / 1e6
        points[:, :3] = deskew_points(points[:, :3], seconds, twist)
    return points


def load_path(scan: PairedScan) -> np.ndarray | None:
    """Load the path of the odometry that a scan belongs to, shape (m, 3) [m, m, rad];
    None without odometry."""
    if scan.odometry_path is None:
        return None
    return compose_odometry(load_radar_odometry(scan.odometry_path))[2]


def compare_points(points: np.ndarray, lidar: np.ndarray) -> dict[str, float | int]:
    """Compute precision and recall of points against lidar points.

    Parameters
    ----------
    points, lidar : array, shape (n, 2), (m, 2)
        Points in one frame [m].

    Returns
    -------
    scores : dict
        ``n_points``, ``n_lidar_points``, ``precision_1m``, ``precision_2m``, ``recall_1m``, ``recall_2m``.
    """
    to_lidar, to_points = nn_distances(points, lidar), nn_distances(lidar, points)
    scores: dict[str, float | int] = {"n_points": len(points), "n_lidar_points": len(lidar)}
    for name, distances in (("precision", to_lidar), ("recall", to_points)):
        scores |= {f"{name}_{r}m": fraction_within(distances, float(r)) for r in (1, 2)}
    return scores


def chance_level(points: np.ndarray, lidar: np.ndarray, n_turns: int = 8) -> dict[str, float]:
    """Compute the precision of points that are turned to wrong headings.

    Parameters
    ----------
    points, lidar : array, shape (n, 2), (m, 2)
        Points in one frame [m].
    n_turns : int
        The circle is divided into so many headings; the right one is left out.

    Returns
    -------
    precision : dict
        ``precision_1m`` and ``precision_2m``, means over the wrong headings.
    """
    tree, found = cKDTree(lidar), []
    for turn in 2.0 * np.pi * np.arange(1, n_turns) / n_turns:
        distances = tree.query(transform_points((0.0, 0.0, turn), points))[0]
        found.append([fraction_within(distances, 1.0), fraction_within(distances, 2.0)])
    return dict(zip(("precision_1m", "precision_2m"), np.mean(found, axis=0).tolist(), strict=True))


# ---- time of a sweep ----


def measure_stamps(sweeps: Sequence[Sweep]) -> tuple[np.ndarray, np.ndarray]:
    """Compare the time between sweeps with the angle by which the lidar turned meanwhile.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Consecutive sweeps of one lidar, .bin files.

    Returns
    -------
    intervals_ms : array, shape (n - 1,)
        Stamp of the next sweep minus that of a sweep [ms].
    turned_deg : array, shape (n - 1,)
        Angle between the first firing of a sweep and that of the next [deg]: 360 and a few.
    """
    starts = np.array([sweep_start(load_velodyne_binary(sweep.path)) for sweep in sweeps])
    turned = 360.0 + np.rad2deg(np.angle(np.exp(1j * np.diff(starts))))
    return np.diff([sweep.stamp_us for sweep in sweeps]) / 1e3, turned


def locate_stamp(
    intervals_ms: np.ndarray, turned_deg: np.ndarray, max_jitter_ms: float = 2.0
) -> tuple[float, float, int]:
    """Estimate where within a sweep its stamp lies, from the lengths of sweeps that differ.

    The time between two stamps is ``(1 - place) * own + place * next``, with the durations of the sweep and
    of the next one: the first alone if a stamp is the beginning of its sweep, the second alone if it is the
    end.

    Parameters
    ----------
    intervals_ms, turned_deg : array, shape (n,)
        As of `measure_stamps`.
    max_jitter_ms : float
        Intervals farther from their median than this are left out (sweeps lost or late) [ms].

    Returns
    -------
    place : float
        0 for the beginning, 1 for the end; nan if the sweeps are all of one length.
    error : float
        Its standard error.
    n : int
        Intervals used.
    """
    is_good = np.abs(intervals_ms - np.median(intervals_ms)) < max_jitter_ms
    used = is_good[:-1] & is_good[1:]
    columns = np.column_stack([turned_deg[:-1], turned_deg[1:], np.ones(len(turned_deg) - 1)])[used]
    values = intervals_ms[:-1][used]
    if np.linalg.matrix_rank(columns) < 3:
        return float("nan"), float("nan"), len(values)
    weights, *_ = np.linalg.lstsq(columns, values, rcond=None)
    residual = values - columns @ weights
    covariance = np.linalg.inv(columns.T @ columns) * (residual @ residual) / max(len(values) - 3, 1)
    own, following = weights[:2]
    slope = np.array([-following, own]) / (own + following) ** 2
    return (
        float(following / (own + following)),
        float(np.sqrt(slope @ covariance[:2, :2] @ slope)),
        len(values),
    )


def sweep_consistency(
    sweeps: Sequence[Sweep],
    odometry_path: Path | str,
    spans_s: Sequence[float],
    lag: int = 12,
    n_pairs: int = 16,
) -> np.ndarray:
    """Measure how well sweeps agree with later ones for several durations of a sweep.

    Both sweeps are brought into one frame by the odometry, each point at the time that the duration gives it.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Consecutive sweeps of one lidar, .bin files.
    odometry_path : path
        Odometry of the radar; sweeps outside its span are left out.
    spans_s : sequence of float
        Durations to try: 0.05 for a turn with the stamp at its beginning, 0 for all points at once, -0.05 for
        points fired the other way round [s].
    lag : int
        Sweeps between the two that are compared.
    n_pairs : int
        Pairs of sweeps, spread over the odometry's span.

    Returns
    -------
    distances : array, shape (n_pairs, s)
        Mean distance of the later sweep's points to the earlier one's, each limited to 0.5 m [m]; no row with
        too few sweeps.
    """
    _, mids, poses = compose_odometry(load_radar_odometry(odometry_path))
    kept = [s for s in sweeps if mids[0] < s.stamp_us < mids[-1] - 100_000]
    starts = np.linspace(0, max(len(kept) - lag - 1, 0), n_pairs).astype(int)
    table = []
    for start in np.unique(starts) if len(kept) > lag else ():
        two = [kept[start], kept[start + lag]]
        loaded = [_upright(*load_sweep_points(sweep, span_s=1.0)) for sweep in two]
        row = []
        for span in spans_s:
            clouds = [
                _to_map(points, s.stamp_us + 1e6 * span * part, mids, poses)
                for s, (points, part) in zip(two, loaded, strict=True)
            ]
            distances = cKDTree(clouds[0]).query(clouds[1][::3], distance_upper_bound=0.5)[0]
            row.append(float(np.minimum(distances, 0.5).mean()))
        table.append(row)
    return np.array(table).reshape(-1, len(spans_s))


def fit_span(
    spans_s: Sequence[float], distances: np.ndarray, rng: np.random.Generator, n_resamples: int = 200
) -> tuple[float, float]:
    """Fit the duration of a sweep at which sweeps agree best.

    Parameters
    ----------
    spans_s, distances : array, shape (s,) and (n, s)
        As of `sweep_consistency`.
    rng : numpy.random.Generator
        Source of randomness of the bootstrap over pairs of sweeps.
    n_resamples : int
        Resamples of the bootstrap.

    Returns
    -------
    span, error : float
        Vertex of the parabola through the mean distances and its standard error [s]; nan without a minimum.
    """
    if len(distances) < 2:
        return float("nan"), float("nan")

    def vertex(rows: np.ndarray) -> float:
        bend, slope, _ = np.polyfit(spans_s, rows.mean(axis=0), 2)
        return -slope / (2.0 * bend) if bend > 0.0 else np.nan

    n = len(distances)
    again = [vertex(distances[rng.integers(0, n, n)]) for _ in range(n_resamples)]
    return float(vertex(distances)), float(np.nanstd(again))


def _upright(points: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep points of upright things, where height does not matter, as 2D points with their times."""
    kept = (points[:, 2] > -0.5) & (points[:, 2] < 4.0) & (np.hypot(points[:, 0], points[:, 1]) < 30.0)
    return points[kept, :2], seconds[kept]


def _to_map(points: np.ndarray, stamps_us: np.ndarray, mids_us: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Move points to the odometry's frame with the pose interpolated at each point's time."""
    x, y, yaw = (np.interp(stamps_us, mids_us, values) for values in (*poses.T[:2], np.unwrap(poses[:, 2])))
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * points[:, 0] - s * points[:, 1] + x, s * points[:, 0] + c * points[:, 1] + y])


# ---- calibration of the radar against the lidar ----


@dataclass(frozen=True)
class Calibration:
    """What the radar's geometry depends on.

    Attributes
    ----------
    rotation_deg : float
        Rotation of the radar image against the lidar points, counter-clockwise [deg].
    forward_m, left_m : float
        Shift of the radar image against the lidar points [m].
    delay_s : float
        Time by which the sweeps were measured later than their stamps say [s].
    doppler_s : float
        Ranges read nearer by this time multiplied by the closing speed [s].
    resolution_m, offset_m : float
        Length of a bin and offset of all ranges [m].
    """

    rotation_deg: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0
    delay_s: float = 0.0
    doppler_s: float = DOPPLER_SECONDS
    resolution_m: float = MEASURED.resolution_m
    offset_m: float = MEASURED.offset_m


STEPS = {  # of numerical derivatives and of the search
    "rotation_deg": 0.3,
    "forward_m": 0.15,
    "left_m": 0.15,
    "delay_s": 0.02,
    "doppler_s": 0.02,
    "resolution_m": 0.0003,
    "offset_m": 0.15,
}


class RadarAgreement:
    """Agreement of scans with the lidar points of their turns, as a function of the calibration.

    Parameters
    ----------
    pairs : sequence of Pair
        Motion-compensated pairs; those without lidar points in the range are left out.
    min_range, max_range : float
        Range of the lidar points used [m].
    max_points : int
        Most points of a scan, taken at a regular interval.
    """

    def __init__(
        self, pairs: Sequence[Pair], min_range: float = 5.0, max_range: float = 50.0, max_points: int = 1500
    ) -> None:
        clouds = [crop_range(pair.lidar_points, max_range, min_range) for pair in pairs]
        self.points = [cloud[:: len(cloud) // max_points + 1] for cloud in clouds if len(cloud)]
        pairs = [pair for pair, cloud in zip(pairs, clouds, strict=True) if len(cloud)]
        self.images = [_sharpen_polar(pair.radar.power) for pair in pairs]
        self.azimuths = [pair.radar.azimuths for pair in pairs]
        self.twists = [pair.scan.twist for pair in pairs]

    def scores(self, calibration: Calibration) -> np.ndarray:
        """Compute the mean sharpened power at the lidar points of every scan, shape (n,).

        Parameters
        ----------
        calibration : Calibration
            The radar's geometry.
        """
        found = []
        for image, azimuths, twist, points in zip(
            self.images, self.azimuths, self.twists, self.points, strict=True
        ):
            rows, bins = _beam_at(points, calibration, azimuths, twist)
            values = cv2.remap(image, bins[:, None], rows[:, None], cv2.INTER_LINEAR)
            found.append(float(values.mean()))
        return np.array(found)

    def fit(
        self, names: Sequence[str], start: Calibration | None = None
    ) -> tuple[Calibration, dict[str, float]]:
        """Find the calibration of the best agreement.

        Parameters
        ----------
        names : sequence of str
            Fields of `Calibration` to estimate; the others stay as in `start`.
        start : Calibration, optional
            Where to begin.

        Returns
        -------
        calibration : Calibration
            The best one; nan without any lidar point in range.
        errors : dict
            Standard error of each field estimated, from the spread of the scans' gradients (scans taken as
            independent, which neighbours in one street are not).
        """
        if not self.points:
            return Calibration(*[np.nan] * 7), dict.fromkeys(names, np.nan)
        start, steps = start or Calibration(), np.array([STEPS[name] for name in names])
        origin = np.array([getattr(start, name) for name in names])

        def per_scan(x: np.ndarray) -> np.ndarray:
            values = dict(zip(names, (origin + steps * x).tolist(), strict=True))
            return self.scores(replace(start, **values))

        n = len(names)
        simplex = np.vstack([np.zeros(n), np.eye(n)])
        options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 1e-4, "maxfev": 150 * n}
        best = minimize(
            lambda x: -float(per_scan(x).mean()), np.zeros(n), method="Nelder-Mead", options=options
        ).x
        values = dict(zip(names, (origin + steps * best).tolist(), strict=True))
        errors = steps * _sandwich_errors(per_scan, best)
        return replace(start, **values), dict(zip(names, errors.tolist(), strict=True))


def _sandwich_errors(per_scan, best: np.ndarray, h: float = 0.5) -> np.ndarray:
    """Compute standard errors of an extremum from gradients per scan and the common curvature."""
    n, unit = len(best), h * np.eye(len(best))
    gradients = np.array([(per_scan(best + e) - per_scan(best - e)) / (2.0 * h) for e in unit]).T
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
            values = [a * b * per_scan(best + a * unit[i] + b * unit[j]).mean() for a, b in signs]
            curvature[i, j] = sum(values) / (4.0 * h * h)
    inverse = np.linalg.pinv(curvature) / len(gradients)
    gradients = gradients - gradients.mean(axis=0)
    return np.sqrt(np.diag(inverse @ (gradients.T @ gradients) @ inverse))


def _sharpen_polar(power: np.ndarray) -> np.ndarray:
    """Subtract the mean of 8 m along range and smooth by about the radar's own point spread."""
    values = power.astype(np.float32)
    values = gaussian_filter(
        values - uniform_filter1d(values, 183, axis=1), (0.7, 3.0), mode=("wrap", "nearest")
    )
    return np.concatenate([values[-1:], values, values[:1]])


def _beam_at(
    points: np.ndarray, c: Calibration, azimuths: np.ndarray, twist: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute row (plus one) and bin at which the moving radar saw places given at mid-scan."""
    turn = np.deg2rad(c.rotation_deg)
    moved = transform_points((c.forward_m, c.left_m, turn), points) + c.delay_s * np.asarray(twist[:2])
    n, step = len(azimuths), (azimuths[0] - azimuths[-1]) / (len(azimuths) - 1)
    seen = moved
    for _ in range(2):
        rows = (
            np.mod(-np.arctan2(seen[:, 1], seen[:, 0]) + azimuths[0] + 0.5 * step, 2.0 * np.pi) / step - 0.5
        )
        seconds = (rows / n - 0.5) * SCAN_SECONDS
        yaw = twist[2] * seconds
        d = moved - seconds[:, None] * np.asarray(twist[:2])
        cos, sin = np.cos(yaw), np.sin(yaw)
        seen = np.column_stack([cos * d[:, 0] + sin * d[:, 1], cos * d[:, 1] - sin * d[:, 0]])
    ranges = np.hypot(seen[:, 0], seen[:, 1])
    ranges = ranges - c.doppler_s * (seen @ np.asarray(twist[:2])) / np.maximum(ranges, 1e-6)
    bins = (ranges - c.offset_m) / c.resolution_m - 0.5
    return (rows + 1.0).astype(np.float32), bins.astype(np.float32)


def measure_walls(pairs: Sequence[Pair], calibration: Calibration) -> pd.DataFrame:
    """Find walls that lidar and radar see in the same direction.

    A wall is the first surface in the direction of a radar row, if its lidar points within 0.35 m of range
    span 1.5 m of height or more. Its radar echo is the strongest one within 1.2 m.

    Parameters
    ----------
    pairs : sequence of Pair
        Motion-compensated pairs.
    calibration : Calibration
        The radar's geometry; its ranges serve to look for echoes only.

    Returns
    -------
    walls : pandas.DataFrame
        One row per wall and radar row: ``scan`` (number of the pair), ``range_m`` by the lidar, as the moving
        radar would measure it with the Doppler shift, ``bin`` of the echo, ``aside`` (absolute sine of the
        bearing).
    """
    found = []
    for number, pair in enumerate(pairs):
        points = crop_range(pair.cloud, 50.0, 4.0)
        points = points[(points[:, 2] > -1.0) & (points[:, 2] < 4.0)]
        one_metre = replace(calibration, resolution_m=1.0, offset_m=-0.5)  # the bin is the range in metres
        azimuths = pair.radar.azimuths
        rows, ranges = _beam_at(points[:, :2], one_metre, azimuths, pair.scan.twist)
        nearest = np.rint(rows - 1.0).astype(int) % len(azimuths)
        smooth = gaussian_filter1d(pair.radar.power.astype(np.float32), 2.0, axis=1)
        order = np.lexsort((ranges, nearest))
        for part in np.split(order, np.flatnonzero(np.diff(nearest[order])) + 1):
            row = nearest[part[0]]
            first = part[ranges[part] < ranges[part[0]] + 0.35]
            if len(first) < 5 or np.ptp(points[first, 2]) < 1.5:
                continue
            wall = float(np.median(ranges[first]))
            echo = _find_echo(smooth[row], (wall - calibration.offset_m) / calibration.resolution_m - 0.5)
            found.append((number, wall, echo, abs(np.sin(azimuths[row]))))
    table = pd.DataFrame(found, columns=["scan", "range_m", "bin", "aside"], dtype=float)
    return table[np.isfinite(table.bin)].reset_index(drop=True)


def _find_echo(power: np.ndarray, middle: float, reach: int = 28, min_power: float = 70.0) -> float:
    """Find the strongest echo near a bin, to a fraction of a bin; nan if it is weak or lies at the border."""
    first = max(round(middle) - reach, 0)
    part = power[first : first + 2 * reach + 1]
    best = int(np.argmax(part))
    if not 0 < best < len(part) - 1 or part[best] < min_power:
        return np.nan
    left, top, right = part[best - 1 : best + 2]
    bend = left - 2.0 * top + right
    return first + best + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)


def fit_ranges(walls: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Fit length of a bin and offset of the radar's ranges to walls.

    Parameters
    ----------
    walls : pandas.DataFrame
        As of `measure_walls`.

    Returns
    -------
    values, errors : array, shape (2,)
        Resolution and offset [m], and their standard errors by leaving out one scan at a time; nan with fewer
        than 20 walls.
    """

    def fit(table: pd.DataFrame) -> np.ndarray:
        weights = np.ones(len(table))
        for _ in range(20):  # iteratively reweighted: distances beyond 0.1 m count linearly
            line = np.polyfit(table.bin + 0.5, table.range_m, 1, w=np.sqrt(weights))
            weights = 1.0 / np.hypot(1.0, (np.polyval(line, table.bin + 0.5) - table.range_m) / 0.1)
        return line

    if len(walls) < 20:
        return np.full(2, np.nan), np.full(2, np.nan)
    scans = walls.scan.unique()
    others = (
        np.array([fit(walls[walls.scan != scan]) for scan in scans])
        if len(scans) > 1
        else np.full((1, 2), np.nan)
    )
    errors = np.sqrt((len(scans) - 1) * ((others - others.mean(axis=0)) ** 2).mean(axis=0))
    return fit(walls), errors


def calibrate(pairs: Sequence[Pair]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Calibrate the radar against the lidar: rotation and shift, delay and Doppler constant, ranges.

    Parameters
    ----------
    pairs : sequence of Pair
        Motion-compensated pairs.

    Returns
    -------
    table : pandas.DataFrame
        Columns ``value`` and ``error`` (standard error) of ``rotation_deg``, ``forward_m``, ``left_m``
        (fitted together), the rotation by points near and far from the radar alone, ``delay_ms``,
        ``doppler_s`` (fitted together with a rotation and a shift to the left), ``resolution_m`` and
        ``offset_m`` (fitted to the walls), and the offset with that resolution by walls beside, and ahead or
        behind, alone; ``beyond_m``, the median distance by which the ranges used in this project show walls
        too far away.
    walls : pandas.DataFrame
        As of `measure_walls`.
    """
    agreement = RadarAgreement(pairs)
    placed, errors = agreement.fit(["rotation_deg", "forward_m", "left_m"])
    rows = {name: (getattr(placed, name), error) for name, error in errors.items()}
    for limits in ((5.0, 20.0), (20.0, 50.0)):
        ring, errors = RadarAgreement(pairs, *limits).fit(["rotation_deg"], placed)
        rows["rotation_deg, {:.0f} to {:.0f} m".format(*limits)] = ring.rotation_deg, errors["rotation_deg"]
    timed, errors = agreement.fit(["rotation_deg", "left_m", "delay_s", "doppler_s"])
    rows["delay_ms"] = 1e3 * timed.delay_s, 1e3 * errors["delay_s"]
    rows["doppler_s"] = timed.doppler_s, errors["doppler_s"]
    walls = measure_walls(pairs, placed)
    ranges, range_errors = fit_ranges(walls)
    rows |= dict(zip(("resolution_m", "offset_m"), zip(ranges, range_errors, strict=True), strict=True))
    offsets = walls.range_m - (walls.bin + 0.5) * ranges[0]
    for name, is_there in {"beside": walls.aside > 0.8, "ahead or behind": walls.aside < 0.6}.items():
        by_scan = offsets[is_there].groupby(walls.scan[is_there]).median()
        rows[f"offset_m, walls {name}"] = offsets[is_there].median(), by_scan.sem()
    beyond = (walls.bin + 0.5) * MEASURED.resolution_m + MEASURED.offset_m - walls.range_m
    rows["beyond_m"] = beyond.median(), beyond.groupby(walls.scan).median().sem()
    return pd.DataFrame(rows, index=["value", "error"]).T, walls


# ---- ground ----


def fit_ground(cloud: np.ndarray, radius_m: float = 25.0, near: float = 0.5) -> tuple[float, float, float]:
    """Fit a plane to the ground around the vehicle.

    Parameters
    ----------
    cloud : array, shape (n, 3) or more columns
        Points in the radar frame [m].
    radius_m : float
        Points farther away are left out [m].
    near : float
        The first plane is level, at the most frequent height below -1 m; points within this distance of a
        plane count for the next one, which then shrinks to 0.15 m [m].

    Returns
    -------
    height, forward, left : float
        Height below the radar [m] and slopes, rise per metre forward and to the left; nan with fewer than 100
        points.
    """
    points = crop_range(cloud, radius_m, 3.0)[:, :3]
    points = points[(points[:, 2] < -1.0) & (points[:, 2] > -3.5)]
    if len(points) < 100:
        return float("nan"), float("nan"), float("nan")
    counts, edges = np.histogram(points[:, 2], np.arange(-3.5, -0.95, 0.1))
    plane = np.array([edges[np.argmax(counts)] + 0.05, 0.0, 0.0])
    columns = np.column_stack([np.ones(len(points)), points[:, :2]])
    for limit in (near, 0.3, 0.15, 0.15):
        kept = np.abs(points[:, 2] - columns @ plane) < limit
        plane, *_ = np.linalg.lstsq(columns[kept], points[kept, 2], rcond=None)
    return tuple(float(value) for value in plane)


# ---- kinds of points ----


def distance_from_path(points: np.ndarray, scan: PairedScan, path: np.ndarray | None) -> np.ndarray:
    """Compute the distance of points from the path of the vehicle.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame of a scan [m].
    scan : PairedScan
        The scan.
    path : array, shape (m, 3), or None
        Poses in the frame of ``scan.pose`` [m, m, rad], continued straight on for 80 m at both ends; without
        it the path is a straight line through the radar.

    Returns
    -------
    distances : array, shape (n,)
        Distances [m].
    """
    own = np.zeros((1, 3))
    if path is not None and scan.pose is not None:
        own = relative_pose(np.broadcast_to(scan.pose, path.shape), path)
    ahead = np.arange(0.25, 80.0, 0.25)
    ends = [
        pose[:2] + sign * ahead[:, None] * (np.cos(pose[2]), np.sin(pose[2]))
        for pose, sign in ((own[0], -1.0), (own[-1], 1.0))
    ]
    return cKDTree(np.vstack([*ends, own[:, :2]])).query(points)[0]


def describe_points(points: np.ndarray, pair: Pair, path: np.ndarray | None = None) -> pd.DataFrame:
    """Describe each point of a front end by what the lidar has around it.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points of the pair's scan [m].
    pair : Pair
        The scan with its sweeps.
    path : array, shape (m, 3), optional
        Path of the vehicle, see `distance_from_path`.

    Returns
    -------
    table : pandas.DataFrame
        One row per point: ``distance_m`` to the nearest lidar point, ``top_m`` (highest lidar point in that
        pixel, above the ground), ``from_path_m``, and ``is_hidden``: more than 1 m farther than the first
        lidar point in its direction, where the lidar cannot confirm or refute it.
    """
    distances, nearest = cKDTree(pair.lidar_points).query(points)
    others = crop_range(pair.lidar_points, min_range=OWN_VEHICLE_M)
    tops = np.append(pair.tops, np.nan)  # the last one for points without any lidar point
    return pd.DataFrame(
        {
            "distance_m": distances,
            "top_m": tops[nearest],
            "from_path_m": distance_from_path(points, pair.scan, path),
            "is_hidden": np.hypot(*points.T) > _first_ranges(points, others) + 1.0,
        }
    )


def _first_ranges(points: np.ndarray, lidar: np.ndarray, n_sectors: int = 360) -> np.ndarray:
    """Find the range of the nearest lidar point within 1.5 sectors of each point's direction;
    infinite without one [m]."""
    sector, own = (
        (np.mod(np.arctan2(p[:, 1], p[:, 0]), 2.0 * np.pi) / (2.0 * np.pi) * n_sectors).astype(int)
        % n_sectors
        for p in (lidar, points)
    )
    first = np.full(n_sectors, np.inf)
    np.minimum.at(first, sector, np.hypot(*lidar.T))
    return minimum_filter1d(first, 3, mode="wrap")[own]


def tabulate_kinds(
    pairs: Sequence[Pair], points: Sequence[Mapping[str, np.ndarray]], path: np.ndarray | None = None
) -> pd.DataFrame:
    """Tabulate where the points of front ends lie, which are right,
    and what the lidar has where they are wrong.

    Parameters
    ----------
    pairs : sequence of Pair
        The pairs.
    points : sequence of mapping
        Of each pair: front end -> points, shape (n, 2) [m].
    path : array, shape (m, 3), optional
        Path of the vehicle, see `distance_from_path`.

    Returns
    -------
    table : pandas.DataFrame
        One row per front end, percentages over all pairs: of ``points`` by distance from the path; of these
        ``within 1 m`` of a lidar point; of the ``lidar points reached`` within 1 m, by the height of the
        highest in the pixel; and of points ``over 2 m off``, all and those in view, see `describe_points`.
    """
    found, lidar = [], []
    for pair, clouds in zip(pairs, points, strict=True):
        for name, cloud in clouds.items():
            found.append(describe_points(cloud, pair, path).assign(front_end=name))
            near = nn_distances(pair.lidar_points, cloud) < 1.0
            lidar.append(pd.DataFrame({"front_end": name, "top_m": pair.tops, "near": near}))
    kinds, reach = pd.concat(found), pd.concat(lidar)
    zone = pd.cut(
        kinds.from_path_m, [0, 4, 10, np.inf], labels=["0-4 m", "4-10 m", "beyond"], include_lowest=True
    )
    height = pd.cut(reach.top_m, [-np.inf, 1.0, 2.5, np.inf], labels=["below 1 m", "1-2.5 m", "higher"])
    is_off = kinds.distance_m >= 2.0
    kinds = kinds.assign(
        zone=zone, right=kinds.distance_m < 1.0, all=is_off, in_view=is_off & ~kinds.is_hidden
    )
    own = kinds.groupby("front_end", sort=False)
    by_zone = kinds.groupby(["front_end", "zone"], sort=False, observed=False)
    by_height = reach.assign(height=height).groupby(["front_end", "height"], sort=False, observed=False)
    parts = {
        "points": by_zone.size().unstack().div(own.size(), axis=0),
        "within 1 m": by_zone.right.mean().unstack(),
        "lidar points reached": by_height.near.mean().unstack(),
        "over 2 m off": own[["all", "in_view"]].mean(),
    }
    return 100.0 * pd.concat(parts, axis=1)


def tabulate_corrected(
    pairs: Sequence[Pair], points: Sequence[Mapping[str, np.ndarray]], rotation_deg: float, beyond_m: float
) -> pd.DataFrame:
    """Compare points as they are, and with a rotation and a range error removed,
    with the lidar points of pairs.

    Parameters
    ----------
    pairs : sequence of Pair
        The pairs.
    points : sequence of mapping
        Of each pair: front end -> points, shape (n, 2) [m].
    rotation_deg : float
        Rotation of the radar against the lidar, counter-clockwise [deg].
    beyond_m : float
        Distance by which the radar shows things too far away [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per front end; of "as is" and "corrected" the percentages within 0.25, 0.5 and 1 m, means over
        pairs.
    """
    rows = []
    for pair, clouds in zip(pairs, points, strict=True):
        for name, cloud in clouds.items():
            ranges = np.hypot(*cloud.T)
            nearer = cloud * (1.0 - beyond_m / np.maximum(ranges, 1.0))[:, None]
            turned = transform_points((0.0, 0.0, -np.deg2rad(rotation_deg)), nearer)
            for words, some in (("as is", cloud), ("corrected", turned)):
                away = nn_distances(some, pair.lidar_points)
                fractions = {f"{r:g} m": 100.0 * fraction_within(away, r) for r in (0.25, 0.5, 1.0)}
                rows.append({"front_end": name, "points": words} | fractions)
    table = pd.DataFrame(rows).groupby(["front_end", "points"], sort=False).mean().unstack()
    return table.swaplevel(axis=1)[["as is", "corrected"]]


def tabulate_on_map(
    pairs: Sequence[Mapping[tuple[str, str], Pair]],
    points: Sequence[Mapping[str, np.ndarray]],
    poses: Mapping[int, np.ndarray],
    map_tree: cKDTree,
) -> pd.DataFrame:
    """Compute the precision of lidar points and of front ends on a map.

    Parameters
    ----------
    pairs : sequence of mapping
        Of each scan: what `load_scan_pairs` returns.
    points : sequence of mapping
        Of each scan: front end -> motion-compensated points, shape (n, 2) [m].
    poses : mapping
        Stamp of a scan [us] -> its pose on the map; scans without one are left out.
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].

    Returns
    -------
    table : pandas.DataFrame
        Rows "lidar, nearest", "lidar, turn" and the front ends: ``share_1m`` and ``share_2m`` (0..1) and
        ``n`` points, means over scans. Empty without a scan on the map.
    """
    rows = []
    for of_scan, clouds in zip(pairs, points, strict=True):
        own = {sweeps: of_scan[motion, sweeps] for motion, sweeps in of_scan if motion == "compensated"}
        stamps = {pair.scan.stamp_us for pair in own.values()} & set(poses)
        of_lidar = {f"lidar, {sweeps}": pair.lidar_points for sweeps, pair in own.items()}
        for stamp in stamps:
            for name, cloud in {**of_lidar, **clouds}.items():
                rows.append({"points": name, **evaluate_on_map(cloud, poses[stamp], map_tree)})
    table = pd.DataFrame(rows, columns=["points", "share_1m", "share_2m", "n"])
    return table.groupby("points", sort=False).mean()


# ---- front ends ----


def front_end_points(
    pair: Pair, networks: Mapping[str, TrainedNetwork], bf16: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Compute the points of every front end from the scan of a pair.

    Parameters
    ----------
    pair : Pair
        The scan; its motion applies.
    networks : mapping
        Name -> network.
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    points : dict of array, shape (n, 2)
        "k-strongest", "cfar" and the networks -> points [m].
    images : dict of array, shape (512, 512), uint8
        Network -> generated image.
    """
    scan = pair.radar
    points = {d: detect_points(scan.power, scan.azimuths, pair.twist, detector=d) for d in DETECTORS}
    images = {}
    for name, network in networks.items():
        points[name], _, images[name] = generate_points(
            network, scan.power, scan.azimuths, pair.twist, bf16=bf16
        )
    return points, images


def tabulate(pair: Pair, points: Mapping[str, np.ndarray]) -> list[dict[str, object]]:
    """Compare the points of every front end with the lidar points of a pair.

    Parameters
    ----------
    pair : Pair
        The pair.
    points : mapping
        Front end -> points, shape (n, 2) [m].

    Returns
    -------
    rows : list of dict
        One row per front end with the keys `COLUMNS`.
    """
    forward, left = pair.misalignment
    rows = []
    for name, cloud in points.items():
        row = {
            "timestamp_us": pair.scan.stamp_us,
            "front_end": name,
            "motion": pair.motion,
            "sweeps": pair.sweeps,
        }
        row |= compare_points(cloud, pair.lidar_points)
        rows.append(row | {"misalignment_forward_m": forward, "misalignment_left_m": left})
    return rows
