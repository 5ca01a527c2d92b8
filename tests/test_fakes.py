"""Folders of fakes: made, gone on with, made anew for other settings, and refused when not whole."""

from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from rol.fakes import finish_fakes, list_fakes, prepare_fakes, read_image, write_fakes
from rol.pix2pix import build_generator, generate

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


def test_fakes_are_what_the_generator_gives(pairs: Path, tmp_path: Path, generator: torch.nn.Module) -> None:
    folder = tmp_path / "fake"
    assert prepare_fakes(folder, {"threshold": 1}) == set()
    assert list(write_fakes(generator, pairs, folder, STAMPS)) == STAMPS
    finish_fakes(folder, {"threshold": 1}, STAMPS, {"threshold": 140})
    assert list_fakes(folder) == (STAMPS, {"threshold": 140})
    expected = generate(generator, read_image(pairs / "radar" / f"{STAMPS[1]}.png"))
    np.testing.assert_array_equal(read_image(folder / f"{STAMPS[1]}.png"), expected)
    names = {path.name for path in folder.iterdir()}
    assert names == {"settings.json", "fake.json", *(f"{stamp}.png" for stamp in STAMPS)}


def test_stopped_run_goes_on_and_other_settings_start_anew(
    pairs: Path, tmp_path: Path, generator: torch.nn.Module
) -> None:
    folder = tmp_path / "fake"
    prepare_fakes(folder, {"weights": "a"})
    next(write_fakes(generator, pairs, folder, STAMPS))
    assert prepare_fakes(folder, {"weights": "a"}) == {STAMPS[0]}
    assert prepare_fakes(folder, {"weights": "b"}) == set()


def test_folder_that_is_not_whole_is_not_taken_for_whole(
    pairs: Path, tmp_path: Path, generator: torch.nn.Module
) -> None:
    folder = tmp_path / "fake"
    prepare_fakes(folder, {})
    list(write_fakes(generator, pairs, folder, STAMPS[:2]))
    with pytest.raises(ValueError, match="fake.json: missing"):
        list_fakes(folder)
    with pytest.raises(ValueError, match=f"{STAMPS[2]}.png: missing"):
        finish_fakes(folder, {}, STAMPS, {})
    (folder / "fake.json").write_text('{"stamps": []}', encoding="utf-8")
    with pytest.raises(ValueError, match="fake.json: not a list of fakes"):
        list_fakes(folder)


def test_unreadable_images_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="none.png: the image is missing"):
        read_image(tmp_path / "none.png")
    for data in (b"", b"not a picture"):
        (tmp_path / "bad.png").write_bytes(data)
        with pytest.raises(ValueError, match="bad.png: not a readable grey image"):
            read_image(tmp_path / "bad.png")
