"""CFEAR's radar odometry: its frame, its number of poses, and files that are at fault."""

from pathlib import Path

import numpy as np
import pytest

from rol.evaluation import drift_by_length
from rol.geometry import accumulate_increments, relative_pose
from rol_data import cfear, rall

N_SCANS = {"01": 8866, "02": 8618}


def write_poses(path: Path, poses: np.ndarray) -> Path:
    """Write poses (y left, yaw counter-clockwise) as CFEAR does: y right, yaw clockwise."""
    rows = [
        (np.cos(yaw), np.sin(yaw), 0, x, -np.sin(yaw), np.cos(yaw), 0, -y, 0, 0, 1, 0) for x, y, yaw in poses
    ]
    np.savetxt(path, rows, fmt="%.9f")
    return path


@pytest.mark.parametrize("number", sorted(N_SCANS))
@pytest.mark.parametrize("variant", sorted(cfear.VARIANTS))
def test_real_increments_follow_the_ground_truth(real_root: Path, number: str, variant: str) -> None:
    path = cfear.find_cfear(real_root, number, variant)
    if not path.is_file():
        pytest.skip(f"{path} is not at hand")
    increments = cfear.load_cfear_increments(path, N_SCANS[number])
    poses = rall.load_poses(real_root / rall.PLACES["oxford"].poses.format(number))
    truth = relative_pose(poses[:-1], poses[1:])
    assert len(increments) == len(truth) - 1  # the last pose is missing

    def error(first: int) -> np.ndarray:  # with the rows shifted by one the errors of the heading are larger
        n = len(increments) - 2
        return np.median(np.abs(increments[1 : 1 + n] - truth[1 + first : 1 + first + n]), axis=0)

    assert error(0)[0] < 0.03 and error(0)[1] < 0.02 and error(0)[2] < 7e-4
    assert error(0)[2] < 0.8 * min(error(-1)[2], error(1)[2])
    drift = drift_by_length(accumulate_increments(increments), poses[:-1])
    assert 1.0 < drift.mean_translation_pct < 1.5


def test_the_frame_is_turned(tmp_path: Path) -> None:
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.3], [1.5, 0.9, 1.0]])
    path = write_poses(tmp_path / "00.txt", poses)
    np.testing.assert_allclose(cfear.load_cfear_poses(path), poses, atol=1e-8)
    increments = cfear.load_cfear_increments(path, 3)
    np.testing.assert_allclose(increments, relative_pose(poses[:-1], poses[1:]), atol=1e-8)


def test_a_pose_more_or_fewer_than_scans_is_allowed(tmp_path: Path) -> None:
    poses = np.column_stack([np.arange(6.0), np.zeros(6), np.zeros(6)])
    path = write_poses(tmp_path / "00.txt", poses)
    assert [len(cfear.load_cfear_increments(path, n)) for n in (5, 6, 7)] == [4, 5, 5]
    for n_scans in (4, 8):
        with pytest.raises(cfear.CfearError, match=f"00.txt: 6 poses for {n_scans} scans"):
            cfear.load_cfear_increments(path, n_scans)


def test_other_sessions_and_variants_are_refused(tmp_path: Path) -> None:
    with pytest.raises(cfear.CfearError, match=r"session 07 is not published; of sessions 01, 02 it is"):
        cfear.find_cfear(tmp_path, "07")
    with pytest.raises(
        cfear.CfearError, match=r"variant: 'cfear-2' is unknown; there are cfear-3, cfear-3-s50"
    ):
        cfear.find_cfear(tmp_path, "02", "cfear-2")
    with pytest.raises(cfear.CfearError, match=r"01.txt: missing"):
        cfear.load_cfear_poses(cfear.find_cfear(tmp_path, "02"))


GOOD = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("", "expected rows of twelve numbers"),
        ("1 0 0\n", r"expected rows of twelve numbers, got shape \(1, 3\)"),
        (GOOD + "one 0 0 0 0 1 0 0 0 0 1 0\n", "not a table of numbers"),
        (GOOD + "1 0 0 nan 0 1 0 0 0 0 1 0\n", "row 2 is not finite"),
        (GOOD + GOOD + "2 0 0 0 0 1 0 0 0 0 1 0\n", "row 3 holds no rotation in the plane"),
        (GOOD + "1 0 0 0 0 -1 0 0 0 0 1 0\n", "row 2 holds no rotation in the plane"),
        (GOOD + "1 0 0 0 0 1 0 0 0 0 1 3\n", "row 2 leaves the plane"),
        (GOOD + "1 0 0.5 0 0 1 0 0 0 0 1 0\n", "row 2 leaves the plane"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_faulty_files_are_named(tmp_path: Path, content: str, fault: str) -> None:
    path = tmp_path / "00.txt"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(cfear.CfearError, match=f"00.txt: .*{fault}"):
        cfear.load_cfear_poses(path)
