"""The translator room: the networks of pix2pix, their losses, one training step, use, weights as files.

Images are tensors of shape (b, 1, h, w) in [-1, 1]: -1 is empty (pixel 0), +1 is occupied (pixel 255). Row 0
is the farthest forward, column 0 the farthest left. The architecture is that of the public pix2pix and
CycleGAN code with one channel in and one channel out (Yin et al. 2020, Sec. III-A, Eq. 2-5, and Sec. IV-A).
Only this room and `rol_beyond.unet` import torch when they are imported; `rol.training` holds the loop.

Batch norm takes the statistics of the images it is given, in training and in use alike, and keeps no running
ones. The public code does so too when it is used as its authors use it, and with one image per batch the
network is then one and the same function in training and in use. So `generate` handles one image at a time.
There is no dropout: nothing is drawn after the first weights but the order of the pairs.
"""

from __future__ import annotations

import json
import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

try:
    from .files import write_bytes
    from .geometry import check_fields
except ImportError:  # this file was copied on its own
    from files import write_bytes
    from geometry import check_fields

if TYPE_CHECKING:
    from rol_beyond.unet import UnetGenerator

ARCHITECTURES = {
    "resnet": "resnet-generator, batch statistics, 1 to 1 channel",
    "unet": "folded u-net, running statistics, 1 to 1 channel",
}


