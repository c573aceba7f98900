"""What FuN learns from: Worker's transitions, what Manager did at the same steps, intrinsic reward and directions.

Time comes first, then environments: (t, n, ...). No cosine crosses the end of an episode.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from torch.nn import functional

from reproduce.baselines.feudal.network import FunSpec, Memory, Step
from reproduce.learning.sequences import Floats, Rollout, as_tensor, sequence_bounds


class FunBuffer(RolloutBuffer):
    """SB3's buffer for Worker's transitions, and beside it what Manager did at the same steps."""

    #: Step, environments (k,) and observations (k, o) with which episodes ended.
    last_observations: list[tuple[int, NDArray[np.int64], th.Tensor]]

    def __init__(self, *args: Any, spec: FunSpec, sequence_length: int, **kwargs: Any) -> None:
        """Make a buffer of zeros for one rollout of the network that ``spec`` describes.

        States of the dilated LSTM are stored every ``sequence_length`` steps; one of each step would fill 40 MB.
        """
        self._spec, self.sequence_length = spec, sequence_length
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Begin a rollout with all arrays zero, time first: (t, n, ...)."""
        super().reset()
        steps, count, spec = self.buffer_size, self.n_envs, self._spec
        self.goals, self.own_goals, self.pooled = (th.zeros(steps, count, spec.goal_size) for _ in range(3))
        self.worker_states = th.zeros(steps, count, 2, spec.hidden_units)
        self.clock = th.zeros(steps, count, dtype=th.int64)
        self.manager_values, self.manager_rewards = th.zeros(steps, count), th.zeros(steps, count)
        self.ends = th.zeros(steps, count, dtype=th.bool)
        stored = -(-steps // self.sequence_length)
        self.manager_states = th.zeros(stored, count, 2, spec.horizon, spec.goal_size)
        self.last_observations = []

    def add_memory(self, memory: Memory) -> None:
        """Store what the levels remember before the step that ``add`` will end."""
        if self.pos % self.sequence_length == 0:
            self.manager_states[self.pos // self.sequence_length] = memory.manager
        self.worker_states[self.pos], self.clock[self.pos] = memory.worker, memory.clock

    def add_levels(self, step: Step, rewards: Floats, dones: NDArray[Any]) -> None:
        """Store what Manager did at the step that ``add`` will end, and its rewards (n,)."""
        self.goals[self.pos], self.own_goals[self.pos], self.pooled[self.pos] = step.goals, step.own_goals, step.pooled
        self.manager_values[self.pos] = step.manager_values
        self.manager_rewards[self.pos] = as_tensor(rewards)
        self.ends[self.pos] = th.from_numpy(np.asarray(dones, bool))

    def sequences(self) -> tuple[NDArray[np.int64], th.Tensor]:
        """Cut sequences where episodes begin and where Manager's state was stored.

        Returns bounds (s, 2) in increasing order, and the state of the dilated LSTM before each (s, 2, r, d).
        """
        steps, every = self.buffer_size, self.sequence_length
        cuts = self.episode_starts.astype(bool) | (np.arange(steps) % every == 0)[:, None]
        found = [b for i in range(self.n_envs) for b in sequence_bounds(cuts[:, i], i * steps, every)]
        bounds = np.array(found, np.int64)
        env, step = np.divmod(bounds[:, 0], steps)
        # Where none was stored an episode begins, in an empty state.
        stored = th.from_numpy(step % every == 0)[:, None, None, None]
        return bounds, self.manager_states[step // every, env] * stored


@dataclass
class FunRollout(Rollout):
    """What Worker learns from, and what Manager learns from beside it."""

    pooled: th.Tensor  # sum of the last c goals at each step, (m, d)
    directions: th.Tensor  # s_{t+c} - s_t, (m, d)
    known: th.Tensor  # whether the rollout goes far enough to know the direction, (m,)
    old_cosines: th.Tensor  # cosine between the direction and the goal that Manager set, (m,)
    manager_advantages: th.Tensor  # A^M, (m,)
    manager_returns: th.Tensor  # (m,)
    clock: th.Tensor  # steps since the episode began, (m,)
    manager_states: th.Tensor  # state of the dilated LSTM before each sequence, (s, 2, r, d)
    intrinsic: th.Tensor  # r^I, not yet weighted, (m,)
    manager_explained: float  # explained variance of V^M

    def states_before(self, first: th.Tensor) -> th.Tensor:
        """Return the dilated LSTM's states (n, 2, r, d) before the sequences that begin at transitions ``first``."""
        return self.manager_states[np.searchsorted(self.bounds[:, 0], first.numpy())]


def intrinsic_rewards(
    states: th.Tensor, following: th.Tensor, goals: th.Tensor, clock: th.Tensor, horizon: int
) -> th.Tensor:
    """Return Eq. 8: r^I = 1/c sum_{i=1..c} cos(s_t - s_{t-i}, g_{t-i}), of the steps that led to s_t.

    Terms that would reach back before the episode are left out of the sum, which is divided by c all the same. The
    ``states`` (c - 1 + t, n, d) begin c - 1 steps before the rollout, as the goals do that were sent to Worker at them;
    ``following`` (t, n, d) are those that each step led to, an episode's last one included. The result is (t, n), in
    [-1, 1]; ``clock`` (t, n) counts steps since the episode began, and c is ``horizon``.
    """
    steps = len(following)
    total = th.zeros(clock.shape)
    for back in range(horizon):  # i - 1: how many steps before this one the goal was set
        first = horizon - 1 - back
        moved = following - states[first : first + steps]
        cosine = functional.cosine_similarity(moved, goals[first : first + steps], dim=-1)
        total += th.where(clock >= back, cosine, 0.0)
    return total / horizon


def directions(states: th.Tensor, following: th.Tensor, ends: th.Tensor, horizon: int) -> tuple[th.Tensor, th.Tensor]:
    """Return Eq. 7's s_{t+c} - s_t, as data: no gradient flows through it, which would let Manager move s itself.

    An episode that ends within c steps gives the way to its last state. Where the rollout ends within c steps the rest
    of the way is not known yet, and Manager does not learn from the step. Takes s_t and the states that each step led
    to (t, n, d), and with which steps episodes ended (t, n). Returns differences (t, n, d), and which are known (t, n).
    """
    steps, count = ends.shape
    now = th.arange(steps)[:, None]
    first_end = th.where(ends, now, steps).flip(0).cummin(0).values.flip(0)  # at or after each step; none is `steps`
    until = th.minimum(now + horizon - 1, first_end)
    known = until < steps
    reached = following[until.clamp(max=steps - 1), th.arange(count)]
    return (reached - states).detach(), known
