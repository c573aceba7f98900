"""Train the embedding: on first pictures and rollouts with true states, then also on rollouts on its own estimates.

Whatever is drawn follows from the seed and the epoch, and a checkpoint is written after each epoch, so a training that
is interrupted goes on where it was and ends as it would have, bit for bit.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from pydantic import NonNegativeInt, PositiveInt
from torch import nn

from lunar_rescue.observation import GROUND_POINTS, SLICES
from lunar_rescue.scenes.records import checked
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.seeing import SeeingEnv
from reproduce.learning.policy import Policy
from reproduce.perception.estimator import LEVEL, EstimatedEnv
from reproduce.perception.frames import Frames, first_frames, joined, rollouts
from reproduce.perception.network import (
    CELL,
    COLUMNS,
    MIDDLE,
    OWN,
    ROWS,
    SPEED,
    SPIN,
    SPREAD,
    Embedding,
    Seen,
    picture_input,
    spec,
)
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
from reproduce.storage.provenance import provenance
from reproduce.storage.records import to_dict

FIRST_SEED = 1_700_000_000  # of the training scenes that are looked at; those of demonstrations begin elsewhere
SHIFT = 3  # px, pictures are moved by up to this each way
TURN, MOVE = math.radians(8.0), 0.06  # rad and m, what they show is turned and moved by up to this
NEIGHBOURS = 0.1  # weight of the cells around a rock, which may as well have been taken for it
WARM_UP = 0.05  # share of the training in which the learning rate rises


@checked
@dataclass(frozen=True)
class EmbeddingConfig:
    """What a training of the embedding looks at and for how long; none of it is in the paper."""

    seed: NonNegativeInt = 0  # of weights, minibatches and scenes
    scenes: PositiveInt = 8000  # whose first picture is looked at
    rescues: PositiveInt = 100  # acted out on true states in the first round
    own_rescues: PositiveInt = 60  # acted out on the embedding's estimates before the second round
    epochs: PositiveInt = 14  # of the first round
    own_epochs: PositiveInt = 6  # of the second round
    batch: PositiveInt = 32  # first pictures of a minibatch
    chunks: PositiveInt = 2  # pieces of rescues of a minibatch
    length: PositiveInt = 12  # pictures of a piece
    learning_rate: float = 1e-3  # highest, of Adam; rises, then falls as a cosine to nothing

    @classmethod
    def looking_at(cls, scenes: int, seed: int = 0) -> "EmbeddingConfig":
        """Return the configuration for another number of scenes, with rescues in proportion."""
        usual = cls()
        share = scenes / usual.scenes
        rescues, own = (max(2, round(share * number)) for number in (usual.rescues, usual.own_rescues))
        return replace(
            usual, seed=seed, scenes=scenes, rescues=rescues, own_rescues=own, batch=min(usual.batch, scenes)
        )


def loss_of(seen: Seen, frames: Frames, shift: tuple[int, int] = (0, 0)) -> dict[str, th.Tensor]:
    """Return the terms of the loss, by name; rocks and ground count in pictures that begin an episode.

    Points, motion and ground are Gaussian with the variance that the network says; each term is weighted by the root of
    that variance, held fixed, so that what is hard to see is learnt, too (Seitzer et al., 2022, beta = 0.5).
    """
    truth, start = th.from_numpy(frames.truth), th.from_numpy(frames.start)
    body = truth[:, SLICES["P_P"]]
    points = th.cat([body[:, None, :3], body[:, 15:].view(len(body), -1, 3)], dim=1)
    motion = body[:, 9:15].view(-1, 2, 3) - seen.motion
    error = motion / motion.new_tensor([SPEED, SPIN])[:, None]
    terms = {
        "points": _gaussian((points - seen.points) / SPREAD, seen.spread[..., None]),
        "motion": _gaussian(error, seen.doubt[..., None]),
        "posture": nn.functional.cross_entropy(seen.posture, th.from_numpy(frames.posture), ignore_index=-1),
    }
    if start.any():
        ground = truth[start][:, SLICES["P_T"]][:, 3:] - seen.ground[start, : 2 * GROUND_POINTS]
        terms["ground"] = _gaussian(ground, seen.ground[start, 2 * GROUND_POINTS :].clamp(-7.0, 3.0))
        terms |= _rock_loss(seen.rocks[start], truth[start], frames.spots[frames.start] + np.array(shift))
    return terms


def _gaussian(error: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """Return the mean of the negative log-likelihood of errors, for logarithms of variances."""
    likelihood = 0.5 * (error**2 * th.exp(-variance) + variance)
    return (likelihood * th.exp(0.5 * variance).detach()).mean()


def _rock_loss(rocks: th.Tensor, truth: th.Tensor, spots: Any) -> dict[str, th.Tensor]:
    """Return the losses of finding rocks and of where they are."""
    cells = np.floor(spots / CELL).astype(np.int64)
    inside = ((cells >= 0) & (cells < [COLUMNS, ROWS])).all(axis=-1)
    index, rock = np.nonzero(inside)
    column, row = cells[index, rock].T
    present = th.zeros(len(rocks), 1, ROWS, COLUMNS)
    present[index, 0, row, column] = 1.0
    near = nn.functional.max_pool2d(present, 3, 1, 1)
    weights = th.where((near > 0) & (present == 0), NEIGHBOURS, 1.0)
    found = nn.functional.binary_cross_entropy_with_logits(rocks[:, :1], present, weights, reduction="sum")
    places = truth[:, SLICES["P_E"]].view(-1, MAX_ROCKS, 5)[index, rock, :4]
    away = nn.functional.smooth_l1_loss(rocks[index, 1:, row, column], places, reduction="sum", beta=0.02)
    number = max(len(index), 1)
    return {"found": found / number, "places": 10.0 * away / number}


def total(terms: dict[str, th.Tensor]) -> th.Tensor:
    """Return the sum of the loss's terms."""
    return th.stack(list(terms.values())).sum()


