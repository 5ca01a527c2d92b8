"""Fine-tune a network on real Oxford pairs and evaluate it on real scans that it was not trained on.

The eleven pairs lie within 2.7 s and 20 m of one street, so no part of them can serve as a test set. Two
other sources can: one scan of another session at its published pose on the lidar map of RaLL, and the pairs
of RADIATE, another radar in fog.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from rol.bev import image_to_points
from rol.geometry import invert, transform_points
from rol.lidar import crop_range
from rol.pairs import PairSettings
from rol.pix2pix import TrainedNetwork
from rol.similarity import fraction_within, nn_distances
from rol_beyond.adaptation import AdaptationConfig, RealPair, adapt_steps
from rol_beyond.front_ends import MAX_RANGE_M, MIN_RANGE_M, generate_points
from rol_data.oxford_pairs import find_pairs
from rol_data.radiate import load_pairs, radiate_azimuths
from rol_data.rall import MAP_PATH, RealScan, load_map_points, load_posed_scans
from rol_study.real_localization import crop_map
from rol_study.real_pairs import load_scan_pairs
from rol_study.real_scans import FOG, lidar_points

FOG_RANGE_M = 20.0  # range up to which the lidar sees through the fog, as in chapter 10 [m]
MARGIN_M = 10.0  # reference points are used so much beyond the range of the comparison [m]
THRESHOLDS = (96, 112, 128, 144, 160, 176, 192, 208, 224)  # grey values
SETTINGS = AdaptationConfig(reach_m=40.0, steps=400, batch_size=2)


@dataclass(frozen=True, eq=False)
class TestScan:
    """A radar scan with the points that generated points are compared with.

    Attributes
    ----------
    source : str
        Name of the group over which results are averaged.
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    reference : array, shape (n, 2)
        Lidar or map points in the radar frame [m].
    max_range_m : float
        Range up to which points are compared [m].
    twist : tuple of float, optional
        Body velocity for the motion compensation [m/s, m/s, rad/s].
    settings : mapping
        Settings of the radar image that differ from the network's.
    """

    __test__ = False  # not a class of tests

    source: str
    power: np.ndarray
    azimuths: np.ndarray
    reference: np.ndarray
    max_range_m: float = MAX_RANGE_M
    twist: tuple[float, float, float] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


def load_training_pairs(real_root: Path | str) -> list[RealPair]:
    """Read the real Oxford pairs, motion-compensated, with all lidar sweeps of each turn.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.

    Returns
    -------
    pairs : list of RealPair
        Scans whose velocity is known, in the order of time.
    """
    found, pairs = find_pairs(real_root), []
    for scan in found.scans:
        pair = load_scan_pairs(found, scan).get(("compensated", "turn"))
        if pair is not None:
            points = crop_range(pair.objects, MAX_RANGE_M, MIN_RANGE_M)[:, :2]
            pairs.append(RealPair(pair.radar.power, pair.radar.azimuths, points, scan.twist))
    return pairs


def load_test_scans(real_root: Path | str) -> list[TestScan]:
    """Read the real scans for the evaluation: "map" (posed scans on the map) and "fog" (RADIATE).

    Parameters
    ----------
    real_root : path
        Folder of the real data.

    Returns
    -------
    scans : list of TestScan
        The scans of `rol_data.rall.load_posed_scans`, then the pairs of `rol_data.radiate.load_pairs`.
    """
    map_points = load_map_points(Path(real_root) / MAP_PATH)
    tree = cKDTree(map_points)
    scans = [place_on_map(scan, map_points, tree) for scan in load_posed_scans(real_root)]
    for pair in load_pairs(real_root):
        sweep, azimuths = lidar_points(pair), radiate_azimuths()
        scans.append(TestScan("fog", pair.power, azimuths, sweep, FOG_RANGE_M, settings=FOG))
    return scans


def place_on_map(scan: RealScan, map_points: np.ndarray, tree: cKDTree) -> TestScan:
    """Compare a scan with the part of a map around its pose, moved into the radar frame."""
    near = crop_map(map_points, tree, scan.pose[None], MAX_RANGE_M + MARGIN_M)
    reference = transform_points(invert(scan.pose), near)
    return TestScan("map", scan.power, scan.azimuths, reference, twist=scan.twist)


def known_scans(pairs: Iterable[RealPair]) -> list[TestScan]:
    """Compare the training pairs with their own lidar points, as the source "pairs"."""
    return [TestScan("pairs", pair.power, pair.azimuths, pair.points, twist=pair.twist) for pair in pairs]


def compare_within(points: np.ndarray, reference: np.ndarray, max_range_m: float) -> dict[str, float]:
    """Compute precision and recall up to a range; neighbours may lie `MARGIN_M` farther away.

    Parameters
    ----------
    points, reference : array, shape (n, 2), (m, 2)
        Generated points, and lidar or map points in the same frame [m].
    max_range_m : float
        Range of the comparison [m].

    Returns
    -------
    scores : dict
        ``n_points``, ``precision_1m``, ``precision_2m``, ``recall_1m``.
    """
    wide = max_range_m + MARGIN_M
    found = crop_range(points, max_range_m)
    forward = nn_distances(found, crop_range(reference, wide))
    back = nn_distances(crop_range(reference, max_range_m, MIN_RANGE_M), crop_range(points, wide))
    precision = {f"precision_{r}m": fraction_within(forward, float(r)) for r in (1, 2)}
    return {"n_points": len(found), **precision, "recall_1m": fraction_within(back, 1.0)}


def evaluate_scans(
    network: TrainedNetwork,
    scans: Iterable[TestScan],
    thresholds: Sequence[int] = THRESHOLDS,
    bf16: bool = False,
) -> pd.DataFrame:
    """Evaluate a network on real scans at several thresholds.

    Parameters
    ----------
    network : TrainedNetwork
        The network.
    scans : iterable of TestScan
        The scans.
    thresholds : sequence of int
        Grey values from which on a pixel is a point.
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    table : pandas.DataFrame
        One row per source and threshold: ``source``, ``threshold``, ``n_scans``, and the means over the scans
        of `compare_within`.
    """
    rows = []
    for scan in scans:
        own = replace(network, settings={**network.settings, **scan.settings})
        image = generate_points(own, scan.power, scan.azimuths, scan.twist, bf16=bf16)[2]
        size = {
            name: getattr(PairSettings.from_dict(own.settings), name) for name in ("pixel_size", "max_range")
        }
        for level in thresholds:
            how = {**network.points, "threshold": int(level), "min_range": MIN_RANGE_M, **size}
            scores = compare_within(image_to_points(image, **how), scan.reference, scan.max_range_m)
            rows.append({"source": scan.source, "threshold": int(level), **scores})
    groups = pd.DataFrame(rows).groupby(["source", "threshold"], sort=False)
    return groups.mean().assign(n_scans=groups.size()).reset_index()


def fine_tune(
    network: TrainedNetwork,
    pairs: Sequence[RealPair],
    seed: int,
    step_counts: Sequence[int],
    config: AdaptationConfig = SETTINGS,
) -> Iterator[tuple[int, TrainedNetwork]]:
    """Fine-tune a network and yield it after each of several numbers of steps.

    Parameters
    ----------
    network : TrainedNetwork
        The network; it is not changed.
    pairs : sequence of RealPair
        Pairs to train on.
    seed : int
        Seed of the drawn pairs and of their rotations about the radar.
    step_counts : sequence of int
        Numbers of steps, 0 for the network as it is.
    config : AdaptationConfig
        Settings; ``steps`` is replaced by the largest number.

    Yields
    ------
    steps : int
        One of the numbers, in ascending order.
    network : TrainedNetwork
        The network after these steps; use it before the next one is asked for.
    """
    if 0 in step_counts:
        yield 0, network
    if max(step_counts) > 0:
        settings = PairSettings.from_dict(network.settings)
        config = replace(config, steps=max(step_counts))
        states = adapt_steps(network.generator, pairs, np.random.default_rng(seed), config, settings)
        for step, generator in enumerate(states, start=1):
            if step in step_counts:
                yield step, replace(network, generator=generator)


def run_study(
    network: TrainedNetwork,
    pairs: Sequence[RealPair],
    scans: Sequence[TestScan],
    seeds: Sequence[int],
    step_counts: Sequence[int],
    config: AdaptationConfig = SETTINGS,
) -> Iterator[pd.DataFrame]:
    """Fine-tune a network with several seeds; yield its evaluation after each number of steps.

    Parameters
    ----------
    network : TrainedNetwork
        The network.
    pairs : sequence of RealPair
        Pairs to train on; they are evaluated, too, as the source "pairs".
    scans : sequence of TestScan
        Other scans.
    seeds, step_counts : sequence of int
        As of `fine_tune`; the network as it is is evaluated once, with the seed 0.
    config : AdaptationConfig
        Settings of the fine-tuning.

    Yields
    ------
    table : pandas.DataFrame
        As of `evaluate_scans`, with ``seed`` and ``steps``.
    """
    every = [*known_scans(pairs), *scans]
    for seed in (0, *seeds):
        counts = [0] if seed == 0 else [count for count in step_counts if count > 0]
        for steps, tuned in fine_tune(network, pairs, seed, counts, config):
            yield evaluate_scans(tuned, every, bf16=config.bf16).assign(seed=seed, steps=steps)
