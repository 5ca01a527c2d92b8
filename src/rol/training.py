"""The training room: the loop around `rol.pix2pix.train_step`, its history, and checkpoints to go on from.

The checkpoint is the only state: the order of the pairs and the learning rate follow from the seed and the number of
the step. A run that was stopped therefore ends with the same losses as one that was not.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from torch import Tensor

    from rol_beyond.unet import UnetGenerator

    from .pix2pix import ResnetGenerator, TrainConfig

HISTORY_COLUMNS = ["step", "epoch", "learning_rate", "loss_d", "loss_gan", "loss_l1", "held_out_l1"]


class TrainingError(ValueError):
    """A training run that cannot start, go on or continue; the message says why."""


class TrainingState:
    """Everything that changes during training: two networks, two optimisers, the step, the history.

    Attributes
    ----------
    step : int
        Steps taken so far.
    history : list of dict
        Finished rows of the history.
    sums : dict
        Sums of the losses of the row that is under way, by name.

    Parameters
    ----------
    config : TrainConfig
        Widths and Adam's settings.
    seed : int
        Seed of the first weights.
    device : str
        Where the networks lie.
    """

    def __init__(self, config: TrainConfig, seed: int, device: str = "cpu") -> None:
        import torch

        from .pix2pix import build_discriminator, build_generator

        rng = torch.Generator().manual_seed(seed)
        self.networks = {"generator": build_generator(config.filters, config.blocks, config.network, rng=rng)}
        self.networks["generator"].to(device)
        if config.gan_weight > 0.0:
            discriminator = build_discriminator(config.discriminator_filters, rng=rng)
            self.networks["discriminator"] = discriminator.to(device)
        betas = (config.beta1, config.beta2)
        self.optimizers = {
            name: torch.optim.Adam(network.parameters(), config.learning_rate, betas)
            for name, network in self.networks.items()
        }
        self.step = 0
        self.history: list[dict[str, float]] = []
        self.sums: dict[str, float] = {}

    def end_row(self, steps_per_epoch: int, rate: float) -> None:
        """Append a row of the mean losses since the last one to the history."""
        n = self.step - (self.history[-1]["step"] if self.history else 0)
        row = {"step": self.step, "epoch": self.step / steps_per_epoch, "learning_rate": rate}
        self.history.append(row | {name: total / n for name, total in self.sums.items()})
        self.sums = {}

    @property
    def parts(self) -> list[Any]:
        """Generator, discriminator and their optimisers, as `rol.pix2pix.train_step` takes them."""
        names = ("generator", "discriminator")
        return [both.get(name) for both in (self.networks, self.optimizers) for name in names]

    def save(self, path: Path, about: dict[str, Any]) -> None:
        """Write weights and Adam's state as tensors and the scalars as JSON into one file, atomically."""
        from .pix2pix import save_tensors

        tensors = {}
        for name, network in self.networks.items():
            tensors |= {f"{name}.{key}": value for key, value in network.state_dict().items()}
            for index, state in self.optimizers[name].state_dict()["state"].items():
                tensors |= {f"adam.{name}.{index}.{key}": value for key, value in state.items()}
        scalars = {"step": self.step, "history": self.history, "sums": self.sums}
        save_tensors(path, tensors, {**about, **scalars})

    def load(self, path: Path, about: dict[str, Any]) -> None:
        """Go back to a checkpoint of the same run; refuse the checkpoint of another."""
        from .pix2pix import load_tensors

        tensors, found = load_tensors(path)
        for name, (then, now) in _differences(found, about).items():
            raise TrainingError(
                f"{path}: is of another run: {name} was {then}, now {now}; delete it, or train with resume=False"
            )
        for name, network in self.networks.items():
            network.load_state_dict({key: tensors[f"{name}.{key}"] for key in network.state_dict()})
            states = {}
            for index, weight in enumerate(network.parameters()):
                prefix = f"adam.{name}.{index}."
                moments = {key: tensors[prefix + key] for key in ("exp_avg", "exp_avg_sq")}
                # Laid out in memory like the weight: the same arithmetic, so the same bits.
                moments = {key: weight.detach().clone().copy_(value) for key, value in moments.items()}
                states[index] = {"step": tensors[prefix + "step"], **moments}
            optimizer = self.optimizers[name]
            optimizer.load_state_dict({**optimizer.state_dict(), "state": states})
        self.step, self.history, self.sums = found["step"], found["history"], found.get("sums", {})


