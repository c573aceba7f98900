"""Rollouts as whole sequences: cut at episode starts and at a sequence length, padded only within a minibatch.

Time is not looped over in Python: a recurrent network sees a minibatch of sequences in one call, each with the state
that the network had when the sequence began (ML-Agents' ``sequence_length``, the natural reading of P9).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Columns of a rollout that a loss compares with what the network says now.
TARGETS = ("actions", "log_probs", "values", "advantages", "returns")


@dataclass
class Rollout:
    """Transitions of several environments: in the order of time within each, environments end to end."""

    observations: Floats  # (m, d)
    actions: Floats  # as drawn, not clipped (m, a)
    log_probs: Floats  # logarithm of the actions' probability density when they were drawn (m,)
    values: Floats  # the critic's when the observations were seen (m,)
    advantages: Floats  # (m,)
    returns: Floats  # (m,)
    hidden: Floats  # LSTM state before each observation (m, 2, h)
    bounds: NDArray[np.int64]  # beginning and end of each sequence (s, 2)

    def __len__(self) -> int:
        """Return the number of transitions, m."""
        return len(self.observations)


@dataclass
class Minibatch:
    """Sequences padded to the longest; per-transition tensors hold real transitions only, in the mask's order."""

    observations: th.Tensor  # (length, n, d), padding repeats a sequence's last observation
    hidden: tuple[th.Tensor, th.Tensor]  # initial hidden and cell state, each (1, n, h)
    mask: th.Tensor  # which of (length, n) are real
    rows: th.Tensor  # index of each real transition in the rollout


def as_tensor(array: Any) -> th.Tensor:
    """Convert to a float32 tensor, whatever the environment's own type is."""
    return th.from_numpy(np.asarray(array, np.float32))


def env_major(tensor: th.Tensor) -> th.Tensor:
    """Lay (t, n, ...) out as (n * t, ...), each environment's steps together."""
    return tensor.transpose(0, 1).flatten(0, 1).contiguous()


def sequence_bounds(starts: NDArray[np.bool_], first: int, length: int) -> list[tuple[int, int]]:
    """Cut an environment's transitions, from index ``first`` of the rollout on, into sequences of at most ``length``.

    ``starts`` (t,) says which transitions begin an episode. Returns beginning and end of each sequence in the rollout.
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
    for sequences in np.split(order, ends):
        if len(sequences):
            yield _minibatch(rollout, rollout.bounds[sequences])


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
    rewards: NDArray[Any], values: NDArray[Any], last_values: Any, ends: NDArray[np.bool_], gamma: float, lam: float
) -> tuple[Floats, Floats]:
    """Estimate advantages and returns by generalised advantage estimation (Schulman et al. 2016, Eq. 16).

    All are (t, ...): time comes first, further axes, such as environments, are independent of each other. ``ends`` says
    after which steps nothing counts any more, as the episode ended; ``last_values`` (...) are of the state after the
    last step, where it did not end one. Returns are advantage plus value. Sums are in double precision.
    """
    going_on = 1.0 - ends
    following = np.concatenate([values[1:], np.asarray(last_values)[None]])
    deltas = rewards + gamma * going_on * following - values
    advantages = np.zeros_like(deltas)
    running = np.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        running = deltas[t] + gamma * lam * going_on[t] * running
        advantages[t] = running
    single = advantages.astype(np.float32)
    return single, single + values
