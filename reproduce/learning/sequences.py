"""Rollouts as whole sequences: cut at episode starts and at a sequence length, padded only within a minibatch.

Time is not looped over in Python: a recurrent network sees a minibatch of sequences in one call, each with the state
that the network had when the sequence began (ML-Agents' ``sequence_length``, the natural reading of P9).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch as th
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass
class Rollout:
    """Transitions of several environments, one after another in time within each, environments end to end.

    Attributes:
        observations: (m, d).
        actions: (m, a), as drawn (not clipped).
        log_probs: Of the actions when drawn (m,).
        values: Of the observations when seen (m,).
        advantages: (m,).
        returns: (m,).
        hidden: LSTM state before each observation (m, 2, h).
        bounds: Beginnings and ends of the sequences, (s, 2).
    """

    observations: Floats
    actions: Floats
    log_probs: Floats
    values: Floats
    advantages: Floats
    returns: Floats
    hidden: Floats
    bounds: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of transitions."""
        return len(self.observations)


@dataclass
class Minibatch:
    """Sequences padded to the longest; per-transition tensors hold real transitions only, in the mask's order.

    Attributes:
        observations: (length, n, d), padding repeats a sequence's last observation.
        hidden: Initial hidden and cell state, each (1, n, h).
        mask: Which of (length, n) are real.
        rows: Index of each real transition in the rollout.
    """

    observations: th.Tensor
    hidden: tuple[th.Tensor, th.Tensor]
    mask: th.Tensor
    rows: th.Tensor


def sequence_bounds(starts: NDArray[np.bool_], first: int, length: int) -> list[tuple[int, int]]:
    """Cut one environment's transitions into sequences.

    Args:
        starts: Which transitions begin an episode, (t,).
        first: Index of the first of them in the whole rollout.
        length: Most transitions in a sequence.
    """
    cuts = [0, *[int(i) for i in np.flatnonzero(starts) if i > 0], len(starts)]
    bounds = []
    for begin, end in pairwise(cuts):
        bounds += [(first + a, first + min(a + length, end)) for a in range(begin, end, length)]
    return bounds


def minibatches(rollout: Rollout, batch_size: int, rng: np.random.Generator) -> Iterator[Minibatch]:
    """Draw the sequences in random order, about ``batch_size`` transitions at a time; each exactly once."""
    order = rng.permutation(len(rollout.bounds))
    lengths = np.diff(rollout.bounds[order], axis=1)[:, 0]
    count = max(1, round(len(rollout) / batch_size))
    ends = np.searchsorted(np.cumsum(lengths), np.linspace(0, len(rollout), count + 1)[1:-1])
    for chosen in np.split(order, ends):
        if len(chosen):
            yield _minibatch(rollout, rollout.bounds[chosen])


def _minibatch(rollout: Rollout, bounds: NDArray[np.int64]) -> Minibatch:
    lengths = bounds[:, 1] - bounds[:, 0]
    steps = np.arange(lengths.max())[:, None]
    mask = steps < lengths[None, :]
    index = np.minimum(bounds[None, :, 0] + steps, bounds[None, :, 1] - 1)  # (length, n)
    hidden = th.from_numpy(rollout.hidden[bounds[:, 0]])
    return Minibatch(
        observations=th.from_numpy(rollout.observations[index]),
        hidden=(hidden[None, :, 0].contiguous(), hidden[None, :, 1].contiguous()),
        mask=th.from_numpy(mask),
        rows=th.from_numpy(index[mask]),
    )


def advantages_and_returns(
    rewards: Floats,
    values: Floats,
    starts: NDArray[np.bool_],
    last_value: float,
    last_done: bool,
    gamma: float,
    lam: float,
) -> tuple[Floats, Floats]:
    """Generalised advantage estimation over one environment's transitions, (t,) each.

    Args:
        rewards: r_t.
        values: V(s_t).
        starts: Whether s_t begins an episode.
        last_value: V of the state after the last transition.
        last_done: Whether the last transition ended its episode.
        gamma: Discount.
        lam: GAE's lambda.
    """
    steps = len(rewards)
    following = np.append(values[1:], last_value)
    going_on = 1.0 - np.append(starts[1:], last_done).astype(np.float32)
    advantages = np.zeros(steps, np.float32)
    running = 0.0
    for t in range(steps - 1, -1, -1):
        delta = rewards[t] + gamma * following[t] * going_on[t] - values[t]
        running = delta + gamma * lam * going_on[t] * running
        advantages[t] = running
    return advantages, advantages + values
