"""Training loop around `rol.pix2pix.train_step`, with history and checkpoints.

A checkpoint is the only state: the order of the pairs and the learning rate follow from the seed and the
number of the step. A run that was stopped and resumed therefore ends with the same losses as an uninterrupted
one.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

if __package__:
    from . import pix2pix
    from .files import write_text
    from .geometry import check_fields
else:  # this file was copied and is imported by its own name
    import pix2pix
    from files import write_text
    from geometry import check_fields

HISTORY_COLUMNS = ["step", "epoch", "learning_rate", "loss_d", "loss_gan", "loss_l1", "held_out_l1"]


class TrainingError(ValueError):
    """A training run that cannot start, continue or resume; the message gives the reason."""


def build_networks(config: pix2pix.TrainConfig, rng: torch.Generator) -> dict[str, nn.Module]:
    """Build the paper's "generator" and "discriminator" with random initial weights."""
    generator = pix2pix.build_generator(config.ngf, config.n_blocks, rng=rng)
    return {"generator": generator, "discriminator": pix2pix.build_discriminator(config.ndf, rng=rng)}


@dataclass(frozen=True)
class TrainHooks:
    """Parts of the training that can be replaced or observed; the defaults are the paper's.

    Attributes
    ----------
    build_networks : callable
        Makes the networks of `rol.pix2pix.train_step` from the config and a torch.Generator.
    pixel_loss : callable, optional
        Replaces Eq. 4, see `rol.pix2pix.train_step`.
    draw_batch : callable, optional
        Draws augmented pairs; takes the pairs, the indices of a batch and a random generator that depends on
        the seed and the step alone; returns the (radar, lidar) pairs, each array float32 (1, h, w) in
        [-1, 1].
    on_report : callable, optional
        Called with each new row of the history and the generator.
    settings : mapping
        Describes the above, JSON values only; kept with the config, so that a checkpoint of other hooks is
        refused.
    """

    build_networks: Callable[[pix2pix.TrainConfig, torch.Generator], dict[str, nn.Module]] = build_networks
    pixel_loss: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    draw_batch: Callable[[Any, np.ndarray, np.random.Generator], Sequence[Any]] | None = None
    on_report: Callable[[dict[str, float], pix2pix.Generator], None] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RunOptions:
    """How a training runs; none of these changes its result on a CPU.

    Attributes
    ----------
    resume : bool
        False: ignore an existing checkpoint and overwrite it.
    device : str
        "cpu" or "cuda".
    num_workers : int
        Threads that load pairs in advance.
    checkpoint_minutes : float
        Longest time without a checkpoint [min], in addition to `rol.pix2pix.TrainConfig.checkpoint_every`.
    metadata : mapping
        More for the header of the weights file, JSON values only.

    Raises
    ------
    TrainingError
        If a value is out of its range; the message names it.
    """

    resume: bool = True
    device: str = "cpu"
    num_workers: int = 1
    checkpoint_minutes: float = 10.0
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self, {"[1, inf)": "num_workers", "[0, inf]": "checkpoint_minutes"}, TrainingError)


class TrainingState:
    """Everything that changes during training: networks, optimizers, step and history.

    Attributes
    ----------
    networks, optimizers : dict
        As `rol.pix2pix.train_step` takes them.
    step : int
        Steps taken so far.
    history : list of dict
        Finished rows of the history.
    sums : dict of float
        Sums of the losses of the unfinished row.

    Parameters
    ----------
    config : TrainConfig
        Widths and Adam's settings.
    seed : int
        Seed of the initial weights.
    device : str
        Device of the networks.
    hooks : TrainHooks
        Builds the networks.
    """

    def __init__(
        self, config: pix2pix.TrainConfig, seed: int, device: str = "cpu", hooks: TrainHooks = TrainHooks()
    ) -> None:
        networks = hooks.build_networks(config, torch.Generator().manual_seed(seed))
        self.networks = {name: network.to(device) for name, network in networks.items()}
        self.optimizers = {
            name: torch.optim.Adam(network.parameters(), config.learning_rate, (config.beta1, 0.999))
            for name, network in self.networks.items()
        }
        self.step, self.history, self.sums = 0, [], {}

    def save(self, path: Path, about: dict[str, Any]) -> None:
        """Write weights and Adam's state as tensors and the scalars as JSON into one file, atomically."""
        tensors = {}
        for name, network in self.networks.items():
            tensors |= {f"{name}.{key}": value for key, value in network.state_dict().items()}
            for index, state in self.optimizers[name].state_dict()["state"].items():
                tensors |= {f"adam.{name}.{index}.{key}": value for key, value in state.items()}
        scalars = {"step": self.step, "history": self.history, "sums": self.sums}
        pix2pix.save_tensors(path, tensors, {**about, **scalars})

    def load(self, path: Path, about: dict[str, Any]) -> None:
        """Restore a checkpoint of the same run; refuse the checkpoint of another, or a part of one."""
        tensors, found = pix2pix.load_tensors(path)
        for name, (then, now) in _differences(found, about).items():
            raise TrainingError(
                f"{path}: is of another run: {name} was {then}, now {now}; delete it, or train with resume=False"
            )
        try:
            self._restore(tensors, found)
        except (KeyError, RuntimeError) as error:
            raise TrainingError(f"{path}: not a whole checkpoint ({error!r:.80}); delete it") from error

    def _restore(self, tensors: dict[str, Tensor], found: dict[str, Any]) -> None:
        """Take over networks, optimizers, step and history."""
        for name, network in self.networks.items():
            network.load_state_dict({key: tensors[f"{name}.{key}"] for key in network.state_dict()})
            states = {}
            for index, weight in enumerate(network.parameters()):
                prefix = f"adam.{name}.{index}."
                moments = {key: tensors[prefix + key] for key in ("exp_avg", "exp_avg_sq")}
                # Same memory layout as the weight: same order of arithmetic, so the same bits.
                moments = {key: weight.detach().clone().copy_(value) for key, value in moments.items()}
                states[index] = {"step": tensors[prefix + "step"], **moments}
            optimizer = self.optimizers[name]
            optimizer.load_state_dict({**optimizer.state_dict(), "state": states})
        self.step, self.history, self.sums = found["step"], found["history"], found.get("sums", {})


