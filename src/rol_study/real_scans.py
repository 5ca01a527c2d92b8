"""Real radar scans on a real lidar map: precision of front ends, choice of thresholds,
localization from wrong starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.bev import image_to_points
from rol.geometry import check_fields, compose, relative_pose
from rol.lidar import crop_range, remove_ground
from rol.mcl import MclSettings
from rol.pairs import PairSettings
from rol.pix2pix import TrainedNetwork
from rol.radar import RangeCalibration
from rol.similarity import fraction_within, nn_distances
from rol_beyond.adaptation import AdaptationConfig, RealPair, adapt
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M, detect_points, evaluate_on_map
from rol_beyond.pipeline import FrontEnd, RobustLocalizer
from rol_beyond.recovery import RecoveringFilter, RecoverySettings
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


# ---- RADIATE ----


def lidar_points(pair: RadiatePair) -> np.ndarray:
    """Give the points of a pair's sweep without the ground, shape (n, 2) [m]."""
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
    return pd.DataFrame(rows)


def adapt_to_fog(
    network: TrainedNetwork, pairs: Sequence[RadiatePair], rng: np.random.Generator, config: AdaptationConfig
) -> TrainedNetwork:
    """Fine-tune a copy of a network on pairs of RADIATE, see `rol_beyond.adaptation.adapt`."""
    real_pairs = [RealPair(pair.power, radiate_azimuths(), lidar_points(pair)) for pair in pairs]
    settings = PairSettings.from_dict({**network.settings, **FOG})
    return replace(network, generator=adapt(network.generator, real_pairs, rng, config, settings))


# ---- localization ----


@dataclass(frozen=True)
class LocalizerSettings:
    """Settings of the robust localizer.

    Attributes
    ----------
    filter : MclSettings
        Of the particle filter.
    recovery : RecoverySettings
        Of detection and relocalization.
    density_radius_m : float
        As in `rol_beyond.pipeline.RobustLocalizer`.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    filter: MclSettings
    recovery: RecoverySettings
    density_radius_m: float

    def __post_init__(self) -> None:
        check_fields(self, {"[0, inf)": "density_radius_m"})


def wrong_starts(off_m: float, off_deg: float, n_directions: int) -> np.ndarray:
    """Give start poses off in all directions, each with both signs of the turn.

    Parameters
    ----------
    off_m, off_deg : float
        Distance and angle to the true pose [m, deg].
    n_directions : int
        Number of directions; the first is straight ahead.

    Returns
    -------
    offsets : array, shape (2 * n_directions, 3)
        Start in the true radar frame [m, m, rad]; the first is ahead and turned to the left.
    """
    angles = 2.0 * np.pi * np.arange(n_directions) / n_directions
    turn = np.deg2rad(off_deg)
    return np.array([(off_m * np.cos(a), off_m * np.sin(a), s * turn) for a in angles for s in (1, -1)])


def cache_front_end(make_points: FrontEnd) -> FrontEnd:
    """Remember the points of a scan and a twist, so that all starts share them."""
    known: dict[Any, np.ndarray] = {}

    def points_of(scan: Any, twist: tuple[float, float, float] | None) -> np.ndarray:
        key = scan.stamp_us, twist
        if key not in known:
            known[key] = make_points(scan, twist)
        return known[key]

    return points_of


def crop_map(
    map_points: np.ndarray, map_tree: cKDTree, poses: np.ndarray, reach_m: float = 120.0
) -> np.ndarray:
    """Keep the points of a map near some poses, shape (n, 2) [m], in their order."""
    around = np.unique(np.concatenate(map_tree.query_ball_point(poses[:, :2], reach_m)))
    return map_points[around.astype(int)]


def localize_from_starts(
    scans: Sequence[RealScan],
    front_end: FrontEnd,
    map_points: np.ndarray,
    starts: np.ndarray,
    settings: LocalizerSettings,
    seeds: Sequence[int],
) -> np.ndarray:
    """Localize consecutive scans on a map from several starts.

    Parameters
    ----------
    scans : sequence of RealScan
        The scans, in the order of time.
    front_end : callable
        As in `rol_beyond.pipeline.RobustLocalizer`.
    map_points : array, shape (m, 2)
        Points of the map [m].
    starts : array, shape (s, 3)
        Poses T_map_radar with which the filter begins [m, m, rad].
    settings : LocalizerSettings
        Of the localizer.
    seeds : sequence of int
        Seeds of the runs from each start.

    Returns
    -------
    poses : array, shape (s * len(seeds), len(scans), 3)
        Estimates, the runs of one start after the other [m, m, rad].
    """
    grid = settings.filter.measurement.build_grid(map_points)
    runs = []
    for start in starts:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            recovering = RecoveringFilter(
                map_points, start, settings.filter, settings.recovery, rng, grid=grid
            )
            radius = settings.density_radius_m
            localizer = RobustLocalizer(recovering, front_end, density_radius_m=radius)
            runs.append([localizer.step(scan).pose for scan in scans])
    return np.array(runs)


def position_and_heading_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute the distance [m] and the angle [deg] to the true poses, shape (..., 2);
    leading axes broadcast."""
    x, y, yaw = np.moveaxis(relative_pose(truth, poses), -1, 0)
    return np.stack([np.hypot(x, y), np.rad2deg(np.abs(yaw))], axis=-1)


