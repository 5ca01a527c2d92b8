"""The whole method from radar to the tables: kept points, both filters, an unknown start, the command."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
import torch

from rol.evaluation import read_metrics, read_tum
from rol.geometry import accumulate_increments, compose, invert, relative_pose, transform_points
from rol.oxford import OxfordError, RadarOdometry
from rol.pairs import save_image
from rol.pix2pix import TrainedNetwork
from rol.radar import SDK, polar_to_cartesian
from rol_beyond.front_ends import detect_points
from rol_data import rall
from rol_sim.session import oxford_files
from rol_sim.session.simulation import make_scan
from rol_study import end_to_end, seq01
from rol_study.end_to_end import EndToEndError, RadarSession, Run, keep_points, open_oxford
from rol_study.rendered_points import build_segment

QUIET = {"vehicles": 0, "people": 0, "parked_share": 0.0}
NOBODY = TrainedNetwork(torch.nn.Linear(1, 1), {}, {}, {})  # type: ignore[arg-type]  # asked for nothing below
N = 72


def drive_poses(n: int) -> np.ndarray:
    """A car at 8 m/s in a bend."""
    return accumulate_increments(np.tile([2.0, 0.0, 0.012], (n - 1, 1)), (-60.0, -20.0, -0.4))


def build_walls(track: np.ndarray, seed: int = 4) -> np.ndarray:
    """Walls of random length and direction, none within 5 m of a track."""
    rng = np.random.default_rng(seed)
    low, high = track[:, :2].min(axis=0) - 60.0, track[:, :2].max(axis=0) + 60.0
    middles, angles = rng.uniform(low, high, (400, 2)), rng.uniform(0.0, np.pi, 400)
    along = np.linspace(-1.0, 1.0, 33)[None, :, None] * rng.uniform(2.0, 7.0, 400)[:, None, None]
    walls = (middles[:, None] + along * np.column_stack([np.cos(angles), np.sin(angles)])[:, None]).reshape(
        -1, 2
    )
    gaps = np.hypot(*(walls[:, None] - track[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    return walls[gaps > 5.0]


@pytest.fixture(scope="module")
def walls() -> np.ndarray:
    return build_walls(drive_poses(N))


@pytest.fixture
def session(walls: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> RadarSession:
    """A session whose points are those of the walls, a third of them false; no network is asked."""
    truth = drive_poses(N)

    def look(network: TrainedNetwork, power: int, azimuths: Any, twist: Any, **how: Any) -> Any:
        rng = np.random.default_rng(power)
        near = transform_points(invert(truth[power]), walls)
        near = near[np.hypot(*near.T) < 40.0]
        seen = rng.choice(near, min(300, len(near)), replace=False) + rng.normal(
            0.0, 0.15, (min(300, len(near)), 2)
        )
        return np.concatenate([seen, rng.uniform(-40.0, 40.0, (150, 2))]), None, None

    monkeypatch.setattr(end_to_end, "generate_points", look)
    stamps = np.arange(N, dtype=np.int64) * 250_000
    return RadarSession("drawn", stamps, lambda k: SimpleNamespace(power=k, azimuths=None), truth)


# ---- points are kept ------------------------------------------------------------------------------------------


def test_a_stopped_run_goes_on_and_makes_nothing_twice(session: RadarSession, tmp_path: Path) -> None:
    asked: list[int] = []

    def stop_at(last: int) -> RadarSession:
        def load_scan(index: int) -> Any:
            if index == last:
                raise KeyboardInterrupt
            asked.append(index)
            return session.load_scan(index)

        return replace(session, load_scan=load_scan)

    whole = keep_points(session, NOBODY, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        keep_points(stop_at(60), NOBODY, tmp_path / "raw")
    assert [path.name for path in sorted((tmp_path / "raw").glob("*.npz"))] == ["000000.npz"]
    asked.clear()
    lines: list[str] = []
    clouds = keep_points(stop_at(-1), NOBODY, tmp_path / "raw", report=lines.append)
    assert asked == list(range(50, N)) and len(lines) == 1 and f"{N} of {N}" in lines[0]
    assert len(clouds) == N and all(len(cloud) > 200 for cloud in clouds)
    for k in (0, 49, 50, N - 1):
        np.testing.assert_array_equal(clouds[k], whole[k])
    with pytest.raises(IndexError):
        clouds[N]


def test_points_of_other_scans_networks_and_velocities_are_made_anew(
    session: RadarSession, tmp_path: Path
) -> None:
    keep_points(session, NOBODY, tmp_path)
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    twists = np.zeros((N, 3))
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}

    def changed() -> set[str]:
        now = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
        names = {name for name in now if before.get(name) != now[name]}
        before.clear()
        before.update(now)
        return names

    for own, network, velocity, expected in (
        (session, NOBODY, None, set()),
        (session, replace(NOBODY, generator=torch.nn.Linear(1, 1)), None, {"000000.npz", "000050.npz"}),
        (replace(session, name="other"), NOBODY, None, {"000000.npz", "000050.npz"}),
        (replace(session, name="other"), NOBODY, twists, {"000000.npz", "000050.npz"}),
        (replace(session, name="other"), NOBODY, twists + (np.arange(N) >= 50)[:, None], {"000050.npz"}),
        # The first scans alone: a file is kept when its velocities are those wanted.
        (replace(session, name="other", stamps_us=session.stamps_us[:50]), NOBODY, twists[:50], set()),
    ):
        keep_points(own, network, tmp_path, velocity)
        assert changed() == expected
    assert (tmp_path / "notes.txt").is_file()


# ---- both filters, and an unknown start -----------------------------------------------------------------------


@pytest.fixture
def measured(session: RadarSession, walls: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> RadarSession:
    """The session with a map and a reference contrast in the place of the real ones."""
    monkeypatch.setattr(seq01, "load_map_points", lambda path, shape: walls)
    monkeypatch.setattr(end_to_end, "measure_contrast", lambda *given: 0.18)
    return session


def test_both_methods_localize_a_session_with_ground_truth(measured: RadarSession, tmp_path: Path) -> None:
    lines: list[str] = []
    table = seq01.run_session(measured, NOBODY, tmp_path, tmp_path / "out", 1, lines.append)
    assert table.method.tolist() == ["paper", "robust"] and (table.n_scans == N).all()
    assert (table.rmse_m < 0.3).all() and (table.failures == 0).all()
    assert (table.points_share_1m > 0.55).all() and (table.points_n > 200).all()
    for method, row in table.set_index("method").iterrows():
        folder = tmp_path / "out" / "drawn" / method
        assert read_metrics(folder / "metrics.json")["rmse_m"] == pytest.approx(row.rmse_m)
        stamps, poses = read_tum(folder / "trajectory.tum")
        assert len(stamps) == N and np.abs(poses - measured.truth)[:, :2].max() < 1.0
    assert any("ParticleFilter" in line for line in lines) and any("raw points" in line for line in lines)
    again: list[str] = []
    pd.testing.assert_frame_equal(
        seq01.run_session(measured, NOBODY, tmp_path, tmp_path / "out", 1, again.append).drop(
            columns="update_ms_median"
        ),
        table.drop(columns="update_ms_median"),
    )
    assert not any("points" in line for line in again)


def test_an_unknown_start_is_found_and_judged_by_the_official_odometry(
    measured: RadarSession, tmp_path: Path
) -> None:
    moved = compose(np.array([500.0, -300.0, 2.0]), measured.truth)
    unknown, lines = replace(measured, truth=None, official=moved), []
    table = seq01.run_session(unknown, NOBODY, tmp_path, tmp_path, 1, lines.append).set_index("method")
    assert any("start found at scan" in line for line in lines)
    assert table.n_scans["paper"] == N and N - 40 < table.n_scans["robust"] < N
    assert (table.rmse_m < 0.3).all() and (table.failures == 0).all()
    fitted = read_tum(tmp_path / "drawn" / "paper" / "truth.tum")[1]
    x, y, yaw = np.abs(relative_pose(measured.truth, fitted)).T
    assert x.max() < 0.15 and y.max() < 0.15 and yaw.max() < 0.005  # not where the first estimates were


def run_of(poses: np.ndarray, is_lost: np.ndarray) -> Run:
    return Run(poses, is_lost, np.zeros(len(poses)), [])


def test_a_start_counts_after_two_seconds_and_never_is_an_error() -> None:
    is_lost = np.ones(40, dtype=bool)
    is_lost[[3, 4, 5, 20, 21, 22, 23, 24, 25, 26, 27, 28]] = False
    assert end_to_end.find_start(run_of(np.zeros((40, 3)), is_lost)) == 27
    for never in (np.ones(40, dtype=bool), np.zeros(7, dtype=bool)):
        with pytest.raises(EndToEndError, match=f"not found in {len(never)} scans"):
            end_to_end.find_start(run_of(np.zeros((len(never), 3)), never))


def test_the_fit_ignores_where_the_filter_was_wrong() -> None:
    truth = drive_poses(N)
    estimate = truth + np.random.default_rng(2).normal(0.0, 0.05, truth.shape)
    estimate[10:20, 0] += 70.0
    official = compose(np.array([30.0, 5.0, -1.0]), truth)
    fitted = end_to_end.fit_official(official, run_of(estimate, np.zeros(N, dtype=bool)), 5)
    assert np.abs(relative_pose(truth, fitted)).max() < 0.03
    failures = end_to_end.find_failures(np.arange(N) * 1_000_000, estimate, fitted)
    assert failures == [15]  # five seconds after the error began


# ---- folders --------------------------------------------------------------------------------------------------


def write_oxford(folder: Path, segment: Any, n: int) -> np.ndarray:
    """Write raw scans and official odometry, and nothing else; return the true poses."""
    stamps, middles = segment.scans_us, segment.scans_us + segment.turns_us // 2
    for index in range(n):
        oxford_files.save_radar(folder / "radar" / f"{stamps[index]}.png", make_scan(segment, index))
    oxford_files.save_timestamps(folder / "radar.timestamps", stamps)
    truth = segment.trajectory.pose(middles)
    steps = np.zeros((n - 2, 6))
    steps[:, [0, 1, 5]] = relative_pose(truth[: n - 2], truth[1 : n - 1])
    odometry = RadarOdometry(middles[1:-1], middles[:-2], stamps[1:-1], stamps[:-2], steps)
    oxford_files.save_radar_odometry(folder / "gt" / "radar_odometry.csv", odometry)
    return truth


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, np.ndarray]:
    """A map in the real one's form, and a simulated session on it: raw radar and official odometry only."""
    root, n = tmp_path_factory.mktemp("real"), 38
    truth, image = drive_poses(n), np.zeros(rall.MAP_SHAPE, dtype=np.uint8)
    rows, columns = ((np.array(rall.MAP_CORNER) - build_walls(truth)) / rall.MAP_CELL).astype(int).T
    image[rows, columns] = 255
    for path in (root / rall.MAP_PATH, root / rall.POSES_PATH / "pose_xy_02.txt"):
        path.parent.mkdir(parents=True)
    cv2.imwrite(str(root / rall.MAP_PATH), image)
    np.savetxt(root / rall.POSES_PATH / "pose_xy_02.txt", truth)
    segment = build_segment(root, "02", 0, 0, 3, **QUIET)
    folder = root / "raw"
    return root, folder, write_oxford(folder, segment, n)


