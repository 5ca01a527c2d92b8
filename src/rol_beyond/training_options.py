"""Options of the training that the paper does not have: other networks, losses and augmentation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rol.geometry import check_fields
from rol.pix2pix import ARCHITECTURES, Generator, TrainConfig, build_discriminator, build_generator
from rol.training import TrainHooks, TrainingError
from rol_beyond import unet  # noqa: F401 (registers its architecture)


def weighted_l1_loss(generated: Tensor, lidar: Tensor, pos_weight: float = 1.0) -> Tensor:
    """Compute Eq. 4 with a weight for occupied pixels.

    Parameters
    ----------
    generated, lidar : tensor, shape (b, 1, h, w)
        Images in [-1, 1].
    pos_weight : float
        Weight of the pixels that are occupied in the lidar image; 1 is the paper's.

    Returns
    -------
    loss : tensor, shape ()
        Mean over all pixels; in [0, 2] for a weight of 1.
    """
    return _weighted_mean((generated - lidar).abs(), lidar, pos_weight)


def bce_loss(logits: Tensor, lidar: Tensor, pos_weight: float = 1.0) -> Tensor:
    """Compute the binary cross-entropy of the lidar image, with the generated grey value as a probability.

    Unlike Eq. 4 it has a gradient where the generator is confidently wrong. Its minimum is at the true
    probability p of an occupied pixel, or at w p / (1 + (w - 1) p) for a weight w.

    Parameters
    ----------
    logits : tensor, shape (b, 1, h, w)
        Output of `rol.pix2pix.Generator.logits`; the image is their tanh, so the log-odds are twice the
        logits.
    lidar : tensor, shape (b, 1, h, w)
        Lidar image in [-1, 1].
    pos_weight : float
        Weight of the pixels that are occupied in the lidar image.

    Returns
    -------
    loss : tensor, shape ()
        Mean over all pixels [nat].
    """
    losses = functional.binary_cross_entropy_with_logits(
        2.0 * logits, (lidar > 0).to(logits.dtype), reduction="none"
    )
    return _weighted_mean(losses, lidar, pos_weight)


def _weighted_mean(losses: Tensor, lidar: Tensor, pos_weight: float) -> Tensor:
    if pos_weight != 1.0:
        losses = losses * (1.0 + (pos_weight - 1.0) * (lidar > 0))
    return losses.mean()


@dataclass(frozen=True)
class TrainingExtensions:
    """Options beyond the paper's training, as hooks of `rol.training.train`; the defaults are the paper's."""

    architecture: str = "resnet"  # of the generator, see `rol.pix2pix.build_generator`
    adversarial: bool = True  # False: no discriminator, the pixel loss alone
    pixel_loss: str = "l1"  # "l1": Eq. 4; "bce": binary cross-entropy
    pos_weight: float = 1.0  # weight of occupied pixels in the pixel loss
    rotate: bool = False  # random rotation of each pair
    gain_spread_db: float = 0.0  # standard deviation of a random gain of each scan [dB]
    streaks: float = 0.0  # mean number of bright streaks added to a scan, see `rol_beyond.augmentation`
    ghosts: float = 0.0  # mean number of ghost echoes added to a scan

    def __post_init__(self) -> None:
        allowed = {
            tuple(ARCHITECTURES): "architecture",
            ("l1", "bce"): "pixel_loss",
            "(0, inf)": "pos_weight",
            "[0, inf)": "gain_spread_db streaks ghosts",
        }
        check_fields(self, allowed, TrainingError)

    def hooks(self, on_report: Callable[[dict[str, float], Generator], None] | None = None) -> TrainHooks:
        """Return the hooks for `rol.training.train`, with a function to report to."""
        is_augmented = self.rotate or max(self.gain_spread_db, self.streaks, self.ghosts) > 0.0
        draw = self._draw_batch if is_augmented else None
        return TrainHooks(self._build_networks, self._pixel_loss, draw, on_report, asdict(self))

    def _build_networks(self, config: TrainConfig, rng: torch.Generator) -> dict[str, nn.Module]:
        networks = {"generator": build_generator(config.ngf, config.n_blocks, self.architecture, rng=rng)}
        if self.adversarial:
            networks["discriminator"] = build_discriminator(config.ndf, rng=rng)
        return networks

    def _pixel_loss(self, logits: Tensor, generated: Tensor, lidar: Tensor) -> Tensor:
        if self.pixel_loss == "bce":
            return bce_loss(logits, lidar, self.pos_weight)
        return weighted_l1_loss(generated, lidar, self.pos_weight)

    def _draw_batch(self, pairs: Any, index: Sequence[int], rng: np.random.Generator) -> list[Any]:
        if not hasattr(pairs, "draw"):
            raise TrainingError(
                "rotate, gain_spread_db, streaks and ghosts need pairs with a method draw, "
                "see rol_beyond.augmentation"
            )
        turns = rng.uniform(-np.pi, np.pi, len(index)) * self.rotate
        gains = rng.normal(0.0, 1.0, len(index)) * self.gain_spread_db
        added = rng.poisson((self.streaks, self.ghosts), (len(index), 2))
        drawn = zip(index, turns, gains, added, rng.spawn(len(index)), strict=True)
        return [
            pairs.draw(int(i), float(turn), float(gain), *map(int, n), own) for i, turn, gain, n, own in drawn
        ]
