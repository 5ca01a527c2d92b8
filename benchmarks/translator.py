"""How fast the translator is: ours beside the plain way of the same weights, in one run.

python benchmarks/translator.py [--rounds 7] [--threads 2]      prints a table and writes build/benchmarks/translator.json

"plain" is PyTorch as one writes it first: float32, rows of pixels channel by channel, every norm on its own. "ours" keeps
the channels of a pixel together, multiplies norms into convolutions where they have running statistics, and computes in
bfloat16 where the processor has instructions for it. Both take turns, so that a busy machine hurts both alike; medians.
"""

from __future__ import annotations

import argparse
import copy
import json
import platform
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from rol.bev import image_to_points
from rol.pix2pix import TrainConfig, build_generator, generate, has_bf16, load_weights
from rol.similarity import nn_distances
from rol.training import TrainingState
from rol.unet import fuse

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "data" / "weights" / "rol.safetensors"


def draw_image(rng: np.random.Generator) -> np.ndarray:
    """A radar image with walls and noise, shape (512, 512), uint8."""
    image = rng.gamma(1.0, 9.0, (512, 512))
    for row, column in rng.integers(40, 470, (6, 2)):
        image[row : row + 3, 60:450] += 60.0
        image[60:450, column : column + 3] += 60.0
    return np.clip(image, 0, 255).astype(np.uint8)


def take_turns(ways: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each way; the first round is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):
        for name, way in ways.items():
            begin = perf_counter()
            way()
            seconds[name].append(perf_counter() - begin)
    return {name: float(np.median(values[1:])) for name, values in seconds.items()}


def make_plain(network: torch.nn.Module) -> torch.nn.Module:
    """The same weights as PyTorch lays them out by itself."""
    return copy.deepcopy(network).to(memory_format=torch.contiguous_format)


def time_use(name: str, network: torch.nn.Module, image: np.ndarray, rounds: int) -> dict[str, float]:
    """Time one image through both, and say how far their points are apart."""
    plain, ours = make_plain(network.eval()), copy.deepcopy(network).eval()
    if name == "unet":
        fuse(ours)
    ways = {"plain": lambda: generate(plain, image), "ours": lambda: generate(ours, image, bf16=has_bf16())}
    found = take_turns(ways, rounds)
    grey = [generate(plain, image).astype(int), generate(ours, image, bf16=has_bf16()).astype(int)]
    level = int(np.quantile(grey[0], 0.99))
    points = [image_to_points(image, threshold=level) for image in grey]
    apart = nn_distances(*points)
    return {
        **{f"{key} [ms]": 1e3 * value for key, value in found.items()},
        "times faster": found["plain"] / found["ours"],
        "greatest difference [grey]": float(np.abs(grey[0] - grey[1]).max()),
        "points within a pixel [%]": 100.0 * float((apart <= 0.36).mean()),
    }


def time_step(config: TrainConfig, rounds: int) -> dict[str, float]:
    """Time one step of training, batch 1, both networks of the paper."""
    from dataclasses import replace

    from rol.pix2pix import train_step

    rng = np.random.default_rng(1)
    pair = [torch.from_numpy(draw_image(rng)[None, None].astype(np.float32) / 127.5 - 1.0) for _ in range(2)]
    states = {"plain": TrainingState(config, seed=1), "ours": TrainingState(config, seed=1)}
    for network in states["plain"].networks.values():
        network.to(memory_format=torch.contiguous_format)
    ways = {}
    for name, state in states.items():
        used = replace(config, bf16=name == "ours" and has_bf16())
        parts = [
            both.get(key)
            for both in (state.networks, state.optimizers)
            for key in ("generator", "discriminator")
        ]
        ways[name] = lambda parts=parts, used=used: train_step(*parts, *pair, used)
    found = take_turns(ways, rounds)
    return {
        **{f"{key} [ms]": 1e3 * value for key, value in found.items()},
        "times faster": found["plain"] / found["ours"],
    }


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast the translator is, beside the plain way.")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--filters", type=int, default=64, help="width of the paper's network")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    image, rng = draw_image(np.random.default_rng(0)), torch.Generator().manual_seed(1)
    shipped = load_weights(SHIPPED) if SHIPPED.is_file() else None
    width = (shipped.filters, shipped.blocks) if shipped is not None else (32, 1)
    table = {
        f"use, resnet {given.filters}": time_use(
            "resnet", build_generator(given.filters, rng=rng), image, given.rounds
        ),
        f"use, unet {width[0]}": time_use(
            "unet", build_generator(*width, "unet", rng=rng), image, given.rounds
        ),
        f"step, resnet {given.filters}": time_step(
            TrainConfig(filters=given.filters, discriminator_filters=given.filters), max(given.rounds // 3, 1)
        ),
    }
    about = {
        "machine": platform.processor() or platform.machine(),
        "bf16": has_bf16(),
        "threads": given.threads,
        "torch": torch.__version__,
    }
    for name, row in table.items():
        print(name, "  ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)
    path = ROOT / "build" / "benchmarks" / "translator.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"about": about, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
