"""Clouds for the real route: rendered scan by scan at the true poses, and motion taken out."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.geometry import transform_points
from rol.pix2pix import TrainedNetwork
from rol_beyond.front_ends import detect_points, evaluate_on_map
from rol_data import rall
from rol_study import rendered_points
from rol_study.rendered_points import build_segment, render_points, true_twists

pytestmark = pytest.mark.open3d
QUIET = {"vehicles": 0, "people": 0, "parked_share": 0.0}
NOBODY = TrainedNetwork(None, {}, {}, {})  # type: ignore[arg-type]  # the detector below asks no network


def drive_poses(n: int = 12) -> np.ndarray:
    """A car at 10 m/s in a slight bend."""
    x = 2.5 * np.arange(n)
    return np.column_stack([x, 0.002 * x**2, np.arctan(0.004 * x)])


@pytest.fixture(scope="module")
def small_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street with a house front on one side and posts on the other."""
    root = tmp_path_factory.mktemp("real")
    x = np.arange(-60.0, 90.0, 0.25)
    front = np.column_stack([x, np.full(len(x), 14.0)])
    posts = np.column_stack([np.arange(-60.0, 90.0, 12.0), np.full(13, -9.0)])
    image = np.zeros((8000, 8000), dtype=np.uint8)
    rows, columns = (((1500.0, 800.0) - np.concatenate([front, posts])) / 0.25).astype(int).T
    image[rows, columns] = 255
    for path in (root / rall.MAP_PATH, root / rall.POSES_PATH):
        (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / rall.MAP_PATH), image)
    for number in ("02", "07"):
        np.savetxt(root / rall.POSES_PATH / f"pose_xy_{number}.txt", drive_poses())
    return root


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Put a detector in the place of the network, and note what it was given."""
    given: list[Any] = []

    def detect(
        network: TrainedNetwork, power: np.ndarray, azimuths: np.ndarray, twist: Any, **how: Any
    ) -> Any:
        given.append((network, twist, how))
        return detect_points(power, azimuths, twist), None, None

    monkeypatch.setattr(rendered_points, "generate_points", detect)
    return given


def test_points_lie_on_the_map_at_their_poses(small_root: Path, asked: list[Any]) -> None:
    tree = cKDTree(rall.load_map_points(small_root / rall.MAP_PATH))
    session = build_segment(small_root, "02", 4, 5, 3, **QUIET)
    clouds = render_points(session, NOBODY, bf16=True, tta_rotations=2)
    assert isinstance(clouds, Iterator) and not asked  # nothing is rendered before it is asked for
    poses = drive_poses()[4:9]
    right, wrong = ([], [])
    for cloud, pose in zip(clouds, poses, strict=True):
        assert cloud.ndim == 2 and cloud.shape[1] == 2 and len(cloud) > 100
        near = cloud[np.abs(transform_points(pose, cloud)[:, 1] - 14.0) < 4.0]
        right.append(evaluate_on_map(near, pose, tree)["share_1m"])
        wrong.append(evaluate_on_map(near, pose + (0.0, 3.0, 0.0), tree)["share_1m"])
    assert np.mean(right) > 0.6 and np.mean(wrong) < 0.5 * np.mean(right)
    assert all(network is NOBODY and how == {"bf16": True, "tta_rotations": 2} for network, _, how in asked)
    speeds = np.array([twist for _, twist, _ in asked])
    np.testing.assert_allclose(speeds[:, 0], 10.0, atol=0.3)
    np.testing.assert_allclose(speeds[:, 2], 0.04, atol=0.01)


def test_a_seed_gives_the_same_points_one_scan_at_a_time(small_root: Path, asked: list[Any]) -> None:
    def take(number: str, seed: int) -> list[np.ndarray]:
        session = build_segment(small_root, number, 0, 12, seed)
        return list(itertools.islice(render_points(session, NOBODY), 2))

    one, again, other, day = take("02", 3), take("02", 3), take("02", 4), take("07", 3)
    assert len(asked) == 8  # two of twelve each time
    for cloud, same in zip(one, again, strict=True):
        np.testing.assert_array_equal(cloud, same)
    assert all(not np.array_equal(one[0], cloud) for cloud in (other[0], day[0]))


def test_velocities_are_those_of_the_poses(small_root: Path) -> None:
    session = build_segment(small_root, "02", 0, 0, 3, **QUIET)
    twists = true_twists(session)
    assert len(twists) == 12
    middles = session.scans_us + session.turns_us // 2
    np.testing.assert_allclose(session.trajectory.pose(middles), drive_poses(), atol=1e-3)
    np.testing.assert_allclose(
        twists[1:-1, 0], np.hypot(*session.trajectory.velocity(middles).T)[1:-1], rtol=0.02
    )


@pytest.mark.parametrize(
    ("number", "first", "n", "fault"),
    [
        ("77", 0, 5, r"pose_xy_77\.txt: missing"),
        ("02", 8, 5, r"pose_xy_02\.txt: 4 poses from scan 8 on, 5 are asked for"),
        ("02", 12, 0, r"pose_xy_02\.txt: 0 poses from scan 12 on"),
        ("02", -3, 3, r"pose_xy_02\.txt: .* first_scan: -3 is not a whole number in"),
        ("02", 0, -1, r"pose_xy_02\.txt: .* scans: -1 is not a whole number in"),
        ("02", 0, 2, r"pose_xy_02\.txt: .* scans: 2 is too few"),
    ],
)
def test_scans_that_are_not_there_are_refused_at_once(
    small_root: Path, number: str, first: int, n: int, fault: str
) -> None:
    with pytest.raises(ValueError, match=fault):
        build_segment(small_root, number, first, n, 3)


def test_other_faults_are_named(small_root: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no real data in"):
        build_segment(tmp_path, "02", 0, 3, 3)
    with pytest.raises(ValueError, match="unknown key 'clouds'"):
        build_segment(small_root, "02", 0, 3, 3, clouds=1)