def learning_rate(step: int, n_steps: int, first: float) -> float:
    """Compute the learning rate of a step: constant in the first half, then linear decay to zero.

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


def batch_indices(step: int, n_pairs: int, batch_size: int, seed: int) -> np.ndarray:
    """Select the pairs of a step; the shuffle of each epoch depends on seed and epoch alone.

    Parameters
    ----------
    step : int
        Number of the step, from 0.
    n_pairs, batch_size : int
        Number of pairs, and pairs per step; the last step of an epoch may have fewer.
    seed : int
        Seed of the run.

    Returns
    -------
    index : array, shape (<= batch_size,)
        Indices of the pairs.
    """
    epoch, place = divmod(step, -(-n_pairs // batch_size))
    order = np.random.default_rng([seed, epoch]).permutation(n_pairs)
    return order[place * batch_size : (place + 1) * batch_size]


def train(
    pairs: Any,
    config: pix2pix.TrainConfig,
    out_dir: str | Path,
    *,
    seed: int,
    held_out: Any = (),
    options: RunOptions = RunOptions(),
    hooks: TrainHooks = TrainHooks(),
) -> tuple[pix2pix.Generator, pd.DataFrame]:
    """Train both networks; a run that was stopped resumes from its last checkpoint.

    On a CPU the same seed gives the same losses to the last bit, stopped or not, for one kind of processor
    and one number of threads.

    Parameters
    ----------
    pairs, held_out : sequence of (radar, lidar), each array float32 (1, h, w) in [-1, 1]
        Pairs to train on, and pairs for evaluation only. Where `pairs` has a method ``name(index)``, errors
        name the files of a batch by it.
    config : TrainConfig
        The settings.
    out_dir : path
        Gets ``generator.safetensors``, ``history.csv`` and ``checkpoint/last.safetensors``, each atomically.
    seed : int
        Seed of the initial weights and of the order of the pairs.
    options : RunOptions
        Resuming, device, threads, metadata.
    hooks : TrainHooks
        Other networks, losses or augmentation than the paper's, and a function to report to.

    Returns
    -------
    generator : Generator
        The trained network.
    history : DataFrame
        One row per ``report_every`` steps: means of the losses over them, and Eq. 4 on the held-out pairs.

    Raises
    ------
    TrainingError
        If there are no pairs, the checkpoint belongs to another run, or a loss or a gradient is not finite;
        then the message names the step, the batch's files and the checkpoint.

    Notes
    -----
    Yin et al. 2020, Sec. III-A and IV-A.
    """
    state, about = _start(pairs, config, seed, options.device, hooks)
    checkpoint, n_steps = Path(out_dir) / "checkpoint" / "last.safetensors", config.n_steps(len(pairs))
    if options.resume and checkpoint.is_file():
        state.load(checkpoint, about)
    generator = state.networks["generator"]
    saved_s = monotonic()
    try:
        for _ in _train_steps(state, pairs, config, seed, hooks, options.num_workers):
            is_last = state.step == n_steps
            if is_last or state.step % config.report_every == 0:
                _end_row(state, config, len(pairs), held_out)
                if hooks.on_report is not None:
                    hooks.on_report(state.history[-1], generator)
            is_due = is_last or state.step % config.checkpoint_every == 0
            if is_due or monotonic() - saved_s >= 60.0 * options.checkpoint_minutes:
                state.save(checkpoint, about)
                saved_s = monotonic()
    except TrainingError as error:
        kept = f"{checkpoint} stays as it is" if checkpoint.is_file() else "there is no checkpoint yet"
        raise TrainingError(f"{error}; {kept}") from error
    history = pd.DataFrame(state.history, columns=HISTORY_COLUMNS)
    write_text(Path(out_dir) / "history.csv", history.to_csv(index=False))
    header = {**options.metadata, **about, "step": state.step}
    pix2pix.save_weights(Path(out_dir) / "generator.safetensors", generator, header)
    return generator.eval(), history


def _end_row(state: TrainingState, config: pix2pix.TrainConfig, n_pairs: int, held_out: Any) -> None:
    """Append the mean losses since the last row and the evaluation of the held-out pairs to the history."""
    n = state.step - (state.history[-1]["step"] if state.history else 0)
    rate = learning_rate(state.step - 1, config.n_steps(n_pairs), config.learning_rate)
    row = {"step": state.step, "epoch": state.step / -(-n_pairs // config.batch_size), "learning_rate": rate}
    row |= {name: total / n for name, total in state.sums.items()}
    row["held_out_l1"] = pix2pix.evaluate_l1(state.networks["generator"], held_out)
    state.history.append(row)
    state.sums = {}


def _train_steps(
    state: TrainingState, pairs: Any, config: pix2pix.TrainConfig, seed: int, hooks: TrainHooks, workers: int
) -> Iterator[int]:
    """Take the remaining steps; yield the number taken so far after each."""
    n_steps, device = config.n_steps(len(pairs)), next(state.networks["generator"].parameters()).device
    how = {"lambda_l1": config.lambda_l1, "pixel_loss": hooks.pixel_loss, "bf16": config.bf16}

    def load(step: int) -> tuple[Tensor, Tensor, np.ndarray]:
        index = batch_indices(step, len(pairs), config.batch_size, seed)
        rng = np.random.default_rng([seed, step, 1])
        drawn = hooks.draw_batch(pairs, index, rng) if hooks.draw_batch else [pairs[int(i)] for i in index]
        radar, lidar = (torch.from_numpy(np.stack(side)) for side in zip(*drawn, strict=True))
        return radar, lidar, index

    for radar, lidar, index in _prefetch(load, range(state.step, n_steps), workers):
        state.networks["generator"].train()
        for optimizer in state.optimizers.values():
            optimizer.param_groups[0]["lr"] = learning_rate(state.step, n_steps, config.learning_rate)
        batch = radar.to(device), lidar.to(device)
        try:
            losses = pix2pix.train_step(state.networks, state.optimizers, *batch, **how)
        except pix2pix.Pix2PixError as error:
            name = pairs.name if hasattr(pairs, "name") else "pair {}".format
            names = ", ".join(name(int(i)) for i in index)
            raise TrainingError(f"step {state.step + 1} of {n_steps}, batch of {names}: {error}") from error
        state.sums = {name: state.sums.get(name, 0.0) + loss for name, loss in losses.items()}
        state.step += 1
        yield state.step


def _prefetch(load: Callable[[int], Any], steps: range, workers: int) -> Iterator[Any]:
    """Load the batches of some steps in threads, in advance."""
    with ThreadPoolExecutor(workers) as pool:
        waiting = deque(pool.submit(load, step) for step in steps[: workers + 1])
        for step in steps:
            batch = waiting.popleft().result()
            if step + workers + 1 < steps.stop:
                waiting.append(pool.submit(load, step + workers + 1))
            yield batch


def _start(
    pairs: Any, config: pix2pix.TrainConfig, seed: int, device: str, hooks: TrainHooks
) -> tuple[TrainingState, dict[str, Any]]:
    """Build the networks of a run and describe it; refuse pairs and intervals that cannot be used."""
    if len(pairs) == 0:
        raise TrainingError("no pairs to train on")
    rows, saved = config.report_every, config.checkpoint_every
    if saved % rows:
        raise TrainingError(f"checkpoint_every ({saved}) is no multiple of report_every ({rows})")
    state, size = TrainingState(config, seed, device, hooks), pairs[0][0].shape[-2:]
    pix2pix.check_size(size, None, "first pair", state.networks["generator"].size_step)
    state.networks["generator"].image_size = tuple(map(int, size))
    settings = asdict(config) | dict(hooks.settings)
    return state, {"config": settings, "seed": seed, "pairs": len(pairs), "data": _checksum(pairs)}


def _checksum(pairs: Any) -> int:
    """Compute a checksum of the first and the last pair."""
    ends = (0, len(pairs) - 1)
    return zlib.crc32(b"".join(np.ascontiguousarray(image).tobytes() for i in ends for image in pairs[i]))


def _differences(found: dict[str, Any], wanted: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """List what differs, settings by their own names: name to (found, wanted)."""
    sides = [{**about, **(about.get("config") or {})} for about in (found, wanted)]
    names = [name for name in {**sides[1], **(found.get("config") or {})} if name != "config"]
    return {
        name: (sides[0].get(name), sides[1].get(name))
        for name in names
        if sides[0].get(name) != sides[1].get(name)
    }
