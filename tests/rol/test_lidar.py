"""Lidar: calibration, height threshold, crop."""

import numpy as np
import pytest

from rol.geometry import transform_from_euler
from rol.lidar import crop_range, ground_removal_tradeoff, relate_sensors, remove_ground, sweep_to_radar


def test_calibration_by_hand():
    """A lidar that faces backward, 1 m ahead of and 0.5 m below the radar."""
    T_vehicle_radar = transform_from_euler(-1.0, 0.0, 2.0, 0, 0, 0)
    T_vehicle_lidar = transform_from_euler(0.0, 0.0, 1.5, 0, 0, np.pi)
    T = relate_sensors(T_vehicle_radar, T_vehicle_lidar)
    points = np.array([[3.0, 2.0, 0.25, 17.0]], dtype=np.float32)
    np.testing.assert_allclose(sweep_to_radar(points, T), [[-2.0, -2.0, -0.25, 17.0]], atol=1e-12)
    assert points.dtype == np.float32 and points[0, 0] == 3.0
    np.testing.assert_allclose(relate_sensors(T_vehicle_lidar, T_vehicle_radar) @ T, np.eye(4), atol=1e-12)


def test_both_lidars_see_a_place_at_the_same_point():
    T_vehicle_radar = transform_from_euler(-0.7, -0.1, 0.5, 0.0, -0.05, 0.0)
    place = np.array([10.0, -4.0, 1.0])
    seen = []
    for x in (0.3, -0.6):
        T_vehicle_lidar = transform_from_euler(x, x, 0.2, 0.01, 0.04, 3.13)
        in_lidar = np.linalg.inv(T_vehicle_lidar) @ np.append(place, 1.0)
        seen.append(sweep_to_radar(in_lidar[None, :3], relate_sensors(T_vehicle_radar, T_vehicle_lidar)))
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-12)


def test_remove_ground_keeps_both_ends():
    points = np.array([[0, 0, -2.0], [1, 0, -1.5], [2, 0, 0.0], [3, 0, 4.0], [4, 0, 4.1], [5, 0, np.nan]])
    np.testing.assert_array_equal(remove_ground(points, -1.5, 4.0)[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(remove_ground(points, -1.5)[:, 0], [1, 2, 3, 4])
    assert remove_ground(points, 10.0).shape == (0, 3)
    with pytest.raises(ValueError, match="lies above"):
        remove_ground(points, 1.0, 0.0)
    with pytest.raises(ValueError, match=r"expected shape \(n, 3\)"):
        remove_ground(points[:, :2])


def test_crop_range_is_measured_in_the_plane():
    points = np.array([[3.0, 4.0, 100.0], [3.1, 4.0, 0.0], [0.5, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_array_equal(crop_range(points, 5.0, 1.0), points[:1])
    np.testing.assert_array_equal(crop_range(points[:, :2], 5.0), points[[0, 2], :2])


def test_ground_removal_tradeoff_by_hand():
    heights = np.array([-2.0, -1.9, -1.8, -1.4, -1.9, -1.0, 0.0, 1.0, 2.0])
    is_ground = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0], dtype=bool)
    ground, objects = ground_removal_tradeoff(heights, is_ground, np.array([-3.0, -1.8, -1.5, 3.0]))
    np.testing.assert_allclose(ground, [0.0, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(objects, [0.0, 0.2, 0.2, 1.0])
    for threshold, lost in zip([-1.8, -1.5], [3, 4], strict=True):  # the same rule as remove_ground's
        assert len(heights) - len(remove_ground(np.tile(heights[:, None], 3), threshold)) == lost
    assert np.isnan(ground_removal_tradeoff(heights, ~np.zeros(9, dtype=bool), np.array([0.0]))[1]).all()
    with pytest.raises(ValueError, match="labels"):
        ground_removal_tradeoff(heights, is_ground[:3], np.array([0.0]))
