"""Points of real radar scans on a real lidar map and beside lidar sweeps in fog: precision, thresholds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.bev import image_to_points
from rol.geometry import compose
from rol.lidar import crop_range, remove_ground
from rol.pairs import PairSettings
from rol.pix2pix import TrainedNetwork
from rol.radar import RangeCalibration
from rol.similarity import fraction_within, nn_distances
from rol_beyond.adaptation import AdaptationConfig, RealPair, adapt
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M, detect_points, evaluate_on_map
from rol_data.radiate import RANGE_RESOLUTION, RadiatePair, radiate_azimuths
from rol_data.rall import RealScan

WRONG_HEADINGS = (1.57, 3.14, -1.57)  # at which the fraction by chance is measured [rad]
FOG = {"range_resolution": RANGE_RESOLUTION, "range_offset": 0.0}  # settings of the images of RADIATE's radar
Generate = Callable[
    ..., tuple[np.ndarray, np.ndarray, np.ndarray]
]  # as `rol_beyond.front_ends.generate_points`


# ---- precision ----


def evaluate_with_chance(points: np.ndarray, pose: np.ndarray, map_tree: cKDTree) -> dict[str, float | int]:
    """Compute the precision of a scan's points on a map, and that of the same points at wrong headings.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame [m].
    pose : array, shape (3,)
        Pose T_map_radar [m, m, rad].
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].

    Returns
    -------
    precision : dict
        As `rol_beyond.front_ends.evaluate_on_map`, with ``chance_1m`` and ``chance_2m``: the means over
        `WRONG_HEADINGS`.
    """
    wrong = [evaluate_on_map(points, compose(pose, (0.0, 0.0, turn)), map_tree) for turn in WRONG_HEADINGS]
    chance = {f"chance_{r}m": np.mean([row[f"share_{r}m"] for row in wrong]) for r in (1, 2)}
    return {**evaluate_on_map(points, pose, map_tree), **chance}


def front_end_points(
    power: np.ndarray,
    azimuths: np.ndarray,
    networks: Mapping[str, TrainedNetwork],
    generate: Generate,
    *,
    twist: Sequence[float] | None = None,
    calibration: RangeCalibration | None = None,
    cfar: Mapping[str, int] | None = None,
) -> dict[str, np.ndarray]:
    """Convert one scan into points by every front end.

    Parameters
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    networks : mapping of str to TrainedNetwork
        The networks by name.
    generate : callable
        `rol_beyond.front_ends.generate_points`, with its options.
    twist : sequence of float, optional
        Body velocity for the motion compensation [m/s, m/s, rad/s].
    calibration : RangeCalibration, optional
        Of another radar; Oxford's if not given.
    cfar : mapping, optional
        Settings of `rol_beyond.detectors.cfar_peaks` for another radar.

    Returns
    -------
    points : dict of array, shape (n, 2)
        "raw" (k strongest peaks), "cfar", and the names of the networks -> points in the radar frame [m].
    """
    own = {"calibration": calibration} if calibration else {}
    points = {"raw": detect_points(power, azimuths, twist, **own)}
    points["cfar"] = detect_points(power, azimuths, twist, detector="cfar", **own, **(cfar or {}))
    for name, network in networks.items():
        if calibration:
            range_settings = {
                "range_resolution": calibration.resolution_m,
                "range_offset": calibration.offset_m,
            }
            network = replace(network, settings=network.settings | range_settings)
        points[name] = generate(network, power, azimuths, twist)[0]
    return points


def evaluate_front_ends(
    scans: Sequence[RealScan],
    networks: Mapping[str, TrainedNetwork],
    chosen: str,
    map_tree: cKDTree,
    generate: Generate,
) -> tuple[pd.DataFrame, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Evaluate the points of all front ends on a map.

    Parameters
    ----------
    scans : sequence of RealScan
        Scans with their poses.
    networks : mapping of str to TrainedNetwork
        The networks by name.
    chosen : str
        Name of the network that is also evaluated without thinning, and with one heading only.
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].
    generate : callable
        As in `front_end_points`.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan and front end: ``timestamp_us``, ``points`` (the front end), ``n``, ``share_1m``,
        ``share_2m``, ``chance_1m``, ``chance_2m``.
    results : list of tuple
        Points, radar image and generated image of the chosen network, per scan.
    """
    rows, results, network = [], [], networks[chosen]
    for scan in scans:
        results.append(generate(network, scan.power, scan.azimuths, scan.twist))
        others = {name: other for name, other in networks.items() if name != chosen}
        points = front_end_points(scan.power, scan.azimuths, others, generate, twist=scan.twist)
        points[chosen] = results[-1][0]
        points = {name: points[name] for name in ("raw", "cfar", *networks)}
        if network.points["thin"]:
            thick = {**network.points, "thin": False, "min_range": MIN_RANGE_M}
            points[f"{chosen}, not thinned"] = image_to_points(results[-1][2], **thick)
        if network.generator.tta_rotations > 1:
            one = generate(network, scan.power, scan.azimuths, scan.twist, tta_rotations=1)
            points[f"{chosen}, one heading"] = one[0]
        rows += [
            {
                "timestamp_us": scan.stamp_us,
                "points": name,
                **evaluate_with_chance(found, scan.pose, map_tree),
            }
            for name, found in points.items()
        ]
    names = ["timestamp_us", "points", "n", "share_1m", "share_2m", "chance_1m", "chance_2m"]
    return pd.DataFrame(rows, columns=names), results


