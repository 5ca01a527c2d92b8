"""Networks against the public ones, losses and a step by hand, `generate` at both ends, files of weights."""

import copy
import json
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from safetensors.torch import save_file
from torch import nn

from rol import pix2pix
from rol.pairs import PairSettings
from rol.pix2pix import (
    Generator,
    Pix2PixError,
    ResnetGenerator,
    TrainConfig,
    build_discriminator,
    build_generator,
    choose_bf16,
    evaluate_l1,
    gan_loss,
    generate,
    l1_loss,
    load_network,
    load_tensors,
    load_weights,
    receptive_field,
    register_architecture,
    save_tensors,
    save_weights,
    to_tensor,
    train_step,
)

pytestmark = pytest.mark.torch


def seeded(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def tiny_generator(seed: int = 1) -> nn.Module:
    return build_generator(2, 1, rng=seeded(seed))


def radar_image(size: int = 32) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (size, size), dtype=np.uint8)


def count(network: nn.Module) -> int:
    return sum(weight.numel() for weight in network.parameters())


# ---- networks


def test_half_precision_weights_come_back_as_single(tmp_path: Path) -> None:
    generator = tiny_generator()
    save_weights(tmp_path / "g.safetensors", generator, half=True)
    assert (tmp_path / "g.safetensors").stat().st_size < 4 * count(generator)
    for back, weight in zip(
        load_weights(tmp_path / "g.safetensors").parameters(), generator.parameters(), strict=True
    ):
        assert back.dtype == torch.float32
        torch.testing.assert_close(back, weight, rtol=1e-3, atol=1e-6)


def test_full_networks_have_the_size_of_the_public_ones() -> None:
    # The public generator with three channels and biases has 11,378,179 weights. One channel takes 4 x 64 x
    # 49 weights and two biases away; scale and shift of the norm instead of 5,248 biases add as many.
    assert count(build_generator(rng=seeded())) == 11_378_179 - 4 * 64 * 49 - 2 + 5_248
    # The public discriminator with six channels and batch norm has 2,768,705; ours has two channels.
    assert count(build_discriminator(rng=seeded())) == 2_768_705 - 4 * 64 * 16


def test_generator_keeps_the_size_and_stays_within_the_range() -> None:
    fake = tiny_generator()(torch.randn(1, 1, 32, 48, generator=seeded()))
    assert fake.shape == (1, 1, 32, 48)
    assert fake.abs().max() <= 1.0


def test_discriminator_judges_patches_of_70_pixels() -> None:
    network = build_discriminator(2, rng=seeded())
    assert receptive_field(network) == 70
    assert network(torch.zeros(1, 2, 512, 512)).shape == (1, 1, 62, 62)
    # The same by asking: on which pixels does one logit depend, the statistics of the norms put aside?
    plain = nn.Sequential(*(nn.Identity() if isinstance(m, nn.BatchNorm2d) else m for m in network))
    pair = torch.randn(1, 2, 192, 192, generator=seeded(), requires_grad=True)
    plain(pair)[0, 0, 11, 11].backward()
    seen = torch.nonzero(pair.grad[0].abs().sum(0))
    assert (seen.max(0).values - seen.min(0).values + 1).tolist() == [70, 70]


def test_first_weights_are_those_of_pix2pix_and_follow_from_the_seed_alone() -> None:
    before = torch.get_rng_state()
    one, two, other = (build_generator(8, 2, rng=seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))
    assert not torch.equal(one.layers[1].weight, other.layers[1].weight)
    kernels = torch.cat([m.weight.detach().flatten() for m in one.modules() if isinstance(m, nn.Conv2d)])
    scales = torch.cat([m.weight.detach() for m in one.modules() if isinstance(m, nn.BatchNorm2d)])
    assert abs(float(kernels.mean())) < 1e-3 and abs(float(kernels.std()) - 0.02) < 1e-3
    assert abs(float(scales.mean()) - 1.0) < 0.01
    assert all(not m.bias.any() for m in one.modules() if getattr(m, "bias", None) is not None)


@pytest.mark.parametrize(("ngf", "n_blocks", "fault"), [(0, 9, "ngf: 0"), (8, -1, "n_blocks: -1")])
def test_impossible_networks_are_refused(ngf: int, n_blocks: int, fault: str) -> None:
    with pytest.raises(Pix2PixError, match=f"{fault} is not a whole number in"):
        build_generator(ngf, n_blocks, rng=seeded())


