"""Local-map odometry on simulated drives with false points, motion distortion and the Doppler effect."""

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.evaluation import pose_errors, rmse
from rol.geometry import accumulate_increments, invert, relative_pose, transform_points
from rol.odometry import OdometryError, scan_to_scan_icp, stack_increments
from rol.radar import DOPPLER_SECONDS, SCAN_SECONDS, ScanMotion, peaks_to_points
from rol_beyond.local_map_odometry import (
    LocalMapSettings,
    MapSettings,
    PlausibilitySettings,
    RobustIcpSettings,
    build_local_map,
    deskew_cloud,
    local_map_odometry,
    register_robust,
)


def posts(n: int = 250) -> np.ndarray:
    """Points (n, 2) scattered over 60 m x 60 m, some 4 m apart: no two places look alike [m]."""
    return np.random.default_rng(0).uniform(-30.0, 30.0, (n, 2))


def street() -> np.ndarray:
    """Corners of house fronts, walls and posts along two streets that cross, shape (n, 2) [m]."""
    rng = np.random.default_rng(11)
    walls = []
    for x in np.arange(-60.0, 160.0, 13.0):
        for side in (-1.0, 1.0):
            begin, aside = x + rng.uniform(-2.0, 2.0), side * rng.uniform(7.0, 12.0)
            front = begin + np.arange(0.0, rng.uniform(5.0, 10.0), 0.3)
            depth = aside + side * np.arange(0.0, 6.0, 0.3)
            walls += [np.column_stack([front, np.full_like(front, aside)])]
            walls += [np.column_stack([np.full_like(depth, begin), depth])]
    return np.concatenate([*walls, rng.uniform((-60.0, -14.0), (160.0, 14.0), (150, 2))])


def test_deskew_cloud_by_hand():
    # at 10 m/s: what is ahead was seen 125 ms before mid-scan and 0.49 m too near; right 62.5 ms before, behind at
    # mid-scan and too far, left 62.5 ms after
    points = np.array([[20.0, 0.0], [0.0, -20.0], [-20.0, 0.0], [0.0, 20.0], [0.0, 0.0]])
    corrected = deskew_cloud(points, (10.0, 0.0, 0.0))
    expected = [[20.49 - 1.25, 0.0], [-0.625, -20.0], [-20.0 + 0.49, 0.0], [0.625, 20.0]]
    np.testing.assert_allclose(corrected[:4], expected, atol=1e-9)
    assert np.isfinite(corrected).all()
    with pytest.raises(OdometryError, match="cloud: point 1 is not finite"):
        deskew_cloud([[0.0, 1.0], [np.nan, 0.0]], (1.0, 0.0, 0.0))


def test_deskew_cloud_agrees_with_the_peaks_of_a_deskewed_scan():
    rng, azimuths, twist = np.random.default_rng(2), -2.0 * np.pi * np.arange(400) / 400, (8.0, 0.3, 0.4)
    rows, bins = rng.integers(0, 400, 500), rng.integers(60, 1400, 500)
    plain = peaks_to_points(rows, bins, azimuths)
    expected = peaks_to_points(rows, bins, azimuths, motion=ScanMotion(twist))
    ahead = rows == 0  # there a rounding decides between the first and the last moment of the turn
    np.testing.assert_allclose(deskew_cloud(plain, twist)[~ahead], expected[~ahead], atol=1e-9)


def test_local_map_keeps_the_mean_of_cells_that_were_seen_twice():
    settings = MapSettings(cell_m=1.0, min_views=2)
    clouds = [np.array([[0.0, 0.0], [0.2, 0.4], [5.0, 0.0]]), np.array([[0.4, 0.2]]), np.array([[9.0, 9.0]])]
    np.testing.assert_allclose(build_local_map(clouds, settings).cloud.points, [[0.2, 0.2]])
    one = build_local_map(clouds[:1], settings)  # of one cloud all is kept
    np.testing.assert_allclose(one.cloud.points, [[0.1, 0.2], [5.0, 0.0]])
    np.testing.assert_allclose(one.information, np.tile(np.eye(2), (2, 1, 1)))
    assert build_local_map([], settings) is None and build_local_map([np.zeros((0, 2))] * 3, settings) is None


