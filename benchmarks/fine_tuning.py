"""Fine-tune the book's network on the real Oxford pairs and evaluate it on other real scans.

python benchmarks/fine_tuning.py [--real-root DIR] [--seeds 3] [--steps 0,50,100,200,400] [--threads 1]

Writes data/ablations/fine_tuning.csv, which chapter 13 reads. About half an hour on one core with bf16 instructions.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import pandas as pd
import torch

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol.files import write_text
from rol.pix2pix import has_bf16, load_network
from rol_book.parameters import positive
from rol_data.rall import find_real_root
from rol_study.fine_tuning import SETTINGS, load_test_pairs, load_training_pairs, run_study

DATA = Path(__file__).resolve().parents[1] / "data"
FIRST = ["seed", "steps", "source", "threshold", "n_scans"]


def main() -> None:
    """Fine-tune, evaluate and write the table after each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real-root", default="", help="folder of the real data")
    parser.add_argument("--seeds", type=positive, default=3, help="number of seeds")
    parser.add_argument("--steps", default="0,50,100,200,400", help="numbers of steps to evaluate at")
    parser.add_argument("--threads", type=positive, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    root = find_real_root(given.real_root)
    if root is None:
        raise SystemExit("the real pairs are not at hand: run `make real`, or give --real-root")
    network = load_network(DATA / "weights" / "unet.safetensors")
    pairs, others = load_training_pairs(root), load_test_pairs(root)
    counts, seeds = sorted(int(word) for word in given.steps.split(",")), range(1, given.seeds + 1)
    tables, begin = [], perf_counter()
    for table in run_study(network, pairs, others, seeds, counts, replace(SETTINGS, bf16=has_bf16())):
        tables.append(table)
        every = pd.concat(tables, ignore_index=True)
        every = every[[*FIRST, *(name for name in every if name not in FIRST)]]
        path = DATA / "ablations" / "fine_tuning.csv"
        write_text(path, every.to_csv(index=False, float_format="%.4f"))
        shown = table[table.threshold == network.points["threshold"]].drop(columns="threshold")
        print(f"{perf_counter() - begin:.0f} s\n{shown.to_string(index=False)}", flush=True)


if __name__ == "__main__":
    main()
