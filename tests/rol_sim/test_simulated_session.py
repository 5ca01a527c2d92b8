"""Simulated sessions on disk: settings, times, odometry, and a small session written, interrupted and read back."""

import errno
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("open3d")
from rol import oxford
from rol.evaluation import read_tum
from rol.geometry import accumulate_increments, compose, invert, transform_points
from rol_sim.__main__ import main
from rol_sim.session import logs, writer
from rol_sim.session.labels import label_sweep, list_labels
from rol_sim.session.settings import SettingsError, load_settings, parse_settings, read_settings
from rol_sim.session.simulation import build_session
from rol_sim.world.mesh import GROUND_MATERIALS, Material

pytestmark = pytest.mark.open3d
NAME = "sim-town-seq01"
START = "2019-01-10T11:46:21"
RECIPE = f"""
simulated:
  seed: 3
  labels_every: 3
  sessions:
    {NAME}: {{start: "{START}", scans: 4, seed: 2, stops: 0, stand_s: 0, vehicles: 6, people: 4}}
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(RECIPE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return writer.write_session(load_settings(recipe), NAME, tmp_path_factory.mktemp("sessions"))


def digests(folder: Path) -> dict[str, str]:
    """What every file of a folder holds."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def other_faults(session: oxford.Session) -> list[str]:
    """Faults of a session but for the gaps between sweeps: those that no scan asks for are not written."""
    faults = oxford.check_session(session)
    return [fault for fault in faults if "velodyne" not in fault or "gaps between frames" not in fault]


# ---- settings ----


def test_settings_are_read(recipe: Path) -> None:
    settings = load_settings(recipe)
    assert settings.seed == 3 and settings.sweeps == "nearest"
    session = settings.sessions[NAME]
    assert session.scans == 4 and session.stand_s == 0.0 and session.cruise_mps == 9.0
    assert session.first_stamp_us == 1_547_120_781_000_000  # 10 January 2019, 11:46:21 UTC


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"sed": 1}, "simulated: unknown key 'sed'; known are: seed, loop_m"),
        ({"seed": -1}, "seed: -1 is not a whole number in"),
        ({"seed": 1.5}, "seed: expected int, got 1.5"),
        ({"loop_m": "long"}, "loop_m: expected float, got 'long'"),
        ({"loop_m": 100}, "loop_m: 100.0 is not in \\[450, inf\\)"),
        ({"sweeps": "some"}, "sweeps: 'some' is none of nearest, all, none"),
        ({"labels_every": True}, "labels_every: expected int, got True"),
        ({"lidar": 3}, "lidar: expected dict, got 3"),
        ("town", "expected keys and values, got 'town'"),
        (
            {"sessions": {"monday": {"start": START}}},
            "session monday: names of simulated sessions begin with",
        ),
        ({"sessions": {"sim-a": {}}}, "session sim-a: the key 'start' is missing"),
        ({"sessions": {"sim-a": {"start": "noon"}}}, "start: 'noon' is not a date and time"),
        ({"sessions": {"sim-a": {"start": START, "scan": 4}}}, "unknown key 'scan'"),
        (
            {"sessions": {"sim-a": {"start": START, "parked_share": 1.2}}},
            "parked_share: 1.2 is not in \\[0, 1\\]",
        ),
    ],
)
def test_bad_settings_are_named(section: object, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        parse_settings(section)


def test_bad_files_and_names_are_named(tmp_path: Path, recipe: Path) -> None:
    with pytest.raises(SettingsError, match="nowhere.yaml: cannot be read"):
        load_settings(tmp_path / "nowhere.yaml")
    (tmp_path / "other.yaml").write_text("profile: demo\n", encoding="utf-8")
    with pytest.raises(SettingsError, match="other.yaml: no section 'simulated'"):
        load_settings(tmp_path / "other.yaml")
    with pytest.raises(SettingsError, match=f"no session 'sim-b' in the settings; there are: {NAME}"):
        writer.write_session(load_settings(recipe), "sim-b", tmp_path)
    assert not (tmp_path / "sim-b").exists()


def test_unknown_sensor_settings_are_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "tiny.yaml").write_text(
        RECIPE.replace("  seed: 3\n", "  seed: 3\n  lidar: {noise: 1}\n"), encoding="utf-8"
    )
    status = main([str(tmp_path / "tiny.yaml"), "--session", NAME, "--out", str(tmp_path)])
    assert status == 1
    assert "lidar: unknown key 'noise'; known are: range_noise_m" in capsys.readouterr().err


