"""Train a network that comes with the book: sessions, pairs, training, evaluation, weights and card.

    python workflow/train_weights.py data/weights/recipe.yaml unet [--device cuda] [--threads 2]
    python workflow/train_weights.py data/weights/recipe.yaml unet --judge
    python workflow/train_weights.py data/weights/recipe.yaml ablations

Every stage resumes where it stopped, and a finished stage is not repeated. The weights go to
`data/weights/NAME.safetensors` in half precision, their card to `data/weights/NAME.json`. With `--judge` nothing is
trained: the weights are evaluated again and compared with their card. Of the ablations no weights are kept, only their
evaluation: `data/ablations/translator.csv`.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import torch

from rol_book.parameters import positive
from rol_data.rall import find_real_root
from rol_study import shipped_networks as shipped

DATA = Path(__file__).resolve().parents[1] / "data"
WEIGHTS, ABLATIONS = DATA / "weights", DATA / "ablations" / "translator.csv"


def read_arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", type=Path)
    parser.add_argument("network", help="a network of the recipe, or 'ablations'")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=positive, default=2)
    parser.add_argument(
        "--judge", action="store_true", help="evaluate the existing weights again, train nothing"
    )
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Train, evaluate and write the requested networks."""
    given = read_arguments(words)
    torch.set_num_threads(given.threads)
    recipe = shipped.load_recipe(given.recipe)
    variants = shipped.list_variants(recipe)
    known = {**recipe["networks"], **variants}
    names = list(variants) if given.network == "ablations" else [given.network]
    if names[0] not in known:
        raise ValueError(f"no network {given.network!r}; there are: {', '.join([*known, 'ablations'])}")
    report = partial(print, flush=True)
    folders = given.recipe, WEIGHTS, ABLATIONS, find_real_root()
    places = shipped.Places(*folders, given.device, given.threads, report)
    if given.judge:
        held_out, real = shipped.open_sets(recipe, [], places), shipped.open_real(places)
        return 0 if shipped.compare_with_card(recipe, names[0], held_out, real, places) else 1
    shipped.run_networks(recipe, {name: known[name] for name in names}, places)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
