"""Figures of the book. Nothing here computes a result.

Functions take an ``ax`` (or a figure), draw into it and return it; nothing is shown or saved. Pictures of the
ground have x (forward) up and y (left) to the left, in metres, with the sensor or the map's origin at zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

# Distinct for colour-blind readers, and by lightness on grey paper (Okabe and Ito 2008).
COLOURS = {
    "radar": "#E69F00",
    "fake": "#009E73",
    "real": "#0072B2",
    "map": "#8C8C8C",
    "truth": "#000000",
    "estimate": "#D55E00",
}

# Lines and markers of methods and front ends; a figure that compares them uses these.
METHOD_COLOURS = {"paper": "#0072B2", "robust": "#D55E00"}
FRONT_END_COLOURS = {
    "k-strongest": "#E69F00",
    "cfar": "#CC79A7",
    "paper": "#0072B2",
    "paper-no-gan": "#56B4E9",
    "unet": "#009E73",
}

WIDTH = 9.0  # of every figure [inches]

# For sessions, in this order: distinct for colour-blind readers too, and from all of the above.
SESSION_COLOURS = ("#332288", "#33BBEE", "#EE3377", "#999933", "#7F3B08")

# For other lines side by side, in this order.
SERIES = ("#000000", "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7")


def style() -> None:
    """Set matplotlib's defaults for the book: readable at a width of 700 pixels, thin lines."""
    plt.rcParams.update(
        {
            "figure.dpi": 120,
            "figure.figsize": (WIDTH, 4.0),
            "figure.constrained_layout.use": True,
            "font.size": 11.0,
            "axes.titlesize": 11.0,
            "axes.titlelocation": "left",
            "axes.labelsize": 10.5,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.color": "#E4E4E4",
            "grid.linewidth": 0.7,
            "legend.frameon": False,
            "legend.fontsize": 10.0,
            "xtick.labelsize": 9.5,
            "ytick.labelsize": 9.5,
            "lines.linewidth": 1.6,
            "image.interpolation": "nearest",
            "image.cmap": "gray_r",
        }
    )


def subplots(
    n_rows: int = 1, n_columns: int = 1, *, height: float = 4.0, **options: Any
) -> tuple[Figure, Any]:
    """Make a figure of the book's width.

    Parameters
    ----------
    n_rows, n_columns : int
        Rows and columns of panels.
    height : float
        Height of the figure [inches].
    **options
        Options of `matplotlib.pyplot.subplots`, such as ``sharex`` or ``width_ratios``.

    Returns
    -------
    figure : Figure
        The figure.
    axes : Axes, or array of Axes
        Its panels, as `matplotlib.pyplot.subplots` returns them.
    """
    return plt.subplots(n_rows, n_columns, figsize=(WIDTH, height), **options)


# ---- images in metres ----


def show_image(
    ax: Axes,
    image: np.ndarray,
    *,
    pixel_size: float = 0.25,
    title: str = "",
    vmax: float | None = None,
    cmap: str = "gray_r",
) -> Axes:
    """Show an image around the sensor in metres: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    image : array, shape (h, h)
        Row 0 farthest forward, column 0 farthest left.
    pixel_size : float
        Edge of a pixel [m].
    title : str
        Title.
    vmax : float, optional
        Value of the darkest colour; the image's largest if not given.
    cmap : str
        Colour map; dark on white if not given.

    Returns
    -------
    ax : Axes
        The axes.
    """
    half = image.shape[0] * pixel_size / 2.0
    ax.imshow(image, cmap=cmap, vmin=0, vmax=vmax, extent=(half, -half, -half, half))
    ax.set_aspect("equal")
    ax.grid(False)
    ax.set(title=title, xlabel="y, to the left [m]", ylabel="x, forward [m]")
    return ax


def show_points(
    ax: Axes,
    points: np.ndarray,
    *,
    colour: str,
    size: float = 1.0,
    label: str = "",
    title: str = "",
    alpha: float = 1.0,
) -> Axes:
    """Show points of the plane in metres: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    points : array, shape (n, 2) or more columns
        x forward, y left [m].
    colour, label, title : str
        Colour of the points, their name in a legend, title.
    size, alpha : float
        Area of a point [square points] and its opacity.

    Returns
    -------
    ax : Axes
        The axes.
    """
    ax.scatter(
        points[:, 1], points[:, 0], s=size, c=colour, label=label, alpha=alpha, linewidths=0, rasterized=True
    )
    ax.set_aspect("equal")
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.set(xlabel="y, to the left [m]", ylabel="x, forward [m]")
    if title:
        ax.set_title(title)
    return ax