@register_architecture
class Dim(Generator):
    """A network of one weight."""

    architecture, description, size_step = "dim", "one weight, 1 to 1 channel", 2

    def __init__(self, ngf: int, n_blocks: int) -> None:
        super().__init__(ngf, n_blocks)
        self.layer = nn.Conv2d(1, 1, 1, bias=False)
        self.is_fused = False

    def logits(self, radar: torch.Tensor) -> torch.Tensor:
        return self.layer(radar)

    def fuse(self) -> None:
        self.is_fused = True


def test_a_registered_architecture_is_built_and_comes_back_from_its_file(tmp_path: Path) -> None:
    generator = build_generator(1, 0, "dim", rng=seeded())
    assert isinstance(generator, Dim) and not generator.is_fused
    save_weights(tmp_path / "g.safetensors", generator)
    read = load_weights(tmp_path / "g.safetensors")
    assert isinstance(read, Dim) and read.is_fused and not read.training
    assert torch.equal(read.layer.weight, generator.layer.weight)


def test_unknown_architectures_are_refused_naming_the_known_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {"resnet": ResnetGenerator, "dim": Dim}
    monkeypatch.setattr(pix2pix, "ARCHITECTURES", known)
    with pytest.raises(Pix2PixError, match="architecture 'vit' is none of resnet, dim"):
        build_generator(8, 1, "vit", rng=seeded())
    with pytest.raises(Pix2PixError, match=r"'unet' is not registered: `import rol_beyond\.unet` first"):
        build_generator(8, 1, "unet", rng=seeded())


# ---- losses and one step


def test_losses_by_hand() -> None:
    assert float(gan_loss(torch.zeros(2, 3), True)) == pytest.approx(math.log(2))
    assert float(gan_loss(torch.full((1,), math.log(3.0)), True)) == pytest.approx(-math.log(0.75))
    assert float(gan_loss(torch.full((1,), math.log(3.0)), False)) == pytest.approx(-math.log(0.25))
    lidar = torch.tensor([[[[-1.0, -1.0], [-1.0, 1.0]]]])
    empty = torch.full_like(lidar, -1.0)
    assert float(l1_loss(empty, lidar)) == 0.5  # one of four pixels is off by 2
    assert float(l1_loss(lidar, lidar)) == 0.0


def literal_step(generator, discriminator, adam_g, adam_d, radar, lidar, lambda_l1) -> None:
    """The step of the public code, written down once more with two graphs of its own."""
    bce = nn.BCEWithLogitsLoss()
    with torch.no_grad():
        fixed = generator(radar)
    real, fake = discriminator(torch.cat([radar, lidar], 1)), discriminator(torch.cat([radar, fixed], 1))
    adam_d.zero_grad()
    ((bce(fake, torch.zeros_like(fake)) + bce(real, torch.ones_like(real))) * 0.5).backward()
    adam_d.step()
    output = generator(radar)
    judged = discriminator(torch.cat([radar, output], 1))
    adam_g.zero_grad()
    (bce(judged, torch.ones_like(judged)) + lambda_l1 * (output - lidar).abs().mean()).backward()
    adam_g.step()


def make_networks() -> dict[str, nn.Module]:
    return {"generator": tiny_generator(), "discriminator": build_discriminator(2, rng=seeded(2))}


def optimizers(networks: dict[str, nn.Module]) -> dict[str, torch.optim.Optimizer]:
    return {
        name: torch.optim.Adam(network.parameters(), 2e-4, (0.5, 0.999)) for name, network in networks.items()
    }


def make_batch() -> torch.Tensor:
    return torch.rand(2, 1, 1, 32, 32, generator=seeded(3)) * 2 - 1


