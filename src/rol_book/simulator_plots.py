"""Figures that compare simulated with real scans. Nothing here computes a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from rol.radar import MEASURED
from rol_book import plots

STYLES = (
    {"color": plots.COLOURS["real"], "linestyle": "-"},
    {"color": plots.COLOURS["radar"], "linestyle": "-"},
    {"color": plots.COLOURS["fake"], "linestyle": "--"},
)
GREYS = plt.get_cmap("gray_r", 12)  # few levels: noise in fine ones makes large files and shows no more


def format_value(value: float) -> str:
    """Format a number of a table of mixed units: three significant digits, no exponent, a dash for NaN."""
    if not np.isfinite(value):
        return "–"
    return f"{value:,.0f}" if value == 0 or abs(value) >= 100 else f"{value:.3g}"


def draw_statistics(axes: np.ndarray, found: Mapping[str, dict]) -> np.ndarray:
    """Draw the statistics of several sets of scans over each other, one panel for each statistic.

    Parameters
    ----------
    axes : array of Axes, shape (2, 3)
        Where to draw.
    found : mapping
        Name of a set -> its statistics, from `rol_study.radar_statistics.scan_statistics`; three sets at
        most, drawn in turn.

    Returns
    -------
    axes : array of Axes
        The axes; the first one has the legend.
    """
    draws = (
        _draw_histogram,
        _draw_zeros,
        _draw_range_correlation,
        _draw_rings,
        _draw_azimuth_spread,
        _draw_range_spread,
    )
    for ax, draw in zip(axes.ravel(), draws, strict=True):
        for (name, statistics), look in zip(found.items(), STYLES, strict=False):
            draw(ax, statistics, {**look, "label": name})
    axes[0, 0].legend(loc="lower left", handlelength=1.2, borderaxespad=0.2)
    return axes


def draw_doppler(ax: Axes, found: Mapping[str, dict]) -> Axes:
    """Draw how well scans agree for every Doppler shift tried.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    found : mapping
        Name of a set -> its statistics, from `rol_study.radar_statistics.motion_statistics`.

    Returns
    -------
    ax : Axes
        The axes.
    """
    for (name, statistics), look in zip(found.items(), STYLES, strict=False):
        shifts, values = (np.array(part) for part in zip(*statistics["doppler_curve"].items(), strict=True))
        ax.plot(1000.0 * shifts, values - values.max(), label=name, **look)
    ax.axvline(0.0, color="#444444", linewidth=0.8)
    ax.set(xlabel="Doppler range shift per closing speed [ms]", ylabel="correlation minus its maximum")
    ax.legend(loc="lower center")
    return ax


def draw_auc_by_group(axes: Sequence[Axes], found: Mapping[str, Mapping[str, float]]) -> Sequence[Axes]:
    """Draw how well a classifier separates simulated from real patches, by group.

    Parameters
    ----------
    axes : sequence of Axes
        One for each way to sort the patches.
    found : mapping
        From `rol_study.two_sample_classifier.auc_by_group`.

    Returns
    -------
    axes : sequence of Axes
        The axes.
    """
    labels = {"range": "range of the patch [m]", "brightest": "brightest code in the patch"}
    for ax, (name, values) in zip(axes, found.items(), strict=True):
        above = [value - 0.5 for value in values.values()]
        ax.bar(list(values), above, bottom=0.5, color=plots.COLOURS["radar"], width=0.7)
        ax.axhline(0.5, color="#444444", linewidth=1.0)
        ax.set(xlabel=labels.get(name, name), ylabel="area under the curve", ylim=(0.3, 1.0))
        ax.tick_params(axis="x", labelrotation=30)
    return axes


def draw_polar_pair(
    axes: Sequence[Axes], scans: Mapping[str, np.ndarray], *, max_range: float = 100.0
) -> None:
    """Draw scans as they are stored, one above the other: a row per azimuth, range to the right.

    Parameters
    ----------
    axes : sequence of Axes
        One per scan.
    scans : mapping
        Title -> codes, shape (400, 3768).
    max_range : float
        Where to stop [m].
    """
    for ax, (title, codes) in zip(axes, scans.items(), strict=True):
        ax.imshow(
            codes,
            cmap=GREYS,
            aspect="auto",
            vmin=0,
            vmax=96,
            interpolation="antialiased",
            extent=(MEASURED.offset_m, MEASURED.offset_m + MEASURED.resolution_m * codes.shape[1], 360, 0),
        )
        ax.set(title=title, xlim=(0, max_range), yticks=np.arange(0, 361, 90), ylabel="azimuth [deg]")
        ax.grid(False)
    axes[-1].set_xlabel("range [m]")


def draw_lidar_statistics(found: Mapping[str, dict]) -> Figure:
    """Draw which beams return, and the histograms, of sets of lidar sweeps.

    Parameters
    ----------
    found : mapping
        Name of a set -> its statistics, from `rol_study.lidar_statistics.compare_sweeps`, of the left lidar;
        two sets at most, and parts of the first one, whose curves are thin: they show how much the statistics
        vary within it.

    Returns
    -------
    figure : Figure
        One map of the beams for each set above, four curves below.
    """
    figure = plt.figure(figsize=(plots.WIDTH, 6.4))
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.05))
    whole = {name: statistics for name, statistics in found.items() if not statistics["is_part"]}
    maps = above.subplots(1, len(whole), sharey=True, squeeze=False)[0]
    for ax, (name, statistics) in zip(maps, whole.items(), strict=True):
        image = _draw_beams(ax, statistics["return_fractions"], name)
    maps[0].set_ylabel("laser, highest on top")
    above.colorbar(image, ax=maps, label="beams that return", pad=0.01)
    axes = below.subplots(1, 4)
    for statistics in (statistics for statistics in found.values() if statistics["is_part"]):
        _draw_sweep_curves(axes, statistics, {**STYLES[0], "linewidth": 0.6, "alpha": 0.7})
    for (name, statistics), look in zip(whole.items(), STYLES, strict=False):
        _draw_sweep_curves(axes, statistics, {**look, "linewidth": 1.3, "label": name})
    below.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _draw_beams(ax: Axes, fractions: np.ndarray, title: str) -> AxesImage:
    image = ax.imshow(fractions, cmap="viridis", aspect="auto", vmin=0, vmax=1, extent=(0, 360, 32, 0))
    ax.set(title=title, xlabel="direction", yticks=(0, 8, 16, 24, 31))
    ax.set_xticks(np.arange(0, 361, 90), ["right", "behind", "left", "ahead", "right"])
    ax.grid(False)
    return image


def _draw_sweep_curves(axes: Sequence[Axes], statistics: dict, look: dict) -> None:
    axes[0].plot(statistics["laser_counts"], np.arange(32), **look)
    axes[0].set(xlabel="points per sweep", ylabel="laser", xlim=(0, 1100), ylim=(31.5, -0.5))
    labels = {"ranges": "range [m]", "heights": "height [m]", "intensities": "intensity"}
    for ax, (name, label) in zip(axes[1:], labels.items(), strict=True):
        fractions, edges = statistics["histograms"][name], statistics["edges"][name]
        ax.step(edges[:-1], fractions / np.diff(edges), where="post", **look)
        ax.set(xlabel=label, yscale="log", ylabel="density" if name == "ranges" else "")
    axes[1].set(xlim=(0, 100))
    axes[3].set(xlim=(0, 110))


def _draw_histogram(ax: Axes, statistics: dict, look: dict) -> None:
    fractions = statistics["histogram"]
    codes = np.flatnonzero(fractions > 0)
    ax.semilogy(codes, fractions[codes], linewidth=1.2, **look)
    ax.set(xlabel="code", ylabel="fraction of pixels", title="codes", xlim=(0, 140))


def _draw_zeros(ax: Axes, statistics: dict, look: dict) -> None:
    ranges, fractions = zip(*statistics["zero_fractions"].items(), strict=True)
    ax.plot(ranges, fractions, marker="o", markersize=3.5, **look)
    ax.set(xlabel="range [m]", ylabel="fraction of code 0", title="quiet bins", ylim=(0.25, 0.6))


def _draw_range_correlation(ax: Axes, statistics: dict, look: dict) -> None:
    values = statistics["range_correlation"]
    ax.plot(MEASURED.resolution_m * np.arange(1, len(values) + 1), values, marker="o", markersize=3.5, **look)
    ax.set(xlabel="distance along range [m]", ylabel="correlation", title="noise along range", ylim=(0, 1))


def _draw_rings(ax: Axes, statistics: dict, look: dict) -> None:
    rings = statistics["fractions_40_by_range"]
    middles = [np.sqrt(np.prod([float(edge) for edge in ring.split("-")])) for ring in rings]
    ax.loglog(middles, list(rings.values()), marker="o", markersize=3.5, **look)
    ax.set(xlabel="range [m]", ylabel="fraction of codes ≥ 40", title="brightness")
    ax.set_xticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    ax.minorticks_off()


def _draw_azimuth_spread(ax: Axes, statistics: dict, look: dict) -> None:
    levels = statistics["point_spread"]["azimuth_db"]
    ax.plot(0.9 * np.arange(len(levels)), levels, marker="o", markersize=3.5, **look)
    ax.set(xlabel="azimuth off the peak [deg]", ylabel="level [dB]", title="a bright point in azimuth")


def _draw_range_spread(ax: Axes, statistics: dict, look: dict) -> None:
    levels = statistics["point_spread"]["range_db"]
    ax.plot(MEASURED.resolution_m * np.arange(len(levels)), levels, **look)
    ax.set(xlabel="range off the peak [m]", ylabel="level [dB]", title="a bright point in range")
