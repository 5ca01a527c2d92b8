"""Poses in the plane and in space, with numbers worked out by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rol import geometry

QUARTER = np.pi / 2


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (np.pi, -np.pi),
        (-np.pi, -np.pi),
        (3 * QUARTER, -QUARTER),
        (-5 * QUARTER, -QUARTER),
        (7.0, 7 - 2 * np.pi),
    ],
)
def test_wrap_angle_lies_in_half_open_interval(angle, wrapped):
    assert_allclose(geometry.wrap_angle(angle), wrapped, atol=1e-12)
    assert_allclose(geometry.wrap_angle(np.array([angle, angle])), [wrapped, wrapped], atol=1e-12)


def test_compose_goes_in_the_direction_that_the_first_pose_looks():
    # From (1, 2), looking along +y, 2 m forward and 1 m to the left: (1 - 1, 2 + 2), yaw 90 + 90 = 180 deg.
    assert_allclose(geometry.compose([1, 2, QUARTER], [2, 1, QUARTER]), [0, 4, -np.pi], atol=1e-12)


def test_compose_broadcasts():
    many = geometry.compose([1, 2, QUARTER], [[1, 0, 0], [0, 1, 0]])
    assert_allclose(many, [[1, 3, QUARTER], [0, 2, QUARTER]], atol=1e-12)


def test_invert_by_hand_and_with_compose():
    # From (3, 0) looking along +y the origin lies 3 m to the left.
    assert_allclose(geometry.invert([3, 0, QUARTER]), [0, 3, -QUARTER], atol=1e-12)
    poses = np.array([[1, 2, 3], [-4, 0.5, -2.9], [0, 0, 0.1]])
    assert_allclose(geometry.compose(poses, geometry.invert(poses)), np.zeros((3, 3)), atol=1e-12)
    assert_allclose(geometry.compose(geometry.invert(poses), poses), np.zeros((3, 3)), atol=1e-12)


def test_relative_pose():
    # Both look along +y; the second is 2 m ahead and 1 m to the right.
    assert_allclose(geometry.relative_pose([5, 5, QUARTER], [6, 7, QUARTER]), [2, -1, 0], atol=1e-12)


def test_accumulate_steps_around_a_square():
    steps = [[2, 0, QUARTER]] * 4
    expected = [[0, 0, 0], [2, 0, QUARTER], [2, 2, -np.pi], [0, 2, -QUARTER], [0, 0, 0]]
    poses = geometry.accumulate_steps(steps)
    assert_allclose(poses[:, :2], np.array(expected)[:, :2], atol=1e-12)
    assert_allclose(np.abs(geometry.wrap_angle(poses[:, 2] - np.array(expected)[:, 2])), 0, atol=1e-12)


def test_accumulate_steps_agrees_with_compose_from_any_start():
    steps = np.random.default_rng(3).normal(size=(20, 3))
    pose = np.array([3.0, -1.0, 2.0])
    poses = geometry.accumulate_steps(steps, pose)
    for step, expected in zip(steps, poses[1:], strict=True):
        pose = geometry.compose(pose, step)
        assert_allclose(pose[:2], expected[:2], atol=1e-12)
        assert abs(geometry.wrap_angle(pose[2] - expected[2])) < 1e-12


def test_accumulate_no_steps_is_the_start():
    assert_allclose(geometry.accumulate_steps(np.zeros((0, 3)), (1, 2, 0.5)), [[1, 2, 0.5]])


def test_transform_points():
    # The pose looks along +y from (1, 2): forward 1 is (1, 3), left 1 is (0, 2).
    assert_allclose(
        geometry.transform_points([1, 2, QUARTER], [[1, 0], [0, 1]]), [[1, 3], [0, 2]], atol=1e-12
    )
    pose, points = np.array([1.0, 2.0, 0.7]), np.array([[3.0, 4.0], [-1.0, 0.0]])
    back = geometry.transform_points(geometry.invert(pose), geometry.transform_points(pose, points))
    assert_allclose(back, points, atol=1e-12)


def test_interpolation_takes_the_short_way_round():
    poses = [[0, 0, np.deg2rad(170)], [4, 8, np.deg2rad(-170)]]
    at = geometry.interpolate_poses([1000, 2000], poses, [1000, 1250, 1500, 2000])
    assert_allclose(at[:, :2], [[0, 0], [1, 2], [2, 4], [4, 8]], atol=1e-12)
    turned = geometry.wrap_angle(at[:, 2] - np.deg2rad([170, 175, 180, -170]))
    assert_allclose(turned, 0, atol=1e-12)


def test_interpolation_keeps_microseconds_of_real_stamps():
    stamps = np.array([1547120788016733, 1547120788264696])
    at = geometry.interpolate_poses(stamps, [[0, 0, 0], [247963, 0, 0]], stamps[:1] + 1)
    assert_allclose(at, [[1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("query", [999, 2001])
def test_interpolation_refuses_to_extrapolate(query):
    with pytest.raises(ValueError, match=f"{query} us lies outside .* 1000 .. 2000"):
        geometry.interpolate_poses([1000, 2000], np.zeros((2, 3)), [1500, query])


def test_interpolation_refuses_bad_times_and_poses():
    with pytest.raises(ValueError, match="do not increase at index 2"):
        geometry.interpolate_poses([1, 3, 3], np.zeros((3, 3)), [2])
    with pytest.raises(ValueError, match="3 stamps for 2 poses"):
        geometry.interpolate_poses([1, 2, 3], np.zeros((2, 3)), [2])
    with pytest.raises(ValueError, match="0 stamps for 0 poses"):
        geometry.interpolate_poses([], np.zeros((0, 3)), [2])


def test_check_poses_names_what_is_wrong():
    with pytest.raises(ValueError, match=r"truth: expected shape \(\.\.\., 3\).*\(2, 2\)"):
        geometry.check_poses(np.zeros((2, 2)), "truth")
    with pytest.raises(ValueError, match=r"poses: value at index \(1, 2\) is not finite"):
        geometry.check_poses([[0, 0, 0], [0, 0, np.nan]])
    assert geometry.check_poses([1, 2, 3]).dtype == np.float64


@pytest.mark.parametrize(
    ("angles", "forward", "left", "up"),
    [
        ((QUARTER, 0, 0), (1, 0, 0), (0, 0, 1), (0, -1, 0)),  # roll: left goes up
        ((0, QUARTER, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),  # pitch: forward goes down
        ((0, 0, QUARTER), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # yaw: forward goes left
        ((QUARTER, 0, QUARTER), (0, 1, 0), (0, 0, 1), (1, 0, 0)),  # roll first, then yaw
    ],
)
def test_rotation_moves_the_axes_as_worked_out_by_hand(angles, forward, left, up):
    R = geometry.rotation_from_euler(*angles)
    assert_allclose(R, np.array([forward, left, up]).T, atol=1e-12)


def test_transform_from_euler_and_points_in_space():
    T = geometry.transform_from_euler(1, 2, 3, 0, 0, QUARTER)
    assert_allclose(
        geometry.transform_points_3d(T, np.array([[1.0, 0, 0], [0, 1, 5]])),
        [[1, 3, 3], [0, 2, 8]],
        atol=1e-12,
    )


def test_flip_y_z_mirrors_y_z_pitch_and_yaw():
    T = geometry.transform_from_euler(1, 2, 3, 0.1, 0.2, 0.3)
    assert_allclose(
        geometry.flip_y_z(T), geometry.transform_from_euler(1, -2, -3, 0.1, -0.2, -0.3), atol=1e-12
    )
    assert_allclose(geometry.flip_y_z(geometry.flip_y_z(T)), T, atol=1e-12)


def test_first_of_cells_by_hand():
    points = np.array([[0.1, 0.1], [-0.1, 0.1], [0.2, 0.05], [5.0, 5.0], [0.1, 0.1], [5.1, 5.2]])
    np.testing.assert_array_equal(geometry.first_of_cells(points, 0.25), points[[0, 1, 3]])
    assert geometry.first_of_cells(np.zeros((0, 2)), 0.25).shape == (0, 2)
