"""Adaptation: the target image, fine-tuning on a few real pairs, and refused input."""

import copy
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from rol.pairs import PairSettings
from rol.pix2pix import build_generator, generate
from rol_beyond import unet  # noqa: F401 (registers its architecture)
from rol_beyond.adaptation import AdaptationConfig, RealPair, adapt, draw_real_pair

pytestmark = pytest.mark.torch
AZIMUTHS = -2.0 * np.pi * np.arange(400) / 400
NEAR = AdaptationConfig(reach_m=15.0, threshold=100)
SETTINGS = PairSettings(width=64, pixel_size=1.0, range_resolution=0.1, range_offset=0.0)


def make_pair(seed: int) -> RealPair:
    """A wall at 10 m on the left, seen by both."""
    rng = np.random.default_rng(seed)
    power = rng.integers(0, 40, (400, 400)).astype(np.uint8)
    x = np.arange(-12.0, 12.0, 0.5)
    wall = np.column_stack([x, np.full(len(x), 10.0)])
    rows = (
        np.rint(np.mod(-np.arctan2(wall[:, 1], wall[:, 0]), 2 * np.pi) / (2 * np.pi) * 400).astype(int) % 400
    )
    power[rows, np.rint(np.hypot(*wall.T) / 0.1).astype(int)] = 200
    return RealPair(power, AZIMUTHS, wall)


@pytest.fixture
def generator() -> torch.nn.Module:
    network = build_generator(4, 1, "unet", rng=torch.Generator().manual_seed(1)).eval()
    network.image_size = (64, 64)
    with torch.no_grad():  # running statistics that have never run: without this nothing comes through
        for weight in network.parameters():
            weight.mul_(6.0 if weight.dim() > 1 else 1.0)
    return network


def test_target_is_the_lidar_within_its_reach_and_the_previous_output_beyond(
    generator: torch.nn.Module,
) -> None:
    pair = make_pair(0)
    radar, lidar = draw_real_pair(generator, pair, 0.0, NEAR, SETTINGS)
    axis = 31.5 - np.arange(64)
    ranges = np.hypot(axis[:, None], axis[None, :])
    drawn = np.where(generate(generator, radar, tta_rotations=1) >= 100, 255, 0)
    np.testing.assert_array_equal(lidar[ranges >= 15.0], drawn[ranges >= 15.0])
    rows, columns = np.nonzero((lidar > 0) & (ranges < 15.0))
    assert len(rows) > 10 and (np.abs(axis[columns] - 10.0) <= 0.5).all()  # y is to the left
    turned = draw_real_pair(generator, pair, np.pi / 2, NEAR, SETTINGS)[1]
    rows, columns = np.nonzero((turned > 0) & (ranges < 15.0))
    assert (np.abs(axis[rows] + 10.0) <= 0.5).all()  # a quarter turn to the left brings it behind


def test_adapting_draws_the_wall_and_leaves_the_first_network_alone(generator: torch.nn.Module) -> None:
    pairs, before = [make_pair(seed) for seed in range(3)], copy.deepcopy(generator.state_dict())
    config = AdaptationConfig(25.0, steps=40, batch_size=2, learning_rate=5e-3)
    adapted = adapt(generator, pairs, np.random.default_rng(1), config, SETTINGS)
    assert all(torch.equal(value, before[name]) for name, value in generator.state_dict().items())
    radar, lidar = draw_real_pair(generator, make_pair(9), 1.0, config, SETTINGS)
    contrast = [
        generate(network, radar)[lidar > 0].mean() - generate(network, radar)[lidar == 0].mean()
        for network in (generator, adapted)
    ]
    assert contrast[1] > contrast[0] + 30
    again = adapt(generator, pairs, np.random.default_rng(1), config, SETTINGS)
    np.testing.assert_array_equal(generate(again, radar), generate(adapted, radar))


def test_adapting_in_bf16_rounds_a_little(generator: torch.nn.Module) -> None:
    pairs, plain = [make_pair(seed) for seed in range(2)], AdaptationConfig(25.0, steps=1, batch_size=2)
    exact, rounded = (
        torch.cat(
            [weight.flatten() for weight in adapt(generator, pairs, rng, config, SETTINGS).parameters()]
        )
        for config, rng in (
            (plain, np.random.default_rng(1)),
            (replace(plain, bf16=True), np.random.default_rng(1)),
        )
    )
    assert 0.0 < (exact - rounded).abs().max() < 1e-3


def test_no_pairs_are_refused(generator: torch.nn.Module) -> None:
    with pytest.raises(ValueError, match="no real pairs"):
        adapt(generator, [], np.random.default_rng(1), NEAR)
