"""The pipeline of the paper: a vehicle between walls, and a stand-in for the network that copies the radar image."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rol.geometry import invert, transform_points
from rol.mcl import MclError, MclSettings, MotionNoise
from rol.pipeline import RadarLocalizer, scan_to_points
from rol.pix2pix import Generator, TrainedNetwork
from rol.radar import RangeCalibration

CALIBRATION = RangeCalibration(0.1, -0.5)
SETTINGS = {"range_resolution": 0.1, "range_offset": -0.5, "pixel_size": 0.5, "width": 200, "max_range": 50.0}


class Copy(Generator):
    """Generator whose image is the radar image."""

    def __init__(self) -> None:
        super().__init__(ngf=1, n_blocks=0)
        self.gain = torch.nn.Parameter(torch.tensor(3.0))

    def logits(self, radar: torch.Tensor) -> torch.Tensor:
        return self.gain * radar


NETWORK = TrainedNetwork(Copy(), {"threshold": 128, "thin": False}, SETTINGS, {})


def walls() -> np.ndarray:
    """Points of walls within 50 m, shape (n, 2) [m]."""
    rng = np.random.default_rng(1)
    first, last = rng.uniform(-45.0, 45.0, (2, 40, 1, 2))
    return (first + np.linspace(0.0, 0.3, 100)[:, None] * (last - first)).reshape(-1, 2)


def look(pose: np.ndarray, points: np.ndarray) -> SimpleNamespace:
    """Radar scan of points at a pose, with the fields of `rol.oxford.RadarScan` that a localizer needs."""
    power = np.zeros((400, 600), dtype=np.uint8)
    x, y = transform_points(invert(pose), points).T
    rows = np.rint(-np.arctan2(y, x) / (2.0 * np.pi) * 400.0).astype(int) % 400
    bins = np.rint((np.hypot(x, y) - CALIBRATION.offset_m) / CALIBRATION.resolution_m).astype(int)
    for shift in range(-4, 5):
        inside = (bins + shift >= 0) & (bins + shift < 600)
        power[rows[inside], bins[inside] + shift] = 250
    return SimpleNamespace(power=power, azimuths=-2.0 * np.pi * np.arange(400) / 400, stamp_us=0)


def test_points_have_the_geometry_of_the_network() -> None:
    points = scan_to_points(NETWORK, look(np.zeros(3), np.array([[20.0, 10.0], [1.0, 0.0]])))
    assert (
        len(points) > 0 and np.hypot(*(points - (20.0, 10.0)).T).max() < 1.5
    )  # 1 m is below the smallest range
    fine = TrainedNetwork(Copy(), NETWORK.points, SETTINGS | {"range_offset": 4.5}, {})
    shifted = scan_to_points(fine, look(np.zeros(3), np.array([[20.0, 10.0]])))
    assert np.hypot(*shifted.T).mean() - np.hypot(*points.T).mean() == pytest.approx(5.0, abs=0.3)


def test_a_vehicle_is_localized_scan_by_scan() -> None:
    points, truth = walls(), np.column_stack([np.linspace(-6.0, 6.0, 12), np.zeros(12), np.zeros(12)])
    start = truth[0] + (0.4, -0.3, 0.01)
    localizer = RadarLocalizer(points, NETWORK, start, rng=np.random.default_rng(2))
    found = [localizer.step(look(pose, points)) for pose in truth]
    off = np.hypot(*(np.array([scan.pose for scan in found]) - truth)[:, :2].T)
    assert off[2:].max() < 0.4
    for scan in found:
        assert np.linalg.eigvalsh(scan.covariance).min() > 0.0 and scan.points.shape[1] == 2
        np.testing.assert_array_equal(scan.pose, scan.update.pose)
    np.testing.assert_allclose(localizer.increment[:2], (12.0 / 11.0, 0.0), atol=0.1)


def test_settings_and_random_generator_are_given() -> None:
    points, scan = walls(), look(np.zeros(3), walls())
    settings = MclSettings(n_particles=50, motion=MotionNoise(forward_m=0.1))
    poses = []
    for seed in (1, 1, 2):
        localizer = RadarLocalizer(
            points, NETWORK, np.zeros(3), rng=np.random.default_rng(seed), settings=settings
        )
        result = [localizer.step(scan) for _ in range(2)][-1]
        assert len(result.update.particles) == 50
        poses.append(result.pose)
    np.testing.assert_array_equal(poses[0], poses[1])
    assert np.abs(poses[0] - poses[2]).max() > 0.0


def test_an_empty_map_is_refused() -> None:
    with pytest.raises(MclError, match="the map holds no point"):
        RadarLocalizer(np.zeros((0, 2)), NETWORK, np.zeros(3), rng=np.random.default_rng(1))
