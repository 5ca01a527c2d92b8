"""Figures of localization: registration of scans, one update of the filter, errors of runs.

Nothing here computes a result. Each function draws one figure of the book's width and returns it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rol.evaluation import CLASSES, PoseErrors
from rol.geometry import transform_points
from rol_book import plots
from rol_book.plots import COLOURS, METHOD_COLOURS
from rol_book.route_plots import split_figure

FAINT_MAP = "#C8C8C8"
FAILURE_LINE = {"color": "#444444", "linewidth": 1.2, "linestyle": "--"}


def draw_scan_on_map(
    map_points: np.ndarray, truth: np.ndarray, index: int, cloud: np.ndarray, colour: str
) -> Figure:
    """Draw the map with a path, and the points of one scan at its true pose.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Map [m].
    truth : array, shape (n, 3)
        True poses [m, m, rad].
    index : int
        Scan that is shown.
    cloud : array, shape (k, 2)
        Its points in the radar frame [m].
    colour : str
        Colour of the points.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, 2, height=4.6)
    plots.show_points(axes[0], map_points, colour=COLOURS["map"], size=0.4)
    plots.draw_track(axes[0], truth, colour=COLOURS["truth"])
    plots.frame_square(axes[0], truth[index, :2], 40.0)
    plots.draw_scan(axes[1], map_points, truth[index], {"": cloud}, 40.0, [colour])
    for ax, title in zip(axes, ("session on the map", "one scan at its pose"), strict=True):
        ax.set_title(title)
    return figure


def draw_registration(
    source: np.ndarray, target: np.ndarray, poses: Mapping[str, np.ndarray], colour: str, half: float = 30.0
) -> Figure:
    """Draw a cloud on the one before it, once for each pose, such as before and after ICP.

    Parameters
    ----------
    source, target : array, shape (n, 2) and (m, 2)
        Cloud that is registered, and the one before it [m].
    poses : mapping of str to array, shape (3,)
        Title of a panel -> pose of the source in the target [m, m, rad].
    colour : str
        Colour of the source.
    half : float
        Half the edge of the square shown [m].

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, len(poses), height=4.4)
    for ax, (title, pose) in zip(axes, poses.items(), strict=True):
        plots.show_points(ax, target, colour=COLOURS["truth"], size=7.0, title=title)
        plots.show_points(ax, transform_points(pose, source), colour=colour, size=7.0)
        plots.zoom(ax, (0.0, 0.0), half)
    return figure


def draw_odometry(
    map_points: np.ndarray, truth: np.ndarray, odometry: np.ndarray, errors: PoseErrors
) -> Figure:
    """Draw a path of odometry alone beside the true one, and the errors of the increments.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Map [m].
    truth, odometry : array, shape (n, 3)
        True poses, and those of the accumulated increments [m, m, rad].
    errors : PoseErrors
        Errors of the n - 1 increments.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, 2, height=4.0)
    plots.show_points(axes[0], map_points, colour=FAINT_MAP, size=0.2)
    plots.draw_track(axes[0], truth, colour=COLOURS["truth"], label="ground truth")
    plots.draw_track(axes[0], odometry, colour=COLOURS["estimate"], label="odometry")
    scans = np.arange(1, len(truth))
    axes[1].plot(scans, errors.longitudinal_m, color=COLOURS["estimate"], linewidth=1.0, label="longitudinal")
    axes[1].plot(scans, errors.lateral_m, color=COLOURS["real"], linewidth=1.0, label="lateral")
    axes[1].set(xlabel="scan", ylabel="error of an increment [m]")
    for ax, title in zip(axes, ("accumulated", "per increment"), strict=True):
        ax.set_title(title)
        ax.legend(loc="best")
    return figure


