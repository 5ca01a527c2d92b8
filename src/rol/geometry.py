"""Poses in the plane (SE(2)) and in space: compose, invert, exp, log, transform.

A 2D pose is an array whose last axis holds ``(x, y, yaw)`` in metres and radians; x points forward, y left,
and yaw turns counter-clockwise. A pose named ``T_a_b`` maps points of frame ``b`` into frame ``a``; it is at
the same time the pose of ``b`` as seen from ``a``. A 3D transform is a 4 x 4 matrix with the same naming.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from scipy.spatial.transform import Rotation

# Beyond these, a point is most likely stray.
MAX_EXTENT_M, MAX_GRID_BYTES = 1e5, 2**33


def wrap_angle(angle: np.ndarray | float) -> np.ndarray | float:
    """Wrap an angle to the half-open interval [-pi, pi).

    Parameters
    ----------
    angle : float or array, any shape
        Angle [rad].

    Returns
    -------
    wrapped : float or array, same shape
        The same direction in [-pi, pi) [rad].
    """
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def check_poses(poses: np.ndarray, name: str = "poses", error: type[ValueError] = ValueError) -> np.ndarray:
    """Check that an array holds finite 2D poses.

    Parameters
    ----------
    poses : array-like, shape (..., 3)
        Poses (x, y, yaw) [m, m, rad].
    name : str
        What the array is called in the message.
    error : type
        Exception to raise.

    Returns
    -------
    poses : array, shape (..., 3)
        The same values as float64.

    Raises
    ------
    ValueError
        Or the given ``error``, if a value is no number or not finite, or the last axis is not 3.
    """
    poses = _to_floats(poses, name, error)
    if poses.ndim == 0 or poses.shape[-1] != 3:
        raise error(f"{name}: expected shape (..., 3) for (x, y, yaw), got {poses.shape}")
    if not np.isfinite(poses).all():
        first = np.argwhere(~np.isfinite(poses))[0]
        raise error(f"{name}: value at index {tuple(int(i) for i in first)} is not finite")
    return poses


def check_pose(pose: np.ndarray, name: str = "pose", error: type[ValueError] = ValueError) -> np.ndarray:
    """Check that an array is one finite 2D pose, shape (3,), as `check_poses` does with many."""
    pose = check_poses(pose, name, error)
    if pose.ndim != 1:
        raise error(f"{name}: expected shape (3,) for (x, y, yaw), got {pose.shape}")
    return pose


def check_points(
    points: np.ndarray,
    name: str = "points",
    *,
    columns: int = 2,
    more: bool = False,
    error: type[ValueError] = ValueError,
) -> np.ndarray:
    """Check that an array holds finite points.

    Parameters
    ----------
    points : array-like, shape (n, columns)
        Points [m]; n may be zero, and an array without any value is a cloud without points.
    name : str
        What the points are called in the message.
    columns : int
        Number of coordinates to check.
    more : bool
        Allow further columns, which are not checked.
    error : type
        Exception to raise.

    Returns
    -------
    points : array, shape (n, columns) or more columns
        The same values as float64, contiguous.

    Raises
    ------
    ValueError
        Or the given ``error``, if the shape is another one or a coordinate is no number or not finite.
    """
    points = np.ascontiguousarray(_to_floats(points, name, error))
    if points.size == 0:
        return points.reshape(0, columns)
    if points.ndim != 2 or points.shape[1] < columns or (points.shape[1] > columns and not more):
        wanted = f"(n, {columns})" + (" or more columns" if more else "")
        raise error(f"{name}: expected points of shape {wanted}, got {points.shape}")
    is_finite = np.isfinite(points[:, :columns]).all(axis=1)
    if not is_finite.all():
        raise error(f"{name}: point {int(np.argmin(is_finite))} is not finite")
    return points


def _to_floats(values: Any, name: str, error: type[ValueError]) -> np.ndarray:
    """Convert to an array of float64; refuse text, other objects, and rows of different lengths."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as fault:
        raise error(f"{name}: not an array of numbers ({fault})") from fault


