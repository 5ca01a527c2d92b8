"""The networks that come with the book: whole, small, with a card that fits, and as good as it says on real scans."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

pytest.importorskip("torch")
from safetensors import safe_open

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol.pix2pix import load_network
from rol_beyond.front_ends import detect_points, evaluate_on_map, generate_points
from rol_data import rall

pytestmark = pytest.mark.torch
WEIGHTS = sorted((Path(__file__).resolve().parents[2] / "data" / "weights").glob("*.safetensors"))
FORMER_WORDS = {"entropy": "bce"}  # in the header of a file that was written before the word changed


@pytest.mark.parametrize("path", WEIGHTS, ids=lambda path: path.stem)
def test_weights_are_small_and_have_a_card_that_fits(path: Path) -> None:
    assert path.stat().st_size < 25e6
    card, network = (json.loads(path.with_suffix(".json").read_text(encoding="utf-8")), load_network(path))
    assert (
        network.about["card"] == f"{card.get('former_name', card['name'])}.json" and card["name"] == path.stem
    )
    assert network.points == {"threshold": card["threshold"], "thin": card["thin"]}
    assert network.generator.tta_rotations == card["headings"]
    assert card["headings"] == card["recipe"]["network"].get("tta_rotations", 1)
    assert network.settings == card["recipe"]["pairs"]
    for key, value in card["recipe"]["network"].items():
        if key in network.about["config"]:
            stored = network.about["config"][key]
            assert FORMER_WORDS.get(stored, stored) == value, key
    assert {"versions", "licence", "history", "judged", "pairs"} <= set(card)
    with safe_open(path, "pt") as file:
        kinds = {file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118 (no mapping)
    assert kinds <= {"F16", "I64"}


def test_the_networks_that_chapters_use_are_there() -> None:
    assert {"unet", "paper", "paper-no-gan"} <= {path.stem for path in WEIGHTS}


def test_the_best_network_beats_raw_peaks_on_real_scans_as_its_card_says(real_root: Path) -> None:
    path = next(path for path in WEIGHTS if path.stem == "unet")
    network, tree = load_network(path), cKDTree(rall.load_map_points(real_root / rall.MAP_PATH))
    rows = []
    for scan in rall.load_scans(real_root)[::3]:
        fake = generate_points(network, scan.power, scan.azimuths, scan.twist)[0]
        raw = detect_points(scan.power, scan.azimuths, scan.twist)
        rows.append([evaluate_on_map(points, scan.pose, tree)["share_1m"] for points in (fake, raw)])
        assert len(fake) >= 300
    fake_share, raw_share = np.mean(rows, axis=0)
    judged = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["judged"]
    told = next(
        share
        for place, level, share in zip(
            judged["places"], judged["threshold"], judged["fake_to_real_within_1m"], strict=True
        )
        if place == "real" and level == network.points["threshold"]
    )
    assert fake_share > raw_share + 0.04 and fake_share == pytest.approx(told, abs=0.05)
