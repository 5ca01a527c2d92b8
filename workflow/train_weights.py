"""Train a network whose weights come with the book: sessions, pairs, training, judging, weights and card.

    python workflow/train_weights.py data/weights/recipe.yaml rol [--device cuda] [--threads 2]
    python workflow/train_weights.py data/weights/recipe.yaml rol --judge
    python workflow/train_weights.py data/weights/recipe.yaml ablations

Every stage goes on where it stopped, at any moment; a stage that is done is not done again. The network's weights go to
`data/weights/NAME.safetensors` in half precision, what is known about them to `data/weights/NAME.json`. With `--judge`
nothing is trained: the weights that are there are judged again and held against their card. Of the ablations no weights
are kept, only how they were judged: `data/ablations/translator.csv`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import sys
import time
import zlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from rol.evaluation import read_tum
from rol.files import read_text, write_text
from rol.oxford import compose_odometry, load_radar_odometry, open_session
from rol.pairs import AlignedScan, PairSettings, align_scans, estimate_twists, usable_sweeps
from rol_beyond.scan_pairs import JoinedPairs, ScanPairs, gather_clouds
from rol_book.parameters import positive

DATA = Path(__file__).resolve().parents[1] / "data"
WEIGHTS, ABLATIONS = DATA / "weights", DATA / "ablations" / "translator.csv"
VERSIONS = ("numpy", "scipy", "torch", "opencv-python-headless", "open3d-cpu")
LICENCE = (
    "MIT; learnt from simulated data, partly in a world grown from the lidar map of RaLL (Yin et al. 2021)"
)
TOLERANCE = 0.01  # of a share, between processors
# Grey values at which points are judged.
LEVELS = (64, 96, 112, *range(128, 193, 8), 208, 224)


def say(line: str) -> None:
    """Print one line at once."""
    print(line, flush=True)


def load_recipe(path: Path) -> dict[str, Any]:
    """Read the recipe and refuse one that lacks a part."""
    recipe = yaml.safe_load(read_text(path))
    missing = {"out_dir", "sessions_root", "seed", "pairs", "worlds", "sets", "networks", "ablations"} - set(
        recipe or {}
    )
    if missing:
        raise ValueError(f"{path}: the key {min(missing)!r} is missing")
    return recipe


def make_sessions(recipe: dict[str, Any], names: set[str], jobs: int) -> None:
    """Write the simulated sessions that are asked for and not there yet."""
    from rol_sim.session.settings import parse_settings
    from rol_sim.session.writer import write_session

    known = set()
    for number, world in enumerate(recipe["worlds"]):
        settings = parse_settings(world, f"worlds[{number}]")
        known |= set(settings.sessions)
        for name in names & set(settings.sessions):
            write_session(settings, name, recipe["sessions_root"], report=say, jobs=jobs)
    if names - known:
        raise ValueError(
            f"no world has a session {min(names - known)!r}; there are: {', '.join(sorted(known))}"
        )


def choose_scans(root: Path, part: dict[str, Any], motion: str) -> tuple[Any, list[AlignedScan]]:
    """Open a session and give the scans that a set asks for, from the alignment of chapter 02."""
    session = open_session(root / part["session"])
    odometry = load_radar_odometry(session.odometry_path)
    radar_us, mid_us, _ = compose_odometry(odometry)
    scans = (radar_us, mid_us, estimate_twists(odometry))
    rows = align_scans(*scans, usable_sweeps(session), motion=motion, max_gap_us=50_000)
    aligned = [AlignedScan.from_row(row) for _, row in pd.DataFrame(rows).iterrows()]
    stamps_us, poses = read_tum(session.root / "truth.tum")
    places = poses[np.searchsorted(stamps_us, [one.radar_stamp_us for one in aligned]), :2]
    within = [np.hypot(*(places - disc[:2]).T) < disc[2] for disc in part.get("within", [])]
    without = [np.hypot(*(places - disc[:2]).T) < disc[2] for disc in part.get("without", [])]
    chosen = np.any(within, axis=0) if within else np.ones(len(aligned), dtype=bool)
    chosen &= ~np.any(without, axis=0) if without else True
    moved = (
        np.hypot(*np.diff(places, axis=0, prepend=places[:1] + 9.0).T) > 0.2
    )  # a car that waits teaches nothing
    return session, [aligned[i] for i in np.flatnonzero(chosen & moved)[:: part.get("every", 1)]]


def open_set(recipe: dict[str, Any], name: str, workers: int, stride: int = 1) -> JoinedPairs:
    """Give one set of pairs, or every so many of it; its lidar points are read once and kept."""
    root, out, settings = (
        Path(recipe["sessions_root"]),
        Path(recipe["out_dir"]),
        PairSettings.from_dict(recipe["pairs"]),
    )
    parts = []
    for part in recipe["sets"][name]:
        session, aligned = choose_scans(root, part, settings.motion)
        aligned = aligned[::stride]
        path = out / "clouds" / f"{part['session']}-{zlib.crc32(repr(aligned).encode()):08x}.npz"
        clouds = gather_clouds(session, aligned, path, settings, workers=workers, report=say)
        parts.append(ScanPairs(session, aligned, clouds, settings))
        say(f"{name}: {len(aligned)} pairs of {part['session']}")
    return JoinedPairs(parts)


def open_real() -> tuple[list[Any], Any] | None:
    """Give the real scans and the tree of the real map, or None where the real data are not at hand."""
    from scipy.spatial import cKDTree

    from rol_data import rall

    root = rall.find_real_root()
    if root is None or not (root / rall.SCANS_PATH).is_dir():
        say("no real scans at hand: the network is judged on simulated places alone")
        return None
    return rall.load_scans(root), cKDTree(rall.load_map_points(root / rall.MAP_PATH))


def judge(
    generator: Any, sets: dict[str, JoinedPairs], real: Any, settings: dict[str, Any], thin: bool
) -> pd.DataFrame:
    """Judge a network on every set but the one it learnt from, and on the real scans against the real map."""
    from rol.bev import image_to_points
    from rol.pix2pix import TrainedNetwork
    from rol.training import score_points
    from rol_beyond.front_ends import MIN_RANGE_M, judge_on_map, translate_scan

    tables = [
        score_points(generator, pairs, LEVELS, thin=thin).assign(places=name)
        for name, pairs in sets.items() if not name.startswith("learn")
    ]  # fmt: skip
    rows, translator = [], TrainedNetwork(generator, {}, settings, {})
    for scan in [] if real is None else real[0]:
        _, _, fake = translate_scan(translator, scan.power, scan.azimuths, scan.twist)
        for level in LEVELS:
            points = image_to_points(fake, threshold=level, min_range=MIN_RANGE_M, thin=thin)
            shares = judge_on_map(points, scan.pose, real[1])
            near = {f"fake_to_real_within_{r}m": shares[f"share_{r}m"] for r in (1, 2)}
            rows.append({"threshold": level, "n_fake": shares["n"], **near})
    if rows:
        by_level = pd.DataFrame(rows).groupby("threshold")
        mean_sd = by_level.mean().join(by_level.std().add_suffix("_sd"))
        mean_sd["n_fake_min"] = by_level.n_fake.min()
        tables.append(mean_sd.reset_index().assign(places="real"))
    return pd.concat(tables, ignore_index=True).round(4)


def choose_threshold(judged: pd.DataFrame, reach: float | None) -> int:
    """Choose the highest level at which so large a share of the real points of the simulated places is still reached."""
    if reach is None:
        return 128
    reached = judged[judged.places != "real"].groupby("threshold").real_to_fake_within_1m.mean()
    return int(max(reached.index[reached >= reach], default=128))


def run_network(
    recipe: dict[str, Any],
    name: str,
    asked: dict[str, Any],
    sets: dict[str, JoinedPairs],
    given: Any,
    real: Any,
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Train and judge one network; give it, the header of its file and its card."""
    from rol.pix2pix import TrainConfig, has_bf16
    from rol.training import train

    elsewhere = ("headings", "learn", "reach", "seed", "thin")
    own = {key: value for key, value in asked.items() if key not in elsewhere}
    unknown = set(own) - {field.name for field in fields(TrainConfig)}
    if unknown:
        raise ValueError(f"{given.recipe}: {name}: no such setting: {min(unknown)}")
    config = TrainConfig(**own)
    if config.bf16 and not has_bf16(given.device):
        raise ValueError(
            f"{given.recipe}: {name}: this processor has no bf16 instructions; set bf16 to false and have time"
        )
    seed = asked.get("seed", recipe["seed"])
    begin = time.perf_counter()
    generator, history = train(
        sets[asked.get("learn", "learn")], config, Path(recipe["out_dir"]) / name, seed=seed,
        device=given.device, loaders=given.threads,
        on_report=lambda row, _: say(f"{name}: " + " ".join(f"{key} {value:.5g}" for key, value in row.items())),
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    thin = bool(asked.get("thin", False))
    as_driven = judged = judge(generator, sets, real, recipe["pairs"], thin)
    if asked.get("headings", 1) > 1:
        generator.headings = asked["headings"]
        judged = judge(generator, sets, real, recipe["pairs"], thin)
    threshold = choose_threshold(judged, asked.get("reach"))
    about = {
        "name": name, "config": asdict(config), "seed": seed, "card": f"{name}.json",
        "pairs_settings": recipe["pairs"], "points": {"threshold": threshold, "thin": thin},
    }  # fmt: skip
    card = {
        "name": name,
        "threshold": threshold,
        "thin": thin,
        "headings": generator.headings,
        "recipe": {**{key: recipe[key] for key in ("seed", "pairs", "worlds", "sets")}, "network": asked},
        "pairs": {part: len(pairs) for part, pairs in sets.items()},
        "weights": sum(weight.numel() for weight in generator.parameters()),
        "last_run_s": round(seconds, 1),
        "versions": {package: importlib.metadata.version(package) for package in VERSIONS},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": given.device,
        "licence": LICENCE,
        "judged": as_lists(judged),
        "judged_one_heading": as_lists(as_driven),
        "history": as_lists(history.round(6)),
    }
    return generator, about, card


def as_lists(table: pd.DataFrame) -> dict[str, list[Any]]:
    """Turn a table into lists that JSON can hold."""
    return table.astype(object).where(table.notna(), None).to_dict("list")


def ship(generator: Any, about: dict[str, Any], card: dict[str, Any]) -> None:
    """Write weights and card of a network to where the book takes them from."""
    from rol.pix2pix import save_weights

    save_weights(WEIGHTS / f"{card['name']}.safetensors", generator.cpu(), about, half=True)
    write_text(WEIGHTS / f"{card['name']}.json", json.dumps(card, indent=1) + "\n")
    say(f"{card['name']}: threshold {card['threshold']}\n{pd.DataFrame(card['judged']).to_string()}")


def judge_again(recipe: dict[str, Any], name: str, sets: dict[str, JoinedPairs], real: Any) -> int:
    """Judge the weights that come with the book and print what their card says beside it; 1 if they differ."""
    from rol.pix2pix import load_weights

    card = json.loads(read_text(WEIGHTS / f"{name}.json"))
    generator = load_weights(WEIGHTS / f"{name}.safetensors")
    tables = [judge(generator, sets, real, recipe["pairs"], card["thin"]), pd.DataFrame(card["judged"])]
    columns = ["n_fake", "fake_to_real_within_1m", "fake_to_real_within_2m", "real_to_fake_within_1m"]
    now, then = (
        table[table.threshold == card["threshold"]].set_index("places")[columns].astype(float)
        for table in tables
    )
    both = pd.concat({"now": now, "card": then.loc[now.index]}, axis=1)
    apart = (now - then.loc[now.index])[columns[1:]].abs().max().max()
    say(
        f"{name} at threshold {card['threshold']}\n{both.to_string()}\nlargest difference of a share: {apart:.4f}"
    )
    return int(apart > TOLERANCE)


def is_done(card: Path, asked: dict[str, Any]) -> bool:
    """Say whether a network was trained and judged with these very settings."""
    return card.is_file() and json.loads(read_text(card))["recipe"]["network"] == asked


def write_ablations(recipe: dict[str, Any], names: list[str]) -> None:
    """Gather what the cards of the ablations say into one table."""
    tables = []
    for name in names:
        path = Path(recipe["out_dir"]) / name / "card.json"
        if path.is_file():
            card = json.loads(read_text(path))
            steps = len(card["history"]["step"]) and card["history"]["step"][-1]
            tables.append(
                pd.DataFrame(card["judged"]).assign(network=name, steps=steps, weights=card["weights"])
            )
    table = pd.concat(tables, ignore_index=True)
    first = ["network", "steps", "weights", "places", "threshold"]
    table = table[[*first, *(column for column in table if column not in first)]]
    ABLATIONS.parent.mkdir(parents=True, exist_ok=True)
    write_text(ABLATIONS, table.to_csv(index=False))


def main(arguments: list[str] | None = None) -> int:
    """Train, judge and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", type=Path)
    parser.add_argument("network", help="a network of the recipe, or 'ablations'")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=positive, default=2)
    parser.add_argument(
        "--judge", action="store_true", help="train nothing, judge the weights that are there"
    )
    given = parser.parse_args(arguments)
    import torch

    torch.set_num_threads(given.threads)
    recipe = load_recipe(given.recipe)
    variants = {f"ablation-{name}": {**recipe["ablations"]["base"], **changes}
                for name, changes in recipe["ablations"]["variants"].items()}  # fmt: skip
    known = {**recipe["networks"], **variants}
    names = list(variants) if given.network == "ablations" else [given.network]
    if names[0] not in known:
        raise ValueError(f"no network {given.network!r}; there are: {', '.join([*known, 'ablations'])}")
    wanted = {name for name in recipe["sets"] if not name.startswith("learn")}
    if not given.judge:
        wanted |= {known[name].get("learn", "learn") for name in names}
    make_sessions(
        recipe, {part["session"] for name in wanted for part in recipe["sets"][name]}, given.threads
    )
    coarse = {name: 2 for name in wanted if given.network == "ablations" and not name.startswith("learn")}
    sets = {name: open_set(recipe, name, given.threads, coarse.get(name, 1)) for name in sorted(wanted)}
    real = open_real()
    if given.judge:
        return judge_again(recipe, names[0], sets, real)
    for name in names:
        kept = Path(recipe["out_dir"]) / name / "card.json"
        if name in variants and is_done(kept, known[name]):
            continue
        generator, about, card = run_network(recipe, name, known[name], sets, given, real)
        write_text(kept, json.dumps(card, indent=1) + "\n")
        if name in variants:
            write_ablations(recipe, list(variants))
        else:
            ship(generator, about, card)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
