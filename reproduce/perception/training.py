"""Train the embedding: on many scenes and rollouts with true states, then also on rollouts on its own estimates.

Whatever is drawn follows from the seed and the epoch, and a checkpoint is written after each epoch, so a training that
is interrupted goes on where it was and ends as it would have, bit for bit.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from pydantic import NonNegativeInt, PositiveInt
from torch import nn

from lunar_rescue.scenes.records import checked
from lunar_rescue.seeing import SeeingEnv
from reproduce.learning.policy import Policy
from reproduce.perception.estimator import LEVEL, EstimatedEnv
from reproduce.perception.frames import Frames, Moves, joined, rollouts, scattered
from reproduce.perception.losses import loss_of, total, turned
from reproduce.perception.network import OWN, Embedding, moved, picture_input, spec
from reproduce.storage.checkpoint import (
    Progress,
    load_checkpoint,
    module_tensors,
    optimizer_tensors,
    restore_module,
    restore_optimizer,
    save_checkpoint,
)
from reproduce.storage.errors import UserError
from reproduce.storage.files import locked, write_atomically, write_json
from reproduce.storage.paths import CHECKPOINT
from reproduce.storage.policies import save_policy
from reproduce.storage.processes import map_in_processes
from reproduce.storage.provenance import provenance
from reproduce.storage.records import to_dict

FIRST_SEED = 1_700_000_000  # of the training scenes that are looked at; those of demonstrations begin elsewhere
SHIFT = 3  # px, pictures are moved by up to this each way
AT_ONCE = 20  # scenes whose pictures a worker hands over together
WARM_UP = 0.05  # share of the training in which the learning rate rises


@checked
@dataclass(frozen=True)
class EmbeddingConfig:
    """What a training of the embedding looks at and for how long; none of it is in the paper."""

    seed: NonNegativeInt = 0  # of weights, minibatches and scenes
    scenes: PositiveInt = 6000  # that are looked at as they begin
    later: NonNegativeInt = 1  # more pictures of each, with arms and body where rescues bring theirs
    rescues: PositiveInt = 80  # acted out on true states in the first round
    own_rescues: PositiveInt = 40  # acted out on the embedding's estimates before the second round
    epochs: PositiveInt = 15  # of the first round
    early: NonNegativeInt = 13  # of these, with no more of a scene than its first picture, and without rescues
    own_epochs: PositiveInt = 2  # of the second round
    batch: PositiveInt = 16  # scenes of a minibatch
    chunks: PositiveInt = 1  # pieces of rescues of a minibatch
    length: PositiveInt = 12  # pictures of a piece
    learning_rate: float = 5e-3  # highest, of Adam; rises, then falls as a cosine to nothing

    @classmethod
    def looking_at(cls, scenes: int, seed: int = 0) -> "EmbeddingConfig":
        """Return the configuration for another number of scenes, with rescues in proportion."""
        usual = cls()
        share = scenes / usual.scenes
        rescues, own = (max(2, round(share * number)) for number in (usual.rescues, usual.own_rescues))
        return replace(
            usual, seed=seed, scenes=scenes, rescues=rescues, own_rescues=own, batch=min(usual.batch, scenes)
        )


class EmbeddingTraining:
    """Network, optimiser and how far they are, as ``storage.checkpoint`` keeps them."""

    def __init__(self, config: EmbeddingConfig) -> None:
        """Draw weights by the configuration's seed."""
        th.manual_seed(config.seed)
        self.config, self.network = config, Embedding(spec().hidden_units)
        self.optimizer = th.optim.Adam(self.network.parameters(), config.learning_rate)
        self.curve: list[dict[str, float]] = []

    def state_tensors(self) -> dict[str, th.Tensor]:
        """Return weights and what the optimiser remembers."""
        return module_tensors("network", self.network) | optimizer_tensors("optimizer", self.optimizer)

    def state_numbers(self) -> dict[str, Any]:
        """Return the learning curve, which is plain data."""
        return {"curve": self.curve}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what the two methods above returned."""
        restore_module("network", self.network, tensors)
        restore_optimizer("optimizer", self.optimizer, tensors)
        self.curve = list(numbers["curve"])

    def standardise(self, *lots: Frames) -> None:
        """Take means and deviations of the robot's own sensors from all lots of frames together."""
        own = th.from_numpy(np.concatenate([frames.truth[:, OWN] for frames in lots]))
        self.network.middle.copy_(own.mean(0))
        self.network.scale.copy_(own.std(0, unbiased=False) + 0.05)

    def epoch(self, scenes: Frames, rescues: Frames, epoch: int) -> dict[str, float]:
        """Learn from each scene's pictures once, and later from rescues, too; return means of the loss's terms."""
        config, epochs = self.config, self.config.epochs + self.config.own_epochs
        early, rng = epoch < config.early, np.random.default_rng([config.seed, epoch])
        views = 1 if early else 1 + config.later
        looks = rng.permutation(_pieces(scenes, 1 + config.later))[:, :views]
        pieces = _pieces(rescues, config.length)
        steps = max(1, len(looks) // config.batch)
        told: list[dict[str, float]] = []
        self.network.train()
        for step in range(steps):
            done = (epoch + step / steps) / epochs
            rise = min(1.0, done / WARM_UP + 0.02)
            self.optimizer.param_groups[0]["lr"] = config.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * done))
            chosen = looks[step * config.batch : (step + 1) * config.batch]
            terms = self._terms(scenes.rows(chosen.T.ravel()), views, rng, still=True)
            if not early:
                chosen = pieces[rng.integers(len(pieces), size=config.chunks)]
                more = self._terms(rescues.rows(chosen.T.ravel()), config.length, rng)
                terms |= {f"later {name}": term for name, term in more.items()}
            self.optimizer.zero_grad()
            total(terms).backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
            self.optimizer.step()
            told.append({name: term.item() for name, term in terms.items()})
        return dict(pd.DataFrame(told).mean())

    def _terms(
        self, frames: Frames, length: int, rng: np.random.Generator, still: bool = False
    ) -> dict[str, th.Tensor]:
        pictures = picture_input(frames.colour, frames.depth, frames.truth)
        frames = turned(pictures, frames, length, rng)
        right, down = (int(shift) for shift in rng.integers(-SHIFT, SHIFT + 1, 2))
        rocks = moved(th.from_numpy(frames.rocks)[:, None].float(), right, down)[:, 0]
        seen, _ = self.network(moved(pictures, right, down), th.from_numpy(frames.truth[:, OWN]), length, None)
        return loss_of(seen, replace(frames, rocks=rocks.numpy()), still=still)


