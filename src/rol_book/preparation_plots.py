"""Figures of the chapters that prepare the data: alignment, ground removal, training and ground truth.

Nothing here computes a result. Functions draw into the given axes and return them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from rol.geometry import transform_points
from rol_book import plots
from rol_book.plots import COLOURS

TIME_COLOURS = plt.get_cmap("viridis")  # of the rows of one radar scan, from the first to the last
# What a pair is made of -> colour, marker and label of its line.
MOTION_LOOKS = {
    "none": (COLOURS["estimate"], "s", "not compensated"),
    "corrected": (COLOURS["real"], "o", "motion-compensated"),
}

# ---- alignment ----


def draw_timeline(
    ax: Axes, scan_ms: tuple[float, float], sweeps_ms: Mapping[str, Mapping[str, tuple[float, float]]]
) -> Axes:
    """Draw when one radar scan and the lidar sweeps of its two kinds of pairs were taken.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    scan_ms : tuple of two floats
        First and last row of the scan, relative to its stamp [ms].
    sweeps_ms : mapping of str to mapping
        Motion ("none", "corrected") -> lidar -> first and last point of its sweep [ms].

    Returns
    -------
    ax : Axes
        The axes.
    """
    start, end = scan_ms
    ax.imshow(
        np.linspace(0, 1, 256)[None], cmap=TIME_COLOURS, aspect="auto", extent=(start, end, -0.35, 0.35)
    )
    names = list(dict.fromkeys(lidar for sweeps in sweeps_ms.values() for lidar in sweeps))
    for motion, sweeps in sweeps_ms.items():
        colour, _, label = MOTION_LOOKS[motion]
        for lidar, (first, last) in sweeps.items():
            place = names.index(lidar) + 1.0
            ax.barh(place, max(last - first, 1.0), 0.5, left=first, color=colour, label=label)
            label = "_"
    ax.vlines((start + end) / 2, -0.5, len(names) + 0.4, color="#444444", linewidth=0.9, linestyle="--")
    ax.set_yticks(range(len(names) + 1), ["radar scan", *(f"{name} lidar" for name in names)])
    ax.set(xlabel="time since the scan's stamp [ms]", ylim=(len(names) + 1.6, -0.6), xlim=(-75, end + 15))
    ax.grid(False, axis="y")
    ax.legend(loc="lower center", ncols=2, fontsize=9.5, columnspacing=1.2)
    return ax


def draw_overlays(
    axes: Sequence[Axes],
    pairs: Mapping[str, tuple[np.ndarray, np.ndarray]],
    centre: Sequence[float],
    half: float,
) -> Sequence[Axes]:
    """Draw the pairs of one scan: the first whole, then all of them enlarged.

    Parameters
    ----------
    axes : sequence of Axes
        One more than there are pairs.
    pairs : mapping of str to (radar image, lidar points)
        Motion -> radar image, shape (h, h), and lidar points, shape (n, 2) [m].
    centre : sequence of two floats
        Middle of the enlarged square [m].
    half : float
        Half its edge [m].

    Returns
    -------
    axes : sequence of Axes
        The axes.
    """
    first = next(iter(pairs))
    plots.draw_overlay(axes[0], *pairs[first], size=0.5, title=f"{MOTION_LOOKS[first][2]}, whole scan")
    plots.frame_square(axes[0], centre, half)
    for ax, (motion, pair) in zip(axes[1:], pairs.items(), strict=True):
        plots.draw_overlay(ax, *pair, size=4.0, title=MOTION_LOOKS[motion][2])
        plots.zoom(ax, centre, half).set_ylabel("")
    return axes


def draw_misalignment(ax: Axes, shifts: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Axes:
    """Draw the misalignment of pairs against speed, with medians.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    shifts : mapping of str to (array, array), shape (n,)
        Motion -> speed [m/s] and misalignment [pixels] of each scan.

    Returns
    -------
    ax : Axes
        The axes.
    """
    for motion, (speed_mps, shift_px) in shifts.items():
        colour, marker, label = MOTION_LOOKS[motion]
        edges = np.arange(-0.5, 20.0, 2.0)
        plots.draw_with_bins(ax, speed_mps, shift_px, edges, colour=colour, label=label, marker=marker)
    ax.set(xlabel="speed [m/s]", ylabel="misalignment [pixels]", ylim=(0, None))
    ax.legend(loc="upper left")
    return ax


def draw_radial(
    ax: Axes, ranges_m: np.ndarray, radial_m: Mapping[str, np.ndarray], expected_m: np.ndarray
) -> Axes:
    """Draw the radial misalignment of radar and lidar against range.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    ranges_m, expected_m : array, shape (k,)
        Middles of the range bands, and the difference of the two calibrations there [m].
    radial_m : mapping of str to array, shape (k,)
        Name of a calibration -> shift of the radar outwards [m]; two of them.

    Returns
    -------
    ax : Axes
        The axes.
    """
    for (name, shift), motion in zip(radial_m.items(), MOTION_LOOKS, strict=True):
        colour, marker, _ = MOTION_LOOKS[motion]
        ax.plot(ranges_m, shift, color=colour, marker=marker, label=name)
    ax.plot(ranges_m, expected_m, "--", color="#666666", label="difference of the two calibrations")
    ax.axhline(0.0, color="#444444", linewidth=0.8)
    ax.set(xlabel="range [m]", ylabel="radar outside lidar [m]")
    ax.legend(loc="lower left")
    return ax


# ---- ground removal ----


def draw_height_histogram(ax: Axes, cloud: np.ndarray, min_height: float, near_m: float = 20.0) -> Axes:
    """Draw the distribution of heights, near and far, and the threshold.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    cloud : array, shape (n, 3) or more columns
        Points in the radar frame [m].
    min_height, near_m : float
        Threshold, and the range that separates near from far [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    is_near = np.hypot(cloud[:, 0], cloud[:, 1]) < near_m
    look = {"bins": np.arange(-3.0, 6.05, 0.1), "histtype": "step", "linewidth": 1.6}
    ax.hist(cloud[is_near, 2], color=COLOURS["real"], label=f"within {near_m:.0f} m", **look)
    ax.hist(cloud[~is_near, 2], color=COLOURS["estimate"], label=f"{near_m:.0f} m and farther", **look)
    ax.axvline(min_height, color="black", linestyle="--", label="threshold")
    ax.set(xlabel="z in the radar frame [m]", ylabel="points", yscale="log", xlim=(-3.0, 6.0))
    ax.legend(loc="upper right")
    return ax


def draw_removal(
    ax: Axes, thresholds: np.ndarray, removed: Mapping[str, np.ndarray], min_height: float
) -> Axes:
    """Draw the fractions of points that a threshold removes.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    thresholds : array, shape (k,)
        Heights [m].
    removed : mapping of str to array, shape (k,)
        Kind of points -> fraction removed; two kinds.
    min_height : float
        Threshold in use [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    for (name, fraction), colour in zip(removed.items(), ("estimate", "real"), strict=True):
        ax.plot(thresholds, 100.0 * fraction, color=COLOURS[colour], label=name)
    ax.axvline(min_height, color="black", linestyle="--", label="threshold in use")
    ax.set(xlabel="threshold, z in the radar frame [m]", ylabel="points removed [%]")
    ax.set(xlim=thresholds[[0, -1]], ylim=(0, 102))
    ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.94))
    return ax


def draw_round_trip(ax: Axes, image: np.ndarray, points: np.ndarray, back: np.ndarray, half: float) -> Axes:
    """Draw points, the pixels they occupy and the points of these pixels, where most pixels are occupied.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    image : array, shape (h, h)
        The pixels.
    points, back : array, shape (n, 2) and (m, 2)
        Points before and after [m].
    half : float
        Half the edge of the square shown [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    cell = np.round(back / 3.0).astype(int)
    cells, counts = np.unique(cell, axis=0, return_counts=True) if len(back) else (np.zeros((1, 2)), [1])
    plots.show_image(ax, image // 5, vmax=255)
    plots.show_points(ax, points, colour=COLOURS["real"], size=7, label="points")
    ax.plot(back[:, 1], back[:, 0], "x", color=COLOURS["estimate"], markersize=6, label="points of the image")
    plots.zoom(ax, 3.0 * cells[np.argmax(counts)], half)
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return ax


def draw_pair_columns(axes: np.ndarray, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Draw pairs of images, a column for each: the radar above, the lidar below.

    Parameters
    ----------
    axes : array of Axes, shape (2, n)
        Where to draw.
    pairs : sequence of n (radar image, lidar image)
        The pairs.

    Returns
    -------
    axes : array of Axes
        The axes.
    """
    for column, (radar_image, lidar_image) in zip(axes.T, pairs, strict=True):
        plots.show_image(column[0], np.maximum(radar_image, 24) - 24, vmax=90, title="radar").set(xlabel="")
        points = np.argwhere(lidar_image > 0)
        centres = ((lidar_image.shape[0] - 1) / 2 - points) * 0.25  # as dots, thin lines remain visible
        plots.show_points(column[1], centres, colour=COLOURS["real"], size=0.5, title="lidar")
        plots.zoom(column[1], (0.0, 0.0), 64.0)
    for ax in axes[:, 1:].ravel():
        ax.set_ylabel("")
    return axes


# ---- training ----


def draw_split(ax: Axes, path: np.ndarray, parts: Mapping[str, np.ndarray]) -> Axes:
    """Draw where along the path the pairs of training and held-out set lie.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    path : array, shape (n, 2) or more columns
        Positions of all scans [m].
    parts : mapping of str to array, bool, shape (n,)
        Name of a set -> its scans; two sets.

    Returns
    -------
    ax : Axes
        The axes.
    """
    plots.draw_track(ax, path, colour=COLOURS["map"], label="not used", linewidth=1.0)
    for (name, is_part), colour in zip(parts.items(), ("fake", "real"), strict=True):
        plots.show_points(ax, path[is_part, :2], colour=COLOURS[colour], size=14, label=name)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(loc="best", markerscale=1.6)
    return ax


# ---- ground truth ----


def draw_registration(
    axes: np.ndarray, maps: Mapping[str, np.ndarray], poses: Mapping[str, np.ndarray], corner: np.ndarray
) -> np.ndarray:
    """Draw maps from their own starts and after registration, whole and enlarged.

    Parameters
    ----------
    axes : array of Axes, shape (2, 2)
        Whole maps above, the enlarged square below; registered maps on the right.
    maps : mapping of str to array, shape (m, 2)
        Session -> its map in its own frame [m].
    poses : mapping of str to array, shape (3,)
        Session -> its registration [m, m, rad].
    corner : array, shape (2,)
        Middle of the square that is enlarged [m].

    Returns
    -------
    axes : array of Axes
        The axes.
    """
    for k, (session, points) in enumerate(maps.items()):
        colour = plots.SESSION_COLOURS[k % len(plots.SESSION_COLOURS)]
        for column, pose in zip(axes.T, (np.zeros(3), poses[session]), strict=True):
            placed = transform_points(pose, points)
            plots.show_points(column[0], placed, colour=colour, size=0.3)
            inside = np.abs(placed - corner).max(axis=1) < 20.0  # a whole map in each panel takes memory
            plots.show_points(column[1], placed[inside], colour=colour, size=1.5)
    for column, title in zip(axes.T, ("each from its own start", "registered"), strict=True):
        column[0].set_title(title)
        plots.frame_square(column[0], corner, 20.0, colour="#000000")
        plots.zoom(column[1], corner, 20.0)
    return axes


def draw_along(
    axes: Sequence[Axes],
    paths_m: Mapping[str, tuple[np.ndarray, np.ndarray]],
    residuals_m: Mapping[str, np.ndarray],
    errors_m: Mapping[str, np.ndarray],
) -> Sequence[Axes]:
    """Draw residuals, and errors where they are known, along the paths of the sessions.

    Parameters
    ----------
    axes : sequence of one or two Axes
        Residuals; errors.
    paths_m : mapping of str to (array, array), shapes (k,) and (n,)
        Session -> length of the path at the scans of its residuals and at all scans [m].
    residuals_m : mapping of str to array, shape (k,)
        Median distance of a scan to the map [m]; a running median of nine scans is drawn.
    errors_m : mapping of str to array, shape (n,)
        Position errors [m]; empty where the true poses are not known.

    Returns
    -------
    axes : sequence of Axes
        The axes.
    """
    for k, (session, (at_residuals, at_scans)) in enumerate(paths_m.items()):
        colour = plots.SESSION_COLOURS[k % len(plots.SESSION_COLOURS)]
        values = residuals_m[session]
        around = [values[max(i - 4, 0) : i + 5] for i in range(len(values))]
        smooth = [np.nanmedian(part) if np.isfinite(part).any() else np.nan for part in around]
        axes[0].plot(at_residuals, smooth, color=colour, label=session)
        if session in errors_m:
            axes[1].plot(at_scans, errors_m[session], color=colour)
    labels = ("distance to the map [m]", "ground-truth error [m]")
    for ax, label in zip(axes, labels, strict=False):
        ax.set(ylabel=label, ylim=(0, None))
    axes[-1].set_xlabel("length of the path [m]")
    axes[0].figure.legend(loc="outside lower center", ncols=3)
    return axes
