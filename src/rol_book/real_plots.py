"""Figures of real scans on real maps. Nothing here computes a result; each function returns a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from rol_book import plots
from rol_book.plots import COLOURS

NOISE = 24  # power that is shown as white


def clean(image: np.ndarray) -> np.ndarray:
    """Subtract the noise from a radar image, so that its background is white."""
    return np.maximum(image, NOISE) - NOISE


def crop(points: np.ndarray, centre: np.ndarray, half: float) -> np.ndarray:
    """Keep the points in a square of the ground."""
    return points[np.abs(points - centre[:2]).max(axis=1) < half]


def draw_story(
    images: Mapping[str, np.ndarray],
    points: np.ndarray,
    around: np.ndarray,
    title: str,
    *,
    half: float = 40.0,
) -> Figure:
    """Draw one scan from left to right: images, and its points on a map, all in the frame of the vehicle.

    Parameters
    ----------
    images : mapping of str to array, shape (w, w), uint8
        Title -> image; the first one is the radar's.
    points : array, shape (n, 2)
        Points of the scan [m].
    around : array, shape (m, 2)
        Points of the map in the frame of the vehicle [m].
    title : str
        Title of the last panel.
    half : float
        Half the edge of the squares shown [m].

    Returns
    -------
    figure : Figure
    """
    n = len(images) + 1
    figure, axes = plots.subplots(1, n, height=plots.WIDTH / n + 0.3)
    for k, (name, image) in enumerate(images.items()):
        plots.show_image(axes[k], clean(image) if k == 0 else image, vmax=75 if k == 0 else None, title=name)
    plots.show_points(axes[-1], crop(around, np.zeros(2), half), colour="#9A9A9A", size=1.5, title=title)
    plots.show_points(axes[-1], crop(points, np.zeros(2), half), colour=COLOURS["fake"], size=4.0)
    plots.show_poses(axes[-1], np.zeros((1, 3)), length=0.3 * half)
    for ax in axes:
        plots.zoom(ax, (0.0, 0.0), half)
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.spines[:].set_visible(True)
        ax.spines[:].set_color("#9A9A9A")
    return figure


def draw_scans_on_map(
    placed: Sequence[np.ndarray],
    poses: np.ndarray,
    titles: Sequence[str],
    map_points: np.ndarray,
    map_tree: cKDTree,
    *,
    half: float = 50.0,
) -> Figure:
    """Draw the points of scans on a map side by side, in colours for near the map and away from it.

    Parameters
    ----------
    placed : sequence of array, shape (n, 2)
        Points on the map [m], one cloud per scan.
    poses : array, shape (k, 3)
        Poses of the scans [m, m, rad].
    titles : sequence of str
        Titles.
    map_points : array, shape (m, 2)
        Points of the map [m].
    map_tree : scipy.spatial.cKDTree
        Their tree.
    half : float
        Half the edge of the squares shown [m].

    Returns
    -------
    figure : Figure
    """
    n = len(placed)
    figure, axes = plots.subplots(1, n, height=plots.WIDTH / n + 0.3, squeeze=False)
    for ax, points, pose, title in zip(axes[0], placed, poses, titles, strict=True):
        away = map_tree.query(points)[0]
        plots.show_points(ax, crop(map_points, pose, half), colour="#B5B5B5", size=0.8, title=title)
        plots.show_points(ax, points[away < 1.0], colour=COLOURS["fake"], size=3.5)
        plots.show_points(ax, points[away >= 1.0], colour=COLOURS["estimate"], size=3.5)
        plots.zoom(ax, pose[:2], half)
        ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        ax.spines[:].set_visible(True)
    return figure


def draw_thresholds(table: Any, used: float) -> Figure:
    """Draw number and precision of points over the threshold.

    Parameters
    ----------
    table : pandas.DataFrame
        ``level``, ``n``, ``share_1m``, ``share_2m``: one row per scan and threshold.
    used : float
        Threshold in use.

    Returns
    -------
    figure : Figure
    """
    by_level = table.groupby("level")
    levels = np.array(sorted(by_level.groups))
    figure, axes = plots.subplots(1, 2, height=3.3)
    lines = (
        (axes[0], by_level.n, 1, "o", "fake", ""),
        (axes[1], by_level.share_1m, 100, "o", "fake", "within 1 m"),
        (axes[1], by_level.share_2m, 100, "s", "real", "within 2 m"),
    )
    for ax, column, scale, mark, colour, label in lines:
        low, high = scale * column.min(), scale * column.max()
        ax.fill_between(levels, low, high, color=COLOURS[colour], alpha=0.22, linewidth=0)
        ax.plot(levels, scale * column.mean(), f"{mark}-", color=COLOURS[colour], label=label)
    axes[0].set(ylabel="points per scan", yscale="log")
    axes[1].set(ylabel="near the map [%]", ylim=(40, 100))
    axes[1].legend(loc="lower left")
    for ax in axes:
        ax.axvline(used, color="#444444", linewidth=0.9)
        ax.set_xlabel("threshold on the grey value")
    return figure


def draw_points_on_scans(
    images: Sequence[np.ndarray],
    layers: Sequence[Mapping[str, np.ndarray]],
    titles: Sequence[str],
    *,
    half: float = 30.0,
    vmax: float = 150,
) -> Figure:
    """Draw radar images side by side with lidar points and generated points.

    Parameters
    ----------
    images : sequence of array, shape (w, w), uint8
        Radar images.
    layers : sequence of mapping
        "real" and "fake" -> points, shape (n, 2) [m]; one per image.
    titles : sequence of str
        Titles.
    half : float
        Half the edge of the square shown [m].
    vmax : float
        Power of the darkest grey.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, len(images), height=0.6 + plots.WIDTH / len(images))
    names = {"real": "lidar", "fake": "generated"}
    for ax, image, layer, title in zip(axes, images, layers, titles, strict=True):
        plots.show_image(ax, clean(image), vmax=vmax)
        for kind, size in (("real", 1.2), ("fake", 2.2)):
            plots.show_points(ax, layer[kind], colour=COLOURS[kind], size=size, label=names[kind])
        plots.zoom(ax, (0.0, 0.0), half).set(title=title)
    for ax in axes[1:]:
        ax.set_ylabel("")
    axes[0].legend(loc="upper left", markerscale=3, frameon=True)
    return figure


