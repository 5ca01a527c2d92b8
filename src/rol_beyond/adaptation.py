"""Domain adaptation: fine-tune a network on a few pairs of a real radar scan and a lidar sweep.

A network trained on simulated scans alone misjudges the artefacts of a real radar. A few real pairs correct
this, even from another radar and a lidar of short reach: beyond the lidar's reach the target is the network's
own previous output, so that it forgets nothing there.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from rol.bev import points_to_image
from rol.geometry import check_fields
from rol.pairs import PairSettings
from rol.pix2pix import Generator, generate, to_tensor
from rol_beyond.augmentation import rotate_points, rotated_radar_image
from rol_beyond.training_options import bce_loss


@dataclass(frozen=True)
class RealPair:
    """A radar scan with the lidar points of the same moment.

    Attributes
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    points : array, shape (n, 2)
        Lidar or map points without the ground, in the radar frame [m]; at mid-scan if there is a twist.
    twist : tuple of float, optional
        Body velocity for the motion compensation of the scan [m/s, m/s, rad/s]; without it there is none.
    """

    power: np.ndarray
    azimuths: np.ndarray
    points: np.ndarray
    twist: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class AdaptationConfig:
    """Settings of `adapt`."""

    reach_m: float  # range up to which the lidar is the target [m]
    steps: int = 80  # of Adam; few, because there are few pairs
    batch_size: int = 4  # pairs per step
    learning_rate: float = 1e-4  # of Adam
    pos_weight: float = 4.0  # of `rol_beyond.training_options.bce_loss`
    threshold: int = 150  # grey value from which on the network's own output counts as occupied
    bf16: bool = False  # True: compute in bfloat16, see `rol.pix2pix.has_bf16`

    def __post_init__(self) -> None:
        allowed = {"[1, inf)": "steps batch_size", "(0, inf)": "reach_m learning_rate pos_weight"}
        check_fields(self, {**allowed, "[0, 255]": "threshold"})


def draw_real_pair(
    generator: Generator, pair: RealPair, turn: float, config: AdaptationConfig, settings: PairSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Create the radar image and the target image of a pair.

    Parameters
    ----------
    generator : Generator
        The network before the adaptation.
    pair : RealPair
        The pair.
    turn : float
        Counter-clockwise rotation of the surroundings [rad].
    config : AdaptationConfig
        Reach of the lidar, threshold, precision.
    settings : PairSettings
        Settings of the images; motion is compensated if the pair has a twist.

    Returns
    -------
    radar, target : array, shape (w, w), uint8
        The target is the lidar's image within the reach, and the network's output beyond it.
    """
    settings = replace(settings, motion="none" if pair.twist is None else "corrected")
    twist = pair.twist or (0.0, 0.0, 0.0)
    radar = rotated_radar_image(pair.power, pair.azimuths, turn, twist, settings)
    size, width = settings.pixel_size, len(radar)
    seen = points_to_image(rotate_points(pair.points, turn), width=width, pixel_size=size)
    axis = ((width - 1) / 2.0 - np.arange(width)) * size
    is_near = np.hypot(axis[:, None], axis[None, :]) < config.reach_m
    grey = generate(generator, radar, bf16=config.bf16, tta_rotations=1)  # the rotation is random anyway
    return radar, np.where(is_near, seen, 255 * (grey >= config.threshold)).astype(np.uint8)


def adapt(
    generator: Generator,
    pairs: Sequence[RealPair],
    rng: np.random.Generator,
    config: AdaptationConfig,
    settings: PairSettings | None = None,
) -> Generator:
    """Fine-tune a copy of a network on a few real pairs with random rotations.

    Parameters
    ----------
    generator : Generator
        Network from `rol.pix2pix.load_weights`; it is not changed.
    pairs : sequence of RealPair
        The pairs.
    rng : numpy.random.Generator
        Draws pairs and rotations.
    config : AdaptationConfig
        The settings.
    settings : PairSettings, optional
        Settings of the images, such as ``range_resolution`` of the pairs' radar [m]; the defaults if not
        given.

    Returns
    -------
    adapted : Generator
        The trained copy.

    Raises
    ------
    ValueError
        If there are no pairs, or a loss is not finite.
    """
    return deque(adapt_steps(generator, pairs, rng, config, settings), maxlen=1)[0]


def adapt_steps(
    generator: Generator,
    pairs: Sequence[RealPair],
    rng: np.random.Generator,
    config: AdaptationConfig,
    settings: PairSettings | None = None,
) -> Iterator[Generator]:
    """Fine-tune as `adapt` does; yield the copy, always the same object, after every step."""
    if len(pairs) == 0:
        raise ValueError("no real pairs to adapt to")
    before, adapted = generator.eval(), copy.deepcopy(generator).eval().requires_grad_(True)
    optimizer = torch.optim.Adam(adapted.parameters(), config.learning_rate)
    device = next(adapted.parameters()).device.type
    for step in range(config.steps):
        chosen = rng.integers(len(pairs), size=config.batch_size)
        turns = rng.uniform(-np.pi, np.pi, config.batch_size)
        images = [
            draw_real_pair(before, pairs[i], turn, config, settings or PairSettings())
            for i, turn in zip(chosen, turns, strict=True)
        ]
        radar, lidar = (torch.cat([to_tensor(image) for image in side]) for side in zip(*images, strict=True))
        with torch.autocast(device, torch.bfloat16, enabled=config.bf16):
            logits = adapted.logits(radar)
        loss = bce_loss(logits, lidar, config.pos_weight)
        if not torch.isfinite(loss.detach()):
            raise ValueError(f"step {step + 1} of {config.steps}: loss is {float(loss.detach())}")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        yield adapted
    adapted.requires_grad_(False)
