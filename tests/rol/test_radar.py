"""Radar: the SDK's convention, a target at the right pixel, motion and Doppler in closed form."""

import math

import cv2
import numpy as np
import pytest

from rol import radar
from rol.geometry import exp
from rol.radar import (
    MEASURED,
    SDK,
    RangeCalibration,
    ScanMotion,
    azimuth_times,
    compensate_points,
    deskew_points,
    doppler_shift,
    find_peaks,
    k_strongest_peaks,
    peaks_to_points,
    polar_to_cartesian,
)

COUNTERS = np.arange(13, 5600, 14)
AZIMUTHS = -2.0 * np.pi * COUNTERS / 5600.0
STEP = 2.0 * np.pi * 14 / 5600
BINS_5_CM = RangeCalibration(0.05)


def slow_polar_to_cartesian(power, clockwise, resolution, pixel_size, width, offset=0.0):
    """The convention word by word, one pixel at a time; clockwise angles, x up, y right."""
    span = (width / 2 - 0.5) * pixel_size
    wrapped = np.vstack([power[-1:], power, power[:1]]).astype(float)
    image = np.zeros((width, width))
    for row in range(width):
        for col in range(width):
            forward, right = span - row * pixel_size, col * pixel_size - span
            r = math.hypot(forward, right)
            angle = math.atan2(right, forward)
            angle += 2 * math.pi if angle < 0 else 0.0
            u = max((r - offset - resolution / 2) / resolution, 0.0)
            v = (angle - clockwise[0]) / (clockwise[1] - clockwise[0]) + 1
            i, j = math.floor(v), math.floor(u)
            for di, wi in ((0, 1 - (v - i)), (1, v - i)):
                for dj, wj in ((0, 1 - (u - j)), (1, u - j)):
                    if i + di < wrapped.shape[0] and j + dj < wrapped.shape[1]:
                        image[row, col] += wi * wj * wrapped[i + di, j + dj] / 255
    return image


@pytest.mark.parametrize(("width", "offset"), [(64, 0.0), (64, -0.31), (33, 0.5)])
def test_agrees_with_slow_loop(width, offset):
    power = np.random.default_rng(1).integers(0, 256, (400, 150), dtype=np.uint8)
    fast = polar_to_cartesian(
        power, AZIMUTHS, calibration=RangeCalibration(0.0432, offset), pixel_size=0.25, width=width
    )
    slow = slow_polar_to_cartesian(power, -AZIMUTHS, 0.0432, 0.25, width, offset)
    assert fast.dtype == np.float32 and fast.shape == (width, width)
    assert width < 64 or slow[0, 0] == fast[0, 0] == 0.0  # beyond the last bin
    np.testing.assert_allclose(fast, slow, atol=2e-4)


def test_agrees_with_slow_loop_on_a_real_scan(real_root):
    path = min((real_root / "RadarSLAMPy/data/tiny/radar").glob("*.png"))
    raw = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    counters = np.ascontiguousarray(raw[:, 8:10]).view("<u2").ravel()
    power, azimuths = raw[:, 11:], -2.0 * np.pi * counters / 5600.0
    fast = polar_to_cartesian(power, azimuths, pixel_size=1.0, width=96)
    slow = slow_polar_to_cartesian(power, -azimuths, 0.0432, 1.0, 96)
    np.testing.assert_allclose(fast, slow, atol=2e-4)


def measured_bearing(image):
    """Bearing of the image's weighted mean [deg]."""
    forward, left = centroid(image)
    return math.degrees(math.atan2(left, forward))


def shifted(counts):
    """Azimuths of a scan that begins ahead, some rows a number of encoder counts farther on."""
    azimuths = -2.0 * np.pi * np.arange(400) * 14 / 5600.0
    for row, n in counts.items():
        azimuths[row] -= 2.0 * np.pi * n / 5600.0
    return azimuths


@pytest.mark.parametrize(
    "azimuths",
    [
        shifted({1: 1}),
        shifted({1: -1}),
        shifted({0: 3}),
        shifted({399: 4}),
        shifted({299: 5, 300: 5, 301: 5}),
        shifted({row: n for row, n in enumerate(np.random.default_rng(1).integers(-3, 4, 400))}),
        shifted({}) + 2.0,
    ],
)
@pytest.mark.parametrize("motion", [None, ScanMotion((0.0, 0.0, 0.0), doppler_seconds=0.0)])
def test_image_and_peaks_agree_on_the_bearing(azimuths, motion):
    for row in (0, 1, 150, 300, 399):
        power = np.zeros((400, 700), dtype=np.uint8)
        power[row, 595:606] = 200 - 30 * np.abs(np.arange(-5, 6))
        power[[row - 1, (row + 1) % 400]] = power[row] // 2
        image = polar_to_cartesian(power, azimuths, calibration=BINS_5_CM, width=256, motion=motion)
        x, y = k_strongest_peaks(power, azimuths, 1, 200, calibration=BINS_5_CM)[0]
        off = measured_bearing(image) - math.degrees(math.atan2(y, x))
        assert (
            abs((off + 180.0) % 360.0 - 180.0) < 0.35
        )  # steps of 0.9 deg; each side reaches to its own neighbour