def test_points_on_a_wall_constrain_across_it_only():
    wall = np.column_stack([np.arange(0.0, 10.0, 0.5), 0.5 * np.arange(0.0, 10.0, 0.5)])  # slope one half
    local_map = build_local_map([np.concatenate([wall, [[50.0, 0.0]]])], MapSettings(cell_m=0.25))
    along, across = np.array([2.0, 1.0]) / np.sqrt(5), np.array([-1.0, 2.0]) / np.sqrt(5)
    for point, metric in zip(local_map.cloud.points, local_map.information, strict=True):
        assert across @ metric @ across == pytest.approx(1.0)
        on_wall = 1.0 < point[0] < 9.0
        if on_wall or point[0] == 50.0:
            assert along @ metric @ along == pytest.approx(0.05 if on_wall else 1.0)


def test_lines_are_fitted_to_the_twelve_nearest_points():
    points = np.random.default_rng(4).uniform(0.0, 6.0, (200, 2)) * (1.0, 0.1)
    settings = MapSettings(cell_m=1e-3, line_radius_m=0.8, line_ratio=0.3)
    local_map = build_local_map([points], settings)
    distances, neighbours = cKDTree(points).query(local_map.cloud.points, 12)
    n_lines = 0
    for metric, near, rows in zip(local_map.information, distances < 0.8, neighbours, strict=True):
        (low, high), axes = np.linalg.eigh(np.cov(points[rows[near]].T, bias=True))
        is_line = near.sum() >= 5 and low < 0.3 * high
        n_lines += is_line
        np.testing.assert_allclose(
            metric, np.eye(2) - is_line * 0.95 * np.outer(axes[:, 1], axes[:, 1]), atol=1e-9
        )
    assert 20 < n_lines < 180


@pytest.mark.parametrize("along_weight", [0.05, 1.0])
def test_robust_registration_withstands_more_false_points_than_true_ones(along_weight):
    rng, motion = np.random.default_rng(3), np.array([1.2, -0.4, 0.05])
    target, settings = street(), RobustIcpSettings()
    source = transform_points(invert(motion), target)[::3] + rng.normal(0.0, 0.05, (len(target[::3]), 2))
    false = rng.uniform(-50.0, 50.0, (int(1.5 * len(source)), 2))
    result = register_robust(
        np.concatenate([false, source]),
        build_local_map([target], MapSettings(along_weight=along_weight)),
        np.zeros(3),
        settings,
    )
    assert (np.abs(result.T_target_source - motion) < (0.04, 0.04, 0.003)).all()


def test_robust_registration_without_a_match_says_so():
    settings = RobustIcpSettings()
    local_map = build_local_map([street()], MapSettings())
    for cloud in (street() + 900.0, np.zeros((0, 2)), np.full((50, 2), 4.0)):
        result = register_robust(cloud, local_map, (0.1, 0.2, 0.0), settings)
        assert not result.converged
    with pytest.raises(OdometryError, match="source cloud: point 3 is not finite"):
        register_robust(
            np.where(np.arange(8)[:, None] == 3, np.nan, street()[:8]), local_map, np.zeros(3), settings
        )