def check_fields(
    settings: Any, allowed: Mapping[str | tuple[str, ...], str], error: type[ValueError] = ValueError
) -> None:
    """Check that the fields of a settings class are in their ranges.

    Parameters
    ----------
    settings : dataclass
        Instance to check; fields declared as ``int`` must be whole numbers, those declared as ``bool`` True
        or False; tuples are checked value by value. Fields declared as ``str``, as a mapping or as a settings
        class must be of that class, or of another one that has all its public methods.
    allowed : mapping
        Range or choices -> names of the fields, separated by spaces. A range is written as an interval, such
        as "(0, inf)", where a bracket includes the bound; choices are a tuple of words.
    error : type
        Exception to raise.

    Raises
    ------
    ValueError
        Or the given ``error``, with the field's name, its value and what is allowed; NaN is in no range.
    """
    # The annotations are text; their names are those of the module, also where it runs under another name.
    hook = getattr(type(settings), "__post_init__", None)
    kinds = get_type_hints(type(settings), getattr(hook, "__globals__", None))
    for name, kind in kinds.items():
        _check_kind(name, getattr(settings, name), kind, error)
    for span, names in allowed.items():
        for name in names.split():
            value = getattr(settings, name)
            if not isinstance(span, tuple):
                check_number(name, value, span, kinds[name], error)
            elif value not in span:
                raise error(f"{name}: {value!r} is none of {', '.join(span)}")


def _check_kind(name: str, value: Any, kind: Any, error: type[ValueError]) -> None:
    """Check a flag, a text, a nested settings class, or a mapping to them."""
    base = get_origin(kind) or kind
    if base is bool and type(value) is not bool:
        raise error(f"{name}: {value!r} is neither True nor False")
    if (base in (str, dict, Mapping) or is_dataclass(base)) and not _acts_as(value, base):
        raise error(f"{name}: expected {base.__name__}, got {value!r:.60}")
    for key, part in value.items() if base in (dict, Mapping) else ():
        _check_kind(f"{name}: {key}", part, get_args(kind)[1], error)


def _acts_as(value: Any, kind: type) -> bool:
    """Check whether a value is of a class, or has all its public methods, such as another motion model."""
    methods = [name for name, part in vars(kind).items() if callable(part) and name[0] != "_"]
    has_all = methods and all(callable(getattr(value, name, None)) for name in methods)
    return isinstance(value, kind) or (has_all and not isinstance(value, type))


def check_number(name: str, value: Any, span: str, kind: Any, error: type[ValueError] = ValueError) -> None:
    """Check that a number, or each number of nested tuples, lies in an interval such as "[0, 1)".

    The kind ``int`` asks for one whole number and ``float`` for one number; with any other kind, numbers may
    be nested.

    Raises
    ------
    ValueError
        Or the given ``error``, with the name, the value and the interval; NaN is in no interval.
    """
    if not _is_in(value, span, kind):
        raise error(f"{name}: {value!r:.60} is not {'a whole number in ' if kind is int else 'in '}{span}")


def _is_in(value: Any, span: str, kind: Any) -> bool:
    """Check whether a number, or each number of nested tuples, lies in an interval such as "[0, 1)"."""
    values = np.asarray(value)
    if values.dtype.kind not in ("iu" if kind is int else "iuf") or (kind in (int, float) and values.ndim):
        return False
    low, high = (float(bound) for bound in span[1:-1].split(","))
    above = values >= low if span[0] == "[" else values > low
    below = values <= high if span[-1] == "]" else values < high
    return bool((above & below).all())