def zoom(ax: Axes, centre: Sequence[float], half: float) -> Axes:
    """Show only a square of the ground.

    Parameters
    ----------
    ax : Axes
        Axes of an image or of points in metres.
    centre : sequence of two floats
        x and y of the middle [m].
    half : float
        Half the edge [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    ax.set(xlim=(centre[1] + half, centre[1] - half), ylim=(centre[0] - half, centre[0] + half))
    return ax


def frame_square(ax: Axes, centre: Sequence[float], half: float, colour: str = COLOURS["estimate"]) -> Axes:
    """Draw the outline of a square of the ground, the place of an enlarged view."""
    x, y = centre
    ax.plot(
        [y + half, y - half, y - half, y + half, y + half],
        [x - half, x - half, x + half, x + half, x - half],
        colour,
    )
    return ax


# ---- alignment and ground ----


def draw_gaps(ax: Axes, gaps_ms: Mapping[str, np.ndarray], *, max_gap_ms: float, title: str = "") -> Axes:
    """Draw the distribution of time gaps between scans and sweeps.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    gaps_ms : mapping of str to array, shape (n,)
        Per lidar its sweep's time minus the scan's [ms].
    max_gap_ms : float
        Limit of the gaps [ms].
    title : str
        Title.

    Returns
    -------
    ax : Axes
        The axes.
    """
    edges = np.linspace(-max_gap_ms, max_gap_ms, 41)
    for (name, gaps), colour in zip(gaps_ms.items(), (COLOURS["real"], COLOURS["estimate"]), strict=False):
        ax.hist(
            np.clip(gaps, *edges[[0, -1]]), edges, histtype="step", color=colour, label=name, linewidth=1.6
        )
    ax.axvline(0.0, color="#444444", linewidth=0.8)
    ax.set(title=title, xlabel="sweep minus scan [ms]", ylabel="scans", xlim=(-max_gap_ms, max_gap_ms))
    ax.legend(loc="upper left", ncols=2)
    ax.margins(y=0.25)
    return ax


def draw_with_bins(
    ax: Axes, x: np.ndarray, y: np.ndarray, edges: np.ndarray, *, colour: str, label: str, marker: str = "o"
) -> Axes:
    """Draw pairs of numbers as faint points, and the median of y in each bin of x as a line.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    x, y : array, shape (n,)
        The numbers; pairs with nan are left out.
    edges : array, shape (k + 1,)
        Edges of the bins; bins of fewer than three pairs get no median.
    colour, label, marker : str
        Look of the line and its name in a legend.

    Returns
    -------
    ax : Axes
        The axes.
    """
    known = np.isfinite(x) & np.isfinite(y)
    x, y = np.asarray(x)[known], np.asarray(y)[known]
    ax.scatter(x, y, s=16, color=colour, alpha=0.4, linewidths=0)
    place = np.digitize(x, edges) - 1
    filled = [i for i in range(len(edges) - 1) if (place == i).sum() >= 3]
    middles = [float(np.median(x[place == i])) for i in filled]
    ax.plot(
        middles, [float(np.median(y[place == i])) for i in filled], color=colour, marker=marker, label=label
    )
    return ax


def draw_heights(ax: Axes, points: np.ndarray, *, size: float = 1.0, max_height: float = 6.0) -> Axes:
    """Draw a cloud in space, coloured by height.

    Parameters
    ----------
    ax : Axes3D
        Axes with the projection "3d".
    points : array, shape (n, 3) or more columns
        x forward, y left, z up [m].
    size : float
        Area of a point [square points].
    max_height : float
        Height of the brightest colour [m].

    Returns
    -------
    ax : Axes3D
        The axes; the colours belong to ``ax.collections[-1]``.
    """
    x, y, z = np.asarray(points)[:, :3].T
    ax.scatter(
        x, y, z, c=z, s=size, cmap="viridis", vmin=-2.2, vmax=max_height, linewidths=0, rasterized=True
    )
    ax.set_box_aspect([np.ptp(v) for v in (x, y, z)], zoom=1.5)
    ax.view_init(elev=30, azim=-145)
    ax.set(xlabel="x, forward [m]", ylabel="y, to the left [m]", zticks=[0, max_height])
    return ax


def draw_overlay(
    ax: Axes,
    radar_image: np.ndarray,
    points: np.ndarray,
    *,
    size: float,
    title: str = "",
    pixel_size: float = 0.25,
) -> Axes:
    """Draw lidar points over a radar image; codes below the noise stay white.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    radar_image : array, shape (h, h), uint8
        Power codes.
    points : array, shape (n, 2)
        Lidar points [m].
    size : float
        Area of a point [square points].
    title : str
        Title.
    pixel_size : float
        Edge of a pixel [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    show_image(ax, np.clip(radar_image, 30, None) - 30.0, pixel_size=pixel_size, vmax=80, title=title)
    show_points(ax, points, colour=COLOURS["real"], size=size)
    return zoom(ax, (0.0, 0.0), radar_image.shape[0] * pixel_size / 2.0)


# ---- maps and localization ----


def draw_track(
    ax: Axes,
    poses: np.ndarray,
    *,
    colour: str = COLOURS["estimate"],
    label: str = "",
    values: np.ndarray | None = None,
    vmax: float | None = None,
    linewidth: float = 1.6,
) -> Axes | LineCollection:
    """Draw a path on the ground: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    poses : array, shape (n, 2) or (n, 3)
        Places along the path [m].
    colour, label : str
        Colour of the line and its name in a legend.
    values : array, shape (n,), optional
        Colours the line by these values instead.
    vmax : float, optional
        Value of the brightest colour.
    linewidth : float
        Width of the line [points].

    Returns
    -------
    drawn : Axes, or LineCollection with values
        The axes, or the line for a colour bar.
    """
    ax.set_aspect("equal")
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.set(xlabel="y, to the left [m]", ylabel="x, forward [m]")
    places = np.asarray(poses)[:, [1, 0]]
    if values is None:
        ax.plot(*places.T, color=colour, label=label, linewidth=linewidth)
        return ax
    line = LineCollection(np.stack([places[:-1], places[1:]], axis=1), cmap="plasma", linewidth=3.0)
    line.set_array(np.asarray(values)[1:])
    line.set_clim(0.0, vmax)
    ax.add_collection(line)
    return line


def show_poses(
    ax: Axes,
    poses: np.ndarray,
    *,
    colour: str = COLOURS["estimate"],
    values: np.ndarray | None = None,
    length: float = 0.7,
) -> Quiver:
    """Draw poses as arrows: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    poses : array, shape (n, 3)
        x, y, yaw [m, m, rad].
    colour : str
        Colour of the arrows.
    values : array, shape (n,), optional
        Colours the arrows by these values instead.
    length : float
        Length of an arrow [m].

    Returns
    -------
    arrows : Quiver
        The arrows, for a colour bar.
    """
    ax.set_aspect("equal")
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.set(xlabel="y, to the left [m]", ylabel="x, forward [m]")
    x, y, yaw = np.asarray(poses).T
    look = {"color": colour} if values is None else {"cmap": "viridis"}
    shade = () if values is None else (values,)
    return ax.quiver(
        y,
        x,
        length * np.sin(yaw),
        length * np.cos(yaw),
        *shade,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="xy",
        width=0.09 * length,
        headwidth=3.2,
        headlength=4.0,
        headaxislength=3.6,
        zorder=3,
        **look,
    )


# ---- the network ----


def draw_losses(
    axes: Sequence[Axes], history: Mapping[str, Sequence[float]], *, empty_l1: float
) -> Sequence[Axes]:
    """Draw the history of a training run: L1 on the left, the two adversarial losses on the right.

    Parameters
    ----------
    axes : two Axes
        Where to draw.
    history : mapping of str to sequence, shape (n,)
        Columns ``step``, ``loss_l1``, ``held_out_l1``, ``loss_d``, ``loss_gan``.
    empty_l1 : float
        L1 of an empty image on the held-out pairs, drawn as a level.

    Returns
    -------
    axes : two Axes
        The axes.
    """
    left, right = axes
    left.plot(
        history["step"], history["loss_l1"], color=COLOURS["fake"], marker="o", markersize=3, label="training"
    )
    left.plot(
        history["step"],
        history["held_out_l1"],
        color=COLOURS["real"],
        marker="s",
        markersize=3,
        label="held out",
    )
    left.axhline(empty_l1, color=COLOURS["map"], linestyle="--", label="an empty image")
    left.set(title="L1 distance (Eq. 4)", xlabel="step", ylabel="mean absolute difference", yscale="log")
    right.plot(
        history["step"],
        history["loss_gan"],
        color=COLOURS["fake"],
        marker="o",
        markersize=3,
        label="generator",
    )
    right.plot(
        history["step"],
        history["loss_d"],
        color=COLOURS["estimate"],
        marker="s",
        markersize=3,
        label="discriminator",
    )
    right.axhline(np.log(2.0), color=COLOURS["map"], linestyle="--", label="D undecided")
    right.set(title="adversarial losses (Eq. 3)", xlabel="step", ylabel="cross-entropy", ylim=(0.0, None))
    for ax in axes:
        ax.legend(loc="best")
    return axes


def draw_image_grid(
    axes: np.ndarray,
    images: Sequence[Sequence[np.ndarray]],
    titles: Sequence[str],
    rows: Sequence[str],
    *,
    half: float,
    vmax: Sequence[float],
) -> np.ndarray:
    """Draw rows of images of the ground, cut to a square around the sensor.

    Parameters
    ----------
    axes : array of Axes, shape (n, m)
        Where to draw.
    images : n sequences of m arrays, shape (h, h)
        Images.
    titles : sequence of str, length m
        Titles of the columns.
    rows : sequence of str, length n
        Labels left of the rows.
    half : float
        Half the edge of the square shown [m].
    vmax : sequence of float, length m
        Value of the darkest colour in each column.

    Returns
    -------
    axes : array of Axes
        The axes.
    """
    for row, (line, label) in enumerate(zip(images, rows, strict=True)):
        for column, (image, darkest) in enumerate(zip(line, vmax, strict=True)):
            ax = zoom(show_image(axes[row, column], image, vmax=darkest), (0.0, 0.0), half)
            ax.set(title=titles[column] if row == 0 else "", xlabel="", ylabel=label if column == 0 else "")
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(True)
    return axes


def draw_distances(ax: Axes, counts: np.ndarray, edges: np.ndarray, *, text: str = "") -> Axes:
    """Draw the distribution of nearest-neighbour distances, with levels at 1 m and 2 m.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    counts : array, shape (k,)
        Points per bin; the last bin holds all beyond.
    edges : array, shape (k + 1,)
        Edges of the bins [m].
    text : str
        Text in the upper right corner.

    Returns
    -------
    ax : Axes
        The axes.
    """
    ax.stairs(100.0 * counts / max(counts.sum(), 1), edges, fill=True, color=COLOURS["fake"])
    for level in (1.0, 2.0):
        ax.axvline(level, color="#444444", linewidth=0.9, linestyle="--")
    ax.text(0.97, 0.95, text, transform=ax.transAxes, ha="right", va="top", fontsize=9.5)
    ax.set(xlim=(edges[0], edges[-1]), xlabel="distance to the nearest real point [m]", ylabel="points [%]")
    return ax


# ---- sessions ----


def draw_routes(ax: Axes, paths: Sequence[np.ndarray], names: Sequence[str]) -> Axes:
    """Draw the paths of several sessions on the ground, a dot at each start.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    paths : sequence of array, shape (n, 2)
        East and north of each session [m].
    names : sequence of str
        Names for the legend.

    Returns
    -------
    ax : Axes
        The axes.
    """
    for index, (path, name) in enumerate(zip(paths, names, strict=True)):
        colour = SESSION_COLOURS[index % len(SESSION_COLOURS)]
        ax.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.4, label=name)
        ax.plot(*path[0], "o", color=colour, markersize=5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(title="positions of gps.csv", xlabel="east [m]", ylabel="north [m]")
    return ax


def draw_speeds(ax: Axes, drives: Sequence[tuple[np.ndarray, np.ndarray]], names: Sequence[str]) -> Axes:
    """Draw the speeds of several sessions over time, one strip for each.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    drives : sequence of (stamps, poses), shapes (n,) and (n, 3)
        Times [us] and poses [m, m, rad] of each session.
    names : sequence of str
        Names for the strips.

    Returns
    -------
    ax : Axes
        The axes.
    """
    for index, (stamps_us, poses) in enumerate(drives):
        seconds = np.diff(stamps_us) / 1e6
        speeds = np.hypot(*np.diff(poses[:, :2], axis=0).T) / seconds
        base = -12.0 * index
        times = (stamps_us[1:] - stamps_us[0]) / 1e6
        colour = SESSION_COLOURS[index % len(SESSION_COLOURS)]
        ax.fill_between(times, base, base + speeds, color=colour, alpha=0.85, linewidth=0)
        ax.text(0.0, base + 9.9, names[index], fontsize=9.5)
    ax.set(
        title="speed; a strip is 12 m/s high",
        xlabel="time since the first scan [s]",
        ylim=(-12.0 * len(drives) + 11.0, 12.5),
    )
    ax.set_yticks([-12.0 * i for i in range(len(drives))], ["0"] * len(drives))
    return ax


def draw_polar(
    ax: Axes, codes: np.ndarray, *, bin_m: float, offset_m: float, max_range: float = 164.0
) -> Axes:
    """Draw a radar scan as it is stored: a row per azimuth, range to the right.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    codes : array, shape (400, 3768)
        Power codes of half a decibel.
    bin_m, offset_m, max_range : float
        Length of a bin, range offset, and where to stop [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    shown = ax.imshow(
        codes,
        cmap="gray_r",
        aspect="auto",
        vmin=0,
        vmax=110,
        extent=(offset_m, offset_m + bin_m * codes.shape[1], 360, 0),
        interpolation="antialiased",
    )
    ax.set(
        title="as stored",
        xlabel="range [m]",
        ylabel="azimuth, clockwise from ahead [deg]",
        xlim=(0, max_range),
    )
    ax.set_yticks(np.arange(0, 361, 90))
    ax.grid(False)
    ax.figure.colorbar(shown, ax=ax, label="power code [0.5 dB]", shrink=0.8)
    return ax


def draw_range_image(ax: Axes, ranges: np.ndarray, *, max_range: float = 50.0) -> Axes:
    """Draw the ranges of a sweep as stored: a row per laser, a column per firing;
    white where nothing came back.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    ranges : array, shape (32, n)
        Ranges, the highest laser first, zero where nothing came back [m].
    max_range : float
        End of the colour scale [m].

    Returns
    -------
    ax : Axes
        The axes.
    """
    shown = ax.imshow(
        np.where(ranges > 0, ranges, np.nan), cmap="viridis_r", aspect="auto", vmin=0, vmax=max_range
    )
    ax.set(title="as stored", xlabel="firing", ylabel="laser")
    ax.grid(False)
    ax.figure.colorbar(shown, ax=ax, label="range [m]")
    return ax


def draw_view(ax: Axes, picture: np.ndarray, *, title: str = "") -> Axes:
    """Show a rendered picture without axes.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    picture : array, shape (h, w, 3)
        Colours between 0 and 1.
    title : str
        Title.

    Returns
    -------
    ax : Axes
        The axes.
    """
    ax.imshow(picture, interpolation="antialiased")
    ax.set_title(title)
    ax.set_axis_off()
    return ax


def draw_plan(
    ax: Axes,
    picture: np.ndarray,
    centre: Sequence[float],
    half: float,
    *,
    path: np.ndarray,
    pose: np.ndarray,
    title: str = "",
) -> Axes:
    """Show a rendered plan with a path on it and one pose as an arrow.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    picture : array, shape (n, n, 3)
        The plan: row 0 at the largest y, column 0 at the smallest x.
    centre : sequence of two floats
        Middle of the plan [m].
    half : float
        Half its edge [m].
    path : array, shape (n, 3)
        Poses along the path [m, m, rad].
    pose : array, shape (3,)
        The pose of the arrow.
    title : str
        Title.

    Returns
    -------
    ax : Axes
        The axes.
    """
    extent = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
    ax.imshow(picture, extent=extent, interpolation="antialiased")
    ax.plot(path[:, 0], path[:, 1], color=COLOURS["truth"], linewidth=1.8)
    shape = "simple, head_width=1.0, head_length=0.8, tail_width=0.3"
    arrow = {"arrowstyle": shape, "mutation_scale": 18, "facecolor": COLOURS["truth"], "edgecolor": "white"}
    tip = pose[:2] + 16.0 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    ax.annotate("", xy=tip, xytext=pose[:2], arrowprops=arrow)
    ax.set(title=title, xlabel="town x [m]", ylabel="town y [m]", xlim=extent[:2], ylim=extent[2:])
    ax.grid(False)
    return ax
