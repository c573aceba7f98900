"""Manager and Worker, side by side (Fig. 1 of Vezhnevets et al. 2017; equation numbers are that paper's).

```
percept  x_t -> standardise -> tanh layer                      -> z_t                       (Eq. 1, shared)
Manager  z_t -> ReLU layer -> s_t -> dilated LSTM -> normalise -> g_t                       (Eq. 2, 3)
Worker   z_t -> LSTM -> U_t;  last c goals -> sum -> phi -> w_t;  mean action U_t w_t       (Eq. 4 to 6)
```
FuN's softmax over U_t w_t becomes a Gaussian with mean U_t w_t and a standard deviation that knows no state; phi has no
bias, so a zero goal gives a zero mean action. Worker gets goals as data: no gradient of its loss reaches Manager.
"""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn
from torch.nn import functional

from reproduce.learning.networks import StateEncoder


class DilatedLSTM(nn.Module):
    """r groups of LSTM state with shared weights; at step t group t mod r alone moves.

    The output (d,) is the sum of all groups' hidden states, which are the outputs of the last r steps.
    """

    def __init__(self, inputs: int, units: int, groups: int) -> None:
        super().__init__()
        self.groups = groups
        self.core = nn.LSTM(inputs, units)

    def step(self, inputs: th.Tensor, state: th.Tensor, clock: th.Tensor) -> th.Tensor:
        """Take one step, from inputs (n, i) to (n, d), and change ``state`` (n, 2, r, d) in place; ``clock`` is t."""
        rows, group = th.arange(inputs.shape[0]), clock % self.groups
        hidden, cell = state[rows, 0, group], state[rows, 1, group]
        _, (hidden, cell) = self.core(inputs[None], (hidden[None], cell[None]))
        state[rows, 0, group], state[rows, 1, group] = hidden[0], cell[0]
        return state[:, 0].sum(1)

    def forward(self, inputs: th.Tensor, state: th.Tensor, clock: th.Tensor) -> th.Tensor:
        """Map whole sequences (l, n, i) to (l, n, d) in one LSTM call.

        Each group sees every r-th input only, so the groups are r independent LSTMs over sequences of a r-th of the
        length: they are laid beside each other like so many sequences more. Each sequence lies within one episode;
        ``state`` (n, 2, r, d) is before its first step, ``clock`` (n,) is t there.
        """
        length, count, _ = inputs.shape
        r, rounds = self.groups, -(-length // self.groups)
        padded = functional.pad(inputs, (0, 0, 0, 0, 0, rounds * r - length))
        order = (clock[:, None] + th.arange(r)) % r  # group j moves at the j-th step from here
        ordered = state[th.arange(count)[:, None], :, order].permute(2, 1, 0, 3)  # (2, r, n, d)
        hidden, cell = ordered.reshape(2, 1, r * count, -1)
        outputs, _ = self.core(padded.reshape(rounds, r * count, -1), (hidden, cell))
        # What the groups hold at first are the outputs of the r steps before, the oldest first.
        outputs = th.cat([ordered[0], outputs.reshape(rounds * r, count, -1)[:length]])
        summed = outputs.cumsum(0)
        return summed[r:] - summed[:length]


class Critic(nn.Module):
    """A value from the observation and, as data, from what a level remembers.

    FuN's critics sit on the levels' own networks; a critic of its own keeps the value loss out of them, as in the other
    methods here. What the level remembers still reaches it.
    """

    def __init__(self, observation_space: spaces.Box, memory_size: int, hidden_units: int) -> None:
        super().__init__()
        self.encoder = StateEncoder(observation_space, hidden_units)
        layer = nn.Linear(hidden_units + memory_size, hidden_units)
        self.head = nn.Sequential(layer, nn.Tanh(), nn.Linear(hidden_units, 1))
        self.apply(lambda module: BasePolicy.init_weights(module, gain=float(np.sqrt(2.0))))
        BasePolicy.init_weights(self.head[-1], gain=1.0)

    def forward(self, observations: th.Tensor, memory: th.Tensor) -> th.Tensor:
        """Estimate values (m,) from observations (m, o) and what the level remembers (m, memory_size)."""
        values: th.Tensor = self.head(th.cat([self.encoder(observations), memory.detach()], dim=-1))
        return values.squeeze(-1)


class Manager(nn.Module):
    """Sets goals: directions in its own space of states."""

    def __init__(self, observation_space: spaces.Box, hidden_units: int, goal_size: int, horizon: int) -> None:
        super().__init__()
        self.horizon = horizon
        self.space = nn.Sequential(nn.Linear(hidden_units, goal_size), nn.ReLU())
        self.space.apply(lambda module: BasePolicy.init_weights(module, gain=float(np.sqrt(2.0))))
        self.core = DilatedLSTM(goal_size, goal_size, horizon)
        self.critic = Critic(observation_space, goal_size, hidden_units)

    def value(self, observations: th.Tensor, raw_goals: th.Tensor) -> th.Tensor:
        """Return V^M (m,); the raw goals (m, d) are sums of r outputs in (-1, 1)."""
        values: th.Tensor = self.critic(observations, raw_goals / self.horizon)
        return values


class Worker(nn.Module):
    """Acts towards the goals that it is given."""

    def __init__(
        self,
        observation_space: spaces.Box,
        actions: int,
        hidden_units: int,
        goal_size: int,
        embedding: int,
        horizon: int,
    ) -> None:
        super().__init__()
        self._shape, self._horizon = (actions, embedding), horizon
        self.core = nn.LSTM(hidden_units, hidden_units)
        self.embeddings = nn.Linear(hidden_units, actions * embedding)
        self.phi = nn.Linear(goal_size, embedding, bias=False)
        BasePolicy.init_weights(self.embeddings, gain=0.01)  # small mean actions at first, as SB3's are
        BasePolicy.init_weights(self.phi, gain=1.0)
        self.critic = Critic(observation_space, hidden_units + goal_size, hidden_units)

    def mean(self, memory: th.Tensor, pooled: th.Tensor) -> th.Tensor:
        """Return Eq. 4 and 6's U_t w_t (m, a) from Worker's LSTM (m, h) and the sum of the last c goals (m, d)."""
        embeddings = self.embeddings(memory).view(-1, *self._shape)
        w: th.Tensor = self.phi(pooled.detach())
        return (embeddings @ w[:, :, None]).squeeze(-1)

    def value(self, observations: th.Tensor, memory: th.Tensor, pooled: th.Tensor) -> th.Tensor:
        """Return V^D (m,), which knows the goals, as the intrinsic reward depends on them."""
        values: th.Tensor = self.critic(observations, th.cat([memory, pooled / self._horizon], dim=-1))
        return values
