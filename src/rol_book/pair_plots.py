"""Figures and tables of real radar scans with real sweeps. Nothing here computes a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from rol.similarity import distance_histogram, nn_distances
from rol_book import plots
from rol_book.plots import COLOURS, FRONT_END_COLOURS

GREY = "#444444"  # of levels
NOISE = 24  # power that is shown as white
MOTIONS = {"none": "as recorded", "compensated": "compensated"}
REFERENCES = {"nearest": "nearest", "turn": "all of the turn"}
QUANTITIES = {  # row of `rol_study.real_calibration.calibrate` -> label and digits
    "rotation_deg": ("rotation of the radar [deg]", 2),
    "rotation_deg, 5 to 20 m": ("by points at 5 to 20 m [deg]", 2),
    "rotation_deg, 20 to 50 m": ("by points at 20 to 50 m [deg]", 2),
    "forward_m": ("shift forward [m]", 2),
    "left_m": ("shift to the left [m]", 2),
    "delay_ms": ("delay of the sweeps [ms]", 1),
    "doppler_s": ("Doppler constant [s]", 3),
    "resolution_m": ("length of a bin [m]", 5),
    "offset_m": ("range offset [m]", 2),
    "offset_m, walls beside": ("by walls beside [m]", 2),
    "offset_m, walls ahead or behind": ("by walls ahead and behind [m]", 2),
    "beyond_m": ("walls shown too far by [m]", 2),
}


# ---- tables ----


def join_spread(mean: pd.Series, spread: pd.Series, digits: int = 0) -> pd.Series:
    """Format means with their spreads, "4.06 ± 0.69"; a mean alone where there is no spread."""
    texts = []
    for value, sd in zip(mean, spread, strict=True):
        texts.append(f"{value:.{digits}f} ± {sd:.{digits}f}" if np.isfinite(sd) else f"{value:.{digits}f}")
    return pd.Series([text.replace("-", "−") for text in texts], mean.index, dtype=object)


def format_misalignment(table: pd.DataFrame) -> pd.DataFrame:
    """Format the shift of radar images, see `rol_study.real_pairs.tabulate_misalignment`: mean ± sd."""
    groups = table.groupby(["motion", "sweeps"], sort=False)[["forward_m", "left_m"]]
    mean, sd = groups.mean(), groups.std()
    ratio = (table.forward_m / table.speed_mps).groupby([table.motion, table.sweeps], sort=False).mean()
    columns = {
        "motion": mean.index.get_level_values(0).map(MOTIONS),
        "sweeps": mean.index.get_level_values(1).map(REFERENCES),
        "forward [m]": join_spread(mean.forward_m, sd.forward_m, 2),
        "to the left [m]": join_spread(mean.left_m, sd.left_m, 2),
        "forward per speed [s]": ratio.map("{:.2f}".format).str.replace("-", "−"),
    }
    return pd.DataFrame(columns)


def format_calibration(calibration: pd.DataFrame, used: Mapping[str, str]) -> pd.DataFrame:
    """Format a calibration, see `rol_study.real_calibration.calibrate`, beside the values in use by row."""
    rows = []
    for name, (label, digits) in QUANTITIES.items():
        one = calibration.loc[[name]]
        rows.append((label, join_spread(one.value, one.error, digits).iloc[0], used.get(name, "")))
    return pd.DataFrame(rows, columns=["quantity", "real scans", "used in this book"])


def format_comparison(comparison: Any, ways: Mapping[tuple[str, str], str]) -> pd.DataFrame:
    """Format precision and recall [%] per front end below the paper's numbers.

    Parameters
    ----------
    comparison : Comparison
        From `rol_study.real_pairs.compare_front_ends`, not empty.
    ways : mapping
        Motion and reference -> title of their columns; the first is that of the paper's numbers.

    Returns
    -------
    table : pandas.DataFrame
        One row per front end, mean ± sd over the scans.
    """
    labels = {"precision_1m": "1 m", "precision_2m": "2 m", "recall_1m": "recall, 1 m"}
    names = list(dict.fromkeys(comparison.rows.front_end))
    columns = {("", "front end"): pd.Series(["paper, Sec. IV-B", *names], ["reported", *names])}
    for way, title in ways.items():
        means = comparison.average(way)
        for key, label in labels.items():
            columns[title, label] = join_spread(means[key], means[f"{key}_sd"])
    columns["", "points"] = comparison.rows.groupby("front_end").n_points.mean().map("{:.0f}".format)
    table = pd.DataFrame(columns).reindex(["reported", *names])
    first = next(iter(ways.values()))
    table.loc["reported", [(first, "1 m"), (first, "2 m")]] = ["> 40", "≈ 60"]
    return table.fillna("–")


# ---- alignment and calibration ----


def draw_alignment(pairs: Mapping[str, Any]) -> Figure:
    """Draw lidar points over radar images side by side: title -> `rol_study.real_pairs.Pair`."""
    figure, axes = plots.subplots(1, len(pairs), height=4.7, squeeze=False)
    for ax, (title, pair) in zip(axes[0], pairs.items(), strict=True):
        plots.draw_overlay(ax, pair.radar_image, pair.lidar_points, size=3.0, title=title)
        plots.zoom(ax, (10.0, 0.0), 30.0)
    return figure


def draw_misalignment(table: pd.DataFrame) -> Figure:
    """Draw the forward shift against the nearest sweep over speed, by motion."""
    figure, ax = plots.subplots(height=3.3)
    for motion, colour, marker in (("none", "estimate", "s"), ("compensated", "real", "o")):
        some = table[(table.motion == motion) & (table.sweeps == "nearest")]
        ax.plot(some.speed_mps, some.forward_m, marker, color=COLOURS[colour], label=MOTIONS[motion])
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set(xlabel="speed [m/s]", ylabel="radar ahead of lidar [m]")
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 0.5))
    return figure


def draw_times(
    times: Any, spans_s: Sequence[float], delays_s: Sequence[float], power: Sequence[float]
) -> Figure:
    """Draw the evidence on stamp, duration (`rol_study.real_calibration.SweepTimes`) and delay of sweeps."""
    figure, axes = plots.subplots(1, 3, height=3.1)
    blue = COLOURS["real"]
    axes[0].plot(times.turned_deg, times.intervals_ms, ".", color=blue, alpha=0.5)
    axes[0].set(ylim=np.median(times.intervals_ms) + np.array([-0.6, 1.4]))
    axes[0].set(title="stamp", xlabel="turn of a sweep [deg]", ylabel="to the next stamp [ms]")
    axes[1].plot(1e3 * np.asarray(spans_s), 100 * times.apart_m.mean(axis=0), "o-", color=blue)
    axes[1].set(title="duration", xlabel="assumed [ms]", ylabel="distance of sweeps [cm]")
    axes[2].plot(1e3 * np.asarray(delays_s), power, "o-", color=COLOURS["radar"])
    axes[2].set(title="delay", xlabel="assumed [ms]", ylabel="power at lidar points")
    return figure


def draw_range_errors(table: pd.DataFrame) -> Figure:
    """Draw the distance of walls beyond their lidar points over range, see
    `rol_study.real_calibration.evaluate_ranges`."""
    figure, ax = plots.subplots(height=3.3)
    for name, colour in zip(table.columns.drop("range_m"), ("estimate", "real", "fake"), strict=False):
        ax.plot(table.range_m, table[name], "o-", color=COLOURS[colour], label=name)
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set(xlabel="range [m]", ylabel="radar beyond lidar [m]")
    ax.legend()
    return figure


def draw_ground(ground: Any, threshold: float) -> Figure:
    """Draw heights of lidar points and what a threshold keeps, from `rol_study.real_pairs.measure_ground`."""
    figure, axes = plots.subplots(1, 2, height=3.3)
    look = {"bins": np.arange(-3.0, 6.05, 0.1), "histtype": "step", "linewidth": 1.6}
    axes[0].hist(ground.near_m, color=COLOURS["real"], label="within 20 m", **look)
    axes[0].hist(ground.far_m, color=COLOURS["estimate"], label="farther", **look)
    axes[0].set(xlabel="z in the radar frame [m]", ylabel="points", yscale="log")
    axes[0].legend(loc="upper right")
    axes[1].plot(ground.levels_m, 100 * ground.kept, "o-", color=COLOURS["real"])
    axes[1].set(xlabel="threshold [m]", ylabel="points kept [%]", ylim=(0, 100))
    for ax in axes:
        ax.axvline(threshold, color="black", linestyle="--")
    return figure


# ---- real against generated ----


def draw_cases(
    cases: Sequence[tuple[Any, np.ndarray, np.ndarray]], *, half: float = 40.0, max_m: float = 5.0
) -> Figure:
    """Draw rows as in the paper's Fig. 3: radar, generated image, lidar, both on each other, distances.

    Parameters
    ----------
    cases : sequence of (pair, generated image, generated points)
        One per row.
    half : float
        Half the edge of the square shown [m].
    max_m : float
        End of the histograms; larger distances are counted in the last bin [m].

    Returns
    -------
    figure : Figure
    """
    widths = (1, 1, 1, 1, 1.15)
    figure, axes = plots.subplots(
        len(cases),
        5,
        height=0.3 + 1.72 * len(cases),
        squeeze=False,
        width_ratios=widths,
        sharex="col",
        sharey="col",
    )
    edges = np.arange(0.0, max_m + 0.01, 0.25)
    for row, (pair, generated, points) in zip(axes, cases, strict=True):
        plots.show_image(row[0], np.maximum(pair.radar_image, NOISE) - NOISE, vmax=90)
        plots.show_image(row[1], generated, vmax=255)
        plots.show_image(row[2], pair.lidar_image)
        plots.show_points(row[3], pair.lidar_points, colour="#A5A5A5", size=0.8)
        plots.show_points(row[3], points, colour=COLOURS["fake"], size=1.8)
        counts = distance_histogram(nn_distances(points, pair.lidar_points), edges)
        plots.draw_distances(row[4], counts, edges).set(xlabel="", ylabel="")
        for ax in row[:4]:
            plots.zoom(ax, (0.0, 0.0), half)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
            ax.spines[:].set_visible(True)
    titles = ("real radar", "generated", "real lidar", "overlay", "points [%]")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title)
    axes[-1, 4].set_xlabel("distance [m]")
    return figure


def draw_distance_curves(
    distances: Mapping[str, Mapping[str, np.ndarray]], paper: Sequence[float] = (40.0, 60.0)
) -> Figure:
    """Draw the cumulated distances of front ends to lidar points.

    Parameters
    ----------
    distances : mapping
        Title of a panel -> front end -> distances, shape (n,) [m].
    paper : sequence of two floats
        Percentages of the paper at 1 m and 2 m, drawn as stars.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, len(distances), height=3.6, sharey=True, squeeze=False)
    levels = np.arange(0.0, 5.01, 0.25)
    for ax, (title, by_front) in zip(axes[0], distances.items(), strict=True):
        for name, away in by_front.items():
            below = [100 * np.mean(away < level) for level in levels]
            ax.plot(levels, below, color=FRONT_END_COLOURS.get(name, "#000000"), label=name)
        ax.plot([1, 2], paper, "k*", markersize=10, label="paper, Sec. IV-B")
        ax.set(xlabel="distance to the nearest lidar point [m]", xlim=(0, 5), ylim=(0, 100), title=title)
    axes[0, 0].set_ylabel("points nearer [%]")
    axes[0, -1].legend(loc="lower right")
    return figure


