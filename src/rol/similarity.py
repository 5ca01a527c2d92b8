"""The similarity room: how near are fake points to real ones, and real ones to fake ones.

Everything is measured in metres between nearest neighbours in the plane. Rules for empty clouds: a cloud
without points has no distances (n = 0) and its shares are nan, so that it is left out of means; against an
empty reference every distance is infinite, so that the shares are 0.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def nn_distances(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Give each point's distance to the nearest reference point.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points asked about [m].
    reference : array, shape (m, 2)
        Points of the k-d tree [m].

    Returns
    -------
    distances : array, shape (n,)
        Distances [m]; infinite if the reference is empty.

    Raises
    ------
    ValueError
        If a shape is wrong or a coordinate is not finite.

    Notes
    -----
    Yin et al. 2020, Sec. IV-B, with the fake points against the tree of the real ones.
    """
    points, reference = _check_cloud(points, "points"), _check_cloud(reference, "reference")
    if len(reference) == 0 or len(points) == 0:
        return np.full(len(points), np.inf)
    return cKDTree(reference).query(points)[0]


def share_within(distances: np.ndarray, radius: float) -> float:
    """Give the share of distances below a radius.

    Parameters
    ----------
    distances : array, shape (n,)
        Distances, infinite allowed [m].
    radius : float
        Distances below it count [m].

    Returns
    -------
    share : float
        Share in 0..1; nan if there is no distance.

    Raises
    ------
    ValueError
        If a distance is nan.
    """
    distances = np.asarray(distances, dtype=np.float64)
    if np.isnan(distances).any():
        raise ValueError(f"distances: value {int(np.argmax(np.isnan(distances)))} is nan")
    return float(np.mean(distances < radius)) if len(distances) else float("nan")


def distance_histogram(distances: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Count distances in bins; the last bin also takes everything beyond.

    Parameters
    ----------
    distances : array, shape (n,)
        Distances, infinite allowed [m].
    edges : array, shape (k + 1,)
        Edges of the bins, from 0 on [m].

    Returns
    -------
    counts : array, shape (k,), int64
        Distances per bin; they add up to n.
    """
    edges = np.asarray(edges, dtype=np.float64)
    clipped = np.clip(np.asarray(distances, dtype=np.float64), edges[0], edges[-1])
    if np.isnan(clipped).any():
        raise ValueError(f"distances: value {int(np.argmax(np.isnan(clipped)))} is nan")
    return np.histogram(clipped, edges)[0]


def similarity_summary(fake: np.ndarray, real: np.ndarray) -> dict[str, float | int]:
    """Compare a fake with a real cloud in both directions.

    Parameters
    ----------
    fake, real : array, shape (n, 2), (m, 2)
        Clouds in one frame [m].

    Returns
    -------
    summary : dict
        ``n_fake``, ``n_real``; for ``fake_to_real`` and ``real_to_fake`` the shares ``_within_1m`` and
        ``_within_2m`` (0..1) and ``_median_m``; nan where the asking cloud is empty.

    Notes
    -----
    Yin et al. 2020, Sec. IV-B report fake to real; the other direction shows what the fake cloud misses.
    """
    return summarize_distances(nn_distances(fake, real), nn_distances(real, fake))


def summarize_distances(fake_to_real: np.ndarray, real_to_fake: np.ndarray) -> dict[str, float | int]:
    """Summarize nearest-neighbour distances of both directions.

    Parameters
    ----------
    fake_to_real, real_to_fake : array, shape (n,), (m,)
        Distances of the points of one cloud to the other [m].

    Returns
    -------
    summary : dict
        As of `similarity_summary`.
    """
    summary: dict[str, float | int] = {"n_fake": len(fake_to_real), "n_real": len(real_to_fake)}
    for name, distances in (("fake_to_real", fake_to_real), ("real_to_fake", real_to_fake)):
        summary[f"{name}_within_1m"] = share_within(distances, 1.0)
        summary[f"{name}_within_2m"] = share_within(distances, 2.0)
        summary[f"{name}_median_m"] = float(np.median(distances)) if len(distances) else float("nan")
    return summary


def _check_cloud(points: np.ndarray, name: str) -> np.ndarray:
    """Refuse clouds of another shape or with values that are not finite."""
    points = np.asarray(points, dtype=np.float64)
    if points.size == 0:
        return points.reshape(0, 2)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (n, 2), got {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: point {int(np.argmin(np.isfinite(points).all(axis=1)))} is not finite")
    return points