def evaluate_thresholds(
    images: Iterable[np.ndarray],
    scans: Sequence[RealScan],
    map_tree: cKDTree,
    settings: Mapping[str, Any],
    levels: Iterable[int],
) -> pd.DataFrame:
    """Evaluate generated images at several thresholds on a map.

    Parameters
    ----------
    images : iterable of array, shape (w, w), uint8
        Generated image of each scan.
    scans : sequence of RealScan
        The scans.
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].
    settings : mapping
        Arguments of `rol.bev.image_to_points` other than the threshold.
    levels : iterable of int
        Thresholds on the grey value.

    Returns
    -------
    table : pandas.DataFrame
        One row per scan and threshold: ``level``, ``n``, ``share_1m``, ``share_2m``.
    """
    how, levels = {**settings, "min_range": MIN_RANGE_M}, [int(level) for level in levels]
    rows = [
        {
            "level": level,
            **evaluate_on_map(image_to_points(image, **{**how, "threshold": level}), scan.pose, map_tree),
        }
        for image, scan in zip(images, scans, strict=True)
        for level in levels
    ]
    return pd.DataFrame(rows, columns=["level", "n", "share_1m", "share_2m"])


def tabulate_precision(table: pd.DataFrame) -> pd.DataFrame:
    """Average the table of `evaluate_front_ends` over the scans, by front end.

    Columns: ``within 1 m``, ``worst scan``, ``best scan`` (at 1 m), ``within 2 m``, ``chance, 1 m`` [%], and
    ``number`` of points per scan (mean) and ``fewest``.
    """
    groups = table.groupby("points", sort=False)
    columns = {
        "within 1 m": 100 * groups.share_1m.mean(),
        "worst scan": 100 * groups.share_1m.min(),
        "best scan": 100 * groups.share_1m.max(),
        "within 2 m": 100 * groups.share_2m.mean(),
        "chance, 1 m": 100 * groups.chance_1m.mean(),
        "number": groups.n.mean(),
        "fewest": groups.n.min(),
    }
    return pd.DataFrame(columns)


def describe_precision(table: pd.DataFrame, network: str) -> dict[str, float]:
    """Summarize the table of `evaluate_front_ends` in percent, NaN without scans.

    ``near_1m`` and ``chance_1m`` of the network and ``raw_1m`` of the raw peaks: means over the scans.
    """
    names = ["share_1m", "chance_1m"]
    means = 100 * table.groupby("points")[names].mean().astype(float).reindex([network, "raw"])
    near_1m, chance_1m = means.loc[network]
    return {"near_1m": near_1m, "chance_1m": chance_1m, "raw_1m": means.share_1m["raw"]}


# ---- RADIATE ----


def lidar_points(pair: RadiatePair) -> np.ndarray:
    """Return the points of a pair's sweep without the ground, shape (n, 2) [m]."""
    return crop_range(remove_ground(pair.points), MAX_RANGE_M, MIN_RANGE_M)[:, :2]


