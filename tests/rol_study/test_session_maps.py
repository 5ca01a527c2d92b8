"""Scans that go into the map of a session, from files written by hand."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from rol.evaluation import write_tum
from rol_study import session_maps
from rol_study.session_maps import MappingScans, read_clouds, read_mapping_scans, read_simulated_poses


@pytest.fixture
def scans(monkeypatch, tmp_path):
    """Six scans, 0.4 m apart on a straight line, of which the alignment holds the last five."""
    stamps = np.arange(6) * 250_000
    poses = np.column_stack([0.4 * np.arange(6), np.zeros((6, 2))])
    drive = SimpleNamespace(root=tmp_path, odometry_path="odometry.csv")
    monkeypatch.setattr(session_maps, "open_session", lambda root: drive)
    monkeypatch.setattr(session_maps, "load_radar_odometry", lambda path: path)
    monkeypatch.setattr(session_maps, "compose_odometry", lambda odometry: (stamps, stamps, poses))
    table = pd.DataFrame({"radar_stamp_us": stamps[1:], "mid_stamp_us": stamps[1:] + 125_000})
    table["left_stamp_us"], table["right_stamp_us"] = stamps[1:] + 1, stamps[1:] + 2
    for name in ("vx_mps", "vy_mps", "yaw_rate_radps"):
        table[name] = 0.5
    table.to_csv(tmp_path / "alignment.csv", index=False)
    return lambda *limits: read_mapping_scans(tmp_path, tmp_path / "alignment.csv", *limits)


def test_one_scan_is_chosen_per_metre(scans):
    read = scans(1.0)
    assert isinstance(read, MappingScans) and len(read.alignment) == 5
    np.testing.assert_allclose(read.path_m, [0.0, 0.4, 0.8, 1.2, 1.6])
    np.testing.assert_allclose(read.poses[0], [0.4, 0.0, 0.0])
    assert read.chosen.tolist() == [0, 3]
    assert len(scans(1.0, 2).alignment) == 2


def test_clouds_have_no_ground_and_one_point_per_cell(scans, monkeypatch):
    asked = []

    def load_lidar_points(drive, left, right, *, mid_stamp_us, twist):
        asked.append((left, right, mid_stamp_us, twist))
        return np.array([[1.0, 1.0, 0.0, 9.0], [1.1, 1.1, 0.0, 9.0], [2.0, 2.0, -2.0, 9.0], [90.0, 0, 0, 9]])

    monkeypatch.setattr(session_maps, "load_lidar_points", load_lidar_points)
    clouds = list(read_clouds(scans(1.0), min_height=-1.5, max_range=64.0, cell=0.25))
    assert len(clouds) == 2 and clouds[0].dtype == np.float32
    np.testing.assert_allclose(clouds[0], [[1.05, 1.05]])
    assert asked[1] == (1_000_001, 1_000_002, 1_125_000, (0.5, 0.5, 0.5))


def test_simulated_poses_are_those_of_the_scans(scans, tmp_path):
    read = scans(1.0)
    assert read_simulated_poses(read) is None
    truth = np.column_stack([np.arange(6.0), np.arange(6.0), np.zeros(6)])
    write_tum(tmp_path / "truth.tum", np.arange(6) * 250_000, truth)
    np.testing.assert_allclose(read_simulated_poses(read), truth[1:], atol=1e-6)
