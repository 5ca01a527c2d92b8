"""Misalignment of pairs: known shifts of images are found to a fraction of a pixel."""

import cv2
import numpy as np
import pandas as pd
import pytest

from rol.pairs import PairSettings
from rol_study import misalignment
from rol_study.misalignment import best_shifts, correlate_images, correlate_ranges, measure_misalignment


def street(seed=0, width=512):
    """A lidar image of random short walls within 60 m."""
    rng = np.random.default_rng(seed)
    image = np.zeros((width, width), dtype=np.uint8)
    for _ in range(60):
        start = rng.integers(60, width - 60, 2)
        end = start + rng.integers(-25, 25, 2)
        cv2.line(image, start.tolist(), end.tolist(), 255)
    return image


def blur(image, drow=0.0, dcol=0.0):
    """A radar image of the same place, moved by a shift, with noise."""
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    move = np.array([[1.0, 0.0, dcol], [0.0, 1.0, drow]])
    moved = cv2.warpAffine(soft, move, image.shape[::-1])
    return moved + np.random.default_rng(1).uniform(0, 20, image.shape)


@pytest.mark.parametrize(("drow", "dcol"), [(0.0, 0.0), (2.0, -3.0), (-1.4, 0.6), (4.5, 5.25)])
def test_finds_known_shifts(drow, dcol):
    image = street()
    found = measure_misalignment(blur(image, drow, dcol), image, max_shift_px=8)
    np.testing.assert_allclose(found, (drow, dcol), atol=0.12)


def test_correlation_agrees_with_a_slow_sum():
    lidar, radar = street(2), blur(street(2), 1, 1)
    surface = correlate_images(radar, lidar, 3, blind_px=0.0)
    hits = cv2.GaussianBlur((lidar > 0).astype(np.float32), (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
    sharp = radar.astype(np.float32)
    sharp = sharp - cv2.blur(sharp, (33, 33), borderType=cv2.BORDER_REFLECT)
    padded = np.pad(sharp, 3)
    for i, j in ((0, 0), (3, 3), (4, 4), (6, 1)):
        slow = (padded[i : i + 512, j : j + 512] * hits).sum() / np.linalg.norm(sharp) / np.linalg.norm(hits)
        assert surface[i, j] == pytest.approx(slow, abs=1e-4)
    assert np.unravel_index(surface.argmax(), surface.shape) == (4, 4)


def test_no_answer_rather_than_a_wrong_one():
    image = street()
    assert np.isnan(measure_misalignment(blur(image), np.zeros_like(image), 4)).all()
    assert np.isnan(measure_misalignment(np.zeros(image.shape), image, 4)).all()
    assert np.isnan(measure_misalignment(blur(image, 7.0, 0.0), image, 4)).all()  # beyond the search


def test_blind_zone_hides_the_leakage():
    image = street()
    radar = blur(image, 1.0, 0.0)
    radar[250:262, 250:262] += 5000.0
    image[254:258, 250:256] = 255  # the lidar's own car
    np.testing.assert_allclose(measure_misalignment(radar, image, 6, blind_px=25.0), (1.0, 0.0), atol=0.12)


def rings(radii, width=512):
    """Dashed rings around the sensor."""
    image = np.zeros((width, width), dtype=np.uint8)
    for i, radius in enumerate(radii):
        for bearing in np.arange(0.1 * i, 2 * np.pi, 0.4):
            angles = np.linspace(bearing, bearing + 0.15, 60)
            rows, cols = 255.5 - radius / 0.25 * np.cos(angles), 255.5 - radius / 0.25 * np.sin(angles)
            image[np.rint(rows).astype(int), np.rint(cols).astype(int)] = 255
    return image


def test_radial_shift_grows_with_range():
    """Radii stretched by 1.02 and shifted by -0.3 m must come out as such."""
    radii = np.arange(8.0, 60.0, 4.0)
    lidar, radar = rings(radii), cv2.GaussianBlur(rings(radii * 1.02 - 0.3), (0, 0), 1.5)
    edges = np.arange(6.0, 59.0, 4.0)
    shifts, table = correlate_ranges(radar, lidar, edges)
    assert table.shape == (len(edges) - 1, len(shifts)) and shifts[len(shifts) // 2] == 0.0
    expected = radii[: len(edges) - 1] * 0.02 - 0.3
    np.testing.assert_allclose(best_shifts(shifts, table), expected, atol=0.1)
    lines = np.polyfit(radii[: len(edges) - 1], best_shifts(shifts, table), 1)
    assert abs(lines[0] - 0.02) < 0.002


def test_best_shifts_by_hand():
    shifts = np.array([-1.0, 0.0, 1.0, 2.0])
    table = np.array([[0.0, 3.0, 4.0, 3.0], [0.0, 4.0, 4.0, 0.0], [1.0, 1.0, 1.0, 1.0], [9.0, 1.0, 0.0, 0.0]])
    np.testing.assert_allclose(best_shifts(shifts, table), [1.0, 0.5, np.nan, np.nan])


def test_pairs_are_measured_under_each_setting(monkeypatch):
    lines = pd.DataFrame(
        {"radar_stamp_us": [1, 2], "mid_stamp_us": [1, 2], "left_stamp_us": [1, 2]}
        | {"vx_mps": [3.0, 0.0], "vy_mps": [4.0, 0.0], "yaw_rate_radps": [0.0, 0.0]}
    )
    built = []

    def build_pair(session, scan, setting):
        built.append((session, scan.radar_stamp_us, setting.motion))
        image = street(scan.radar_stamp_us)
        return blur(image, 3.0 if setting.motion == "none" else 0.0), image

    monkeypatch.setattr(misalignment, "build_pair", build_pair)
    settings = {"as is": PairSettings("none"), "compensated": PairSettings("corrected")}
    edges = np.array([5.0, 20.0, 40.0])
    found, radial_m = misalignment.measure_pairs(
        "session", {"none": lines, "corrected": lines[:1]}, settings, edges
    )
    assert built == [("session", 1, "none"), ("session", 2, "none"), ("session", 1, "corrected")]
    assert found.option.tolist() == ["as is", "as is", "compensated"]
    np.testing.assert_allclose(found.speed_mps, [5.0, 0.0, 5.0])
    np.testing.assert_allclose(found.drow, [3.0, 3.0, 0.0], atol=0.12)
    np.testing.assert_allclose(found.shift_px, np.hypot(found.drow, found.dcol))
    assert list(radial_m) == ["compensated"]  # only these can be compared along range
    np.testing.assert_allclose(radial_m["compensated"], 0.0, atol=0.1)