def test_even_azimuths_need_no_table():
    for azimuths in (AZIMUTHS, AZIMUTHS + 2.0, shifted({})):
        assert radar._row_table(azimuths, STEP) is None
    assert radar._row_table(shifted({1: 1}), STEP) is not None


@pytest.mark.parametrize("rows", [np.r_[0:100], np.r_[-50:50], np.r_[0:100, 200:400]])
def test_nothing_is_shown_where_nothing_was_measured(rows):
    """A sector to the right, a sector ahead, a turn with a hole."""
    power = np.full((len(rows), 700), 200, dtype=np.uint8)
    image = polar_to_cartesian(power, -rows * STEP, calibration=BINS_5_CM, width=101)
    x, y = 50 - np.indices(image.shape)
    numbers = np.degrees(np.arctan2(-y, x)) % 360.0 / 0.9
    is_seen = np.isin(numbers.astype(int), rows % 400)
    is_edge = np.abs(numbers[..., None] - [0, 50, 100, 200, 350, 400]).min(axis=-1) < 2.0
    is_sure = (np.hypot(x, y) > 5) & ~is_edge
    np.testing.assert_allclose(image[is_sure & is_seen], 200 / 255, atol=1e-6)
    assert image[is_sure & ~is_seen].max() == 0.0


def test_the_seam_between_last_and_first_row_is_interpolated():
    power = np.full((400, 1000), 200, dtype=np.uint8)
    np.testing.assert_allclose(polar_to_cartesian(power, AZIMUTHS, width=200), 200 / 255, atol=1e-6)


def test_single_target_lands_at_its_pixel():
    """Row 100 looks 90.8 deg clockwise, to the right; bin 600 lies at 600.5 * 0.05 = 30.025 m."""
    power = np.zeros((400, 1500), dtype=np.uint8)
    power[100, 596:605] = [50, 100, 150, 200, 250, 200, 150, 100, 50]
    image = polar_to_cartesian(power, AZIMUTHS, calibration=BINS_5_CM, pixel_size=0.25)
    bearing = -2.0 * np.pi * (13 + 1400) / 5600
    x, y = 30.025 * np.cos(bearing), 30.025 * np.sin(bearing)
    assert x < 0 and y < -29  # behind by a little, and to the right
    row, col = np.unravel_index(image.argmax(), image.shape)
    assert abs(row - (255.5 - x / 0.25)) <= 1.0 and abs(col - (255.5 - y / 0.25)) <= 0.5


def test_range_offset_moves_the_target():
    power = np.zeros((400, 1500), dtype=np.uint8)
    power[:] = np.rint(200 * np.exp(-0.5 * ((np.arange(1500) - 702.5) / 12.0) ** 2))
    for offset in (0.0, -0.31):
        image = polar_to_cartesian(power, AZIMUTHS, calibration=RangeCalibration(0.0438, offset))
        column = image[:256, 255].astype(float)
        x = (255.5 - np.arange(256)) * 0.25
        assert abs((column * x).sum() / column.sum() - (703 * 0.0438 + offset)) < 0.01


def simulate_dot(twist, place, doppler_seconds, n_bins=2000, resolution=0.05):
    """A scan of one resting target, seen by a radar at constant twist; place in the frame at mid-scan."""
    power = np.zeros((400, n_bins), dtype=np.uint8)
    for row, t in enumerate(azimuth_times(400)):
        x, y, yaw = exp(twist, t)
        dx, dy = place[0] - x, place[1] - y
        bearing = math.atan2(dy, dx) - yaw
        off = abs((bearing - AZIMUTHS[row] + math.pi) % (2 * math.pi) - math.pi)
        closing = twist[0] * math.cos(bearing) + twist[1] * math.sin(bearing)
        read = math.hypot(dx, dy) - doppler_seconds * closing
        bins = np.arange(n_bins)
        spread = np.exp(-0.5 * ((bins + 0.5 - read / resolution) / 4.0) ** 2 - 0.5 * (off / STEP) ** 2)
        power[row] = np.rint(255 * spread)
    return power


