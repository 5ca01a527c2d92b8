"""MulRan's scans against a keyframe and a map: rigid fits, published poses, and the frame that they are in."""

from pathlib import Path

import numpy as np
import pytest

from rol.geometry import compose, invert, transform_points
from rol_data import mulran
from rol_study import mulran_scans

rng = np.random.default_rng(3)
STREET = np.vstack([
    np.column_stack([rng.uniform(-40.0, 40.0, 1500), np.repeat([7.0, -9.0, 15.0], 500)]),
    np.column_stack([np.repeat([-20.0, 12.0, 30.0], 200), rng.uniform(7.0, 15.0, 600)]),
])  # fmt: skip


def test_a_fit_finds_what_the_calibration_leaves() -> None:
    left = np.array([0.2, -0.15, np.deg2rad(1.1)])
    motion, score = mulran_scans.fit_cloud(transform_points(invert(left), STREET[::3]), STREET)
    np.testing.assert_allclose(motion[:2], left[:2], atol=0.02)
    assert np.rad2deg(motion[2]) == pytest.approx(1.1, abs=0.1) and score > 0.95


def test_precision_recall_and_chance_against_a_keyframe() -> None:
    points = {"good": STREET[::5], "bad": STREET[::5] + (0.0, 1.5), "none": np.zeros((0, 2))}
    table = mulran_scans.evaluate_on_keyframe(points, STREET).set_index("points")
    assert table.share_1m["good"] == 1.0 and table.reached_1m["good"] > 0.9
    assert table.share_1m["bad"] < 0.5 < table.share_2m["bad"]
    assert table.chance_1m["good"] < 0.6 * table.share_1m["good"]
    assert table.n["none"] == 0 and np.isnan(table.share_1m["none"]) and table.reached_1m["none"] == 0.0


def test_published_poses_are_interpolated() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    found = mulran_scans.poses_at(poses, 100.0, np.array([99.9, 100.25, 100.375, 100.75]))
    np.testing.assert_allclose(found[:, 0], [0.0, 0.0, 1.0, 4.0])
    with pytest.raises(ValueError, match="4 poses every 0.25 s do not cover the rows 0 .. 8"):
        mulran_scans.poses_at(poses, 100.0, np.array([100.0, 102.0]))


def test_the_frame_of_the_poses_is_found() -> None:
    frame = np.array([-0.6, 0.4, np.deg2rad(1.0)])
    poses = np.array([[100.0, 50.0, 0.3], [103.0, 51.0, 0.35]])
    map_points = transform_points(np.array([100.0, 50.0, 0.3]), STREET)
    clouds = [transform_points(invert(compose(pose, frame)), map_points) for pose in poses]
    found = mulran_scans.find_pose_frame(clouds, poses, map_points)
    np.testing.assert_allclose(found, [frame, frame], atol=0.05)


def test_the_real_scans(real_root: Path) -> None:
    if not (real_root / mulran.SCANS_PATH).is_dir():
        pytest.skip("no MulRan scans under ROL_REAL_ROOT: run `make real`")
    study = mulran_scans.evaluate_mulran(real_root, {}, lambda *_: None, every=20)
    raw = study.precision.loc["raw"]
    assert raw.share_1m > 0.7 and raw.share_1m_map > 0.8 and raw.chance_1m < 0.5 * raw.share_1m
    assert study.offsets.score.idxmax() == pytest.approx(-0.31)
    assert (
        study.frame.shape == (2, 3) and study.frame[0, 0] < -0.8
    )  # the published pose is ahead of the radar
    numbers = mulran_scans.describe_mulran(study, "cfar")
    assert numbers["mulran_raw_1m"] == 100 * raw.share_1m and numbers["best_offset_m"] == pytest.approx(-0.31)
    assert numbers["frame_first_m"] == -study.frame[0, 0]


def test_without_scans_there_are_no_numbers() -> None:
    numbers = mulran_scans.describe_mulran(None, "unet")
    assert {"mulran_1m", "mulran_raw_1m", "frame_deg"} <= set(numbers)
    assert np.isnan(list(numbers.values())).all()
