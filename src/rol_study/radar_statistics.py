"""Compute statistics of radar scans, real or simulated: brightness, noise, point spread, code histogram.

Every function takes the power codes of one scan, shape (400, 3768), or of several, shape (n, 400, 3768), and
pools all of them. Comparing the numbers of real and simulated scans validates the
simulator. Rows are azimuths and neighbours in time (the turn is not closed); columns are range bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.geometry import relative_pose, transform_points
from rol.lidar import crop_range, remove_ground
from rol.oxford import Session, load_radar
from rol.pairs import load_lidar_points, usable_sweeps
from rol.radar import MEASURED, RangeCalibration, ScanMotion, k_strongest_peaks, polar_to_cartesian
from rol.similarity import fraction_within, nn_distances
from rol_sim.sensors.radar import beam_azimuths

BRIGHTNESS_CODES = (40, 60, 80, 100, 120)
ZERO_RANGES_M = (3.0, 28.0, 41.0, 80.0, 106.0, 145.0)
NEAR_RANGES_M = (0.0, 0.86, 2.0, 3.0)
PEAK_EDGES = (0, 110, 130, 133, 256)
QUIET_CODE = 30  # a piece of a row whose codes stay below this holds noise and little else
FAR_BIN = 3000
HALF_TURN_US = 125_000


def forbidden_codes() -> np.ndarray:
    """List the codes that cannot occur, because the sensor's powers are integers.

    Returns
    -------
    codes : array, shape (11,), uint8
        1-5, 7, 8, 10, 11, 13, 16: what round(6.0206 (e + m)) skips for n = 2^e (1 + m) = 1, 2, 3, ...
    """
    mantissa, exponent = np.frexp(np.arange(1.0, 64.0))
    reachable = np.round(20.0 * np.log10(2.0) * (exponent + 2.0 * mantissa - 2.0))
    return np.setdiff1d(np.arange(24), reachable).astype(np.uint8)


def _brightness_fractions(
    codes: np.ndarray, codes_from: tuple[int, ...] = BRIGHTNESS_CODES
) -> dict[int, float]:
    """Compute the fraction of pixels at or above each code.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    codes_from : tuple of int
        Codes to count from.

    Returns
    -------
    fractions : dict
        Code -> fraction of all pixels [0..1].
    """
    counts = np.bincount(np.asarray(codes).ravel(), minlength=256)
    tail = counts[::-1].cumsum()[::-1] / counts.sum()
    return {code: float(tail[code]) for code in codes_from}


def code_histogram(codes: np.ndarray) -> np.ndarray:
    """Compute the fraction of pixels of every code.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.

    Returns
    -------
    fractions : array, shape (256,)
        They sum to one.
    """
    counts = np.bincount(np.asarray(codes).ravel(), minlength=256)
    return counts / counts.sum()


def hellinger_distance(p: np.ndarray, q: np.ndarray) -> float:
    """Compute the distance of two histograms: 0 for equal ones, 1 for those without a common code.

    Parameters
    ----------
    p, q : array, shape (n,)
        Histograms that sum to one.

    Returns
    -------
    distance : float
        Root of one minus the sum of sqrt(p q).
    """
    return float(np.sqrt(max(0.0, 1.0 - np.sum(np.sqrt(np.asarray(p) * np.asarray(q))))))


def zero_fractions(
    codes: np.ndarray, ranges_m: tuple[float, ...] = ZERO_RANGES_M, half_bins: int = 15
) -> dict:
    """Compute the fraction of code 0 in quiet bins at several ranges.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    ranges_m : tuple of float
        Ranges, counted as bin * MEASURED.resolution_m [m].
    half_bins : int
        Pieces of 2 * half_bins bins around a range are used; those that reach code 30 are discarded.

    Returns
    -------
    fractions : dict
        Range [m] -> fraction of zeros [0..1]; NaN where no piece is quiet.
    """
    scans = _rows(codes)
    fractions = {}
    for range_m in ranges_m:
        middle = round(range_m / MEASURED.resolution_m)
        piece = scans[:, max(middle - half_bins, 0) : middle + half_bins]
        quiet = piece[piece.max(axis=1) < QUIET_CODE]
        fractions[range_m] = float((quiet == 0).mean()) if len(quiet) else float("nan")
    return fractions


def _noise_correlation(codes: np.ndarray, lags: int = 7, bins: tuple[int, int] = (700, 1100)) -> list[float]:
    """Estimate the correlation of noise along the range, in quiet bins.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    lags : int
        Greatest distance in bins.
    bins : tuple of int
        Range bins to use; the quieter 30 % of the rows (by their greatest code there) are taken.

    Returns
    -------
    correlation : list of float
        Pearson correlation at lags 1..lags.
    """
    piece = _rows(codes)[:, slice(*bins)]
    greatest = piece.max(axis=1)
    quiet = piece[greatest <= np.percentile(greatest, 30)].astype(np.float64)
    quiet -= quiet.mean(axis=1, keepdims=True)
    power = float((quiet**2).mean())
    return [
        float((quiet[:, :-lag] * quiet[:, lag:]).mean() / max(power, 1e-12)) for lag in range(1, lags + 1)
    ]


def azimuth_correlation(codes: np.ndarray, bins: tuple[int, int] = (1500, 1900)) -> float:
    """Estimate the correlation of noise between neighbouring azimuths.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    bins : tuple of int
        Range bins to use; pairs of neighbours that are both among the quieter 30 % are taken.

    Returns
    -------
    correlation : float
        Pearson correlation of codes; NaN when no two quiet rows are neighbours.
    """
    scans = np.asarray(codes).reshape((-1,) + np.shape(codes)[-2:])[:, :, slice(*bins)]
    greatest = scans.max(axis=2)
    quiet = greatest <= np.percentile(greatest, 30)
    both = quiet[:, :-1] & quiet[:, 1:]
    if not both.any():
        return float("nan")
    return float(np.corrcoef(scans[:, :-1][both].ravel(), scans[:, 1:][both].ravel())[0, 1])


def near_field(codes: np.ndarray, ranges_m: tuple[float, ...] = NEAR_RANGES_M) -> dict[float, float]:
    """Compute the mean code of the leakage close to the sensor.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    ranges_m : tuple of float
        Ranges, counted as bin * MEASURED.resolution_m [m].

    Returns
    -------
    codes : dict
        Range [m] -> mean code over all rows.
    """
    scans = _rows(codes)
    return {r: float(scans[:, round(r / MEASURED.resolution_m)].mean()) for r in ranges_m}


def _floor_by_peak(codes: np.ndarray, edges: tuple[int, ...] = PEAK_EDGES) -> dict[str, float]:
    """Compute the noise floor at far range, for rows grouped by their strongest return.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    edges : tuple of int
        Edges of the classes of the strongest code beyond bin 60.

    Returns
    -------
    floors : dict
        "low-high" -> median over the rows of the median code beyond bin 3000; NaN for an empty class.
    """
    scans = _rows(codes)
    peaks, floors = scans[:, 60:].max(axis=1), np.median(scans[:, FAR_BIN:], axis=1)
    classes = {}
    for low, high in pairwise(edges):
        inside = floors[(peaks >= low) & (peaks < high)]
        classes[f"{low}-{high}"] = float(np.median(inside)) if len(inside) else float("nan")
    return classes


def point_spread(codes: np.ndarray, reach: tuple[int, int] = (5, 16)) -> dict[str, list[float]]:
    """Measure the point spread over azimuth and range, from strong peaks.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    reach : tuple of int
        How many rows and bins to each side.

    Returns
    -------
    spread : dict
        "azimuth_db" and "range_db": median level relative to the strongest cell at 0, 1, 2, ... rows or bins
        away [dB], both sides pooled, over peaks of code 116 and more; empty lists when there is none.
    """
    rows_off, bins_off = reach
    scans = np.asarray(codes).reshape((-1,) + np.shape(codes)[-2:]).astype(np.int16)
    column = scans[:, :, 60:-bins_off].argmax(axis=2) + 60
    azimuth, range_ = [], []
    for scan, row in np.argwhere(scans[:, :, 60:-bins_off].max(axis=2) >= 116):
        bin_ = column[scan, row]
        if not rows_off <= row < scans.shape[1] - rows_off:
            continue
        across = scans[scan, row - rows_off : row + rows_off + 1, bin_]
        if across.max() == across[rows_off]:
            azimuth.append(across - across[rows_off])
            range_.append(scans[scan, row, bin_ - bins_off : bin_ + bins_off + 1] - across[rows_off])
    return {"azimuth_db": _fold(azimuth), "range_db": _fold(range_)}


def motion_statistics(
    codes: np.ndarray,
    poses: np.ndarray,
    *,
    lag: int = 5,
    scan_seconds: float = 0.25,
    doppler_seconds: tuple[float, ...] = tuple(np.arange(-0.06, 0.1501, 0.01)),
) -> dict:
    """Measure the effect of motion compensation and Doppler correction on the agreement of scans.

    Scans some metres apart are aligned by their known poses. An object ahead in the first is abeam in the
    second, so a range error ahead reduces their correlation.

    Parameters
    ----------
    codes : array, shape (n, 400, 3768), uint8
        Successive scans, all of them from a moving car; more than ``lag``.
    poses : array, shape (n, 3)
        Poses at mid-scan in any frame (x, y, yaw) [m, m, rad].
    lag : int
        Scan i is compared with scan i + lag.
    scan_seconds : float
        Time of a turn [s].
    doppler_seconds : tuple of float
        Doppler range shifts per closing speed to try [s].

    Returns
    -------
    statistics : dict
        "metres_per_turn": mean distance driven in a turn; "correlation_raw", "correlation_motion",
        "correlation_both": mean correlation of the Cartesian images of such pairs, uncorrected, with motion
        compensation, and with the best Doppler shift as well; "doppler_seconds": that shift [s], positive
        where what is ahead reads nearer; "doppler_curve": correlation of every shift tried.
    """
    odometry, increments = relative_pose(poses[:-1], poses[1:]), relative_pose(poses[:-lag], poses[lag:])
    twists = np.vstack([odometry, odometry[-1:]]) / scan_seconds
    curve = {
        float(shift): _mean_correlation(codes, increments, lag, twists, shift) for shift in doppler_seconds
    }
    best = max(curve, key=curve.__getitem__)
    return {
        "metres_per_turn": float(np.hypot(odometry[:, 0], odometry[:, 1]).mean()),
        "correlation_raw": _mean_correlation(codes, increments, lag, None, 0.0),
        "correlation_motion": _mean_correlation(codes, increments, lag, twists, 0.0),
        "correlation_both": curve[best],
        "doppler_seconds": best,
        "doppler_curve": curve,
    }


def _mean_correlation(
    codes: np.ndarray, increments: np.ndarray, lag: int, twists: np.ndarray | None, doppler_seconds: float
) -> float:
    """Mean correlation of scans i and i + lag, as aligned images of 0.25 m per pixel."""
    azimuths = beam_azimuths()
    width, pixel, found = 512, 0.25, []
    middle = (width - 1) / 2.0
    images = [
        polar_to_cartesian(
            scan,
            azimuths,
            calibration=MEASURED,
            pixel_size=pixel,
            width=width,
            motion=None if twists is None else ScanMotion(twists[i], doppler_seconds=doppler_seconds),
        )
        for i, scan in enumerate(codes)
    ]
    away = np.hypot(*(np.mgrid[:width, :width] - middle)) * pixel
    own = np.where((away > 4.0) & (away < 50.0), np.float32(0.0), np.float32(np.nan))  # no leakage
    for before, after, (x, y, yaw) in zip(images[:-lag], images[lag:], increments, strict=True):
        # Column c and row r show the place (middle - r, middle - c) * pixel; both axes fall, so a turn stays
        # one.
        c, s = np.cos(yaw), np.sin(yaw)
        forward = np.array([[c, s, 0.0], [-s, c, 0.0]])
        forward[:, 2] = np.array([-y, -x]) / pixel + middle - forward[:, :2] @ (middle, middle)
        moved = cv2.warpAffine(after + own, forward, (width, width), borderValue=np.nan)
        seen = np.isfinite(moved + own)
        found.append(np.corrcoef(before[seen], moved[seen])[0, 1])
    return float(np.mean(found))


def scan_statistics(codes: np.ndarray) -> dict:
    """Compute all statistics of one scan or several.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.

    Returns
    -------
    statistics : dict
        "histogram": fraction of every code; "fractions": code -> fraction of pixels at or above it;
        "zero_fractions": range [m] -> fraction of code 0 in quiet bins; "range_correlation": of the noise at
        lags 1-7 bins; "azimuth_correlation"; "near_field": range [m] -> mean code; "near_copies": True when
        bins 0-4 are identical; "floors": class of peak -> far floor; "point_spread": levels [dB] by distance;
        "forbidden": number of pixels with a code that cannot occur; "greatest": greatest code;
        "fractions_40_by_range": fraction of codes >= 40 by range, edges [m] as keys.

    Raises
    ------
    ValueError
        If the last two axes are not azimuths x range bins of a full scan or the type is not uint8.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8 or codes.ndim < 2 or codes.shape[-1] < 3500:
        raise ValueError(f"codes: expected uint8 of shape (..., 400, 3768), got {codes.dtype} {codes.shape}")
    near = _rows(codes)[:, :5]
    return {
        "histogram": code_histogram(codes),
        "fractions": _brightness_fractions(codes),
        "fractions_40_by_range": _fractions_by_range(codes, 40),
        "zero_fractions": zero_fractions(codes),
        "range_correlation": _noise_correlation(codes),
        "azimuth_correlation": azimuth_correlation(codes),
        "near_field": near_field(codes),
        "near_copies": bool((near == near[:, :1]).all()),
        "floors": _floor_by_peak(codes),
        "point_spread": point_spread(codes),
        "forbidden": int(np.isin(codes, forbidden_codes()).sum()),
        "greatest": int(codes.max()),
    }


