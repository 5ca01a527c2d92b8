"""Comparison of real and simulated scans: statistics of motion and map, and the two-sample classifier."""

from pathlib import Path

import numpy as np
import pytest

from rol.oxford import load_radar
from rol_data import rall
from rol_sim.sensors.radar_signal import echoes_to_codes, range_to_bins
from rol_sim.session.simulation import build_counterparts, make_scan
from rol_study import radar_statistics as statistics
from rol_study import two_sample_classifier


def noise_scans(n: int, scale: float, seed: int) -> np.ndarray:
    rng, nothing = np.random.default_rng(seed), np.zeros(0)
    return np.stack([
        echoes_to_codes(nothing, nothing, nothing, rng, noise_scale=scale, interference_rate=0.0) for _ in range(n)
    ])  # fmt: skip


def moving_scans(doppler: float, n: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Scans of bright points by a car that drives 2 m a turn through them."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-60.0, 60.0, (160, 2))
    poses = np.column_stack([2.0 * np.arange(n) - 6.0, np.zeros(n), np.zeros(n)])
    scans = []
    for x, _, _ in poses:
        rows = np.arange(400)
        for _ in range(4):  # the row in which a point is seen depends on where the car is then
            places = x + 2.0 * ((rows + 0.5) / 400.0 - 0.5) if np.ndim(rows) and len(rows) == 160 else x
            angle = -np.arctan2(points[:, 1], points[:, 0] - places) % (2.0 * np.pi)
            rows = (angle * 5600 / (2.0 * np.pi) - 13) / 14
        places = x + 2.0 * ((rows + 0.5) / 400.0 - 0.5)
        ranges = np.hypot(points[:, 1], points[:, 0] - places)
        ranges -= doppler * 8.0 * (points[:, 0] - places) / ranges
        power = np.full(160, 3e4)
        scans.append(echoes_to_codes(rows, range_to_bins(ranges), power, rng, interference_rate=0.0))
    return np.stack(scans), poses


@pytest.mark.parametrize("doppler", [0.05, -0.05])
def test_doppler_shift_and_motion_are_found_from_scans_alone(doppler: float) -> None:
    scans, poses = moving_scans(doppler)
    found = statistics.motion_statistics(scans, poses, doppler_seconds=tuple(np.arange(-0.09, 0.1, 0.02)))
    assert found["doppler_seconds"] == pytest.approx(doppler, abs=0.011)
    assert found["metres_per_turn"] == pytest.approx(2.0)
    assert found["correlation_raw"] < found["correlation_both"]
    assert found["correlation_motion"] < found["correlation_both"] - 0.01


def test_map_fractions_count_peaks_near_the_map() -> None:
    scans, poses = moving_scans(0.0)
    rng = np.random.default_rng(5)
    points = rng.uniform(-60.0, 60.0, (160, 2))
    assert statistics.map_fractions(scans[3:4], poses[3:4], points)[0, 1] > 0.9
    half = statistics.map_fractions(scans[3:4], poses[3:4], points[:80])[0, 1]
    assert 0.35 < half < 0.75
    empty = np.zeros((1, 400, 3768), dtype=np.uint8)
    assert np.isnan(statistics.map_fractions(empty, poses[:1], points)).all()


def test_hellinger_distance_of_histograms() -> None:
    p, q = np.array([0.5, 0.5, 0.0]), np.array([0.0, 0.0, 1.0])
    assert statistics.hellinger_distance(p, p) == 0.0 and statistics.hellinger_distance(p, q) == 1.0
    histogram = statistics.code_histogram(noise_scans(1, 1.0, 0))
    assert histogram.sum() == pytest.approx(1.0) and (histogram[statistics.forbidden_codes()] == 0.0).all()


def test_differences_between_sets_of_scans() -> None:
    quiet, louder = (statistics.scan_statistics(noise_scans(1, scale, 0)) for scale in (1.0, 1.5))
    equal = statistics.compare_statistics(quiet, quiet)
    assert equal == {
        "hellinger": 0.0,
        "brightness_min": 1.0,
        "brightness_max": 1.0,
        "zeros": 0.0,
        "noise": 0.0,
    }
    found = statistics.compare_statistics(louder, quiet)
    assert found["hellinger"] > 0.05 and found["brightness_max"] > 1.0 and found["zeros"] > 0.05
    rows = statistics.summarize_scans(louder, quiet)
    assert rows["Hellinger distance of the codes to real"] == found["hellinger"]


def test_agreement_is_a_mean_with_its_extremes() -> None:
    motion = dict.fromkeys(
        ("metres_per_turn", "correlation_raw", "correlation_motion", "correlation_both"), 0.5
    )
    rows = statistics.summarize_agreement(
        motion | {"doppler_seconds": 0.05}, np.array([[0.2, 0.4], [0.6, 0.8]])
    )
    assert rows["best Doppler shift [ms]"] == 50.0
    means = [rows[f"peaks within {r} m of the map, mean [%]"] for r in (1, 2)]
    assert means == pytest.approx([40.0, 60.0])
    assert rows["peaks within 1 m of the map, lowest scan [%]"] == pytest.approx(20.0)


def test_area_under_curve() -> None:
    assert two_sample_classifier.area_under_curve(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert two_sample_classifier.area_under_curve(np.array([0.0, 1.0]), np.array([2.0, 3.0])) == 0.0
    assert two_sample_classifier.area_under_curve(np.ones(3), np.ones(4)) == 0.5
    assert two_sample_classifier.area_under_curve(np.array([1.0, 3.0]), np.array([2.0])) == 0.5


def test_patches_tile_the_scan() -> None:
    scan = np.arange(400 * 3768, dtype=np.uint32).reshape(1, 400, 3768)
    patches = two_sample_classifier.cut_patches(scan)
    assert patches.shape == (1, 25, 58, 16, 64)
    np.testing.assert_array_equal(patches[0, 3, 7], scan[0, 48:64, 448:512])


def test_classifier_tells_what_differs_and_nothing_else() -> None:
    one, same, louder = noise_scans(2, 1.0, 1), noise_scans(2, 1.0, 2), noise_scans(2, 1.5, 3)
    rng = np.random.default_rng(0)
    alike = two_sample_classifier.train_classifier(one, same, rng, folds=2, epochs=2)
    assert abs(alike.auc - 0.5) < 0.06 and alike.scores.shape == (2, 2, 25, 58)
    other = two_sample_classifier.train_classifier(one, louder, rng, folds=2, epochs=2)
    assert other.auc > 0.9 and len(other.fold_aucs) == 2
    rounded = two_sample_classifier.train_classifier(one, louder, rng, folds=2, epochs=2, bf16=True)
    assert abs(rounded.auc - other.auc) < 0.02
    assert not (
        rounded.scores.astype(np.float32).view(np.uint32) & 0xFFFF
    ).any()  # the bits that bf16 leaves out
    found = two_sample_classifier.auc_by_group(other, one, louder)
    assert found["range"]["110-170"] > 0.9
    with pytest.raises(ValueError, match="cannot be split"):
        two_sample_classifier.train_classifier(one, louder[:1], rng)


def test_counterparts_have_the_statistics_of_the_real_scans(real_root: Path) -> None:
    """The calibration itself: targets that simulated scans must meet, on a seed that it was not set with."""
    known = rall.load_scan_poses(rall.find_scan_poses(real_root))
    real = np.stack([load_radar(real_root / rall.SCANS_PATH / "radar" / f"{us}.png").power for us in known])
    counterparts = build_counterparts(real_root, seed=11)
    codes = np.stack([make_scan(counterparts, i).power for i in range(len(known))])
    ours, theirs = statistics.scan_statistics(codes), statistics.scan_statistics(real)
    assert ours["forbidden"] == 0 and ours["near_copies"]
    assert statistics.hellinger_distance(ours["histogram"], theirs["histogram"]) < 0.1
    for code, share in theirs["fractions"].items():
        assert 1.0 / 1.5 < ours["fractions"][code] / share < 1.5, code
    for range_m, share in theirs["zero_fractions"].items():
        assert abs(ours["zero_fractions"][range_m] - share) < 0.05, range_m
    np.testing.assert_allclose(ours["range_correlation"], theirs["range_correlation"], atol=0.05)
    assert abs(ours["azimuth_correlation"] - theirs["azimuth_correlation"]) < 0.05
    poses, points = np.array(list(known.values())), rall.load_map_points(real_root / rall.MAP_PATH)
    on_map = [statistics.map_fractions(scans, poses, points)[:, 0].mean() for scans in (codes, real)]
    assert abs(on_map[0] - on_map[1]) < 0.08
    tried = tuple(np.arange(-0.05, 0.1501, 0.02))
    found = statistics.motion_statistics(codes, poses, doppler_seconds=tried)
    assert found["doppler_seconds"] == pytest.approx(0.05, abs=0.021)