class Drive:
    """A vehicle on a winding path with changing speed; its scans are distorted by motion and the Doppler effect."""

    def __init__(self, n_scans: int = 40, first_s: float = 0.0) -> None:
        self.seconds = np.arange(0.0, 30.0, 1e-3)
        speed = 6.0 - 6.0 * np.cos(2.0 * np.pi * self.seconds / 14.0)  # 0 to 12 m/s
        self.velocity = np.column_stack([speed, 0.02 * speed * np.sin(self.seconds)])
        steps = np.column_stack([speed * 1e-3, np.zeros_like(speed), self.velocity[:, 1] * 1e-3])
        self.poses = accumulate_increments(steps[:-1])
        self.mid_s = 0.2 + first_s + SCAN_SECONDS * np.arange(n_scans)
        self.stamps_us = np.round(self.mid_s * 1e6).astype(np.int64)
        self.truth = self.at(self.mid_s)

    def at(self, seconds: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(seconds, self.seconds, column) for column in self.poses.T], axis=-1)

    def scan(self, mid_s: float, world: np.ndarray) -> np.ndarray:
        """Points as read: the moment of each is that at which the beam, clockwise from ahead, meets it."""
        moments = np.full(len(world), mid_s)
        for _ in range(6):
            x, y, yaw = self.at(moments).T
            dx, dy = world[:, 0] - x, world[:, 1] - y
            bearings = np.arctan2(dy, dx) - yaw
            moments = mid_s + (np.mod(-bearings, 2.0 * np.pi) / (2.0 * np.pi) - 0.5) * SCAN_SECONDS
        closing = np.interp(moments, self.seconds, self.velocity[:, 0]) * np.cos(bearings)
        ranges = np.hypot(dx, dy)
        read = ranges - DOPPLER_SECONDS * closing
        return np.column_stack([read * np.cos(bearings), read * np.sin(bearings)])[
            (3.0 < ranges) & (ranges < 50.0)
        ]

    def clouds(self, false_fraction: float, seed: int = 0) -> list[np.ndarray]:
        """One cloud per scan: 5 cm of noise, three quarters of the points, and false points."""
        rng, clouds = np.random.default_rng(seed), []
        for mid_s in self.mid_s:
            seen = self.scan(mid_s, street())
            seen = seen[rng.random(len(seen)) < 0.75]
            seen += rng.normal(0.0, 0.05, seen.shape)
            n_false = int(len(seen) * false_fraction / (1.0 - false_fraction))
            clouds.append(np.concatenate([seen, rng.uniform(-50.0, 50.0, (n_false, 2))]))
        return clouds

    def end_error(self, steps: np.ndarray) -> float:
        """Compute the position error at the end [m]."""
        end = accumulate_increments(steps, self.truth[0])[-1]
        return float(np.hypot(*(end - self.truth[-1])[:2]))


@pytest.mark.parametrize("false_fraction", [0.0, 0.5, 0.6])
def test_local_map_odometry_tracks_through_false_points_motion_and_doppler(false_fraction):
    drive = Drive()
    results = list(local_map_odometry(drive.clouds(false_fraction), drive.stamps_us))
    assert [r.fault for r in results] == [""] * 39
    errors = pose_errors(stack_increments(results), relative_pose(drive.truth[:-1], drive.truth[1:]))
    assert rmse(errors.position_m) < 0.12 and rmse(errors.yaw_rad) < np.deg2rad(0.3)
    assert drive.end_error(stack_increments(results)) < 0.5  # of 71 m


def test_local_map_odometry_drifts_less_than_scan_to_scan_icp_and_needs_deskewing():
    drive = Drive()
    clouds = drive.clouds(0.3)
    ours = stack_increments(local_map_odometry(clouds, drive.stamps_us))
    plain = stack_increments(local_map_odometry(clouds, drive.stamps_us, deskew=None))
    paper = stack_increments(scan_to_scan_icp(clouds))
    assert drive.end_error(ours) < 0.5 * min(drive.end_error(plain), drive.end_error(paper))


def test_compensated_clouds_need_no_deskewing():
    drive = Drive(12)
    twists = np.column_stack(
        [
            *(np.interp(drive.mid_s, drive.seconds, drive.velocity[:, 0]), np.zeros(12)),
            np.interp(drive.mid_s, drive.seconds, drive.velocity[:, 1]),
        ]
    )
    clouds = [deskew_cloud(c, twist) for c, twist in zip(drive.clouds(0.3), twists, strict=True)]
    assert drive.end_error(stack_increments(local_map_odometry(clouds, drive.stamps_us, deskew=None))) < 0.2


def test_a_first_velocity_is_found_or_given():
    drive = Drive(8, first_s=5.0)  # 10 to 12 m/s from the first scan on
    clouds = drive.clouds(0.5)
    for first_twist in (None, (10.5, 0.0, 0.0)):
        results = list(local_map_odometry(clouds, drive.stamps_us, first_twist=first_twist))
        assert not any(r.fault for r in results)
        assert drive.end_error(stack_increments(results)) < 0.4


