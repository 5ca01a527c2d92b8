"""The U-Net: registered by import, the same images after fusing, and refused by `rol` alone."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from torch import nn

from rol.pix2pix import build_generator, save_weights
from rol_beyond.unet import UnetGenerator

pytestmark = pytest.mark.torch
SRC = Path(__file__).resolve().parents[2] / "src"
LOAD = "import sys; from rol.pix2pix import load_weights; print(load_weights(sys.argv[1]).architecture)"


def test_fused_network_generates_the_same_images() -> None:
    rng = torch.Generator().manual_seed(1)
    network = build_generator(4, 1, "unet", rng=rng)
    assert isinstance(network, UnetGenerator) and (network.ngf, network.n_blocks) == (4, 1)
    images = torch.rand(4, 1, 64, 96, generator=rng) * 2.0 - 1.0
    for _ in range(3):
        network.logits(images)  # updates the running statistics
    with torch.inference_mode():
        before = network.eval()(images)
        network.fuse()
        np.testing.assert_allclose(network(images), before, atol=2e-5)
    assert before.shape == images.shape and float(before.std()) > 0.0
    assert not any(isinstance(part, nn.BatchNorm2d) for part in network.modules())


@pytest.mark.parametrize("registered", [False, True])
def test_rol_alone_names_the_import_that_the_weights_need(tmp_path: Path, registered: bool) -> None:
    path = tmp_path / "net.safetensors"
    save_weights(path, build_generator(2, 1, "unet", rng=torch.Generator().manual_seed(1)))
    code = ("import rol_beyond.unet; " if registered else "") + LOAD
    answer = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        env={**os.environ, "PYTHONPATH": str(SRC)},
        capture_output=True,
        text=True,
        check=False,
    )
    if registered:
        assert answer.stdout == "unet\n", answer.stderr
    else:
        assert "net.safetensors: architecture 'folded u-net" in answer.stderr
        assert "is not registered: `import rol_beyond.unet` first" in answer.stderr
