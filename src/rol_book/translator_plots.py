"""Figures about generated points and the networks that generate them. Nothing here computes a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rol_book import plots
from rol_book.plots import COLOURS, FRONT_END_COLOURS

NOISE_POWER = 24  # grey value of the radar's noise, drawn white
SOURCE_LOOKS = {  # of the real scans that a fine-tuned network is evaluated on
    "pairs": ("#8C8C8C", "s", "the pairs themselves"),
    "map": ("#0072B2", "o", "fast turn, on the map"),
    "fog": ("#D55E00", "^", "RADIATE, fog"),
}


def draw_example(radar_image: np.ndarray, generated: np.ndarray, lidar: np.ndarray) -> Figure:
    """Draw generated and lidar points over the radar image, whole and enlarged.

    Parameters
    ----------
    radar_image : array, shape (w, w), uint8
        Power.
    generated, lidar : array, shape (n, 2), (m, 2)
        Points [m].

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, 2, height=4.7)
    echoes = np.maximum(radar_image, NOISE_POWER) - NOISE_POWER
    for ax, size in zip(axes, (1.0, 7.0), strict=True):
        plots.show_image(ax, echoes, vmax=150)
        plots.show_points(ax, lidar, colour=COLOURS["real"], size=size, label="lidar")
        plots.show_points(ax, generated, colour=COLOURS["fake"], size=size, label="generated")
    plots.zoom(plots.frame_square(axes[0], (12.0, 0.0), 18.0), (0.0, 0.0), 64.0)
    plots.zoom(axes[1], (12.0, 0.0), 18.0)
    axes[1].legend(loc="upper right", markerscale=3, frameon=True)
    return figure


def draw_cases(cases: Sequence[Mapping[str, Any]], edges: np.ndarray) -> Figure:
    """Draw the paper's Fig. 3: a row per scan with radar, generated and lidar image and the distances.

    Parameters
    ----------
    cases : sequence of mapping
        Per row ``label``, the images ``radar``, ``generated``, ``lidar`` (shape (w, w), uint8), ``counts``
        (points per bin, shape (k,)) and the percentages ``within_1m`` and ``within_2m``.
    edges : array, shape (k + 1,)
        Edges of the bins [m].

    Returns
    -------
    figure : Figure
        The figure.
    """
    titles = ("radar", "generated", "lidar")
    figure, axes = plots.subplots(len(cases), 4, height=2.3 * len(cases), squeeze=False)
    top = max(105.0 * case["counts"].max() / max(case["counts"].sum(), 1) for case in cases)
    for i, (row, case) in enumerate(zip(axes, cases, strict=True)):
        radar = np.maximum(case["radar"], NOISE_POWER) - NOISE_POWER
        images = [radar, case["generated"], case["lidar"]]
        names = titles if i == 0 else ("", "", "")
        plots.draw_image_grid(
            row[None, :3], [images], names, [case["label"]], half=50.0, vmax=(100, 255, 255)
        )
        text = f"{case['within_1m']:.0f} % < 1 m\n{case['within_2m']:.0f} % < 2 m"
        plots.draw_distances(row[3], case["counts"], edges, text=text)
        row[3].set(xlabel="distance [m]" if i == len(cases) - 1 else "", ylim=(0.0, max(top, 1.0)))
        row[3].set_title("NN distance" if i == 0 else "")
    return figure