class Pix2PixError(ValueError):
    """An image, a loss or a file of weights that cannot be used; the message names it and the fault."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of one training run; the defaults are the paper's, or the public code's where it is silent."""

    network: str = "resnet"  # the paper's; "unet": `rol_beyond.unet`, smaller and quicker
    filters: int = 64  # width of the generator's first layer; public default
    blocks: int = 9  # residual blocks; Sec. IV-A, "ResNet with 9 blocks"
    discriminator_filters: int = 64  # width of the discriminator's first layer; public default
    epochs: int = 200  # passes over the pairs, half at full rate and half decaying; public default 100 + 100
    steps: int = (
        0  # 0: as many as the epochs need; otherwise this many optimiser steps and `epochs` is not read
    )
    batch: int = 1  # public default; batch statistics are then those of one image, as in use
    lambda_l1: float = 100.0  # lambda of Eq. 2; the paper gives no value, public default
    gan_weight: float = 1.0  # of Eq. 3 in Eq. 2; 0: no discriminator, the pixels' loss alone
    pixel_loss: str = (
        "l1"  # "l1": Eq. 4; "entropy": how surprised the image is, as if grey were a probability
    )
    occupied_weight: float = 1.0  # 1: Eq. 4 as printed; above 1, an occupied pixel counts so many times
    rotate: bool = False  # True: every pair in a heading drawn anew; the paper does not
    gain_spread_db: float = 0.0  # spread of a gain drawn anew for every scan; the paper has none
    streaks: float = (
        0.0  # bright streaks added to a scan on average, see `rol_beyond.scan_pairs`; the paper adds none
    )
    ghosts: float = 0.0  # echoes that appear a second time elsewhere, on average; the paper adds none
    learning_rate: float = 2e-4  # Adam; public default
    beta1: float = (
        0.5  # Adam; public default, lower than Adam's own 0.9 because the two losses chase each other
    )
    beta2: float = 0.999  # Adam; public default
    bf16: bool = (
        False  # True: multiply in bfloat16; quicker only where the processor or GPU has such instructions
    )
    report_every: int = 50  # steps per row of the history, each with a look at the held-out pairs
    checkpoint_every: int = 500  # steps between checkpoints, a multiple of the above: minutes lost at most

    def __post_init__(self) -> None:
        allowed = {
            tuple(ARCHITECTURES): "network",
            ("l1", "entropy"): "pixel_loss",
            "[1, inf)": "filters discriminator_filters epochs batch report_every checkpoint_every",
            "[0, inf)": "blocks steps lambda_l1 gan_weight gain_spread_db streaks ghosts",
            "(0, inf)": "occupied_weight learning_rate",
            "[0, 1)": "beta1 beta2",
        }
        check_fields(self, allowed, Pix2PixError)

    def n_steps(self, n_pairs: int) -> int:
        """Give the number of optimiser steps for a data set of `n_pairs` pairs."""
        return self.steps or self.epochs * -(-n_pairs // self.batch)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, track_running_stats=False)


class _ReflectionPad2d(nn.ReflectionPad2d):
    """Reflection padding that keeps bfloat16: autocast would pad in float32, which only costs time."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x)


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; shape (b, c, h, w) in and out."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for is_last in (False, True):  # no bias: the norm that follows would cancel it
            layers += [_ReflectionPad2d(1), nn.Conv2d(channels, channels, 3, bias=False), _norm(channels)]
            layers += [] if is_last else [nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Return the input plus what the block has learnt to add."""
        return x + self.layers(x)  # (b, c, h, w)


class ResnetGenerator(nn.Module):
    """Generator G: 7 x 7, two halvings, residual blocks, two doublings, 7 x 7, tanh.

    Attributes
    ----------
    filters, blocks : int
        Width of the first layer and number of residual blocks.
    image_size : tuple of int or None
        Height and width it was trained on; ``generate`` refuses any other. None: not trained yet.
    headings : int
        Quarter turns of an image that ``generate`` averages, 1 to 4; kept with the weights. The paper takes one.
    """

    size_step = 4  # height and width must be multiples of it
    headings = 1

    def __init__(self, filters: int, blocks: int) -> None:
        super().__init__()
        self.filters, self.blocks, self.image_size = filters, blocks, None
        f = filters
        layers: list[nn.Module] = [
            _ReflectionPad2d(3),
            nn.Conv2d(1, f, 7, bias=False),
            _norm(f),
            nn.ReLU(True),
        ]
        for c in (f, 2 * f):
            layers += [nn.Conv2d(c, 2 * c, 3, stride=2, padding=1, bias=False), _norm(2 * c), nn.ReLU(True)]
        layers += [ResidualBlock(4 * f) for _ in range(blocks)]
        for c in (4 * f, 2 * f):
            up = nn.ConvTranspose2d(c, c // 2, 3, stride=2, padding=1, output_padding=1, bias=False)
            layers += [up, _norm(c // 2), nn.ReLU(True)]
        layers += [_ReflectionPad2d(3), nn.Conv2d(f, 1, 7), nn.Tanh()]
        self.layers = nn.Sequential(*layers)

    def logits(self, radar: Tensor) -> Tensor:
        """Map radar images to fake lidar images before the tanh: half the log-odds of an occupied pixel."""
        return self.layers[:-1](radar).float()  # (b, 1, h, w) -> (b, 1, h, w)

    def forward(self, radar: Tensor) -> Tensor:
        """Map radar images to fake lidar images."""
        return torch.tanh(self.logits(radar))  # (b, 1, h, w) -> (b, 1, h, w)


def _initialise(network: nn.Module, rng: torch.Generator) -> nn.Module:
    """Fill a network built on the meta device with pix2pix's first weights, drawn from `rng` alone."""
    network.to_empty(device="cpu")
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.BatchNorm2d):
            mean = 1.0 if isinstance(module, nn.BatchNorm2d) else 0.0
            nn.init.normal_(module.weight, mean, 0.02, generator=rng)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
            if isinstance(module, nn.BatchNorm2d):
                module.reset_running_stats()
    return network.to(memory_format=torch.channels_last)  # about a fifth quicker on a CPU


def build_generator(
    filters: int = 64, blocks: int = 9, network: str = "resnet", *, rng: torch.Generator
) -> ResnetGenerator | UnetGenerator:
    """Build the generator with freshly drawn weights.

    Parameters
    ----------
    filters : int
        Width of the first layer; 64 is the paper's, the cost grows with its square.
    blocks : int
        Residual blocks; 9 in the paper.
    network : str
        "resnet", the paper's, or "unet", see `rol_beyond.unet`.
    rng : torch.Generator
        Source of the weights, N(0, 0.02) as in pix2pix.

    Returns
    -------
    generator : ResnetGenerator or UnetGenerator
        Maps (b, 1, h, w) to (b, 1, h, w), both in [-1, 1]; h and w must be multiples of its `size_step`.

    Raises
    ------
    Pix2PixError
        If there is no such network, or not of this width and depth.
    """
    if network not in ARCHITECTURES:
        raise Pix2PixError(f"network: {network!r} is none of {', '.join(ARCHITECTURES)}")
    if filters < 1 or blocks < 0:
        raise Pix2PixError(
            f"generator: filters must be at least 1 and blocks at least 0, got {filters}, {blocks}"
        )
    if network == "unet":
        from rol_beyond.unet import UnetGenerator as Network
    else:
        Network = ResnetGenerator
    with torch.device("meta"):  # no weights drawn from torch's global state
        built = Network(filters, blocks)
    return _initialise(built, rng)


def build_discriminator(filters: int = 64, *, rng: torch.Generator) -> nn.Sequential:
    """Build the 70 x 70 PatchGAN discriminator with freshly drawn weights.

    Parameters
    ----------
    filters : int
        Width of the first layer.
    rng : torch.Generator
        Source of the weights, N(0, 0.02) as in pix2pix.

    Returns
    -------
    discriminator : torch.nn.Sequential
        Maps radar and lidar image stacked (b, 2, h, w) to one logit per patch of 70 x 70 pixels,
        (b, 1, h / 8 - 2, w / 8 - 2).
    """
    f = filters
    with torch.device("meta"):
        layers: list[nn.Module] = [nn.Conv2d(2, f, 4, stride=2, padding=1), nn.LeakyReLU(0.2, True)]
        for c, stride in ((f, 2), (2 * f, 2), (4 * f, 1)):
            layers += [nn.Conv2d(c, 2 * c, 4, stride, 1, bias=False), _norm(2 * c), nn.LeakyReLU(0.2, True)]
        network = nn.Sequential(*layers, nn.Conv2d(8 * f, 1, 4, stride=1, padding=1))
    return _initialise(network, rng)


def receptive_field(network: nn.Module) -> int:
    """Work out how many pixels of the input, along an edge, one output of a chain of convolutions sees.

    Parameters
    ----------
    network : torch.nn.Module
        Convolutions one after the other, none of them transposed; what lies between them is not counted, so
        not the statistics of batch norm, which come from the whole image.

    Returns
    -------
    size : int
        Edge of the receptive field [pixels]; 70 for `build_discriminator`.
    """
    size, jump = 1, 1  # pixels seen by one output, and pixels between two neighbouring outputs
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            size += (module.kernel_size[0] - 1) * jump
            jump *= module.stride[0]
    return size


def gan_loss(logits: Tensor, is_real: bool) -> Tensor:
    """Score logits against one answer for all patches: binary cross-entropy, one term of Eq. 3.

    Parameters
    ----------
    logits : tensor, any shape
        What the discriminator says before the sigmoid.
    is_real : bool
        The answer it is held against.

    Returns
    -------
    loss : tensor, shape ()
        ``-log D`` if `is_real`, else ``-log(1 - D)``, mean over patches.
    """
    return functional.binary_cross_entropy_with_logits(logits, torch.full_like(logits, float(is_real)))


def l1_loss(fake: Tensor, lidar: Tensor, occupied_weight: float = 1.0) -> Tensor:
    """Measure the mean absolute difference of two images, Eq. 4.

    Parameters
    ----------
    fake, lidar : tensor, shape (b, 1, h, w)
        Generated and real image in [-1, 1].
    occupied_weight : float
        How many times a pixel counts that is occupied in the real image; 1 is the paper's.

    Returns
    -------
    loss : tensor, shape ()
        Mean over all pixels; in [0, 2] for a weight of 1.
    """
    return _weigh((fake - lidar).abs(), lidar, occupied_weight)


def entropy_loss(logits: Tensor, lidar: Tensor, occupied_weight: float = 1.0) -> Tensor:
    """Measure how surprising the real image is if the generated grey is a probability: cross-entropy.

    Unlike Eq. 4 it has a slope where the generator is sure and wrong, and its least value is reached by the
    true probability p of an occupied pixel, or w p / (1 + (w - 1) p) for a weight w. Not in the paper.

    Parameters
    ----------
    logits : tensor, shape (b, 1, h, w)
        Output of `ResnetGenerator.logits`; the image is their tanh, so the log-odds are twice the logits.
    lidar : tensor, shape (b, 1, h, w)
        Real image in [-1, 1].
    occupied_weight : float
        How many times a pixel counts that is occupied in the real image.

    Returns
    -------
    loss : tensor, shape ()
        Mean over all pixels [nat].
    """
    surprise = functional.binary_cross_entropy_with_logits(
        2.0 * logits, (lidar > 0).to(logits.dtype), reduction="none"
    )
    return _weigh(surprise, lidar, occupied_weight)


def _weigh(losses: Tensor, lidar: Tensor, occupied_weight: float) -> Tensor:
    """Mean of losses by pixel, those of occupied pixels counted so many times."""
    if occupied_weight != 1.0:
        losses = losses * (1.0 + (occupied_weight - 1.0) * (lidar > 0))
    return losses.mean()


def train_step(
    generator: ResnetGenerator | UnetGenerator,
    discriminator: nn.Module | None,
    optimizer_g: torch.optim.Optimizer,
    optimizer_d: torch.optim.Optimizer | None,
    radar: Tensor,
    lidar: Tensor,
    config: TrainConfig,
) -> dict[str, float]:
    """Update the discriminator, then the generator against the frozen discriminator (changes both in place).

    Parameters
    ----------
    generator, discriminator : torch.nn.Module
        The two networks; no discriminator is needed where `config.gan_weight` is 0.
    optimizer_g, optimizer_d : torch.optim.Optimizer
        Their optimisers.
    radar, lidar : tensor, shape (b, 1, h, w)
        A batch of pairs in [-1, 1].
    config : TrainConfig
        Read: `gan_weight`, `pixel_loss`, `lambda_l1`, `occupied_weight`, `bf16`.

    Returns
    -------
    losses : dict of float
        ``loss_d`` (half the sum of its two terms), ``loss_gan``, both nan without a discriminator, and
        ``loss_l1`` (Eq. 4, without lambda and weight).

    Raises
    ------
    Pix2PixError
        If a loss or a gradient is not finite; the weights are then not updated by it.

    Notes
    -----
    Yin et al. 2020, Sec. III-A, Eq. 2-4. As in the public code the generator maximises log D(fake) instead of
    minimising log(1 - D(fake)): the same aim with a stronger slope while the fakes are still poor.
    """
    autocast = torch.autocast(radar.device.type, torch.bfloat16) if config.bf16 else nullcontext()
    with autocast:
        logits = generator.logits(radar)  # (b, 1, h, w)
        fake = torch.tanh(logits)
    loss_d, loss_gan = torch.tensor(float("nan")), torch.tensor(float("nan"))
    if discriminator is not None and optimizer_d is not None and config.gan_weight > 0.0:
        loss_d = _discriminator_loss(
            discriminator.requires_grad_(True), radar, lidar, fake.detach(), autocast
        )
        _descend(optimizer_d, loss_d, "discriminator loss")
        discriminator.requires_grad_(False)
        with autocast:
            loss_gan = gan_loss(discriminator(torch.cat([radar, fake], 1)).float(), True)
    weight = config.occupied_weight
    if config.pixel_loss == "entropy":
        loss_g = config.lambda_l1 * entropy_loss(logits, lidar, weight)
    else:
        loss_g = config.lambda_l1 * l1_loss(fake, lidar, weight)
    if config.gan_weight > 0.0:
        loss_g = loss_g + config.gan_weight * loss_gan
    _descend(optimizer_g, loss_g, "generator loss")
    losses = {"loss_d": loss_d, "loss_gan": loss_gan, "loss_l1": l1_loss(fake, lidar)}
    return {name: float(loss.detach()) for name, loss in losses.items()}


def _discriminator_loss(
    discriminator: nn.Module, radar: Tensor, lidar: Tensor, fake: Tensor, autocast: AbstractContextManager
) -> Tensor:
    """Eq. 3 for the discriminator, halved as in pix2pix: it learns more slowly than the generator."""
    with autocast:
        loss_fake = gan_loss(discriminator(torch.cat([radar, fake], 1)).float(), False)
        loss_real = gan_loss(discriminator(torch.cat([radar, lidar], 1)).float(), True)
    return 0.5 * (loss_fake + loss_real)


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor, name: str) -> None:
    """Take one optimiser step down a loss, or refuse if the loss or a gradient is not finite."""
    if not torch.isfinite(loss.detach()):
        raise Pix2PixError(f"{name} is {float(loss.detach())}")
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    steepness = torch.nn.utils.get_total_norm([w.grad for w in weights if w.grad is not None])
    if not torch.isfinite(steepness):
        raise Pix2PixError(f"gradient of the {name} is {float(steepness)}")
    optimizer.step()


def evaluate_l1(generator: ResnetGenerator | UnetGenerator, pairs: Any) -> float:
    """Measure Eq. 4 on pairs that are not learnt from.

    Parameters
    ----------
    generator : ResnetGenerator or UnetGenerator
        The network.
    pairs : sequence of (radar, lidar), each array float32 (1, h, w) in [-1, 1]
        The pairs.

    Returns
    -------
    l1 : float
        Mean absolute difference in [0, 2]; nan without pairs.
    """
    device, losses, was_training = next(generator.parameters()).device, [], generator.training
    generator.eval()
    with torch.inference_mode():
        for index in range(len(pairs)):
            radar, lidar = (torch.from_numpy(image[None]).to(device) for image in pairs[index])
            losses.append(float(l1_loss(generator(radar), lidar)))
    generator.train(was_training)
    return float(np.mean(losses)) if losses else float("nan")


def has_bf16(device: str = "cpu") -> bool:
    """Tell whether a device has instructions for bfloat16; without them it is many times slower than float32."""
    if device.startswith("cuda"):
        return torch.cuda.is_available() and torch.cuda.is_bf16_supported()
    tests = (getattr(torch.cpu, f"_is_{name}_supported", None) for name in ("amx_tile", "avx512_bf16"))
    return any(test() for test in tests if test is not None)


def choose_bf16(bf16: bool | str, device: str = "cpu") -> bool:
    """Decide whether to multiply in bfloat16.

    Parameters
    ----------
    bf16 : bool or "auto"
        True or False, or "auto": where `has_bf16`.
    device : str
        "cpu" or "cuda".

    Returns
    -------
    bf16 : bool

    Raises
    ------
    Pix2PixError
        If the value is none of these.
    """
    if not isinstance(bf16, bool) and bf16 != "auto":
        raise Pix2PixError(f'bf16: expected true, false or "auto", got {bf16!r}')
    return has_bf16(device) if bf16 == "auto" else bool(bf16)


def to_tensor(image: np.ndarray) -> Tensor:
    """Turn a grey image into a tensor: 0 becomes -1, 255 becomes +1.

    Parameters
    ----------
    image : array, shape (h, w), uint8
        Grey image.

    Returns
    -------
    tensor : tensor, shape (1, 1, h, w), float32
        The same in [-1, 1].
    """
    return torch.from_numpy(image[None, None].astype(np.float32) / np.float32(127.5) - np.float32(1.0))


def generate(
    generator: ResnetGenerator | UnetGenerator,
    radar_image: np.ndarray,
    *,
    bf16: bool = False,
    headings: int | None = None,
) -> np.ndarray:
    """Turn a radar image into a fake lidar image.

    The same network gives the same image whether it is in training or evaluation mode: batch norm takes the
    statistics of this one image, there is no dropout, and nothing in the network changes.

    Parameters
    ----------
    generator : ResnetGenerator or UnetGenerator
        The trained network.
    radar_image : array, shape (h, w), uint8
        Power image of one scan; h and w multiples of 4, and those the network was trained on.
    bf16 : bool
        Multiply in bfloat16: quicker where `has_bf16`.
    headings : int, optional
        Quarter turns of the image, 1 to 4, that are translated and averaged before the tanh: what a network draws
        in one heading only is doubtful. Costs as many times; the paper takes one. Not given: the network's own number.

    Returns
    -------
    fake_image : array, shape (h, w), uint8
        0 empty to 255 occupied.

    Raises
    ------
    Pix2PixError
        If the image has another type, shape or size, or the number of headings is none of these.

    Notes
    -----
    Yin et al. 2020, Eq. 5.
    """
    if radar_image.dtype != np.uint8 or radar_image.ndim != 2:
        raise Pix2PixError(f"radar image: expected uint8 (h, w), got {radar_image.dtype} {radar_image.shape}")
    check_size(radar_image.shape, generator.image_size, "radar image", generator.size_step)
    headings = generator.headings if headings is None else headings
    if headings not in (1, 2, 3, 4):
        raise Pix2PixError(f"headings: expected 1 to 4, got {headings}")
    device = next(generator.parameters()).device
    autocast = torch.autocast(device.type, torch.bfloat16) if bf16 else nullcontext()
    radar = to_tensor(radar_image).to(device)
    with torch.inference_mode(), autocast:
        logits = sum(
            torch.rot90(generator.logits(torch.rot90(radar, turn, (2, 3))), -turn, (2, 3))
            for turn in range(headings)
        )
        fake = torch.tanh(logits / headings)[0, 0]  # (h, w)
    return torch.round((fake.float() + 1.0) * 127.5).to(torch.uint8).cpu().numpy()


def check_size(size: tuple[int, ...], expected: tuple[int, int] | None, name: str, step: int = 4) -> None:
    """Refuse image sizes the network cannot give back, or was not trained on."""
    if any(n % step or n < max(step, 16) for n in size):
        raise Pix2PixError(
            f"{name}: height and width must be multiples of {step} from {max(step, 16)} on, got {tuple(size)}"
        )
    if expected is not None and tuple(size) != tuple(expected):
        raise Pix2PixError(f"{name}: size {tuple(size)}, but the generator was trained on {tuple(expected)}")


def save_weights(
    path: str | Path,
    generator: ResnetGenerator | UnetGenerator,
    metadata: dict[str, Any] | None = None,
    *,
    half: bool = False,
) -> None:
    """Write a generator with what is needed to build it again, atomically.

    Parameters
    ----------
    path : path
        File to write, ``*.safetensors``.
    generator : ResnetGenerator or UnetGenerator
        The network.
    metadata : dict, optional
        More to put into the header, JSON values only (seed, settings, session ...).
    half : bool
        Write float16, half the size; `load_weights` gives float32 again.
    """
    about = {
        "architecture": ARCHITECTURES["resnet" if isinstance(generator, ResnetGenerator) else "unet"],
        "filters": generator.filters,
        "blocks": generator.blocks,
        "image_size": generator.image_size,
        "headings": generator.headings,
        "torch": str(torch.__version__),
    }
    tensors = {name: value.half() if half else value for name, value in generator.state_dict().items()}
    save_tensors(Path(path), tensors, {**(metadata or {}), **about})


def load_weights(
    path: str | Path, *, filters: int | None = None, blocks: int | None = None
) -> ResnetGenerator | UnetGenerator:
    """Build a generator from a file of `save_weights`.

    Parameters
    ----------
    path : path
        The file.
    filters, blocks : int, optional
        Refuse a network of another width or depth; not given: take what the file holds.

    Returns
    -------
    generator : ResnetGenerator or UnetGenerator
        The network with its weights, on the CPU, for use and not for training: norms with running statistics
        are multiplied into the convolutions before them.

    Raises
    ------
    Pix2PixError
        If the file is missing, truncated, of another architecture, width, depth, does not hold the weights that
        its header promises, or holds a value that is not finite; the message names the file.
    """
    tensors, about = load_tensors(Path(path))
    _check_header(path, about)
    network = next(name for name, words in ARCHITECTURES.items() if words == about["architecture"])
    for name, wanted in (("filters", filters), ("blocks", blocks)):
        if wanted is not None and about[name] != wanted:
            raise Pix2PixError(f"{path}: generator with {about[name]} {name}, expected {wanted}")
    try:  # also raised when the width or depth needs more memory than there is
        generator = build_generator(about["filters"], about["blocks"], network, rng=torch.Generator())
        generator.load_state_dict(tensors)
    except RuntimeError as error:
        raise Pix2PixError(f"{path}: tensors do not fit the header's architecture ({error})") from error
    for name, value in generator.state_dict().items():
        if value.is_floating_point() and not tensors[name].is_floating_point():
            raise Pix2PixError(f"{path}: tensor {name!r} is of {tensors[name].dtype}, expected {value.dtype}")
    generator.image_size = tuple(about["image_size"]) if about.get("image_size") else None
    generator.headings = int(about.get("headings", 1))
    if network == "unet":
        from rol_beyond.unet import fuse

        fuse(generator)
    return generator.eval()


@dataclass(frozen=True)
class TrainedNetwork:
    """A generator with what is needed to turn a scan into points.

    Attributes
    ----------
    generator : Generator
        The network.
    points : dict
        How the generated image becomes points: ``threshold`` and ``thin`` of `rol.bev.image_to_points`.
    settings : dict
        How the radar images were made that it was trained on.
    about : dict
        Header of its file.
    """

    generator: ResnetGenerator | UnetGenerator
    points: dict[str, Any]
    settings: dict[str, Any]
    about: dict[str, Any]


def load_network(path: str | Path) -> TrainedNetwork:
    """Read a generator with its threshold and the settings of its radar images.

    Parameters
    ----------
    path : path
        File of `save_weights`; its header may hold ``points`` (threshold 128, no thinning otherwise) and
        ``pairs_settings`` (the defaults of pairs otherwise).

    Returns
    -------
    network : TrainedNetwork
        Ready for `generate`.

    Raises
    ------
    Pix2PixError
        As `load_weights`, or if ``points`` or ``pairs_settings`` of the header hold anything else.
    """
    about, defaults = load_metadata(path), {"threshold": 128, "thin": False}
    for name in ("points", "pairs_settings"):
        if not isinstance(about.get(name, {}), dict):
            raise Pix2PixError(f"{path}: header: {name} is {about[name]!r:.60}, not a JSON object")
    points = {**defaults, **about.get("points", {})}
    for name, value in points.items():
        if type(value) is not type(defaults.get(name)):
            raise Pix2PixError(f"{path}: header: points: {name} is {value!r:.60}, known are {defaults}")
    return TrainedNetwork(load_weights(path), points, dict(about.get("pairs_settings", {})), about)


def load_metadata(path: str | Path) -> dict[str, Any]:
    """Read the header of a weights file: architecture, sizes, seed, settings, versions.

    Parameters
    ----------
    path : path
        File of `save_weights`.

    Returns
    -------
    metadata : dict
        What the header holds.
    """
    return load_tensors(Path(path))[1]


def save_tensors(path: Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """Write tensors and a header into a file that appears whole or not at all.

    Parameters
    ----------
    path : path
        File to write.
    tensors : dict of tensor
        Named tensors, no pickle.
    about : dict
        Header, JSON values only.

    Raises
    ------
    Pix2PixError
        If a value is not finite; the message names the tensor.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    _check_finite(path, plain)
    write_bytes(path, save(plain, {"rol": json.dumps(about, sort_keys=True)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the header of a file of `save_tensors`.

    Raises
    ------
    Pix2PixError
        If the file is missing, not whole, or written by something else, or if a value is not finite.
    """
    if not path.is_file():
        raise Pix2PixError(f"{path}: no such weights file")
    try:
        with safe_open(path, "pt") as file:
            about = (file.metadata() or {}).get("rol")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise Pix2PixError(f"{path}: not a whole safetensors file ({error})") from error
    if about is None:
        raise Pix2PixError(f"{path}: header says nothing of the network, so not written by rol.pix2pix")
    try:
        header = json.loads(about)
    except ValueError as error:
        raise Pix2PixError(f"{path}: header is not whole JSON ({error})") from error
    if not isinstance(header, dict):
        raise Pix2PixError(f"{path}: header is {header!r:.60}, not a JSON object")
    _check_finite(path, tensors)
    return tensors, header


def _check_finite(path: Path, tensors: dict[str, Tensor]) -> None:
    """Refuse tensors of a type that torch cannot compute with, or with a value that is not finite."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and tensor.element_size() < 2:
            raise Pix2PixError(f"{path}: tensor {name!r} is of {tensor.dtype}, expected at least 16 bits")
        if not torch.isfinite(tensor).all():
            raise Pix2PixError(f"{path}: tensor {name!r} holds a value that is not finite")


def _check_header(path: str | Path, about: dict[str, Any]) -> None:
    """Refuse a header without a known architecture or with sizes of another type."""
    if about.get("architecture") not in ARCHITECTURES.values():
        known = list(ARCHITECTURES.values())
        raise Pix2PixError(f"{path}: architecture {about.get('architecture')!r}, known are {known}")
    size = about.get("image_size")
    if size is not None and not (isinstance(size, list) and len(size) == 2):
        raise Pix2PixError(f"{path}: header: image_size is {size!r}, expected two numbers or null")
    numbers = {name: about.get(name) for name in ("filters", "blocks")} | {
        "headings": about.get("headings", 1)
    }
    for name, number in [*numbers.items(), *(("image_size", n) for n in size or ())]:
        low, high = {"blocks": (0, math.inf), "headings": (1, 4)}.get(name, (1, math.inf))
        if type(number) is not int or not low <= number <= high:
            raise Pix2PixError(
                f"{path}: header: {name} is {number!r}, expected a whole number from {low}"
                + (f" to {high}" if high < math.inf else "")
            )
