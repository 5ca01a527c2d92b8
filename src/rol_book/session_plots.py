"""Figures of a session: the turn of the radar while the vehicle moves, and the frames. Nothing here computes
a result.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from rol.geometry import transform_points
from rol_book import plots

PLACES = {  # of a name: offset [points], alignments
    "above": ((6, 5), "left", "bottom"),
    "above left": ((-6, 5), "right", "bottom"),
    "below": ((0, -9), "center", "top"),
}
AXIS_COLOURS = {"x": plots.COLOURS["estimate"], "y": plots.COLOURS["fake"]}


def draw_turn(
    ax: Axes, row_poses: np.ndarray, azimuths: np.ndarray, seconds: np.ndarray, *, range_m: float = 6.0
) -> LineCollection:
    """Draw the beams of one turn from above, coloured by time, with a colour bar: x up, y to the left.

    The ends of the beams, all at one range, lie on a spiral; a dashed circle shows where they would lie with
    a stationary vehicle.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    row_poses : array, shape (n, 3)
        T_mid_row, pose of the radar at each azimuth, in its frame at mid-scan [m, m, rad].
    azimuths : array, shape (n,)
        Azimuths of the rows, counter-clockwise [rad].
    seconds : array, shape (n,)
        Time of each row relative to mid-scan [s].
    range_m : float
        Length of the beams [m].

    Returns
    -------
    beams : LineCollection
        The beams.
    """
    ends = range_m * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    tips = np.array([transform_points(pose, end[None])[0] for pose, end in zip(row_poses, ends, strict=True)])
    lines = np.stack([row_poses[:, :2], tips], axis=1)[:, :, ::-1]
    beams = LineCollection(lines[::8], cmap="viridis", linewidth=1.0, array=1e3 * seconds[::8])
    ax.add_collection(beams)
    circle = np.deg2rad(np.arange(361))
    ax.plot(
        range_m * np.sin(circle), range_m * np.cos(circle), color="#444444", linestyle="--", linewidth=1.0
    )
    ax.scatter(tips[:, 1], tips[:, 0], c=1e3 * seconds, s=9, cmap="viridis", linewidths=0, zorder=3)
    ax.plot(row_poses[:, 1], row_poses[:, 0], color="black", linewidth=2.4, zorder=4)
    ax.set_aspect("equal")
    ax.invert_xaxis()
    ax.set(title="beams of one turn", xlabel="y, to the left [m]", ylabel="x, forward [m]")
    ax.figure.colorbar(beams, ax=ax, label="time from mid-scan [ms]", shrink=0.85)
    return beams


def draw_displacement(ax: Axes, row_poses: np.ndarray, azimuths: np.ndarray) -> Axes:
    """Draw the position of the radar at each azimuth, forward and to the left of that at mid-scan.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    row_poses : array, shape (n, 3)
        T_mid_row, pose of the radar at each azimuth, in its frame at mid-scan [m, m, rad].
    azimuths : array, shape (n,)
        Azimuths of the rows, counter-clockwise [rad].

    Returns
    -------
    ax : Axes
        The axes.
    """
    clockwise = -np.rad2deg(azimuths)
    for column, (label, colour) in enumerate((("forward", "x"), ("to the left", "y"))):
        ax.plot(clockwise, row_poses[:, column], color=AXIS_COLOURS[colour], label=label)
    ax.axhline(0.0, color="#444444", linewidth=0.8)
    ax.set_xticks(np.arange(0, 361, 90), ["0\nahead", "90\nright", "180\nbehind", "270\nleft", "360\nahead"])
    ax.set(title="position of the radar at each azimuth", xlabel="azimuth, clockwise [deg]")
    ax.set_ylabel("from mid-scan [m]")
    ax.legend(loc="upper left")
    return ax


def draw_frame(ax: Axes, pose: np.ndarray, name: str, *, length: float, place: str = "above") -> Axes:
    """Draw the two axes of a frame from above, with its name: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    pose : array, shape (3,)
        Pose of the frame in that of the figure [m, m, rad].
    name : str
        Name, written beside the origin.
    length : float
        Length of an axis [m].
    place : str
        Where the name is written: "above", "above left" or "below" the origin.

    Returns
    -------
    ax : Axes
        The axes.
    """
    x, y, yaw = pose
    for axis, turn in (("x", 0.0), ("y", np.pi / 2.0)):
        tip = y + length * np.sin(yaw + turn), x + length * np.cos(yaw + turn)
        look = {"arrowstyle": "-|>", "color": AXIS_COLOURS[axis], "linewidth": 1.8, "shrinkA": 0}
        ax.annotate("", xy=tip, xytext=(y, x), arrowprops=look, zorder=4)
        end = y + 1.18 * (tip[0] - y), x + 1.18 * (tip[1] - x)
        ax.text(*end, axis, color=AXIS_COLOURS[axis], ha="center", va="center", fontsize=9.5)
    ax.plot(y, x, "o", color="black", markersize=4.5, zorder=5)
    offset, across, along = PLACES[place]
    ax.annotate(name, (y, x), xytext=offset, textcoords="offset points", ha=across, va=along)
    return ax


def draw_map_frames(ax: Axes, path: np.ndarray, pose: np.ndarray) -> Axes:
    """Draw the frames of the map and of the radar with the path between them: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    path : array, shape (n, 3)
        Poses of the radar in the map [m, m, rad].
    pose : array, shape (3,)
        T_map_radar, the pose to show [m, m, rad].

    Returns
    -------
    ax : Axes
        The axes.
    """
    plots.draw_track(ax, path, colour=plots.COLOURS["map"])
    length = 0.16 * max(np.ptp(path[:, 0]), np.ptp(path[:, 1]))
    look = {"arrowstyle": "-|>", "linestyle": "--", "color": "#444444", "linewidth": 1.0}
    ax.annotate("", xy=(pose[1], pose[0]), xytext=(0.0, 0.0), arrowprops=look)
    middle = 0.5 * pose[1], 0.5 * pose[0]
    box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none"}
    ax.annotate(
        "T_map_radar", middle, xytext=(-6, -8), textcoords="offset points", ha="right", va="center", bbox=box
    )
    draw_frame(ax, np.zeros(3), "map", length=length, place="below")
    draw_frame(ax, pose, "radar", length=length)
    ax.set_title("map and radar")
    ax.margins(0.18)
    return ax


def draw_mounting(ax: Axes, extrinsics: Mapping[str, np.ndarray]) -> Axes:
    """Draw the frames of the vehicle and of its sensors from above: x up, y to the left.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    extrinsics : mapping
        Name of a sensor -> T_vehicle_sensor, shape (4, 4).

    Returns
    -------
    ax : Axes
        The axes.
    """
    draw_frame(ax, np.zeros(3), "vehicle", length=0.25)
    for sensor, transform in extrinsics.items():
        x, y, z = transform[:3, 3]
        yaw = np.arctan2(transform[1, 0], transform[0, 0])
        name = f"{sensor.replace('velodyne_', 'lidar, ')}\nz = {z:.2f} m"
        place = {"radar": "below", "velodyne_left": "above left"}.get(sensor, "above")
        draw_frame(ax, np.array([x, y, yaw]), name, length=0.25, place=place)
    ax.set_aspect("equal")
    ax.set(title="sensors on the vehicle", xlim=(0.95, -1.05), ylim=(-1.2, 0.45))
    ax.set(xlabel="y, to the left [m]", ylabel="x, forward [m]")
    return ax
