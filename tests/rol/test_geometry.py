"""Poses in the plane and in space, with numbers worked out by hand."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rol import geometry
from rol.maps import register_maps, to_first_map
from rol.mcl import MapGrid, MclSettings, MotionNoise, ParticleFilter, predict, sample_particles
from rol.odometry import icp_2d, scan_to_scan_icp
from rol.radar import ScanMotion, deskew_points

QUARTER = np.pi / 2
GRID = MapGrid(np.zeros((2, 2), np.uint8), np.zeros(2), 0.5)


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


def test_accumulate_increments_around_a_square():
    steps = [[2, 0, QUARTER]] * 4
    expected = [[0, 0, 0], [2, 0, QUARTER], [2, 2, -np.pi], [0, 2, -QUARTER], [0, 0, 0]]
    poses = geometry.accumulate_increments(steps)
    assert_allclose(poses[:, :2], np.array(expected)[:, :2], atol=1e-12)
    assert_allclose(np.abs(geometry.wrap_angle(poses[:, 2] - np.array(expected)[:, 2])), 0, atol=1e-12)


def test_accumulate_increments_agrees_with_compose_from_any_start():
    steps = np.random.default_rng(3).normal(size=(20, 3))
    pose = np.array([3.0, -1.0, 2.0])
    poses = geometry.accumulate_increments(steps, pose)
    for step, expected in zip(steps, poses[1:], strict=True):
        pose = geometry.compose(pose, step)
        assert_allclose(pose[:2], expected[:2], atol=1e-12)
        assert abs(geometry.wrap_angle(pose[2] - expected[2])) < 1e-12


def test_accumulate_no_steps_is_the_start():
    assert_allclose(geometry.accumulate_increments(np.zeros((0, 3)), (1, 2, 0.5)), [[1, 2, 0.5]])


def test_transform_points():
    # The pose looks along +y from (1, 2): forward 1 is (1, 3), left 1 is (0, 2).
    assert_allclose(
        geometry.transform_points([1, 2, QUARTER], [[1, 0], [0, 1]]), [[1, 3], [0, 2]], atol=1e-12
    )
    pose, points = np.array([1.0, 2.0, 0.7]), np.array([[3.0, 4.0], [-1.0, 0.0]])
    back = geometry.transform_points(geometry.invert(pose), geometry.transform_points(pose, points))
    assert_allclose(back, points, atol=1e-12)


def test_exp_in_closed_form():
    assert_allclose(geometry.exp([2.0, 0.0, 0.0], 3.0), [6.0, 0.0, 0.0])
    assert_allclose(geometry.exp([1.0, 0.0, QUARTER]), [1 / QUARTER, 1 / QUARTER, QUARTER])
    # A sideways velocity, one second back: a quarter turn clockwise on a circle of the same radius.
    assert_allclose(geometry.exp([0.0, 1.0, QUARTER], [-1.0]), [[-1 / QUARTER, -1 / QUARTER, -QUARTER]])


def test_exp_is_the_limit_of_many_small_steps():
    twist, n = np.array([[9.0, -0.4, 0.7], [-3.0, 0.2, -2.0]]), 100_000
    for one, pose in zip(twist, geometry.exp(twist, 0.5), strict=True):
        poses = geometry.accumulate_increments(np.tile(one * 0.5 / n, (n, 1)))
        assert_allclose(poses[-1], pose, atol=2e-5)


def test_log_inverts_exp_for_less_than_a_full_turn():
    twists = np.random.default_rng(4).uniform([-20, -2, -6.2], [20, 2, 6.2], (200, 3))
    assert_allclose(geometry.log(geometry.exp(twists)), twists, atol=1e-9)
    assert_allclose(geometry.exp(geometry.log([1.5, 0.1, 0.0])), [1.5, 0.1, 0.0], atol=1e-15)
    assert geometry.log(twists.reshape(10, 20, 3)).shape == (10, 20, 3)


def test_check_points_names_what_is_wrong():
    for points in (np.zeros(3), np.zeros((4, 3)), np.zeros((4, 1))):
        with pytest.raises(ValueError, match=r"cloud: expected points of shape \(n, 2\), got"):
            geometry.check_points(points, "cloud")
    with pytest.raises(KeyError, match="map: point 1 is not finite"):
        geometry.check_points([[0, 0], [0, np.inf], [np.nan, 0]], "map", error=KeyError)
    with pytest.raises(ValueError, match=r"points of shape \(n, 3\) or more columns, got \(4, 2\)"):
        geometry.check_points(np.zeros((4, 2)), columns=3, more=True)


def test_check_points_gives_float64():
    points = geometry.check_points(np.array([[1, 2, np.nan], [3, 4, 0]], np.float32).T[:2].T)
    assert points.dtype == np.float64 and points.flags.c_contiguous and points.tolist() == [[1, 2], [3, 4]]
    assert geometry.check_points([[1, 2, np.nan]], more=True).shape == (1, 3)
    assert geometry.check_points([]).shape == (0, 2)


def test_check_poses_names_what_is_wrong():
    with pytest.raises(ValueError, match=r"truth: expected shape \(\.\.\., 3\).*\(2, 2\)"):
        geometry.check_poses(np.zeros((2, 2)), "truth")
    with pytest.raises(ValueError, match=r"poses: value at index \(1, 2\) is not finite"):
        geometry.check_poses([[0, 0, 0], [0, 0, np.nan]])
    assert geometry.check_poses([1, 2, 3]).dtype == np.float64
    for bad in (["a", 0, 0], [[0, 0, 0], [0, 0]], [None, {}, 0]):
        with pytest.raises(ValueError, match="start: not an array of numbers"):
            geometry.check_pose(bad, "start")


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.zeros((1, 3)), np.zeros(2), 0.0])
@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda pose: geometry.accumulate_increments(np.zeros((4, 3)), pose), "start"),
        (lambda pose: geometry.transform_points(pose, np.zeros((4, 2))), "T_a_b"),
        (lambda pose: icp_2d(np.zeros((4, 2)), np.zeros((4, 2)), pose), "initial guess"),
        (lambda pose: list(scan_to_scan_icp([np.zeros((4, 2))] * 2, pose)), "first guess"),
        (lambda pose: register_maps(np.zeros((4, 2)), np.zeros((4, 2)), pose), "initial guess"),
        (lambda pose: to_first_map(pose, np.zeros((4, 3))), "T_map_session"),
        (lambda pose: sample_particles(pose, 4, 1.0, 0.1, np.random.default_rng(1)), "start pose"),
        (lambda pose: predict(np.zeros((4, 3)), pose, MotionNoise(), np.random.default_rng(1)), "odometry"),
        (lambda pose: ParticleFilter(GRID, pose, MclSettings(), np.random.default_rng(1)), "start pose"),
        (lambda pose: deskew_points(np.zeros((4, 2)), np.zeros(4), pose), "twist"),
        (lambda pose: ScanMotion(pose), "twist"),
    ],
)
def test_one_pose_is_asked_for_by_its_name(call, name, bad):
    with pytest.raises(ValueError, match=rf"{name}.*: expected shape .*3\)"):
        call(bad)


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
    R = geometry.transform_from_euler(0, 0, 0, *angles)[:3, :3]
    assert_allclose(R, np.array([forward, left, up]).T, atol=1e-12)


def test_transform_in_space_is_asked_for_by_its_name():
    for bad in (np.zeros(3), np.eye(3)):
        with pytest.raises(ValueError, match=r"T_a_b: expected a transform of shape \(4, 4\), got \(3"):
            geometry.transform_points_3d(bad, np.zeros((2, 3)))


def test_transform_from_euler_and_points_in_space():
    T = geometry.transform_from_euler(1, 2, 3, 0, 0, QUARTER)
    assert_allclose(
        geometry.transform_points_3d(T, np.array([[1.0, 0, 0], [0, 1, 5]])),
        [[1, 3, 3], [0, 2, 8]],
        atol=1e-12,
    )


def test_first_of_cells_by_hand():
    points = np.array([[0.1, 0.1], [-0.1, 0.1], [0.2, 0.05], [5.0, 5.0], [0.1, 0.1], [5.1, 5.2]])
    np.testing.assert_array_equal(geometry.first_of_cells(points, 0.25), points[[0, 1, 3]])
    assert geometry.first_of_cells(np.zeros((0, 2)), 0.25).shape == (0, 2)


def test_flags_must_be_true_or_false():
    @dataclass
    class Flags:
        on: "bool" = False

    geometry.check_fields(Flags(True), {})
    for value in ("no", 1, None):
        with pytest.raises(ValueError, match="on: .* is neither True nor False"):
            geometry.check_fields(Flags(value), {})