def centroid(image):
    weight = image.astype(float)
    rows, cols = np.indices(image.shape)
    half = (image.shape[0] - 1) / 2
    return np.array(
        [((half - rows) * weight).sum() / weight.sum(), ((half - cols) * weight).sum() / weight.sum()]
    )


@pytest.mark.parametrize("place", [(30.0, 12.0), (-25.0, 8.0), (4.0, -20.0), (28.0, 4.0), (20.0, -9.0)])
def test_motion_and_doppler_are_taken_out(place):
    twist = (10.0, 0.3, 0.4)
    power = simulate_dot(twist, place, 0.049)
    options = {"calibration": BINS_5_CM, "pixel_size": 0.25, "width": 300}
    moved = centroid(polar_to_cartesian(power, AZIMUTHS, motion=ScanMotion(twist), **options)) * 0.25
    assert np.linalg.norm(moved - place) < 0.05
    blurred = centroid(polar_to_cartesian(power, AZIMUTHS, **options)) * 0.25
    assert np.linalg.norm(blurred - place) > 0.3  # 10 m/s for up to 0.125 s, and 0.49 m of Doppler ahead


def test_zero_twist_changes_nothing():
    power = np.random.default_rng(2).integers(0, 100, (400, 800), dtype=np.uint8)
    plain = polar_to_cartesian(power, AZIMUTHS, width=100)
    still = polar_to_cartesian(power, AZIMUTHS, width=100, motion=ScanMotion((0.0, 0.0, 0.0)))
    np.testing.assert_allclose(still, plain, atol=1e-3)