def summarize_scans(statistics: dict, reference: dict) -> dict[str, float]:
    """Select the statistics of scans that are one number each, for a table.

    Parameters
    ----------
    statistics, reference : dict
        From `scan_statistics`; the codes' histogram is compared with that of the reference.

    Returns
    -------
    rows : dict
        What it is -> number.
    """
    zeros, noise = statistics["zero_fractions"], statistics["range_correlation"]
    return {
        "Hellinger distance of the codes to real": hellinger_distance(
            statistics["histogram"], reference["histogram"]
        ),
        **{
            f"pixels with codes >= {code} [%]": 100.0 * statistics["fractions"][code]
            for code in (40, 80, 120)
        },
        **{f"code 0 in quiet bins at {r:g} m [%]": 100.0 * zeros[r] for r in (3.0, 41.0, 145.0)},
        **{f"noise correlation at {lag} bins": noise[lag - 1] for lag in (1, 3, 7)},
        "noise correlation of neighbouring azimuths": statistics["azimuth_correlation"],
        **{f"mean code of the leakage at {r:g} m": statistics["near_field"][r] for r in (0.86, 3.0)},
        "largest code": statistics["greatest"],
        "pixels with an impossible code": statistics["forbidden"],
    }


def compare_statistics(statistics: dict, reference: dict) -> dict[str, float]:
    """Compute the largest differences between the statistics of two sets of scans.

    Parameters
    ----------
    statistics, reference : dict
        From `scan_statistics`.

    Returns
    -------
    differences : dict
        "hellinger": distance of the codes' histograms; "brightness_min", "brightness_max": smallest and
        largest ratio of the fractions of pixels at or above a code; "zeros", "noise": largest absolute
        difference of the fractions of code 0 in quiet bins, and of the noise correlations along range.
    """
    names = ("fractions", "zero_fractions", "range_correlation")
    bright, zeros, noise = (
        np.array([_values(part[name]) for part in (statistics, reference)]) for name in names
    )
    occurs = bright[1] > 0
    ratios = bright[0, occurs] / bright[1, occurs]
    return {
        "hellinger": hellinger_distance(statistics["histogram"], reference["histogram"]),
        "brightness_min": float(ratios.min()),
        "brightness_max": float(ratios.max()),
        "zeros": float(np.nanmax(np.abs(zeros[0] - zeros[1]))),
        "noise": float(np.max(np.abs(noise[0] - noise[1]))),
    }


