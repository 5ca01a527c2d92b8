"""A second generator: a small U-Net that is fast on a CPU. Importing this module registers it as "unet".

Images as in `rol.pix2pix`: (b, 1, h, w) in [-1, 1]. The image is folded (pixel unshuffle) by 4 in both
directions before the first convolution, so that all computation takes place at a quarter of the resolution
and below, and unfolded at the end; the receptive field of the deepest level covers most of the image. An
additional channel holds the distance from the radar, because the width of the beam grows with range.

Batch norm keeps running statistics here. In inference it is a scale and a shift, which `UnetGenerator.fuse`
merges into the convolution before it.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from rol.pix2pix import Generator, register_architecture

FOLD = 4
WIDTHS = (1, 2, 4, 4)  # channels of the levels, in units of the first


class _Conv(nn.Sequential):
    """3 x 3 convolution, norm, ReLU."""

    def __init__(self, n_in: int, n_out: int, stride: int = 1) -> None:
        conv = nn.Conv2d(n_in, n_out, 3, stride, 1, bias=False)
        super().__init__(conv, nn.BatchNorm2d(n_out, momentum=0.02), nn.ReLU(True))


class _Block(nn.Module):
    """Two 3 x 3 convolutions with a shortcut; shape (b, c, h, w) in and out."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _Conv(channels, channels), _Conv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x))


@register_architecture
class UnetGenerator(Generator):
    """Generator: fold, three halvings with skip connections, unfold, tanh.

    `ngf` is the number of channels of the first level, `n_blocks` that of residual blocks on each level and
    side; other attributes as in `rol.pix2pix.Generator`.
    """

    architecture, description = "unet", "folded u-net, running statistics, 1 to 1 channel"
    size_step = 32

    def __init__(self, ngf: int, n_blocks: int) -> None:
        super().__init__(ngf, n_blocks)
        c = [ngf * width for width in WIDTHS]
        self.first = _Conv(FOLD * FOLD + 1, c[0])
        self.down = nn.ModuleList(_Conv(a, b, 2) for a, b in pairwise(c))
        self.left = nn.ModuleList(nn.Sequential(*[_Block(n) for _ in range(n_blocks)]) for n in c)
        self.up = nn.ModuleList(_Conv(b, a) for a, b in pairwise(c))
        self.right = nn.ModuleList(nn.Sequential(*[_Block(n) for _ in range(n_blocks)]) for n in c[:-1])
        half = max(ngf // 2, 1)
        self.widen = nn.Sequential(nn.Conv2d(c[0], 4 * half, 3, padding=1), nn.PixelShuffle(2))
        self.fine = _Conv(half + 4, half)
        self.last = nn.Sequential(nn.Conv2d(half, 4, 3, padding=1), nn.PixelShuffle(2))

    def logits(self, radar: Tensor) -> Tensor:
        """Compute the generated images before the tanh: half the log-odds of an occupied pixel."""
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

    def fuse(self) -> None:
        """Merge every norm into the convolution before it; the network can no longer be trained.

        The generated images stay the same but for rounding.
        """
        for part in self.eval().modules():
            if isinstance(part, _Conv) and isinstance(part[1], nn.BatchNorm2d):
                part[0], part[1] = fuse_conv_bn_eval(part[0], part[1]), nn.Identity()


def _distances(radar: Tensor) -> Tensor:
    """Distance of every folded pixel from the centre, 0 to 1 at the edges, shape (b, 1, h / 4, w / 4)."""
    h, w = (n // FOLD for n in radar.shape[-2:])
    rows, columns = (torch.linspace(-1.0, 1.0, n, device=radar.device, dtype=radar.dtype) for n in (h, w))
    distances = torch.hypot(rows[:, None], columns[None, :])
    return distances.expand(len(radar), 1, h, w)
