"""Nearest-neighbour distances between generated points and lidar points, in the plane [m] (Sec. IV-B).

Rules for empty clouds: a cloud without points has no distances (n = 0) and its fractions are nan, so that it
is left out of means; against an empty reference every distance is infinite, so that the fractions are 0.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

if __package__:
    from .geometry import check_points
else:  # this file was copied and is imported by its own name
    from geometry import check_points


def nn_distances(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Compute the distance of each point to the nearest reference point.

    Parameters
    ----------
    points : array, shape (n, 2)
        Query points [m].
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
    Yin et al. 2020, Sec. IV-B: generated points against the k-d tree of the lidar points.
    """
    points, reference = check_points(points), check_points(reference, "reference")
    if len(reference) == 0 or len(points) == 0:
        return np.full(len(points), np.inf)
    return cKDTree(reference).query(points)[0]


def fraction_within(distances: np.ndarray, radius: float) -> float:
    """Compute the fraction of distances below a radius.

    Parameters
    ----------
    distances : array, shape (n,)
        Distances, infinite allowed [m].
    radius : float
        Upper limit of the distances that count [m].

    Returns
    -------
    fraction : float
        In 0..1; nan without distances.

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
    """Count distances in bins; the last bin includes everything beyond its edge.

    Parameters
    ----------
    distances : array, shape (n,)
        Distances, infinite allowed [m].
    edges : array, shape (k + 1,)
        Edges of the bins, starting at 0 [m].

    Returns
    -------
    counts : array, shape (k,), int64
        Distances per bin; their sum is n.
    """
    edges = np.asarray(edges, dtype=np.float64)
    clipped = np.clip(np.asarray(distances, dtype=np.float64), edges[0], edges[-1])
    if np.isnan(clipped).any():
        raise ValueError(f"distances: value {int(np.argmax(np.isnan(clipped)))} is nan")
    return np.histogram(clipped, edges)[0]


def similarity_summary(generated: np.ndarray, lidar: np.ndarray) -> dict[str, float | int]:
    """Compare generated points with lidar points in both directions.

    Parameters
    ----------
    generated, lidar : array, shape (n, 2), (m, 2)
        Points in one frame [m].

    Returns
    -------
    summary : dict
        ``n_fake``, ``n_real``; for ``fake_to_real`` (precision) and ``real_to_fake`` (recall) the fractions
        ``_within_1m`` and ``_within_2m`` (0..1) and ``_median_m``; nan where the first cloud is empty. "fake"
        are the generated points, "real" the lidar points.

    Notes
    -----
    Yin et al. 2020, Sec. IV-B report the precision; the recall shows what the generated points miss.
    """
    return summarize_distances(nn_distances(generated, lidar), nn_distances(lidar, generated))


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
        summary[f"{name}_within_1m"] = fraction_within(distances, 1.0)
        summary[f"{name}_within_2m"] = fraction_within(distances, 2.0)
        summary[f"{name}_median_m"] = float(np.median(distances)) if len(distances) else float("nan")
    return summary
