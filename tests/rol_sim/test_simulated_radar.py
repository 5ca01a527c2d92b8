"""The simulated radar against plates, hedges and walls at known places, its statistics against real scans."""

import cv2
import numpy as np
import pytest

pytest.importorskip("open3d")
from rol_sim.sensors import radar_signal
from rol_sim.sensors.radar import RadarSettings, beam_azimuths, simulate_scan
from rol_sim.sensors.radar_surfaces import Surface, surface_table
from rol_sim.world.mesh import Material, make_mesh, merge_meshes
from rol_sim.world.scene import Scene
from rol_study import radar_statistics as statistics

pytestmark = pytest.mark.open3d

QUIET = RadarSettings(interference_rate=0.0, clutter_tail_db=-80.0)
FORBIDDEN = [1, 2, 3, 4, 5, 7, 8, 10, 11, 13, 16]
STILL = np.zeros((400, 2))


def plate(range_m, azimuth, width=0.3, height=4.0, material=Material.METAL, object_id=1):
    """An upright plate that faces the origin, its middle at a true range from (0, 0, 2)."""
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    along = 0.5 * width * np.array([-towards[1], towards[0], 0.0])
    up = np.array([0.0, 0.0, 0.5 * height])
    middle = range_m * towards + (0.0, 0.0, 2.0)
    corners = [middle - along - up, middle + along - up, middle + along + up, middle - along + up]
    return make_mesh(corners, [[0, 1, 2], [0, 2, 3]], material, object_id)


def scan(*meshes, seed=0, poses=None, velocities=STILL, settings=QUIET, movers=None):
    poses = np.zeros((400, 3)) if poses is None else poses
    return simulate_scan(
        Scene(merge_meshes(list(meshes))), poses, velocities, np.random.default_rng(seed), settings, movers
    )


def energy_centre(codes, rows, bins):
    """Centre of power of a piece of a scan, in rows and bins."""
    piece = radar_signal.codes_to_power(codes[rows[0] : rows[1], bins[0] : bins[1]])
    piece = np.where(piece > 0.01 * piece.max(), piece, 0.0)
    row, bin_ = np.mgrid[rows[0] : rows[1], bins[0] : bins[1]]
    return (row * piece).sum() / piece.sum(), (bin_ * piece).sum() / piece.sum()


def strongest(codes, row, bin_, reach=4):
    return int(codes[row - reach : row + reach + 1, bin_ - 15 : bin_ + 16].max())


def test_row_directions_are_the_sensors_counters():
    counters = -beam_azimuths() * 5600 / (2 * np.pi)
    np.testing.assert_allclose(counters, np.arange(13, 5600, 14))


def test_codes_of_small_powers_by_hand():
    # n = 3 = 2 * 1.5: 6.02 * (1 + 0.5) = 9.03; n = 5 = 4 * 1.25: 6.02 * 2.25 = 13.5 -> 14; n = 11: 20.3.
    powers = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 1024])
    np.testing.assert_array_equal(
        radar_signal.power_to_codes(powers), [0, 0, 6, 9, 12, 14, 15, 17, 18, 19, 20, 60]
    )
    np.testing.assert_array_equal(statistics.forbidden_codes(), FORBIDDEN)
    codes = np.array([0, 6, 12, 60, 100, 130])
    np.testing.assert_array_equal(
        radar_signal.power_to_codes(radar_signal.codes_to_power(codes) + 0.5), codes
    )


def test_range_response_is_as_wide_as_measured():
    level = 20 * np.log10(np.abs(radar_signal.range_response(np.array([0.0, 4.2, 8.5, 15.0]))))
    np.testing.assert_allclose(level[:3], [0.0, -3.0, -14.0], atol=0.7)
    assert -36 < level[3] < -30


@pytest.mark.parametrize(("range_m", "row"), [(12.0, 60.0), (40.0, 201.3), (90.0, 333.6)])
def test_plate_appears_at_its_range_and_azimuth(range_m, row):
    azimuth = -(13 + 14 * row) * 2 * np.pi / 5600
    codes = scan(plate(range_m, azimuth, width=0.01 * range_m))
    bin_ = (range_m + 0.31) / 0.0438 - 0.5
    window = (round(row) - 6, round(row) + 7), (round(bin_) - 15, round(bin_) + 16)
    assert codes[window[0][0] : window[0][1], window[1][0] : window[1][1]].max() > 80
    found_row, found_bin = energy_centre(codes, *window)
    assert abs(found_row - row) < 0.5
    assert abs(found_bin - bin_) < 1.0


