"""Imitation: a recurrent network learns to put out what demonstrators wanted, by least squares over whole episodes.

Its critic learns the demonstrations' returns beside it, so that reinforcement that follows does not begin with a critic
that knows nothing, which is how policies fall after cloning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch.nn.utils.rnn import pad_sequence

from reproduce.learning.config import ImitationConfig
from reproduce.learning.networks import RecurrentNetwork, observe_all

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Example:
    """One episode to imitate, as the network sees it."""

    observations: Floats  # (t, d)
    outputs: Floats  # (t, a)
    returns: Floats  # (t,)
    begin: int = 0  # first step that counts; those before only fill the memory


class Imitation:
    """Imitates examples with one network; ``epoch`` is one pass, to be called ``config.epochs`` times."""

    def __init__(
        self, network: RecurrentNetwork, examples: Sequence[Example], config: ImitationConfig, seed: int
    ) -> None:
        """Let the network's standardisers see all observations, and begin."""
        self._network, self._examples, self._config = network, list(examples), config
        self._rng = np.random.default_rng(seed)
        self._optimizer = th.optim.Adam(network.parameters(), lr=config.learning_rate)
        self.epochs = 0
        observe_all(network, np.concatenate([example.observations for example in self._examples]))

    def epoch(self) -> dict[str, float]:
        """Pass over all examples once in random order and return the mean losses."""
        self._network.set_training_mode(True)
        losses, batches = [], list(self._batches())
        for index, batch in enumerate(batches):
            lower_rate(self._optimizer, self._config, (self.epochs + index / len(batches)) / self._config.epochs)
            imitation, value = imitation_losses(self._network, batch)
            self._optimizer.zero_grad()
            (imitation + self._config.vf_coef * value).backward()
            th.nn.utils.clip_grad_norm_(self._network.parameters(), self._config.max_grad_norm)
            self._optimizer.step()
            losses.append((float(imitation.detach()), float(value.detach())))
        self.epochs += 1
        self._network.set_training_mode(False)
        mean = np.mean(losses, axis=0)
        return {"imitation_loss": float(mean[0]), "value_loss": float(mean[1])}

    def _batches(self) -> Iterator[list[Example]]:
        """Yield minibatches of examples of about the same length, so that little is padding, in random order."""
        count = self._config.episodes
        noisy = [len(example.outputs) * self._rng.uniform(0.8, 1.25) for example in self._examples]
        order = np.argsort(noisy)
        starts = self._rng.permutation(range(0, len(order), count))
        for start in starts:
            yield [self._examples[index] for index in order[start : start + count]]


def lower_rate(optimizer: th.optim.Optimizer, config: ImitationConfig, done: float) -> None:
    """Set the learning rate on its half cosine, at a share ``done`` of all passes."""
    first, last = config.learning_rate, config.final_learning_rate
    for group in optimizer.param_groups:
        group["lr"] = last + 0.5 * (first - last) * (1.0 + math.cos(math.pi * min(1.0, done)))


def imitation_losses(network: RecurrentNetwork, batch: Sequence[Example]) -> tuple[th.Tensor, th.Tensor]:
    """Return the mean squared error of the network's means, and that of its values, over the steps that count."""
    observations, outputs, returns = (
        pad_sequence([th.from_numpy(getattr(example, name)) for example in batch])
        for name in ("observations", "outputs", "returns")
    )
    steps = th.arange(len(observations))[:, None]
    begins, ends = th.tensor([[example.begin, len(example.outputs)] for example in batch]).T
    counts = (steps >= begins) & (steps < ends)
    means, values = evaluate(network, observations)
    return ((means - outputs)[counts] ** 2).mean(), ((values - returns)[counts] ** 2).mean()


def evaluate(network: RecurrentNetwork, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return the means (t, n, a) and values (t, n) of whole episodes (t, n, d), from an empty memory on."""
    policy: Any = network  # sb3-contrib types its parts too loosely to follow
    length, count = observations.shape[:2]
    pi_features, vf_features = policy.extract_features(observations.flatten(0, 1))
    memory, _ = policy.lstm_actor(pi_features.view(length, count, -1))
    means = policy.action_net(policy.mlp_extractor.forward_actor(memory))
    values = policy.value_net(policy.mlp_extractor.forward_critic(policy.critic(vf_features)))
    return means, values.view(length, count)