def learning_rate(step: int, n_steps: int, first: float) -> float:
    """Give the learning rate of a step: constant in the first half, then down to zero in a straight line.

    Parameters
    ----------
    step : int
        Number of the step, from 0.
    n_steps : int
        Steps of the whole run.
    first : float
        Rate of the first half.

    Returns
    -------
    rate : float
        Rate of this step, never 0.
    """
    return first * min(1.0, 2.0 * (1.0 - step / n_steps))


def pick_pairs(step: int, n_pairs: int, batch: int, seed: int) -> np.ndarray:
    """Give the pairs of a step; each epoch is a fresh shuffle that follows from seed and epoch alone.

    Parameters
    ----------
    step : int
        Number of the step, from 0.
    n_pairs, batch : int
        Pairs there are, and pairs per step; the last step of an epoch may have fewer.
    seed : int
        Seed of the run.

    Returns
    -------
    index : array, shape (<= batch,)
        Which pairs.
    """
    epoch, place = divmod(step, -(-n_pairs // batch))
    order = np.random.default_rng([seed, epoch]).permutation(n_pairs)
    return order[place * batch : (place + 1) * batch]


def train(
    dataset: Any,
    config: TrainConfig,
    out_dir: str | Path,
    *,
    seed: int,
    held_out: Any = (),
    resume: bool = True,
    device: str = "cpu",
    metadata: dict[str, Any] | None = None,
    on_report: Callable[[dict[str, float], ResnetGenerator | UnetGenerator], None] | None = None,
    loaders: int = 1,
    checkpoint_minutes: float = 10.0,
) -> tuple[ResnetGenerator | UnetGenerator, pd.DataFrame]:
    """Train both networks; stop at any time and call again to go on from the last checkpoint.

    On a CPU the same seed gives the same losses to the last bit, stopped or not, for one kind of processor
    and one number of threads.

    Parameters
    ----------
    dataset, held_out : sequence of (radar, lidar), each array float32 (1, h, w) in [-1, 1]
        Pairs to learn from, and pairs that are only looked at. With `config.rotate`, `config.gain_spread_db`,
        `config.streaks` or `config.ghosts` the former need a method `draw`, see `rol_beyond.scan_pairs.ScanPairs`. Where it has a method
        `name(index)`, errors name the files of a batch by it.
    config : TrainConfig
        The settings.
    out_dir : path
        Gets ``generator.safetensors``, ``history.csv`` and ``checkpoint/last.safetensors``, each atomically.
    seed : int
        Seed of the first weights and of the order of the pairs.
    resume : bool
        False: a checkpoint that is there is not read, and is written over.
    device : str
        Where to compute, "cpu" or "cuda".
    metadata : dict, optional
        More for the header of the weights file, JSON values only.
    on_report : callable, optional
        Called with each new row of the history and the generator, to print or to keep samples.
    loaders : int
        Threads that load pairs ahead.
    checkpoint_minutes : float
        Longest time without a checkpoint [min], beside one every ``config.checkpoint_every`` steps.

    Returns
    -------
    generator : ResnetGenerator or UnetGenerator
        The trained network.
    history : DataFrame
        One row per ``report_every`` steps: means of the losses over them, and Eq. 4 on the held-out pairs.

    Raises
    ------
    TrainingError
        If there are no pairs, the settings contradict each other, the checkpoint is another run's, or a loss
        or a gradient is not finite; then the message names the step, the batch's files and the checkpoint.

    Notes
    -----
    Yin et al. 2020, Sec. III-A and IV-A.
    """
    from .files import write_text
    from .pix2pix import evaluate_l1, save_weights

    _check_run(dataset, config)
    folder, checkpoint = Path(out_dir), Path(out_dir) / "checkpoint" / "last.safetensors"
    about = {"config": asdict(config), "seed": seed, "pairs": len(dataset), "data": _checksum(dataset)}
    n_steps = config.n_steps(len(dataset))
    state = TrainingState(config, seed, device)
    generator = state.networks["generator"]
    generator.image_size = _image_size(dataset, generator.size_step)
    if resume and checkpoint.is_file():
        state.load(checkpoint, about)
    saved_s = monotonic()
    while state.step < n_steps or state.sums:  # sums: stopped before the last row was ended
        generator.train()
        try:
            for _ in _train_row(state, dataset, config, seed, loaders):
                if monotonic() - saved_s >= 60.0 * checkpoint_minutes:
                    state.save(checkpoint, about)
                    saved_s = monotonic()
        except TrainingError as error:
            kept = f"{checkpoint} stays as it is" if checkpoint.is_file() else "there is no checkpoint yet"
            raise TrainingError(f"{error}; {kept}") from error
        state.end_row(
            -(-len(dataset) // config.batch), learning_rate(state.step - 1, n_steps, config.learning_rate)
        )
        state.history[-1]["held_out_l1"] = evaluate_l1(generator, held_out)
        if on_report is not None:
            on_report(state.history[-1], generator)
        if state.step % config.checkpoint_every == 0 or state.step == n_steps:
            state.save(checkpoint, about)
            saved_s = monotonic()
    history = pd.DataFrame(state.history, columns=HISTORY_COLUMNS)
    write_text(folder / "history.csv", history.to_csv(index=False))
    save_weights(
        folder / "generator.safetensors", generator, {**(metadata or {}), **about, "step": state.step}
    )
    return generator.eval(), history


def score_points(
    generator: ResnetGenerator | UnetGenerator,
    pairs: Any,
    thresholds: Sequence[int] = (128,),
    *,
    thin: bool = False,
    bf16: bool = False,
) -> pd.DataFrame:
    """Measure in metres how good a generator's points are, at several thresholds.

    Parameters
    ----------
    generator : ResnetGenerator or UnetGenerator
        The network.
    pairs : sequence of (radar, lidar), each array float32 (1, h, w) in [-1, 1]
        Pairs that it did not learn from.
    thresholds : sequence of int
        Smallest grey values that count as a point.
    thin : bool
        Keep only the crests of strokes, see `rol.bev.crest_pixels`.
    bf16 : bool
        Multiply in bfloat16.

    Returns
    -------
    scores : DataFrame
        One row per threshold: its value, and the means over the pairs of what
        `rol.similarity.similarity_summary` gives, spreads under the names ending in ``_sd``.

    Notes
    -----
    Yin et al. 2020, Sec. IV-B.
    """
    from .bev import image_to_points
    from .pix2pix import generate
    from .similarity import similarity_summary

    rows = []
    for index in range(len(pairs)):
        radar, lidar = (np.rint((image[0] + 1.0) * 127.5).astype(np.uint8) for image in pairs[index])
        fake, real = generate(generator, radar, bf16=bf16), image_to_points(lidar)
        rows += [
            {
                "threshold": level,
                **similarity_summary(image_to_points(fake, threshold=level, thin=thin), real),
            }
            for level in thresholds
        ]
    by_threshold = pd.DataFrame(rows).groupby("threshold")
    return by_threshold.mean().join(by_threshold.std().add_suffix("_sd")).reset_index()


def _train_row(
    state: TrainingState, dataset: Any, config: TrainConfig, seed: int, loaders: int
) -> Iterator[int]:
    """Take the steps that are left of the row of the history under way; yield the number taken so far after each."""
    from .pix2pix import Pix2PixError, train_step

    n_steps = config.n_steps(len(dataset))
    device = next(state.networks["generator"].parameters()).device
    steps = range(state.step, min((len(state.history) + 1) * config.report_every, n_steps))
    for step, (radar, lidar) in zip(steps, _load_ahead(dataset, config, seed, steps, loaders), strict=True):
        rate = learning_rate(step, n_steps, config.learning_rate)
        for optimizer in state.optimizers.values():
            optimizer.param_groups[0]["lr"] = rate
        try:
            losses = train_step(*state.parts, radar.to(device), lidar.to(device), config)
        except Pix2PixError as error:
            batch = pick_pairs(step, len(dataset), config.batch, seed)
            names = ", ".join(
                dataset.name(int(i)) if hasattr(dataset, "name") else f"pair {i}" for i in batch
            )
            raise TrainingError(f"step {step + 1} of {n_steps}, batch of {names}: {error}") from error
        state.sums = {name: state.sums.get(name, 0.0) + loss for name, loss in losses.items()}
        state.step = step + 1
        yield state.step


def _load_ahead(
    dataset: Any, config: TrainConfig, seed: int, steps: range, loaders: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Give the batches of some steps, each loaded while the one before is learnt from."""
    import torch

    is_drawn = _is_drawn(config)

    def load(step: int) -> tuple[Tensor, Tensor]:
        batch = pick_pairs(step, len(dataset), config.batch, seed)
        rng = np.random.default_rng([seed, step, 1])
        turns = rng.uniform(-np.pi, np.pi, len(batch)) * config.rotate
        gains = rng.normal(0.0, 1.0, len(batch)) * config.gain_spread_db
        false = rng.poisson((config.streaks, config.ghosts), (len(batch), 2))
        drawn = zip(batch, turns, gains, false, rng.spawn(len(batch)), strict=True)
        pairs = [
            dataset.draw(int(i), float(turn), float(gain), *map(int, n), own) if is_drawn else dataset[int(i)]
            for i, turn, gain, n, own in drawn
        ]
        radar, lidar = (torch.from_numpy(np.stack(side)) for side in zip(*pairs, strict=True))
        return radar, lidar

    with ThreadPoolExecutor(loaders) as pool:
        waiting = deque(pool.submit(load, step) for step in steps[: loaders + 1])
        for step in steps:
            radar, lidar = waiting.popleft().result()
            if step + loaders + 1 < steps.stop:
                waiting.append(pool.submit(load, step + loaders + 1))
            yield radar, lidar


def _is_drawn(config: TrainConfig) -> bool:
    """Say whether pairs are changed at random before they are learnt from."""
    return config.rotate or max(config.gain_spread_db, config.streaks, config.ghosts) > 0.0


def _check_run(dataset: Any, config: TrainConfig) -> None:
    """Refuse what cannot be trained on."""
    if len(dataset) == 0:
        raise TrainingError("no pairs to train on")
    if _is_drawn(config) and not hasattr(dataset, "draw"):
        raise TrainingError(
            "rotate, gain_spread_db, streaks and ghosts need pairs that are drawn, see rol_beyond.scan_pairs"
        )
    if config.checkpoint_every % config.report_every:
        every = (config.checkpoint_every, config.report_every)
        raise TrainingError(f"checkpoint_every ({every[0]}) is no multiple of report_every ({every[1]})")


def _image_size(dataset: Any, step: int) -> tuple[int, int]:
    """Give the size of the images, which must be multiples of a step."""
    from .pix2pix import check_size

    height, width = dataset[0][0].shape[-2:]
    check_size((height, width), None, "first pair", step)
    return int(height), int(width)


def _checksum(dataset: Any) -> int:
    """Tell one data set from another by its first and its last pair."""
    ends = (0, len(dataset) - 1)
    return zlib.crc32(b"".join(np.ascontiguousarray(image).tobytes() for i in ends for image in dataset[i]))


def _differences(found: dict[str, Any], wanted: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """List what differs, settings by their own names: name to (found, wanted)."""
    sides = [{**about, **(about.get("config") or {})} for about in (found, wanted)]
    names = [name for name in sides[1] if name != "config"]
    return {
        name: (sides[0].get(name), sides[1][name]) for name in names if sides[0].get(name) != sides[1][name]
    }
