"""Read the true materials of simulated lidar points.

The writer stores them for some sweeps of a session, below `labels/`, one image per sweep.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rol.oxford import RANGE_UNIT, load_velodyne_raw, velodyne_raw_to_points


def label_sweep(folder: Path | str, sensor: str, stamp_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a sweep and what each one hit, for sweeps whose true materials were written.

    Parameters
    ----------
    folder : path
        Folder of a simulated session.
    sensor : str
        "velodyne_left" or "velodyne_right".
    stamp_us : int
        The sweep's name [us].

    Returns
    -------
    points : array, shape (n, 4), float32
        As `rol.oxford.velodyne_raw_to_points` gives them: x, y, z [m] in the lidar frame, intensity.
    materials : array, shape (n,), uint8
        `rol_sim.world.mesh.Material` of every point.

    Raises
    ------
    ValueError
        If the sweep has no labels or they do not fit; the message names the file.
    """
    path = Path(folder) / "labels" / sensor / f"{stamp_us}.png"
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.exists() else None
    if labels is None:
        raise ValueError(
            f"{path}: missing or not an image; labels are there for some sweeps only, see list_labels"
        )
    raw = load_velodyne_raw(Path(folder) / sensor / f"{stamp_us}.png")
    if labels.shape != raw.ranges.shape:
        raise ValueError(f"{path}: shape {labels.shape} for a sweep of {raw.ranges.shape}")
    points, _ = velodyne_raw_to_points(raw)
    return points, labels.T[raw.ranges.T * RANGE_UNIT > 1.0]


def list_labels(folder: Path | str, sensor: str) -> np.ndarray:
    """List the sweeps of a simulated session whose true materials were written, shape (n,), int64 [us]."""
    return np.array(
        sorted(int(path.stem) for path in (Path(folder) / "labels" / sensor).glob("[!.]*.png")),
        dtype=np.int64,
    )
