"""Networks of pix2pix and their losses, one training step, image generation, and weights as files.

Images are tensors of shape (b, 1, h, w) in [-1, 1]: -1 is empty (pixel 0), +1 is occupied (pixel 255). Row 0
is the farthest forward, column 0 the farthest left. The networks are those of the public pix2pix and CycleGAN
code with one input and one output channel (Yin et al. 2020, Sec. III-A, Eq. 2-5, and Sec. IV-A).
`rol.training` holds the training loop.

Batch norm uses the statistics of its input, in training and in inference, and keeps no running statistics.
The public code does the same as its authors use it. With one image per batch, the network is then the same
function in training and in inference, so `generate` processes one image at a time. There is no dropout: only
the initial weights and the order of the pairs are random.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

if __package__:
    from .bev import normalize_image
    from .files import write_bytes
    from .geometry import check_fields, check_number
else:  # this file was copied and is imported by its own name
    from bev import normalize_image
    from files import write_bytes
    from geometry import check_fields, check_number


class Pix2PixError(ValueError):
    """An image, a loss or a file of weights that cannot be used; the message names it and the fault."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run; the defaults are the paper's, or the public code's where it states none."""

    ngf: int = 64  # width of the generator's first layer; public default
    n_blocks: int = 9  # residual blocks; Sec. IV-A, "ResNet with 9 blocks"
    ndf: int = 64  # width of the discriminator's first layer; public default
    epochs: int = 200  # passes over the pairs; public default 100 at constant rate + 100 decaying
    steps: int = 0  # optimizer steps; 0: as many as `epochs` needs
    batch_size: int = 1  # public default; batch statistics are then those of one image, as in inference
    lambda_l1: float = 100.0  # lambda of Eq. 2; the paper gives no value, public default
    learning_rate: float = 2e-4  # Adam; public default
    beta1: float = 0.5  # Adam; public default
    bf16: bool = False  # True: compute in bfloat16; quicker only where there are instructions for it
    report_every: int = 50  # steps per row of the history, each with an evaluation of the held-out pairs
    checkpoint_every: int = 500  # steps between checkpoints, a multiple of `report_every`

    def __post_init__(self) -> None:
        allowed = {
            "[1, inf)": "ngf ndf epochs batch_size report_every checkpoint_every",
            "[0, inf)": "n_blocks steps lambda_l1",
            "(0, inf)": "learning_rate",
            "[0, 1)": "beta1",
        }
        check_fields(self, allowed, Pix2PixError)

    def n_steps(self, n_pairs: int) -> int:
        """Compute the number of optimizer steps for a data set of `n_pairs` pairs."""
        return self.steps or self.epochs * -(-n_pairs // self.batch_size)


class Generator(nn.Module):
    """Base class of the generators G: radar images to lidar images, shape (b, 1, h, w) in [-1, 1].

    Attributes
    ----------
    architecture, description : str
        Name for `build_generator`, and the words in the header of a weights file.
    size_step : int
        Height and width must be multiples of it [pixels].
    ngf, n_blocks : int
        Width of the first layer and number of residual blocks.
    image_size : tuple of int or None
        Height and width it was trained on; `generate` refuses any other. None: not trained yet.
    tta_rotations : int
        Quarter turns of the image that `generate` averages, 1 to 4 (test-time augmentation); kept with the
        weights. The paper takes one.
    """

    architecture, description, size_step = "", "", 4

    def __init__(self, ngf: int, n_blocks: int) -> None:
        super().__init__()
        self.ngf, self.n_blocks, self.tta_rotations = ngf, n_blocks, 1
        self.image_size: tuple[int, int] | None = None

    def logits(self, radar: Tensor) -> Tensor:
        """Compute the generated images before the tanh: half the log-odds of an occupied pixel."""
        raise NotImplementedError

    def forward(self, radar: Tensor) -> Tensor:
        """Generate lidar images from radar images."""
        return torch.tanh(self.logits(radar))  # (b, 1, h, w) -> (b, 1, h, w)

    def fuse(self) -> None:
        """Merge norms with running statistics into convolutions, for inference; without them do nothing."""


ARCHITECTURES: dict[str, type[Generator]] = {}
# Modules that register an architecture when they are imported, by its name and by its description.
REGISTERED_BY = dict.fromkeys(("unet", "folded u-net, running statistics, 1 to 1 channel"), "rol_beyond.unet")


def register_architecture(network: type[Generator]) -> type[Generator]:
    """Register an architecture for `build_generator` and `load_weights`; a decorator of its class."""
    ARCHITECTURES[network.architecture] = network
    return network


def _find_architecture(key: Any) -> type[Generator]:
    """Find an architecture by its name or its description."""
    for network in ARCHITECTURES.values():
        if key in (network.architecture, network.description):
            return network
    if str(key) in REGISTERED_BY:
        raise Pix2PixError(f"architecture {key!r} is not registered: `import {REGISTERED_BY[key]}` first")
    raise Pix2PixError(f"architecture {key!r} is none of {', '.join(ARCHITECTURES)}")


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, track_running_stats=False)