@pytest.fixture
def peaks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Radar peaks in the place of the network's points."""

    def detect(network: Any, power: np.ndarray, azimuths: np.ndarray, twist: Any, **how: Any) -> Any:
        return detect_points(power, azimuths, twist), None, None

    monkeypatch.setattr(end_to_end, "generate_points", detect)
    monkeypatch.setattr(seq01, "load_network", lambda path: NOBODY)


@pytest.mark.open3d
@pytest.mark.usefixtures("peaks")
def test_a_folder_of_raw_scans_is_localized_without_a_start(
    town: tuple[Path, Path, np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    root, folder, truth = town
    monkeypatch.setattr(end_to_end, "measure_contrast", lambda *given: 0.15)
    words = ["--real-root", str(root), "--session", str(folder), "--out", str(tmp_path)]
    assert seq01.main(words) == 0
    printed = capsys.readouterr().out
    assert "start found at scan" in printed and "published" not in printed
    table = pd.read_csv(tmp_path / "raw" / "results.csv").set_index("method")
    assert (table.rmse_m < 0.6).all() and (table.failures == 0).all()
    # The last scan has no pose in the official odometry.
    fitted = read_tum(tmp_path / "raw" / "paper" / "truth.tum")[1]
    assert len(fitted) == len(truth) - 1
    assert np.hypot(*relative_pose(truth[:-1], fitted)[:, :2].T).max() < 0.6


@pytest.mark.open3d
def test_a_folder_with_holes_is_refused(
    town: tuple[Path, Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root, folder, _ = town
    copy = tmp_path / "raw"
    shutil.copytree(folder, copy)
    session = open_oxford(copy, max_scans=10)
    assert len(session.stamps_us) == len(session.official) == 10 and session.truth is None
    scans = sorted((copy / "radar").glob("*.png"))
    scans[5].unlink()
    with pytest.raises(EndToEndError, match=f"{scans[5].name}: missing between scans"):
        open_oxford(copy)
    for path in scans[7:]:
        path.unlink()
    for path in scans[:5]:
        path.unlink()
    with pytest.raises(EndToEndError, match="raw: 1 scans have a file and a pose of radar_odometry.csv"):
        open_oxford(copy)
    (copy / "gt" / "radar_odometry.csv").unlink()
    with pytest.raises(OxfordError, match="radar_odometry.csv"):
        open_oxford(copy)
    words = ["--real-root", str(root), "--session", str(copy), "--out", str(tmp_path / "out")]
    assert seq01.main(words) == 1
    assert "radar_odometry.csv" in capsys.readouterr().err
    assert seq01.main(["--real-root", str(tmp_path)]) == 1
    assert "make real" in capsys.readouterr().err


def test_the_published_row_is_the_papers() -> None:
    row = seq01.published_row(folder=Path(__file__).parents[2] / "data" / "paper").iloc[0]
    assert (row.failures, row.rmse_m, row.rmse_yaw_deg, row.within_1m_2deg) == (0, 8.46, 5.43, 0.2955)


@pytest.mark.open3d
def test_twenty_images_of_seq01_go_through_network_and_filters(
    real_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Images as the public ones, rendered at true poses of session 02 on which the network was not trained."""
    monkeypatch.chdir(Path(__file__).parents[2])
    first, n, number = 5600, 20, "pose_xy_02.txt"
    for name in (rall.MAP_PATH, rall.SCANS_PATH):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).symlink_to((real_root / name).resolve())
    poses = rall.load_poses(real_root / rall.POSES_PATH / number)[first : first + n]
    (tmp_path / rall.POSES_PATH).mkdir(parents=True)
    np.savetxt(tmp_path / rall.POSES_PATH / number, poses)
    folder = tmp_path / rall.IMAGES_PATH / "seq02"
    made = build_segment(real_root, "02", first, n, 5)
    for k in range(n):
        scan = make_scan(made, k)
        image = polar_to_cartesian(scan.power, scan.azimuths, calibration=SDK)
        save_image(folder / f"{k + 1}.png", np.rint(255.0 * image).astype(np.uint8))
    assert seq01.main(["--real-root", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "published" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "out" / "seq02" / "results.csv").set_index("method")
    assert (table.n_scans == n).all() and (table.failures == 0).all()
    assert table.rmse_m["robust"] < 0.5 and table.rmse_m["paper"] < 2.0
    assert (table.points_share_1m > 0.5).all()