def draw_adaptation(curves: Mapping[str, Any], raw: tuple[float, float]) -> Figure:
    """Draw precision against number of points before and after an adaptation.

    Parameters
    ----------
    curves : mapping of str to pandas.DataFrame
        Label -> ``n`` and ``share_1m`` per threshold: before, then after.
    raw : tuple of float
        Number of the raw peaks, and their precision at 1 m.

    Returns
    -------
    figure : Figure
    """
    figure, ax = plots.subplots(height=3.6)
    for (label, curve), colour in zip(curves.items(), ("fake", "estimate"), strict=True):
        ax.plot(curve.n, 100 * curve.share_1m, "o-", color=COLOURS[colour], markersize=3.5, label=label)
    ax.plot(raw[0], 100 * raw[1], "s", color=COLOURS["radar"], label="raw peaks")
    ax.set(xlabel="points per scan", ylabel="within 1 m of the map [%]", ylim=(50, 100))
    ax.legend(loc="best")
    return figure


def draw_localization(
    map_points: np.ndarray,
    truth: np.ndarray,
    estimate: np.ndarray,
    start: np.ndarray,
    errors: Mapping[str, tuple[np.ndarray, str]],
    *,
    seconds: np.ndarray,
    limits: Sequence[float],
) -> Figure:
    """Draw a localization run on the map, and the errors of all runs over time.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Points of the map [m].
    truth, estimate : array, shape (k, 3)
        Poses of one run [m, m, rad].
    start : array, shape (3,)
        Its start [m, m, rad].
    errors : mapping of str to (array, str)
        Label -> errors of all runs, shape (s, k, 2) [m, deg], and the name of a colour.
    seconds : array, shape (k,)
        Times of the scans [s].
    limits : sequence of float
        Errors aimed at [m, deg].

    Returns
    -------
    figure : Figure
    """
    middle = truth[:, :2].mean(axis=0)
    half = max(20.0, 0.6 * np.ptp(truth[:, :2], axis=0).max() + 8.0)
    figure = plt.figure(figsize=(plots.WIDTH, 4.2))
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    ax = left.subplots()
    plots.show_points(ax, crop(map_points, middle, half + 2.0), colour=COLOURS["map"], size=1.5)
    plots.draw_track(ax, truth, colour=COLOURS["truth"], label="fitted", linewidth=3.0)
    plots.draw_track(ax, estimate, label="estimate", linewidth=1.4)
    plots.show_poses(ax, truth, colour=COLOURS["truth"], length=1.2)
    plots.show_poses(ax, estimate, length=1.2)
    plots.show_poses(ax, start[None], colour=COLOURS["real"], length=4.0)
    ax.plot([], [], color=COLOURS["real"], label="start")
    plots.zoom(ax, middle, half)
    ax.legend(loc="upper left", frameon=True)
    axes = right.subplots(2, 1, sharex=True)
    for label, (every, colour) in errors.items():
        for k, ax in enumerate(axes):
            low, high = every[..., k].min(axis=0), every[..., k].max(axis=0)
            ax.fill_between(seconds, low, high, color=COLOURS[colour], alpha=0.25, linewidth=0)
            middle_run = np.median(every[..., k], axis=0)
            ax.plot(seconds, middle_run, "o-", color=COLOURS[colour], label=label, markersize=3.5)
    for ax, limit, unit in zip(axes, limits, ("position error [m]", "heading error [deg]"), strict=True):
        ax.axhline(limit, color="#444444", linewidth=0.9, linestyle="--")
        ax.set(ylabel=unit, ylim=(0, None))
    axes[0].legend(loc="upper right")
    axes[1].set_xlabel("time since the first scan [s]")
    return figure