def _values(statistic: dict | list) -> list[float]:
    return list(statistic.values()) if isinstance(statistic, dict) else statistic


def _fractions_by_range(
    codes: np.ndarray, code: int, edges_m: tuple[float, ...] = (2.5, 5, 10, 20, 30, 50, 80, 110, 165)
) -> dict:
    """Compute the fraction of pixels at or above a code, ring by ring.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    code : int
        Code to count from.
    edges_m : tuple of float
        Edges of the rings, counted as bin * MEASURED.resolution_m [m].

    Returns
    -------
    fractions : dict
        "low-high" [m] -> fraction [0..1].
    """
    scans, bins = _rows(codes), [round(edge / MEASURED.resolution_m) for edge in edges_m]
    names = [f"{low:g}-{high:g}" for low, high in pairwise(edges_m)]
    fractions = [float((scans[:, low:high] >= code).mean()) for low, high in pairwise(bins)]
    return dict(zip(names, fractions, strict=True))


def map_fractions(
    codes: np.ndarray,
    poses: np.ndarray,
    map_points: np.ndarray,
    within_m: tuple[float, ...] = (1.0, 2.0),
    *,
    k: int = 12,
    min_power: int = 70,
    max_range_m: float = 64.0,
) -> np.ndarray:
    """Compute the fraction of raw radar peaks that lie near a map point, scan by scan.

    Parameters
    ----------
    codes : array, shape (n, 400, 3768), uint8
        Scans.
    poses : array, shape (n, 3)
        Their poses in the map (x, y, yaw) [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    within_m : tuple of float
        Distances [m].
    k, min_power, max_range_m : int, int, float
        The detector: strongest peaks per azimuth, weakest code, farthest range [m]; no network, no correction
        of motion.

    Returns
    -------
    fractions : array, shape (n, len(within_m))
        Fraction of the peaks of each scan; NaN for a scan without peaks.
    """
    tree, fractions = cKDTree(map_points), []
    for scan, pose in zip(codes, poses, strict=True):
        peaks = k_strongest_peaks(
            scan,
            beam_azimuths(),
            k,
            min_power,
            range_limits_m=(2.5, max_range_m),
            calibration=MEASURED,
        )
        gaps = tree.query(transform_points(pose, peaks))[0]
        fractions.append([float(np.mean(gaps < limit)) if len(gaps) else float("nan") for limit in within_m])
    return np.array(fractions)