def foggy_points(
    pair: RadiatePair, networks: Mapping[str, TrainedNetwork], generate: Generate
) -> dict[str, np.ndarray]:
    """Convert a scan of RADIATE into points by every front end, see `front_end_points`."""
    how = {"calibration": RangeCalibration(RANGE_RESOLUTION), "cfar": {"guard_bins": 3, "train_bins": 10}}
    return front_end_points(pair.power, radiate_azimuths(), networks, generate, **how)


def evaluate_pairs(
    points: Iterable[Mapping[str, np.ndarray]], sweeps: Iterable[np.ndarray], reach_m: float
) -> pd.DataFrame:
    """Compare the points of front ends with the sweeps of the same moments within a range,
    in both directions.

    Parameters
    ----------
    points : iterable of mapping
        Front end -> points in the radar frame, shape (n, 2) [m]; one per pair.
    sweeps : iterable of array, shape (m, 2)
        Lidar points without the ground [m].
    reach_m : float
        Range of the comparison [m]; the points compared with are cut 10 m farther away.

    Returns
    -------
    table : pandas.DataFrame
        One row per pair and front end: ``points``, ``n``, ``share_1m``, ``share_2m`` (precision),
        ``reached_1m`` (recall).
    """
    rows = []
    for found, sweep in zip(points, sweeps, strict=True):
        for name, cloud in found.items():
            near = nn_distances(crop_range(cloud, reach_m), crop_range(sweep, reach_m + 10.0))
            back = nn_distances(crop_range(sweep, reach_m, MIN_RANGE_M), crop_range(cloud, reach_m + 10.0))
            fractions = {f"share_{r}m": fraction_within(near, r) for r in (1, 2)}
            rows.append(
                {"points": name, "n": len(near), **fractions, "reached_1m": fraction_within(back, 1.0)}
            )
    return pd.DataFrame(rows, columns=["points", "n", "share_1m", "share_2m", "reached_1m"])


def adapt_to_fog(
    network: TrainedNetwork, pairs: Sequence[RadiatePair], rng: np.random.Generator, config: AdaptationConfig
) -> TrainedNetwork:
    """Fine-tune a copy of a network on pairs of RADIATE, see `rol_beyond.adaptation.adapt`."""
    real_pairs = [RealPair(pair.power, radiate_azimuths(), lidar_points(pair)) for pair in pairs]
    settings = PairSettings.from_dict({**network.settings, **FOG})
    return replace(network, generator=adapt(network.generator, real_pairs, rng, config, settings))


def tabulate_fog(table: pd.DataFrame) -> pd.DataFrame:
    """Average the table of `evaluate_pairs` over the pairs, by front end.

    Columns: ``within 1 m``, its standard deviation ``sd``, ``within 2 m``, ``recall, 1 m`` [%], and the
    ``number`` of points.
    """
    groups = table.groupby("points", sort=False)
    columns = {
        "within 1 m": 100 * groups.share_1m.mean(),
        "sd": 100 * groups.share_1m.std(),
        "within 2 m": 100 * groups.share_2m.mean(),
        "recall, 1 m": 100 * groups.reached_1m.mean(),
        "number": groups.n.mean(),
    }
    return pd.DataFrame(columns)


def describe_fog(table: pd.DataFrame, network: str) -> dict[str, float]:
    """Summarize the table of `evaluate_pairs` in percent, NaN without pairs: ``fog_1m`` of the network,
    ``fog_raw_1m`` of the raw peaks."""
    means = 100 * table.groupby("points").share_1m.mean().astype(float).reindex([network, "raw"])
    return {"fog_1m": means[network], "fog_raw_1m": means["raw"]}


def describe_adaptation(curves: Mapping[str, pd.DataFrame], level: float) -> dict[str, float]:
    """Summarize curves before and after an adaptation at one threshold.

    Parameters
    ----------
    curves : mapping of str to pandas.DataFrame
        "before" and "adapted" -> table of `evaluate_thresholds`; one that is missing gives NaN.
    level : float
        Threshold.

    Returns
    -------
    numbers : dict
        ``<name>_1m`` [%] and ``<name>_n`` points per scan.
    """
    numbers = {}
    for name in ("before", "adapted"):
        row = {"share_1m": np.nan, "n": np.nan}
        if name in curves and len(curves[name]):
            row = curves[name].groupby("level").mean().loc[level]
        numbers |= {f"{name}_1m": 100 * row["share_1m"], f"{name}_n": row["n"]}
    return numbers