def draw_kinds(points: np.ndarray, kinds: pd.DataFrame, lidar: np.ndarray) -> Figure:
    """Draw points by their distance to lidar points and by what the lidar can see.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m].
    kinds : pandas.DataFrame
        A row per point, from `rol_study.real_pairs.describe_points`.
    lidar : array, shape (m, 2)
        Lidar points [m].

    Returns
    -------
    figure : Figure
    """
    figure, (ax, side) = plots.subplots(1, 2, height=5.4, width_ratios=(1.6, 1))
    side.axis("off")
    is_far = kinds.distance_m >= 2.0
    groups = {
        "within 1 m": (kinds.distance_m < 1.0, "fake"),
        "1 to 2 m": ((kinds.distance_m >= 1.0) & ~is_far, "radar"),
        "over 2 m, hidden from the lidar": (is_far & kinds.is_hidden, "real"),
        "over 2 m, in view": (is_far & ~kinds.is_hidden, "estimate"),
    }
    plots.show_points(ax, lidar, colour="#A5A5A5", size=2.0, label="real lidar")
    for label, (is_kind, colour) in groups.items():
        some = points[is_kind.to_numpy()]
        plots.show_points(ax, some, colour=COLOURS[colour], size=7.0, label=label)
    plots.zoom(ax, (0.0, 0.0), 50.0)
    side.legend(*ax.get_legend_handles_labels(), loc="upper left", markerscale=2.5)
    return figure
