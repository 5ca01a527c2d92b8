"""Compare a published ground truth with the data set's odometry and with the path of another session."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rol.geometry import compose, invert, relative_pose


def lateral_offsets(
    poses: np.ndarray,
    reference: np.ndarray,
    *,
    max_m: float = 12.0,
    max_turn: float = float(np.deg2rad(15.0)),
) -> np.ndarray:
    """Compute how far to the left of another session's path each pose of a session lies.

    Parameters
    ----------
    poses, reference : array, shape (n, 3) and (m, 3)
        Poses of the two sessions in the same frame [m, m, rad].
    max_m, max_turn : float
        A pose farther than this from the nearest one of the other session, or of another heading, has no
        offset [m, rad].

    Returns
    -------
    offsets : array, shape (n,)
        NaN where there is none [m].
    """
    distances, nearest = cKDTree(reference[:, :2]).query(poses[:, :2])
    off = relative_pose(reference[nearest], poses)
    return np.where((distances < max_m) & (np.abs(off[:, 2]) < max_turn), off[:, 1], np.nan)


def largest_gap(truth: np.ndarray, odometry: np.ndarray) -> float:
    """Compute the largest distance between a ground truth and an odometry that starts at its first pose.

    Parameters
    ----------
    truth, odometry : array, shape (n, 3) and (m, 3)
        Poses of the same scans, each in its own frame; the longer one is cut [m, m, rad].

    Returns
    -------
    gap : float
        Zero where the ground truth is this odometry, rigidly moved [m].
    """
    n = min(len(truth), len(odometry))
    moved = compose(compose(truth[0], invert(odometry[0])), odometry[:n])
    return float(np.hypot(*(moved - truth[:n])[:, :2].T).max())
