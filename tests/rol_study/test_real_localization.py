"""Localization of scans from wrong starts: errors, summaries and the variants of a turn, on small made-up scans."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree
from test_real_scans import WALL, make_scan

from rol.mcl import MclSettings
from rol_beyond.recovery import RecoverySettings
from rol_study import real_localization

ROOM = np.vstack([WALL, WALL[:60] * (1, -1), WALL[:, ::-1] + (12.0, -8.0)])


def test_starts_are_off_in_all_directions_with_both_turns() -> None:
    starts = real_localization.wrong_starts(5.0, 3.0, 4)
    np.testing.assert_allclose(np.hypot(starts[:, 0], starts[:, 1]), 5.0)
    np.testing.assert_allclose(starts[0], [5.0, 0.0, np.deg2rad(3.0)], atol=1e-12)
    np.testing.assert_allclose(starts[1], [5.0, 0.0, -np.deg2rad(3.0)], atol=1e-12)
    np.testing.assert_allclose(starts[2, :2], [0.0, 5.0], atol=1e-12)


def test_errors_are_metres_and_degrees() -> None:
    poses = np.array([[[3.0, 4.0, 0.1], [0.0, 0.0, -np.pi]], [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]])
    errors = real_localization.position_and_heading_errors(
        poses, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]])
    )
    np.testing.assert_allclose(
        errors, [[[5.0, np.rad2deg(0.1)], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]], atol=1e-9
    )


def test_runs_are_judged_from_a_scan_on() -> None:
    errors = np.zeros((4, 3, 2))
    errors[:, 0] = [[9.0, 9.0], [1.0, 1.0], [3.0, 3.0], [5.0, 5.0]]
    errors[2, 2] = [0.7, 0.1]
    summary = real_localization.summarize_starts([errors], 2, [0.6, 0.6])
    np.testing.assert_allclose(summary["median"][0], 4.0)
    np.testing.assert_allclose(summary["worst"], [0.7, 0.1])
    assert summary["met"] == 0.75
    short = real_localization.summarize_starts([errors[:, :1]], 2, [0.6, 0.6])
    assert np.isnan(short["worst"]).all() and np.isnan(short["met"])


def test_points_of_a_scan_are_made_once() -> None:
    calls = []
    points_of = real_localization.cache_front_end(lambda scan: calls.append(scan.stamp_us) or WALL)
    for _ in range(3):
        for scan in (make_scan(1), make_scan(2)):
            points_of(scan)
    assert len(calls) == 2


def make_settings() -> real_localization.LocalizerSettings:
    """Few particles around a start that is nearly right."""
    settings = MclSettings(n_particles=2000, start_spread_m=1.0, start_spread_yaw_rad=0.05)
    return real_localization.LocalizerSettings(settings, RecoverySettings(reference_contrast=0.2), 0.0)


def test_a_cloud_is_localized_from_every_start() -> None:
    pose = np.array([1.0, -2.0, 0.1])
    c, s = np.cos(0.1), np.sin(0.1)
    cloud = (ROOM - pose[:2]) @ np.array([[c, -s], [s, c]])
    starts = real_localization.wrong_starts(1.0, 2.0, 3)
    errors = real_localization.localize_points(cloud, pose, ROOM, starts, make_settings(), 1)
    assert errors.shape == (6, 2)
    assert np.median(errors[:, 0]) < 0.4 and np.median(errors[:, 1]) < 1.0


def test_variants_of_a_turn_get_the_twist_and_the_azimuths() -> None:
    seen = []

    def front_end(scan, twist):
        seen.append((twist, scan.azimuths[0]))
        return WALL if twist else WALL + (0.0, 1.5)

    def localize(points, pose, map_points):
        return np.array([[points[0, 1] - 8.0, 1.0], [0.0, 2.0]])

    variants = {"recorded": (False, 0.0), "turned": (True, -0.1)}
    table, points = real_localization.evaluate_turn(make_scan(), {"raw": front_end}, variants, WALL, localize)
    assert seen == [(None, 0.0), ((4.0, 0.0, 0.5), pytest.approx(-0.1))]
    assert table.loc[("recorded", "raw"), ["share_1m", "share_2m", "worst_m"]].tolist() == [0.0, 1.0, 1.5]
    assert table.loc[("turned", "raw"), ["share_1m", "m", "deg"]].tolist() == [1.0, 0.0, 1.5]
    assert set(points) == set(table.index)
    named = table.rename(index={"recorded": "compensated"}, level=0).rename(index={"raw": "fake"}, level=1)
    numbers = real_localization.describe_turn(named)
    assert numbers["compensated_fake_m"] == 0.75 and np.isnan(numbers["recorded_fake_m"])
    assert np.isnan(list(real_localization.describe_turn(None).values())).all()


def test_drives_are_localized_and_their_errors_named() -> None:
    scans = [make_scan(stamp) for stamp in (1, 250_001, 500_001, 750_001, 9_000_000)]
    drives = real_localization.split_drives(scans, ROOM, cKDTree(ROOM))
    assert [len(drive.scans) for drive in drives] == [4, 1] and len(drives[0].map_points) == len(ROOM)
    np.testing.assert_allclose(drives[0].seconds(), [0.0, 0.25, 0.5, 0.75])
    starts = real_localization.wrong_starts(0.5, 1.0, 2)
    runs = real_localization.localize_drives(
        drives, {"raw": lambda scan: ROOM}, starts, make_settings(), [1, 2]
    )
    assert [poses.shape for poses in runs["raw"].poses] == [(8, 4, 3), (8, 1, 3)]
    assert set(runs["raw"].first_run()) == {scan.stamp_us for scan in scans}
    numbers = real_localization.describe_runs(runs)
    assert numbers["raw_worst_m"] < 0.6 and np.isnan(numbers["fake_worst_m"])
    table = real_localization.tabulate_runs({"room": runs, "none": {}}, {"raw": "k-strongest"})
    assert table[["map", "points"]].values.tolist() == [["room", "k-strongest"]]
    assert table["worst [m]"][0] == numbers["raw_worst_m"]
    alone = real_localization.localize_alone(drives, lambda scan: ROOM, starts, make_settings(), 1)
    assert alone.shape == (5, 4, 2) and real_localization.describe_alone(alone)["lone_m"] < 0.6
    assert np.isnan(list(real_localization.describe_alone(alone[:0]).values())).all()
    assert real_localization.split_drives([], ROOM[:0], None) == []


def test_scans_are_tabulated_with_precision_and_pose() -> None:
    rows = [(1, "raw", 0.5, 0.6), (1, "unet", 0.7, 0.8), (1, "cfar", 0.1, 0.2)]
    judged = pd.DataFrame(rows, columns=["timestamp_us", "points", "share_1m", "share_2m"])
    table = real_localization.tabulate_scans(judged, "unet", {1: np.array([1.0, 2.0, 0.1])})
    names = ["timestamp_us", "share_1m_raw", "share_2m_raw", "share_1m_fake", "share_2m_fake"]
    assert list(table.columns) == [*names, "x_m", "y_m", "yaw_rad"]
    assert table.iloc[0].tolist() == [1, 0.5, 0.6, 0.7, 0.8, 1.0, 2.0, 0.1]
