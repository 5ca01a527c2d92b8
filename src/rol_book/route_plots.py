"""Figures of the filters on the real route. Nothing here computes a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rol.geometry import transform_points
from rol_book import plots
from rol_book.player import Frame

PRINTED = {"color": "#444444", "alpha": 0.2, "linewidth": 0}  # range of the paper's own values


def split_figure(n: int, height: float) -> tuple[Figure, list[Axes]]:
    """Create a figure of n panels side by side, each within its own n-th of the width.

    Parameters
    ----------
    n : int
        Number of panels.
    height : float
        Height of the figure [inches].

    Returns
    -------
    figure : Figure
    axes : list of Axes
    """
    figure = plt.figure(figsize=(plots.WIDTH, height))
    return figure, [part.subplots() for part in figure.subfigures(1, n, squeeze=False)[0]]


def draw_quality(
    runs: pd.DataFrame, printed: Mapping[str, np.ndarray], likely: tuple[float, float]
) -> Figure:
    """Draw error, good scans and failures of both methods over the fraction of points near the map.

    Parameters
    ----------
    runs : pandas.DataFrame
        Runs with ``is_complete``, from `rol_study.route_results.select_qualities`: fractions with fewer runs
        get open markers, and dashed lines lead to them.
    printed : mapping of str to array
        The paper's values by column: ``rmse_m`` [m], ``within_1m_2deg`` (0..1) and ``failures``.
    likely : tuple of float
        Range of the fraction that is shaded.

    Returns
    -------
    figure : Figure
    """
    labels = {
        "rmse_m": "RMSE [m]",
        "within_1m_2deg": "within 1 m, 2° [%]",
        "failures": "failures per session",
    }
    figure, axes = split_figure(3, 3.4)
    for ax, (name, words) in zip(axes, labels.items(), strict=True):
        scale = 100.0 if name.startswith("within") else 1.0
        for method in ("paper", "robust"):
            groups = runs[runs.method == method].groupby("fraction_1m")
            _draw_band(ax, groups, name, scale, method)
        ax.axvspan(*(100 * value for value in likely), color="#009E73", alpha=0.16, linewidth=0)
        ax.axhspan(scale * min(printed[name]), scale * max(printed[name]), **PRINTED)
        ax.set(xlabel="within 1 m of the map [%]", ylabel=words, xlim=(28.0, 82.0))
        ax.set_xticks(range(30, 81, 10))
    axes[0].set_yscale("log")
    axes[0].set_yticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
    axes[0].set_ylim(0.05, max(60.0, 1.3 * runs.rmse_m.max()))
    axes[1].set_ylim(0, 103)
    axes[2].set_yscale("symlog", linthresh=1.0)
    axes[2].set_yticks([0.0, 1.0, 10.0, 100.0], ["0", "1", "10", "100"])
    axes[2].set_ylim(0.0, max(10.0, 1.3 * runs.failures.max()))
    for ax, corner in zip(axes, ("upper right", "lower right", "upper right"), strict=True):
        ax.legend(loc=corner)
    return figure


def _draw_band(
    ax: Axes, groups: pd.api.typing.DataFrameGroupBy, name: str, scale: float, method: str
) -> None:
    """Draw mean and range of a column over the groups; groups with fewer runs have open markers."""
    colour = plots.METHOD_COLOURS[method]
    low, middle, high = (scale * getattr(groups[name], how)() for how in ("min", "mean", "max"))
    x, is_complete = 100 * middle.index.to_numpy(), groups.is_complete.all().to_numpy()
    ax.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)
    ax.plot(x, middle, "--", color=colour, linewidth=1.2)
    ax.plot(x, middle.where(is_complete), "o-", color=colour, markersize=3.5, label=method)
    ax.plot(x, middle.mask(is_complete), "o", color=colour, markersize=5.0, markerfacecolor="white")


def draw_settings(swept: pd.DataFrame, printed: Mapping[str, float]) -> Figure:
    """Draw error and good scans over each setting of the filter that the paper does not state.

    Parameters
    ----------
    swept : pandas.DataFrame
        The stored table "settings", with ``what``, ``value`` and ``fraction_1m``.
    printed : mapping of str to float
        The paper's ``rmse_m`` [m] and ``within_1m_2deg`` (0..1), drawn as dashed lines.

    Returns
    -------
    figure : Figure
    """
    names = {"lambda": "$\\lambda$", "d_th [m]": "$d_{th}$ [m]", "noise": "motion noise (1: ours)"}
    whats, qualities = list(swept.what.unique()), sorted(swept.fraction_1m.unique())
    figure, axes = plots.subplots(2, len(whats), height=4.6, sharex="col", sharey="row", squeeze=False)
    for column, what in zip(axes.T, whats, strict=True):
        for ax, (name, scale) in zip(column, {"rmse_m": 1.0, "within_1m_2deg": 100.0}.items(), strict=True):
            for quality, colour in zip(qualities, plots.SERIES[1:], strict=False):
                part = swept[(swept.what == what) & (swept.fraction_1m == quality)].groupby("value")[name]
                low, middle, high = (scale * getattr(part, how)() for how in ("min", "mean", "max"))
                bars = {"fmt": "o-", "capsize": 2, "markersize": 3.5, "label": f"{100 * quality:.0f} %"}
                ax.errorbar(middle.index, middle, [middle - low, high - middle], color=colour, **bars)
            ax.axhline(scale * printed[name], color="#444444", linestyle="--", linewidth=1.0)
        values = sorted(swept.value[swept.what == what].unique())
        column[0].set(xscale="log", yscale="log")
        column[1].set_xticks(values, [f"{value:g}" for value in values], rotation=60)
        column[1].minorticks_off()
        column[1].set_xlabel(names.get(what, what))
    axes[0, 0].set_ylabel("RMSE [m]")
    axes[1, 0].set_ylabel("within 1 m, 2° [%]")
    axes[0, -1].legend(title="within 1 m", loc="center")
    return figure


def draw_errors(
    minutes: np.ndarray, errors: np.ndarray, deviations: np.ndarray, is_faulty: np.ndarray
) -> Figure:
    """Draw position and heading errors over time with the standard deviations that the filter reports.

    Parameters
    ----------
    minutes : array, shape (n,)
        Times of the scans [min].
    errors, deviations : array, shape (n, 2)
        Of position [m] and heading [deg]; drawn as root mean square over ten seconds (40 scans).
    is_faulty : array of bool, shape (n,)
        Scans with faulty ground truth, shaded.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(2, 1, height=4.6, sharex=True)
    window = np.ones(40)
    n = np.convolve(np.ones(len(minutes)), window, "same")[: len(minutes)]
    for k, (ax, words) in enumerate(zip(axes, ("position error [m]", "heading error [deg]"), strict=True)):
        for values, colour, name in (
            (errors, plots.METHOD_COLOURS["robust"], "error"),
            (deviations, "#000000", "reported standard deviation"),
        ):
            smooth = np.sqrt(np.convolve(values[:, k] ** 2, window, "same")[: len(minutes)] / n)
            ax.plot(minutes, smooth, color=colour, linewidth=1.0, label=name)
        for minute in minutes[is_faulty]:
            ax.axvspan(minute - 0.01, minute + 0.01, color="#999999", alpha=0.5, linewidth=0)
        ax.set(ylabel=words, ylim=(0.0, None))
    axes[0].legend(loc="upper right", ncols=2, frameon=True)
    axes[1].set_xlabel("time [min]")
    return figure


