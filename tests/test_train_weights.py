"""The workflow behind the weights that come with the book, on a tiny recipe."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("open3d")
pytest.importorskip("torch")
import train_weights
from rol.pix2pix import generate, load_metadata, load_weights

pytestmark = [pytest.mark.open3d, pytest.mark.torch]
RECIPE = """
seed: 1
pairs: {motion: corrected, width: 64, pixel_size: 1.0, max_range: 32.0}
worlds:
  - seed: 3
    sessions:
      virtual-x: {start: "2019-01-10T11:46:21", scans: 7, seed: 2, stops: 0, stand_s: 0, vehicles: 4, people: 2}
sets:
  learn: [{session: virtual-x, every: 2}]
  rest: [{session: virtual-x, every: 3}]
networks:
  tiny: {network: unet, filters: 4, blocks: 1, gan_weight: 0, pixel_loss: entropy, lambda_l1: 1, rotate: true,
         gain_spread_db: 2.0, steps: 6, batch: 2, report_every: 2, checkpoint_every: 2}
  wrong: {filter: 4}
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    places = {"out_dir": str(folder / "out"), "sessions_root": str(folder / "sessions")}
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(RECIPE), **places}))
    return path


def test_one_command_makes_sessions_weights_and_card(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(train_weights, "WEIGHTS", tmp_path)
    assert train_weights.main([str(recipe), "tiny", "--threads", "1"]) == 0
    card = json.loads((tmp_path / "tiny.json").read_text())
    assert (
        card["recipe"]["network"]["filters"] == 4
        and card["recipe"]["seed"] == 1
        and "torch" in card["versions"]
    )
    assert card["history"]["step"] == [2, 4, 6] and card["history"]["loss_gan"] == [None] * 3
    assert card["judged"]["rest"]["threshold"] == list(train_weights.LEVELS)
    assert load_metadata(tmp_path / "tiny.safetensors")["card"] == "tiny.json"
    fake = generate(load_weights(tmp_path / "tiny.safetensors"), np.zeros((64, 64), dtype=np.uint8))
    assert fake.shape == (64, 64)
    capsys.readouterr()
    assert (
        train_weights.main([str(recipe), "tiny", "--threads", "1"]) == 0
    )  # all is there: nothing is trained again
    again = json.loads((tmp_path / "tiny.json").read_text())
    assert again["history"] == card["history"] and again["judged"] == card["judged"]
    assert "step" not in capsys.readouterr().out.split("rest:")[1].split("{")[0]


def test_places_choose_scans_and_waiting_ones_are_left_out(recipe: Path) -> None:
    given = train_weights.load_recipe(recipe)
    train_weights.make_sessions(given, {"virtual-x"}, 1)
    root, part = Path(given["sessions_root"]), {"session": "virtual-x"}
    _, every = train_weights.choose_jobs(root, part, "corrected")
    truth = np.loadtxt(root / "virtual-x" / "truth.tum")
    place = truth[1, 1:3].tolist()
    _, near = train_weights.choose_jobs(root, {**part, "within": [[*place, 1.0]]}, "corrected")
    _, far = train_weights.choose_jobs(root, {**part, "without": [[*place, 1.0]]}, "corrected")
    stamps = [[job["radar_stamp"] for job in jobs] for jobs in (every, near, far)]
    assert sorted(stamps[1] + stamps[2]) == stamps[0] and 0 < len(near) < len(every)


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [(["wrong"], "wrong: no such setting: filter"), (["none"], "no network 'none'; there are: tiny, wrong")],
)
def test_faulty_recipes_are_told(recipe: Path, arguments: list[str], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        train_weights.main([str(recipe), *arguments])


def test_recipes_that_lack_a_part_are_told(tmp_path: Path) -> None:
    (tmp_path / "r.yaml").write_text("seed: 1\n")
    with pytest.raises(ValueError, match="r.yaml: the key 'networks' is missing"):
        train_weights.load_recipe(tmp_path / "r.yaml")
    with pytest.raises(ValueError, match="no world has a session 'virtual-y'; there are: virtual-x"):
        train_weights.make_sessions(
            {**yaml.safe_load(RECIPE), "sessions_root": str(tmp_path)}, {"virtual-y"}, 1
        )