@pytest.mark.parametrize("lambda_l1", [100.0, 7.0])
def test_step_updates_the_discriminator_first_and_then_the_generator(lambda_l1: float) -> None:
    networks = make_networks()
    literal = copy.deepcopy(networks)
    adam_ours, adam_literal = optimizers(networks), optimizers(literal)
    for _ in range(2):
        train_step(networks, adam_ours, *make_batch(), lambda_l1=lambda_l1)
        literal_step(*literal.values(), *adam_literal.values(), *make_batch(), lambda_l1)
    for name in networks:
        for a, b in zip(networks[name].parameters(), literal[name].parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


def test_step_reports_plain_losses() -> None:
    networks, (radar, lidar) = make_networks(), make_batch()
    expected = float(l1_loss(networks["generator"](radar), lidar).detach())
    losses = train_step(
        networks, optimizers(networks), radar, lidar, pixel_loss=lambda logits, image, lidar: image.mean()
    )
    assert set(losses) == {"loss_d", "loss_gan", "loss_l1"}
    assert losses["loss_l1"] == pytest.approx(expected)


def test_another_pixel_loss_is_what_the_generator_minimizes() -> None:
    networks = {"generator": tiny_generator()}
    literal, (radar, lidar) = copy.deepcopy(networks), make_batch()
    adam_ours, adam_literal = optimizers(networks), optimizers(literal)
    losses = train_step(
        networks, adam_ours, radar, lidar, lambda_l1=2.0, pixel_loss=lambda logits, *_: (logits**2).mean()
    )
    assert math.isnan(losses["loss_d"]) and math.isnan(losses["loss_gan"])  # no discriminator
    adam_literal["generator"].zero_grad()
    (2.0 * (literal["generator"].logits(radar) ** 2).mean()).backward()
    adam_literal["generator"].step()
    for a, b in zip(networks["generator"].parameters(), literal["generator"].parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-7)


def test_loss_that_is_not_finite_is_refused_before_it_reaches_the_weights() -> None:
    networks = make_networks()
    before = copy.deepcopy(networks)
    radar = torch.full((1, 1, 32, 32), float("nan"))
    with pytest.raises(Pix2PixError, match="discriminator loss is nan"):
        train_step(networks, optimizers(networks), radar, torch.zeros_like(radar))
    for name, network in networks.items():
        pairs = zip(network.parameters(), before[name].parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs)


def test_step_in_bfloat16_keeps_weights_in_full_precision() -> None:
    networks = make_networks()
    losses = train_step(networks, optimizers(networks), *make_batch(), bf16=True)
    assert all(math.isfinite(loss) for loss in losses.values())
    assert all(weight.dtype == torch.float32 for weight in networks["generator"].parameters())


def test_padding_keeps_bfloat16() -> None:
    image = torch.rand(1, 4, 16, 16, generator=seeded(1)).bfloat16()
    pads = [
        part
        for part in build_generator(4, 1, rng=seeded(2)).modules()
        if isinstance(part, nn.ReflectionPad2d)
    ]
    with torch.autocast("cpu", torch.bfloat16):
        kinds = [pad(image).dtype for pad in pads]
    assert kinds == [torch.bfloat16] * 4


def test_bf16_is_chosen_by_the_processor_unless_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for there in (False, True):
        monkeypatch.setattr("rol.pix2pix.has_bf16", lambda device, there=there: there)
        assert [choose_bf16(value) for value in (False, True, "auto")] == [False, True, there]
    for value in ("yes", 1, None):
        with pytest.raises(Pix2PixError, match='bf16: expected true, false or "auto"'):
            choose_bf16(value)


def test_steps_of_a_run_count_epochs_unless_told() -> None:
    assert TrainConfig(epochs=3, batch_size=4).n_steps(10) == 9
    assert TrainConfig(epochs=3, steps=7).n_steps(10) == 7


def test_held_out_l1_is_the_mean_over_pairs() -> None:
    pairs = [(np.full((1, 16, 16), -1, np.float32), np.full((1, 16, 16), v, np.float32)) for v in (-1, 0)]
    assert evaluate_l1(Same(), pairs) == 0.5
    assert math.isnan(evaluate_l1(Same(), []))


# ---- use


class Same(Generator):
    """A network that gives its input back."""

    def __init__(self) -> None:
        super().__init__(1, 0)
        self.unused = nn.Parameter(torch.zeros(1))

    def logits(self, x: torch.Tensor) -> torch.Tensor:
        return torch.atanh(x)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


def test_value_range_goes_there_and_back_for_every_grey_value() -> None:
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    tensor = to_tensor(image)
    assert (float(tensor.min()), float(tensor.max())) == (-1.0, 1.0)
    assert tensor.shape == (1, 1, 16, 16) and tensor.dtype == torch.float32
    np.testing.assert_array_equal(generate(Same(), image), image)


def test_generate_does_not_depend_on_the_mode_and_changes_nothing() -> None:
    generator, image = tiny_generator(), radar_image()
    before = copy.deepcopy(generator.state_dict())
    fakes = [generate(generator.train(mode), image) for mode in (True, False, True)]
    assert fakes[0].shape == (32, 32) and fakes[0].dtype == np.uint8
    assert len(np.unique(fakes[0])) > 1
    np.testing.assert_array_equal(fakes[0], fakes[1])
    np.testing.assert_array_equal(fakes[0], fakes[2])
    assert before.keys() == generator.state_dict().keys()
    assert all(torch.equal(value, generator.state_dict()[name]) for name, value in before.items())


def test_rotations_are_averaged_and_turned_back() -> None:
    generator, image = tiny_generator().eval(), radar_image()
    turned = generate(generator, np.ascontiguousarray(np.rot90(image)), tta_rotations=4)
    np.testing.assert_allclose(
        np.rot90(turned, -1).astype(int), generate(generator, image, tta_rotations=4).astype(int), atol=1
    )
    assert not np.array_equal(generate(generator, image), generate(generator, image, tta_rotations=4))
    with pytest.raises(Pix2PixError, match=r"tta_rotations: 5 is not a whole number in \[1, 4\]"):
        generate(generator, image, tta_rotations=5)


def test_number_of_rotations_is_kept_with_the_weights(tmp_path: Path) -> None:
    generator, image = tiny_generator().eval(), radar_image()
    assert generator.tta_rotations == 1
    generator.tta_rotations = 4
    save_weights(tmp_path / "g.safetensors", generator)
    read = load_weights(tmp_path / "g.safetensors")
    np.testing.assert_array_equal(generate(read, image), generate(tiny_generator(), image, tta_rotations=4))


def test_generate_is_the_function_that_training_saw() -> None:
    generator, image = tiny_generator(), radar_image()
    seen = generator.train()(to_tensor(image)).detach()[0, 0].numpy()
    np.testing.assert_array_equal(generate(generator.eval(), image), np.rint((seen + 1) * np.float32(127.5)))


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (np.zeros((32, 32)), "expected uint8"),
        (np.zeros((32, 32, 3), np.uint8), r"expected uint8 \(h, w\), got uint8 \(32, 32, 3\)"),
        (np.zeros((30, 32), np.uint8), "multiples of 4"),
        (np.zeros((8, 32), np.uint8), "from 16 on"),
    ],
)
def test_images_that_do_not_fit_are_refused(image: np.ndarray, fault: str) -> None:
    with pytest.raises(Pix2PixError, match=fault):
        generate(tiny_generator(), image)