def _pieces(frames: Frames, length: int) -> Any:
    """Return the numbers of the frames of each piece of a rescue, (m, length)."""
    begins = np.append(np.flatnonzero(frames.start), len(frames))
    rows = [np.arange(a, b - length + 1) for a, b in pairwise(begins)]
    return np.concatenate(rows)[:, None] + np.arange(length)


_STATE: dict[str, Any] = {}  # of a worker that takes pictures


def _prepare(network: Embedding | None, policies: Sequence[Policy], moves: Moves | None) -> None:
    th.set_num_threads(1)
    env = SeeingEnv() if network is None else EstimatedEnv(network)
    _STATE.update(env=env, policies=policies, moves=moves)


def _look(seeds: range, later: int) -> Frames:
    return scattered(_STATE["env"], seeds, _STATE["moves"], later)


def _act(seeds: range) -> Frames:
    return rollouts(_STATE["env"], _STATE["policies"], seeds)


class _Data:
    """The frames of a training, kept in its folder until it has ended."""

    def __init__(self, config: EmbeddingConfig, out: Path, policies: Sequence[Policy]) -> None:
        self._config, self._out, self._policies = config, out, policies
        self._begin = FIRST_SEED + 1_000_000 * config.seed

    def _frames(self, name: str, job: Callable[[range], Frames], number: int, *what: Any) -> Frames:
        """Return the pictures of the next scenes, taken by all cores unless they are in the folder already."""
        path, seeds = self._out / f"frames_{name}.safetensors", range(self._begin, self._begin + number)
        self._begin += number
        if not path.is_file():
            parts = [seeds[i : i + AT_ONCE] for i in range(0, number, AT_ONCE)]
            joined(map_in_processes(job, parts, None, _prepare, what)).save(path)
        return Frames.load(path)

    def first_round(self) -> tuple[Frames, Frames]:
        """Return scenes as they begin, with what could become of them, and rescues on true states."""
        config = self._config
        rescues = self._frames("rescues", _act, config.rescues, None, self._policies, None)
        job = partial(_look, later=config.later)
        return self._frames("scenes", job, config.scenes, None, (), Moves.of(rescues)), rescues

    def second_round(self, network: Embedding) -> Frames:
        """Return rescues on the network's own estimates."""
        return self._frames("own", _act, self._config.own_rescues, network.eval(), self._policies, None)

    def remove(self) -> None:
        """Delete the files and the checkpoint, once nothing wants them any more."""
        for path in self._out.glob("frames_*.safetensors"):
            path.unlink()
        (self._out / CHECKPOINT).unlink(missing_ok=True)