def draw_both_ways(counts: np.ndarray, edges: np.ndarray) -> Figure:
    """Draw the distances from generated to lidar points and back.

    Parameters
    ----------
    counts : array, shape (2, k)
        Points per bin, in both directions.
    edges : array, shape (k + 1,)
        Edges of the bins [m].

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, 2, height=3.2)
    titles = ("generated to lidar (precision)", "lidar to generated (recall)")
    top = 105.0 * (counts / counts.sum(axis=1, keepdims=True)).max()
    for ax, row, title in zip(axes, counts, titles, strict=True):
        near = [100.0 * row[edges[1:] <= r].sum() / row.sum() for r in (1.0, 2.0)]
        plots.draw_distances(ax, row, edges, text=f"{near[0]:.0f} % < 1 m\n{near[1]:.0f} % < 2 m")
        ax.set(title=title, xlabel="distance to the nearest point [m]", ylim=(0.0, top))
    return figure


def draw_speed(moving: pd.DataFrame, columns: Mapping[str, str]) -> Figure:
    """Draw the precision of scans over the speed, with means of the classes of speed.

    Parameters
    ----------
    moving : pandas.DataFrame
        One row per scan with ``vx_mps`` [m/s], its class ``speed``, and fractions.
    columns : mapping of str to str
        Column of a fraction -> its name in the legend; the first is drawn in the radar's colour.

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, ax = plots.subplots(height=3.4)
    for (column, label), colour in zip(columns.items(), ("radar", "fake"), strict=True):
        ax.plot(moving.vx_mps, 100.0 * moving[column], ".", color=COLOURS[colour], markersize=3, alpha=0.3)
        means = moving.groupby("speed", observed=True)[["vx_mps", column]].mean()
        ax.plot(means.vx_mps, 100.0 * means[column], "o-", color=COLOURS[colour], label=label)
    ax.set(xlabel="speed [m/s]", ylabel="precision at 1 m [%]", ylim=(0, 102))
    ax.legend(loc="lower left")
    return figure


def draw_thresholds(table: pd.DataFrame, used: int) -> Figure:
    """Draw number, precision and recall of generated points over the threshold.

    Parameters
    ----------
    table : pandas.DataFrame
        Of `rol_study.session_similarity.compare_thresholds`.
    used : int
        Threshold in use, drawn as a vertical line.

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, 2, height=3.2)
    axes[0].plot(table.index, table.n_fake, "o-", color=COLOURS["fake"])
    axes[0].set(ylabel="generated points per scan", ylim=(0, None))
    for column, colour, marker, label in (
        ("fake_to_real_within_1m", "fake", "o", "precision"),
        ("real_to_fake_within_1m", "real", "s", "recall"),
    ):
        axes[1].plot(table.index, 100.0 * table[column], marker=marker, color=COLOURS[colour], label=label)
    axes[1].set(ylabel="points within 1 m [%]", ylim=(0, 102))
    axes[1].legend(loc="lower left")
    for ax in axes:
        ax.axvline(used, color="#444444", linewidth=0.9, linestyle="--")
        ax.set_xlabel("threshold on the grey value")
    return figure


def draw_networks(
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray]], lidar: np.ndarray, half: float = 45.0
) -> Figure:
    """Draw the points of networks over the lidar points: near ones and others, a panel each.

    Parameters
    ----------
    clouds : mapping of str to tuple
        Network -> points, shape (n, 2) [m], and their distances to the nearest lidar point, shape (n,) [m].
    lidar : array, shape (m, 2)
        Lidar points [m].
    half : float
        Half the edge of the square shown [m].

    Returns
    -------
    figure : Figure
        The figure.
    """
    n_rows = -(-len(clouds) // 2)
    figure, axes = plots.subplots(n_rows, 2, height=4.2 * n_rows, squeeze=False)
    for ax, (name, (points, distances)) in zip(axes.flat, clouds.items(), strict=False):
        plots.show_points(ax, lidar, colour="#B5B5B5", size=0.6)
        near = distances < 1.0
        plots.show_points(ax, points[near], colour=COLOURS["fake"], size=1.6)
        plots.show_points(ax, points[~near], colour=COLOURS["estimate"], size=1.6)
        plots.zoom(ax, (0.0, 0.0), half).set_title(name)
    return figure


def draw_changes(compared: pd.DataFrame, noise: Mapping[str, float], labels: Mapping[str, str]) -> Figure:
    """Draw how variants of a network differ from it, beside the range of other seeds.

    Parameters
    ----------
    compared : pandas.DataFrame
        Of `rol_study.translator_variants.compare_variants`, with the row "base".
    noise : mapping of str to float
        Of `rol_study.translator_variants.seed_noise`: half the width of the grey band.
    labels : mapping of str to str
        Variants in the order of the figure, and their names.

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, 2, height=4.2)
    places = -np.arange(len(labels))
    for ax, column, title in zip(
        axes, ("simulated_1m", "real_1m"), ("simulated places", "real scans"), strict=True
    ):
        change = (compared[column] - compared.loc["base", column]).reindex(labels)
        ax.axvspan(-noise[column], noise[column], color="#DDDDDD", zorder=0)
        ax.axvline(0.0, color="#444444", linewidth=0.9)
        ax.plot(change, places, "o", color=COLOURS["real"], markersize=7)
        for place in places[change.isna().to_numpy()]:
            ax.text(0.03, place, "not reached", va="center", transform=ax.get_yaxis_transform())
        ax.set_yticks(places, labels.values())
        ax.set(
            title=title,
            xlabel="change of the precision [points]",
            xlim=(-6.5, 4.5),
            ylim=(0.6 - len(labels), 0.6),
        )
    return figure


