"""Readers of one Oxford session, and its writers in rol_sim.session.oxford_files: real files, files made by hand, every fault that users meet."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rol import oxford
from rol.geometry import wrap_angle
from rol.oxford import OxfordError
from rol_sim.session import oxford_files

START = 1547131046353776  # the first real scan's name


# ---- material made by hand ----


def make_scan(stamp_us=START):
    rng = np.random.default_rng(1)
    codes = np.tile(rng.integers(1, 130, (400, 8)), 471).astype(np.uint8)  # compresses fast
    stamps = stamp_us + np.arange(400) * 625
    return oxford.RadarScan(
        stamps, (13 + 14 * np.arange(400)).astype(np.uint16), np.full(400, 255, np.uint8), codes
    )


def make_raw(n=24, stamp_us=START):
    rng = np.random.default_rng(2)
    return oxford.VelodyneRaw(
        rng.integers(0, 256, (32, n)).astype(np.uint8),
        rng.integers(0, 30_000, (32, n)).astype(np.uint16),
        (np.arange(n) * 1500).astype(np.uint16),
        stamp_us + np.arange(n) * 46,
    )


def make_odometry(stamps_us, increments=None):
    """One row per pair of neighbouring stamps; mid-scan 125 ms after the first row."""
    stamps_us = np.asarray(stamps_us)
    n = len(stamps_us) - 1
    increments_6dof = np.zeros((n, 6))
    increments_6dof[:, [0, 1, 5]] = [1.0, 0.0, 0.0] if increments is None else increments
    mid = stamps_us + 125_000
    return oxford.RadarOdometry(mid[1:], mid[:-1], stamps_us[1:], stamps_us[:-1], increments_6dof)


GPS_TEXT = (
    "timestamp,num_satellites,latitude,longitude,altitude,latitude_sigma,longitude_sigma,altitude_sigma,"
    "northing,easting,down,utm_zone\n"
    "0001547131010502681,7,51.762042,-1.262751,65.176138,0.766980,0.683444,0.955170,"
    "5736000.133896,619890.113928,-65.176138,30U\n"
    "0001547131010702733,7,51.762042,-1.262751,65.178802,0.761020,0.676749,0.950388,"
    "5736000.135991,619890.119947,-65.178802,30U\n"
)
INS_TEXT = (
    "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,"
    "velocity_north,velocity_east,velocity_down,roll,pitch,yaw\n"
    "0001547131010502681,INS_SOLUTION_GOOD,51.760642,-1.260381,114.696263,5735848.358489,620057.410348,"
    "-114.696263,30U,0.352838,-0.028782,0.011870,0.034337,-0.018738,0.047108\n"
    "0001547131010522681,INS_SOLUTION_GOOD,51.760642,-1.260381,114.696300,5735848.358500,620057.410300,"
    "-114.696300,30U,0.352838,-0.028782,-0.000000,0.034337,-0.018738,0.047108\n"
)


@pytest.fixture
def session_root(tmp_path):
    """A sound session: six scans at 4 Hz, both lidars at 20 Hz, the left as raw PNG and the right as .bin."""
    root = tmp_path / "2019-01-01-00-00-00-radar-oxford-10k"
    scans, sweeps = START + np.arange(6) * 250_000, START + np.arange(30) * 50_000
    scan, raw = make_scan(), make_raw()
    for stamp in scans:
        moved = dataclasses.replace(scan, row_stamps_us=scan.row_stamps_us + stamp - START)
        oxford_files.save_radar(root / "radar" / f"{stamp}.png", moved)
    points, _ = oxford.velodyne_raw_to_points(raw)
    for stamp in sweeps:
        moved = dataclasses.replace(raw, stamps_us=raw.stamps_us + stamp - START)
        oxford_files.save_velodyne_raw(root / "velodyne_left" / f"{stamp}.png", moved)
        oxford_files.save_velodyne_binary(root / "velodyne_right" / f"{stamp}.bin", points)
    oxford_files.save_timestamps(root / "radar.timestamps", scans)
    oxford_files.save_timestamps(root / "velodyne_left.timestamps", sweeps)
    oxford_files.save_timestamps(root / "velodyne_right.timestamps", sweeps)
    oxford_files.save_radar_odometry(root / "gt/radar_odometry.csv", make_odometry(scans[:5]))
    (root / "gps").mkdir()
    (root / "gps/gps.csv").write_text(GPS_TEXT, encoding="utf-8")
    (root / "gps/ins.csv").write_text(INS_TEXT, encoding="utf-8")
    return root


# ---- the real files ----


def test_real_scans_round_trip(real_root, tmp_path):
    paths = sorted((real_root / "RadarSLAMPy/data/tiny/radar").glob("*.png"))
    assert len(paths) == 11
    for path in paths:
        scan = oxford.load_radar(path)
        assert scan.stamp_us == int(path.stem)
        assert (scan.counters[0], scan.counters[1], scan.counters[-1]) == (13, 27, 5599)
        assert_allclose(
            scan.azimuths[[0, -1]], [-np.deg2rad(13 * 360 / 5600), -np.deg2rad(5599 * 360 / 5600)]
        )
        assert (np.diff(scan.azimuths) < 0).all()
        assert (scan.valid == 255).all()
        copy, again = tmp_path / path.name, tmp_path / "again" / path.name
        oxford_files.save_radar(copy, scan)
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert pixels.shape == (400, 3779)
        assert_array_equal(cv2.imread(str(copy), cv2.IMREAD_UNCHANGED), pixels)
        oxford_files.save_radar(again, oxford.load_radar(copy))
        assert again.read_bytes() == copy.read_bytes()


@pytest.mark.parametrize("folder", ["full_seq_1", "tiny"])
def test_real_odometry_and_timestamps_round_trip_byte_for_byte(real_root, tmp_path, folder):
    root = real_root / "RadarSLAMPy/data" / folder
    odometry = oxford.load_radar_odometry(root / "gt/radar_odometry.csv")
    oxford_files.save_radar_odometry(tmp_path / "odometry.csv", odometry)
    assert (tmp_path / "odometry.csv").read_bytes() == (root / "gt/radar_odometry.csv").read_bytes()
    assert not odometry.increments_6dof[:, 2:5].any()
    stamps, valid = oxford.load_timestamps(root / "radar.timestamps")
    assert valid.all()
    oxford_files.save_timestamps(tmp_path / "radar.timestamps", stamps, valid)
    assert (tmp_path / "radar.timestamps").read_bytes() == (root / "radar.timestamps").read_bytes()


def test_real_gps_round_trips_byte_for_byte(real_root, tmp_path):
    path = real_root / "RadarSLAMPy/data/tiny/gps/gps.csv"
    table = oxford.load_gps(path)
    assert table.timestamp[0] == 1547131010502681
    assert table.utm_zone[0] == "30U"
    oxford_files.save_gps(tmp_path / "gps.csv", table)
    assert (tmp_path / "gps.csv").read_bytes() == path.read_bytes()


def test_official_odometry_composes_to_the_published_poses(real_root):
    root = real_root / "RadarSLAMPy/data/full_seq_1"
    published = np.loadtxt(real_root / "RaLL/data/gt_poses/RobotCar/pose_xy_01.txt")
    odometry = oxford.load_radar_odometry(root / "gt/radar_odometry.csv")
    radar_stamps, mid_stamps, poses = oxford.compose_odometry(odometry)
    assert poses.shape == published.shape == (8866, 3)
    # The published file has five decimals; 9 km are driven.
    assert np.abs(poses[:, :2] - published[:, :2]).max() < 1e-4
    assert np.abs(wrap_angle(poses[:, 2] - published[:, 2])).max() < 1e-4
    assert np.hypot(*odometry.increments[:, :2].T).sum() == pytest.approx(9024.6, abs=0.1)
    stamps, _ = oxford.load_timestamps(root / "radar.timestamps")
    assert_array_equal(radar_stamps, stamps[:-1])  # every scan but the last has a pose
    assert 122_000 < (mid_stamps - radar_stamps).min() and (mid_stamps - radar_stamps).max() < 128_000


def test_real_sample_opens_as_a_session_without_lidars(real_root):
    session = oxford.open_session(real_root / "RadarSLAMPy/data/tiny")
    assert len(session.radar_stamps_us) == 11
    assert session.left_stamps_us is None and session.right_stamps_us is None
    faults = " | ".join(oxford.check_session(session))
    assert "velodyne_left.timestamps: missing" in faults
    assert "2239 poses without a scan" in faults
    assert "ins.csv: file is missing" in faults


# ---- radar scans ----


def test_radar_bytes_lie_where_the_description_says(tmp_path):
    scan = make_scan()
    path = tmp_path / f"{START}.png"
    oxford_files.save_radar(path, scan)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert bytes(pixels[3, :8]) == (START + 3 * 625).to_bytes(8, "little")
    assert bytes(pixels[300, 8:10]) == (13 + 14 * 300).to_bytes(2, "little")
    assert pixels[7, 10] == 255
    assert_array_equal(pixels[:, 11:], scan.power)
    loaded = oxford.load_radar(path)
    for field in dataclasses.fields(scan):
        assert_array_equal(getattr(loaded, field.name), getattr(scan, field.name))
    assert loaded.power.dtype == np.uint8 and loaded.row_stamps_us.dtype == np.int64
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]  # no temporary file stays behind


def test_azimuths_are_counter_clockwise_and_do_not_wrap():
    scan = make_scan()
    assert_allclose(scan.azimuths[:2], [-2 * np.pi * 13 / 5600, -2 * np.pi * 27 / 5600])
    late = dataclasses.replace(scan, counters=((5593 + 14 * np.arange(400)) % 5600).astype(np.uint16))
    assert_allclose(late.azimuths[[0, 1]], -2 * np.pi * np.array([5593, 5607]) / 5600)


def test_interpolated_rows_keep_their_flag(tmp_path):
    valid = np.full(400, 255, np.uint8)
    valid[5] = 0
    oxford_files.save_radar(tmp_path / "scan.png", dataclasses.replace(make_scan(), valid=valid))
    assert_array_equal(np.flatnonzero(oxford.load_radar(tmp_path / "scan.png").valid != 255), [5])


def write_pixels(path, change):
    """Write the image of a good scan after a change to its pixels, past the checks of the writer."""
    oxford_files.save_radar(path, make_scan())
    pixels = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).copy())
    cv2.imwrite(str(path), pixels)


def zero_rows(pixels, columns, rows=(17, 18)):
    pixels[list(rows), columns] = 0
    return pixels


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda p: np.rot90(p), r"got 3779 x 400; the image is rotated by 90 deg"),
        (lambda p: np.rot90(p, -1), r"rotated by 90 deg"),
        (lambda p: np.rot90(p, 2), r"row stamps|all-zero|not those of one turn"),
        (lambda p: np.flipud(p), r"row stamps out of order at row 1"),
        (lambda p: p[:399], r"expected 400 x 3779 pixels \(rows x columns\), got 399 x 3779$"),
        (lambda p: p[:, :-1], r"expected 400 x 3779 .* got 400 x 3778$"),
        (lambda p: zero_rows(p, slice(11, None)), r"2 all-zero azimuths .*, first in row 17"),
        (lambda p: zero_rows(p, slice(0, 8)), r"2 all-zero azimuths .*, first in row 17"),
        (lambda p: np.zeros_like(p), r"400 all-zero azimuths .*, first in row 0"),
        (lambda p: p[[0, 2, 1, *range(3, 400)]], r"row stamps out of order at row 2"),
        (lambda p: np.hstack([p[:, :8], p[::-1, 8:10], p[:, 10:]]), r"sweep counters do not go clockwise"),
        (lambda p: np.dstack([p, p, p]), r"not an 8-bit grey image \(bit depth 8, PNG colour type 2\)"),
        (lambda p: p.astype(np.uint16), r"not an 8-bit grey image \(bit depth 16"),
    ],
)
def test_radar_faults_are_named(tmp_path, change, fault):
    path = tmp_path / f"{START}.png"
    write_pixels(path, change)
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_radar(path)
    assert str(path) in str(error.value)


def test_radar_file_name_must_be_the_first_stamp(tmp_path):
    oxford_files.save_radar(tmp_path / f"{START}.png", make_scan())
    other = tmp_path / f"{START + 1}.png"
    shutil.copy(tmp_path / f"{START}.png", other)
    with pytest.raises(
        OxfordError, match=f"{other.name}: the first row's stamp {START} is not the file's name"
    ):
        oxford.load_radar(other)
    shutil.copy(other, tmp_path / "scan.png")
    assert oxford.load_radar(tmp_path / "scan.png").stamp_us == START


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9999])
def test_truncated_png_is_named_without_noise(tmp_path, capfd, share):
    path = tmp_path / f"{START}.png"
    oxford_files.save_radar(path, make_scan())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(OxfordError, match=rf"{path.name}: PNG is truncated or damaged"):
        oxford.load_radar(path)
    assert capfd.readouterr().err == ""


def test_damaged_missing_empty_and_foreign_files_are_named(tmp_path, capfd):
    path = tmp_path / f"{START}.png"
    oxford_files.save_radar(path, make_scan())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(OxfordError, match="truncated or damaged"):
        oxford.load_radar(path)
    bare = {b"": "file is empty", b"<html>": "not a PNG file", bytes(data[:8]): "truncated"}
    bare[bytes(data[:8] + data[-12:])] = "truncated"  # an end without a beginning
    for content, fault in bare.items():
        path.write_bytes(content)
        with pytest.raises(OxfordError, match=fault):
            oxford.load_radar(path)
    with pytest.raises(OxfordError, match=r"gone\.png: file is missing"):
        oxford.load_radar(tmp_path / "gone.png")
    assert capfd.readouterr().err == ""


def test_radar_writer_refuses_what_the_reader_would(tmp_path):
    scan, path = make_scan(), tmp_path / f"{START}.png"
    bad = {
        "power: expected shape": {"power": scan.power[:, :100]},
        "power: a value does not fit into uint8": {"power": scan.power.astype(float) + 0.5},
        "counters: a value does not fit": {"counters": np.full(400, -1)},
        "all-zero azimuths": {"power": np.zeros_like(scan.power)},
        "is not the file's name": {"row_stamps_us": scan.row_stamps_us + 1},
    }
    for fault, change in bad.items():
        with pytest.raises(OxfordError, match=fault):
            oxford_files.save_radar(path, dataclasses.replace(scan, **change))
    assert not path.exists()


# ---- lidar sweeps ----


def hand_made_sweep():
    """Three firings; what comes back is worked out in the test below."""
    intensities, ranges = np.zeros((32, 3), np.uint8), np.zeros((32, 3), np.uint16)
    ranges[8, 0], intensities[8, 0] = 5_000, 10  # level laser, 10 m, angle 0
    ranges[8, 1], intensities[8, 1] = 2_500, 20  # level laser, 5 m, angle 90 deg
    ranges[31, 1], intensities[31, 1] = 1_000, 30  # lowest laser (0.5353 rad down), 2 m, angle 90 deg
    ranges[0, 2], intensities[0, 2] = 5_000, 40  # highest laser (0.1862 rad up), 10 m, angle 180 deg
    ranges[8, 2], intensities[8, 2] = 500, 50  # exactly 1 m: too near
    angles = np.array([0, 9_000, 18_000], np.uint16)
    return oxford.VelodyneRaw(intensities, ranges, angles, START + np.array([0, 46, 92]))


def test_hand_made_sweep_gives_hand_worked_points():
    points, stamps = oxford.velodyne_raw_to_points(hand_made_sweep())
    # Angle 0 is to the left, 90 deg forward, 180 deg to the right; the lasers sit 0.090805 m above the base.
    expected = [
        [0.0, 10.0, 0.090805, 10],
        [5.0, 0.0, 0.090805, 20],
        [1.720231, 0.0, -0.929393, 30],  # 2 cos 0.5353 = 1.720231, 2 sin 0.5353 = 1.020198
        [0.0, -9.827148, 1.942064, 40],  # 10 cos 0.1862 = 9.827148, 10 sin 0.1862 = 1.851259
    ]
    assert points.dtype == np.float32
    assert_allclose(points, expected, atol=2e-6)
    assert_array_equal(stamps - START, [0, 46, 46, 92])
    near, _ = oxford.velodyne_raw_to_points(hand_made_sweep(), min_range_m=0.5)
    assert len(near) == 5


def test_velodyne_bytes_lie_where_the_description_says(tmp_path):
    raw, path = hand_made_sweep(), tmp_path / "velodyne_left" / f"{START}.png"
    oxford_files.save_velodyne_raw(path, raw)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (106, 3)
    assert pixels[31, 1] == 30
    assert bytes(pixels[32 + 2 * 8 : 34 + 2 * 8, 0]) == (5_000).to_bytes(2, "little")
    assert bytes(pixels[96:98, 2]) == (18_000).to_bytes(2, "little")
    assert bytes(pixels[98:, 1]) == (START + 46).to_bytes(8, "little")


def test_velodyne_round_trip_and_literal_oracle(tmp_path):
    raw, path = make_raw(), tmp_path / f"{START}.png"
    oxford_files.save_velodyne_raw(path, raw)
    loaded = oxford.load_velodyne_raw(path)
    for field in dataclasses.fields(raw):
        values = getattr(loaded, field.name)
        assert_array_equal(values, getattr(raw, field.name))
        assert values.dtype == getattr(raw, field.name).dtype
    first = path.read_bytes()
    oxford_files.save_velodyne_raw(path, loaded)
    assert path.read_bytes() == first
    expected = []
    for column in range(24):
        for laser in range(32):
            r, a = raw.ranges[laser, column] * 0.002, np.deg2rad(raw.angles[column] / 100)
            e = oxford.ELEVATIONS_DOWN[laser]
            if r > 1.0:
                x, y, z = r * np.cos(e) * np.sin(a), -r * np.cos(e) * np.cos(a), r * np.sin(e) - 0.090805
                expected.append([x, -y, -z, raw.intensities[laser, column]])
    points, stamps = oxford.velodyne_raw_to_points(loaded)
    assert_allclose(points, expected, atol=1e-5)
    assert (np.diff(stamps) >= 0).all()


def test_sweep_without_a_return_gives_no_points():
    raw = dataclasses.replace(make_raw(), ranges=np.zeros((32, 24), np.uint16))
    points, stamps = oxford.velodyne_raw_to_points(raw)
    assert points.shape == (0, 4) and stamps.shape == (0,)


def zero_column(pixels):
    pixels[98:, 5] = 0
    return pixels


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (
            lambda p: np.rot90(p),
            r"expected 106 x N pixels \(rows x columns\), got 24 x 106; .* rotated by 90 deg",
        ),
        (lambda p: p[:98], r"expected 106 x N pixels .* got 98 x 24$"),
        (lambda p: np.fliplr(p), r"are not those of one sweep"),
        (zero_column, r"firing without a time stamp in column 5"),
        (
            lambda p: np.vstack([p[:96], np.full_like(p[:2], 255), p[98:]]),
            r"angle 65535 lies outside 0\.\.35999",
        ),
    ],
)
def test_velodyne_faults_are_named(tmp_path, change, fault):
    path = tmp_path / f"{START}.png"
    oxford_files.save_velodyne_raw(path, make_raw())
    cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_velodyne_raw(path)
    assert str(path) in str(error.value)


def test_velodyne_name_must_be_near_its_stamps(tmp_path):
    oxford_files.save_velodyne_raw(tmp_path / f"{START}.png", make_raw())
    other = tmp_path / f"{START + 300_000}.png"
    shutil.copy(tmp_path / f"{START}.png", other)
    with pytest.raises(OxfordError, match="not near the file's name"):
        oxford.load_velodyne_raw(other)
    with pytest.raises(OxfordError, match="not near the file's name"):
        oxford_files.save_velodyne_raw(other, make_raw())
    with pytest.raises(OxfordError, match="sweep without a firing"):
        oxford_files.save_velodyne_raw(other, make_raw(n=0))


def test_binary_holds_four_rows_in_oxford_axes(tmp_path):
    path = tmp_path / f"{START}.bin"
    np.array([1, 2, 10, 20, -3, 4, 50, 60], dtype="<f4").tofile(path)  # x x, y y, z z, intensity intensity
    points = oxford.load_velodyne_binary(path)
    assert_array_equal(points, [[1, -10, 3, 50], [2, -20, -4, 60]])
    assert points.dtype == np.float32
    oxford_files.save_velodyne_binary(tmp_path / "again.bin", points)
    assert (tmp_path / "again.bin").read_bytes() == path.read_bytes()


def test_both_formats_give_the_same_points(tmp_path):
    points, _ = oxford.velodyne_raw_to_points(make_raw())
    oxford_files.save_velodyne_binary(tmp_path / "sweep.bin", points)
    assert_array_equal(oxford.load_velodyne_binary(tmp_path / "sweep.bin"), points)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        (np.arange(7), r"28 bytes are not four rows of float32; the file is truncated"),
        (np.array([1, 2, 3, np.nan, 5, 6, 7, 8]), r"point 1 is not finite"),
        (np.array([[1, 2, 3, 9], [4, -5, -6, 9]]).ravel(), r"intensities lie outside 0\.\.255"),
        (np.array([[1, 2, 3, 9], [4, 5, 6, 7.5]]).ravel(), r"or are fractions; truncated\?"),
    ],
)
def test_binary_faults_are_named(tmp_path, values, fault):
    path = tmp_path / "sweep.bin"
    values.astype("<f4").tofile(path)
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_velodyne_binary(path)
    assert str(path) in str(error.value)


def test_binary_writer_refuses_bad_points(tmp_path):
    for points in (np.zeros((0, 4)), np.zeros((5, 3)), np.full((2, 4), np.nan), np.full((2, 4), -1.0)):
        with pytest.raises(OxfordError):
            oxford_files.save_velodyne_binary(tmp_path / "sweep.bin", points)
    assert not (tmp_path / "sweep.bin").exists()


# ---- text files ----


def test_timestamps_keep_flags(tmp_path):
    path = tmp_path / "radar.timestamps"
    path.write_text(f"{START} 1\n{START + 250_000} 0\n", encoding="utf-8")
    stamps, valid = oxford.load_timestamps(path)
    assert_array_equal(stamps, [START, START + 250_000])
    assert_array_equal(valid, [True, False])
    oxford_files.save_timestamps(tmp_path / "again", stamps, valid)
    assert (tmp_path / "again").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "file is empty"),
        ("10 1\n20\n", "line 2 is not '<microseconds> <0 or 1>': '20'"),
        ("10 1\n20 x\n", "line 2 is not"),
        ("10 1\n\n20 1\n", "line 2 is not"),
        ("10.5 1\n", "line 1 is not"),
        ("nan 1\n", "line 1 is not"),
        ("1" * 30 + " 1\n", "line 1 is not"),
        ("10 1\n30 1\n20 1\n", "stamps out of order in line 3: 30, then 20 us"),
        ("10 1\n10 1\n", "stamps out of order in line 2"),
    ],
)
def test_timestamp_faults_are_named(tmp_path, text, fault):
    path = tmp_path / "velodyne_left.timestamps"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_timestamps(path)
    assert str(path) in str(error.value)


def test_timestamp_writer_refuses_bad_stamps(tmp_path):
    for stamps, valid in (([], None), ([2, 1], None), ([1, 2], [True])):
        with pytest.raises(OxfordError):
            oxford_files.save_timestamps(tmp_path / "radar.timestamps", stamps, valid)


def test_gps_and_ins_round_trip_byte_for_byte(tmp_path):
    for text, load, save in (
        (GPS_TEXT, oxford.load_gps, oxford_files.save_gps),
        (INS_TEXT, oxford.load_ins, oxford_files.save_ins),
    ):
        path = tmp_path / "table.csv"
        path.write_text(text, encoding="utf-8")
        table = load(path)
        assert table.timestamp.dtype == np.int64
        save(path, table)
        assert path.read_text(encoding="utf-8") == text
    assert table.ins_status[0] == "INS_SOLUTION_GOOD" and table.yaw[0] == 0.047108


def test_table_writer_refuses_what_the_reader_would(tmp_path):
    path = tmp_path / "gps.csv"
    path.write_text(GPS_TEXT, encoding="utf-8")
    table = oxford.load_gps(path)
    for fault, bad in {
        "num_satellites: a value does not fit into int64": table.assign(num_satellites=[7, 7.5]),
        "line 3: down is missing or not finite": table.assign(down=[1.0, np.nan]),
        "missing: utm_zone": table.drop(columns="utm_zone"),
        "stamps out of order in line 3": table[::-1],
    }.items():
        with pytest.raises(OxfordError, match=fault):
            oxford_files.save_gps(path, bad)
    assert path.read_text(encoding="utf-8") == GPS_TEXT  # what was there is still there


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda t: t.replace("down,", "", 1), "missing columns: down"),
        (lambda t: t.replace("0.766980", "nan"), "line 2: latitude_sigma is missing or not finite"),
        (lambda t: t.replace("0.761020", ""), "line 3: latitude_sigma is missing or not finite"),
        (lambda t: t.replace("0.761020", "inf"), "line 3: latitude_sigma is missing or not finite"),
        (lambda t: t.replace("0.761020", "abc"), "not a number.*abc"),
        (lambda t: t.replace("0.761020", "0.7,61020"), "line 3 has 13 fields, not 12"),
        (lambda t: t.replace("0001547131010702733", "0001547131010402733"), "stamps out of order in line 3"),
        (lambda t: t.replace("0001547131010702733", ""), "missing or not a number"),
        (lambda t: t.replace("0001547131010702733", "9" * 30), "not a number"),
        (lambda t: t[:-2], "the last line is cut off"),
        (lambda t: t[:-30] + "\n", "line 3 has 9 fields, not 12"),
        (lambda t: t.splitlines()[0] + "\n", "no rows"),
        (lambda t: t.replace("\n", ",a\n"), "unknown or doubled columns: a$"),
        (lambda t: t.replace("down", "up"), "missing columns: down; unknown or doubled columns: up$"),
        (lambda t: t.replace("\n", ",latitude\n"), "unknown or doubled columns: latitude$"),
        (lambda t: "\ufeff", "file is empty"),
        (lambda t: t.replace("latitude,longitude", "longitude,latitude"), "wrong columns"),
    ],
)
def test_table_faults_are_named(tmp_path, change, fault):
    path = tmp_path / "gps.csv"
    path.write_text(change(GPS_TEXT), encoding="utf-8")
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_gps(path)
    assert str(path) in str(error.value)


def test_extrinsics_are_in_our_axes():
    radar, left = oxford.EXTRINSICS["radar"], oxford.EXTRINSICS["velodyne_left"]
    assert_allclose(radar[:3, 3], [-0.71813, -0.12, 0.54479])  # right is negative, up is positive
    assert_allclose(
        radar[:3, 0], [np.cos(0.05), 0, np.sin(0.05)]
    )  # the radar's forward points up by 0.05 rad
    assert left[1, 3] > oxford.EXTRINSICS["velodyne_right"][1, 3]  # left is left
    T_radar_left = np.linalg.inv(radar) @ left
    assert T_radar_left[0, 0] < -0.99  # the lidar faces backward
    assert -0.29 < T_radar_left[2, 3] < -0.26  # and hangs below the radar


# ---- radar odometry ----

HAND_ODOMETRY = (
    "source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw,"
    "source_radar_timestamp,destination_radar_timestamp\n"
    "1375000,1125000,2.000000,1.000000,-0.000000,0.000000,-0.000000,1.570796,1250000,1000000\n"
    "1625000,1375000,3.000000,-0.000000,-0.000000,-0.000000,0.000000,0.000000,1500000,1250000\n"
)


def test_odometry_is_turned_into_our_axes_and_composed(tmp_path):
    path = tmp_path / "radar_odometry.csv"
    path.write_text(HAND_ODOMETRY, encoding="utf-8")
    odometry = oxford.load_radar_odometry(path)
    assert_allclose(
        odometry.increments, [[2, -1, -1.570796], [3, 0, 0]]
    )  # 1 m right, a quarter turn to the right
    radar_stamps, mid_stamps, poses = oxford.compose_odometry(odometry)
    assert_array_equal(radar_stamps, [1_000_000, 1_250_000, 1_500_000])
    assert_array_equal(mid_stamps, [1_125_000, 1_375_000, 1_625_000])
    assert_allclose(poses, [[0, 0, 0], [2, -1, -np.pi / 2], [2, -4, -np.pi / 2]], atol=1e-5)
    _, _, moved = oxford.compose_odometry(odometry, start=(10, 0, np.pi / 2))
    assert_allclose(moved, [[10, 0, np.pi / 2], [11, 2, 0], [14, 2, 0]], atol=1e-5)
    oxford_files.save_radar_odometry(tmp_path / "again.csv", odometry)
    assert (tmp_path / "again.csv").read_text(encoding="utf-8") == HAND_ODOMETRY  # minus zeros included


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda t: t.replace(",yaw", "", 1), "missing columns: yaw"),
        (lambda t: t.replace("3.000000", "nan"), "line 3: x is missing or not finite"),
        (lambda t: t.replace("1625000,1375000", "1375000,1625000"), "out of order in line 3"),
        (lambda t: t.replace("1375000,1125000", "1375000,1475000"), "line 2: the source is not later"),
        (lambda t: t.replace("1500000,", "15000,"), "line 3: the source is not later"),
        (lambda t: t.replace("1625000,", "9625000,"), "line 3: a frame's time lies outside its radar scan"),
        (lambda t: t[:-4], "the last line is cut off"),
    ],
)
def test_odometry_faults_are_named(tmp_path, change, fault):
    path = tmp_path / "radar_odometry.csv"
    path.write_text(change(HAND_ODOMETRY), encoding="utf-8")
    with pytest.raises(OxfordError, match=fault) as error:
        oxford.load_radar_odometry(path)
    assert str(path) in str(error.value)


def test_odometry_writer_refuses_nan_and_odd_lengths(tmp_path):
    odometry, path = make_odometry(START + np.arange(4) * 250_000), tmp_path / "radar_odometry.csv"
    with pytest.raises(OxfordError, match="line 2: x is missing or not finite"):
        oxford_files.save_radar_odometry(
            path, dataclasses.replace(odometry, increments_6dof=np.full((3, 6), np.nan))
        )
    with pytest.raises(OxfordError, match="stamps: expected shape"):
        oxford_files.save_radar_odometry(
            path, dataclasses.replace(odometry, increments_6dof=np.zeros((2, 6)))
        )
    assert not path.exists()


def test_a_gap_in_the_odometry_is_not_composed_over(tmp_path):
    lines = HAND_ODOMETRY.splitlines(keepends=True)
    path = tmp_path / "radar_odometry.csv"
    path.write_text(lines[0] + lines[1] + "1875000,1625000,1,0,0,0,0,0,1750000,1500000\n", encoding="utf-8")
    odometry = oxford.load_radar_odometry(path)
    with pytest.raises(
        OxfordError, match=rf"{path.name}: gap before line 3: from scan 1250000 to scan 1500000"
    ):
        oxford.compose_odometry(odometry)


# ---- whole sessions ----


def test_a_sound_session_has_no_faults(session_root):
    session = oxford.open_session(session_root)
    assert session.name == session_root.name
    assert len(session.radar_stamps_us) == 6 and len(session.left_stamps_us) == 30
    assert oxford.check_session(session) == []
    assert oxford.load_radar(session.radar_path(START)).stamp_us == START
    left, left_stamps = oxford.load_sweep(session, "velodyne_left", START + 50_000)
    right, right_stamps = oxford.load_sweep(session, "velodyne_right", START + 50_000)
    assert_array_equal(left, right)
    assert left_stamps[0] == START + 50_000 and left_stamps[-1] == START + 50_000 + 23 * 46
    assert (right_stamps == START + 50_000).all() and len(right_stamps) == len(right)


def test_unknown_session_lists_those_that_are_there(session_root):
    with pytest.raises(
        OxfordError, match=f"nowhere: no such session; sessions beside it: {session_root.name}"
    ):
        oxford.open_session(session_root.parent / "nowhere")
    with pytest.raises(OxfordError, match="no such session; sessions beside it: none"):
        oxford.open_session(session_root.parent / "no" / "where")
    assert oxford.list_sessions(session_root.parent) == [session_root.name]


def test_incomplete_sessions_are_refused(session_root):
    simulated = session_root.parent / "sim-town-train"
    shutil.copytree(session_root, simulated)
    with pytest.raises(OxfordError, match="sim-town-train: incomplete session, session.json missing"):
        oxford.open_session(simulated)
    (simulated / "session.json").write_text("{}", encoding="utf-8")
    assert oxford.open_session(simulated).name == "sim-town-train"
    (session_root / "radar.timestamps").unlink()
    with pytest.raises(OxfordError, match="radar.timestamps missing; sessions beside it: sim-town-train"):
        oxford.open_session(session_root)


def test_a_missing_lidar_is_none_and_named_when_asked_for(session_root):
    shutil.rmtree(session_root / "velodyne_right")
    (session_root / "velodyne_right.timestamps").unlink()
    session = oxford.open_session(session_root)
    assert session.right_stamps_us is None
    with pytest.raises(OxfordError, match="the session has no velodyne_right"):
        oxford.load_sweep(session, "velodyne_right", START)
    with pytest.raises(OxfordError, match="no lidar is called 'velodyne'"):
        session.sweep_path("velodyne", START)
    assert any("velodyne_right" in fault and "missing" in fault for fault in oxford.check_session(session))


def test_a_file_in_place_of_a_folder_is_named(session_root):
    shutil.rmtree(session_root / "velodyne_left")
    (session_root / "velodyne_left").touch()
    (session_root / "velodyne_right.timestamps").unlink()
    (session_root / "velodyne_right.timestamps").mkdir()
    shutil.rmtree(session_root / "gt")
    (session_root / "gt").touch()
    session = oxford.open_session(session_root)
    assert session.right_stamps_us is None
    assert oxford.check_session(session) == [
        f"{session_root}/velodyne_left: not a folder",
        f"{session_root}/velodyne_right.timestamps: not a file",
        f"{session_root}/gt/radar_odometry.csv: file is missing",
    ]
    shutil.rmtree(session_root / "radar")
    (session_root / "radar").touch()
    with pytest.raises(OxfordError, match="incomplete session, radar missing"):
        oxford.open_session(session_root)


def test_a_broken_link_is_an_empty_file(session_root):
    path = session_root / "radar" / f"{START}.png"
    path.unlink()
    path.symlink_to("nowhere.png")
    assert f"{session_root}/radar: 1 empty files, the first: {START}.png" in oxford.check_session(
        oxford.open_session(session_root)
    )


def test_a_missing_sweep_is_named(session_root):
    session = oxford.open_session(session_root)
    with pytest.raises(OxfordError, match=f"{START + 1}.png: file is missing, and so is {START + 1}.bin"):
        oxford.load_sweep(session, "velodyne_left", START + 1)


def test_check_session_names_every_fault(session_root):
    scans = START + np.arange(6) * 250_000
    (session_root / "radar" / f"{scans[1]}.png").unlink()
    shutil.copy(session_root / "radar" / f"{scans[0]}.png", session_root / "radar" / f"{scans[0] + 7}.png")
    (session_root / "radar" / f"{scans[2]}.png").write_bytes(b"")
    (session_root / "radar" / "notes.txt").write_text("x", encoding="utf-8")
    (session_root / "radar" / f"._{scans[0]}.png").write_bytes(b"x")  # macOS puts it beside a file; no fault
    oxford_files.save_timestamps(session_root / "radar.timestamps", scans, scans != scans[3])
    keep = np.r_[0:4, 8:20]
    oxford_files.save_timestamps(session_root / "velodyne_left.timestamps", START + keep * 50_000)
    oxford_files.save_radar_odometry(session_root / "gt/radar_odometry.csv", make_odometry(scans[:3]))
    (session_root / "gps/gps.csv").unlink()
    session = oxford.open_session(session_root)
    assert_array_equal(session.radar_stamps_us, scans[[0, 1, 2, 4, 5]])  # the stamp flagged 0 is not used
    faults = oxford.check_session(session)
    for expected in (
        f"radar.timestamps: 1 stamps flagged 0, not to be used, the first: {scans[3]}",
        f"radar: 1 stamps without a file, the first: {scans[1]}",
        f"radar: 1 files without a stamp, the first: {scans[0] + 7}",
        "radar: 1 files that are no frame, the first: notes.txt",
        f"radar: 1 empty files, the first: {scans[2]}.png",
        f"velodyne_left.timestamps: 1 gaps between frames, the first: 0.250 s after {START + 150_000}",
        f"velodyne_left: 14 files without a stamp, the first: {START + 200_000}",
        f"velodyne_left: 1 scans without a sweep near, the first: {scans[5]}",
        f"radar_odometry.csv: 2 scans after the last pose, the ground truth ends early, the first: {scans[4]}",
        "gps.csv: file is missing",
    ):
        assert any(expected in fault for fault in faults), (expected, faults)
    assert len(faults) == 10


def test_check_session_reports_broken_odometry_and_late_truth(session_root):
    scans = START + np.arange(6) * 250_000
    path = session_root / "gt/radar_odometry.csv"
    session = oxford.open_session(session_root)
    oxford_files.save_radar_odometry(path, make_odometry(scans[2:5]))
    assert oxford.check_session(session) == [f"{path}: 2 scans before the first pose, the first: {scans[0]}"]
    oxford_files.save_radar_odometry(path, make_odometry(scans[[0, 1, 3, 4]]))
    assert "1 scans without a pose within the ground truth's span" in oxford.check_session(session)[0]
    path.write_text(path.read_text(encoding="utf-8")[:-20], encoding="utf-8")
    assert oxford.check_session(session)[0].startswith(f"{path}: the last line is cut off")
    path.unlink()
    assert oxford.check_session(session) == [f"{path}: file is missing"]
