"""Pairs: association in time, velocities, one pair out of a session, pairs as files."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rol import pairs
from rol.bev import image_to_points
from rol.geometry import accumulate_increments, exp, relative_pose
from rol.oxford import EXTRINSICS, RadarScan, Session
from rol.pairs import (
    AlignedScan,
    PairDataset,
    PairSettings,
    align_scans,
    associate_nearest,
    build_pair,
    describe_pairs,
    estimate_twists,
    list_pairs,
    load_lidar_points,
    load_pair,
    pair_folder,
    save_pair,
    usable_stamps,
    usable_sweeps,
    write_pairs,
)
from rol_sim.session.oxford_files import save_radar, save_velodyne_binary

STAMP = 1_547_000_000_000_000
ALIGNED = AlignedScan(STAMP, STAMP + 25_000, STAMP + 25_000)


# ---- association


def test_associate_by_hand():
    index, gap = associate_nearest([100, 149, 150, 400, 0], [90, 210], max_gap_us=100)
    np.testing.assert_array_equal(index, [0, 0, 0, -1, 0])  # 150 lies in the middle: the earlier one
    np.testing.assert_array_equal(gap, [-10, -59, -60, -190, 90])
    index, gap = associate_nearest([100, 300], [210], max_gap_us=100)
    np.testing.assert_array_equal(index, [-1, 0])
    np.testing.assert_array_equal(gap, [110, -90])


def test_associate_agrees_with_all_pairs():
    rng = np.random.default_rng(6)
    stamps, others = np.sort(rng.integers(0, 10**6, 200)), np.unique(rng.integers(0, 10**6, 300))
    index, gap = associate_nearest(stamps + STAMP, others + STAMP, max_gap_us=10**6)
    slow = np.abs(stamps[:, None] - others[None]).min(axis=1)
    np.testing.assert_array_equal(np.abs(gap), slow)
    np.testing.assert_array_equal(others[index] - stamps, gap)


def test_associate_refuses():
    with pytest.raises(ValueError, match="no other stamps"):
        associate_nearest([1, 2], [])
    with pytest.raises(ValueError, match="do not increase at index 2"):
        associate_nearest([1, 2], [1, 5, 4])


# ---- sweeps of scans


def test_align_scans_by_hand():
    radar = np.array([0, 250_000, 500_000])
    twists = np.array([[1.0, 0.1, 0.01], [2.0, 0.2, 0.02], [3.0, 0.3, 0.03]])
    sweeps = {
        "left": np.array([10_000, 130_000, 260_000, 380_000]),
        "right": np.array([-40_000, 120_000, 265_000, 375_000]),
    }
    columns = align_scans(radar, radar + 125_000, twists, sweeps)
    np.testing.assert_array_equal(columns["radar_stamp_us"], [0, 250_000])  # nothing within 50 ms of the last
    np.testing.assert_array_equal(columns["left_stamp_us"], [10_000, 260_000])
    np.testing.assert_array_equal(columns["right_gap_ms"], [-40.0, 15.0])
    columns = align_scans(radar, radar + 125_000, twists, sweeps, motion="corrected")
    np.testing.assert_array_equal(columns["left_gap_ms"], [5.0, 5.0])
    np.testing.assert_array_equal(columns["right_stamp_us"], [120_000, 375_000])
    row = {name: values[1] for name, values in columns.items()}
    expected = AlignedScan(250_000, 380_000, 375_000, mid_stamp_us=375_000, twist=(2.0, 0.2, 0.02))
    assert AlignedScan.from_row(row) == expected
    with pytest.raises(ValueError, match="motion must be"):
        align_scans(radar, radar, twists, sweeps, motion="maybe")


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_lidar_is_enough(side):
    radar, twists, sweeps = np.array([0, 250_000]), np.zeros((2, 3)), {side: np.array([10_000, 260_000])}
    columns = align_scans(radar, radar + 125_000, twists, sweeps)
    assert [name for name in columns if "left" in name or "right" in name] == [
        f"{side}_stamp_us",
        f"{side}_gap_ms",
    ]
    aligned = AlignedScan.from_row({name: values[1] for name, values in columns.items()})
    assert {aligned.left_stamp_us, aligned.right_stamp_us} == {260_000, None}
    assert getattr(aligned, f"{side}_stamp_us") == 260_000
    for wrong in ({}, {f"velodyne_{side}": radar}):
        with pytest.raises(ValueError, match="sweeps_us must have the keys"):
            align_scans(radar, radar, twists, wrong)


def test_scans_that_are_all_too_far_from_their_sweeps_are_refused():
    radar, twists = np.array([0, 250_000]), np.zeros((2, 3))
    sweeps = {"left": radar + 90_000, "right": radar + 10_000}
    with pytest.raises(
        ValueError, match="within 50 ms of its stamp; the smallest gaps are left 90 ms, right 10 ms"
    ):
        align_scans(radar, radar + 125_000, twists, sweeps)
    sweeps = {"left": radar + 90_000}
    assert len(align_scans(radar, radar + 125_000, twists, sweeps, motion="corrected")["left_gap_ms"]) == 2


def test_usable_stamps(tmp_path):
    (tmp_path / "velodyne_left").mkdir()
    for name in ("10.png", "20.bin", "40.png", "notes.txt"):
        (tmp_path / "velodyne_left" / name).touch()
    session = Session(tmp_path, "s", np.array([1]), np.array([10, 20, 30]), None)
    np.testing.assert_array_equal(usable_stamps(session, "velodyne_left"), [10, 20])
    with pytest.raises(ValueError, match="velodyne_right: no usable frame"):
        usable_stamps(session, "velodyne_right")
    with pytest.raises(ValueError, match="radar: no usable frame"):
        usable_stamps(session, "radar")
    assert list(usable_sweeps(session)) == ["left"]
    with pytest.raises(ValueError, match="velodyne_left: no usable frame.*velodyne_right: no usable frame"):
        usable_sweeps(Session(tmp_path, "s", np.array([1]), None, np.array([10])))


# ---- velocities


@dataclass
class Odometry:
    increments: np.ndarray
    destination_stamps_us: np.ndarray
    source_stamps_us: np.ndarray


def chain(poses, times_us):
    return Odometry(relative_pose(poses[:-1], poses[1:]), times_us[:-1], times_us[1:])


def test_constant_twist_in_closed_form():
    """At a constant twist the velocity comes out exactly, however uneven the times."""
    twist = np.array([8.0, -0.4, 0.5])
    times = np.array([0, 250_000, 490_000, 760_000, 1_000_000]) + STAMP
    poses = exp(twist, (times - STAMP) / 1e6)
    np.testing.assert_allclose(estimate_twists(chain(poses, times)), np.tile(twist, (5, 1)), atol=1e-9)


def test_constant_acceleration_is_met_between_two_steps():
    times = np.array([0, 250_000, 450_000, 750_000]) + STAMP
    t = (times - STAMP) / 1e6
    poses = np.stack([3.0 * t + t**2, 0 * t, 0 * t], axis=1)
    twists = estimate_twists(chain(poses, times))
    np.testing.assert_allclose(twists[1:3, 0], 3.0 + 2.0 * t[1:3])
    assert abs(twists[0, 0] - 3.25) < 1e-9  # at the ends the one step there is


def test_velocities_refuse_broken_chains():
    times = np.arange(4) * 250_000
    good = chain(np.zeros((4, 3)), times)
    with pytest.raises(ValueError, match="no increment"):
        estimate_twists(Odometry(good.increments[:0], times[:0], times[:0]))
    with pytest.raises(ValueError, match="chain"):
        estimate_twists(Odometry(good.increments[[0, 2]], times[[0, 2]], times[[1, 3]]))
    with pytest.raises(ValueError, match="chain"):
        estimate_twists(Odometry(good.increments, times[1:], times[:-1]))


def test_real_velocities(real_root):
    from rol.oxford import load_radar_odometry

    odometry = load_radar_odometry(real_root / "RadarSLAMPy/data/full_seq_1/gt/radar_odometry.csv")
    twists = estimate_twists(odometry)
    assert len(twists) == len(odometry.increments) + 1
    assert 3.5 < np.hypot(twists[:, 0], twists[:, 1]).mean() < 4.5  # mean speed of the sessions is 4.1 m/s
    assert np.abs(twists[:, 1]).mean() < 0.2 and np.abs(twists[:, 2]).max() < 1.0
    assert accumulate_increments(odometry.increments).shape == twists.shape


# ---- one pair out of a session


@pytest.fixture
def session(tmp_path):
    """A session of one scan: a post at (20.125, 5.125) with ground below, at one place in both sensors."""
    root = tmp_path / "tiny"
    for folder in ("radar", "velodyne_left", "velodyne_right"):
        (root / folder).mkdir(parents=True)
    counters = np.arange(13, 5600, 14).astype(np.uint16)
    clockwise = 2 * np.pi * counters / 5600
    off = np.abs((clockwise + np.arctan2(5.125, 20.125) + np.pi) % (2 * np.pi) - np.pi)
    ranges = (np.arange(3768) + 0.5) * 0.0438 - 0.31
    spread = np.exp(-0.5 * (off[:, None] / 0.02) ** 2 - 0.5 * ((ranges - np.hypot(20.125, 5.125)) / 0.2) ** 2)
    rows = STAMP + np.arange(400) * 625
    scan = RadarScan(rows, counters, np.full(400, 255, np.uint8), np.rint(6 + 114 * spread).astype(np.uint8))
    save_radar(root / "radar" / f"{STAMP}.png", scan)
    in_radar = np.array([[20.125, 5.125, z, 1.0] for z in (-2.0, -1.6, -1.0, 0.5)] + [[60.1, 40.1, 0.0, 1.0]])
    for sensor in ("velodyne_left", "velodyne_right"):
        T = np.linalg.inv(np.linalg.inv(EXTRINSICS["radar"]) @ EXTRINSICS[sensor])
        points = in_radar.copy()
        points[:, :3] = in_radar[:, :3] @ T[:3, :3].T + T[:3, 3]
        save_velodyne_binary(root / sensor / f"{STAMP + 25_000}.bin", points.astype(np.float32))
    stamps = np.array([STAMP + 25_000])
    return Session(root, "tiny", np.array([STAMP]), stamps, stamps)


def test_both_images_show_the_post_at_one_pixel(session):
    radar_image, lidar_image = build_pair(session, ALIGNED)
    assert radar_image.dtype == lidar_image.dtype == np.uint8
    assert radar_image.shape == lidar_image.shape == (512, 512)
    np.testing.assert_array_equal(image_to_points(lidar_image), [[20.125, 5.125]])  # 72 m away: cropped
    assert np.unravel_index(radar_image.argmax(), (512, 512)) == (175, 235)
    assert 110 <= radar_image.max() <= 120


def test_ground_alone_gives_an_empty_image(session):
    assert not build_pair(session, ALIGNED, PairSettings(min_height=3.0))[1].any()


def test_correction_moves_lidar_points_to_mid_scan(session):
    """At 10 m/s a sweep 100 ms before mid-scan saw the post 1 m too far ahead; Doppler adds 0.49 m * cos."""
    mid, twist = STAMP + 125_000, (10.0, 0.0, 0.0)
    raw = load_lidar_points(session, STAMP + 25_000, STAMP + 25_000)
    moved = load_lidar_points(session, STAMP + 25_000, STAMP + 25_000, mid_stamp_us=mid, twist=twist)
    assert raw.shape == (10, 4)
    np.testing.assert_allclose(raw[:, :3] - moved[:, :3], np.tile([1.0, 0, 0], (10, 1)), atol=1e-5)
    images = build_pair(session, replace(ALIGNED, twist=twist), PairSettings("corrected"))
    np.testing.assert_array_equal(image_to_points(images[1]), [[19.125, 5.125]])
    row = np.unravel_index(images[0].argmax(), (512, 512))[0]
    # Seen at 346 of 360 deg, 0.115 s after mid-scan: 1.15 m farther then, and 0.47 m farther without Doppler.
    assert abs((255.5 - row) * 0.25 - (20.125 + 1.15 + 0.47)) < 0.3


def test_build_pair_refuses(session):
    sweeps = (STAMP + 25_000, STAMP + 25_000)
    with pytest.raises(ValueError, match="motion must be"):
        PairSettings("yes")
    with pytest.raises(ValueError, match="needs a twist"):
        build_pair(session, ALIGNED, PairSettings("corrected"))
    with pytest.raises(ValueError, match="mid_stamp_us"):
        load_lidar_points(session, *sweeps, twist=(1, 0, 0))
    with pytest.raises(ValueError, match=str(STAMP + 1)):
        build_pair(session, replace(ALIGNED, radar_stamp_us=STAMP + 1))


# ---- files


def images(seed=0, size=8):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (size, size), dtype=np.uint8), np.uint8(
        rng.random((size, size)) < 0.3
    ) * np.uint8(255)


def test_pair_round_trip(tmp_path):
    radar, lidar = images()
    save_pair(tmp_path, 17, radar, lidar)
    again = load_pair(tmp_path, 17)
    np.testing.assert_array_equal(again[0], radar)
    np.testing.assert_array_equal(again[1], lidar)
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["17.png", "17.png"]
    with pytest.raises(ValueError, match="uint8"):
        save_pair(tmp_path, 18, radar.astype(float), lidar)


def test_broken_files_are_named(tmp_path):
    save_pair(tmp_path, 17, *images())
    with pytest.raises(ValueError, match=r"radar.18\.png: the image is missing"):
        load_pair(tmp_path, 18)
    path = tmp_path / "lidar/17.png"
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(ValueError, match=r"lidar.17\.png: not a readable"):
        load_pair(tmp_path, 17)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"lidar.17\.png: not a readable"):
        load_pair(tmp_path, 17)
    save_pair(tmp_path, 17, *images())
    path.write_bytes((tmp_path / "radar/17.png").read_bytes())
    save_pair(tmp_path / "other", 17, *images(size=6))
    path.write_bytes((tmp_path / "other/lidar/17.png").read_bytes())
    with pytest.raises(ValueError, match="lidar image"):
        load_pair(tmp_path, 17)


def test_folder_is_whole_only_at_the_end(tmp_path):
    settings = {"min_height": -1.5}
    assert pair_folder(tmp_path / "s").prepare(settings) == set()
    save_pair(tmp_path / "s", 17, *images())
    with pytest.raises(ValueError, match=r"pairs\.json: missing"):
        list_pairs(tmp_path / "s")
    with pytest.raises(ValueError, match=r"18\.png: missing"):
        pair_folder(tmp_path / "s").finish(settings, [17, 18])
    pair_folder(tmp_path / "s").finish(settings, [17])
    assert list_pairs(tmp_path / "s") == [17]
    assert json.loads((tmp_path / "s/pairs.json").read_text(encoding="utf-8"))["settings"] == settings
    (tmp_path / "s/pairs.json").write_text('{"stamps_us": [1', encoding="utf-8")
    with pytest.raises(ValueError, match=r"pairs\.json: not a list"):
        list_pairs(tmp_path / "s")


def test_same_settings_resume_others_start_over(tmp_path):
    pair_folder(tmp_path).prepare({"a": 1})
    save_pair(tmp_path, 17, *images())
    save_pair(tmp_path, 18, *images())
    (tmp_path / "lidar/18.png").unlink()
    assert pair_folder(tmp_path).prepare({"a": 1}) == {17}
    assert pair_folder(tmp_path).prepare({"a": 2}) == set()
    assert not list(tmp_path.rglob("*.png"))


def test_description_changes_with_what_it_depends_on(session, tmp_path):
    alignment = tmp_path / "alignment.csv"
    alignment.write_text("radar_stamp_us\n1\n", encoding="utf-8")
    first = describe_pairs(session, alignment, PairSettings())
    assert first == describe_pairs(session, alignment, PairSettings())
    assert first["min_height"] == -1.5 and first["session"] == "tiny"
    (session.root / "session.json").write_text("{}", encoding="utf-8")
    second = describe_pairs(session, alignment, PairSettings())
    alignment.write_text("radar_stamp_us\n2\n", encoding="utf-8")
    third = describe_pairs(session, alignment, PairSettings())
    assert [name for name in first if first[name] != second[name]] == ["made_digest"]
    assert [name for name in second if second[name] != third[name]] == ["alignment_digest"]


@pytest.mark.parametrize("workers", [1, 2])
def test_write_pairs(session, tmp_path, workers):
    folder, settings = tmp_path / "pairs", PairSettings(width=128)
    assert list(write_pairs(session, folder, [ALIGNED], settings, workers)) == [STAMP]
    expected = build_pair(session, ALIGNED, PairSettings(width=128))
    np.testing.assert_array_equal(load_pair(folder, STAMP), expected)


def test_dataset(tmp_path):
    for stamp in (17, 18, 19):
        save_pair(tmp_path, stamp, *images(stamp))
    pair_folder(tmp_path).finish({}, [17, 18, 19])
    dataset = PairDataset(tmp_path)
    assert len(dataset) == 3
    radar, lidar = dataset[1]
    assert radar.shape == lidar.shape == (1, 8, 8) and radar.dtype == lidar.dtype == np.float32
    np.testing.assert_array_equal(np.rint((radar[0] + 1) * 127.5), images(18)[0])
    assert set(np.unique(lidar)) == {-1.0, 1.0}  # both ends of the range are met exactly
    assert PairDataset(tmp_path, [19]).stamps_us == [19]
    with pytest.raises(ValueError, match="no pair 20"):
        PairDataset(tmp_path, [17, 20])
    with pytest.raises(IndexError):
        dataset[3]
    assert Path(pairs.__file__).read_text(encoding="utf-8").count("import torch") == 0


def test_listing_without_points_is_named(tmp_path):
    folder = pairs.generated_folder(tmp_path)
    folder.prepare({})
    pairs.save_image(folder.path(1), np.zeros((8, 8), np.uint8))
    folder.finish({}, [1])
    with pytest.raises(ValueError, match=r"fake\.json: the key 'points' is missing"):
        list(pairs.read_points(tmp_path, [1]))
