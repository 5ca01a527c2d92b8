"""Detectors of peaks beyond the k strongest: cell-averaging CFAR."""

import numpy as np
import pytest

from rol_beyond.detectors import cfar_peaks


def test_cfar_by_hand():
    power = np.full((2, 60), 20, dtype=np.uint8)  # 10 dB everywhere
    power[0, 30] = 20 + 24 + 1  # 12.5 dB above it
    power[1, 20:23] = (60, 80, 60)  # one echo of three bins; the guard keeps it out of its own floor
    power[1, 55] = 43  # 11.5 dB above: not enough
    rows, bins = cfar_peaks(power, guard_bins=2, train_bins=6, threshold_db=12.0)
    assert list(zip(rows, bins, strict=True)) == [(0, 30), (1, 21)]
    assert len(cfar_peaks(power, guard_bins=2, train_bins=6, threshold_db=12.0, min_bin=31)[0]) == 0
    louder = np.minimum(power.astype(int) + 100, 255).astype(np.uint8)  # only the contrast counts
    np.testing.assert_array_equal(cfar_peaks(louder, guard_bins=2, train_bins=6), (rows, bins))
    with pytest.raises(ValueError, match="do not fit"):
        cfar_peaks(power, guard_bins=20, train_bins=20)


def test_cfar_against_a_literal_loop():
    power = np.random.default_rng(5).integers(0, 140, (3, 50)).astype(np.uint8)
    linear, found = 10.0 ** (power / 20.0), []
    for row, bin_ in np.ndindex(power.shape):
        cells = [linear[row, b] for b in range(50) if 3 <= abs(b - bin_) <= 7]
        left, right = (int(power[row, b]) if 0 <= b < 50 else -1 for b in (bin_ - 1, bin_ + 1))
        if linear[row, bin_] > 4.0 * np.mean(cells) and left < power[row, bin_] >= right:
            found.append((row, bin_))
    rows, bins = cfar_peaks(power, guard_bins=2, train_bins=5, threshold_db=10.0 * np.log10(4.0))
    assert list(zip(rows.tolist(), bins.tolist(), strict=True)) == found and len(found) > 5


@pytest.mark.parametrize(
    "power", [np.zeros((4, 10)), np.zeros((4, 10), dtype=np.int64), np.zeros(10, np.uint8)]
)
def test_cfar_refuses_what_is_no_power_of_a_scan(power):
    with pytest.raises(ValueError, match="power 0..255"):
        cfar_peaks(power, guard_bins=1, train_bins=1)
