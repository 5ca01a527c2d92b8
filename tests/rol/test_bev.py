"""Bird's-eye images: the right pixel, and exact round trips (Eq. 1)."""

import numpy as np
import pytest

from rol.bev import crest_pixels, image_to_points, points_to_image


def test_pixels_by_hand():
    """A 4 x 4 image of 1 m pixels: x forward is up, y left is left, the sensor in the middle."""
    points = np.array([[1.5, 1.5], [0.5, -0.5], [-1.2, 0.1], [2.1, 0.0], [0.0, -2.0]])
    image = points_to_image(points, width=4, pixel_size=1.0, max_range=10.0)
    expected = np.zeros((4, 4), dtype=np.uint8)
    expected[0, 0] = expected[1, 2] = expected[3, 1] = 255  # the last two lie outside, one on the far edge
    np.testing.assert_array_equal(image, expected)
    centres = image_to_points(image, pixel_size=1.0, max_range=10.0)
    np.testing.assert_array_equal(centres, [[1.5, 1.5], [0.5, -0.5], [-1.5, 0.5]])


def test_defaults_are_the_papers():
    image = points_to_image(np.array([[63.9, 0.1], [0.0, 0.0], [50.0, 50.0]]))
    assert image.shape == (512, 512) and image.dtype == np.uint8
    assert sorted(map(tuple, np.argwhere(image))) == [(0, 255), (256, 256)]  # (50, 50) lies beyond 64 m


@pytest.mark.parametrize(
    ("width", "pixel_size", "max_range"), [(512, 0.25, 64.0), (64, 0.1, 3.0), (65, 0.3, 9.0)]
)
def test_round_trips_are_exact(width, pixel_size, max_range):
    rng = np.random.default_rng(3)
    options = {"pixel_size": pixel_size, "max_range": max_range}
    image = points_to_image(rng.normal(0, max_range / 2, (3000, 2)), width=width, **options)
    points = image_to_points(image, **options)
    assert len(points) == np.count_nonzero(image) > 100
    np.testing.assert_array_equal(points_to_image(points, width=width, **options), image)
    again = image_to_points(points_to_image(points, width=width, **options), **options)
    np.testing.assert_array_equal(again, points)
    assert np.hypot(*points.T).max() <= max_range


def test_every_pixel_inside_survives():
    full = np.full((64, 64), 255, dtype=np.uint8)
    points = image_to_points(full, max_range=100.0)
    assert len(points) == 64 * 64
    np.testing.assert_array_equal(points_to_image(points, width=64, max_range=100.0), full)


def test_a_point_moves_half_a_pixel_at_most():
    points = np.random.default_rng(4).uniform(-40, 40, (500, 2))
    for point in points:
        assert np.abs(image_to_points(points_to_image(point[None])) - point).max() <= 0.125 + 1e-12


def test_threshold_counts_equal_values():
    image = np.array([[0, 127], [128, 255]], dtype=np.uint8)
    assert len(image_to_points(image)) == 2
    assert len(image_to_points(image, threshold=129)) == 1


def test_empty_both_ways():
    image = points_to_image(np.zeros((0, 2)))
    assert not image.any()
    assert image_to_points(image).shape == (0, 2)


def test_further_columns_are_ignored():
    np.testing.assert_array_equal(points_to_image([[1.0, 2.0, 9.0]]), points_to_image([[1.0, 2.0]]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_refuses_what_is_not_finite(bad):
    with pytest.raises(ValueError, match="point 1 is not finite"):
        points_to_image(np.array([[0.0, 0.0], [bad, 1.0]]))


def test_refuses_wrong_shapes():
    with pytest.raises(ValueError, match="points: expected"):
        points_to_image(np.zeros(4))
    with pytest.raises(ValueError, match="image: expected"):
        image_to_points(np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="image: expected"):
        image_to_points(np.zeros((4, 5)))


def test_points_too_near_are_left_out() -> None:
    points = image_to_points(
        np.full((8, 8), 255, dtype=np.uint8), pixel_size=1.0, max_range=5.0, min_range=2.0
    )
    gaps = np.hypot(*points.T)
    assert len(points) == 64 - 12 and gaps.min() >= 2.0


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 70.0, 90.0, 135.0])
def test_thin_points_lie_on_the_middle_of_a_stroke(angle_deg: float) -> None:
    y, x = np.mgrid[:129, :129] - 64.0
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    aside = c * y - s * x  # distance from a line through the middle [pixels]
    stroke = np.rint(255.0 * np.exp(-0.5 * (aside / 1.5) ** 2)).astype(np.uint8)
    options = {"pixel_size": 1.0, "max_range": 60.0}
    thick, thin = (image_to_points(stroke, thin=thin, **options) for thin in (False, True))
    assert 110 < len(thin) < 180 and len(thick) > 2.2 * len(thin)
    off = np.abs(c * -thin[:, 0] - s * -thin[:, 1])
    assert off.max() <= 0.75


def test_a_blob_thins_to_little_and_flat_ground_to_nothing() -> None:
    y, x = np.mgrid[:65, :65] - 32.0
    blob = np.rint(255.0 * np.exp(-0.5 * (x**2 + y**2) / 36.0)).astype(np.uint8)
    assert crest_pixels(blob)[blob >= 128].sum() < 0.5 * (blob >= 128).sum()
    assert not crest_pixels(np.full((20, 20), 200, dtype=np.uint8)).any()
