"""Real scans on a map: chance, thresholds, pairs, starts, and the variants of a turn; all on small made-up scans."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.mcl import MclSettings
from rol_beyond.recovery import RecoverySettings
from rol_data.rall import RealScan
from rol_study import real_scans

WALL = np.column_stack([np.linspace(-20.0, 20.0, 200), np.full(200, 8.0)])
ROOM = np.vstack([WALL, WALL[:60] * (1, -1), WALL[:, ::-1] + (12.0, -8.0)])


def make_scan(stamp_us: int = 1) -> RealScan:
    """A scan with one strong target ahead and to the left."""
    power = np.zeros((400, 3768), dtype=np.uint8)
    power[350, 300] = 120
    azimuths = -2.0 * np.pi * np.arange(400) / 400
    return RealScan(Path("scan.png"), stamp_us, power, azimuths, np.zeros(3), (4.0, 0.0, 0.5))


def make_network(**points: object) -> SimpleNamespace:
    """What `evaluate_front_ends` reads of a network."""
    return SimpleNamespace(
        points={"threshold": 128, "thin": True, **points}, generator=SimpleNamespace(tta_rotations=4)
    )


def generate(network, power, azimuths, twist=None, tta_rotations=4):
    """A front end with as many points as headings, on the wall."""
    image = np.zeros((512, 512), dtype=np.uint8)
    image[200:203, 220:260] = 200
    return WALL[:tta_rotations], image, image


def test_by_chance_are_the_points_at_wrong_headings() -> None:
    found = real_scans.evaluate_with_chance(WALL, np.zeros(3), cKDTree(WALL))
    assert found["n"] == 200 and found["share_1m"] == found["share_2m"] == 1.0
    assert found["chance_1m"] < found["chance_2m"] < 0.1


def test_every_front_end_of_every_scan_is_a_row() -> None:
    networks = {"paper": make_network(), "unet": make_network()}
    scans = [make_scan(1), make_scan(2)]
    table, results = real_scans.evaluate_front_ends(scans, networks, "unet", cKDTree(WALL), generate)
    fronts = ["raw", "cfar", "paper", "unet", "unet, not thinned", "unet, one heading"]
    assert table["points"].tolist() == fronts * 2 and table.timestamp_us.tolist() == [1] * 6 + [2] * 6
    counts = table.set_index("points").n
    assert (
        (counts["unet"] == 4).all()
        and (counts["unet, one heading"] == 1).all()
        and (counts["raw"] == 1).all()
    )
    assert len(results) == 2 and results[0][0] is not None
    empty, none = real_scans.evaluate_front_ends([], networks, "unet", cKDTree(WALL), generate)
    assert none == [] and list(empty.columns) == list(table.columns)


def test_higher_thresholds_keep_fewer_points() -> None:
    image = np.zeros((512, 512), dtype=np.uint8)
    image[180, 200:300] = np.linspace(100, 250, 100).astype(np.uint8)
    table = real_scans.evaluate_thresholds(
        [image], [make_scan()], cKDTree(WALL), {"threshold": 1, "thin": False}, [100, 175, 251]
    )
    assert table.level.tolist() == [100, 175, 251]
    assert table.n.tolist() == [100, 50, 0]


def test_pairs_are_compared_within_the_reach_in_both_directions() -> None:
    sweep = np.array([[10.0, 0.0], [10.0, 5.0], [40.0, 0.0]])
    points = {"raw": np.array([[10.5, 0.0], [10.0, 1.5], [40.0, 0.0], [15.0, -9.0]])}
    [row] = real_scans.evaluate_pairs([points], [sweep], 20.0).to_dict("records")
    assert row["points"] == "raw" and row["n"] == 3  # the one at 40 m is out of reach
    assert row["share_1m"] == pytest.approx(1 / 3) and row["share_2m"] == pytest.approx(2 / 3)
    assert row["reached_1m"] == 0.5


def test_starts_are_off_in_all_directions_with_both_turns() -> None:
    starts = real_scans.wrong_starts(5.0, 3.0, 4)
    np.testing.assert_allclose(np.hypot(starts[:, 0], starts[:, 1]), 5.0)
    np.testing.assert_allclose(starts[0], [5.0, 0.0, np.deg2rad(3.0)], atol=1e-12)
    np.testing.assert_allclose(starts[1], [5.0, 0.0, -np.deg2rad(3.0)], atol=1e-12)
    np.testing.assert_allclose(starts[2, :2], [0.0, 5.0], atol=1e-12)


def test_errors_are_metres_and_degrees() -> None:
    poses = np.array([[[3.0, 4.0, 0.1], [0.0, 0.0, -np.pi]], [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]])
    errors = real_scans.position_and_heading_errors(poses, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]))
    np.testing.assert_allclose(
        errors, [[[5.0, np.rad2deg(0.1)], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]], atol=1e-9
    )


def test_runs_are_judged_from_a_scan_on() -> None:
    errors = np.zeros((4, 3, 2))
    errors[:, 0] = [[9.0, 9.0], [1.0, 1.0], [3.0, 3.0], [5.0, 5.0]]
    errors[2, 2] = [0.7, 0.1]
    summary = real_scans.summarize_starts([errors], 2, [0.6, 0.6])
    np.testing.assert_allclose(summary["median"][0], 4.0)
    np.testing.assert_allclose(summary["worst"], [0.7, 0.1])
    assert summary["met"] == 0.75
    short = real_scans.summarize_starts([errors[:, :1]], 2, [0.6, 0.6])
    assert np.isnan(short["worst"]).all() and np.isnan(short["met"])
    table = real_scans.tabulate_starts({"unet": summary})
    assert table.shape == (4, 2) and table["unet [m]"].tolist() == [4.0, 0.0, 0.0, 0.7]


def test_points_of_a_scan_and_a_twist_are_made_once() -> None:
    calls = []
    points_of = real_scans.cache_front_end(lambda scan, twist: calls.append(twist) or WALL)
    for _ in range(3):
        for scan in (make_scan(1), make_scan(2)):
            points_of(scan, None)
            points_of(scan, (1.0, 0.0, 0.0))
    assert len(calls) == 4


def make_settings() -> real_scans.LocalizerSettings:
    """Few particles around a start that is nearly right."""
    settings = MclSettings(n_particles=2000, start_spread_m=1.0, start_spread_yaw_rad=0.05)
    return real_scans.LocalizerSettings(settings, RecoverySettings(reference_contrast=0.2), 0.0)


def test_a_cloud_is_localized_from_every_start() -> None:
    pose = np.array([1.0, -2.0, 0.1])
    c, s = np.cos(0.1), np.sin(0.1)
    cloud = (ROOM - pose[:2]) @ np.array([[c, -s], [s, c]])
    starts = real_scans.wrong_starts(1.0, 2.0, 3)
    errors = real_scans.localize_points(cloud, pose, ROOM, starts, make_settings(), 1)
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
    table, points = real_scans.evaluate_turn(make_scan(), {"raw": front_end}, variants, WALL, localize)
    assert seen == [(None, 0.0), ((4.0, 0.0, 0.5), pytest.approx(-0.1))]
    assert table.loc[("recorded", "raw"), ["share_1m", "share_2m", "worst_m"]].tolist() == [0.0, 1.0, 1.5]
    assert table.loc[("turned", "raw"), ["share_1m", "m", "deg"]].tolist() == [1.0, 0.0, 1.5]
    assert set(points) == set(table.index)