def relate_to_lidar(
    codes: np.ndarray, azimuths: np.ndarray, points: np.ndarray, calibration: RangeCalibration
) -> dict[str, float]:
    """Compare the raw radar peaks and the lidar points of one moment, within 20 m of the car,
    in both directions.

    Parameters
    ----------
    codes : array, shape (400, n)
        Scan.
    azimuths : array, shape (400,)
        Azimuths of its rows [rad].
    points : array, shape (m, 3) or more columns
        Lidar points in the radar frame [m].
    calibration : RangeCalibration
        Range bins of the radar.

    Returns
    -------
    relation : dict
        "peaks" and "lidar points": their numbers; "peaks with a lidar point within ... m", "lidar points with
        a peak within ... m": fractions [0..1].
    """
    peaks = k_strongest_peaks(codes, azimuths, 12, 70, range_limits_m=(2.5, 30.0), calibration=calibration)
    points = crop_range(remove_ground(points), 30.0, 2.5)[:, :2]
    echoes = nn_distances(crop_range(peaks, 20.0), points)
    seen = nn_distances(crop_range(points, 20.0), peaks)
    return {
        "peaks": len(echoes),
        "lidar points": len(seen),
        **{f"peaks with a lidar point within {r:g} m": fraction_within(echoes, r) for r in (1.0, 2.0)},
        **{f"lidar points with a peak within {r:g} m": fraction_within(seen, r) for r in (0.5, 1.0, 2.0)},
    }


