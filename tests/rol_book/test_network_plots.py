"""Figures of networks show the layers of the network that they are given."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pytest

torch = pytest.importorskip("torch")

from matplotlib.patches import Rectangle

from rol.pix2pix import build_discriminator, build_generator
from rol_book.network_plots import Layer, draw_network, trace_layers

pytestmark = pytest.mark.torch


def test_layers_of_the_generator():
    network = build_generator(4, 3, rng=torch.Generator().manual_seed(1))
    layers = trace_layers(network, 1, 64)
    assert [layer.kind for layer in layers] == ["input", *["conv"] * 3, "residual", *["conv up"] * 2, "conv"]
    assert [layer.channels for layer in layers] == [1, 4, 8, 16, 16, 8, 4, 1]
    assert [layer.height for layer in layers] == [64, 64, 32, 16, 16, 32, 64, 64]
    assert layers[4].repeats == 3 and layers[1].label == "conv\n7 x 7"
    assert layers[2].label == "conv\n3 x 3, / 2" and layers[5].label == "up-conv\n3 x 3, x 2"
    assert not any(module._forward_hooks for module in network.modules())


def test_layers_of_the_discriminator_end_with_its_answers():
    network = build_discriminator(4, rng=torch.Generator().manual_seed(1))
    layers = trace_layers(network, 2, 64)
    assert [layer.channels for layer in layers] == [2, 4, 8, 16, 32, 1]
    assert (layers[-1].height, layers[-1].width) == tuple(network(torch.zeros(1, 2, 64, 64)).shape[-2:])


def test_drawing_has_a_box_for_each_layer_and_its_shape():
    layers = [Layer("input", "input", 1, 64, 64), Layer("residual", "block", 16, 16, 8, repeats=2)]
    ax = draw_network(plt.subplots()[1], layers, "a network")
    plt.close("all")
    assert len([patch for patch in ax.patches if isinstance(patch, Rectangle)]) == 3
    assert [text.get_text() for text in ax.texts if text.get_text()] == [
        "input",
        "1 ch.\n64 x 64",
        "2 x block",
        "16 ch.\n16 x 8",
    ]
