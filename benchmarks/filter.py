"""How fast the particle filter is: the weighing beside NumPy, a whole update, and cost against size, in one run.

python benchmarks/filter.py [--rounds 25] [--real-root DIR]      prints a table and writes data/performance/filter.json

"numpy" weighs all pairs of particle and point at once, as one writes it without a compiler; its matrix products stay on one
thread, like the rest of it. "one thread" is `rol.mcl.count_matches`, "all threads" the same in parts. Ways and sizes take turns, so that
a busy machine hurts all alike; medians, by the clock and of the processors' working time, which others on the machine
lengthen less. Tracked particles lie within a metre or two of the pose, as after a few scans; spread ones within 150 m to
each side and with any heading, so that hardly two read the same part of the map. Without the real lidar map, streets of the
same extent are drawn.
"""

from __future__ import annotations

import os

# Before OpenMP is loaded: threads that wait for work must not spin while another way has its turn.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import json
from collections.abc import Callable
from functools import partial
from time import process_time

import numba
import numpy as np
from threadpoolctl import threadpool_limits
from translator import ROOT, describe_machine, take_turns

from rol import mcl
from rol.compiled import compiled
from rol.files import write_text
from rol.geometry import invert, transform_points
from rol.mcl import MapGrid
from rol_beyond.likelihood_field import build_likelihood_field
from rol_book.parameters import positive
from rol_data import rall

CELLS = (0.5, 0.25, 0.125)  # sides of a cell [m]
RANGE = 64.0  # of the translator's points [m]


def draw_streets(rng: np.random.Generator) -> np.ndarray:
    """Draw walls of 100 m along both axes over the extent of the real map, with as many points [m]."""
    starts, walls = rng.uniform((0.0, 0.0), (1200.0, 1260.0), (1000, 1, 2)), np.zeros((1000, 400, 2))
    walls[:500, :, 0] = walls[500:, :, 1] = np.arange(0.0, 100.0, 0.25)
    return (starts + walls).reshape(-1, 2)


