"""Figures of real scans on real maps. Nothing here computes a result; each function returns a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol.similarity import distance_histogram
from rol_book import plots
from rol_book.plots import COLOURS

NOISE = 24  # power that is shown as white


def clean(image: np.ndarray) -> np.ndarray:
    """Subtract the noise from a radar image, so that its background is white."""
    return np.maximum(image, NOISE) - NOISE


def crop(points: np.ndarray, centre: np.ndarray, half: float) -> np.ndarray:
    """Keep the points in a square of the ground."""
    return points[np.abs(points - centre[:2]).max(axis=1) < half]


def draw_scan_on_map(
    result: Sequence[np.ndarray],
    pose: np.ndarray,
    map_points: np.ndarray,
    titles: Sequence[str],
    *,
    half: float = 55.0,
    arrow: str = "truth",
) -> Figure:
    """Draw a radar scan, the generated image, and the generated points on a map at a pose.

    Parameters
    ----------
    result : points, radar image, generated image
        As `rol_beyond.front_ends.generate_points` returns them.
    pose : array, shape (3,)
        Pose T_map_radar [m, m, rad].
    map_points : array, shape (m, 2)
        Points of the map [m].
    titles : sequence of three str
        Titles.
    half : float
        Half the edge of the square shown [m].
    arrow : str
        Colour of the pose, a name of ``rol_book.plots.COLOURS``.

    Returns
    -------
    figure : Figure
    """
    points, radar_image, generated = result
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.5), dpi=90)
    plots.show_image(axes[0], clean(radar_image), vmax=90, title=titles[0])
    plots.show_image(axes[1], generated, title=titles[1])
    around = crop(map_points, pose, 1.3 * half)
    plots.show_points(axes[2], around, colour=COLOURS["map"], size=0.5, title=titles[2])
    plots.show_points(axes[2], transform_points(pose, points), colour=COLOURS["fake"], size=3.0)
    plots.show_poses(axes[2], pose[None], colour=COLOURS[arrow], length=0.15 * half)
    for ax, centre in zip(axes, ((0.0, 0.0), (0.0, 0.0), pose[:2]), strict=True):
        plots.zoom(ax, centre, half)
    for ax in axes[1:]:
        ax.set_ylabel("")
    return figure


def draw_precision(table: Any, names: Mapping[str, str]) -> Figure:
    """Draw the precision of each scan's points by front end.

    Parameters
    ----------
    table : pandas.DataFrame
        ``points``, ``share_1m``, ``share_2m``: one row per scan and front end.
    names : mapping of str to str
        Front end -> name under the column.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plt.subplots(1, 2, figsize=(9.8, 3.6), sharey=True)
    fronts = list(dict.fromkeys(table["points"]))
    for ax, radius in zip(axes, (1, 2), strict=True):
        values = [100 * table[f"share_{radius}m"][table["points"] == front].to_numpy() for front in fronts]
        plots.draw_dots(ax, values, [names.get(front, front) for front in fronts], colour=COLOURS["fake"])
        ax.set(title=f"within {radius} m", ylim=(0, 100))
        ax.tick_params(axis="x", labelsize=7.5)
    axes[0].set_ylabel("points near the map [%]")
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
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
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
    axes[1].legend(loc="lower right")
    for ax in axes:
        ax.axvline(used, color="#444444", linewidth=0.9)
        ax.set_xlabel("threshold on the grey value")
    return figure


