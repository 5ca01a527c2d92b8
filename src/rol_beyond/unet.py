"""A second generator for the translator: a small U-Net that is cheap on a processor. Not in the paper.

Images as in `rol.pix2pix`: (b, 1, h, w) in [-1, 1]. The picture is folded four times in each direction before
the first convolution, so that all work is done at a quarter of the resolution and below, and unfolded at the
end; the deepest level sees most of the picture at once. A channel with the distance from the radar tells the
network what the picture does not: that a beam is wide far away and narrow near by.

Batch norm keeps running statistics here. In use it is a scale and a shift, which `fuse` multiplies into the
convolution before it.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

FOLD = 4
WIDTHS = (1, 2, 4, 4)  # channels of the levels, in units of the first


class _Conv(nn.Sequential):
    """3 x 3 convolution, norm, ReLU."""

    def __init__(self, n_in: int, n_out: int, stride: int = 1) -> None:
        conv = nn.Conv2d(n_in, n_out, 3, stride, 1, bias=False)
        super().__init__(conv, nn.BatchNorm2d(n_out, momentum=0.02), nn.ReLU(True))


class _Block(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; shape (b, c, h, w) in and out."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _Conv(channels, channels), _Conv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x))


class UnetGenerator(nn.Module):
    """Generator: fold, three halvings with shortcuts across, unfold, tanh.

    Attributes
    ----------
    filters, blocks : int
        Channels of the first level, and residual blocks on each level and side.
    image_size, headings
        As in `rol.pix2pix.ResnetGenerator`.
    """

    size_step = 32  # height and width must be multiples of it
    headings = 1

    def __init__(self, filters: int, blocks: int) -> None:
        super().__init__()
        self.filters, self.blocks, self.image_size = filters, blocks, None
        c = [filters * width for width in WIDTHS]
        self.first = _Conv(FOLD * FOLD + 1, c[0])
        self.down = nn.ModuleList(_Conv(a, b, 2) for a, b in pairwise(c))
        self.left = nn.ModuleList(nn.Sequential(*[_Block(n) for _ in range(blocks)]) for n in c)
        self.up = nn.ModuleList(_Conv(b, a) for a, b in pairwise(c))
        self.right = nn.ModuleList(nn.Sequential(*[_Block(n) for _ in range(blocks)]) for n in c[:-1])
        half = max(filters // 2, 1)
        self.widen = nn.Sequential(nn.Conv2d(c[0], 4 * half, 3, padding=1), nn.PixelShuffle(2))
        self.fine = _Conv(half + 4, half)
        self.last = nn.Sequential(nn.Conv2d(half, 4, 3, padding=1), nn.PixelShuffle(2))

    def logits(self, radar: Tensor) -> Tensor:
        """Map radar images to fake lidar images before the tanh: half the log-odds of an occupied pixel."""
        x = self.first(torch.cat([functional.pixel_unshuffle(radar, FOLD), _distances(radar)], 1))
        kept = []
        for level, blocks in enumerate(self.left):
            x = blocks(x if level == 0 else self.down[level - 1](x))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            x = functional.interpolate(self.up[level](x), scale_factor=2.0)  # (b, c, h, w) -> (b, c, 2h, 2w)
            x = self.right[level](x + kept[level])
        x = self.fine(torch.cat([functional.relu(self.widen(x)), functional.pixel_unshuffle(radar, 2)], 1))
        return self.last(x).float()  # (b, 1, h, w)

    def forward(self, radar: Tensor) -> Tensor:
        """Map radar images to fake lidar images."""
        return torch.tanh(self.logits(radar))  # (b, 1, h, w) -> (b, 1, h, w)


def _distances(radar: Tensor) -> Tensor:
    """Distance of every folded pixel from the middle, 0 to 1 at the edges, shape (b, 1, h / 4, w / 4)."""
    h, w = (n // FOLD for n in radar.shape[-2:])
    rows, columns = (torch.linspace(-1.0, 1.0, n, device=radar.device, dtype=radar.dtype) for n in (h, w))
    distances = torch.hypot(rows[:, None], columns[None, :])
    return distances.expand(len(radar), 1, h, w)


def fuse(network: nn.Module) -> nn.Module:
    """Multiply every norm with running statistics into the convolution before it (changes the network).

    Parameters
    ----------
    network : torch.nn.Module
        Network with `_Conv` parts, in evaluation mode.

    Returns
    -------
    network : torch.nn.Module
        The same; it gives the same images, but for rounding, and can no longer be trained.
    """
    from torch.nn.utils.fusion import fuse_conv_bn_eval

    for part in network.eval().modules():
        if isinstance(part, _Conv) and isinstance(part[1], nn.BatchNorm2d):
            part[0], part[1] = fuse_conv_bn_eval(part[0], part[1]), nn.Identity()
    return network