def draw_submap(
    submap: np.ndarray,
    map_points: np.ndarray,
    path: np.ndarray,
    changes: Any,
    sharpness: tuple[np.ndarray, np.ndarray],
) -> Figure:
    """Draw a registered submap, what has changed since the map was made, and the submap's sharpness.

    Parameters
    ----------
    submap, map_points : array, shape (n, 2) and (m, 2)
        Points of submap and map [m].
    path : array, shape (k, 3)
        Poses of the sweeps in the map [m, m, rad].
    changes : Changes
        ``same``, ``new``, ``confirmed``, ``gone``, ``hidden``: points [m].
    sharpness : tuple of array, shape (j,)
        Rotations [deg], and number of occupied cells.

    Returns
    -------
    figure : Figure
    """
    figure, (ax, other, last) = plots.subplots(1, 3, height=3.6)
    middle = path[:, :2].mean(axis=0)
    size = np.ptp(path[:, :2], axis=0).max() / 2.0 + 30.0
    plots.show_points(ax, crop(map_points, middle, size), colour=COLOURS["map"], size=1.5, label="map")
    plots.show_points(ax, crop(submap, middle, size), colour=COLOURS["real"], size=0.7, label="submap")
    plots.draw_track(ax, path, colour=COLOURS["truth"])
    ax.set_title("registered")
    kinds = {"same": "#C9C9C9", "confirmed": "#C9C9C9", "hidden": "#E9E9E9"}
    for kind, colour in kinds.items():
        plots.show_points(other, getattr(changes, kind), colour=colour, size=1.0)
    plots.show_points(other, changes.new, colour=COLOURS["estimate"], size=2.5, label="new")
    plots.show_points(other, changes.gone, colour=COLOURS["real"], size=2.5, label="gone")
    plots.draw_track(other, path, colour=COLOURS["truth"])
    other.set(title="changes", ylabel="")
    for axes in (ax, other):
        plots.zoom(axes, middle, size)
        axes.legend(loc="upper left", markerscale=4, frameon=True)
    last.plot(sharpness[0], sharpness[1] / 1000.0, "o-", color=COLOURS["real"])
    last.axvline(0.0, color="#444444", linewidth=0.9, linestyle="--")
    last.set_box_aspect(1.0)
    last.set(title="sharpness", xlabel="rotation of sweeps [deg]", ylabel="occupied cells [1000]")
    return figure


def draw_lidar_and_map(
    clouds: Sequence[tuple[np.ndarray, np.ndarray, str]], titles: Sequence[str], *, half: float = 45.0
) -> Figure:
    """Draw points over reference points side by side.

    Parameters
    ----------
    clouds : sequence of (reference, points, name of a colour)
        Reference points, shape (m, 2), and points, shape (n, 2), around the radar [m].
    titles : sequence of str
        Titles.
    half : float
        Half the edge of the square shown [m].

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, len(clouds), height=0.6 + plots.WIDTH / len(clouds))
    for ax, (reference, points, colour), title in zip(axes, clouds, titles, strict=True):
        plots.show_points(ax, crop(reference, np.zeros(2), 1.2 * half), colour=COLOURS["map"], size=0.6)
        plots.show_points(ax, points, colour=COLOURS[colour], size=3.0, title=title)
        plots.zoom(ax, (0.0, 0.0), half)
    for ax in axes[1:]:
        ax.set_ylabel("")
    return figure