def draw_update(
    true_pose: np.ndarray, before: np.ndarray, counts: np.ndarray, kept: np.ndarray, moved: np.ndarray
) -> Figure:
    """Draw one update: particles with their counts, the resampled ones, and the count over the distance.

    Parameters
    ----------
    true_pose : array, shape (3,)
        True pose [m, m, rad].
    before : array, shape (n, 3)
        Particles before the update [m, m, rad].
    counts : array, shape (n,)
        Matched points of each.
    kept, moved : array, shape (n, 3)
        Particles after resampling, and after the next prediction [m, m, rad].

    Returns
    -------
    figure : Figure
    """
    figure, axes = split_figure(3, 3.4)
    plots.show_poses(axes[0], before, values=counts, length=0.6)
    plots.show_poses(axes[1], moved, colour=COLOURS["radar"], length=0.6).set_alpha(0.35)
    plots.show_poses(axes[1], kept, colour=METHOD_COLOURS["paper"], length=0.6)
    for ax in axes[:2]:
        plots.show_poses(ax, true_pose[None], colour=COLOURS["truth"], length=1.5)
        plots.zoom(ax, true_pose[:2], 5.0)
    distances = np.hypot(*(before - true_pose)[:, :2].T)
    axes[2].scatter(distances, counts, s=6, c=counts, cmap="viridis")
    axes[2].set(xlabel="distance from the true pose [m]", box_aspect=1)
    for ax, title in zip(axes, ("before", "after", "matched points"), strict=True):
        ax.set_title(title)
    return figure


def draw_trajectory(
    map_points: np.ndarray,
    poses: np.ndarray,
    position_m: np.ndarray,
    failures: Sequence[int],
    cloud: np.ndarray,
    colour: str,
) -> Figure:
    """Draw an estimated path on the map, coloured by its error, and the scan with the largest error.

    Parameters
    ----------
    map_points : array, shape (m, 2)
        Map [m].
    poses : array, shape (n, 3)
        Estimates [m, m, rad].
    position_m : array, shape (n,)
        Their errors [m].
    failures : sequence of int
        Scans of the failures.
    cloud : array, shape (k, 2)
        Points of the scan with the largest error in the radar frame [m].
    colour : str
        Colour of these points.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, 2, height=5.2)
    pose = poses[np.argmax(position_m)]
    plots.draw_route(axes[0], map_points, poses, position_m, failures)
    plots.frame_square(axes[0], pose[:2], 40.0, COLOURS["truth"])
    plots.draw_scan(axes[1], map_points, pose, {"": cloud}, 40.0, [colour])
    return figure


def draw_errors(
    seconds: np.ndarray, errors: PoseErrors, diagnostics: pd.DataFrame, failures: Sequence[int]
) -> Figure:
    """Draw the errors of a run over time, and the filter's own diagnostics.

    Parameters
    ----------
    seconds : array, shape (n,)
        Times of the scans [s].
    errors : PoseErrors
        Errors of the n estimates.
    diagnostics : DataFrame
        ``spread_m`` and ``inlier_ratio`` of the n updates.
    failures : sequence of int
        Scans of the failures, drawn as vertical lines.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(3, 1, height=6.4, sharex=True)
    axes[0].plot(seconds, errors.longitudinal_m, color=COLOURS["estimate"], label="longitudinal")
    axes[0].plot(seconds, errors.lateral_m, color=COLOURS["real"], label="lateral")
    axes[1].plot(seconds, np.rad2deg(errors.yaw_rad), color=COLOURS["truth"])
    spreads, ratios = diagnostics.spread_m, diagnostics.inlier_ratio
    axes[2].plot(seconds, spreads, color=COLOURS["radar"], label="spread of the particles [m]")
    axes[2].plot(seconds, ratios, color=COLOURS["fake"], label="inlier ratio")
    for ax, label in zip(axes, ("position error [m]", "heading error [deg]", "diagnostics"), strict=True):
        ax.set_ylabel(label)
        for index in failures:
            ax.axvline(seconds[index], **FAILURE_LINE)
    axes[0].legend(loc="upper right", ncols=2)
    axes[2].legend(loc="lower left", ncols=2)
    axes[2].set(xlabel="time [s]", ylim=(0, None))
    return figure