def draw_scans_as_in_paper(
    results: Sequence[Sequence[np.ndarray]],
    poses: np.ndarray,
    labels: Sequence[str],
    map_points: np.ndarray,
    map_tree: cKDTree,
) -> Figure:
    """Draw scans in rows as in the paper's Fig. 3: radar, generated image, points on the map, distances.

    Parameters
    ----------
    results : sequence of (points, radar image, generated image)
        One per scan.
    poses : array, shape (n, 3)
        Their poses on the map [m, m, rad].
    labels : sequence of str
        Labels of the rows.
    map_points : array, shape (m, 2)
        Points of the map [m].
    map_tree : scipy.spatial.cKDTree
        Their tree.

    Returns
    -------
    figure : Figure
    """
    edges = np.arange(0.0, 10.01, 0.25)
    size, widths = (9.6, 2.3 * len(results)), (1, 1, 1, 1.15)
    figure, axes = plt.subplots(len(results), 4, figsize=size, width_ratios=widths, dpi=72, squeeze=False)
    images = [[clean(radar_image), generated] for _, radar_image, generated in results]
    plots.draw_image_grid(axes[:, :2], images, ("real radar", "generated"), labels, half=50.0, vmax=(70, 255))
    for row, (points, _, _), pose in zip(axes, results, poses, strict=True):
        placed = transform_points(pose, points)
        away = map_tree.query(placed)[0]
        plots.show_points(row[2], crop(map_points, pose, 80.0), colour=COLOURS["map"], size=0.3)
        plots.show_points(row[2], placed[away < 1.0], colour=COLOURS["fake"], size=2.5)
        plots.show_points(row[2], placed[away >= 1.0], colour=COLOURS["estimate"], size=2.5)
        plots.zoom(row[2], pose[:2], 50.0)
        row[2].set(xticks=[], yticks=[], xlabel="", ylabel="")
        text = "\n".join(f"{100 * np.mean(away < r):.0f} % below {r} m" for r in (1, 2))
        plots.draw_distances(
            row[3], distance_histogram(away, edges), edges, text=f"{text}\n{len(points)} points"
        )
        row[3].set(xlabel="")
    axes[0, 2].set_title("on the map")
    axes[0, 3].set_title("nearest map point")
    axes[-1, 3].set_xlabel("distance [m]")
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
    figure, axes = plt.subplots(1, len(images), figsize=(9.6, 0.4 + 9.6 / len(images)), dpi=75)
    names = {"real": "lidar", "fake": "generated"}
    for ax, image, layer, title in zip(axes, images, layers, titles, strict=True):
        plots.show_image(ax, clean(image), vmax=vmax)
        for kind, size in (("real", 1.2), ("fake", 2.2)):
            plots.show_points(ax, layer[kind], colour=COLOURS[kind], size=size, label=names[kind])
        plots.zoom(ax, (0.0, 0.0), half).set(title=title)
    for ax in axes[1:]:
        ax.set_ylabel("")
    axes[0].legend(loc="upper left", markerscale=3, frameon=True, fontsize=8.5)
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
    figure, ax = plt.subplots(figsize=(6.4, 3.6))
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
    figure = plt.figure(figsize=(9.6, 4.2), dpi=90)
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
    ax.legend(loc="upper left", fontsize=8.5, frameon=True)
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
    figure, (ax, other, last) = plt.subplots(1, 3, figsize=(9.6, 3.9), dpi=85, width_ratios=(1, 1, 0.8))
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
        axes.legend(loc="upper left", markerscale=4, frameon=True, fontsize=8.5)
    last.plot(sharpness[0], sharpness[1] / 1000.0, "o-", color=COLOURS["real"])
    last.axvline(0.0, color="#444444", linewidth=0.9, linestyle="--")
    last.set(title="sharpness", xlabel="rotation of the sweeps [deg]", ylabel="occupied cells [thousands]")
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
    width = 9.6 / len(clouds)
    figure, axes = plt.subplots(1, len(clouds), figsize=(9.6, width + 0.4), dpi=75)
    for ax, (reference, points, colour), title in zip(axes, clouds, titles, strict=True):
        plots.show_points(ax, crop(reference, np.zeros(2), 1.2 * half), colour=COLOURS["map"], size=0.6)
        plots.show_points(ax, points, colour=COLOURS[colour], size=3.0, title=title)
        plots.zoom(ax, (0.0, 0.0), half)
    for ax in axes[1:]:
        ax.set_ylabel("")
    return figure
