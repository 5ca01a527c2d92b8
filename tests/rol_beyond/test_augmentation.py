"""Augmentation: a rotated pair shows the rotated surroundings, gain, streaks and ghosts, joined sets."""

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rol.bev import image_to_points
from rol.oxford import RadarScan
from rol.pairs import AlignedScan, PairSettings
from rol_beyond import augmentation
from rol_beyond.augmentation import JoinedPairs, LidarClouds, ScanPairs, gather_clouds, rotated_radar_image
from rol_sim.session.oxford_files import save_radar

AZIMUTHS = -2.0 * np.pi * (13 + 14 * np.arange(400)) / 5600
SETTINGS = PairSettings("corrected", max_range=60.0, width=256, pixel_size=0.5)


def bright_spot(bearing: float, range_m: float) -> np.ndarray:
    power = np.full((400, 3768), 6, dtype=np.uint8)
    row = int(np.argmin(np.abs(np.angle(np.exp(1j * (AZIMUTHS - bearing))))))
    bin_ = round((range_m + 0.31) / 0.0438 - 0.5)
    power[row - 1 : row + 2, bin_ - 8 : bin_ + 9] = 200
    return power


def middle_of(image: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(image > 60)
    weights = image[rows, columns].astype(float)
    half = (image.shape[0] - 1) / 2.0
    return (
        np.array([np.average(half - rows, weights=weights), np.average(half - columns, weights=weights)])
        * 0.5
    )


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0, -1.1, -3.1, 3.14])
@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (12.0, 0.3, 0.2)])
def test_a_turned_scan_is_the_scan_of_a_turned_world(turn: float, twist: tuple) -> None:
    power = bright_spot(-1.2, 35.0)
    plain = middle_of(rotated_radar_image(power, AZIMUTHS, 0.0, twist, SETTINGS))
    turned = middle_of(rotated_radar_image(power, AZIMUTHS, turn, twist, SETTINGS))
    c, s = np.cos(turn), np.sin(turn)
    np.testing.assert_allclose(turned, np.array([[c, -s], [s, c]]) @ plain, atol=0.12)


def test_without_motion_turning_by_rows_moves_rows() -> None:
    power = np.random.default_rng(0).integers(0, 120, (400, 3768)).astype(np.uint8)
    plain = replace(SETTINGS, motion="none")
    turned = rotated_radar_image(power, AZIMUTHS, -2.0 * np.pi * 100 / 400, (0, 0, 0), plain)
    rolled = rotated_radar_image(np.roll(power, 100, axis=0), AZIMUTHS, 0.0, (0, 0, 0), plain)
    assert np.abs(turned.astype(int) - rolled).max() <= 1


def test_gain_changes_power_above_zero_only() -> None:
    power = np.array([[0, 6, 120, 254]], dtype=np.uint8)
    np.testing.assert_array_equal(augmentation.apply_gain(power, 2.0), [[0, 10, 124, 255]])
    np.testing.assert_array_equal(augmentation.apply_gain(power, -4.0), [[0, 1, 112, 246]])
    assert augmentation.apply_gain(power, 0.0) is power


def test_streaks_brighten_a_few_rows_and_darken_nothing() -> None:
    power = bright_spot(-1.2, 35.0)
    with_streaks = augmentation.add_streaks(power, 2, np.random.default_rng(1))
    assert (with_streaks >= power).all() and power[0, 0] == 6
    changed = np.flatnonzero((with_streaks != power).mean(axis=1) > 0.2)
    assert 2 <= len(changed) <= 14  # of 400
    near, far = (np.median(with_streaks[changed][:, part]) for part in (slice(700, 900), slice(3000, 3700)))
    assert near > far + 10
    np.testing.assert_array_equal(with_streaks, augmentation.add_streaks(power, 2, np.random.default_rng(1)))
    np.testing.assert_array_equal(augmentation.add_streaks(power, 0, np.random.default_rng(1)), power)


def test_ghosts_are_echoes_elsewhere() -> None:
    power = bright_spot(-1.2, 35.0)
    with_ghosts = augmentation.add_ghosts(power, 5, np.random.default_rng(1))
    assert (with_ghosts >= power).all() and (power > 6).sum() == 51
    changed = np.argwhere(with_ghosts != power)
    assert 5 < len(changed) <= 5 * 51 and changed[:, 1].max() < 1600
    assert with_ghosts[tuple(changed.T)].max() <= 200 and with_ghosts[tuple(changed.T)].max() > 100
    np.testing.assert_array_equal(with_ghosts, augmentation.add_ghosts(power, 5, np.random.default_rng(1)))
    quiet = np.full((400, 3768), 6, dtype=np.uint8)  # nothing bright, no ghosts
    np.testing.assert_array_equal(augmentation.add_ghosts(quiet, 5, np.random.default_rng(1)), quiet)