def summarize_starts(
    errors: Sequence[np.ndarray], first_scan: int, limits: Sequence[float]
) -> dict[str, Any]:
    """Summarize errors over runs from several starts.

    Parameters
    ----------
    errors : sequence of array, shape (s, k, 2)
        Errors of each group of scans [m, deg]; the groups may differ in length.
    first_scan : int
        Scan, counted from 1, from which on the runs are judged.
    limits : sequence of float
        Largest errors allowed [m, deg].

    Returns
    -------
    summary : dict
        ``median``: medians per scan, shape (k, 2); ``worst``: largest errors from ``first_scan`` on, shape
        (2,); ``met``: fraction of the runs that stay within the limits from then on. NaN where no group is
        long enough.
    """
    longest = max(e.shape[1] for e in errors)
    median = [
        np.median(np.concatenate([e[:, i] for e in errors if e.shape[1] > i]), axis=0) for i in range(longest)
    ]
    later = [e[:, first_scan - 1 :] for e in errors if e.shape[1] >= first_scan]
    worst = np.max([e.max(axis=(0, 1)) for e in later], axis=0) if later else np.full(2, np.nan)
    met = float(np.mean([(e <= limits).all(axis=(1, 2)) for e in later])) if later else np.nan
    return {"median": np.array(median), "worst": worst, "met": met}


def tabulate_starts(summaries: Mapping[str, Mapping[str, Any]], n_scans: int = 11) -> pd.DataFrame:
    """Tabulate summaries of `summarize_starts`, a row per scan and two columns per summary.

    Parameters
    ----------
    summaries : mapping of str to mapping
        Label -> summary.
    n_scans : int
        Largest number of scans shown.

    Returns
    -------
    table : pandas.DataFrame
        Medians per scan, and the worst errors of the scans that are judged [m, deg].
    """
    columns = {
        f"{label} [{unit}]": [*summary["median"][:n_scans, k], summary["worst"][k]]
        for label, summary in summaries.items()
        for k, unit in enumerate(("m", "deg"))
    }
    n_rows = len(next(iter(columns.values()))) - 1
    return pd.DataFrame(columns, [*(f"scan {i + 1}, median" for i in range(n_rows)), "worst of those judged"])


def localize_points(
    points: np.ndarray,
    pose: np.ndarray,
    map_points: np.ndarray,
    offsets: np.ndarray,
    settings: LocalizerSettings,
    seed: int,
) -> np.ndarray:
    """Localize one cloud by one update of the filter from several starts.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame [m].
    pose : array, shape (3,)
        True pose [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    offsets : array, shape (s, 3)
        Starts in the true radar frame, from `wrong_starts` [m, m, rad].
    settings : LocalizerSettings
        Of the localizer.
    seed : int
        Seed of each run.

    Returns
    -------
    errors : array, shape (s, 2)
        Distance and angle to the true pose [m, deg].
    """
    scan = SimpleNamespace(stamp_us=0)
    starts = compose(pose, offsets)
    found = localize_from_starts([scan], lambda *_: points, map_points, starts, settings, [seed])
    return position_and_heading_errors(found[:, 0], pose)


def evaluate_turn(
    scan: RealScan,
    front_ends: Mapping[str, FrontEnd],
    variants: Mapping[str, tuple[bool, float]],
    map_points: np.ndarray,
    localize: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> tuple[pd.DataFrame, dict[tuple[str, str], np.ndarray]]:
    """Evaluate a scan with and without motion compensation, and with turned azimuths.

    Parameters
    ----------
    scan : RealScan
        Scan with pose and twist.
    front_ends : mapping of str to callable
        Front ends by name, as in `rol_beyond.pipeline.RobustLocalizer`.
    variants : mapping of str to (bool, float)
        Name -> whether motion is compensated, and the angle added to the azimuths [rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    localize : callable
        Takes points, the true pose and the map and returns errors, shape (s, 2) [m, deg]; see
        `localize_points`.

    Returns
    -------
    table : pandas.DataFrame
        One row per variant and front end: fractions ``share_1m`` and ``share_2m`` at the true pose; medians
        ``m`` and ``deg`` and the largest ``worst_m`` of the errors.
    points : dict
        (variant, front end) -> points, shape (n, 2) [m].
    """
    points, rows, tree = {}, {}, cKDTree(map_points)
    for variant, (is_compensated, turn) in variants.items():
        turned = replace(scan, azimuths=scan.azimuths + turn)
        for name, make_points in front_ends.items():
            cloud = points[variant, name] = make_points(turned, scan.twist if is_compensated else None)
            errors = localize(cloud, scan.pose, map_points)
            shares = evaluate_on_map(cloud, scan.pose, tree)
            middle = dict(zip(("m", "deg"), np.median(errors, axis=0), strict=True))
            rows[variant, name] = {**shares, **middle, "worst_m": errors[:, 0].max()}
    return pd.DataFrame.from_dict(rows, orient="index").drop(columns="n"), points