def draw_error_cdfs(
    errors: Mapping[str, Sequence[PoseErrors]], published: Mapping[str, np.ndarray], min_m: float = 0.01
) -> Figure:
    """Draw the cumulative distributions of position and heading errors of several methods.

    Parameters
    ----------
    errors : mapping of str to sequence of PoseErrors
        Method -> errors of its sessions. Thin lines are sessions, thick ones all scans together.
    published : mapping of str to array, shape (3,)
        Session of the paper -> percentages of its Table III, drawn at the limits of the three classes.
    min_m : float
        Left end of the position axis [m]; that of the heading axis is the same number of degrees.

    Returns
    -------
    figure : Figure
    """
    figure, axes = plots.subplots(1, 2, height=4.4, sharey=True)
    for method, sessions in errors.items():
        positions = [one.position_m for one in sessions]
        headings = [np.abs(np.rad2deg(one.yaw_rad)) for one in sessions]
        for ax, values in zip(axes, (positions, headings), strict=True):
            for one in values:
                _draw_cdf(ax, one, METHOD_COLOURS[method], linewidth=0.7, alpha=0.6)
            _draw_cdf(
                ax, np.concatenate(values), METHOD_COLOURS[method], label=f"method {method}", linewidth=2.4
            )
    for ax, limits in zip(axes, np.transpose(CLASSES), strict=True):
        for number, values in enumerate(published.values()):
            label = "" if number else "paper's Table III"
            ax.plot(limits, values, "o", color="#000000", markerfacecolor="white", label=label, zorder=4)
        ax.set(xscale="log", xlim=(min_m, 20.0), ylim=(0, 103), ylabel="scans below the error [%]")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.tick_params(labelleft=True)
        ax.legend(loc="upper left")
    axes[0].set_xlabel("position error [m]")
    axes[1].set_xlabel("heading error [deg]")
    return figure


def draw_result_row(
    axes: Sequence[Axes],
    truth: np.ndarray,
    estimate: np.ndarray,
    errors: PoseErrors,
    colour: str,
    limits: tuple[float, float] = (5.0, 5.0),
) -> Sequence[Axes]:
    """Draw one row of the paper's Fig. 4: paths, position errors, heading errors.

    Parameters
    ----------
    axes : sequence of three Axes
        Where to draw.
    truth, estimate : array, shape (n, 3)
        Poses in the map [m, m, rad].
    errors : PoseErrors
        Errors of the estimate.
    colour : str
        Colour of the estimate.
    limits : tuple of float
        Ends of the histograms [m] and [deg]; larger errors are counted in the last bins.

    Returns
    -------
    axes : sequence of three Axes
        The axes.
    """
    max_m, max_deg = limits
    plots.draw_track(axes[0], truth, colour=COLOURS["truth"], label="ground truth", linewidth=2.8)
    plots.draw_track(axes[0], estimate, colour=colour, label="estimate", linewidth=1.2)
    weights = np.full(len(errors.position_m), 100.0 / len(errors.position_m))
    positions = np.clip(errors.position_m, 0.0, max_m)
    headings = np.clip(np.rad2deg(errors.yaw_rad), -max_deg, max_deg)
    axes[1].hist(positions, np.linspace(0.0, max_m, 26), weights=weights, color=colour)
    axes[2].hist(headings, np.linspace(-max_deg, max_deg, 41), weights=weights, color=colour)
    axes[1].set(xlabel="position error [m]", ylabel="scans [%]", xlim=(0.0, max_m))
    axes[2].set(xlabel="heading error [deg]", ylabel="scans [%]", xlim=(-max_deg, max_deg))
    return axes


def _draw_cdf(ax: Axes, values: np.ndarray, colour: str, **look: object) -> None:
    """Draw the percentage of values below each value."""
    order = np.sort(values)
    ax.plot(order, 100.0 * np.arange(1, len(order) + 1) / len(order), color=colour, **look)