def test_plate_behind_a_wall_is_hidden_and_behind_a_hedge_weaker():
    azimuth, bin_, row = beam_azimuths()[100], round(30.31 / 0.0438 - 0.5), 100
    target = plate(30.0, azimuth, width=1.0)
    bare = strongest(scan(target), row, bin_)
    brick = Surface(0.3)  # neither mirror nor corners
    wall = plate(15.0, azimuth, width=6.0, height=12.0, material=Material.WALL, object_id=2)
    settings = RadarSettings(
        interference_rate=0.0, clutter_tail_db=-80.0, streak_scale=0.0, surfaces={"WALL": brick}
    )
    hidden = strongest(scan(target, wall, settings=settings), row, bin_)
    hedge = plate(15.0, azimuth, width=6.0, height=12.0, material=Material.HEDGE, object_id=2)
    veiled = strongest(scan(target, hedge), row, bin_)
    assert bare > 100
    assert hidden < 35
    # Half the power passes on the way out and half on the way back: 6 dB or 12 codes, speckle on top.
    assert bare - 30 < veiled < bare - 3


def test_target_ahead_of_a_moving_radar_reads_nearer():
    row, range_m = 10, 50.0
    azimuth = beam_azimuths()[row]
    window = (row - 6, row + 7), (1090, 1200)
    target = plate(range_m, azimuth, width=0.5)
    _, still = energy_centre(scan(target), *window)
    _, ahead = energy_centre(scan(target, velocities=np.tile([10.0, 0.0], (400, 1))), *window)
    _, back = energy_centre(scan(target, velocities=np.tile([-10.0, 0.0], (400, 1))), *window)
    shift = 0.049 * 10.0 * np.cos(azimuth) / 0.0438
    assert ahead - still == pytest.approx(-shift, abs=0.5)
    assert back - still == pytest.approx(shift, abs=0.5)
    # A target that drives away as fast as the radar comes has no shift.
    moves = {1: (10.0, 0.0)}
    _, alike = energy_centre(scan(target, velocities=np.tile([10.0, 0.0], (400, 1)), movers=moves), *window)
    assert alike == pytest.approx(still, abs=0.5)


def test_motion_during_the_turn_shifts_late_rows():
    # Straight ahead lies the seam: row 0 sees the target from the start, row 399 from 2 m nearer.
    poses = np.zeros((400, 3))
    poses[:, 0] = np.linspace(0.0, 2.0, 400)
    codes = scan(plate(30.0, 0.0, width=1.0), poses=poses)
    first, last = (np.argmax(codes[row, 500:800]) + 500 for row in (0, 399))
    assert (first - last) * 0.0438 == pytest.approx(2.0, abs=0.15)


def test_mirror_wall_shows_a_ghost_behind_it():
    # Walls 10 m to the left and 6 m to the right: the left one is seen again at 10 + 16 m, by way of itself.
    walls = [
        plate(10.0, np.pi / 2, width=30.0, height=8.0, material=Material.FACADE, object_id=1),
        plate(6.0, -np.pi / 2, width=30.0, height=8.0, material=Material.FACADE, object_id=2),
    ]
    ghost, row = round(26.31 / 0.0438 - 0.5), int(np.argmin(np.abs(beam_azimuths() + 1.5 * np.pi)))
    with_ghost = strongest(scan(*walls), row, ghost, reach=10)
    no_bounce = RadarSettings(interference_rate=0.0, clutter_tail_db=-80.0, bounces=0)
    assert with_ghost > 60
    assert strongest(scan(*walls, settings=no_bounce), row, ghost, reach=10) < with_ghost - 30


def test_same_generator_same_bytes():
    target = plate(20.0, 1.0, width=3.0, material=Material.VEHICLE)
    np.testing.assert_array_equal(scan(target, seed=4), scan(target, seed=4))
    assert (scan(target, seed=4) != scan(target, seed=5)).any()


