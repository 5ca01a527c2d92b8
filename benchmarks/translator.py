"""How fast the translator is: ours beside the plain way of the same weights, in one run.

python benchmarks/translator.py [--rounds 7] [--threads 2]      prints a table and writes data/performance/translator.json

"plain" is PyTorch as one writes it first: float32, rows of pixels channel by channel, every norm on its own. "ours" keeps
the channels of a pixel together, multiplies norms into convolutions where they have running statistics, and computes in
bfloat16 where the processor has instructions for it. Both take turns, so that a busy machine hurts both alike; medians.
The steps beside the network are held against plain NumPy and against SciPy.
"""

from __future__ import annotations

import argparse
import copy
import datetime
import json
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
import scipy
import torch
from scipy.ndimage import map_coordinates

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol.bev import image_to_points
from rol.files import write_text
from rol.pix2pix import TrainConfig, build_generator, generate, has_bf16, load_weights, train_step
from rol.radar import SDK, polar_to_cartesian
from rol.similarity import nn_distances
from rol.training import TrainingState
from rol_book.parameters import positive

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "data" / "weights" / "unet.safetensors"


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
    """Time one image through both, and measure how far their points are apart."""
    plain, ours = make_plain(network.eval()), copy.deepcopy(network).eval()
    if name == "unet":
        ours.fuse()
    ways = {"plain": lambda: generate(plain, image), "ours": lambda: generate(ours, image, bf16=has_bf16())}
    found = take_turns(ways, rounds)
    grey = [generate(plain, image).astype(int), generate(ours, image, bf16=has_bf16()).astype(int)]
    level = int(np.quantile(grey[0], 0.99))
    points = [image_to_points(image, threshold=level) for image in grey]
    apart = nn_distances(*points)
    return {
        **compare(found),
        "greatest difference [grey]": float(np.abs(grey[0] - grey[1]).max()),
        "points within a pixel [%]": 100.0 * float((apart <= 0.36).mean()),
    }


def time_step(config: TrainConfig, rounds: int) -> dict[str, float]:
    """Time one step of training, batch 1, both networks of the paper."""
    rng = np.random.default_rng(1)
    pair = [torch.from_numpy(draw_image(rng)[None, None].astype(np.float32) / 127.5 - 1.0) for _ in range(2)]
    states = {"plain": TrainingState(config, seed=1), "ours": TrainingState(config, seed=1)}
    for network in states["plain"].networks.values():
        network.to(memory_format=torch.contiguous_format)
    ways = {}
    for name, state in states.items():
        how = {"lambda_l1": config.lambda_l1, "bf16": name == "ours" and has_bf16()}
        ways[name] = lambda state=state, how=how: train_step(state.networks, state.optimizers, *pair, **how)
    return compare(take_turns(ways, rounds))


def warp_with_scipy(codes: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    """Polar to Cartesian as one writes it with SciPy: coordinates of every pixel, and one bilinear look-up."""
    axis = np.linspace(63.875, -63.875, 512)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    rows = np.mod(azimuths[0] - np.arctan2(y, x), 2.0 * np.pi) / (azimuths[0] - azimuths[1])
    bins = np.hypot(x, y) / SDK.resolution_m - 0.5
    return map_coordinates(codes / 255.0, [rows, bins], order=1, mode="nearest")


def points_with_loops(image: np.ndarray) -> np.ndarray:
    """Points of an image pixel by pixel, as Eq. 1 reads."""
    points = []
    for row in range(512):
        for column in range(512):
            x, y = (255.5 - row) * 0.25, (255.5 - column) * 0.25
            if image[row, column] >= 128 and np.hypot(x, y) <= 64.0:
                points.append((x, y))
    return np.array(points)


def time_polar(rounds: int) -> dict[str, float]:
    """Time polar to Cartesian beside SciPy, and measure how far the images are apart."""
    rng = np.random.default_rng(3)
    codes = np.clip(rng.gamma(1.0, 9.0, (400, 3768)), 0, 255).astype(np.uint8)
    azimuths = -2.0 * np.pi * np.arange(400) / 400
    ways = {
        "plain": lambda: warp_with_scipy(codes, azimuths),
        "ours": lambda: polar_to_cartesian(codes, azimuths),
    }
    images = [way() for way in ways.values()]
    apart = np.abs(images[0] - images[1])[:, :255]  # SciPy's has a seam behind the first row
    return {
        **compare(take_turns(ways, rounds)),
        "greatest difference [grey]": 255.0 * float(np.median(apart)),
    }


def time_points(rounds: int) -> dict[str, float]:
    """Time image to points beside the loops of Eq. 1."""
    image = draw_image(np.random.default_rng(4)) * 2
    ways = {"plain": lambda: points_with_loops(image), "ours": lambda: image_to_points(image)}
    assert np.allclose(ways["plain"](), ways["ours"]())
    return compare(take_turns(ways, rounds))


def compare(found: dict[str, float]) -> dict[str, float]:
    """Put two medians in milliseconds and as a ratio."""
    return {
        **{f"{key} [ms]": 1e3 * value for key, value in found.items()},
        "times faster": found["plain"] / found["ours"],
    }


def describe_machine(threads: int) -> dict[str, object]:
    """Describe machine, date, commit and versions."""
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.strip()
    lines = (
        Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        if Path("/proc/cpuinfo").is_file()
        else []
    )
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "processor": model or platform.processor() or platform.machine(),
        "threads": threads,
        "bf16 instructions": has_bf16(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "commit": commit,
        **{module.__name__: module.__version__ for module in (torch, np, scipy, cv2)},
    }


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast the translator is, beside the plain way.")
    parser.add_argument("--rounds", type=positive, default=7)
    parser.add_argument("--threads", type=positive, default=2)
    parser.add_argument("--ngf", type=positive, default=64, help="width of the paper's network")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    image, rng = draw_image(np.random.default_rng(0)), torch.Generator().manual_seed(1)
    shipped = load_weights(SHIPPED) if SHIPPED.is_file() else None
    width = (shipped.ngf, shipped.n_blocks) if shipped is not None else (32, 1)
    table = {
        f"use, resnet {given.ngf}": time_use(
            "resnet", build_generator(given.ngf, rng=rng), image, given.rounds
        ),
        f"use, unet {width[0]}": time_use(
            "unet", build_generator(*width, "unet", rng=rng), image, given.rounds
        ),
        f"step, resnet {given.ngf}": time_step(
            TrainConfig(ngf=given.ngf, ndf=given.ngf), max(given.rounds // 3, 1)
        ),
        "polar to image": time_polar(given.rounds),
        "image to points": time_points(max(given.rounds // 3, 1)),
    }
    about = describe_machine(given.threads)
    for name, row in table.items():
        print(name, "  ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)
    path = ROOT / "data" / "performance" / "translator.json"
    write_text(path, json.dumps({"about": about, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