def check_grid(
    shape: tuple[float, ...] | np.ndarray,
    points: np.ndarray,
    name: str,
    *,
    n_bytes: int = 1,
    error: type[ValueError] = ValueError,
) -> tuple[int, ...]:
    """Check, before it is allocated, that a grid around points is of a size that memory holds.

    Parameters
    ----------
    shape : sequence of float
        Cells in each direction.
    points : array, shape (m, 2)
        Points that the grid is made for, at least one [m].
    name : str
        What the points are called in the message, such as "map".
    n_bytes : int
        Bytes per cell.
    error : type
        Exception to raise.

    Returns
    -------
    shape : tuple of int
        The same shape.

    Raises
    ------
    ValueError
        Or the given ``error``, when the grid is larger than ``MAX_GRID_BYTES`` or the points reach over more
        than ``MAX_EXTENT_M``; it says how far the points reach and how many of them lie far from the others.
    """
    size = n_bytes * float(np.prod(np.asarray(shape, dtype=np.float64)))
    low, high = points.min(axis=0), points.max(axis=0)
    if size <= MAX_GRID_BYTES and (high - low <= MAX_EXTENT_M).all():
        return tuple(int(n) for n in shape)
    away = np.hypot(*(points - np.median(points, axis=0)).T)
    n_far, farthest = int(np.sum(away > 10.0 * np.median(away))), points[away.argmax()]
    need = f"; their grid would take {size / 2**30:,.0f} GiB" if size > MAX_GRID_BYTES else ""
    raise error(
        f"{name}: points from x {low[0]:.6g} to {high[0]:.6g} m and y {low[1]:.6g} to {high[1]:.6g} m; {n_far} of"
        f" {len(points)} lie far from the others, the farthest at ({farthest[0]:.6g}, {farthest[1]:.6g}) m{need}"
    )