def test_empty_scan_has_the_noise_of_the_sensor():
    codes = scan(plate(500.0, 0.0))
    assert codes.shape == (400, 3768) and codes.dtype == np.uint8
    found = statistics.scan_statistics(codes)
    assert found["forbidden"] == 0
    measured = {3.0: 0.45, 28.0: 0.36, 41.0: 0.35, 80.0: 0.40, 106.0: 0.46, 145.0: 0.50}
    for range_m, share in measured.items():  # real quiet cells hold clutter and streaks too, so fewer zeros
        assert share - 0.04 < found["zero_fractions"][range_m] < share + 0.15
    np.testing.assert_allclose(
        found["range_correlation"], [0.93, 0.85, 0.74, 0.61, 0.49, 0.37, 0.28], atol=0.08
    )
    far = codes[:, 1500:1900].astype(float)
    assert abs(np.corrcoef(far[:-1].ravel(), far[1:].ravel())[0, 1]) < 0.03
    assert found["near_copies"]
    for range_m, code in {0.0: 29, 0.86: 44, 2.0: 20, 3.0: 5}.items():
        assert found["near_field"][range_m] == pytest.approx(code, abs=5)


def test_single_echo_is_spread_as_measured():
    args = np.array([100.0]), np.array([1500.0]), np.array([1e6])
    codes = radar_signal.echoes_to_codes(*args, np.random.default_rng(0), interference_rate=0.0)
    spread = statistics.point_spread(codes)
    np.testing.assert_allclose(spread["azimuth_db"][:4], [0, -6, -19, -28], atol=2.0)
    assert codes[100, 1500] == 120
    # The receiver is not quite straight: a second harmonic at twice the bin.
    assert 25 < codes[100, 2985:3015].max() < 60


def test_very_strong_echo_is_clipped_lifts_its_row_and_returns_at_odd_multiples():
    args = np.array([100.0, 200.0]), np.array([700.0, 700.0]), np.array([1e8, 1e3])
    codes = radar_signal.echoes_to_codes(*args, np.random.default_rng(0), interference_rate=0.0)
    assert codes.max() == 136
    assert codes[100, 2090:2110].max() > 90
    assert np.median(codes[100, 3000:]) > np.median(codes[200, 3000:]) + 3


def test_settings_replace_a_surface_and_bad_input_is_named():
    table = surface_table({"HEDGE": Surface(0.5, passes=0.25)})
    assert table[Material.HEDGE, 0] == 0.5 and table[Material.HEDGE, 7] == 0.25
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="row_poses"):
        simulate_scan(Scene(plate(9.0, 0.0)), np.zeros((399, 3)), STILL, rng)
    with pytest.raises(ValueError, match="row_velocities"):
        simulate_scan(Scene(plate(9.0, 0.0)), np.zeros((400, 3)), np.full((400, 2), np.nan), rng)
    with pytest.raises(ValueError, match="codes"):
        statistics.scan_statistics(np.zeros((400, 100), dtype=np.uint8))


def test_statistics_of_real_scans_are_those_measured(real_root):
    files = sorted((real_root / "RadarSLAMPy/data/tiny/radar").glob("*.png"))
    real = np.stack([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)[:, 11:] for file in files])
    found = statistics.scan_statistics(real)
    assert found["forbidden"] == 0 and found["greatest"] == 136 and found["near_copies"]
    assert set(FORBIDDEN).isdisjoint(np.unique(real)) and {0, 6, 9, 12, 14, 15, 17, 18} <= set(
        np.unique(real)
    )
    for code, share in {40: 0.055, 60: 0.021, 80: 0.0077, 100: 0.0019, 120: 0.0002}.items():
        assert found["fractions"][code] == pytest.approx(share, rel=0.1)
    measured = {3.0: 0.45, 28.0: 0.36, 41.0: 0.35, 80.0: 0.40, 106.0: 0.46, 145.0: 0.50}
    for range_m, share in measured.items():
        assert found["zero_fractions"][range_m] == pytest.approx(share, abs=0.04)
    np.testing.assert_allclose(
        found["range_correlation"], [0.93, 0.85, 0.74, 0.61, 0.49, 0.37, 0.28], atol=0.025
    )
    assert abs(found["azimuth_correlation"]) < 0.03
    for range_m, code in {0.0: 29, 0.86: 44, 2.0: 20, 3.0: 5}.items():
        assert found["near_field"][range_m] == pytest.approx(code, abs=1)
    np.testing.assert_allclose(list(found["floors"].values()), [0, 6, 9, 12], atol=1.5)
    np.testing.assert_allclose(found["point_spread"]["azimuth_db"], [0, -6, -19, -28, -37, -40], atol=3.5)
    assert found["point_spread"]["range_db"][4] == pytest.approx(-3, abs=0.5)