def open_map(given: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the points of the map, a pose among them, and a description of the map."""
    root = rall.find_real_root(given)
    if root is None:
        points = draw_streets(rng)
        middle = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
        return points, np.append(middle, 0.7), "random streets, for the real map is not at hand"
    poses = rall.load_poses(root / rall.POSES_PATH / "pose_xy_01.txt")
    return rall.load_map_points(root / rall.MAP_PATH), poses[len(poses) // 2], "lidar map of the Oxford route"


def draw_cloud(map_points: np.ndarray, pose: np.ndarray, m: int, rng: np.random.Generator) -> np.ndarray:
    """Draw a cloud as seen from the pose: map points in range, 0.3 m off, farthest forward first as in an image."""
    near = map_points[np.linalg.norm(map_points - pose[:2], axis=1) < RANGE]
    seen = near[rng.integers(0, len(near), m)] + rng.normal(0.0, 0.3, (m, 2))
    cloud = transform_points(invert(pose), seen)
    return cloud[np.argsort(-cloud[:, 0])]


def draw_particles(pose: np.ndarray, n: int, rng: np.random.Generator, spread: bool = False) -> np.ndarray:
    """Draw particles about the pose, tracked or spread."""
    if spread:
        return pose + rng.uniform(-1.0, 1.0, (n, 3)) * (150.0, 150.0, np.pi)
    return mcl.sample_particles(pose, n, 0.5, np.deg2rad(1.0), rng)


def count_with_numpy(particles: np.ndarray, points: np.ndarray, grid: MapGrid) -> np.ndarray:
    """Sum the grid's values under the points in NumPy; the fastest way found that takes all pairs at once."""
    c, s = np.cos(particles[:, 2]) / grid.cell, np.sin(particles[:, 2]) / grid.cell
    u, v = ((particles[:, :2] - grid.origin) / grid.cell).T
    ahead = np.vstack([points.T, np.ones(len(points))])
    rows, columns = np.stack([c, -s, u], axis=1) @ ahead, np.stack([s, c, v], axis=1) @ ahead
    h, w = grid.values.shape
    is_inside = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
    cells = rows.astype(np.int32) * w + columns.astype(np.int32)
    return np.sum(grid.values.ravel().take(cells, mode="clip") * is_inside, axis=1)


@compiled(parallel=True)
def _sum_in_parts(particles, points, values, x0, y0, cell, n_parts):
    """Divide the particles into parts, one for each thread."""
    n = particles.shape[0]
    sums = np.empty(n, dtype=np.int64)
    for part in numba.prange(n_parts):
        first, end = part * n // n_parts, (part + 1) * n // n_parts
        sums[first:end] = mcl._sum_values(particles[first:end], points, values, x0, y0, cell)
    return sums


def count_with_threads(particles: np.ndarray, points: np.ndarray, grid: MapGrid) -> np.ndarray:
    """Count matches with all of numba's threads."""
    given = map(np.ascontiguousarray, (particles, points, grid.values))
    return _sum_in_parts(*given, *map(float, grid.origin), float(grid.cell), numba.get_num_threads())


def ways_to_weigh(particles: np.ndarray, points: np.ndarray, grid: MapGrid) -> dict[str, Callable]:
    """List the compiled ways of weighting."""
    given = particles, points, grid
    return {
        "one thread": partial(mcl.count_matches, *given),
        "all threads": partial(count_with_threads, *given),
    }


def time_rows(rows: dict[str, dict[str, Callable]], rounds: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of each way of each row, by the clock and of the processors; all ways take turns."""
    used: dict[tuple[str, str], list[float]] = {(row, way): [] for row, ways in rows.items() for way in ways}

    def run(key: tuple[str, str]) -> None:
        begin = process_time()
        rows[key[0]][key[1]]()
        used[key].append(process_time() - begin)

    found = take_turns({key: partial(run, key) for key in used}, rounds)
    table: dict[str, dict[str, float]] = {row: {} for row in rows}
    for (row, way), seconds in found.items():
        table[row][f"{way} [ms]"] = 1e3 * seconds
        table[row][f"{way} [processor ms]"] = 1e3 * float(np.median(used[row, way][1:]))
    return table


def time_weighings(draw: Callable, grid: MapGrid, rounds: int) -> dict[str, dict[str, float]]:
    """Weigh beside NumPy, tracked and spread particles; every way must give the same sums."""
    rows = {}
    for n, m, kind in (
        (500, 2000, "tracked"),
        (5000, 400, "tracked"),
        (500, 2000, "spread"),
        (5000, 400, "spread"),
    ):
        particles, points = draw(n, m, kind == "spread")
        ways = {"numpy": partial(count_with_numpy, particles, points, grid)}
        ways |= ways_to_weigh(particles, points, grid)
        first, *others = [way() for way in ways.values()]
        assert all(np.array_equal(first, other) for other in others), "the ways do not agree"
        rows[f"weighing, {n} x {m}, {kind}"] = ways
    table = time_rows(rows, rounds)
    for row in table.values():
        for way in ("one thread", "all threads"):
            row[f"times faster, {way}"] = row["numpy [ms]"] / row[f"{way} [ms]"]
        row["times less processor time"] = row["numpy [processor ms]"] / row["one thread [processor ms]"]
    return table


def time_updates(draw: Callable, grid: MapGrid, rounds: int) -> dict[str, dict[str, float]]:
    """One scan's update of the method `paper`, whole and in two parts."""
    settings, rng, rows = mcl.MclSettings(), np.random.default_rng(2), {}
    weights = np.full(settings.n_particles, 1.0 / settings.n_particles)
    for m in (400, 2000):
        particles, points = draw(settings.n_particles, m)
        move = partial(mcl.predict, particles, np.array([2.0, 0.0, 0.02]), settings.motion, rng)

        def update(move=move, points=points):
            return mcl.update(move(), weights, points, grid, settings, rng)

        rows[f"update, {settings.n_particles} x {m}"] = {
            "whole": update,
            "predict": move,
            "weigh, one thread": ways_to_weigh(particles, points, grid)["one thread"],
        }
    return time_rows(rows, rounds)


def time_sizes(draw: Callable, grid: MapGrid, rounds: int) -> dict[str, dict[str, float]]:
    """Weigh with more and more particles, and points."""
    sizes = [("particles", n, n, 2000) for n in (100, 300, 1000, 3000, 10000)]
    sizes += [("points", m, 500, m) for m in (100, 250, 500, 1000, 2000, 4000)]
    return time_rows(
        {f"{what}, {size}": ways_to_weigh(*draw(n, m), grid) for what, size, n, m in sizes}, rounds
    )


def cut_map(map_points: np.ndarray, pose: np.ndarray, share: float) -> np.ndarray:
    """Keep a share of the map's area: a window of its shape about the pose, moved into the map."""
    low, high = map_points.min(axis=0), map_points.max(axis=0)
    size = (high - low) * np.sqrt(share)
    corner = np.clip(pose[:2] - size / 2.0, low, high - size)
    return map_points[((map_points >= corner) & (map_points <= corner + size)).all(axis=1)]


def time_maps(
    map_points: np.ndarray, pose: np.ndarray, draw: Callable, grids: dict[float, MapGrid], rounds: int
) -> dict[str, dict[str, float]]:
    """Weigh on larger and larger maps, and on finer and finer cells; say what each grid takes."""
    of_size = {f"cell, {cell} m": grid for cell, grid in grids.items()}
    for name, share in {"a quarter": 0.25, "a half": 0.5, "whole": 1.0}.items():
        of_size[f"map, {name}"] = mcl.build_matched_grid(cut_map(map_points, pose, share), cell=0.25)
    rows, near, far = {}, draw(500, 2000), draw(500, 2000, True)
    for name, grid in of_size.items():
        rows[name] = {
            "tracked, one thread": ways_to_weigh(*near, grid)["one thread"],
            "spread, one thread": ways_to_weigh(*far, grid)["one thread"],
        }
    table = time_rows(rows, rounds)
    return {name: {**row, "grid [bytes]": of_size[name].values.nbytes} for name, row in table.items()}


def time_builds(map_points: np.ndarray, rounds: int) -> dict[str, dict[str, float]]:
    """Build the grid of the whole map, for both measurements."""
    rows = {}
    for cell in CELLS:
        rows[f"building, {cell} m"] = {
            "matched cells": partial(mcl.build_matched_grid, map_points, cell=cell),
            "distances": partial(build_likelihood_field, map_points, cell=cell),
        }
    return time_rows(rows, rounds)


def measure(
    map_points: np.ndarray, pose: np.ndarray, rounds: int, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Measure all rows."""

    def draw(n: int, m: int, spread: bool = False) -> tuple[np.ndarray, np.ndarray]:
        return draw_particles(pose, n, rng, spread), draw_cloud(map_points, pose, m, rng)

    grids = {cell: mcl.build_matched_grid(map_points, cell=cell) for cell in CELLS}
    return {
        **time_weighings(draw, grids[0.25], rounds),
        **time_updates(draw, grids[0.125], rounds),
        **time_sizes(draw, grids[0.25], rounds),
        **time_maps(map_points, pose, draw, grids, rounds),
        **time_builds(map_points, max(rounds // 5, 1)),
    }


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast the particle filter is, beside NumPy.")
    parser.add_argument("--rounds", type=positive, default=25)
    parser.add_argument("--real-root", default="", help="folder of the real data")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    map_points, pose, words = open_map(given.real_root, rng)
    about = {
        **describe_machine(numba.get_num_threads()),
        "numba": numba.__version__,
        "load when begun": os.getloadavg()[0],
        "map": words,
        "map points": len(map_points),
    }
    with threadpool_limits(1, "blas"):
        table = measure(map_points, pose, given.rounds, rng)
    for name, row in table.items():
        print(f"{name:30s}", "  ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)
    path = ROOT / "data" / "performance" / "filter.json"
    write_text(path, json.dumps({"about": about, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