def turned(pictures: th.Tensor, frames: Frames, length: int, rng: np.random.Generator) -> Frames:
    """Move everything that pictures (n, 6, h, w) show a little about the robot, in place; return frames that say so.

    Each episode of ``length`` pictures is turned about the base's vertical and moved along the ground by amounts of its
    own: one picture stands for many places of the base.
    """
    episodes = len(frames) // length
    angles, moves = rng.uniform(-TURN, TURN, episodes), rng.uniform(-MOVE, MOVE, (episodes, 1, 2))
    c, s = np.tile(np.cos(angles), length), np.tile(np.sin(angles), length)
    turns, moves = np.array([[c, s], [-s, c]]).transpose(2, 0, 1), np.tile(moves, (length, 1, 1))  # rows times turns
    middle = np.array(MIDDLE[:2])
    shift = th.from_numpy((middle @ turns + moves[:, 0] - middle).astype(np.float32))
    flat = pictures[:, :2].flatten(2).transpose(1, 2) @ th.from_numpy(turns.astype(np.float32))
    pictures[:, :2] = flat.transpose(1, 2).reshape(pictures[:, :2].shape) + shift[:, :, None, None]
    truth = frames.truth.copy()
    body, rocks = truth[:, SLICES["P_P"]].reshape(len(truth), -1, 3), truth[:, SLICES["P_E"]].reshape(-1, MAX_ROCKS, 5)
    body[..., :2], rocks[..., :2] = body[..., :2] @ turns, rocks[..., :2] @ turns
    body[:, [0, *range(5, body.shape[1])], :2] += moves
    rocks[..., :2] += moves * rocks[..., 4:]
    truth[:, SLICES["P_P"]], truth[:, SLICES["P_E"]] = body.reshape(len(truth), -1), rocks.reshape(len(truth), -1)
    return replace(frames, truth=truth)


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
        """Return the learning curve."""
        return {"curve": self.curve}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what the two methods above returned."""
        restore_module("network", self.network, tensors)
        restore_optimizer("optimizer", self.optimizer, tensors)
        self.curve = list(numbers["curve"])

    def standardise(self, frames: Frames) -> None:
        """Take means and deviations of the robot's own sensors from frames."""
        own = th.from_numpy(frames.truth[:, OWN])
        self.network.middle.copy_(own.mean(0))
        self.network.scale.copy_(own.std(0, unbiased=False) + 0.05)

    def epoch(self, first: Frames, rescues: Frames, epoch: int) -> dict[str, float]:
        """Learn from each first picture once and from as many pieces of rescues; return means of the loss's terms."""
        config, epochs = self.config, self.config.epochs + self.config.own_epochs
        rng = np.random.default_rng([config.seed, epoch])
        order, pieces = rng.permutation(len(first)), _pieces(rescues, config.length)
        steps = max(1, len(first) // config.batch)
        told: list[dict[str, float]] = []
        self.network.train()
        for step in range(steps):
            done = (epoch + step / steps) / epochs
            rise = min(1.0, done / WARM_UP + 0.02)
            self.optimizer.param_groups[0]["lr"] = config.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * done))
            terms = self._terms(first.rows(order[step * config.batch : (step + 1) * config.batch]), 1, rng)
            chosen = pieces[rng.integers(len(pieces), size=config.chunks)]
            more = self._terms(rescues.rows(chosen.T.ravel()), config.length, rng)
            self.optimizer.zero_grad()
            (total(terms) + total(more)).backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
            self.optimizer.step()
            terms |= {f"later {name}": term for name, term in more.items()}
            told.append({name: term.item() for name, term in terms.items()})
        return {name: float(np.mean([row[name] for row in told if name in row])) for name in told[0]}

    def _terms(self, frames: Frames, length: int, rng: np.random.Generator) -> dict[str, th.Tensor]:
        pictures = picture_input(frames.colour, frames.depth, frames.truth)
        frames = turned(pictures, frames, length, rng)
        right, down = (int(shift) for shift in rng.integers(-SHIFT, SHIFT + 1, 2))
        padded = nn.functional.pad(pictures, (SHIFT,) * 4, mode="replicate")
        top, left = SHIFT - down, SHIFT - right
        moved = padded[:, :, top : top + pictures.shape[2], left : left + pictures.shape[3]]
        seen, _ = self.network(moved, th.from_numpy(frames.truth[:, OWN]), length, None)
        return loss_of(seen, frames, (right, down))