def test_a_disk_that_fills_up_is_told_and_what_is_there_is_kept(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    whole, written = writer._write_scan, []

    def write_until_full(folder: Path, session: object, index: int) -> None:
        if index == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(folder / "radar"))
        whole(folder, session, index)
        written.append(index)

    monkeypatch.setattr(writer, "_write_scan", write_until_full)
    assert main([str(recipe), "--session", NAME, "--out", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert "No space left on device" in told and "the same command goes on from there" in told
    assert len(list((tmp_path / NAME / "radar").iterdir())) == len(written) == 2
    assert not (tmp_path / NAME / "session.json").exists()


# ---- times and odometry ----


def test_scans_follow_the_measured_rhythm() -> None:
    stamps, turns = logs.schedule_scans(10**15, 4_000, np.random.default_rng(1))
    np.testing.assert_array_equal(np.diff(stamps), turns[:-1])
    assert abs(turns.mean() - 249_990) < 150 and 1_300 < turns.std() < 1_700
    assert 0.6 < np.corrcoef(turns[1:], turns[:-1])[0, 1] < 0.8


def test_row_stamps_come_in_bursts() -> None:
    rows = np.array([logs.draw_row_stamps(10**15, 250_000, np.random.default_rng(k)) for k in range(20)])
    assert (rows[:, 0] == 10**15).all() and (np.diff(rows, axis=1) > 0).all()
    gaps = np.diff(rows, axis=1)
    np.testing.assert_array_equal(
        np.flatnonzero(gaps[0] > 2_000), 13 + 16 * np.arange(25)
    )  # as in real scans
    assert 7_000 < np.median(gaps[:, 13::16]) < 8_500
    assert 247_000 < (rows[:, -1] - rows[:, 0]).min() and (rows[:, -1] - rows[:, 0]).max() < 252_000
    even = logs.scan_row_times(10**15, 250_000)
    np.testing.assert_allclose(even[[0, -1]] - 10**15, [312.5, 249_687.5])


def test_nearest_sweeps_against_brute_force() -> None:
    scans, turns = logs.schedule_scans(10**15, 50, np.random.default_rng(2))
    sweeps = logs.schedule_sweeps(10**15 - 100_000, int(scans[-1]) + 400_000, np.random.default_rng(3))
    slow = {int(np.abs(sweeps - t).argmin()) for t in [*scans, *(scans + turns // 2)]}
    assert logs.choose_sweeps(sweeps, scans, turns).tolist() == sorted(slow)
    assert abs(np.diff(sweeps).mean() - 50_000) < 50


def test_odometry_drifts_a_little() -> None:
    """Over 400 m the end is off by some decimetres; without errors the steps are exact."""
    t = np.linspace(0.0, 1.0, 241)
    truth = np.column_stack([120 * np.cos(3.3 * t), 120 * np.sin(3.3 * t), 3.3 * t + np.pi / 2])
    exact = logs.drift_odometry(truth, _Silent(), scale_spread=0.0, yaw_spread_rad=0.0)
    np.testing.assert_allclose(accumulate_increments(exact, truth[0])[:, :2], truth[:, :2], atol=1e-9)
    ends = [
        np.hypot(
            *(
                accumulate_increments(logs.drift_odometry(truth, np.random.default_rng(k)), truth[0])[-1]
                - truth[-1]
            )[:2]
        )
        for k in range(40)
    ]
    assert 0.3 < np.median(ends) < 1.0 and np.max(ends) < 3.0


class _Silent:
    """A generator that draws no noise."""

    @staticmethod
    def normal(mean: float, spread: float, shape: object = None) -> object:
        return mean if shape is None else np.full(shape, mean)


# ---- a small session ----


def test_session_is_a_whole_oxford_session(folder: Path) -> None:
    session = oxford.open_session(folder)
    assert other_faults(session) == []
    assert len(session.radar_stamps_us) == 4 and session.radar_stamps_us[0] == 1_547_120_781_000_000
    assert not list(folder.rglob(".*"))
    for stamp in session.radar_stamps_us:
        scan = oxford.load_radar(session.radar_path(stamp))
        assert scan.counters[[0, 1, -1]].tolist() == [13, 27, 5599] and (scan.valid == 255).all()
        assert 0.001 < (scan.power >= 80).mean() < 0.05
        for sensor, stamps in zip(
            writer.LIDARS, (session.left_stamps_us, session.right_stamps_us), strict=True
        ):
            assert np.abs(stamps - stamp).min() <= 26_000 and np.abs(stamps - stamp - 125_000).min() <= 28_000
            points, times = oxford.load_sweep(session, sensor, stamps[0])
            assert len(points) > 20_000 and times[0] == stamps[0]
    assert (
        oxford.load_velodyne_raw(session.sweep_path("velodyne_left", stamps_of(folder)[0])).ranges.shape[0]
        == 32
    )


def stamps_of(folder: Path, sensor: str = "velodyne_left") -> np.ndarray:
    return oxford.load_timestamps(folder / f"{sensor}.timestamps")[0]


def test_odometry_follows_the_truth(folder: Path) -> None:
    odometry = oxford.load_radar_odometry(folder / "gt" / "radar_odometry.csv")
    assert len(odometry.increments) == 4 - 2
    stamps, middles, poses = oxford.compose_odometry(odometry)
    true_stamps, truth = read_tum(folder / "truth.tum")
    np.testing.assert_array_equal(true_stamps[:-1], stamps)
    assert ((middles - stamps > 122_000) & (middles - stamps < 128_000)).all()
    relative = compose(invert(truth[0]), truth[: len(poses)])
    np.testing.assert_allclose(poses, relative, atol=0.03)
    assert poses[-1, 0] > 0.1  # it drives forward


def test_gps_and_ins_lie_in_the_town(folder: Path) -> None:
    session = oxford.open_session(folder)
    gps, ins = oxford.load_gps(session.gps_path), oxford.load_ins(session.ins_path)
    _, truth = read_tum(folder / "truth.tum")
    for table, rate in ((gps, 5), (ins, 50)):
        np.testing.assert_allclose(np.diff(table["timestamp"]).mean(), 1e6 / rate, rtol=1e-3)
        east, north = table["easting"] - logs.EASTING, table["northing"] - logs.NORTHING
        assert np.hypot(east - truth[0, 0], north - truth[0, 1]).max() < 12.0
    heading = np.pi / 2 - ins["yaw"].iloc[len(ins) // 2]  # clockwise from north
    assert abs((heading - truth[1, 2] + np.pi) % (2 * np.pi) - np.pi) < 0.1
    assert set(ins["ins_status"]) == {"INS_SOLUTION_GOOD"} and set(gps["utm_zone"]) == {"30U"}


def test_description_says_how_it_was_made(folder: Path, recipe: Path) -> None:
    said = json.loads((folder / "session.json").read_text(encoding="utf-8"))
    assert said["name"] == NAME and said["n_scans"] == 4
    assert said["settings"]["session"]["scans"] == 4 and said["settings"]["seed"] == 3
    assert 0.5 < said["distance_m"] < 5.0 and 0.95 < said["duration_s"] < 1.05
    assert read_settings(folder / "settings.json") == load_settings(recipe)
    (folder.parent / "settings.json").write_text("{}", encoding="utf-8")
    with pytest.raises(SettingsError, match="settings.json: cannot be read"):
        read_settings(folder.parent / "settings.json")


def test_labels_tell_what_was_hit(folder: Path) -> None:
    for sensor in writer.LIDARS:
        labelled = list_labels(folder, sensor)
        np.testing.assert_array_equal(labelled, stamps_of(folder, sensor)[::3])
        points, materials = label_sweep(folder, sensor, labelled[0])
        T_radar_lidar = np.linalg.inv(oxford.EXTRINSICS["radar"]) @ oxford.EXTRINSICS[sensor]
        height = (points[:, :3] @ T_radar_lidar[:3, :3].T + T_radar_lidar[:3, 3])[:, 2]
        assert len(points) == len(materials) and (materials > 0).all()
        is_ground = np.isin(materials, GROUND_MATERIALS)
        assert 0.3 < is_ground.mean() < 0.8
        assert np.abs(height[materials == Material.GROUND] + 2.0).mean() < 0.15
        assert np.median(height[materials == Material.FACADE]) > -1.0
    with pytest.raises(ValueError, match=r"labels.*123\.png: missing or not an image"):
        label_sweep(folder, "velodyne_left", 123)


def test_points_of_scan_and_sweep_lie_on_the_town(folder: Path, recipe: Path) -> None:
    """Facade points, set at the true pose, lie on the outlines of the buildings as seen from above."""
    session = build_session(load_settings(recipe), NAME)
    stamp = list_labels(folder, "velodyne_right")[0]
    points, materials = label_sweep(folder, "velodyne_right", stamp)
    T_radar_lidar = np.linalg.inv(oxford.EXTRINSICS["radar"]) @ oxford.EXTRINSICS["velodyne_right"]
    in_radar = points[:, :3] @ T_radar_lidar[:3, :3].T + T_radar_lidar[:3, 3]
    pose = session.trajectory.pose(np.array([stamp + 25_000]))[0]
    at = transform_points(pose, in_radar[materials == Material.FACADE, :2])
    gaps = []
    for footprint in session.town.footprints:
        x, y = transform_points(invert(footprint[:3]), at).T
        gaps.append(
            np.hypot(np.maximum(np.abs(x) - footprint[3], 0), np.maximum(np.abs(y) - footprint[4], 0))
        )
    nearest = np.min(gaps, axis=0)  # bays and porches stand out by 1.2 m, rear wings by 3 m
    assert np.quantile(nearest, 0.6) < 0.3 and nearest.max() < 3.5


def test_complete_session_is_left_alone(folder: Path, recipe: Path) -> None:
    before, lines = digests(folder), []
    writer.write_session(load_settings(recipe), NAME, folder.parent, lines.append)
    assert lines == [f"{NAME}: complete already"] and digests(folder) == before


def test_interrupted_session_goes_on_with_the_same_bytes(folder: Path, recipe: Path, tmp_path: Path) -> None:
    copy = tmp_path / NAME
    shutil.copytree(folder, copy)
    scans = sorted((copy / "radar").glob("*.png"))
    kept = scans[0].stat().st_mtime_ns
    for path in (*scans[2:], *list((copy / "velodyne_left").glob("*.png"))[1:3], copy / "session.json"):
        path.unlink()
    shutil.rmtree(copy / "labels")
    (copy / "radar" / ".1547120781500000.png.17.tmp").write_bytes(b"half a scan")
    lines: list[str] = []
    writer.write_session(load_settings(recipe), NAME, tmp_path, lines.append)
    assert lines[0] == f"{NAME}: going on with what is there" and lines[-1] == f"{NAME}: complete"
    assert any(line.startswith(f"{NAME}: 4 of 4 scans") for line in lines)
    assert digests(copy) == digests(folder)
    assert scans[0].stat().st_mtime_ns == kept


def test_changed_settings_start_anew(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / NAME
    shutil.copytree(folder, copy)
    (tmp_path / "tiny.yaml").write_text(
        RECIPE.replace("scans: 4, seed: 2", "scans: 3, seed: 4"), encoding="utf-8"
    )
    (copy / "gps").rename(tmp_path / "gps")
    (copy / "gps").symlink_to(tmp_path / "gps")
    lines: list[str] = []
    writer.write_session(load_settings(tmp_path / "tiny.yaml"), NAME, tmp_path, lines.append)
    assert lines[0] == f"{NAME}: settings changed (session), starting anew"
    assert (tmp_path / "gps" / "gps.csv").is_file() and not (copy / "gps").is_symlink()
    session = oxford.open_session(copy)
    assert other_faults(session) == [] and len(list((copy / "radar").iterdir())) == 3
    after, before = digests(copy), digests(folder)
    assert not {after[f"radar/{path.name}"] for path in (copy / "radar").iterdir()} & set(before.values())


def test_a_folder_of_someone_else_is_left_alone(recipe: Path, tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    (tmp_path / NAME / "thesis.txt").write_text("years of work", encoding="utf-8")
    (tmp_path / NAME / "radar").mkdir()
    for content in (None, '{"listing": "pairs.json", "settings": {}}', "[]", "{"):
        for name in ("settings.json", "radar/.1.png.1.tmp"):
            if content is not None:
                (tmp_path / NAME / name).write_text(content, encoding="utf-8")
        with pytest.raises(ValueError, match="not empty and without a settings.json"):
            writer.write_session(load_settings(recipe), NAME, tmp_path)
    assert (tmp_path / NAME / "radar/.1.png.1.tmp").is_file()
    assert (tmp_path / NAME / "thesis.txt").read_text(encoding="utf-8") == "years of work"


def test_all_sweeps_can_be_had(recipe: Path) -> None:
    text = RECIPE.replace("  seed: 3\n", "  seed: 3\n  sweeps: all\n")
    (recipe.parent / "all.yaml").write_text(text, encoding="utf-8")
    session = build_session(load_settings(recipe.parent / "all.yaml"), NAME)
    for sensor in writer.LIDARS:
        assert 22 <= len(session.chosen[sensor]) <= 26  # 1.2 s at 20 Hz
        assert len(session.chosen[sensor]) == len(session.sweeps_us[sensor])


def test_command_line_tells_how_far_it_is(folder: Path, recipe: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([str(recipe), "--session", NAME, "--out", str(folder.parent)]) == 0
    assert capsys.readouterr().out == f"{NAME}: complete already\n"
    assert main([str(recipe), "--session", "sim-x", "--out", str(folder.parent)]) == 1
    assert "error: no session 'sim-x'" in capsys.readouterr().err