@pytest.mark.parametrize("n_gone", [1, 5])
def test_empty_clouds_are_bridged_at_constant_velocity(n_gone):
    drive = Drive()
    clouds = drive.clouds(0.5)
    clouds[20 : 20 + n_gone] = [np.zeros((0, 2))] * n_gone
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == list(range(19, 19 + n_gone))
    for result in results[19 : 19 + n_gone]:
        assert result.fault == "0 % of the points match" and result.inlier_ratio == 0.0
        np.testing.assert_allclose(result.T_target_source, results[18].T_target_source, atol=1e-9)
    assert drive.end_error(stack_increments(results)) < 0.6


def test_the_local_map_is_started_again_after_a_long_time_without_a_match():
    drive = Drive()
    clouds = drive.clouds(0.3)
    clouds[10:24] = [np.zeros((0, 2))] * 14  # 3.5 s
    results = list(local_map_odometry(clouds, drive.stamps_us))
    # the first cloud with points, scan 24, can only begin a map
    assert [i for i, r in enumerate(results) if r.fault] == list(range(9, 24))
    last = stack_increments(results)[24:] - relative_pose(drive.truth[24:-1], drive.truth[25:])
    assert np.hypot(*last[:, :2].T).max() < 0.4


def test_clouds_without_points_at_the_start_are_waited_for():
    drive = Drive(8)
    clouds = drive.clouds(0.0)
    clouds[:3] = [np.zeros((0, 2))] * 3
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [bool(r.fault) for r in results] == [True] * 3 + [False] * 4


def test_implausible_motions_are_rejected():
    drive = Drive(20)
    clouds = drive.clouds(0.0)
    clouds[10] = transform_points((1.5, 0.0, 0.0), clouds[10])  # as if seen from 1.5 m farther back
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == [9]
    assert re.fullmatch(r"acceleration of \d\d m/s2", results[9].fault)
    assert drive.end_error(stack_increments(results)) < 0.3
    narrow = LocalMapSettings(plausibility=PlausibilitySettings(max_yaw_rate=0.05))
    faults = {r.fault for r in local_map_odometry(clouds, drive.stamps_us, narrow)}
    assert any(fault.startswith("yaw rate of ") and fault.endswith(" rad/s") for fault in faults)
    clouds = drive.clouds(0.0)
    clouds[10] = np.random.default_rng(6).uniform(-50.0, 50.0, clouds[10].shape)
    results = list(local_map_odometry(clouds, drive.stamps_us))
    assert [i for i, r in enumerate(results) if r.fault] == [9]
    assert results[9].fault.endswith("% of the points match") and results[9].inlier_ratio < 0.2


def test_local_map_odometry_of_one_or_no_cloud_is_empty():
    assert stack_increments(local_map_odometry([posts()], [0])).shape == (0, 3)
    assert stack_increments(local_map_odometry([], [])).shape == (0, 3)


@pytest.mark.parametrize(
    ("clouds", "stamps_us", "fault"),
    [
        ([posts()] * 3, [0, 250_000, 250_000], "stamps do not increase at index 2"),
        ([posts()] * 3, [[0, 1, 2]], r"stamps: expected shape \(m,\), got \(1, 3\)"),
        ([posts()] * 3, [0, 250_000], "2 stamps, but more clouds"),
        ([posts()] * 2, [0, 250_000, 500_000], "3 stamps for 2 clouds"),
        ([posts(), posts(), posts() * np.nan], [0, 250_000, 500_000], "cloud 2: point 0 is not finite"),
        (
            [posts(), np.zeros((5, 3))],
            [0, 250_000],
            r"cloud 1: expected points of shape \(n, 2\), got \(5, 3\)",
        ),
    ],
)
def test_local_map_odometry_refuses_bad_clouds_and_stamps(clouds, stamps_us, fault):
    with pytest.raises(OdometryError, match=fault):
        list(local_map_odometry(clouds, stamps_us))
