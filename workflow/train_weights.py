"""Train a network whose weights come with the book: sessions, pairs, training, judging, weights and card.

    python workflow/train_weights.py data/weights/recipe.yaml rol [--device cuda] [--threads 2]

Every stage goes on where it stopped, at any moment; a stage that is done is not done again. The network's weights go to
`data/weights/NAME.safetensors` in half precision, what is known about them to `data/weights/NAME.json`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from rol.alignment import align_scans, usable_stamps
from rol.evaluation import read_tum, write_text
from rol.oxford import compose_odometry, load_radar_odometry, open_session
from rol.pairs import estimate_twists, job_of_row
from rol.scan_pairs import JoinedPairs, ScanPairs, gather_clouds

WEIGHTS = Path(__file__).resolve().parents[1] / "data" / "weights"
VERSIONS = ("numpy", "scipy", "torch", "opencv-python-headless", "open3d-cpu")
LICENCE = (
    "MIT; learnt from simulated data, partly in a world grown from the lidar map of RaLL (Yin et al. 2021)"
)
LEVELS = (64, 96, 128, 160, 192, 224)


def say(line: str) -> None:
    """Print one line at once."""
    print(line, flush=True)


def load_recipe(path: Path) -> dict[str, Any]:
    """Read the recipe and refuse one that lacks a part."""
    recipe = yaml.safe_load(path.read_text(encoding="utf-8"))
    missing = {"out_dir", "sessions_root", "seed", "pairs", "worlds", "sets", "networks"} - set(recipe or {})
    if missing:
        raise ValueError(f"{path}: the key {min(missing)!r} is missing")
    return recipe


def make_sessions(recipe: dict[str, Any], names: set[str], jobs: int) -> None:
    """Write the virtual sessions that are asked for and not there yet."""
    from rol.virtual.settings import parse_settings
    from rol.virtual.writer import write_session

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


def choose_jobs(root: Path, part: dict[str, Any], motion: str) -> tuple[Any, list[dict[str, Any]]]:
    """Open a session and give the scans that a set asks for, from the alignment of chapter 02."""
    session = open_session(root / part["session"])
    odometry = load_radar_odometry(session.odometry_path)
    radar_us, mid_us, _ = compose_odometry(odometry)
    lidar_us = [usable_stamps(session, f"velodyne_{side}") for side in ("left", "right")]
    rows = align_scans(
        radar_us, mid_us, estimate_twists(odometry), *lidar_us, motion=motion, max_gap_us=50_000
    )
    jobs = [job_of_row(row) for _, row in pd.DataFrame(rows).iterrows()]
    stamps_us, poses = read_tum(session.root / "truth.tum")
    places = poses[np.searchsorted(stamps_us, [job["radar_stamp"] for job in jobs]), :2]
    within = [np.hypot(*(places - disc[:2]).T) < disc[2] for disc in part.get("within", [])]
    without = [np.hypot(*(places - disc[:2]).T) < disc[2] for disc in part.get("without", [])]
    chosen = np.any(within, axis=0) if within else np.ones(len(jobs), dtype=bool)
    chosen &= ~np.any(without, axis=0) if without else True
    moved = (
        np.hypot(*np.diff(places, axis=0, prepend=places[:1] + 9.0).T) > 0.2
    )  # a car that waits teaches nothing
    return session, [jobs[i] for i in np.flatnonzero(chosen & moved)[:: part.get("every", 1)]]


def open_set(recipe: dict[str, Any], name: str, workers: int) -> JoinedPairs:
    """Give one set of pairs; its lidar points are read once and kept."""
    root, out, settings = Path(recipe["sessions_root"]), Path(recipe["out_dir"]), recipe["pairs"]
    parts = []
    for part in recipe["sets"][name]:
        session, jobs = choose_jobs(root, part, settings["motion"])
        path = out / "clouds" / f"{name}-{part['session']}.npz"
        clouds = gather_clouds(session, jobs, path, settings, workers=workers, report=say)
        parts.append(ScanPairs(session, jobs, clouds, settings))
        say(f"{name}: {len(jobs)} pairs of {part['session']}")
    return JoinedPairs(parts)


def make_card(
    recipe: dict[str, Any], name: str, history: pd.DataFrame, figures: dict[str, Any]
) -> dict[str, Any]:
    """Put down all that is known about a network."""
    return {
        "name": name,
        "recipe": {
            **{key: recipe[key] for key in ("seed", "pairs", "worlds", "sets")},
            "network": recipe["networks"][name],
        },
        "versions": {package: importlib.metadata.version(package) for package in VERSIONS},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "licence": LICENCE,
        "judged": figures,
        "history": history.round(6).replace({np.nan: None}).to_dict("list"),
    }


def main(arguments: list[str] | None = None) -> int:
    """Train, judge and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", type=Path)
    parser.add_argument("network")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args(arguments)
    import torch

    from rol.pix2pix import TrainConfig, save_weights
    from rol.training import score_points, train

    torch.set_num_threads(given.threads)
    recipe = load_recipe(given.recipe)
    if given.network not in recipe["networks"]:
        raise ValueError(f"no network {given.network!r}; there are: {', '.join(recipe['networks'])}")
    asked = recipe["networks"][given.network]
    unknown = set(asked) - {field.name for field in fields(TrainConfig)}
    if unknown:
        raise ValueError(f"networks: {given.network}: no such setting: {min(unknown)}")
    config = TrainConfig(**asked)
    make_sessions(
        recipe, {part["session"] for parts in recipe["sets"].values() for part in parts}, given.threads
    )
    sets = {name: open_set(recipe, name, given.threads) for name in recipe["sets"]}
    folder = Path(recipe["out_dir"]) / given.network
    generator, history = train(
        sets["learn"], config, folder, seed=recipe["seed"], device=given.device, loaders=given.threads,
        on_report=lambda row, _: say(" ".join(f"{key} {value:.5g}" for key, value in row.items())),
    )  # fmt: skip
    figures = {
        name: score_points(generator, pairs, LEVELS).round(4).to_dict("list")
        for name, pairs in sets.items() if name != "learn"
    }  # fmt: skip
    card = make_card(recipe, given.network, history, figures)
    about = {"config": asdict(config), "seed": recipe["seed"], "card": f"{given.network}.json"}
    save_weights(WEIGHTS / f"{given.network}.safetensors", generator.cpu(), about, half=True)
    write_text(WEIGHTS / f"{given.network}.json", json.dumps(card, indent=1) + "\n")
    say(json.dumps(figures, indent=1))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
