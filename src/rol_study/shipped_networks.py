"""Training and evaluation of the networks in `data/weights`: sessions, pairs, training, threshold,
weights and card.

A recipe describes everything; every stage resumes where it stopped, and a finished stage is not repeated.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from scipy.spatial import cKDTree

from rol.bev import image_to_points
from rol.evaluation import read_tum
from rol.files import read_text, write_text
from rol.oxford import Session, compose_odometry, load_radar_odometry, open_session
from rol.pairs import AlignedScan, PairSettings, align_scans, estimate_twists, usable_sweeps
from rol.pix2pix import (
    Generator,
    TrainConfig,
    TrainedNetwork,
    generate,
    has_bf16,
    load_weights,
    save_weights,
)
from rol.similarity import similarity_summary
from rol.training import RunOptions, train
from rol_beyond.augmentation import JoinedPairs, ScanPairs, gather_clouds
from rol_beyond.front_ends import MIN_RANGE_M, evaluate_on_map, generate_points
from rol_beyond.training_options import TrainingExtensions
from rol_data import rall
from rol_sim.session.settings import parse_settings
from rol_sim.session.writer import write_session

VERSIONS = ("numpy", "scipy", "torch", "opencv-python-headless", "open3d-cpu")
LICENCE = (
    "MIT; trained on simulated data, partly in a world built from the lidar map of RaLL (Yin et al. 2021)"
)
TOLERANCE = 0.01  # of a fraction, between processors
THRESHOLDS = (64, 96, 112, *range(128, 193, 8), 208, 224)  # grey values at which points are evaluated
PARTS = {"out_dir", "sessions_root", "seed", "pairs", "worlds", "sets", "networks", "ablations"}
NOT_TRAINING = (
    "learn",
    "reach",
    "seed",
    "thin",
    "tta_rotations",
)  # keys of a network that its training ignores
COMPARED = ["n_fake", "fake_to_real_within_1m", "fake_to_real_within_2m", "real_to_fake_within_1m"]


@dataclass(frozen=True)
class Places:
    """Where files lie, and how the work is done.

    Attributes
    ----------
    recipe : path
        The recipe.
    weights : path
        Folder of the shipped weights and cards.
    ablations : path
        Table of the ablations.
    real_root : path, optional
        Folder of the real data.
    device : str
        "cpu" or "cuda".
    threads : int
        Threads and processes.
    report : callable
        Takes a line about the progress.
    """

    recipe: Path
    weights: Path
    ablations: Path
    real_root: Path | None = None
    device: str = "cpu"
    threads: int = 2
    report: Callable[[str], None] = print


def load_recipe(path: Path) -> dict[str, Any]:
    """Read a recipe; refuse one that lacks a part."""
    recipe = yaml.safe_load(read_text(path))
    missing = PARTS - set(recipe or {})
    if missing:
        raise ValueError(f"{path}: the key {min(missing)!r} is missing")
    return recipe


def list_variants(recipe: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """List the ablations of a recipe: name -> settings of the network."""
    ablations = recipe["ablations"]
    return {f"ablation-{name}": {**ablations["base"], **own} for name, own in ablations["variants"].items()}


def make_sessions(recipe: dict[str, Any], names: set[str], places: Places) -> None:
    """Write the simulated sessions of these names that do not exist yet."""
    known = set()
    for number, world in enumerate(recipe["worlds"]):
        settings = parse_settings(world, f"worlds[{number}]")
        known |= set(settings.sessions)
        for name in names & set(settings.sessions):
            write_session(settings, name, recipe["sessions_root"], report=places.report, jobs=places.threads)
    if names - known:
        raise ValueError(
            f"no world has a session {min(names - known)!r}; there are: {', '.join(sorted(known))}"
        )


def choose_scans(root: Path, part: dict[str, Any], motion: str) -> tuple[Session, list[AlignedScan]]:
    """Open a session, align its scans and select those of a set;
    scans of a stationary vehicle are left out."""
    session = open_session(root / part["session"])
    odometry = load_radar_odometry(session.odometry_path)
    radar_us, mid_us, _ = compose_odometry(odometry)
    scans = (radar_us, mid_us, estimate_twists(odometry))
    rows = align_scans(*scans, usable_sweeps(session), motion=motion, max_gap_us=50_000)
    aligned = [AlignedScan.from_row(row) for _, row in pd.DataFrame(rows).iterrows()]
    stamps_us, poses = read_tum(session.root / "truth.tum")
    positions = poses[np.searchsorted(stamps_us, [one.radar_stamp_us for one in aligned]), :2]
    within = [np.hypot(*(positions - disc[:2]).T) < disc[2] for disc in part.get("within", [])]
    without = [np.hypot(*(positions - disc[:2]).T) < disc[2] for disc in part.get("without", [])]
    chosen = np.any(within, axis=0) if within else np.ones(len(aligned), dtype=bool)
    chosen &= ~np.any(without, axis=0) if without else True
    chosen &= np.hypot(*np.diff(positions, axis=0, prepend=positions[:1] + 9.0).T) > 0.2
    return session, [aligned[i] for i in np.flatnonzero(chosen)[:: part.get("every", 1)]]


def open_set(recipe: dict[str, Any], name: str, places: Places, stride: int = 1) -> JoinedPairs:
    """Open one set of pairs, or every `stride`-th pair of it; its lidar points are read once and kept."""
    root, out = Path(recipe["sessions_root"]), Path(recipe["out_dir"])
    settings, parts = PairSettings.from_dict(recipe["pairs"]), []
    for part in recipe["sets"][name]:
        session, aligned = choose_scans(root, part, settings.motion)
        aligned = aligned[::stride]
        path = out / "clouds" / f"{part['session']}-{zlib.crc32(repr(aligned).encode()):08x}.npz"
        how = {"workers": places.threads, "report": places.report}
        clouds = gather_clouds(session, aligned, path, settings, **how)
        parts.append(ScanPairs(session, aligned, clouds, settings))
        places.report(f"{name}: {len(aligned)} pairs of {part['session']}")
    return JoinedPairs(parts)


def open_sets(recipe: dict[str, Any], networks: Sequence[dict[str, Any]], places: Places) -> dict[str, Any]:
    """Write the sessions and open the held-out sets, every second pair for ablations,
    and the training sets of networks."""
    held_out = {name for name in recipe["sets"] if not name.startswith("learn")}
    wanted = held_out | {network.get("learn", "learn") for network in networks}
    make_sessions(recipe, {part["session"] for name in wanted for part in recipe["sets"][name]}, places)
    stride = 2 if len(networks) > 1 else 1
    return {
        name: open_set(recipe, name, places, stride if name in held_out else 1) for name in sorted(wanted)
    }


def open_real(places: Places) -> tuple[list[Any], Any] | None:
    """Read the real scans and the tree of the real map; None where the real data are missing."""
    root = places.real_root
    if root is None or not (root / rall.SCANS_PATH).is_dir():
        places.report("no real scans at hand: the network is evaluated on simulated places alone")
        return None
    return rall.load_scans(root), cKDTree(rall.load_map_points(root / rall.MAP_PATH))


def score_points(generator: Generator, pairs: Any, *, thin: bool = False) -> pd.DataFrame:
    """Evaluate the generated points of held-out pairs at all `THRESHOLDS`.

    Parameters
    ----------
    generator : Generator
        The network.
    pairs : sequence of (radar, lidar), each array float32 (1, h, w) in [-1, 1]
        Held-out pairs.
    thin : bool
        Keep only the crests of strokes, see `rol.bev.crest_pixels`.

    Returns
    -------
    scores : DataFrame
        One row per threshold: its value, and the means over the pairs of `rol.similarity.similarity_summary`,
        standard deviations under the names ending in ``_sd``.
    """
    rows = []
    for index in range(len(pairs)):
        radar, lidar = (np.rint((image[0] + 1.0) * 127.5).astype(np.uint8) for image in pairs[index])
        generated, real = generate(generator, radar), image_to_points(lidar)
        for threshold in THRESHOLDS:
            points = image_to_points(generated, threshold=threshold, thin=thin)
            rows.append({"threshold": threshold, **similarity_summary(points, real)})
    by_threshold = pd.DataFrame(rows).groupby("threshold")
    return by_threshold.mean().join(by_threshold.std().add_suffix("_sd")).reset_index()


def evaluate_network(
    network: TrainedNetwork, sets: dict[str, JoinedPairs], real: Any, thin: bool
) -> pd.DataFrame:
    """Evaluate a network on every held-out set, and on the real scans against the real map."""
    tables = [
        score_points(network.generator, pairs, thin=thin).assign(places=name)
        for name, pairs in sets.items()
        if not name.startswith("learn")
    ]
    rows = []
    for scan in [] if real is None else real[0]:
        _, _, generated = generate_points(network, scan.power, scan.azimuths, scan.twist)
        for threshold in THRESHOLDS:
            points = image_to_points(generated, threshold=threshold, min_range=MIN_RANGE_M, thin=thin)
            found = evaluate_on_map(points, scan.pose, real[1])
            near = {f"fake_to_real_within_{r}m": found[f"share_{r}m"] for r in (1, 2)}
            rows.append({"threshold": threshold, "n_fake": found["n"], **near})
    if rows:
        by_threshold = pd.DataFrame(rows).groupby("threshold")
        mean_sd = by_threshold.mean().join(by_threshold.std().add_suffix("_sd"))
        mean_sd["n_fake_min"] = by_threshold.n_fake.min()
        tables.append(mean_sd.reset_index().assign(places="real"))
    return pd.concat(tables, ignore_index=True).round(4)


def choose_threshold(evaluated: pd.DataFrame, min_recall: float | None) -> int:
    """Choose the highest threshold whose recall at 1 m on the simulated places is at least `min_recall`."""
    if min_recall is None:
        return 128
    recall = evaluated[evaluated.places != "real"].groupby("threshold").real_to_fake_within_1m.mean()
    return int(max(recall.index[recall >= min_recall], default=128))


def train_network(
    recipe: dict[str, Any], name: str, asked: dict[str, Any], pairs: Any, places: Places
) -> tuple[Generator, pd.DataFrame, dict[str, Any]]:
    """Train one network of a recipe; return it with its history and the settings for the header of its
    file."""
    known = [{field.name for field in fields(kind)} for kind in (TrainConfig, TrainingExtensions)]
    own = {key: value for key, value in asked.items() if key not in NOT_TRAINING}
    if unknown := set(own) - known[0] - known[1]:
        raise ValueError(f"{places.recipe}: {name}: no such setting: {min(unknown)}")
    config = TrainConfig(**{key: value for key, value in own.items() if key in known[0]})
    extensions = TrainingExtensions(**{key: value for key, value in own.items() if key in known[1]})
    if config.bf16 and not has_bf16(places.device):
        raise ValueError(
            f"{places.recipe}: {name}: this processor has no bf16 instructions; set bf16 to false, which takes longer"
        )
    seed = asked.get("seed", recipe["seed"])
    hooks = extensions.hooks(
        lambda row, _: places.report(
            f"{name}: " + " ".join(f"{key} {value:.5g}" for key, value in row.items())
        )
    )
    options = RunOptions(device=places.device, num_workers=places.threads)
    out = Path(recipe["out_dir"]) / name
    generator, history = train(pairs, config, out, seed=seed, options=options, hooks=hooks)
    return generator, history, {"config": asdict(config) | asdict(extensions), "seed": seed}


def run_network(
    recipe: dict[str, Any], name: str, asked: dict[str, Any], sets: dict[str, Any], real: Any, places: Places
) -> tuple[Generator, dict[str, Any], dict[str, Any]]:
    """Train and evaluate one network; return it with the header of its file and its card."""
    begin = time.perf_counter()
    generator, history, about = train_network(recipe, name, asked, sets[asked.get("learn", "learn")], places)
    seconds = time.perf_counter() - begin
    thin = bool(asked.get("thin", False))
    network = TrainedNetwork(generator, {}, recipe["pairs"], {})
    one_heading = evaluated = evaluate_network(network, sets, real, thin)
    if asked.get("tta_rotations", 1) > 1:
        generator.tta_rotations = asked["tta_rotations"]
        evaluated = evaluate_network(network, sets, real, thin)
    points = {"threshold": choose_threshold(evaluated, asked.get("reach")), "thin": thin}
    about |= {"name": name, "card": f"{name}.json", "pairs_settings": recipe["pairs"], "points": points}
    card = {
        "name": name,
        **points,
        "headings": generator.tta_rotations,
        "recipe": {**{key: recipe[key] for key in ("seed", "pairs", "worlds", "sets")}, "network": asked},
        "pairs": {part: len(pairs) for part, pairs in sets.items()},
        "weights": sum(weight.numel() for weight in generator.parameters()),
        "last_run_s": round(seconds, 1),
        **describe_environment(places.device),
        "licence": LICENCE,
        "judged": as_lists(evaluated),
        "judged_one_heading": as_lists(one_heading),
        "history": as_lists(history.round(6)),
    }
    return generator, about, card


def describe_environment(device: str) -> dict[str, Any]:
    """Return the versions of packages and of Python, the machine and the device."""
    return {
        "versions": {package: importlib.metadata.version(package) for package in VERSIONS},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": device,
    }


def as_lists(table: pd.DataFrame) -> dict[str, list[Any]]:
    """Convert a table to lists that JSON can hold."""
    return table.astype(object).where(table.notna(), None).to_dict("list")


def write_network(generator: Generator, about: dict[str, Any], card: dict[str, Any], places: Places) -> None:
    """Write weights in half precision and the card of a network into the folder of the shipped weights."""
    save_weights(places.weights / f"{card['name']}.safetensors", generator.cpu(), about, half=True)
    write_text(places.weights / f"{card['name']}.json", json.dumps(card, indent=1) + "\n")
    table = pd.DataFrame(card["judged"]).to_string()
    places.report(f"{card['name']}: threshold {card['threshold']}\n{table}")


def compare_with_card(
    recipe: dict[str, Any], name: str, sets: dict[str, Any], real: Any, places: Places
) -> bool:
    """Evaluate shipped weights again and compare with their card; return whether the fractions agree."""
    card = json.loads(read_text(places.weights / f"{name}.json"))
    generator = load_weights(places.weights / f"{name}.safetensors")
    network = TrainedNetwork(generator, {}, recipe["pairs"], {})
    tables = [evaluate_network(network, sets, real, card["thin"]), pd.DataFrame(card["judged"])]
    now, then = (
        table[table.threshold == card["threshold"]].set_index("places")[COMPARED].astype(float)
        for table in tables
    )
    both = pd.concat({"now": now, "card": then.loc[now.index]}, axis=1)
    difference = (now - then.loc[now.index])[COMPARED[1:]].abs().max().max()
    places.report(
        f"{name} at threshold {card['threshold']}\n{both.to_string()}\nlargest difference of a fraction: {difference:.4f}"
    )
    return bool(difference <= TOLERANCE)


def run_networks(recipe: dict[str, Any], networks: dict[str, dict[str, Any]], places: Places) -> None:
    """Train, evaluate and write networks; of ablations only the table is kept,
    and finished ones are not repeated."""
    variants = list_variants(recipe)
    sets, real = open_sets(recipe, list(networks.values()), places), open_real(places)
    for name, asked in networks.items():
        kept = Path(recipe["out_dir"]) / name / "card.json"
        if name in variants and _is_done(kept, asked):
            continue
        generator, about, card = run_network(recipe, name, asked, sets, real, places)
        write_text(kept, json.dumps(card, indent=1) + "\n")
        if name in variants:
            write_ablations(recipe, list(variants), places.ablations)
        else:
            write_network(generator, about, card, places)


def _is_done(card: Path, asked: dict[str, Any]) -> bool:
    """Return whether a network was trained and evaluated with exactly these settings."""
    return card.is_file() and json.loads(read_text(card))["recipe"]["network"] == asked


def write_ablations(recipe: dict[str, Any], names: list[str], path: Path) -> None:
    """Collect the evaluations in the cards of the ablations in one table."""
    tables = []
    for name in names:
        kept = Path(recipe["out_dir"]) / name / "card.json"
        if kept.is_file():
            card = json.loads(read_text(kept))
            steps = len(card["history"]["step"]) and card["history"]["step"][-1]
            tables.append(
                pd.DataFrame(card["judged"]).assign(network=name, steps=steps, weights=card["weights"])
            )
    table = pd.concat(tables, ignore_index=True)
    first = ["network", "steps", "weights", "places", "threshold"]
    table = table[[*first, *(column for column in table if column not in first)]]
    write_text(path, table.to_csv(index=False))
