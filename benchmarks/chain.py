"""How fast a whole online chain is, from the polar scan to the pose, with each front end.

python benchmarks/chain.py [--real-root DIR] [--rounds 2] [--threads 2]
                                                        prints a table and writes data/performance/chain.json

Each scan goes through a front end (raw peaks, or a network and the points of its image), the book's odometry, and one
update of the filter `robust` on the map, as they would come from a car: no scan is known before its turn. The scans are
the real ones in a row, again and again, for as many rounds; without the real data, the first of a simulated session, and
random streets for a map. Times are medians over the scans, for each part; the rate is that of the parts' sum. What
poses come out is no matter here. The paper's network at its full width has random weights, which cost the same; what it
draws is of no use, so raw peaks are handed on in its place.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from filter import open_map
from translator import ROOT, describe_machine

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol import mcl
from rol.files import write_text
from rol.oxford import load_radar, load_timestamps
from rol.pix2pix import ResnetGenerator, TrainedNetwork, has_bf16, load_network
from rol_beyond.front_ends import detect_points, generate_points
from rol_beyond.local_map_odometry import local_map_odometry
from rol_beyond.motion import MotionModel
from rol_beyond.robust import settings_for
from rol_book.parameters import positive
from rol_data import rall

NETWORKS = {"network unet, four headings": ("unet", None), "network unet, one heading": ("unet", 1),
            "network paper, narrow": ("paper", None)}  # fmt: skip
PERIOD_US = 250_000  # of the radar
Scan = tuple[np.ndarray, np.ndarray]
FrontEnd = Callable[[np.ndarray, np.ndarray], np.ndarray]


def open_scans(given: str, n_simulated: int = 11) -> tuple[list[Scan], str]:
    """Codes and bearings of the scans, and what they are."""
    root = rall.find_real_root(given)
    if root is not None:
        scans = rall.load_scans(root)
        return [(scan.power, scan.azimuths) for scan in scans], f"{len(scans)} real scans"
    folder = ROOT / "data" / "sessions" / "demo" / "sim-town-seq01"
    if not folder.is_dir():
        raise SystemExit(f"{folder}: missing, and no real data at hand; `make book` makes the session")
    stamps_us = load_timestamps(folder / "radar.timestamps")[:n_simulated]
    loaded = [load_radar(folder / "radar" / f"{us}.png") for us in stamps_us]
    return [(scan.power, scan.azimuths) for scan in loaded], f"{len(loaded)} simulated scans"


def list_front_ends(full_width: int = 64) -> dict[str, FrontEnd]:
    """Every front end by name; networks multiply in bfloat16 where the processor has instructions for it."""
    ends: dict[str, FrontEnd] = {"raw peaks": detect_points}
    weights = ROOT / "data" / "weights"
    for words, (name, tta_rotations) in NETWORKS.items():
        ends[words] = translate(load_network(weights / f"{name}.safetensors"), tta_rotations)
    narrow = load_network(weights / "paper.safetensors")
    full = ResnetGenerator(full_width, n_blocks=9).eval()
    wide = translate(TrainedNetwork(full, narrow.points, narrow.settings, {}), 1)
    ends["network paper, full width"] = lambda codes, azimuths: (
        wide(codes, azimuths),
        detect_points(codes, azimuths),
    )[1]
    return ends


def translate(network: TrainedNetwork, tta_rotations: int | None) -> FrontEnd:
    """A network as a front end."""
    made = partial(generate_points, network, bf16=has_bf16(), tta_rotations=tta_rotations)
    return lambda codes, azimuths: made(codes, azimuths)[0]


def run_chain(
    front_end: FrontEnd, scans: list[Scan], rounds: int, grid: mcl.MapGrid, start: np.ndarray
) -> dict[str, float]:
    """Let scans pass through the chain one by one; median times of its parts [ms], and the rate [Hz]."""
    settings = settings_for("robust", motion=MotionModel())
    particle_filter = mcl.ParticleFilter(grid, start, settings, np.random.default_rng(1))
    many = scans * rounds
    spent: dict[str, list[float]] = {"points": [], "odometry": [], "filter": []}
    clouds: list[np.ndarray] = []

    def feed() -> Iterator[np.ndarray]:  # the odometry asks for a cloud when it is due, no sooner
        for codes, azimuths in many:
            begin = perf_counter()
            clouds.append(front_end(codes, azimuths))
            spent["points"].append(perf_counter() - begin)
            yield clouds[-1]

    stamps_us = np.arange(len(many)) * PERIOD_US
    odometry = local_map_odometry(feed(), stamps_us)
    for _ in range(1, len(many)):
        begin, before = perf_counter(), sum(spent["points"])
        increment = next(odometry).T_target_source
        spent["odometry"].append(perf_counter() - begin - (sum(spent["points"]) - before))
        begin = perf_counter()
        particle_filter.step(clouds[-1], increment)
        spent["filter"].append(perf_counter() - begin)
    row = {f"{part} [ms]": 1e3 * float(np.median(seconds[1:])) for part, seconds in spent.items()}
    total = sum(row.values())
    n_points = float(np.mean([len(cloud) for cloud in clouds]))
    return row | {"all [ms]": total, "rate [Hz]": 1e3 / total, "points of a scan": n_points}


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast the chain is, from the polar scan to the pose.")
    parser.add_argument("--real-root", default="", help="folder of the real data")
    parser.add_argument("--rounds", type=positive, default=2)
    parser.add_argument("--threads", type=positive, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    torch.manual_seed(1)
    scans, what = open_scans(given.real_root)
    map_points, start, place = open_map(given.real_root, np.random.default_rng(0))
    grid = settings_for("robust").measurement.build_grid(map_points)
    about = {
        **describe_machine(given.threads),
        "load when begun": os.getloadavg()[0],
        "scans": what,
        "map": place,
    }
    rows = {}
    for name, front_end in list_front_ends().items():
        front_end(*scans[0])  # what is compiled or set up at the first call is not timed
        rows[name] = run_chain(front_end, scans, given.rounds, grid, start)
        print(name, "  ".join(f"{key} {value:.3g}" for key, value in rows[name].items()), flush=True)
    path = Path(ROOT, "data", "performance", "chain.json")
    write_text(path, json.dumps({"about": about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
