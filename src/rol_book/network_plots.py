"""Figure of a convolutional network, drawn from the network itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from torch import nn

from rol.pix2pix import ResidualBlock

KIND_COLOURS = {"input": "#FFFFFF", "conv": "#56B4E9", "conv up": "#E69F00", "residual": "#BBBBBB"}


@dataclass(frozen=True)
class Layer:
    """One box of the figure.

    Attributes
    ----------
    kind : str
        "input", "conv", "conv up" (transposed) or "residual".
    label : str
        Name, kernel and stride.
    channels, height, width : int
        Shape of the output.
    repeats : int
        Number of equal layers in a row.
    """

    kind: str
    label: str
    channels: int
    height: int
    width: int
    repeats: int = 1


def trace_layers(network: nn.Module, n_channels: int, size: int = 512) -> list[Layer]:
    """Trace the convolutions and residual blocks of a network, with the shapes that they output.

    Parameters
    ----------
    network : torch.nn.Module
        The network, layers in the order in which they run.
    n_channels, size : int
        Channels of the input, and its height and width [pixels].

    Returns
    -------
    layers : list of Layer
        The input first; equal neighbours are merged.
    """
    layers, handles = [Layer("input", "input", n_channels, size, size)], []

    def record(module: nn.Module, _: Any, output: torch.Tensor) -> None:
        layer = Layer(*_name_layer(module), *output.shape[1:])
        if replace(layers[-1], repeats=1) == layer and layer.kind == "residual":
            layers[-1] = replace(layers[-1], repeats=layers[-1].repeats + 1)
        else:
            layers.append(layer)

    blocks = [module for module in network.modules() if isinstance(module, ResidualBlock)]
    inside = {part for block in blocks for part in block.modules()} - set(blocks)
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | ResidualBlock) and module not in inside:
            handles.append(module.register_forward_hook(record))
    try:
        with torch.inference_mode():
            network(torch.zeros(1, n_channels, size, size))
    finally:
        for handle in handles:
            handle.remove()
    return layers


def draw_network(ax: Axes, layers: list[Layer], title: str = "") -> Axes:
    """Draw the layers of a network from left to right.

    The height of a box grows with the height of the layer's output, its width with the number of channels.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    layers : list of Layer
        From `trace_layers`.
    title : str
        Title.

    Returns
    -------
    ax : Axes
        The axes.
    """
    right = 0.0
    for place, layer in enumerate(layers):
        tall = 0.2 + 0.8 * np.log2(max(layer.height, 16) / 16) / np.log2(512 / 16)
        wide = 0.10 + 0.09 * np.log2(layer.channels)
        copies = min(layer.repeats, 3)  # a stack of boxes stands for several layers
        for copy in reversed(range(copies)):
            corner = (place - wide / 2 + 0.05 * copy, -tall / 2 + 0.03 * copy)
            box = Rectangle(corner, wide, tall, facecolor=KIND_COLOURS[layer.kind], edgecolor="#333333")
            ax.add_patch(box)
        if place:
            arrow = {"arrowstyle": "->", "shrinkA": 4, "shrinkB": 2}
            ax.annotate("", (place - wide / 2, 0.0), (right, 0.0), arrowprops=arrow)
        right = place + wide / 2 + 0.05 * (copies - 1)
        name = f"{layer.repeats} x {layer.label}" if layer.repeats > 1 else layer.label
        ax.text(place, 0.62, name, ha="center", va="bottom", fontsize=9.5)
        shape = f"{layer.channels} ch.\n{layer.height} x {layer.width}"
        ax.text(place, -0.6, shape, ha="center", va="top", fontsize=9.5)
    ax.set(xlim=(-0.6, max(len(layers), 8) - 0.4), ylim=(-1.05, 1.05))
    ax.set_title(title)
    ax.set_axis_off()
    return ax


def count_weights(network: nn.Module) -> int:
    """Count the weights of a network."""
    return sum(weight.numel() for weight in network.parameters())


def _name_layer(module: nn.Module) -> tuple[str, str]:
    """Name a layer: its kind, and what stands above its box."""
    if isinstance(module, ResidualBlock):
        return "residual", "residual\nblock"
    is_up = isinstance(module, nn.ConvTranspose2d)
    kernel, stride = module.kernel_size[0], module.stride[0]
    change = "" if stride == 1 else f", {'x' if is_up else '/'} {stride}"
    return (
        ("conv up", f"up-conv\n{kernel} x {kernel}{change}")
        if is_up
        else ("conv", f"conv\n{kernel} x {kernel}{change}")
    )
