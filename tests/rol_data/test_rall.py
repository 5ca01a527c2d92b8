"""The readers of the real map, poses and odometry, and what they say of files that are at fault."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol_data import rall


def test_real_map_and_poses_belong_together(real_root: Path) -> None:
    points = rall.load_map_points(real_root / rall.MAP_PATH)
    poses = rall.load_poses(real_root / rall.POSES_PATH / "pose_xy_01.txt")
    assert points.shape == (399_468, 2) and poses.shape == (8_866, 3)
    assert points[:, 0].max() < 1500.0 and points[:, 1].max() < 800.0
    near = np.hypot(*(points - poses[4000, :2]).T)
    assert (near < 30.0).sum() > 200 and near.min() > 0.5  # a street with sides, and nothing on the lane


@pytest.mark.parametrize(
    ("place", "number", "n_points", "n_poses"),
    [("oxford", "10", 399_468, 8_197), ("kaist", "02", 411_501, 3_587), ("dcc", "02", 242_904, 3_026)],
)
def test_the_map_of_a_place_leaves_its_roads_free(
    real_root: Path, place: str, number: str, n_points: int, n_poses: int
) -> None:
    points = rall.load_map(real_root, place)
    poses = rall.load_poses(real_root / rall.PLACES[place].poses.format(number))
    assert len(points) == n_points and len(poses) == n_poses
    tree, road = cKDTree(points), poses[::10, :2]
    steps = ((0, 0), (10, 0), (-10, 0), (0, 10), (0, -10))  # wrong corners: the road leads through walls
    at, *beside = (np.mean(tree.query(road + step)[0] < 1.5) for step in steps)
    assert at < 0.3 and at < 0.7 * min(beside)


def test_riverside_is_asked_for_by_name(real_root: Path) -> None:
    if (real_root / rall.PLACES["riverside"].map_path).is_file():
        assert rall.load_map(real_root, "riverside")[:, 0].max() < 1800.0
    else:
        with pytest.raises(rall.RallError, match=r"laser_map_riverside.png: missing"):
            rall.load_map(real_root, "riverside")


def test_places_have_their_own_corner_and_size(tmp_path: Path) -> None:
    for place, (height, width), corner in (
        ("kaist", (4000, 4000), (500.0, 200.0)),
        ("dcc", (3200, 3275), (600.0, 200.0)),
        ("riverside", (8800, 8800), (1800.0, 1100.0)),
    ):
        path = tmp_path / rall.PLACES[place].map_path
        path.parent.mkdir(parents=True, exist_ok=True)
        image = np.zeros((height, width), dtype=np.uint8)
        image[4, 8] = 255
        cv2.imwrite(str(path), image)
        np.testing.assert_allclose(rall.load_map(tmp_path, place), [np.subtract(corner, (1.125, 2.125))])
        assert rall.find_real_root(tmp_path, place) == tmp_path and rall.find_real_root(tmp_path) is None
        cv2.imwrite(str(path), image[:-1])
        with pytest.raises(rall.RallError, match=f"laser_map_{place}.png: .*, so their places are not known"):
            rall.load_map(tmp_path, place)
    with pytest.raises(
        rall.RallError, match="place: 'paris' is unknown; there are oxford, kaist, dcc, riverside"
    ):
        rall.find_real_root(tmp_path, "paris")


def test_real_odometry_follows_the_real_poses(real_root: Path) -> None:
    steps = rall.load_odometry(real_root / rall.ODOMETRY_PATH / "seq02_odom.txt")
    poses = rall.load_poses(real_root / rall.POSES_PATH / "pose_xy_02.txt")
    n = len(poses) - 1
    way = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert np.hypot(steps[:n, 0], steps[:n, 1]).sum() == pytest.approx(way, rel=0.03)


def test_real_scan_poses(real_root: Path) -> None:
    poses = rall.load_scan_poses(rall.find_scan_poses(real_root))
    assert len(poses) == 11 and min(poses) == 1547131046353776
    np.testing.assert_allclose(poses[1547131046353776], [146.619, -10.956, -0.06091])


def test_real_scans_come_with_pose_and_velocity(real_root: Path, tmp_path: Path) -> None:
    scans = rall.load_scans(real_root)
    assert [scan.stamp_us for scan in scans] == sorted(scan.stamp_us for scan in scans) and len(scans) == 11
    assert scans[0].power.shape == (400, 3768) and scans[0].path.stem == str(scans[0].stamp_us)
    for before, after in pairwise(scans):
        seconds = (after.stamp_us - before.stamp_us) * 1e-6
        speed = np.hypot(*(after.pose - before.pose)[:2]) / seconds
        assert 0.5 * (before.twist[0] + after.twist[0]) == pytest.approx(speed, abs=0.25)
    # Without the official odometry the poses tell the velocity, and a scan that is far from all others has none.
    folder = tmp_path / rall.SCANS_PATH / "radar"
    folder.mkdir(parents=True)
    lines = ["timestamp_us,x_m,y_m,yaw_rad"]
    for scan in (*scans[:2], scans[-1]):
        (folder / scan.path.name).write_bytes(scan.path.read_bytes())
        lines.append(",".join(map(str, (scan.stamp_us, *scan.pose))))
    (tmp_path / rall.SCAN_POSES_PATH).write_text("\n".join(lines), encoding="utf-8")
    alone = rall.load_scans(tmp_path)
    assert alone[0].twist == pytest.approx(scans[0].twist, abs=0.3) and alone[2].twist is None


def test_real_scans_that_are_missing_are_told(tmp_path: Path) -> None:
    (tmp_path / rall.SCAN_POSES_PATH).write_text("timestamp_us,x_m,y_m,yaw_rad\n1,0,0,0\n", encoding="utf-8")
    with pytest.raises(rall.RallError, match="holds none of the 1 scans"):
        rall.load_scans(tmp_path)


@pytest.mark.parametrize(
    ("stamps_us", "groups"),
    [
        ([], []),
        ([5], [[0]]),
        ([0, 250_000, 500_000], [[0, 1, 2]]),
        ([0, 1_000_000, 2_000_001], [[0, 1], [2]]),  # a second is no gap yet
        ([0, 5_000_000, 5_250_000, 99_000_000], [[0], [1, 2], [3]]),
    ],
)
def test_scans_far_apart_are_no_drive(stamps_us: list[int], groups: list[list[int]]) -> None:
    assert rall.group_scans(stamps_us) == groups


def test_wider_gaps_may_be_allowed_and_disorder_is_told() -> None:
    assert rall.group_scans([0, 3_000_000], 3.0) == [[0, 1]]
    for stamps_us in ([0, 0], [0, 250_000, 1]):
        with pytest.raises(rall.RallError, match=f"scan {len(stamps_us) - 1}: its time"):
            rall.group_scans(stamps_us)


def test_find_real_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROL_REAL_ROOT", raising=False)
    assert rall.find_real_root() is None and rall.find_real_root(tmp_path) is None
    with pytest.raises(rall.RallError, match="real_root: there is no folder .*elsewhere"):
        rall.find_real_root(tmp_path / "elsewhere")
    path = tmp_path / "here" / rall.MAP_PATH
    path.parent.mkdir(parents=True)
    path.write_bytes(b"")
    assert rall.find_real_root(tmp_path / "here") == tmp_path / "here"
    monkeypatch.setenv("ROL_REAL_ROOT", str(tmp_path / "here"))
    assert rall.find_real_root() == tmp_path / "here"
    assert rall.find_real_root(tmp_path) is None  # what is asked for by name is not replaced
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "real").symlink_to(tmp_path / "here")
    monkeypatch.setenv("ROL_REAL_ROOT", str(tmp_path))
    assert rall.find_real_root() is None
    monkeypatch.delenv("ROL_REAL_ROOT")
    assert rall.find_real_root() == Path("data/real")


def test_scan_poses_come_with_the_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])
    shipped = rall.find_scan_poses(tmp_path)
    assert len(rall.load_scan_poses(shipped)) == 11
    (tmp_path / rall.SCAN_POSES_PATH).write_text("timestamp_us,x_m,y_m,yaw_rad\n1,0,0,0\n", encoding="utf-8")
    assert list(rall.load_scan_poses(rall.find_scan_poses(tmp_path))) == [1]


def test_map_cells_lie_where_the_readme_says(tmp_path: Path) -> None:
    image = np.zeros((40, 30), dtype=np.uint8)
    image[4, 8] = 255
    cv2.imwrite(str(tmp_path / "map.png"), image)
    x, y = rall.load_map_points(tmp_path / "map.png")[0]
    assert int((1500.0 - x) / 0.25) == 4 and int((800.0 - y) / 0.25) == 8


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (None, "missing"),
        ("", r"expected rows of three numbers"),
        ("1 2\n3 4\n", r"expected rows of three numbers"),
        ("1 2 three\n", "not a table of numbers"),
        ("0 0 0\n1 nan 0\n", "row 2 is not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_faulty_poses_are_named(tmp_path: Path, content: str | None, fault: str) -> None:
    path = tmp_path / "pose_xy_03.txt"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(rall.RallError, match=f"pose_xy_03.txt: .*{fault}"):
        rall.load_poses(path)


def test_faulty_maps_and_scan_poses_are_named(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    with pytest.raises(rall.RallError, match=r"map.png: missing or not an image"):
        rall.load_map_points(path)
    cv2.imwrite(str(path), np.zeros((4, 4), dtype=np.uint8))
    with pytest.raises(rall.RallError, match="holds no occupied cell"):
        rall.load_map_points(path)
    cv2.imwrite(str(path), np.full((4, 5), 255, dtype=np.uint8))
    with pytest.raises(rall.RallError, match=r"map.png: \(4, 5\) pixels instead of \(8000, 8000\)"):
        rall.load_map_points(path, rall.MAP_SHAPE)
    cv2.imwrite(str(path), np.full((4, 4), 128, dtype=np.uint8))
    with pytest.raises(rall.RallError, match=r"map.png: holds the value 128; 0 is free and 255 occupied"):
        rall.load_map_points(path)
    cv2.imwrite(str(path), np.zeros((4, 4, 3), dtype=np.uint8))
    with pytest.raises(rall.RallError, match="one grey channel"):
        rall.load_map_points(path)
    table = tmp_path / "poses.csv"
    with pytest.raises(rall.RallError, match=r"poses.csv: missing"):
        rall.load_scan_poses(table)
    for row, fault in (("12,1.0,2.0,nan", "all finite"), ("noon,1,2,3", "line 2")):
        table.write_text(f"timestamp_us,x_m,y_m,yaw_rad\n{row}\n", encoding="utf-8")
        with pytest.raises(rall.RallError, match=fault):
            rall.load_scan_poses(table)


def copy_posed_scan(real_root: Path, root: Path, n_poses: int, n_increments: int) -> str:
    """Link the scan of session 01 into another folder, with shortened ground truth and odometry; its name."""
    paths = sorted((real_root / rall.POSED_SCANS_PATH).glob("*.png"))
    if not paths:
        pytest.skip("no scan with a published pose under ROL_REAL_ROOT: run `make real`")
    for folder in (rall.POSED_SCANS_PATH, rall.SESSION_01_PATH / "gt", rall.POSES_PATH):
        (root / folder).mkdir(parents=True)
    (root / rall.POSED_SCANS_PATH / paths[0].name).symlink_to(paths[0].resolve())
    lengths = {rall.POSES_PATH / "pose_xy_01.txt": n_poses}
    lengths[rall.SESSION_01_PATH / "gt" / "radar_odometry.csv"] = 1 + n_increments
    for name, n in lengths.items():
        lines = (real_root / name).read_text(encoding="utf-8").splitlines(keepends=True)
        (root / name).write_text("".join(lines[:n]), encoding="utf-8")
    return paths[0].name


def test_a_scan_with_a_published_pose(real_root: Path, tmp_path: Path) -> None:
    name = copy_posed_scan(real_root, tmp_path, 700, 700)
    [scan] = rall.load_posed_scans(tmp_path)
    assert f"{scan.stamp_us}.png" == name == "1547120953445209.png"
    np.testing.assert_allclose(scan.pose, [474.22136, -38.90319, 1.84825], atol=1e-5)  # row 663
    assert np.rad2deg(scan.twist[2]) * 0.25 == pytest.approx(8.0, abs=0.5)  # per scan
    assert rall.load_posed_scans(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    ("n_poses", "n_increments", "fault"),
    [
        (663, 700, "1547120953445209.png: .* the 701 scans .*radar_odometry.csv with the 663 poses"),
        (700, 600, "1547120953445209.png: .* the 601 scans .* with the 700 poses of .*pose_xy_01.txt"),
    ],
)
def test_a_scan_without_a_published_pose_is_named(
    real_root: Path, tmp_path: Path, n_poses: int, n_increments: int, fault: str
) -> None:
    copy_posed_scan(real_root, tmp_path, n_poses, n_increments)
    with pytest.raises(rall.RallError, match=fault):
        rall.load_posed_scans(tmp_path)
