"""Read and compare the evaluations of the networks' variants: `data/ablations/translator.csv` and the cards.

Every network is evaluated at many grey values. Networks are compared where they have the same recall, or the
same number of points where there is no recall, so that thresholds are not compared with each other.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rol.files import read_text

PRINTED = "paper-as-printed"  # a network of another length, not one of the variants
RECALL, PRECISION = "real_to_fake_within_1m", "fake_to_real_within_1m"
KINDS = {"simulated": RECALL, "real": "n_fake"}  # data -> along which column networks are compared


def value_at(curve: pd.DataFrame, along: str, value: float, column: str) -> float:
    """Interpolate a column of a curve linearly where another column has a value.

    Parameters
    ----------
    curve : pandas.DataFrame
        One row per threshold.
    along, column : str
        Column that has the value, and the one that is read.
    value : float
        The value.

    Returns
    -------
    found : float
        nan where the curve does not reach the value.
    """
    rows = curve.sort_values(along)
    if not rows[along].min() <= value <= rows[along].max():
        return float("nan")
    return float(np.interp(value, rows[along], rows[column]))


def load_variants(path: str | Path) -> tuple[dict[str, dict[str, pd.DataFrame]], pd.DataFrame]:
    """Read the table of the ablations.

    Parameters
    ----------
    path : path
        `data/ablations/translator.csv`.

    Returns
    -------
    curves : dict
        "simulated" and "real" -> variant -> one row per threshold; for "simulated" the means over the
        simulated places.
    printed : pandas.DataFrame
        The rows of the network "paper-as-printed".
    """
    table = pd.read_csv(path)
    table["network"] = table["network"].str.removeprefix("ablation-")
    is_printed = table["network"] == PRINTED
    variants = {name: rows for name, rows in table[~is_printed].groupby("network", sort=False)}
    curves: dict[str, dict[str, pd.DataFrame]] = {"simulated": {}, "real": {}}
    for name, rows in variants.items():
        for kind, found in split_places(rows).items():
            curves[kind][name] = found
    return curves, table[is_printed]


def split_places(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split the evaluation of a network into "simulated" (means over the places) and "real", where it has
    them; one row per threshold."""
    is_real = table["places"] == "real"
    found = {"simulated": table[~is_real], "real": table[is_real]}
    return {
        kind: rows.groupby("threshold").mean(numeric_only=True).reset_index()
        for kind, rows in found.items()
        if len(rows)
    }


def compare_variants(
    curves: Mapping[str, Mapping[str, pd.DataFrame]], at: Mapping[str, float]
) -> pd.DataFrame:
    """Compare all variants at the same recall (simulated) and number of points (real).

    Parameters
    ----------
    curves : mapping
        Of `load_variants`.
    at : mapping of str to float
        "simulated" -> recall at 1 m, "real" -> points per scan.

    Returns
    -------
    table : pandas.DataFrame
        One row per variant: precision in percent, ``simulated_1m``, ``simulated_2m``, ``real_1m``,
        ``real_2m``; nan where a variant does not reach the value; and ``simulated_points``.
    """
    rows: dict[str, dict[str, float]] = {name: {} for name in curves["simulated"]}
    for kind, along in KINDS.items():
        for name, curve in curves[kind].items():
            for r in (1, 2):
                column = f"fake_to_real_within_{r}m"
                rows[name][f"{kind}_{r}m"] = 100.0 * value_at(curve, along, at[kind], column)
    for name, curve in curves["simulated"].items():
        rows[name]["simulated_points"] = value_at(curve, RECALL, at["simulated"], "n_fake")
    return pd.DataFrame.from_dict(rows, orient="index")


def seed_noise(compared: pd.DataFrame, base: str = "base") -> pd.Series:
    """Compute how far other seeds of a network are from it at most.

    Parameters
    ----------
    compared : pandas.DataFrame
        Of `compare_variants`; the seeds are the rows whose name begins with "seed".
    base : str
        Row of the network.

    Returns
    -------
    noise : pandas.Series
        Largest distance of each column; nan without other seeds.
    """
    seeds = compared[compared.index.str.startswith("seed")]
    return (seeds - compared.loc[base]).abs().max()