class _ReflectionPad2d(nn.ReflectionPad2d):
    """Reflection padding that keeps bfloat16: autocast would pad in float32, which is slower."""

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
        """Add the output of the two convolutions to the input."""
        return x + self.layers(x)  # (b, c, h, w)


@register_architecture
class ResnetGenerator(Generator):
    """The paper's generator: 7 x 7, two halvings, residual blocks, two doublings, 7 x 7, tanh."""

    architecture, description = "resnet", "resnet-generator, batch statistics, 1 to 1 channel"

    def __init__(self, ngf: int, n_blocks: int) -> None:
        super().__init__(ngf, n_blocks)
        layers = [_ReflectionPad2d(3), nn.Conv2d(1, ngf, 7, bias=False), _norm(ngf), nn.ReLU(True)]
        for c in (ngf, 2 * ngf):
            layers += [nn.Conv2d(c, 2 * c, 3, stride=2, padding=1, bias=False), _norm(2 * c), nn.ReLU(True)]
        layers += [ResidualBlock(4 * ngf) for _ in range(n_blocks)]
        for c in (4 * ngf, 2 * ngf):
            up = nn.ConvTranspose2d(c, c // 2, 3, stride=2, padding=1, output_padding=1, bias=False)
            layers += [up, _norm(c // 2), nn.ReLU(True)]
        layers += [_ReflectionPad2d(3), nn.Conv2d(ngf, 1, 7), nn.Tanh()]
        self.layers = nn.Sequential(*layers)

    def logits(self, radar: Tensor) -> Tensor:
        """Compute the generated images before the tanh: half the log-odds of an occupied pixel."""
        return self.layers[:-1](radar).float()  # (b, 1, h, w) -> (b, 1, h, w)


def _initialise(network: nn.Module, rng: torch.Generator) -> nn.Module:
    """Initialize a network built on the meta device as pix2pix does, with `rng` as the only source."""
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
    ngf: int = 64, n_blocks: int = 9, architecture: str = "resnet", *, rng: torch.Generator
) -> Generator:
    """Build a generator with random initial weights.

    Parameters
    ----------
    ngf : int
        Width of the first layer; 64 in the public code. The cost grows with its square.
    n_blocks : int
        Residual blocks; 9 in the paper.
    architecture : str
        "resnet", the paper's, or another registered one, see `register_architecture`.
    rng : torch.Generator
        Source of the weights, N(0, 0.02) as in pix2pix.

    Returns
    -------
    generator : Generator
        Maps (b, 1, h, w) to (b, 1, h, w), both in [-1, 1]; h and w must be multiples of its `size_step`.

    Raises
    ------
    Pix2PixError
        If the architecture is not registered, or cannot have this width and depth.
    """
    network = _find_architecture(architecture)
    check_number("ngf", ngf, "[1, inf)", int, Pix2PixError)
    check_number("n_blocks", n_blocks, "[0, inf)", int, Pix2PixError)
    with torch.device("meta"):  # no weights drawn from torch's global state
        built = network(ngf, n_blocks)
    return _initialise(built, rng)


def build_discriminator(ndf: int = 64, *, rng: torch.Generator) -> nn.Sequential:
    """Build the 70 x 70 PatchGAN discriminator with random initial weights.

    Parameters
    ----------
    ndf : int
        Width of the first layer.
    rng : torch.Generator
        Source of the weights, N(0, 0.02) as in pix2pix.

    Returns
    -------
    discriminator : torch.nn.Sequential
        Maps radar and lidar image stacked (b, 2, h, w) to one logit per patch of 70 x 70 pixels,
        (b, 1, h / 8 - 2, w / 8 - 2).
    """
    with torch.device("meta"):
        layers: list[nn.Module] = [nn.Conv2d(2, ndf, 4, stride=2, padding=1), nn.LeakyReLU(0.2, True)]
        for c, stride in ((ndf, 2), (2 * ndf, 2), (4 * ndf, 1)):
            layers += [nn.Conv2d(c, 2 * c, 4, stride, 1, bias=False), _norm(2 * c), nn.LeakyReLU(0.2, True)]
        network = nn.Sequential(*layers, nn.Conv2d(8 * ndf, 1, 4, stride=1, padding=1))
    return _initialise(network, rng)


def receptive_field(network: nn.Module) -> int:
    """Compute the receptive field of one output of a sequence of convolutions.

    Parameters
    ----------
    network : torch.nn.Module
        Convolutions in sequence, none of them transposed. Other layers are not counted, so neither are the
        statistics of batch norm, which depend on the whole image.

    Returns
    -------
    size : int
        Edge of the receptive field [pixels]; 70 for `build_discriminator`.
    """
    size, jump = 1, 1  # receptive field, and distance between two neighbouring outputs [pixels]
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            size += (module.kernel_size[0] - 1) * jump
            jump *= module.stride[0]
    return size


def gan_loss(logits: Tensor, is_real: bool) -> Tensor:
    """Compute the binary cross-entropy of a discriminator's output, one term of Eq. 3.

    Parameters
    ----------
    logits : tensor, any shape
        Output of the discriminator before the sigmoid.
    is_real : bool
        Target for all patches.

    Returns
    -------
    loss : tensor, shape ()
        ``-log D`` if `is_real`, else ``-log(1 - D)``, mean over patches.
    """
    return functional.binary_cross_entropy_with_logits(logits, torch.full_like(logits, float(is_real)))


def l1_loss(generated: Tensor, lidar: Tensor) -> Tensor:
    """Compute the mean absolute difference of generated and lidar image, Eq. 4.

    Parameters
    ----------
    generated, lidar : tensor, shape (b, 1, h, w)
        Images in [-1, 1].

    Returns
    -------
    loss : tensor, shape ()
        Mean over all pixels, in [0, 2].
    """
    return (generated - lidar).abs().mean()


def train_step(
    networks: Mapping[str, nn.Module],
    optimizers: Mapping[str, torch.optim.Optimizer],
    radar: Tensor,
    lidar: Tensor,
    *,
    lambda_l1: float = 100.0,
    pixel_loss: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None,
    bf16: bool = False,
) -> dict[str, float]:
    """Update the discriminator, then the generator against the frozen discriminator, both in place.

    Parameters
    ----------
    networks, optimizers : mapping
        The "generator" and the "discriminator", and the optimizer of each; without a discriminator the pixel
        loss alone is minimized.
    radar, lidar : tensor, shape (b, 1, h, w)
        A batch of pairs in [-1, 1].
    lambda_l1 : float
        Lambda of Eq. 2.
    pixel_loss : callable, optional
        Replaces Eq. 4; takes the logits of the generated image, the generated image and the lidar image.
    bf16 : bool
        Compute in bfloat16 by autocast.

    Returns
    -------
    losses : dict of float
        ``loss_d`` (half the sum of its two terms), ``loss_gan``, both nan without a discriminator, and
        ``loss_l1`` (Eq. 4, without lambda).

    Raises
    ------
    Pix2PixError
        If a loss or a gradient is not finite; the weights are then not updated by it.

    Notes
    -----
    Yin et al. 2020, Sec. III-A, Eq. 2-4. As in the public code the generator maximizes log D(G(x)) instead of
    minimizing log(1 - D(G(x))), which has a larger gradient early in the training.
    """
    generator, discriminator = networks["generator"], networks.get("discriminator")
    autocast = torch.autocast(radar.device.type, torch.bfloat16, enabled=bf16)
    with autocast:
        logits = generator.logits(radar)  # (b, 1, h, w)
        generated = torch.tanh(logits)
    loss_d, loss_gan = torch.tensor(float("nan")), torch.tensor(float("nan"))
    if discriminator is not None:
        with autocast:
            loss_d = _discriminator_loss(discriminator.requires_grad_(True), radar, lidar, generated.detach())
        _optimizer_step(optimizers["discriminator"], loss_d, "discriminator loss")
        discriminator.requires_grad_(False)
        with autocast:
            loss_gan = gan_loss(discriminator(torch.cat([radar, generated], 1)).float(), True)
    loss_pixels = pixel_loss(logits, generated, lidar) if pixel_loss else l1_loss(generated, lidar)
    loss_g = lambda_l1 * loss_pixels + (0.0 if discriminator is None else loss_gan)
    _optimizer_step(optimizers["generator"], loss_g, "generator loss")
    losses = {"loss_d": loss_d, "loss_gan": loss_gan, "loss_l1": l1_loss(generated, lidar)}
    return {name: float(loss.detach()) for name, loss in losses.items()}


def _discriminator_loss(discriminator: nn.Module, radar: Tensor, lidar: Tensor, generated: Tensor) -> Tensor:
    """Compute Eq. 3 for the discriminator, halved as in pix2pix to slow it down."""
    loss_generated = gan_loss(discriminator(torch.cat([radar, generated], 1)).float(), False)
    loss_real = gan_loss(discriminator(torch.cat([radar, lidar], 1)).float(), True)
    return 0.5 * (loss_generated + loss_real)


def _optimizer_step(optimizer: torch.optim.Optimizer, loss: Tensor, name: str) -> None:
    """Take one optimizer step, or refuse if the loss or a gradient is not finite."""
    if not torch.isfinite(loss.detach()):
        raise Pix2PixError(f"{name} is {float(loss.detach())}")
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    norm = torch.nn.utils.get_total_norm([w.grad for w in weights if w.grad is not None])
    if not torch.isfinite(norm):
        raise Pix2PixError(f"gradient of the {name} is {float(norm)}")
    optimizer.step()


def evaluate_l1(generator: nn.Module, pairs: Any) -> float:
    """Evaluate Eq. 4 on held-out pairs.

    Parameters
    ----------
    generator : torch.nn.Module
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
    """Return whether a device has bfloat16 instructions; without them bfloat16 is far slower than float32."""
    if device.startswith("cuda"):
        return torch.cuda.is_available() and torch.cuda.is_bf16_supported()
    tests = (getattr(torch.cpu, f"_is_{name}_supported", None) for name in ("amx_tile", "avx512_bf16"))
    return any(test() for test in tests if test is not None)


def choose_bf16(bf16: bool | str, device: str = "cpu") -> bool:
    """Decide whether to compute in bfloat16.

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
    """Convert a grey image to a tensor: 0 becomes -1, 255 becomes +1.

    Parameters
    ----------
    image : array, shape (h, w), uint8
        Grey image.

    Returns
    -------
    tensor : tensor, shape (1, 1, h, w), float32
        The same in [-1, 1].
    """
    return torch.from_numpy(normalize_image(image[None, None]))


def generate(
    generator: Generator, radar_image: np.ndarray, *, bf16: bool = False, tta_rotations: int | None = None
) -> np.ndarray:
    """Generate a lidar image from a radar image.

    Parameters
    ----------
    generator : Generator
        The trained network. The paper's gives the same image in training and in evaluation mode.
    radar_image : array, shape (h, w), uint8
        Power image of one scan, of the size the network was trained on.
    bf16 : bool
        Compute in bfloat16: quicker where `has_bf16`.
    tta_rotations : int, optional
        Quarter turns of the image, 1 to 4, whose logits are averaged; the network's own number if not given.

    Returns
    -------
    generated : array, shape (h, w), uint8
        0 empty to 255 occupied.

    Raises
    ------
    Pix2PixError
        If the image has another type, shape or size, or `tta_rotations` is not 1 to 4.

    Notes
    -----
    Yin et al. 2020, Eq. 5.
    """
    if radar_image.dtype != np.uint8 or radar_image.ndim != 2:
        raise Pix2PixError(f"radar image: expected uint8 (h, w), got {radar_image.dtype} {radar_image.shape}")
    check_size(radar_image.shape, generator.image_size, "radar image", generator.size_step)
    n_turns = generator.tta_rotations if tta_rotations is None else tta_rotations
    check_number("tta_rotations", n_turns, "[1, 4]", int, Pix2PixError)
    radar = to_tensor(radar_image).to(next(generator.parameters()).device)
    with torch.inference_mode(), torch.autocast(radar.device.type, torch.bfloat16, enabled=bf16):
        logits = sum(
            torch.rot90(generator.logits(torch.rot90(radar, turn, (2, 3))), -turn, (2, 3))
            for turn in range(n_turns)
        )
        generated = torch.tanh(logits / n_turns)[0, 0]  # (h, w)
    return torch.round((generated.float() + 1.0) * 127.5).to(torch.uint8).cpu().numpy()


def check_size(size: tuple[int, ...], expected: tuple[int, int] | None, name: str, step: int = 4) -> None:
    """Refuse image sizes that the network cannot process, or was not trained on."""
    if any(n % step or n < max(step, 16) for n in size):
        raise Pix2PixError(
            f"{name}: height and width must be multiples of {step} from {max(step, 16)} on, got {tuple(size)}"
        )
    if expected is not None and tuple(size) != tuple(expected):
        raise Pix2PixError(f"{name}: size {tuple(size)}, but the generator was trained on {tuple(expected)}")


def save_weights(
    path: str | Path, generator: Generator, metadata: dict[str, Any] | None = None, *, half: bool = False
) -> None:
    """Write a generator with what is needed to build it again, atomically.

    Parameters
    ----------
    path : path
        File to write, ``*.safetensors``.
    generator : Generator
        The network.
    metadata : dict, optional
        More to put into the header, JSON values only (seed, settings, session ...).
    half : bool
        Write float16, half the size; `load_weights` returns float32.
    """
    about = {
        "architecture": generator.description,
        "filters": generator.ngf,
        "blocks": generator.n_blocks,
        "image_size": generator.image_size,
        "headings": generator.tta_rotations,
        "torch": str(torch.__version__),
    }
    tensors = {name: value.half() if half else value for name, value in generator.state_dict().items()}
    save_tensors(Path(path), tensors, {**(metadata or {}), **about})


def load_weights(path: str | Path) -> Generator:
    """Build a generator from a file of `save_weights`.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    generator : Generator
        The network with its weights, on the CPU, for inference: norms with running statistics are merged into
        the convolutions before them.

    Raises
    ------
    Pix2PixError
        If the file is missing, truncated, of an architecture that is not registered, does not hold the
        weights of its header's network, or holds a value that is not finite; the message names the file.
    """
    return load_network(path).generator


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

    generator: Generator
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
        As `load_weights`, or if ``points`` or ``pairs_settings`` of the header hold values of another type or
        out of range.
    """
    tensors, about = load_tensors(Path(path))
    return TrainedNetwork(_restore_generator(path, tensors, about), *_read_settings(path, about), about)


# Ranges of ``pairs_settings``: those of `rol.pairs.PairSettings`, which needs more modules than a network.
_RANGES = {"width": "[1, inf)", "max_range": "(0, inf]", "min_height": "[-inf, inf)"}
_RANGES |= dict.fromkeys(("range_resolution", "pixel_size"), "(0, inf)")
_RANGES |= dict.fromkeys(("range_offset", "doppler_seconds"), "(-inf, inf)")


def _read_settings(path: str | Path, about: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read from the header how points and radar images are made; refuse other types and values out of range.

    Other keys of ``pairs_settings``, such as the name of the session, are kept.
    """
    defaults = {"threshold": 128, "thin": False}
    for name in ("points", "pairs_settings"):
        if not isinstance(about.get(name, {}), dict):
            raise Pix2PixError(f"{path}: header: {name} is {about[name]!r:.60}, not a JSON object")
    points, pairs = {**defaults, **about.get("points", {})}, dict(about.get("pairs_settings", {}))
    for name, value in points.items():
        if type(value) is not type(defaults.get(name)):
            raise Pix2PixError(f"{path}: header: points: {name} is {value!r:.60}, known are {defaults}")
    check_number(f"{path}: header: points: threshold", points["threshold"], "[0, 255]", int, Pix2PixError)
    if (motion := pairs.get("motion", "none")) not in ("none", "corrected"):
        raise Pix2PixError(f"{path}: header: pairs_settings: motion is {motion!r:.60}, not none or corrected")
    for name in (name for name in _RANGES if name in pairs):
        field = f"{path}: header: pairs_settings: {name}"
        check_number(field, pairs[name], _RANGES[name], int if name == "width" else float, Pix2PixError)
    return points, pairs


def _restore_generator(path: str | Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> Generator:
    """Build the generator that the header describes and give it its weights."""
    try:
        network = _find_architecture(about.get("architecture"))
    except Pix2PixError as error:
        raise Pix2PixError(f"{path}: {error}") from error
    _check_header(path, about)
    try:  # RuntimeError also when the width or depth needs more memory than there is
        size = about["filters"], about["blocks"]
        generator = build_generator(*size, network.architecture, rng=torch.Generator())
        generator.load_state_dict(tensors)
    except RuntimeError as error:
        raise Pix2PixError(f"{path}: tensors do not fit the header's architecture ({error})") from error
    for name, value in generator.state_dict().items():
        if value.is_floating_point() and not tensors[name].is_floating_point():
            raise Pix2PixError(f"{path}: tensor {name!r} is of {tensors[name].dtype}, expected {value.dtype}")
    generator.image_size = tuple(about["image_size"]) if about.get("image_size") else None
    generator.tta_rotations = int(about.get("headings", 1))
    generator.eval().fuse()
    return generator


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
        raise Pix2PixError(f"{path}: header describes no network; the file was not written by rol.pix2pix")
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
    """Refuse a header with sizes of another type or out of range."""
    size = about.get("image_size")
    if size is not None and not (isinstance(size, list) and len(size) == 2):
        raise Pix2PixError(f"{path}: header: image_size is {size!r}, expected two numbers or null")
    numbers = [(name, {"headings": 1, **about}.get(name)) for name in ("filters", "blocks", "headings")]
    for name, number in [*numbers, *(("image_size", n) for n in size or ())]:
        span = {"blocks": "[0, inf)", "headings": "[1, 4]"}.get(name, "[1, inf)")
        check_number(f"{path}: header: {name}", number, span, int, Pix2PixError)