def draw_fields(fields: Mapping[str, np.ndarray], pixel_size: float = 0.25) -> Figure:
    """Draw scores of a point around a place of the map side by side, white for 0 and black for the largest.

    Parameters
    ----------
    fields : mapping of str to array, shape (h, h)
        Scores by title; row 0 farthest forward (x up), column 0 farthest left.
    pixel_size : float
        Side of a cell [m].

    Returns
    -------
    figure : Figure
    """
    figure, axes = split_figure(len(fields), 3.4)
    for ax, (title, values) in zip(axes, fields.items(), strict=True):
        plots.show_image(ax, values, pixel_size=pixel_size, vmax=values.max(), title=title)
    return figure


def draw_found(trials: Mapping[str, pd.DataFrame], ends_s: Mapping[str, float]) -> Figure:
    """Draw the fraction of trials in which the pose was found, over time.

    Parameters
    ----------
    trials : mapping of str to pandas.DataFrame
        Trials by title, with ``found_s`` [s], infinite where the pose was not found.
    ends_s : mapping of str to float
        Length of each time axis [s].

    Returns
    -------
    figure : Figure
    """
    figure, axes = split_figure(len(trials), 3.2)
    for ax, (title, table) in zip(axes, trials.items(), strict=True):
        times = np.sort(np.minimum(table.found_s, 1e6))
        fractions = 100 * np.arange(1, len(times) + 1) / len(times)
        colour = plots.METHOD_COLOURS["robust"]
        ax.step([0.0, *times], [0.0, *fractions], where="post", color=colour)
        ax.set(xlim=(0.0, ends_s[title]), ylim=(0, 102), xlabel="time since the start [s]", title=title)
        ax.set_ylabel("found [%]")
    return figure


def recovery_frames(updates: Sequence, clouds: Sequence[np.ndarray], truth: np.ndarray) -> list[Frame]:
    """Create the frames of an animation of a recovery, for `rol_book.player.play_filter`.

    Parameters
    ----------
    updates : sequence of rol_beyond.recovery.RecoveryUpdate
        One per scan, at 4 Hz.
    clouds : sequence of array, shape (m, 2)
        Points of the scans [m].
    truth : array, shape (n, 3)
        True poses from the first scan on [m, m, rad].

    Returns
    -------
    frames : list of Frame
    """
    frames = []
    for k, (update, cloud, pose) in enumerate(zip(updates, clouds, truth, strict=False)):
        mcl, state = update.filter, "lost" if update.is_lost else "not lost"
        text = f"{0.25 * k:.1f} s, {state}, {np.hypot(*(mcl.pose - pose)[:2]):.1f} m off"
        frames.append(Frame(transform_points(mcl.pose, cloud), mcl.particles, mcl.pose, pose, text))
    return frames
