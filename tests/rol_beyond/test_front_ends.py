"""From a polar scan to points: detectors and networks in one frame, and their evaluation on a map."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rol.radar import RangeCalibration
from rol_beyond import front_ends
from rol_beyond.front_ends import detect_points, evaluate_on_map, resample_by_density

AZIMUTHS = -2.0 * np.pi * (13 + 14 * np.arange(400)) / 5600


def scan_with_spot(bearing: float, range_m: float, code: int = 140) -> np.ndarray:
    """A quiet scan with one bright echo."""
    power = np.full((400, 3768), 6, dtype=np.uint8)
    row = int(np.argmin(np.abs(np.angle(np.exp(1j * (AZIMUTHS - bearing))))))
    bin_ = round((range_m + 0.31) / 0.0438 - 0.5)
    power[row, bin_ - 1 : bin_ + 2] = code - 20
    power[row, bin_] = code
    return power


@pytest.mark.parametrize("detector", front_ends.DETECTORS)
def test_both_detectors_find_a_spot_where_it_is(detector: str) -> None:
    points = detect_points(scan_with_spot(0.8, 30.0), AZIMUTHS, detector=detector)
    assert points.shape == (1, 2)
    assert np.hypot(*(points[0] - 30.0 * np.array([np.cos(0.8), np.sin(0.8)]))) < 0.3


@pytest.mark.parametrize("detector", front_ends.DETECTORS)
@pytest.mark.parametrize("range_m", [1.5, 70.0])
def test_leakage_and_what_lies_beyond_the_image_are_left_out(detector: str, range_m: float) -> None:
    assert len(detect_points(scan_with_spot(0.8, range_m), AZIMUTHS, detector=detector)) == 0


def test_motion_moves_points_to_mid_scan() -> None:
    power = scan_with_spot(-0.1, 30.0)  # seen at the very beginning of the turn
    still, moving = (detect_points(power, AZIMUTHS, twist)[0] for twist in (None, (10.0, 0.0, 0.0)))
    # The car has another eighth of a second to go, and the echo ahead read 0.49 m too near.
    assert moving[0] - still[0] == pytest.approx(-1.25 + 0.49, abs=0.1)


def test_other_bins_are_an_argument() -> None:
    power = np.full((400, 576), 6, dtype=np.uint8)
    power[100, 115] = 140
    point = detect_points(power, AZIMUTHS, calibration=RangeCalibration(0.17361))[0]
    assert np.hypot(*point) == pytest.approx(115.5 * 0.17361)


def test_unknown_detectors_are_refused() -> None:
    with pytest.raises(ValueError, match="'best' is none of k-strongest, cfar"):
        detect_points(scan_with_spot(0.0, 9.0), AZIMUTHS, detector="best")


@pytest.mark.parametrize("detector", front_ends.DETECTORS)
def test_detectors_refuse_scans_that_are_turned_or_no_codes(detector: str) -> None:
    power, own = (
        scan_with_spot(0.0, 9.0)[:, :576],
        {"detector": detector, "calibration": RangeCalibration(0.17)},
    )
    with pytest.raises(ValueError, match="the power is transposed"):
        detect_points(power.T, AZIMUTHS, **own)
    with pytest.raises(ValueError, match="azimuths must decrease"):
        detect_points(power, -AZIMUTHS, **own)
    with pytest.raises(ValueError, match="power 0..255"):
        detect_points(power / 255, AZIMUTHS, **own)


def test_shares_on_a_map_by_hand() -> None:
    pose = np.array([100.0, 50.0, np.pi / 2])  # forward is along y of the map
    points = np.array([[10.0, 0.0], [10.0, 1.5], [20.0, 0.0], [30.0, 0.0]])
    tree = cKDTree([[100.0, 60.0], [100.5, 70.0]])
    judged = evaluate_on_map(points, pose, tree)
    assert judged == {"n": 4, "share_1m": 0.5, "share_2m": 0.75}
    nothing = evaluate_on_map(np.zeros((0, 2)), pose, tree)
    assert nothing["n"] == 0 and np.isnan(nothing["share_1m"])


@pytest.mark.torch
def test_generated_points_are_where_the_scan_shows_them() -> None:
    torch = pytest.importorskip("torch")
    from rol.pix2pix import Generator, TrainedNetwork

    class Copy(Generator):
        """Returns its input."""

        def __init__(self) -> None:
            super().__init__(1, 0)
            self.weight = torch.nn.Parameter(torch.zeros(1))

        def logits(self, radar: torch.Tensor) -> torch.Tensor:
            return torch.atanh(radar * 0.999)

    power, copy = scan_with_spot(0.8, 30.0, 255), TrainedNetwork(Copy(), {"threshold": 60}, {}, {})
    points, radar_image, fake_image = front_ends.generate_points(copy, power, AZIMUTHS)
    assert np.abs(radar_image.astype(int) - fake_image).max() <= 1
    np.testing.assert_array_equal(
        front_ends.generate_points(copy, power, AZIMUTHS, tta_rotations=4)[2], fake_image
    )
    raw = detect_points(power, AZIMUTHS)[0]
    assert len(points) and np.hypot(*(points.mean(axis=0) - raw)) < 0.3
    surer = replace(copy, points={"threshold": int(fake_image.max())})
    fewer, *_ = front_ends.generate_points(surer, power, AZIMUTHS)
    assert 0 < len(fewer) < len(points)
    near = front_ends.generate_points(copy, scan_with_spot(0.8, 1.5, 255), AZIMUTHS)[0]
    assert len(near) == 0


def test_resampling_by_density_lets_a_wall_count_by_its_length():
    rng = np.random.default_rng(3)
    crowd, alone = rng.uniform(0.0, 0.5, (90, 2)), np.arange(10)[:, None] * (5.0, 0.0) + (20.0, 0.0)
    points = np.concatenate([crowd, alone])
    drawn = resample_by_density(points, 2.0, rng)
    assert drawn.shape == points.shape
    n_crowd = (drawn[:, 0] < 1.0).sum()
    assert abs(n_crowd - 100 / 11) <= 1.0  # the crowd together counts as one of eleven
    assert (drawn[:, None] == points[None]).all(axis=-1).any(axis=1).all()
    assert resample_by_density(np.zeros((0, 2)), 2.0, rng).shape == (0, 2)
