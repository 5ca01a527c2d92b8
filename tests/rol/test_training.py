"""The loop learns, repeats itself to the last bit, goes on where it stopped, and refuses what it must."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

torch = pytest.importorskip("torch")

from rol import training
from rol.pix2pix import Generator, TrainConfig, build_generator, load_tensors, load_weights, save_tensors
from rol.training import RunOptions, TrainHooks, TrainingError, batch_indices, learning_rate, train

pytestmark = pytest.mark.torch
TINY = TrainConfig(ngf=2, n_blocks=1, ndf=2, steps=12, report_every=1, checkpoint_every=4)


def make_pairs(n: int = 5, size: int = 32, seed: int = 7) -> list[tuple[np.ndarray, np.ndarray]]:
    """Walls as the lidar sees them, and thick, dim and noisy as the radar does."""
    rng, pairs = np.random.default_rng(seed), []
    for _ in range(n):
        lidar, radar = np.full((2, 1, size, size), -1, dtype=np.float32)
        row, col = rng.integers(4, size - 4, 2)
        lidar[0, row], lidar[0, :, col] = 1.0, 1.0
        radar[0, row - 1 : row + 2], radar[0, :, col - 1 : col + 2] = 0.2, 0.2
        pairs.append((np.clip(radar + rng.normal(0, 0.1, radar.shape), -1, 1).astype(np.float32), lidar))
    return pairs


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Generator, pd.DataFrame]:
    """Folder, network and history of a training that ran to its end."""
    folder, options = tmp_path_factory.mktemp("finished"), RunOptions(metadata={"session": "s"})
    return folder, *train(make_pairs(), TINY, folder, seed=1, options=options)


@pytest.fixture
def copy(finished: tuple, tmp_path: Path) -> Path:
    """A copy of that folder."""
    return Path(shutil.copytree(finished[0], tmp_path / "copy"))


def test_rate_is_constant_for_half_the_run_and_then_falls_in_a_straight_line() -> None:
    rates = [learning_rate(step, 8, 2e-4) for step in range(8)]
    np.testing.assert_allclose(rates, np.array([1, 1, 1, 1, 1, 0.75, 0.5, 0.25]) * 2e-4)


def test_every_epoch_takes_every_pair_once_in_an_order_of_its_own() -> None:
    orders = [
        np.concatenate([batch_indices(3 * epoch + k, 5, 2, seed=1) for k in range(3)]) for epoch in (0, 1)
    ]
    assert [sorted(order) for order in orders] == [[0, 1, 2, 3, 4]] * 2
    assert orders[0].tolist() != orders[1].tolist()
    assert batch_indices(2, 5, 2, seed=1).shape == (1,)
    assert [batch_indices(k, 50, 1, seed=1) for k in range(9)] != [
        batch_indices(k, 50, 1, seed=2) for k in range(9)
    ]


def test_training_lowers_l1_on_pairs_it_learns_from_and_on_others(tmp_path: Path) -> None:
    config = TrainConfig(ngf=4, n_blocks=1, ndf=4, steps=60, report_every=20)
    config = replace(config, checkpoint_every=60, learning_rate=2e-3)
    pairs = make_pairs(10, 64)
    _, history = train(pairs[:8], config, tmp_path, seed=1, held_out=pairs[8:])
    assert history["step"].tolist() == [20, 40, 60]
    assert history["loss_l1"].iloc[-1] < 0.9 * history["loss_l1"].iloc[0]
    assert history["held_out_l1"].iloc[-1] < 0.9 * history["held_out_l1"].iloc[0]


def test_same_seed_gives_the_same_losses_and_another_seed_others(tmp_path: Path) -> None:
    runs = {}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        runs[name] = train(make_pairs(), TINY, tmp_path / name, seed=seed, held_out=make_pairs(2, seed=8))[1]
    pd.testing.assert_frame_equal(runs["a"], runs["b"], check_exact=True)
    assert (runs["a"]["loss_l1"] != runs["c"]["loss_l1"]).all()
    files = [(tmp_path / name / "history.csv").read_bytes() for name in ("a", "b")]
    assert files[0] == files[1]


@pytest.mark.parametrize("stop_at", [4, 11])
def test_stopped_run_goes_on_to_the_same_bits(tmp_path: Path, stop_at: int) -> None:
    def stop(row: dict, generator: torch.nn.Module) -> None:
        if row["step"] == stop_at:
            raise KeyboardInterrupt

    settings = {"seed": 3, "held_out": make_pairs(2, seed=8)}
    whole, history = train(make_pairs(), TINY, tmp_path / "whole", **settings)
    with pytest.raises(KeyboardInterrupt):
        train(make_pairs(), TINY, tmp_path / "stopped", **settings, hooks=TrainHooks(on_report=stop))
    assert not (tmp_path / "stopped" / "generator.safetensors").exists()
    steps = []
    resumed, again = train(
        make_pairs(),
        TINY,
        tmp_path / "stopped",
        **settings,
        hooks=TrainHooks(on_report=lambda row, _: steps.append(row["step"])),
    )
    assert steps == list(range((stop_at - 1) // 4 * 4 + 1, 13))  # stopped before the checkpoint of its step
    pd.testing.assert_frame_equal(history, again, check_exact=True)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name])
    for file in ("generator.safetensors", "checkpoint/last.safetensors", "history.csv"):
        assert (tmp_path / "whole" / file).read_bytes() == (tmp_path / "stopped" / file).read_bytes()


@pytest.mark.parametrize(("last_look", "saved_step"), [(4, 2), (10, 6)])
def test_checkpoints_by_time_within_a_row_lead_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_look: int, saved_step: int
) -> None:
    """Every look at the clock takes a minute; a row of the history has five steps, a checkpoint by steps comes after ten."""
    config, pairs = replace(TINY, report_every=5, checkpoint_every=10), make_pairs()
    settings = {"seed": 3, "held_out": make_pairs(2, seed=8), "options": RunOptions(checkpoint_minutes=2.0)}
    whole = train(pairs, config, tmp_path / "whole", **settings)[1]

    def clock(looks: Iterator[int]) -> float:
        minute = next(looks)
        if minute == last_look:
            raise KeyboardInterrupt
        return 60.0 * minute

    monkeypatch.setattr(training, "monotonic", partial(clock, count()))
    with pytest.raises(KeyboardInterrupt):
        train(pairs, config, tmp_path / "stopped", **settings)
    about = load_tensors(tmp_path / "stopped" / "checkpoint" / "last.safetensors")[1]
    assert (about["step"], len(about["history"])) == (saved_step, saved_step // 5)
    monkeypatch.undo()
    again = train(pairs, config, tmp_path / "stopped", **settings)[1]
    assert again["step"].tolist() == [5, 10, 12]
    pd.testing.assert_frame_equal(whole, again, check_exact=True)
    for file in ("generator.safetensors", "checkpoint/last.safetensors", "history.csv"):
        assert (tmp_path / "whole" / file).read_bytes() == (tmp_path / "stopped" / file).read_bytes()


def test_a_stop_between_the_last_step_and_its_row_keeps_the_row(tmp_path: Path) -> None:
    config, settings = (
        replace(TINY, report_every=5, checkpoint_every=10),
        {"seed": 3, "options": RunOptions(checkpoint_minutes=0.0)},
    )
    whole = train(make_pairs(), config, tmp_path / "whole", **settings)[1]

    def stop(row: dict[str, float], _: object) -> None:
        if row["step"] == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(make_pairs(), config, tmp_path / "stopped", **settings, hooks=TrainHooks(on_report=stop))
    again = train(make_pairs(), config, tmp_path / "stopped", **settings)[1]
    assert again["step"].tolist() == [5, 10, 12]
    pd.testing.assert_frame_equal(whole, again, check_exact=True)


def test_finished_run_is_only_read_again(finished: tuple, copy: Path) -> None:
    rows = []
    hooks = TrainHooks(on_report=lambda row, _: rows.append(row))
    again = train(make_pairs(), TINY, copy, seed=1, hooks=hooks)[1]
    assert rows == []
    pd.testing.assert_frame_equal(finished[2], again, check_exact=True)


def test_files_hold_what_was_done(finished: tuple) -> None:
    folder, generator, history = finished
    about = load_tensors(folder / "generator.safetensors")[1]
    assert (about["session"], about["seed"], about["step"], about["pairs"]) == ("s", 1, 12, 5)
    assert about["config"]["lambda_l1"] == 100.0 and about["image_size"] == [32, 32]
    assert load_weights(folder / "generator.safetensors").image_size == generator.image_size == (32, 32)
    stored = pd.read_csv(folder / "history.csv")
    pd.testing.assert_frame_equal(stored, history, rtol=1e-14)
    assert stored["held_out_l1"].isna().all()
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    assert names == ["checkpoint/last.safetensors", "generator.safetensors", "history.csv"]


def test_checkpoint_of_another_run_is_refused_unless_told_to_start_anew(copy: Path) -> None:
    arguments = {"pairs": make_pairs(), "config": TINY, "out_dir": copy, "seed": 1}
    for change, fault in (
        ({"hooks": TrainHooks(settings={"pos_weight": 2.0})}, "pos_weight was None, now 2.0"),
        ({"config": replace(TINY, lambda_l1=5.0)}, "lambda_l1 was 100.0, now 5.0"),
        ({"seed": 2}, "seed was 1, now 2"),
        ({"pairs": make_pairs(4)}, "pairs was 5, now 4"),
        ({"pairs": make_pairs(5, seed=9)}, "data was"),
    ):
        with pytest.raises(TrainingError, match=f"last.safetensors: is of another run: {fault}"):
            train(**(arguments | change))
    assert len(train(**(arguments | {"seed": 2}), options=RunOptions(resume=False))[1]) == 12


def test_damaged_checkpoint_is_refused(copy: Path) -> None:
    path = copy / "checkpoint" / "last.safetensors"
    tensors, about = load_tensors(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="last.safetensors: not a whole safetensors file"):
        train(make_pairs(), TINY, copy, seed=1)
    for part in ("generator.", "adam.discriminator.", "history"):
        kept = ({k: v for k, v in content.items() if not k.startswith(part)} for content in (tensors, about))
        save_tensors(path, *kept)
        with pytest.raises(TrainingError, match="last.safetensors: not a whole checkpoint"):
            train(make_pairs(), TINY, copy, seed=1)


def test_loss_that_is_not_finite_names_the_step_and_leaves_the_checkpoint(tmp_path: Path) -> None:
    pairs = make_pairs(12)
    spoilt = int(batch_indices(6, 12, 1, seed=1)[0])
    pairs[spoilt] = (np.full_like(pairs[spoilt][0], np.nan), pairs[spoilt][1])
    told = (
        f"step 7 of 12, batch of pair {spoilt}: discriminator loss is nan; .*last.safetensors stays as it is"
    )
    with pytest.raises(TrainingError, match=told):
        train(pairs, TINY, tmp_path, seed=1)
    assert load_tensors(tmp_path / "checkpoint" / "last.safetensors")[1]["step"] == 4
    assert not (tmp_path / "generator.safetensors").exists()


class Named(list):
    """Pairs with names."""

    def name(self, index: int) -> str:
        return f"scan-{index}.png"


def generator_alone(config: TrainConfig, rng: torch.Generator) -> dict[str, torch.nn.Module]:
    return {"generator": build_generator(config.ngf, config.n_blocks, rng=rng)}


def test_files_of_a_batch_are_named_when_a_gradient_is_not_finite(tmp_path: Path) -> None:
    pairs = Named(make_pairs(3))
    pairs[1] = (np.full_like(pairs[1][0], np.inf), pairs[1][1])
    with pytest.raises(TrainingError, match=r"batch of scan-1.png: .* there is no checkpoint yet"):
        train(pairs, TINY, tmp_path, seed=1, hooks=TrainHooks(generator_alone))


@pytest.mark.parametrize(
    ("pairs", "config", "fault"),
    [
        ([], TINY, "no pairs"),
        (make_pairs(1), replace(TINY, checkpoint_every=5, report_every=2), "no multiple"),
        (make_pairs(1, size=30), TINY, "multiples of 4"),
    ],
)
def test_runs_that_cannot_be_are_refused(
    tmp_path: Path, pairs: list, config: TrainConfig, fault: str
) -> None:
    with pytest.raises(ValueError, match=fault):
        train(pairs, config, tmp_path, seed=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [("num_workers", 0), ("num_workers", 1.5), ("checkpoint_minutes", float("nan")), ("resume", "no")],
)
def test_options_out_of_range_are_refused(name: str, value: object) -> None:
    with pytest.raises(TrainingError, match=f"{name}: "):
        RunOptions(**{name: value})