def train(
    config: EmbeddingConfig,
    policies: Sequence[Policy],
    out: Path,
    *,
    actors: Sequence[str] = (),
    resume: bool = False,
    tell: Callable[[str], object] = print,
) -> None:
    """Train the embedding and write weights, configuration, learning curve and ``run.json`` into a folder.

    Args:
        config: What it looks at and for how long.
        policies: Who acts in rescues.
        out: Folder to write.
        actors: The policies' names, for the record.
        resume: Whether to go on from the folder's checkpoint.
        tell: Called with a line an epoch.

    Raises:
        UserError: Without a checkpoint to go on from, or with one that must not be lost.
    """
    _check_checkpoint(out, resume)
    th.set_num_threads(1)
    training, settings = EmbeddingTraining(config), {**to_dict(config), "actors": list(actors)}
    with locked(out, "training"):
        data = _Data(config, out, policies)
        done = load_checkpoint(out, {LEVEL: training}, settings) if resume else Progress(0, 0, 0.0)
        begun = time.monotonic() - done.seconds
        if not resume:
            data.remove()
            save_checkpoint(out, {LEVEL: training}, done, settings)  # pictures that are taken now are kept, too
        for epoch, terms in _epochs(training, data, done.update):
            seconds = time.monotonic() - begun
            training.curve.append({"epoch": epoch + 1, "seconds": seconds, **terms})
            save_checkpoint(out, {LEVEL: training}, Progress(epoch + 1, (epoch + 1) * config.scenes, seconds), settings)
            tell(f"epoch {epoch + 1}, {seconds:.0f} s: " + ", ".join(f"{n} {v:.3f}" for n, v in terms.items()))
        _finish(training, out, list(actors))
        data.remove()


def _check_checkpoint(out: Path, resume: bool) -> None:
    if resume != (out / CHECKPOINT).is_file():
        words = "no checkpoint to go on from" if resume else "holds a training that was interrupted: add --resume"
        raise UserError(f"{out}: {words}")


def _epochs(training: EmbeddingTraining, data: _Data, done: int) -> Iterator[tuple[int, dict[str, float]]]:
    """Make the epochs that were not made yet and yield their numbers and losses."""
    config = training.config
    scenes, rescues = data.first_round()
    if not done:
        training.standardise(scenes, rescues)
    for epoch in range(done, config.epochs + config.own_epochs):
        if epoch == max(done, config.epochs):
            rescues = joined([rescues, data.second_round(training.network)])
        yield epoch, training.epoch(scenes, rescues, epoch)


def _finish(training: EmbeddingTraining, out: Path, actors: list[str]) -> None:
    training.network.eval()
    save_policy(out, LEVEL, {LEVEL: (spec(), training.network)}, training.config)
    write_atomically(out / "progress.csv", lambda path: pd.DataFrame(training.curve).to_csv(path, index=False))
    seconds = round(training.curve[-1]["seconds"], 1)
    write_json(out / "run.json", {**provenance(), "method": LEVEL, "actors": actors, "seconds": seconds})