def _pieces(frames: Frames, length: int) -> Any:
    """Return the numbers of the frames of each piece of a rescue, (m, length)."""
    begins = np.append(np.flatnonzero(frames.start), len(frames))
    rows = [np.arange(a, b - length + 1) for a, b in pairwise(begins)]
    return np.concatenate(rows)[:, None] + np.arange(length)


class _Data:
    """The frames of a training, kept in its folder until it has ended."""

    def __init__(self, config: EmbeddingConfig, out: Path, policies: Sequence[Policy]) -> None:
        self._config, self._out, self._policies = config, out, policies
        self._begin = FIRST_SEED + 1_000_000 * config.seed

    def _frames(self, name: str, make: Callable[[], Frames]) -> Frames:
        path = self._out / f"frames_{name}.safetensors"
        if not path.is_file():
            make().save(path)
        return Frames.load(path)

    def first_round(self) -> tuple[Frames, Frames]:
        """Return first pictures and rescues on true states."""
        config, begin = self._config, self._begin
        env = SeeingEnv()
        try:
            first = self._frames("first", lambda: first_frames(env, range(begin, begin + config.scenes)))
            seeds = range(begin + config.scenes, begin + config.scenes + config.rescues)
            return first, self._frames("rescues", lambda: rollouts(env, self._policies, seeds))
        finally:
            env.close()

    def second_round(self, network: Embedding) -> Frames:
        """Return rescues on the network's own estimates."""
        begin = self._begin + self._config.scenes + self._config.rescues

        def make() -> Frames:
            network.eval()
            env = EstimatedEnv(network)
            try:
                return rollouts(env, self._policies, range(begin, begin + self._config.own_rescues))
            finally:
                env.close()

        return self._frames("own", make)

    def remove(self) -> None:
        """Delete the files."""
        for path in self._out.glob("frames_*.safetensors"):
            path.unlink()


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
    if resume != (out / CHECKPOINT).is_file():
        words = "no checkpoint to go on from" if resume else "holds a training that was interrupted: add --resume"
        raise UserError(f"{out}: {words}")
    th.set_num_threads(1)
    training, settings = EmbeddingTraining(config), {**to_dict(config), "actors": list(actors)}
    with locked(out, "training"):
        data, begun = _Data(config, out, policies), time.process_time()
        done = load_checkpoint(out, {LEVEL: training}, settings) if resume else Progress(0, 0, 0.0)
        if not resume:
            data.remove()
            save_checkpoint(out, {LEVEL: training}, done, settings)  # pictures that are taken now are kept, too
        for epoch, terms in _epochs(training, data, done.update):
            seconds = done.seconds + time.process_time() - begun
            training.curve.append({"epoch": epoch + 1, "seconds": round(seconds, 1), **terms})
            save_checkpoint(out, {LEVEL: training}, Progress(epoch + 1, (epoch + 1) * config.scenes, seconds), settings)
            tell(f"epoch {epoch + 1}, {seconds:.0f} s: " + ", ".join(f"{n} {v:.3f}" for n, v in terms.items()))
        _finish(training, out, list(actors))
        data.remove()
        (out / CHECKPOINT).unlink()


def _epochs(training: EmbeddingTraining, data: _Data, done: int) -> Iterator[tuple[int, dict[str, float]]]:
    """Make the epochs that were not made yet and yield their numbers and losses."""
    config = training.config
    first, rescues = data.first_round()
    if not done:
        training.standardise(joined([first, rescues]))
    for epoch in range(done, config.epochs + config.own_epochs):
        if epoch == max(done, config.epochs):
            rescues = joined([rescues, data.second_round(training.network)])
        yield epoch, training.epoch(first, rescues, epoch)


def _finish(training: EmbeddingTraining, out: Path, actors: list[str]) -> None:
    import pandas as pd

    training.network.eval()
    save_policy(out, LEVEL, {LEVEL: (spec(), training.network)}, training.config)
    write_atomically(out / "progress.csv", lambda path: pd.DataFrame(training.curve).to_csv(path, index=False))
    seconds = training.curve[-1]["seconds"]
    write_json(out / "run.json", {**provenance(), "method": LEVEL, "actors": actors, "processor_seconds": seconds})