# ---- weights as files


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    generator = tiny_generator()
    generator.image_size = (32, 32)
    save_weights(tmp_path / "deep" / "g.safetensors", generator, {"seed": 1, "config": {"steps": 3}})
    return tmp_path / "deep" / "g.safetensors"


def test_weights_come_back_with_what_they_are(weights: Path) -> None:
    assert [path.name for path in weights.parent.iterdir()] == ["g.safetensors"]
    generator = load_weights(weights)
    np.testing.assert_array_equal(
        generate(generator, radar_image()), generate(tiny_generator(), radar_image())
    )
    about = load_tensors(weights)[1]
    assert about["seed"] == 1 and about["config"] == {"steps": 3}
    assert about["architecture"] == ResnetGenerator.description and about["torch"] == torch.__version__


def test_trained_generator_refuses_images_of_another_size(weights: Path) -> None:
    with pytest.raises(Pix2PixError, match=r"size \(64, 64\), but the generator was trained on \(32, 32\)"):
        generate(load_weights(weights), radar_image(64))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_truncated_weights_are_refused(weights: Path, share: float) -> None:
    data = weights.read_bytes()
    weights.write_bytes(data[: int(share * len(data))])
    with pytest.raises(Pix2PixError, match="g.safetensors: not a whole safetensors file"):
        load_weights(weights)


def test_missing_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(Pix2PixError, match="none.safetensors: no such"):
        load_weights(tmp_path / "none.safetensors")


def test_weights_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"w": torch.zeros(2)}, path)
    with pytest.raises(Pix2PixError, match="other.safetensors: .*not written by"):
        load_weights(path)
    save_tensors(path, {"w": torch.zeros(2)}, {"architecture": "u-net"})
    with pytest.raises(Pix2PixError, match="other.safetensors: architecture 'u-net'"):
        load_weights(path)


def contiguous(network: nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.contiguous() for name, tensor in network.state_dict().items()}


HEADER = {"architecture": ResnetGenerator.description, "filters": 2, "blocks": 1, "image_size": None}


@pytest.mark.parametrize(
    ("header", "fault"),
    [
        ("{", "header is not whole JSON"),
        ("[1]", r"header is \[1\], not a JSON object"),
        (json.dumps({**HEADER, "filters": None}), "header: filters: None is not a whole number"),
        (json.dumps({**HEADER, "blocks": "1"}), "header: blocks: '1' is not a whole number"),
        (json.dumps({**HEADER, "headings": 1.5}), "header: headings: 1.5 is not a whole number"),
        (json.dumps({**HEADER, "image_size": 512}), "header: image_size is 512, expected two numbers"),
        (json.dumps({**HEADER, "filters": 0}), r"header: filters: 0 is not a whole number in \[1, inf"),
        (json.dumps({**HEADER, "headings": 9}), r"header: headings: 9 is not a whole number in \[1, 4\]"),
        (json.dumps({**HEADER, "filters": 10**9}), "tensors do not fit the header's architecture"),
    ],
)
def test_broken_headers_are_named(tmp_path: Path, header: str, fault: str) -> None:
    path = tmp_path / "g.safetensors"
    save_file(contiguous(tiny_generator()), path, {"rol": header})
    with pytest.raises(Pix2PixError, match=f"g.safetensors: {fault}"):
        load_weights(path)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_neither_read_nor_written(tmp_path: Path, value: float) -> None:
    path, generator = tmp_path / "g.safetensors", tiny_generator()
    name, weight = list(generator.named_parameters())[-1]
    nn.init.constant_(weight, value)
    fault = f"g.safetensors: tensor '{name}' holds a value that is not finite"
    with pytest.raises(Pix2PixError, match=fault):
        save_weights(path, generator)
    save_file(contiguous(generator), path, {"rol": json.dumps(HEADER)})
    with pytest.raises(Pix2PixError, match=fault):
        load_weights(path)


