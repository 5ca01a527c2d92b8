"""Convert points to bird's-eye-view images and back (Eq. 1), and grey values to the range of the networks.

Row 0 is farthest forward (x), column 0 farthest left (y), index is (row, column), the sensor sits in the
middle between the four central pixels, and a pixel's coordinate is that of its centre: ``x = ((width - 1) / 2
- row) * pixel_size`` and ``y = ((width - 1) / 2 - column) * pixel_size``. A pixel is used when its centre
lies within ``max_range``; the same rule in both directions makes the round trips exact.
"""

from __future__ import annotations

import cv2
import numpy as np

if __package__:
    from .geometry import check_points
else:  # this file was copied and is imported by its own name
    from geometry import check_points


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
    points = check_points(points, more=True)
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
    thin: bool = False,
) -> np.ndarray:
    """Convert an occupancy image into points.

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
    thin : bool
        Keep only the crests, see `crest_pixels`; the paper keeps all pixels.

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
    is_point = image >= threshold
    cells = np.argwhere(is_point & crest_pixels(image) if thin else is_point)
    points = ((image.shape[0] - 1) / 2.0 - cells) * pixel_size
    ranges = np.hypot(points[:, 0], points[:, 1])
    return points[(ranges >= min_range) & (ranges <= max_range)]


def crest_pixels(image: np.ndarray, sigma: float = 0.8) -> np.ndarray:
    """Mark the pixels that are local maxima across a line of the smoothed image.

    Parameters
    ----------
    image : array, shape (h, w)
        Grey values.
    sigma : float
        Width of the Gaussian that smooths first [pixels].

    Returns
    -------
    is_crest : array of bool, shape (h, w)
        True where the smoothed image is not smaller than both neighbours in the direction, of four, in which
        it is curved down most; one of two equal neighbours counts.

    Notes
    -----
    Non-maximum suppression as in Canny's edge detector. A generator that is uncertain by a pixel draws lines
    three pixels wide; the wall is in the middle. Not in the paper.
    """
    smooth = cv2.GaussianBlur(np.asarray(image, dtype=np.float32), (0, 0), sigma)
    padded = np.pad(smooth, 1, mode="edge")
    (h, w), curved = smooth.shape, np.full(smooth.shape, np.inf, dtype=np.float32)
    is_crest = np.zeros(smooth.shape, dtype=bool)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        after = padded[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]
        before = padded[1 - dy : 1 - dy + h, 1 - dx : 1 - dx + w]
        bend = (after + before - 2.0 * smooth) / (dy * dy + dx * dx)
        is_sharpest = bend < curved
        curved[is_sharpest] = bend[is_sharpest]
        is_crest[is_sharpest] = ((smooth >= after) & (smooth > before))[is_sharpest]
    return is_crest


def normalize_image(image: np.ndarray) -> np.ndarray:
    """Scale grey values 0..255 to [-1, 1], the input of the networks, as float32 of the same shape."""
    return image.astype(np.float32) / np.float32(127.5) - np.float32(1.0)
