"""The bird's-eye room: points to image and back (Eq. 1).

Row 0 is farthest forward (x), column 0 farthest left (y), index is (row, column), the sensor sits in the
middle between the four central pixels, and a pixel's coordinate is that of its centre: ``x = ((width - 1) / 2
- row) * pixel_size`` and ``y = ((width - 1) / 2 - column) * pixel_size``. A pixel takes part when its centre
lies within ``max_range``; the same rule in both directions makes the round trips exact.
"""

from __future__ import annotations

import numpy as np


def points_to_image(
    points: np.ndarray, *, width: int = 512, pixel_size: float = 0.25, max_range: float = 64.0
) -> np.ndarray:
    """Draw points as an occupancy image.

    Parameters
    ----------
    points : array, shape (n, 2) or more columns
        x forward, y left in the first columns [m].
    width : int
        Number of rows and of columns.
    pixel_size : float
        Edge of a pixel [m].
    max_range : float
        Pixels whose centre is farther from the sensor stay empty [m].

    Returns
    -------
    image : array, shape (width, width), uint8
        255 where at least one point falls into the pixel, else 0.

    Raises
    ------
    ValueError
        If a coordinate is not finite.

    Notes
    -----
    Yin et al. 2020, Eq. 1.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 2:
        raise ValueError(f"points: expected shape (n, 2) or more columns, got {points.shape}")
    if not np.isfinite(points[:, :2]).all():
        raise ValueError(
            f"points: point {int(np.argmin(np.isfinite(points[:, :2]).all(axis=1)))} is not finite"
        )
    cells = np.floor(width / 2.0 - points[:, :2] / pixel_size)
    cells = cells[((cells >= 0) & (cells < width)).all(axis=1)].astype(np.int64)
    centres = ((width - 1) / 2.0 - cells) * pixel_size
    rows, cols = cells[np.hypot(centres[:, 0], centres[:, 1]) <= max_range].T
    image = np.zeros((width, width), dtype=np.uint8)
    image[rows, cols] = 255
    return image


def image_to_points(
    image: np.ndarray,
    *,
    threshold: int = 128,
    pixel_size: float = 0.25,
    max_range: float = 64.0,
    min_range: float = 0.0,
) -> np.ndarray:
    """Read an occupancy image as points.

    Parameters
    ----------
    image : array, shape (width, width)
        Occupancy, 0 empty to 255 occupied.
    threshold : int
        Smallest value that counts as occupied.
    pixel_size : float
        Edge of a pixel [m].
    max_range, min_range : float
        Pixels whose centre is farther from the sensor, or nearer, are left out [m].

    Returns
    -------
    points : array, shape (n, 2)
        Centres of the occupied pixels, row by row [m].

    Raises
    ------
    ValueError
        If the image is not square with one channel.

    Notes
    -----
    Yin et al. 2020, Eq. 1 and Eq. 5.
    """
    image = np.asarray(image)
    if image.ndim != 2 or image.shape[0] != image.shape[1]:
        raise ValueError(f"image: expected a square image with one channel, got shape {image.shape}")
    cells = np.argwhere(image >= threshold)
    points = ((image.shape[0] - 1) / 2.0 - cells) * pixel_size
    ranges = np.hypot(points[:, 0], points[:, 1])
    return points[(ranges >= min_range) & (ranges <= max_range)]
