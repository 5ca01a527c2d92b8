"""Fine-tuning study on small made-up pairs: evaluation within a range, states of the training, sources of the real data."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from rol.pix2pix import TrainedNetwork, build_generator
from rol_beyond import unet  # noqa: F401 (registers its architecture)
from rol_beyond.adaptation import AdaptationConfig, RealPair
from rol_study import fine_tuning

pytestmark = pytest.mark.torch
AZIMUTHS = -2.0 * np.pi * np.arange(400) / 400
WALL = np.column_stack([np.arange(-12.0, 12.0, 0.5), np.full(48, 10.0)])
SETTINGS = {"width": 64, "pixel_size": 1.0, "range_resolution": 0.1, "range_offset": 0.0, "max_range": 32.0}
CONFIG = AdaptationConfig(25.0, batch_size=2, learning_rate=5e-3)


def make_power() -> np.ndarray:
    """Power of a wall at 10 m on the left."""
    power = np.zeros((400, 400), dtype=np.uint8)
    bearings = np.mod(-np.arctan2(WALL[:, 1], WALL[:, 0]), 2.0 * np.pi)
    power[
        np.rint(bearings / (2.0 * np.pi) * 400).astype(int) % 400,
        np.rint(np.hypot(*WALL.T) / 0.1).astype(int),
    ] = 200
    return power


@pytest.fixture
def network() -> TrainedNetwork:
    generator = build_generator(4, 1, "unet", rng=torch.Generator().manual_seed(1)).eval()
    generator.image_size = (64, 64)
    with torch.no_grad():
        for weight in generator.parameters():
            weight.mul_(6.0 if weight.dim() > 1 else 1.0)
    return TrainedNetwork(generator, {"threshold": 128, "thin": False}, SETTINGS, {})


def test_points_beyond_the_range_do_not_count_but_may_be_neighbours() -> None:
    points = np.array([[19.5, 0.0], [20.4, 0.0], [3.0, 0.0], [60.0, 0.0]])
    reference = np.array([[20.3, 0.0], [3.5, 0.0], [1.0, 0.0], [-15.0, 0.0]])
    found = fine_tuning.compare_within(points, reference, 20.0)
    assert found == {"n_points": 2, "precision_1m": 1.0, "precision_2m": 1.0, "recall_1m": 0.5}
    assert fine_tuning.compare_within(points, reference, 21.0)["recall_1m"] == pytest.approx(2 / 3)


def test_fine_tuning_stops_at_the_asked_steps_and_leaves_the_network_alone(network: TrainedNetwork) -> None:
    pairs = [RealPair(make_power(), AZIMUTHS, WALL)]
    before = [weight.detach().clone() for weight in network.generator.parameters()]
    far, states = [], {}
    for steps, tuned in fine_tuning.fine_tune(network, pairs, 1, (0, 2, 5), CONFIG):
        states[steps] = torch.cat(
            [weight.detach().flatten().clone() for weight in tuned.generator.parameters()]
        )
        far.append(float((states[steps] - states[0]).abs().sum()))
    assert list(states) == [0, 2, 5] and far[0] == 0.0 < far[1] < far[2]
    assert all(torch.equal(*two) for two in zip(before, network.generator.parameters(), strict=True))
    short = dict(fine_tuning.fine_tune(network, pairs, 1, (2,), CONFIG))[2]
    assert torch.equal(torch.cat([weight.flatten() for weight in short.generator.parameters()]), states[2])


def test_study_evaluates_every_seed_and_source(network: TrainedNetwork) -> None:
    pairs = [RealPair(make_power(), AZIMUTHS, WALL)]
    tables = list(fine_tuning.run_study(network, pairs, {"fog": pairs * 2}, (1, 2), (0, 20), CONFIG))
    assert [(t.seed[0], t.steps[0]) for t in tables] == [(0, 0), (1, 20), (2, 20)]
    assert all(t.source.unique().tolist() == ["pairs", "fog"] for t in tables)
    assert tables[0].set_index("source").n_scans.to_dict() == {"pairs": 1, "fog": 2}
    counts = [t[t.source == "fog"].n_points.tolist() for t in tables]
    own = tables[0][tables[0].source == "pairs"].n_points.tolist()
    assert own != counts[0]  # the same scans, but with the range resolution of the radar in fog
    assert counts[0] == sorted(counts[0], reverse=True)  # fewer points at higher thresholds
    assert counts[0] != counts[1] != counts[2]


def test_motion_of_a_pair_is_compensated(network: TrainedNetwork) -> None:
    pairs = [RealPair(make_power(), AZIMUTHS, WALL, twist) for twist in (None, (0.0, 8.0, 0.0))]
    weights = []
    for pair in pairs:
        ((_, tuned),) = fine_tuning.fine_tune(network, [pair], 1, (1,), CONFIG)
        weights.append(torch.cat([weight.flatten() for weight in tuned.generator.parameters()]))
    assert not torch.equal(*weights)


def test_real_sources_are_found_and_placed(real_root: Path) -> None:
    pairs, others = fine_tuning.load_training_pairs(real_root), fine_tuning.load_test_pairs(real_root)
    assert len(pairs) == 11 and all(pair.twist is not None for pair in pairs)
    assert min(np.hypot(*pair.points.T).min() for pair in pairs) >= 2.5
    assert {source: len(group) for source, group in others.items()} == {"map": 1, "fog": 18}
    assert others["map"][0].twist is not None and np.hypot(*others["map"][0].points.T).max() <= 74.0
    assert others["fog"][0].twist is None