def make_pairs(tmp_path: Path) -> ScanPairs:
    save_radar(
        tmp_path / "1000.png",
        RadarScan(
            1000 + 625 * np.arange(400), (13 + 14 * np.arange(400)).astype(np.uint16),
            np.full(400, 255, np.uint8), bright_spot(-0.5, 20.0),
        ),
    )  # fmt: skip
    session = SimpleNamespace(name="sim-x", radar_path=lambda us: tmp_path / f"{us}.png")
    aligned = [AlignedScan(1000, 1, 2, 3, (5.0, 0.0, 0.1))]
    points = np.array([[10.0, 2.0], [-20.0, 31.0], [3.0, -8.0]])
    points = np.rint(points / augmentation.STEP_M).astype(np.int16)
    return ScanPairs(session, aligned, LidarClouds(points, np.array([0, 3])), SETTINGS)


def test_both_sides_of_a_pair_turn_together(tmp_path: Path) -> None:
    pairs, turn = make_pairs(tmp_path), 0.7
    radar, lidar = pairs.draw(0, turn)
    assert radar.shape == lidar.shape == (1, 256, 256) and radar.dtype == lidar.dtype == np.float32
    assert set(np.unique(lidar)) == {-1.0, 1.0} and -1.0 <= radar.min() < -0.9 and radar.max() > 0.3
    points = image_to_points(np.where(lidar[0] > 0, 255, 0).astype(np.uint8), pixel_size=0.5)
    turned = pairs.clouds.cloud(0) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    gaps = np.hypot(*(points[:, None] - turned[None]).transpose(2, 0, 1)).min(axis=0)
    assert gaps.max() <= 0.5 * 0.5 * np.sqrt(2.0) + 1e-9
    for plain, again in zip(pairs[0], pairs.draw(0, 0.0), strict=True):
        np.testing.assert_array_equal(plain, again)
    with_streaks = pairs.draw(0, 0.0, 0.0, 3, 2, np.random.default_rng(2))
    assert (with_streaks[0] > pairs[0][0]).sum() > 100  # the radar alone
    np.testing.assert_array_equal(with_streaks[1], pairs[0][1])
    with pytest.raises(ValueError, match="need a random generator"):
        pairs.draw(0, 0.0, 0.0, 1)


def test_joined_sets_count_on(tmp_path: Path) -> None:
    pairs = make_pairs(tmp_path)
    joined = JoinedPairs([pairs, pairs, pairs])
    assert len(joined) == 3 and joined.name(2).endswith("1000.png")
    np.testing.assert_array_equal(joined[2][1], pairs[0][1])
    with pytest.raises(IndexError, match="pair 3 of 3"):
        joined[3]
    with pytest.raises(ValueError, match="1 scans, but clouds of 2"):
        ScanPairs(
            pairs.session, pairs.aligned, LidarClouds(pairs.clouds.points, np.array([0, 1, 3])), SETTINGS
        )


@pytest.mark.parametrize("kind", ["truncated", "array", "text", "other"])
def test_a_broken_file_of_lidar_points_is_named_and_kept(tmp_path: Path, kind: str) -> None:
    path, aligned = tmp_path / "clouds.npz", [AlignedScan(1, 2, 3, 4, (0.0, 0.0, 0.0))]
    points, array = np.arange(2000, dtype=np.int16).reshape(-1, 2), io.BytesIO()
    np.savez(path, points=points, starts=[0, 1000], about=repr((SETTINGS, aligned)))
    assert len(gather_clouds(SimpleNamespace(), aligned, path, SETTINGS).points) == 1000
    np.save(array, points)
    broken = {"truncated": path.read_bytes()[:-100], "array": array.getvalue(), "text": b"x,y"}
    if kind == "other":
        np.savez(path, points=points)
    else:
        path.write_bytes(broken[kind])
    content = path.read_bytes()
    with pytest.raises(ValueError, match="clouds.npz: not a whole file of lidar points"):
        gather_clouds(SimpleNamespace(), aligned, path, SETTINGS)
    assert path.read_bytes() == content
