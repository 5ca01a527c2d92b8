"""Sessions with the sweeps of one lidar, as .bin files alone: real ones of the left lidar, and both sides by hand."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rol import oxford
from rol.pairs import (
    AlignedScan,
    PairSettings,
    align_scans,
    build_pair,
    estimate_twists,
    load_lidar_points,
    usable_sweeps,
)
from rol_sim.session import oxford_files
from rol_study.misalignment import measure_misalignment

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def left_only(real_root: Path, tmp_path_factory: pytest.TempPathFactory) -> oxford.Session:
    """Eleven real scans and the sweeps of the left lidar, of which there are .bin files only."""
    lidar = real_root / "oxford_car_visualiser2" / "data"
    if not lidar.is_dir():
        pytest.skip(f"{lidar}: not there")
    root = tmp_path_factory.mktemp("sessions") / "left-only"
    shutil.copytree(real_root / "RadarSLAMPy" / "data" / "tiny", root)
    shutil.copy(lidar / "velodyne_left.timestamps", root)
    (root / "velodyne_left").symlink_to(lidar / "binaries")
    return oxford.open_session(root)


def test_real_scans_are_paired_with_the_left_sweeps(left_only: oxford.Session) -> None:
    assert any("velodyne_right: missing" in fault for fault in oxford.check_session(left_only))
    odometry = oxford.load_radar_odometry(left_only.odometry_path)
    radar_us, mid_us, _ = oxford.compose_odometry(odometry)
    there = np.isin(radar_us, left_only.radar_stamps_us)
    scans = (radar_us[there], mid_us[there], estimate_twists(odometry)[there])
    sweeps_us = usable_sweeps(left_only)
    assert {side: len(stamps) for side, stamps in sweeps_us.items()} == {"left": 257}
    table = pd.DataFrame(align_scans(*scans, sweeps_us, motion="corrected"))
    assert len(table) == 11
    pair = build_pair(left_only, AlignedScan.from_row(table.iloc[5]), PairSettings("corrected"))
    assert np.hypot(*measure_misalignment(*pair, max_shift_px=16)) < 4.0  # of 0.25 m


def test_each_lidar_alone_is_read_with_its_own_mounting(left_only: oxford.Session) -> None:
    stamp = int(left_only.left_stamps_us[3])
    left = load_lidar_points(left_only, stamp, None)
    root = left_only.root.with_name("right-only")
    oxford_files.save_velodyne_binary(
        root / "velodyne_right" / f"{stamp}.bin", oxford.load_sweep(left_only, "velodyne_left", stamp)[0]
    )
    right_only = replace(left_only, root=root, left_stamps_us=None, right_stamps_us=np.array([stamp]))
    right = load_lidar_points(right_only, None, stamp)
    assert left.shape == right.shape and np.abs(left - right).max() > 0.5  # its own mounting
    with pytest.raises(oxford.OxfordError, match="the session has no velodyne_left"):
        load_lidar_points(right_only, stamp, stamp)
    with pytest.raises(ValueError, match=r"left_stamp_us and right_stamp_us are None"):
        load_lidar_points(right_only, None, None)


def test_chapter_1_draws_a_sweep_without_firings(left_only: oxford.Session, tmp_path: Path) -> None:
    nbformat, papermill = pytest.importorskip("nbformat"), pytest.importorskip("papermill")
    notebook = nbformat.read(ROOT / "notebooks" / "01_sessions.ipynb", as_version=4)
    nbformat.write(notebook, tmp_path / "in.ipynb")
    places = {"sessions_root": str(left_only.root.parent), "sessions": [left_only.name]}
    done = papermill.execute_notebook(
        tmp_path / "in.ipynb", tmp_path / "out.ipynb", places, progress_bar=False, cwd=ROOT
    )
    html = "".join(
        output.get("data", {}).get("text/html", "")
        for cell in done.cells
        for output in cell.get("outputs", [])
    )
    values = re.findall(r">([^<]+)</td>", re.search(r"lidar sweep, left</th>(.*?)</tr>", html, re.DOTALL)[1])
    assert values[0] == "–" and int(values[-1].replace(",", "")) > 10_000