def summarize_agreement(motion: dict, fractions: np.ndarray) -> dict[str, float]:
    """Select what scans at known poses show about motion and map, for a table.

    Parameters
    ----------
    motion : dict
        From `motion_statistics`.
    fractions : array, shape (n, 2)
        From `map_fractions`, within 1 m and 2 m.

    Returns
    -------
    rows : dict
        What it is -> number.
    """
    return {
        "distance per turn [m]": motion["metres_per_turn"],
        "correlation of scans, as recorded": motion["correlation_raw"],
        "correlation, motion compensated": motion["correlation_motion"],
        "correlation, Doppler compensated as well": motion["correlation_both"],
        "best Doppler shift [ms]": 1e3 * motion["doppler_seconds"],
        "peaks within 1 m of the map, mean [%]": 100.0 * fractions[:, 0].mean(),
        "peaks within 1 m of the map, lowest scan [%]": 100.0 * fractions[:, 0].min(),
        "peaks within 1 m of the map, highest scan [%]": 100.0 * fractions[:, 0].max(),
        "peaks within 2 m of the map, mean [%]": 100.0 * fractions[:, 1].mean(),
    }


def relate_session(session: Session, stamps_us: Sequence[int]) -> pd.DataFrame:
    """Compare the raw radar peaks of scans with the lidar sweeps nearest to their middle.

    Parameters
    ----------
    session : Session
        The session.
    stamps_us : sequence of int
        Names of the scans [us].

    Returns
    -------
    relations : DataFrame
        One row per scan, from `relate_to_lidar`.
    """
    sweeps_us, rows = usable_sweeps(session), []
    for us in map(int, stamps_us):
        scan = load_radar(session.radar_path(us))
        nearest = {side: s[np.argmin(np.abs(s - us - HALF_TURN_US))] for side, s in sweeps_us.items()}
        points = load_lidar_points(session, nearest.get("left"), nearest.get("right"))
        rows.append(relate_to_lidar(scan.power, scan.azimuths, points, MEASURED))
    return pd.DataFrame(rows)


def _rows(codes: np.ndarray) -> np.ndarray:
    return np.asarray(codes).reshape(-1, np.shape(codes)[-1])


def _fold(profiles: list[np.ndarray]) -> list[float]:
    """Median of both sides of profiles in half dB around their middle, in dB by distance from it."""
    if not profiles:
        return []
    both = np.asarray(profiles)
    middle = both.shape[1] // 2
    folded = [np.median(both[:, [middle - k, middle + k]]) / 2.0 for k in range(middle + 1)]
    return [float(level) for level in folded]
