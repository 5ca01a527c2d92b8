"""Fine-tune a network on real Oxford pairs and evaluate it on real scans that it was not trained on.

The eleven pairs lie within 2.7 s and 20 m of one street, so no part of them can serve as a test set. Two
other sources can: one scan of another session at its published pose on the lidar map of RaLL, and the pairs
of RADIATE, another radar in fog.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

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


def load_test_pairs(real_root: Path | str) -> dict[str, list[RealPair]]:
    """Read the real scans for the evaluation: "map" (posed scans on the map) and "fog" (RADIATE).

    Parameters
    ----------
    real_root : path
        Folder of the real data.

    Returns
    -------
    pairs : dict of list of RealPair
        By source: the scans of `rol_data.rall.load_posed_scans` with the map points around them, and the
        pairs of `rol_data.radiate.load_pairs`.
    """
    map_points = load_map_points(Path(real_root) / MAP_PATH)
    tree = cKDTree(map_points)
    placed = [place_on_map(scan, map_points, tree) for scan in load_posed_scans(real_root)]
    foggy = [RealPair(pair.power, radiate_azimuths(), lidar_points(pair)) for pair in load_pairs(real_root)]
    return {"map": placed, "fog": foggy}


def place_on_map(scan: RealScan, map_points: np.ndarray, tree: cKDTree) -> RealPair:
    """Pair a scan with the part of a map around its pose, moved into the radar frame."""
    near = crop_map(map_points, tree, scan.pose[None], MAX_RANGE_M + MARGIN_M)
    return RealPair(scan.power, scan.azimuths, transform_points(invert(scan.pose), near), scan.twist)


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
    pairs: Mapping[str, Sequence[RealPair]],
    thresholds: Sequence[int] = THRESHOLDS,
    bf16: bool = False,
) -> pd.DataFrame:
    """Evaluate a network on real scans at several thresholds.

    Parameters
    ----------
    network : TrainedNetwork
        The network.
    pairs : mapping of str to sequence of RealPair
        Scans with lidar or map points, by source. Those of "fog" are compared up to `FOG_RANGE_M`, with the
        settings ``rol_study.real_scans.FOG``.
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
    for source, pair in ((source, pair) for source, group in pairs.items() for pair in group):
        own, max_range_m = network, MAX_RANGE_M
        if source == "fog":
            own, max_range_m = replace(network, settings={**network.settings, **FOG}), FOG_RANGE_M
        image = generate_points(own, pair.power, pair.azimuths, pair.twist, bf16=bf16)[2]
        settings = PairSettings.from_dict(own.settings)
        size = {"pixel_size": settings.pixel_size, "max_range": settings.max_range}
        for level in thresholds:
            how = {**network.points, "threshold": int(level), "min_range": MIN_RANGE_M, **size}
            scores = compare_within(image_to_points(image, **how), pair.points, max_range_m)
            rows.append({"source": source, "threshold": int(level), **scores})
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
    others: Mapping[str, Sequence[RealPair]],
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
    others : mapping of str to sequence of RealPair
        Other scans by source, as of `load_test_pairs`.
    seeds, step_counts : sequence of int
        As of `fine_tune`; the network as it is is evaluated once, with the seed 0.
    config : AdaptationConfig
        Settings of the fine-tuning.

    Yields
    ------
    table : pandas.DataFrame
        As of `evaluate_scans`, with ``seed`` and ``steps``.
    """
    every = {"pairs": pairs, **others}
    for seed in (0, *seeds):
        counts = [0] if seed == 0 else [count for count in step_counts if count > 0]
        for steps, tuned in fine_tune(network, pairs, seed, counts, config):
            yield evaluate_scans(tuned, every, bf16=config.bf16).assign(seed=seed, steps=steps)
