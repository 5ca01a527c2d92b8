"""Folders of generated images: made, resumed, made anew for other settings, and refused when incomplete."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

import generate_images
from rol import pix2pix
from rol.pairs import generated_folder, read_image, read_points
from rol.pix2pix import build_generator, generate, save_weights
from rol.radar import ScanMotion, compensate_points
from rol_beyond import generated
from rol_beyond.generated import generate_session

pytestmark = pytest.mark.torch
STAMPS = [1_000_000, 1_250_000, 1_500_000]


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """A folder of pairs with three radar images."""
    (tmp_path / "pairs" / "radar").mkdir(parents=True)
    rng = np.random.default_rng(1)
    for stamp in STAMPS:
        image = rng.integers(0, 256, (32, 32), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "pairs" / "radar" / f"{stamp}.png"), image)
    return tmp_path / "pairs"


@pytest.fixture
def generator() -> torch.nn.Module:
    return build_generator(2, 1, rng=torch.Generator().manual_seed(1))


@pytest.fixture
def weights(tmp_path: Path, generator: torch.nn.Module) -> Path:
    save_weights(tmp_path / "tiny.safetensors", generator, {"points": {"threshold": 100, "thin": False}})
    return tmp_path / "tiny.safetensors"


@pytest.fixture
def session(pairs: Path) -> Path:
    """The same pairs, complete."""
    about = {"settings": {"motion": "none"}, "stamps_us": STAMPS}
    (pairs / "pairs.json").write_text(json.dumps(about), encoding="utf-8")
    return pairs


def test_images_are_what_the_generator_gives(session: Path, weights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fake"
    assert list(generate_session(weights, session, folder, threshold=140, bf16=False)) == STAMPS
    about = generated_folder(folder).read()
    assert about["stamps_us"] == STAMPS and about["points"] == {"threshold": 140, "thin": False}
    assert about["settings"]["pairs"] == {"motion": "none"}
    network = pix2pix.load_network(weights).generator
    expected = generate(network, read_image(session / "radar" / f"{STAMPS[1]}.png"))
    np.testing.assert_array_equal(read_image(folder / f"{STAMPS[1]}.png"), expected)
    names = {path.name for path in folder.iterdir()}
    assert names == {"settings.json", "fake.json", *(f"{stamp}.png" for stamp in STAMPS)}


def test_incomplete_folder_is_refused(session: Path, weights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fake"
    run = generate_session(weights, session, folder)
    assert [next(run), next(run)] == STAMPS[:2]
    run.close()
    images = generated_folder(folder)
    with pytest.raises(ValueError, match="fake.json: missing"):
        images.read()
    with pytest.raises(ValueError, match=f"{STAMPS[2]}.png: missing"):
        images.finish({}, STAMPS)
    (folder / "fake.json").write_text('{"stamps": []}', encoding="utf-8")
    with pytest.raises(ValueError, match="fake.json: not a list of images"):
        images.read()


def test_unreadable_images_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="none.png: the image is missing"):
        read_image(tmp_path / "none.png")
    for data in (b"", b"not a picture"):
        (tmp_path / "bad.png").write_bytes(data)
        with pytest.raises(ValueError, match="bad.png: not a readable grey image"):
            read_image(tmp_path / "bad.png")


def test_complete_folder_is_not_changed(
    session: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "fake"
    assert list(generate_session(weights, session, folder)) == STAMPS
    assert generated_folder(folder).read()["points"]["threshold"] == 100
    monkeypatch.setattr(Path, "write_bytes", lambda path, data: pytest.fail(f"wrote {path}"))
    assert list(generate_session(weights, session, folder)) == STAMPS


def test_stopped_session_goes_on_and_other_pairs_start_anew(
    session: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, made = tmp_path / "fake", []
    save = generated.save_image
    monkeypatch.setattr(
        generated, "save_image", lambda path, image: made.append(int(path.stem)) or save(path, image)
    )
    stopped = generate_session(weights, session, folder)
    next(stopped)
    stopped.close()
    assert list(generate_session(weights, session, folder)) == STAMPS
    assert made == STAMPS
    list(generate_session(weights, session, folder, threshold=120))
    assert made == STAMPS and generated_folder(folder).read()["points"]["threshold"] == 120
    about = {"settings": {"motion": "corrected"}, "stamps_us": STAMPS}
    (session / "pairs.json").write_text(json.dumps(about), encoding="utf-8")
    list(generate_session(weights, session, folder))
    assert made == STAMPS * 2


def test_bf16_is_used_where_the_device_has_it(
    session: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = []
    monkeypatch.setattr(pix2pix, "generate", lambda network, image, bf16: used.append(bf16) or image)
    for i, (has, wanted) in enumerate(((True, "auto"), (True, False), (False, "auto"))):
        monkeypatch.setattr(pix2pix, "has_bf16", lambda device, has=has: has)
        list(generate_session(weights, session, tmp_path / f"fake-{i}", bf16=wanted))
    assert used == [True] * 3 + [False] * 6


def test_points_are_moved_to_mid_scan_once(session: Path, weights: Path, tmp_path: Path) -> None:
    folder, twists = tmp_path / "fake", [(10.0, 0.0, 0.1)] * 3
    list(generate_session(weights, session, folder, threshold=1))
    recorded = list(read_points(folder, STAMPS))
    assert all(len(points) for points in recorded)
    moved = list(read_points(folder, STAMPS, twists))
    np.testing.assert_array_equal(moved[1], compensate_points(recorded[1], ScanMotion(twists[1])))
    assert np.abs(moved[1] - recorded[1]).max() > 0.1
    about = json.loads((folder / "fake.json").read_text(encoding="utf-8"))
    about["settings"]["pairs"]["motion"] = "corrected"  # the images are of mid-scan already
    (folder / "fake.json").write_text(json.dumps(about), encoding="utf-8")
    np.testing.assert_array_equal(list(read_points(folder, STAMPS, twists))[1], recorded[1])


@pytest.mark.parametrize(
    "content", ["{", '{"stamps_us": [1], "points": {}}', '{"stamps_us": [1], "settings": 3}']
)
def test_pairs_without_settings_are_named(content: str, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "pairs.json").write_text(content, encoding="utf-8")
    (tmp_path / "fake.json").write_text(content.replace(": 3", ': 3, "points": {}'), encoding="utf-8")
    with pytest.raises(ValueError, match="pairs.json: not a list of images"):
        list(generate_session(weights, tmp_path, tmp_path / "fake"))
    with pytest.raises(ValueError, match="fake.json: not a list of images"):
        list(read_points(tmp_path, [1]))


def test_script_generates_a_session_and_names_what_is_missing(
    session: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    given = [str(session), str(weights), str(tmp_path / "fake"), "--threshold", "90"]
    assert generate_images.main(given) == 0
    about = generated_folder(tmp_path / "fake").read()
    assert (about["stamps_us"], about["points"]) == (STAMPS, {"threshold": 90, "thin": False})
    (session / "radar" / f"{STAMPS[0]}.png").unlink()
    assert generate_images.main([*given[:2], str(tmp_path / "other")]) == 1
    assert f"{STAMPS[0]}.png: the image is missing" in capsys.readouterr().err
