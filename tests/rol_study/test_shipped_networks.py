"""The workflow behind the weights that come with the book, on a tiny recipe."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

pytest.importorskip("open3d")
pytest.importorskip("torch")
import train_weights
from rol.pix2pix import generate, load_tensors, load_weights
from rol_study import shipped_networks
from rol_study.shipped_networks import Places, choose_scans, choose_threshold, load_recipe, make_sessions

pytestmark = [pytest.mark.open3d, pytest.mark.torch]
RECIPE = """
seed: 1
pairs: {motion: corrected, width: 64, pixel_size: 1.0, max_range: 32.0}
worlds:
  - seed: 3
    sessions:
      sim-x: {start: "2019-01-10T11:46:21", scans: 7, seed: 2, stops: 0, stand_s: 0, vehicles: 4, people: 2}
sets:
  learn: [{session: sim-x, every: 2}]
  rest: [{session: sim-x, every: 3}]
networks:
  tiny: {architecture: unet, ngf: 4, n_blocks: 1, adversarial: false, pixel_loss: bce, lambda_l1: 1, rotate: true,
         gain_spread_db: 2.0, streaks: 1.0, reach: 0.7, thin: true, steps: 6, batch_size: 2, report_every: 2, checkpoint_every: 2}
  wrong: {filters: 4}
ablations:
  base: {architecture: unet, ngf: 4, n_blocks: 1, adversarial: false, pixel_loss: bce, lambda_l1: 1, steps: 2, report_every: 2,
         checkpoint_every: 2}
  variants: {base: {}, turned: {rotate: true, seed: 2}}
"""


@pytest.fixture(scope="module")
def monkeypatch_module() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory, monkeypatch_module: pytest.MonkeyPatch) -> Path:
    monkeypatch_module.setattr(train_weights, "find_real_root", lambda: None)
    folder = tmp_path_factory.mktemp("weights")
    places = {"out_dir": str(folder / "out"), "sessions_root": str(folder / "sessions")}
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(RECIPE), **places}), encoding="utf-8")
    return path


def test_one_command_makes_sessions_weights_and_card(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(train_weights, "WEIGHTS", tmp_path)
    assert train_weights.main([str(recipe), "tiny", "--threads", "1"]) == 0
    card = json.loads((tmp_path / "tiny.json").read_text(encoding="utf-8"))
    assert (
        card["recipe"]["network"]["ngf"] == 4 and card["recipe"]["seed"] == 1 and "torch" in card["versions"]
    )
    assert card["history"]["step"] == [2, 4, 6] and card["history"]["loss_gan"] == [None] * 3
    judged = pd.DataFrame(card["judged"])
    assert judged[judged.places == "rest"].threshold.tolist() == list(shipped_networks.THRESHOLDS)
    header = load_tensors(tmp_path / "tiny.safetensors")[1]
    assert header["card"] == "tiny.json" and header["points"] == {
        "threshold": card["threshold"],
        "thin": True,
    }
    assert header["pairs_settings"]["motion"] == "corrected"
    fake = generate(load_weights(tmp_path / "tiny.safetensors"), np.zeros((64, 64), dtype=np.uint8))
    assert fake.shape == (64, 64)
    capsys.readouterr()
    assert (
        train_weights.main([str(recipe), "tiny", "--threads", "1"]) == 0
    )  # all is there: nothing is trained again
    again = json.loads((tmp_path / "tiny.json").read_text(encoding="utf-8"))
    assert again["history"] == card["history"] and again["judged"] == card["judged"]
    assert "tiny: step" not in capsys.readouterr().out
    assert train_weights.main([str(recipe), "tiny", "--threads", "1", "--judge"]) == 0
    assert "largest difference of a fraction: 0.0" in capsys.readouterr().out
    judged.fake_to_real_within_1m += 0.1
    (tmp_path / "tiny.json").write_text(
        json.dumps({**card, "judged": shipped_networks.as_lists(judged)}), encoding="utf-8"
    )
    assert train_weights.main([str(recipe), "tiny", "--threads", "1", "--judge"]) == 1


def test_ablations_are_run_once_and_gathered(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_weights, "ABLATIONS", tmp_path / "a" / "translator.csv")
    assert train_weights.main([str(recipe), "ablations", "--threads", "1"]) == 0
    table = pd.read_csv(tmp_path / "a" / "translator.csv")
    assert (
        table.network.unique().tolist() == ["ablation-base", "ablation-turned"] and (table.steps == 2).all()
    )
    assert {"rest"} <= set(table.places) and "fake_to_real_within_1m_sd" in table
    monkeypatch.setattr(shipped_networks, "run_network", lambda *_: pytest.fail("trained again"))
    assert train_weights.main([str(recipe), "ablations", "--threads", "1"]) == 0


def test_threshold_is_the_highest_with_the_recall() -> None:
    judged = pd.DataFrame({
        "places": ["a"] * 3 + ["b"] * 3 + ["real"], "threshold": [64, 128, 192] * 2 + [224],
        "real_to_fake_within_1m": [0.9, 0.8, 0.5, 0.8, 0.7, 0.6, np.nan],
    })  # fmt: skip
    assert choose_threshold(judged, 0.7) == 128
    assert choose_threshold(judged, 0.5) == 192
    assert choose_threshold(judged, 0.99) == 128 == choose_threshold(judged, None)


def test_places_choose_scans_and_stationary_ones_are_left_out(recipe: Path) -> None:
    given = load_recipe(recipe)
    make_sessions(given, {"sim-x"}, Places(recipe, recipe.parent, recipe.parent, threads=1))
    root, part = Path(given["sessions_root"]), {"session": "sim-x"}
    _, every = choose_scans(root, part, "corrected")
    truth = np.loadtxt(root / "sim-x" / "truth.tum")
    place = truth[1, 1:3].tolist()
    _, near = choose_scans(root, {**part, "within": [[*place, 1.0]]}, "corrected")
    _, far = choose_scans(root, {**part, "without": [[*place, 1.0]]}, "corrected")
    stamps = [[one.radar_stamp_us for one in aligned] for aligned in (every, near, far)]
    assert sorted(stamps[1] + stamps[2]) == stamps[0] and 0 < len(near) < len(every)


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["wrong"], "wrong: no such setting: filters"),
        (["none"], "no network 'none'; there are: tiny, wrong, ablation-base"),
    ],
)
def test_faulty_recipes_are_refused(recipe: Path, arguments: list[str], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        train_weights.main([str(recipe), *arguments])


def test_recipes_that_lack_a_part_are_refused(tmp_path: Path) -> None:
    (tmp_path / "r.yaml").write_text("seed: 1\n", encoding="utf-8")
    with pytest.raises(ValueError, match="r.yaml: the key 'ablations' is missing"):
        load_recipe(tmp_path / "r.yaml")
    with pytest.raises(ValueError, match="no world has a session 'sim-y'; there are: sim-x"):
        make_sessions(
            {**yaml.safe_load(RECIPE), "sessions_root": str(tmp_path)},
            {"sim-y"},
            Places(tmp_path, tmp_path, tmp_path),
        )