@pytest.mark.parametrize("kind", [torch.int32, torch.bool, torch.float8_e4m3fn])
def test_weights_of_another_type_are_refused(tmp_path: Path, kind: torch.dtype) -> None:
    path = tmp_path / "g.safetensors"
    tensors = {name: tensor.to(kind) for name, tensor in contiguous(tiny_generator()).items()}
    save_file(tensors, path, {"rol": json.dumps(HEADER)})
    with pytest.raises(Pix2PixError, match=f"g.safetensors: tensor .* is of {kind}, expected"):
        load_weights(path)


def test_header_that_promises_another_network_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong.safetensors"
    about = {"architecture": ResnetGenerator.description, "filters": 4, "blocks": 1, "image_size": None}
    save_tensors(path, dict(tiny_generator().state_dict()), about)
    with pytest.raises(Pix2PixError, match="wrong.safetensors: tensors do not fit"):
        load_weights(path)


@pytest.mark.parametrize(
    ("header", "fault"),
    [
        ({"points": None}, "points is None, not a JSON object"),
        ({"pairs_settings": [1]}, r"pairs_settings is \[1\], not a JSON object"),
        ({"points": {"threshold": "high"}}, "points: threshold is 'high', known are"),
        ({"points": {"radius": 3}}, "points: radius is 3, known are"),
        ({"points": {"threshold": 300}}, r"points: threshold: 300 is not a whole number in \[0, 255\]"),
        ({"pairs_settings": {"motion": "turned"}}, "pairs_settings: motion is 'turned', not none"),
        ({"pairs_settings": {"width": 512.0}}, "pairs_settings: width: 512.0 is not a whole number"),
        ({"pairs_settings": {"pixel_size": None}}, r"pairs_settings: pixel_size: None is not in \(0, inf\)"),
        ({"pairs_settings": {"range_offset": [0.0]}}, r"pairs_settings: range_offset: \[0.0\] is not in"),
        ({"pairs_settings": {"max_range": "far"}}, "pairs_settings: max_range: 'far' is not in"),
    ],
)
def test_header_with_other_points_is_refused(tmp_path: Path, header: dict, fault: str) -> None:
    save_weights(tmp_path / "net.safetensors", tiny_generator(), header)
    with pytest.raises(Pix2PixError, match=f"net.safetensors: header: {fault}"):
        load_network(tmp_path / "net.safetensors")


@pytest.mark.parametrize("name", [field.name for field in fields(PairSettings)])
@pytest.mark.parametrize("value", [-math.inf, -2.0, -1, 0, 0.5, 1, math.inf, True, None, "corrected", [1]])
def test_header_and_pair_settings_refuse_the_same(tmp_path: Path, name: str, value: object) -> None:
    def is_refused(make: Callable[[], object]) -> bool:
        try:
            make()
        except ValueError as error:
            assert name in str(error)
            return True
        return False

    path = tmp_path / "net.safetensors"
    save_weights(path, tiny_generator(), {"pairs_settings": {name: value, "session": "sim-a"}})
    assert is_refused(lambda: load_network(path)) == is_refused(lambda: PairSettings(**{name: value}))


def test_network_comes_with_its_threshold_and_image_settings(tmp_path: Path, weights: Path) -> None:
    plain = load_network(weights)
    assert plain.points == {"threshold": 128, "thin": False} and plain.settings == {}
    path = tmp_path / "net.safetensors"
    save_weights(
        path, tiny_generator(), {"points": {"threshold": 140}, "pairs_settings": {"motion": "corrected"}}
    )
    network = load_network(path)
    assert network.points == {"threshold": 140, "thin": False} and network.settings == {"motion": "corrected"}
    assert network.about["filters"] == network.generator.ngf == 2