def test_deskew_points():
    """One second at 1 m/s and a quarter turn: what is ahead afterwards lay to the left before."""
    points = np.array([[1.0, 0.0, 5.0], [1.0, 0.0, 5.0]])
    moved = deskew_points(points, np.array([0.0, 1.0]), (1.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(moved, [[1, 0, 5], [2 / np.pi, 2 / np.pi + 1, 5]], atol=1e-12)
    np.testing.assert_array_equal(points[1], [1.0, 0.0, 5.0])
    assert deskew_points(np.zeros((0, 2)), np.zeros(0), (1, 0, 0)).shape == (0, 2)


def test_doppler_shift():
    shift = doppler_shift(np.array([0.0, np.pi / 2, np.pi]), (10.0, 0.0, 0.1))
    np.testing.assert_allclose(shift, [-0.49, 0.0, 0.49], atol=1e-12)
    np.testing.assert_allclose(doppler_shift(np.array([np.pi / 2]), (0.0, 2.0), 0.05), [-0.1], atol=1e-12)


def test_azimuth_times():
    np.testing.assert_allclose(azimuth_times(4, 0.2), [-0.1, -0.05, 0.0, 0.05])


def test_find_peaks_by_hand():
    power = np.array([[0, 70, 90, 80, 0, 65, 65, 10, 61], [99, 0, 59, 0, 0, 0, 0, 0, 0]], dtype=np.uint8)
    rows, bins = find_peaks(power, k=2, min_power=60)
    assert list(zip(rows, bins, strict=True)) == [(0, 2), (0, 5), (1, 0)]
    rows, bins = find_peaks(power, k=9, min_power=60, min_bin=1)
    assert list(zip(rows, bins, strict=True)) == [(0, 2), (0, 5), (0, 8)]
    assert len(find_peaks(np.zeros((3, 5), dtype=np.uint8))[0]) == 0


def test_peaks_become_points():
    power = np.zeros((400, 1000), dtype=np.uint8)
    power[99, 500], power[99, 30], power[299, 800] = 120, 130, 90
    points = k_strongest_peaks(power, AZIMUTHS, calibration=MEASURED, range_limits_m=(2.5, 30.0))
    bearing, r = (
        AZIMUTHS[99],
        500.5 * 0.0438 - 0.31,
    )  # the one in bin 30 is too near, the one in bin 800 too far
    np.testing.assert_allclose(points, [[r * np.cos(bearing), r * np.sin(bearing)]])


def test_peaks_with_motion_meet_the_place():
    twist, place = (10.0, 0.3, 0.4), (30.0, 12.0)
    power = simulate_dot(twist, place, 0.049)
    points = k_strongest_peaks(power, AZIMUTHS, 1, 150, calibration=BINS_5_CM, motion=ScanMotion(twist))
    assert len(points) and np.linalg.norm(points.mean(axis=0) - place) < 0.25


@pytest.mark.parametrize("place", [(30.0, 12.0), (-20.0, 5.0), (15.0, -25.0), (-4.0, -8.0)])
def test_points_of_a_scan_as_recorded_move_to_their_place(place):
    twist = (10.0, 0.3, 0.4)
    recorded = k_strongest_peaks(simulate_dot(twist, place, 0.049), AZIMUTHS, 1, 150, calibration=BINS_5_CM)
    assert np.linalg.norm(recorded.mean(axis=0) - place) > 0.4
    moved = compensate_points(recorded, ScanMotion(twist))
    assert np.linalg.norm(moved.mean(axis=0) - place) < 0.25


def test_real_peaks_lie_on_the_real_map(real_root):
    """Measured elsewhere: 50-73 % of raw peaks lie within 1 m of the map at the fitted poses."""
    image = cv2.imread(
        str(real_root / "RaLL/data/maps/RobotCar/png/oxford_laser_map.png"), cv2.IMREAD_GRAYSCALE
    )
    row = np.genfromtxt("data/oxford_scan_map_poses.csv", delimiter=",", skip_header=1)[5]
    path = real_root / f"RadarSLAMPy/data/tiny/radar/{int(row[0])}.png"
    raw = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    azimuths = -2.0 * np.pi * np.ascontiguousarray(raw[:, 8:10]).view("<u2").ravel() / 5600.0
    points = k_strongest_peaks(
        raw[:, 11:], azimuths, min_power=80, range_limits_m=(2.5, 64.0), calibration=MEASURED
    )
    c, s = np.cos(row[3]), np.sin(row[3])
    x, y = c * points[:, 0] - s * points[:, 1] + row[1], s * points[:, 0] + c * points[:, 1] + row[2]
    distance = cv2.distanceTransform(np.uint8(image == 0), cv2.DIST_L2, 5) * 0.25
    near = distance[((1500 - x) / 0.25).astype(int), ((800 - y) / 0.25).astype(int)]
    assert np.mean(near < 1.0) > 0.45


SCAN = np.zeros((400, 10), dtype=np.uint8)


@pytest.mark.parametrize(
    ("power", "azimuths", "fault"),
    [
        (SCAN, AZIMUTHS[:-1], "expected power"),
        (SCAN[0], AZIMUTHS, "expected power"),
        (np.zeros((10, 400), dtype=np.uint8), AZIMUTHS, "the power is transposed"),
        (SCAN / 255, AZIMUTHS, "power 0..255 .* as uint8, got float64"),
        (SCAN.astype(np.int16), AZIMUTHS, "as uint8, got int16"),
        (SCAN, np.zeros(400), "decrease"),
        (SCAN, -AZIMUTHS, "azimuths must decrease .*, row 1 does not"),
        (SCAN, np.where(np.arange(400) == 7, np.nan, AZIMUTHS), "row 7 does not"),
        (SCAN, 2.0 * AZIMUTHS, "within one turn, they decrease by 718.2 deg"),
    ],
)
def test_refuses_bad_scans(power, azimuths, fault):
    for function in (polar_to_cartesian, k_strongest_peaks, radar.check_scan):
        with pytest.raises(ValueError, match=fault):
            function(power, azimuths)


@pytest.mark.parametrize("power", [SCAN / 255, SCAN.astype(np.int64), SCAN[0]])
def test_detectors_refuse_what_is_no_power_of_a_scan(power):
    with pytest.raises(ValueError, match="power 0..255"):
        find_peaks(power)


def test_peaks_refuse_azimuths_that_rise():
    with pytest.raises(ValueError, match="azimuths must decrease"):
        peaks_to_points(np.array([1]), np.array([1]), -AZIMUTHS)


def test_calibrations():
    assert (SDK.resolution_m, SDK.offset_m) == (0.0432, 0.0)
    assert (MEASURED.resolution_m, MEASURED.offset_m) == (0.0438, -0.31)


@pytest.mark.parametrize("name", ["resolution_m", "offset_m"])
@pytest.mark.parametrize("value", [math.nan, math.inf, "0.04", None])
def test_calibrations_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}: "):
        radar.RangeCalibration(**{"resolution_m": 0.0438, name: value})
    with pytest.raises(ValueError, match="resolution_m: 0.0 is not in"):
        radar.RangeCalibration(0.0)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"twist": (1.0, 0.0)}, "twist: expected shape"),
        ({"twist": (1.0, math.nan, 0.0)}, "twist: value at index"),
        ({"scan_seconds": 0.0}, "scan_seconds: 0.0 is not in"),
        ({"doppler_seconds": math.nan}, "doppler_seconds: nan is not in"),
    ],
)
def test_motions_out_of_range_are_refused(change, fault):
    with pytest.raises(ValueError, match=fault):
        radar.ScanMotion(**{"twist": (1.0, 0.0, 0.0), **change})