def load_cards(folder: str | Path, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Read the cards of networks, by name."""
    return {name: json.loads(read_text(Path(folder, f"{name}.json"))) for name in names}


def summarize_card(card: Mapping[str, Any]) -> dict[str, float]:
    """Summarize the evaluation of a network at the threshold that it comes with.

    Parameters
    ----------
    card : mapping
        Card of a network.

    Returns
    -------
    summary : dict
        ``weights``, ``steps``, ``batch_size``, ``threshold``, ``headings``; in percent, over the simulated
        places, ``precision_1m``, ``precision_2m``, ``recall_1m``, with ``points``; for the real scans on the
        map ``real_1m``, ``real_2m`` and ``real_points``, nan where the card has none.
    """
    places = split_places(pd.DataFrame(card["judged"]))
    at = {kind: curve.set_index("threshold").loc[card["threshold"]] for kind, curve in places.items()}
    real = at.get("real", pd.Series(dtype=float))
    return {
        "weights": card["weights"],
        "steps": card["history"]["step"][-1],
        "batch_size": card["recipe"]["network"].get("batch_size", 1),
        "threshold": card["threshold"],
        "headings": card["headings"],
        **{f"precision_{r}m": 100.0 * at["simulated"][f"fake_to_real_within_{r}m"] for r in (1, 2)},
        "recall_1m": 100.0 * at["simulated"][RECALL],
        "points": at["simulated"]["n_fake"],
        **{f"real_{r}m": 100.0 * real.get(f"fake_to_real_within_{r}m", np.nan) for r in (1, 2)},
        "real_points": real.get("n_fake", np.nan),
    }


def gain_of_headings(card: Mapping[str, Any], at: Mapping[str, float]) -> dict[str, float]:
    """Compute what averaging over headings adds to the precision at 1 m.

    Parameters
    ----------
    card : mapping
        Card of a network with ``judged`` and ``judged_one_heading``.
    at : mapping of str to float
        As of `compare_variants`.

    Returns
    -------
    gain : dict
        "simulated" and "real" -> percentage points.
    """
    found = []
    for judged in (card["judged"], card["judged_one_heading"]):
        places = split_places(pd.DataFrame(judged))
        found.append(
            {kind: value_at(curve, KINDS[kind], at[kind], PRECISION) for kind, curve in places.items()}
        )
    return {kind: 100.0 * (found[0][kind] - found[1][kind]) for kind in found[0]}


def compare_tuned(table: pd.DataFrame, threshold: int, sources: Sequence[str]) -> pd.DataFrame:
    """Compare a fine-tuned network with itself before, at the same recall.

    Parameters
    ----------
    table : pandas.DataFrame
        `data/ablations/fine_tuning.csv`.
    threshold : int
        Threshold of the network before the fine-tuning; its recall there is the one of the comparison.
    sources : sequence of str
        Values of ``source``.

    Returns
    -------
    rows : pandas.DataFrame
        One row per seed, number of steps and source: ``seed``, ``steps``, ``source``, ``n_scans``, and in
        percent ``precision_1m`` and ``recall_1m`` at the threshold, ``points`` there, and ``equal_1m``, the
        precision at 1 m at the recall of the network before (nan where it is not reached).
    """
    rows = []
    for source in sources:
        own = table[table["source"] == source]
        before = own[(own["steps"] == 0) & (own["threshold"] == threshold)].iloc[0]
        for (seed, steps), curve in own.groupby(["seed", "steps"]):
            at = curve[curve["threshold"] == threshold].iloc[0]
            equal = value_at(curve, "recall_1m", before["recall_1m"], "precision_1m")
            rows.append(
                {
                    "seed": seed,
                    "steps": steps,
                    "source": source,
                    "n_scans": int(at["n_scans"]),
                    "precision_1m": 100.0 * at["precision_1m"],
                    "recall_1m": 100.0 * at["recall_1m"],
                    "points": at["n_points"],
                    "equal_1m": 100.0 * equal,
                }
            )
    return pd.DataFrame(rows)
