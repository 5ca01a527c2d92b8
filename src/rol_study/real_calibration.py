"""Calibrate real radar scans against the lidar sweeps of the same moment: times, rotation, ranges.

Everything is in the radar frame, x forward, y left [m]. Pairs are those of `rol_study.real_pairs`, with
motion compensated by the velocity of the official odometry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol.lidar import crop_range
from rol.oxford import compose_odometry, load_radar_odometry, load_velodyne_binary
from rol.radar import DOPPLER_SECONDS, MEASURED, SCAN_SECONDS, RangeCalibration
from rol_data.oxford_pairs import Sweep, load_sweep_points, sweep_start
from rol_study.real_pairs import Pair

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


@dataclass(frozen=True, eq=False)
class SweepTimes:
    """When the points of sweeps were measured, see `measure_times`.

    Attributes
    ----------
    intervals_ms, turned_deg : array, shape (n,)
        As of `measure_stamps`.
    apart_m : array, shape (k, s)
        As of `sweep_consistency`.
    numbers : dict
        ``place``, ``place_error``, ``n_intervals`` as of `locate_stamp`; ``span_ms``, ``span_error`` as of
        `fit_span` [ms]. NaN where they cannot be measured.
    """

    intervals_ms: np.ndarray
    turned_deg: np.ndarray
    apart_m: np.ndarray
    numbers: dict[str, float]


def measure_times(
    sweeps: Sequence[Sweep], odometry_path: Path | None, spans_s: Sequence[float], rng: np.random.Generator
) -> SweepTimes:
    """Measure what the stamp of a sweep means, and how long a sweep takes.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Sweeps; those of the first lidar that are .bin files are used, 600 at most.
    odometry_path : path or None
        As in `sweep_consistency`; without it the duration is not measured.
    spans_s, rng
        As in `sweep_consistency` and `fit_span`.

    Returns
    -------
    times : SweepTimes
        Arrays without rows, and NaN, with fewer than 31 sweeps.
    """
    plain = [sweep for sweep in sweeps if sweep.path.suffix == ".bin"]
    plain = [sweep for sweep in plain if sweep.lidar == plain[0].lidar][:600]
    intervals, turned, apart = np.zeros(0), np.zeros(0), np.zeros((0, len(spans_s)))
    place: tuple[float, float, int] = (np.nan, np.nan, 0)
    if len(plain) > 30:
        intervals, turned = measure_stamps(plain)
        place = locate_stamp(intervals, turned)
        if odometry_path is not None:
            apart = sweep_consistency(plain, odometry_path, spans_s)
    span, error = fit_span(spans_s, apart, rng)
    numbers = dict(zip(("place", "place_error", "n_intervals"), place, strict=True))
    numbers |= {"span_ms": 1e3 * span, "span_error": 1e3 * error}
    return SweepTimes(intervals, turned, apart, numbers)


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


RINGS_M = (4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 50.0)  # of `evaluate_ranges` [m]
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
        self.images = [pair.sharpened for pair in pairs]
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


def _sandwich_errors(
    per_scan: Callable[[np.ndarray], np.ndarray], best: np.ndarray, h: float = 0.5
) -> np.ndarray:
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


def describe_calibration(calibration: pd.DataFrame, walls: pd.DataFrame) -> dict[str, float]:
    """Name the values and errors of `calibrate` for a text: `<name>`, `<name>_error`, and `n_walls`."""
    named = calibration[~calibration.index.str.contains(",")]
    errors = named.error.add_suffix("_error")
    return {**named.value.to_dict(), **errors.to_dict(), "n_walls": len(walls)}


def evaluate_ranges(
    walls: pd.DataFrame, calibrations: Mapping[str, RangeCalibration], edges_m: Sequence[float] = RINGS_M
) -> pd.DataFrame:
    """Compute by how much calibrations show walls beyond their lidar points, by range.

    Parameters
    ----------
    walls : pandas.DataFrame
        As of `measure_walls`.
    calibrations : mapping of str to RangeCalibration
        Label -> calibration.
    edges_m : sequence of float
        Edges of the intervals of range [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per interval: median ``range_m`` of its walls, and one column per calibration with the median
        distance beyond the lidar points [m].
    """
    rings = pd.cut(walls.range_m, list(edges_m))
    columns = {"range_m": walls.range_m}
    for name, used in calibrations.items():
        columns[name] = (walls.bin + 0.5) * used.resolution_m + used.offset_m - walls.range_m
    return pd.DataFrame(columns).groupby(rings, observed=True).median()
