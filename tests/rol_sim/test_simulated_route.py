"""The world grown from a map and the trajectory along given poses, on a small map of known things."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from rol import oxford
from rol.geometry import relative_pose
from rol_data import rall
from rol_sim.drive import recorded_poses
from rol_sim.session import writer
from rol_sim.session.settings import SettingsError, load_settings, parse_settings
from rol_sim.session.simulation import build_counterparts, build_session, make_scan
from rol_sim.world import mapped
from rol_sim.world.mesh import Material

NAME = "sim-route-2019-01-10-12-32-52"
START = "2019-01-10T12:32:52"


def known_map() -> dict[str, np.ndarray]:
    """A house front of 30 m, a wall of 6 m, a shrubbery, a lonely post and a vehicle's outline."""
    rng = np.random.default_rng(1)
    return {
        "front": np.column_stack([np.arange(-10.0, 20.0, 0.25), np.full(120, 7.0)]),
        "wall": np.column_stack([np.arange(30.0, 36.0, 0.25), np.full(24, 9.0)]),
        "shrubs": np.unique(np.round(rng.normal((10.0, -18.0), (2.0, 2.0), (150, 2)) * 4.0) / 4.0, axis=0),
        "post": np.array([[30.0, -12.0]]),
        "vehicle": np.array(
            [[45.0, -9.0], [45.5, -9.25], [45.5, -8.5], [46.0, -8.0], [46.5, -8.5], [46.0, -9.0]]
        ),
    }


def drive_poses(n: int = 12) -> np.ndarray:
    """A car that stands for four scans and then drives on with up to 1.5 m a scan, in a slight bend."""
    x = np.concatenate([np.zeros(4), np.cumsum(np.linspace(0.2, 1.5, n - 4))])
    return np.column_stack([x, 0.004 * x**2, np.arctan(0.008 * x)])


@pytest.fixture(scope="module")
def small_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("real")
    image = np.zeros((8000, 8000), dtype=np.uint8)
    for points in (
        *known_map().values(),
        np.array([[3.1, 0.1], [6.1, 1.1]]),
    ):  # traces of traffic on the lane
        image[((1500.0 - points[:, 0]) / 0.25).astype(int), ((800.0 - points[:, 1]) / 0.25).astype(int)] = 255
    for path in (root / rall.MAP_PATH, root / rall.POSES_PATH / "pose_xy_02.txt"):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / rall.MAP_PATH), image)
    np.savetxt(root / rall.POSES_PATH / "pose_xy_02.txt", drive_poses())
    return root


def recipe(folder: Path, root: Path, **session: object) -> Path:
    own = {
        "start": START,
        "scans": 4,
        "poses": "02",
        "vehicles": 12,
        "people": 6,
        "sweeps": "none",
        **session,
    }
    section = {"world": "route", "real_root": str(root), "seed": 5, "sessions": {NAME: own}}
    path = folder / "route.yaml"
    path.write_text(yaml.safe_dump({"simulated": section}), encoding="utf-8")
    return path


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# ---- the world ----


def test_cells_are_taken_for_what_they_are() -> None:
    things = known_map()
    cells = mapped.classify_cells(np.concatenate(list(things.values())))
    ends = np.cumsum([len(points) for points in things.values()])
    kinds = dict(zip(things, np.split(cells.kinds, ends[:-1]), strict=True))
    assert (kinds["front"] == mapped.Kind.FACADE).mean() > 0.95
    assert (kinds["wall"] == mapped.Kind.WALL).mean() > 0.8
    assert (kinds["shrubs"] == mapped.Kind.PLANT).mean() > 0.9
    assert kinds["post"] == [mapped.Kind.POLE]
    assert (kinds["vehicle"] == mapped.Kind.VEHICLE).all()
    front = cells.headings[: len(things["front"])]
    assert np.abs(np.sin(front)).max() < 0.02
    for bad in (np.zeros((0, 2)), np.array([[0.0, np.nan]]), np.zeros((3, 3))):
        with pytest.raises(ValueError, match="map: expected"):
            mapped.classify_cells(bad)


def test_rows_lose_the_teeth_of_the_grid() -> None:
    x = np.arange(0.0, 20.0, 0.25)
    slanted = np.column_stack([x, np.round(0.3 * x * 4.0) / 4.0])
    cells = mapped.classify_cells(slanted)
    middle = (x > 3.0) & (x < 17.0)
    assert np.abs(slanted[:, 1] - 0.3 * x)[middle].max() > 0.1
    assert np.abs(cells.points[:, 1] - 0.3 * cells.points[:, 0])[middle].max() < 0.04


def test_a_week_changes_a_stated_share_and_leaves_the_walls() -> None:
    rng = np.random.default_rng(0)
    lonely = rng.uniform(-2000.0, 2000.0, (3000, 2))
    wall = np.column_stack([np.arange(0.0, 500.0, 0.25), np.full(2000, 5000.0)])
    cells = mapped.classify_cells(np.concatenate([lonely, wall]))
    later = mapped.change_cells(cells, np.random.default_rng(3), missing_fraction=0.2)
    is_row, was_row = later.kinds <= mapped.Kind.WALL, cells.kinds <= mapped.Kind.WALL
    assert 1.0 - (~is_row).sum() / (~was_row).sum() == pytest.approx(0.2, abs=0.03)
    assert 1.0 - is_row.sum() / was_row.sum() == pytest.approx(0.04, abs=0.02)