def compose(T_a_b: np.ndarray, T_b_c: np.ndarray) -> np.ndarray:
    """Compose two poses: the pose of c in a.

    Parameters
    ----------
    T_a_b, T_b_c : array, shape (..., 3)
        Poses (x, y, yaw) [m, m, rad]; leading axes broadcast.

    Returns
    -------
    T_a_c : array, shape (..., 3)
        The composed pose, yaw in [-pi, pi).
    """
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def invert(T_a_b: np.ndarray) -> np.ndarray:
    """Invert a pose.

    Parameters
    ----------
    T_a_b : array, shape (..., 3)
        Pose (x, y, yaw) [m, m, rad].

    Returns
    -------
    T_b_a : array, shape (..., 3)
        The inverse, such that ``compose(T_a_b, T_b_a)`` is zero.
    """
    a = np.asarray(T_a_b, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -c * a[..., 0] - s * a[..., 1]
    y = s * a[..., 0] - c * a[..., 1]
    return np.stack([x, y, wrap_angle(-a[..., 2])], axis=-1)


def relative_pose(T_w_a: np.ndarray, T_w_b: np.ndarray) -> np.ndarray:
    """Compute the pose of b in the frame of a.

    Parameters
    ----------
    T_w_a, T_w_b : array, shape (..., 3)
        Two poses in one frame [m, m, rad]; leading axes broadcast.

    Returns
    -------
    T_a_b : array, shape (..., 3)
        ``compose(invert(T_w_a), T_w_b)``.
    """
    return compose(invert(T_w_a), T_w_b)


def exp(twist: np.ndarray | tuple[float, float, float], seconds: np.ndarray | float = 1.0) -> np.ndarray:
    """Compute the pose reached at a constant body velocity, the exponential map of SE(2).

    Parameters
    ----------
    twist : array-like, shape (..., 3)
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    seconds : array or float, shape (...)
        Time since the pose was zero, may be negative [s]; leading axes broadcast.

    Returns
    -------
    poses : array, shape (..., 3)
        Pose (x, y, yaw) on the arc [m, m, rad]; yaw is not wrapped.
    """
    vx, vy, yaw_rate = np.moveaxis(np.asarray(twist, dtype=np.float64), -1, 0)
    seconds = np.asarray(seconds, dtype=np.float64)
    yaw = yaw_rate * seconds
    along = seconds * np.sinc(yaw / np.pi)  # sin(yaw) / yaw_rate, also where the yaw rate is zero
    aside = seconds * np.sin(yaw / 2.0) * np.sinc(yaw / (2.0 * np.pi))  # (1 - cos(yaw)) / yaw_rate
    return np.stack([vx * along - vy * aside, vx * aside + vy * along, yaw], axis=-1)


def log(poses: np.ndarray) -> np.ndarray:
    """Compute the constant body velocity that reaches a pose in one second, the inverse of `exp`.

    Parameters
    ----------
    poses : array-like, shape (..., 3)
        Poses (x, y, yaw) [m, m, rad], yaw in (-2 pi, 2 pi).

    Returns
    -------
    twists : array, shape (..., 3)
        Body velocity (vx, vy, yaw rate) [m/s, m/s, rad/s].
    """
    x, y, yaw = np.moveaxis(np.asarray(poses, dtype=np.float64), -1, 0)
    half = yaw / 2.0
    stretch = 1.0 / np.sinc(half / np.pi)  # length of the arc over that of its chord
    vx = (np.cos(half) * x + np.sin(half) * y) * stretch
    vy = (np.cos(half) * y - np.sin(half) * x) * stretch
    return np.stack([vx, vy, yaw], axis=-1)


def accumulate_increments(
    increments: np.ndarray, start: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Compose odometry increments into a trajectory.

    Parameters
    ----------
    increments : array, shape (n, 3)
        Increment i is the pose of frame i + 1 in frame i (x, y, yaw) [m, m, rad].
    start : array-like, shape (3,)
        Pose of frame 0 [m, m, rad].

    Returns
    -------
    poses : array, shape (n + 1, 3)
        Pose of every frame, the start first; yaw in [-pi, pi).
    """
    increments = check_poses(np.asarray(increments, dtype=np.float64).reshape(-1, 3), "increments")
    x0, y0, yaw0 = check_pose(start, "start")
    yaws = yaw0 + np.concatenate([[0.0], np.cumsum(increments[:, 2])])
    c, s = np.cos(yaws[:-1]), np.sin(yaws[:-1])
    dx, dy = increments[:, 0], increments[:, 1]
    x = x0 + np.concatenate([[0.0], np.cumsum(c * dx - s * dy)])
    y = y0 + np.concatenate([[0.0], np.cumsum(s * dx + c * dy)])
    return np.stack([x, y, wrap_angle(yaws)], axis=-1)


def transform_points(T_a_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map 2D points from frame b into frame a.

    Parameters
    ----------
    T_a_b : array, shape (3,)
        Pose of b in a (x, y, yaw) [m, m, rad].
    points : array, shape (n, 2)
        Points in frame b [m].

    Returns
    -------
    points : array, shape (n, 2)
        The same points in frame a [m].
    """
    x, y, yaw = check_pose(T_a_b, "T_a_b")
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points, dtype=np.float64) @ np.array([[c, s], [-s, c]]) + (x, y)


def first_of_cells(points: np.ndarray, cell: float) -> np.ndarray:
    """Keep one point per square cell, so that a place observed many times counts once.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points [m].
    cell : float
        Side of a cell [m].

    Returns
    -------
    points : array, shape (k, 2)
        The first of each cell, in the order given.
    """
    cells = np.floor(np.asarray(points, dtype=np.float64) / cell).astype(np.int64)
    return points[np.sort(np.unique(cells, axis=0, return_index=True)[1])]


def transform_from_euler(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Build a 4 x 4 transform from a translation and Euler angles.

    Parameters
    ----------
    x, y, z : float
        Translation [m].
    roll, pitch, yaw : float
        Angles of Rz(yaw) Ry(pitch) Rx(roll) [rad].

    Returns
    -------
    T : array, shape (4, 4)
        Homogeneous transform.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    T[:3, 3] = x, y, z
    return T


def transform_points_3d(T_a_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map 3D points from frame b into frame a.

    Parameters
    ----------
    T_a_b : array, shape (4, 4)
        Homogeneous transform.
    points : array, shape (n, 3)
        Points in frame b [m].

    Returns
    -------
    points : array, shape (n, 3)
        The same points in frame a [m].

    Raises
    ------
    ValueError
        If the transform has another shape.
    """
    if np.shape(T_a_b) != (4, 4):
        raise ValueError(f"T_a_b: expected a transform of shape (4, 4), got {np.shape(T_a_b)}")
    return points @ T_a_b[:3, :3].T + T_a_b[:3, 3]
