"""Alignment: sweeps are found for scans, and known shifts of images to a fraction of a pixel."""

import cv2
import numpy as np
import pytest

from rol.alignment import (
    align_scans,
    best_shifts,
    correlate_images,
    correlate_ranges,
    measure_misalignment,
    usable_stamps,
    usable_sweeps,
)
from rol.oxford import Session
from rol.pairs import job_of_row


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
    assert job_of_row(row) == {
        "radar_stamp": 250_000,
        "left_stamp": 380_000,
        "right_stamp": 375_000,
        "mid_stamp_us": 375_000,
        "twist": (2.0, 0.2, 0.02),
    }
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
    job = job_of_row({name: values[1] for name, values in columns.items()})
    assert {job["left_stamp"], job["right_stamp"]} == {260_000, None} and job[f"{side}_stamp"] == 260_000
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
