"""Losses by hand, drawn pairs, and the U-Net trained by the loop of `rol`."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

torch = pytest.importorskip("torch")

from rol.pix2pix import Pix2PixError, TrainConfig, generate, l1_loss, load_tensors, load_weights
from rol.training import RunOptions, TrainingError, train
from rol_beyond.training_options import TrainingExtensions, bce_loss, weighted_l1_loss

pytestmark = pytest.mark.torch
TINY = TrainConfig(ngf=2, n_blocks=1, ndf=2, steps=6, batch_size=2, report_every=1, checkpoint_every=2)


class Turnable(list):
    """Pairs that can be turned by quarters."""

    def draw(
        self, index: int, turn: float, gain_db: float, n_streaks: int, n_ghosts: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, ...]:
        quarters = round(turn / (0.5 * np.pi)) + int(rng.integers(2)) * n_streaks
        return tuple(np.ascontiguousarray(np.rot90(image, quarters, (1, 2))) for image in self[index])


def make_pairs(n: int = 6, size: int = 32) -> Turnable:
    """Walls as the lidar sees them, and thick, dim and noisy as the radar does."""
    rng, pairs = np.random.default_rng(7), Turnable()
    for _ in range(n):
        lidar, radar = np.full((2, 1, size, size), -1, dtype=np.float32)
        row, col = rng.integers(4, size - 4, 2)
        lidar[0, row], lidar[0, :, col] = 1.0, 1.0
        radar[0, row - 1 : row + 2], radar[0, :, col - 1 : col + 2] = 0.2, 0.2
        pairs.append((np.clip(radar + rng.normal(0, 0.1, radar.shape), -1, 1).astype(np.float32), lidar))
    return pairs


def test_weighted_l1_by_hand() -> None:
    lidar = torch.tensor([[[[-1.0, -1.0], [-1.0, 1.0]]]])
    empty = torch.full_like(lidar, -1.0)
    assert float(weighted_l1_loss(empty, lidar)) == float(l1_loss(empty, lidar)) == 0.5
    assert float(weighted_l1_loss(empty, lidar, 10.0)) == 5.0
    assert float(weighted_l1_loss(-empty, lidar, 10.0)) == 1.5  # the three empty pixels still count once
    assert float(weighted_l1_loss(lidar, lidar, 10.0)) == 0.0


def test_cross_entropy_is_least_at_the_probability() -> None:
    lidar = torch.tensor([1.0] * 3 + [-1.0] * 7).reshape(1, 1, 1, 10)
    for weight in (1.0, 4.0):
        p = weight * 0.3 / (1.0 + (weight - 1.0) * 0.3)
        losses = [
            float(bce_loss(torch.full_like(lidar, 0.5 * math.log(q / (1.0 - q))), lidar, weight))
            for q in (p - 0.02, p, p + 0.02)
        ]
        assert losses[1] < min(losses[0], losses[2])
    p = torch.tanh(torch.tensor(0.3)) * 0.5 + 0.5  # grey as a probability
    loss = bce_loss(torch.full((1, 1, 2, 2), 0.3), torch.ones(1, 1, 2, 2))
    assert float(loss) == pytest.approx(-math.log(p), rel=1e-5)


def test_defaults_train_as_the_paper(tmp_path: Path) -> None:
    pairs = make_pairs()
    paper = train(pairs, TINY, tmp_path / "paper", seed=1)[1]
    same = train(pairs, TINY, tmp_path / "same", seed=1, hooks=TrainingExtensions().hooks())[1]
    pd.testing.assert_frame_equal(paper, same, check_exact=True)
    weighted = TrainingExtensions(pos_weight=5.0).hooks()
    other = train(pairs, TINY, tmp_path / "weighted", seed=1, hooks=weighted)[1]
    assert (other["loss_l1"] != paper["loss_l1"])[1:].all()  # the first row is before the first step
    with pytest.raises(TrainingError, match=r"another run: pos_weight was 5.0, now 1.0"):
        train(pairs, TINY, tmp_path / "weighted", seed=1, hooks=TrainingExtensions().hooks())


def test_drawn_pairs_follow_from_seed_and_step_alone(tmp_path: Path) -> None:
    pairs, extensions = make_pairs(), TrainingExtensions(adversarial=False, rotate=True, streaks=1.0)

    def stop(row: dict, generator: object) -> None:
        if row["step"] == 4:
            raise KeyboardInterrupt

    options = RunOptions(num_workers=3)
    whole = train(pairs, TINY, tmp_path / "whole", seed=1, options=options, hooks=extensions.hooks())[1]
    plain = TrainingExtensions(adversarial=False).hooks()
    assert not np.allclose(
        whole["loss_l1"], train(pairs, TINY, tmp_path / "plain", seed=1, hooks=plain)[1]["loss_l1"]
    )
    assert whole["loss_gan"].isna().all()
    with pytest.raises(KeyboardInterrupt):
        train(pairs, TINY, tmp_path / "again", seed=1, hooks=extensions.hooks(stop))
    again = train(pairs, TINY, tmp_path / "again", seed=1, hooks=extensions.hooks())[1]
    pd.testing.assert_frame_equal(whole, again, check_exact=True)
    config = load_tensors(tmp_path / "whole" / "generator.safetensors")[1]["config"]
    assert config["rotate"] is True and config["streaks"] == 1.0 and config["ngf"] == 2


def test_small_u_net_learns_and_comes_back_from_its_file(tmp_path: Path) -> None:
    config = TrainConfig(ngf=4, n_blocks=1, lambda_l1=1.0, steps=40, batch_size=2, learning_rate=5e-3)
    config = replace(config, report_every=20, checkpoint_every=40)
    hooks = TrainingExtensions(architecture="unet", adversarial=False, pixel_loss="bce").hooks()
    pairs = make_pairs(8, 64)
    generator, history = train(pairs, config, tmp_path, seed=1, held_out=pairs[:2], hooks=hooks)
    assert history["loss_l1"].iloc[-1] < 0.9 * history["loss_l1"].iloc[0]
    image = np.rint((pairs[0][0][0] + 1.0) * 127.5).astype(np.uint8)
    from_file = load_weights(tmp_path / "generator.safetensors")
    difference = generate(from_file, image).astype(int) - generate(generator, image)
    assert np.abs(difference).max() <= 1 and "BatchNorm" not in str(from_file)


@pytest.mark.parametrize(
    ("pairs", "change", "fault"),
    [
        (list(make_pairs(1)), {"rotate": True}, "need pairs with a method draw"),
        (make_pairs(1, size=48), {"architecture": "unet"}, "multiples of 32"),
    ],
)
def test_runs_that_cannot_be_are_refused(tmp_path: Path, pairs: list, change: dict, fault: str) -> None:
    with pytest.raises((TrainingError, Pix2PixError), match=fault):
        train(pairs, TINY, tmp_path, seed=1, hooks=TrainingExtensions(**change).hooks())


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"architecture": "vit"}, "architecture: 'vit' is none of resnet, .*unet"),
        ({"architecture": None}, "architecture: expected str, got None"),
        ({"pixel_loss": "l2"}, "pixel_loss: 'l2' is none of l1, bce"),
        ({"pos_weight": 0.0}, "pos_weight"),
        ({"ghosts": -1.0}, "ghosts"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict, fault: str) -> None:
    with pytest.raises(TrainingError, match=fault):
        TrainingExtensions(**change)