def draw_curves(
    panels: Sequence[tuple[str, Mapping[str, pd.DataFrame], Mapping[str, tuple[str, str]]]], at: float
) -> Figure:
    """Draw precision over recall of networks at all thresholds, a panel for each group of networks.

    Parameters
    ----------
    panels : sequence of (title, curves, looks)
        Curves by name, one row per threshold; looks map the names that are drawn to label and colour. An
        empty label draws a thin line without a place in the legend.
    at : float
        Recall at which networks are compared, drawn as a vertical line (0..1).

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, len(panels), height=4.0)
    for ax, (title, curves, looks) in zip(np.atleast_1d(axes), panels, strict=True):
        ax.axvline(100.0 * at, color="#444444", linewidth=0.9, linestyle="--")
        for name, (label, colour) in looks.items():
            _draw_curve(ax, curves[name], label, colour)
        ax.set(title=title, xlabel="recall at 1 m [%]", ylabel="precision at 1 m [%]")
        ax.set(xlim=(0, 100), ylim=(75, 100))
        ax.legend(loc="lower left")
    return figure


def _draw_curve(ax: Axes, curve: pd.DataFrame, label: str, colour: str) -> None:
    """Draw one network at all thresholds; thin without a label."""
    drawn = curve[curve["n_fake"] > 0]
    recall, precision = (100.0 * drawn[f"{way}_within_1m"] for way in ("real_to_fake", "fake_to_real"))
    look = {"marker": "o", "markersize": 3.5, "label": label} if label else {"linewidth": 1.0, "zorder": 1}
    ax.plot(recall, precision, color=colour, **look)


def network_looks(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return each network's name and colour in the book, for `draw_curves`."""
    return {name: (name, FRONT_END_COLOURS.get(name, "#000000")) for name in names}


def draw_tuning(tuned: pd.DataFrame) -> Figure:
    """Draw precision and recall of a fine-tuned network over the steps of the fine-tuning.

    Parameters
    ----------
    tuned : pandas.DataFrame
        Of `rol_study.translator_variants.compare_tuned`; thin lines are seeds, thick ones their means.

    Returns
    -------
    figure : Figure
        The figure.
    """
    figure, axes = plots.subplots(1, 3, height=3.6)
    titles = {
        "equal_1m": "precision, equal recall",
        "precision_1m": "precision, same threshold",
        "recall_1m": "recall, same threshold",
    }
    for ax, (column, title) in zip(axes, titles.items(), strict=True):
        for source, (colour, marker, label) in SOURCE_LOOKS.items():
            own = tuned[tuned["source"] == source]
            start = own[own["steps"] == 0]
            for _, rows in own[own["steps"] > 0].groupby("seed"):
                line = pd.concat([start, rows])
                ax.plot(line["steps"], line[column], color=colour, linewidth=0.8, alpha=0.6)
            means = own.groupby("steps")[column].mean()
            ax.plot(means.index, means, marker=marker, color=colour, label=label)
        ax.set(title=title, xlabel="steps", ylabel="points within 1 m [%]", ylim=(0, 102))
    axes[0].legend(loc="lower left")
    return figure
