"""Adapt a translator to a real radar with a few pairs of a scan and a lidar sweep. Not in the paper.

A network that learnt from simulated scans alone trusts what a real radar makes up in its own way. A handful of real
pairs tells it better, even from another radar and a lidar that sees little: beyond the lidar's reach the network
is held to what it drew before, so that it forgets nothing there.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rol.pix2pix import ResnetGenerator
    from rol_beyond.unet import UnetGenerator


@dataclass(frozen=True)
class RealPair:
    """A radar scan with the lidar points of the same moment.

    Attributes
    ----------
    power, azimuths : array, shape (a, b) and (a,)
        Power in half-dB steps, and counter-clockwise bearings of the rows [rad].
    points : array, shape (n, 2)
        Lidar points without the ground, in the radar frame [m].
    """

    power: np.ndarray
    azimuths: np.ndarray
    points: np.ndarray


def draw_real_pair(
    generator: ResnetGenerator | UnetGenerator,
    pair: RealPair,
    turn: float,
    *,
    reach_m: float,
    threshold: int,
    settings: dict[str, Any],
    bf16: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Make the radar image of a pair, and the lidar image that is to be learnt.

    Parameters
    ----------
    generator : ResnetGenerator or UnetGenerator
        The network as it was before.
    pair : RealPair
        The pair.
    turn : float
        Counter-clockwise turn of everything that is seen [rad].
    reach_m : float
        How far the lidar is trusted [m].
    threshold : int
        Grey value from which on the network's own drawing counts beyond.
    settings : dict
        Entries of `rol.pairs.PairSettings`.
    bf16 : bool
        Multiply in bfloat16, see `rol.pix2pix.has_bf16`.

    Returns
    -------
    radar, lidar : array, shape (w, w), uint8
        Within the reach the lidar's points, beyond it what the network drew.
    """
    from rol.bev import points_to_image
    from rol.pairs import PairSettings
    from rol.pix2pix import generate
    from rol_beyond.scan_pairs import turned_radar_image

    how = PairSettings.from_dict({**settings, "motion": "none"})
    radar = turned_radar_image(pair.power, pair.azimuths, turn, (0.0, 0.0, 0.0), how)
    c, s = np.cos(turn), np.sin(turn)
    size, width = how.pixel_size, len(radar)
    seen = points_to_image(pair.points @ np.array([[c, s], [-s, c]]), width=width, pixel_size=size)
    axis = ((width - 1) / 2.0 - np.arange(width)) * size
    is_near = np.hypot(axis[:, None], axis[None, :]) < reach_m
    grey = generate(generator, radar, bf16=bf16, headings=1)  # turned at random anyhow
    return radar, np.where(is_near, seen, 255 * (grey >= threshold)).astype(np.uint8)


def adapt(
    generator: ResnetGenerator | UnetGenerator,
    pairs: Sequence[RealPair],
    rng: np.random.Generator,
    *,
    reach_m: float,
    steps: int = 80,
    batch: int = 4,
    learning_rate: float = 1e-4,
    occupied_weight: float = 4.0,
    threshold: int = 150,
    settings: dict[str, Any] | None = None,
    bf16: bool = False,
) -> ResnetGenerator | UnetGenerator:
    """Train a copy of a network on a few real pairs, in headings drawn anew.

    Parameters
    ----------
    generator : ResnetGenerator or UnetGenerator
        Network from `rol.pix2pix.load_weights`; it is not changed.
    pairs : sequence of RealPair
        The pairs.
    rng : numpy.random.Generator
        Draws pairs and headings.
    reach_m : float
        How far the lidar is trusted [m].
    steps, batch : int
        Steps of Adam, and pairs a step. Few of both: there is little to learn from.
    learning_rate, occupied_weight : float
        Of Adam, and of `rol.pix2pix.entropy_loss`.
    threshold : int
        See `draw_real_pair`.
    settings : dict, optional
        Entries of `rol.pairs.PairSettings`, such as ``range_resolution`` of the pairs' radar [m].
    bf16 : bool
        Multiply in bfloat16, see `rol.pix2pix.has_bf16`; halves the time there.

    Returns
    -------
    adapted : ResnetGenerator or UnetGenerator
        The trained copy.

    Raises
    ------
    ValueError
        If there are no pairs, or a loss is not finite.
    """
    import torch

    from rol.bev import normalize_image
    from rol.pix2pix import entropy_loss

    if len(pairs) == 0:
        raise ValueError("no real pairs to adapt to")
    before, adapted = generator.eval(), copy.deepcopy(generator).eval().requires_grad_(True)
    optimizer = torch.optim.Adam(adapted.parameters(), learning_rate)
    how = {"reach_m": reach_m, "threshold": threshold, "settings": settings or {}, "bf16": bf16}
    device = next(adapted.parameters()).device.type
    for step in range(steps):
        chosen, turns = rng.integers(len(pairs), size=batch), rng.uniform(-np.pi, np.pi, batch)
        images = [
            draw_real_pair(before, pairs[i], turn, **how) for i, turn in zip(chosen, turns, strict=True)
        ]
        radar, lidar = (
            torch.from_numpy(normalize_image(np.stack(side)[:, None])) for side in zip(*images, strict=True)
        )
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            logits = adapted.logits(radar)
        loss = entropy_loss(logits, lidar, occupied_weight)
        if not torch.isfinite(loss.detach()):
            raise ValueError(f"step {step + 1} of {steps}: loss is {float(loss.detach())}")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return adapted.requires_grad_(False)
