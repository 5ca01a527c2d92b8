"""Figures of measured times and of the drift of odometries. Nothing here computes a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from rol_book import plots

SPEED_COLOURS = {"plain": plots.COLOURS["map"], "ours": plots.COLOURS["real"]}


def draw_speedup(ax: Axes, table: pd.DataFrame, *, period_ms: float) -> Axes:
    """Draw the time of each step, plain and optimized, as two dots on a line.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    table : DataFrame
        Steps as index; columns "plain [ms]" and "ours [ms]".
    period_ms : float
        Time between two scans, a dashed line [ms].

    Returns
    -------
    ax : Axes
        The axes.
    """
    places = np.arange(len(table))[::-1]
    ax.hlines(places, table["ours [ms]"], table["plain [ms]"], color="#BBBBBB", zorder=1)
    for name, label in (("plain", "plain"), ("ours", "optimized")):
        ax.plot(table[f"{name} [ms]"], places, "o", color=SPEED_COLOURS[name], label=label)
    ax.axvline(period_ms, color="#444444", linestyle="--", linewidth=1.0, label="between two scans")
    ax.set_yticks(places, table.index)
    ax.set(xscale="log", xlabel="time [ms]")
    ax.xaxis.set_major_formatter("{x:,g}")
    ax.legend(loc="lower right")
    return ax


def draw_filter_cost(axes: Sequence[Axes], costs: pd.DataFrame) -> Sequence[Axes]:
    """Draw the time of one weighting against particles, points, and the size of a map cell.

    Parameters
    ----------
    axes : three Axes
        Where to draw.
    costs : DataFrame
        Rows such as "particles, 100", "points, 500" and "cell, 0.25 m"; columns of processor time [ms].

    Returns
    -------
    axes : three Axes
        The axes.
    """
    labels = {"particles": "particles", "points": "points of a scan", "cell": "cell size [m]"}
    for ax, (kind, label) in zip(axes, labels.items(), strict=True):
        rows = costs[costs.index.str.startswith(f"{kind}, ")]
        sizes = [float(name.split(", ")[1].split()[0]) for name in rows.index]
        for case, colour in (("", "real"), ("tracked, ", "real"), ("spread, ", "radar")):
            times = rows.get(f"{case}one thread [processor ms]")
            if times is not None and times.notna().any():
                look = {"color": plots.COLOURS[colour], "markersize": 4}
                ax.plot(sizes, times, "o-", label=case.strip(", "), **look)
        ax.set(xscale="log", yscale="log", xlabel=label, ylim=(0.2, 60.0))
        ax.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
        ax.xaxis.set_major_formatter("{x:,g}")
        ax.minorticks_off()
    axes[0].set_ylabel("processor time [ms]")
    axes[2].set_xticks([0.125, 0.25, 0.5], ["0.125", "0.25", "0.5"])
    axes[2].legend(loc="upper right")
    return axes


def draw_drift(axes: Sequence[Axes], ways: pd.DataFrame, colours: Mapping[str, str]) -> Sequence[Axes]:
    """Draw drift and time of several odometries, one row for each.

    Parameters
    ----------
    axes : two Axes
        Where to draw: the drift on the left, the time on the right; they share their rows.
    ways : DataFrame
        Odometries as index; columns "drift [%], as read" and "drift [%], corrected", each also with
        ", lowest" and ", highest", and "step [ms]".
    colours : mapping
        Beginning of a name -> its colour; others are grey.

    Returns
    -------
    axes : two Axes
        The axes.
    """
    drift, time = axes
    names, places = list(ways.index), np.arange(len(ways))[::-1]
    found = [next((c for start, c in colours.items() if name.startswith(start)), "") for name in names]
    for place, name, colour in zip(places, names, found, strict=True):
        row, look = ways.loc[name], {"color": colour or plots.COLOURS["map"], "elinewidth": 1.0}
        for case, face, up in (("as read", "white", 0.13), ("corrected", look["color"], -0.13)):
            middle, low, high = (row[f"drift [%], {case}{end}"] for end in ("", ", lowest", ", highest"))
            bars = [[middle - low], [high - middle]]
            drift.errorbar(middle, place + up, xerr=bars, fmt="o", markerfacecolor=face, markersize=6, **look)
        time.barh(place, row["step [ms]"], color=look["color"], height=0.55)
    for label, face in (("clouds as recorded", "white"), ("clouds compensated before", "#444444")):
        drift.plot([], [], "o", color="#444444", markerfacecolor=face, label=label)
    drift.set_yticks(places, names)
    drift.set(xscale="log", xlabel="drift [%]", xlim=(0.05, 4.0))
    drift.set_xticks([0.1, 0.3, 1, 3], ["0.1", "0.3", "1", "3"])
    drift.minorticks_off()
    drift.figure.legend(*drift.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    time.set(xlabel="time per scan [ms]")
    time.set_yticks(places, [""] * len(places))
    for ax in axes:
        ax.set_ylim(-0.6, len(places) - 0.4)
    return axes