def test_what_the_map_does_not_show_is_the_same_on_all_days() -> None:
    cells = mapped.classify_cells(np.random.default_rng(0).uniform(-500.0, 500.0, (3000, 2)))
    drawn = mapped.draw_unmapped(cells, np.random.default_rng(4), fraction=0.5)
    assert len(np.unique(drawn.groups)) / len(np.unique(cells.groups)) == pytest.approx(0.5, abs=0.01)
    assert drawn.groups.min() > cells.groups.max()
    kept = mapped.crop_cells(drawn, np.zeros((1, 2)), 300.0, clear_m=40.0)
    gaps = np.hypot(*drawn.points.T)
    np.testing.assert_array_equal(kept.points, drawn.points[(gaps >= 40.0) & (gaps <= 300.0)])


def test_pieces_have_the_heights_and_materials_of_their_kind() -> None:
    cells = mapped.classify_cells(np.concatenate(list(known_map().values())))
    mesh = mapped.build_pieces(cells, seed=3)
    heights = {
        material: mesh.vertices[mesh.triangles[mesh.materials == material].ravel(), 2].max()
        for material in np.unique(mesh.materials)
    }
    assert 4.0 <= heights[Material.FACADE] <= 9.0 and 1.3 <= heights[Material.WALL] <= 2.8
    assert 1.0 <= heights[Material.METAL] <= 6.0 and 1.4 <= heights[Material.VEHICLE] <= 2.2
    assert {Material.HEDGE, Material.TREE_CROWN} <= set(heights)
    post = mapped.crop_cells(cells, np.array([[30.0, -12.0]]), 1.0)
    part = mapped.build_pieces(post, seed=3)
    own = mesh.triangles[mesh.objects == post.groups[0]]
    np.testing.assert_array_equal(part.vertices[part.triangles], mesh.vertices[own])


# ---- the trajectory ----


def test_drive_goes_through_the_poses_and_stands_where_they_stand() -> None:
    poses, stamps = drive_poses(), 10**15 + 250_000 * np.arange(12)
    trajectory = recorded_poses.interpolate_trajectory(stamps, poses)
    np.testing.assert_allclose(trajectory.pose(stamps), poses, atol=1e-3)
    assert np.abs(trajectory.speeds[(trajectory.stamps_us < stamps[2])]).max() < 0.3
    np.testing.assert_allclose(
        trajectory.velocity(stamps[9:10])[0], (poses[10] - poses[8])[:2] / 0.5, atol=0.15
    )
    assert trajectory.stamps_us[0] == stamps[0] - 1_000_000


def test_nobody_stands_or_drives_in_the_way() -> None:
    n = 400
    poses = np.column_stack([2.0 * np.arange(n), np.zeros(n), np.zeros(n)])
    stamps = 10**15 + 250_000 * np.arange(n)
    trajectory, rng = recorded_poses.interpolate_trajectory(stamps, poses), np.random.default_rng(2)
    taken = np.column_stack(
        [np.arange(0.0, 400.0, 0.5), np.full(800, 2.4)]
    )  # the first kerb is not free there
    parked = recorded_poses.park_vehicles(trajectory, taken, rng, parked_share=1.0, first_object=50)
    x, y = parked.vertices[:, 0], parked.vertices[:, 1]
    assert np.abs(y).min() > 1.1 and not ((y > 0.0) & (x > 5.0) & (x < 395.0)).any()
    assert parked.objects.min() == 50 and len(np.unique(parked.objects)) > 100
    traffic = recorded_poses.plan_encounters(trajectory, rng, vehicles_per_min=20, people_per_min=10)
    met = 0
    for stamp in stamps[::4]:
        own = trajectory.pose(np.array([stamp]))[0]
        numbers, there, velocities = traffic.bodies_at(stamp, own, 12.0)
        met += len(numbers)
        assert np.hypot(*velocities.T).max(initial=0.0) < 20.0
        for i, pose in zip(numbers, there, strict=True):
            size = np.abs(traffic.meshes[i].vertices[:, :2]).max(axis=0)
            apart = np.abs(relative_pose(own, pose)[:2])
            assert apart[0] > 2.2 + size[0] - 0.5 or apart[1] > 0.9 + size[1] - 0.4
    assert met > 20
    assert len(traffic.bodies_at(stamps[0] - 60_000_000, poses[0])[0]) == 0
    quiet = recorded_poses.plan_encounters(trajectory, rng, vehicles_per_min=0, people_per_min=0)
    assert len(quiet.bodies_at(stamps[100], poses[100], 8.0)[0]) == 0


# ---- sessions ----


def test_route_session_is_read_back_as_it_was_made(small_root: Path, tmp_path: Path) -> None:
    settings = load_settings(recipe(tmp_path, small_root, scans=0, sweeps="nearest"))
    folder = writer.write_session(settings, NAME, tmp_path)
    found, made = oxford.open_session(folder), build_session(settings, NAME)
    assert len(found.radar_stamps_us) == 12 and len(found.left_stamps_us) >= 12
    stamp = int(found.radar_stamps_us[7])
    raw = cv2.imread(
        str(folder / "radar" / f"{stamp}.png"), cv2.IMREAD_GRAYSCALE
    )  # the official rules, by hand
    scan = make_scan(made, 7)
    np.testing.assert_array_equal(raw[:, 11:], scan.power)
    np.testing.assert_array_equal(np.ascontiguousarray(raw[:, :8]).view("<i8").ravel(), scan.row_stamps_us)
    np.testing.assert_array_equal(
        np.ascontiguousarray(raw[:, 8:10]).view("<u2").ravel(), 13 + 14 * np.arange(400)
    )
    assert (raw[:, 10] == 255).all()
    odometry = oxford.compose_odometry(oxford.load_radar_odometry(found.odometry_path))[2]
    truth = relative_pose(drive_poses()[0], drive_poses()[: len(odometry)])
    assert np.abs(odometry - truth).max() < 0.1


def test_traces_of_traffic_on_the_map_do_not_stand_in_the_way(small_root: Path, tmp_path: Path) -> None:
    made = build_session(load_settings(recipe(tmp_path, small_root, scans=12, vehicles=0, people=0)), NAME)
    mesh = made.scene.static_mesh
    upright = mesh.vertices[mesh.triangles].mean(axis=1)
    upright = upright[upright[:, 2] > 0.2]
    gaps = np.hypot(*(upright[:, None, :2] - drive_poses()[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert gaps.min() > 1.0 and (gaps < 12.0).any()


def test_two_writers_killed_and_one_that_goes_on_give_the_same_bytes(
    small_root: Path, tmp_path: Path
) -> None:
    settings = load_settings(path := recipe(tmp_path, small_root, scans=8))
    command = [sys.executable, "-m", "rol_sim", str(path), "--jobs", "2", "--out"]
    killed = tmp_path / "killed"
    process = subprocess.Popen([*command, str(killed)], start_new_session=True, stdout=subprocess.DEVNULL)
    give_up = time.monotonic() + 120.0
    while len(list(killed.glob(f"{NAME}/radar/*.png"))) < 2 and time.monotonic() < give_up:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (killed / NAME / "session.json").exists()
    (killed / NAME / "radar" / ".1.png.99.tmp").write_bytes(b"half")  # what a write in progress leaves
    lines: list[str] = []
    whole = writer.write_session(settings, NAME, tmp_path / "whole", lines.append)
    assert "8 scans and 0 sweeps, about 0.00 GB in all" in lines[0] and lines[-1] == f"{NAME}: complete"
    assert digests(writer.write_session(settings, NAME, killed)) == digests(whole)
    assert not (whole / "velodyne_left").exists()


def test_a_disk_without_room_is_told_before_anything_is_written(
    small_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(writer.shutil, "disk_usage", lambda path: usage._replace(free=1_000_000))
    with pytest.raises(OSError, match=r"not enough disk space: 4 scans and 0 sweeps, .* 0.0 GB are free"):
        writer.write_session(load_settings(recipe(tmp_path, small_root)), NAME, tmp_path)
    assert not list((tmp_path / NAME / "radar").iterdir())


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"poses": ""}, "the key 'poses' is missing"),
        ({"poses": "77"}, r"pose_xy_77.txt: missing"),
        ({"scans": 13}, "12 poses from scan 0 on, 13 are asked for"),
        ({"first_scan": 10, "scans": 0}, "2 poses from scan 10 on, 3 are asked for"),
        ({"sweeps": "some"}, "sweeps: 'some' is none of"),
    ],
)
def test_faulty_route_settings_are_named(small_root: Path, tmp_path: Path, changes: dict, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        build_session(load_settings(recipe(tmp_path, small_root, **changes)), NAME)


def test_route_without_real_data_says_how_to_get_them(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"no real data in .*; run `make real` or set ROL_REAL_ROOT"):
        build_session(load_settings(recipe(tmp_path, tmp_path)), NAME)
    with pytest.raises(rall.RallError, match="real_root: there is no folder .*nowhere"):
        build_session(load_settings(recipe(tmp_path, tmp_path / "nowhere")), NAME)
    with pytest.raises(SettingsError, match="world: 'moon' is none of town, route"):
        parse_settings({"world": "moon"})
    with pytest.raises(SettingsError, match="scans: 0 is too few"):
        parse_settings({"sessions": {"sim-a": {"start": START, "scans": 0}}})


def test_counterparts_stand_where_the_real_scans_stood(real_root: Path) -> None:
    counterparts = build_counterparts(real_root, seed=2)
    known = rall.load_scan_poses(rall.find_scan_poses(real_root))
    np.testing.assert_array_equal(counterparts.scans_us, list(known))
    np.testing.assert_allclose(
        counterparts.trajectory.pose(counterparts.scans_us + 125_000), list(known.values()), atol=1e-4
    )
    assert make_scan(counterparts, 0).stamp_us == counterparts.scans_us[0]
