"""The two networks of Fig. 3, side by side: SGN sets sub-goals, LLN moves joints. Both hold an LSTM.

```
SGN  s_t, I            -> encoder (tanh) -> LSTM -> fully connected -> tanh -> sub-goal g_t of the two arm ends
LLN  s_t, g_t, a_{t-1} -> encoder (tanh) -> LSTM -> fully connected -> joint action a_t
```
Task code I and previous action a_{t-1} are part of the observation. Each has a feed-forward critic of its own.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from lunar_rescue.scenes.records import checked
from reproduce.storage.policies import Spec

Floats = NDArray[np.float32]
LIMIT = 5.0  # standard deviations
LEAST_DEVIATION = 0.01  # in the observation's units; what hardly varies is not blown up further


def flat_spaces(observations: int, actions: int) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of observations (observations,), without bounds, and of actions (actions,) in [-1, 1]."""
    return spaces.Box(-np.inf, np.inf, (observations,), np.float32), spaces.Box(-1.0, 1.0, (actions,), np.float32)


def flat_box(name: str, space: spaces.Space[Any]) -> spaces.Box:
    """Return a space that is a Box of one dimension; any other is a ``ValueError`` with its name."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"{name}: expected a Box of one dimension, got {space}")
    return space


class Standardiser(nn.Module):
    """Subtracts the mean and divides by the standard deviation of the observations of past rollouts.

    Distances of centimetres decide here, beside coordinates of metres: without it learning is several times slower
    (see the training log). The statistics are buffers, so they travel with the weights. It begins as the identity.
    """

    mean: th.Tensor
    variance: th.Tensor
    count: th.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(size))
        self.register_buffer("variance", th.ones(size))
        self.register_buffer("count", th.zeros(1))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Standardise observations (..., d), within ``LIMIT`` deviations."""
        scaled = (observations - self.mean) / th.sqrt(self.variance + LEAST_DEVIATION**2)
        return th.clamp(scaled, -LIMIT, LIMIT)

    @th.no_grad()
    def observe(self, observations: th.Tensor) -> None:
        """Take the observations of a rollout (m, d) into the statistics (Chan's parallel update)."""
        new, mean, variance = float(len(observations)), observations.mean(0), observations.var(0, unbiased=False)
        old = float(self.count)
        total, delta = old + new, mean - self.mean
        spread = self.variance * old + variance * new + delta**2 * old * new / total
        self.mean += delta * new / total
        self.variance.copy_(spread / total)
        self.count.fill_(total)


def observe_all(network: nn.Module, observations: Floats) -> None:
    """Let every standardiser inside a network see the observations of a rollout (m, d)."""
    for module in network.modules():
        if isinstance(module, Standardiser):
            module.observe(th.from_numpy(observations))


class NoOptimizer:
    """Stands for the optimiser of a network that only acts, as PyTorch's first one imports a compiler for a second."""

    def __init__(self, parameters: Any, lr: float) -> None:
        """Take what SB3 hands to an optimiser, and keep nothing of it."""


class StateEncoder(BaseFeaturesExtractor):
    """Standardised observations through one fully connected layer, so that the LSTM sees features."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128) -> None:
        """Make the layer of ``features_dim`` units for flat observations (d,)."""
        super().__init__(observation_space, features_dim)
        size = observation_space.shape[0]
        self.layer = nn.Sequential(Standardiser(size), nn.Linear(size, features_dim), nn.Tanh())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (n, d) as features (n, features_dim)."""
        encoded: th.Tensor = self.layer(observations)
        return encoded


class RecurrentNetwork(RecurrentActorCriticPolicy):
    """Encoder, LSTM and a fully connected layer; Gaussian actions (see the assumptions on the paper's softmax)."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        hidden_units: int = 128,
        bounded_mean: bool = False,
        **kwargs: Any,
    ) -> None:
        """Build it with ``hidden_units`` in every layer and the LSTM; with ``bounded_mean`` the mean passes a tanh."""
        encoder = {
            "features_extractor_class": StateEncoder,
            "features_extractor_kwargs": {"features_dim": hidden_units},
        }
        kwargs |= {"share_features_extractor": False, "enable_critic_lstm": False, **encoder}
        sizes: Any = {"net_arch": [hidden_units], "lstm_hidden_size": hidden_units}
        super().__init__(observation_space, action_space, lr_schedule, **sizes, **kwargs)
        if bounded_mean:
            self.action_net = nn.Sequential(self.action_net, nn.Tanh())
        make_optimizer: Any = self.optimizer_class
        self.optimizer = make_optimizer(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


@checked
@dataclass(frozen=True)
class NetworkSpec(Spec):
    """All that is needed to build a ``RecurrentNetwork``."""

    bounded_mean: bool  # Whether the mean passes a tanh

    def build(self) -> RecurrentNetwork:
        """Make a network of these sizes, not trained, to act or to imitate."""
        seen, acts = flat_spaces(self.observations, self.actions)
        more: Any = {"optimizer_class": NoOptimizer}
        return RecurrentNetwork(seen, acts, lambda _: 0.0, self.hidden_units, self.bounded_mean, **more)


class Memory:
    """LSTM states of one network in several environments, and what the network puts out from them."""

    def __init__(self, network: RecurrentNetwork, count: int) -> None:
        """Begin with empty states of ``count`` environments."""
        self._network = network
        self._states = th.zeros(2, 1, count, network.lstm_actor.hidden_size)  # hidden and cell state

    def copy(self) -> "Memory":
        """Return a memory that goes on from the same states by itself."""
        other = Memory(self._network, self._states.shape[2])
        other._states.copy_(self._states)
        return other

    def forget(self, starts: NDArray[np.bool_]) -> None:
        """Empty the states of environments (n,) that begin an episode."""
        self._states[:, :, th.from_numpy(np.asarray(starts, bool))] = 0.0

    @th.no_grad()
    def act(self, observations: Floats, rows: NDArray[np.int64]) -> Floats:
        """Return the means (m, a), cut to [-1, 1], for observations (m, d) of environments ``rows`` (m,)."""
        index = th.from_numpy(rows)
        hidden, cell = self._states[:, :, index]
        distribution, after = self._network.get_distribution(
            th.from_numpy(observations), (hidden, cell), th.zeros(len(rows))
        )
        self._states[:, :, index] = th.stack(after)
        return np.clip(distribution.get_actions(deterministic=True).numpy(), -1.0, 1.0)

    @th.no_grad()
    def draw(self, observations: Floats, rows: NDArray[np.int64]) -> tuple[Floats, Floats, Floats, Floats]:
        """Draw outputs (m, a) for observations (m, d) of environments ``rows`` (m,).

        Returned with the logarithms of their probability density (m,), values (m,) and the states before (m, 2, h).
        """
        index = th.from_numpy(rows)
        hidden, cell = self._states[:, :, index]
        states = RNNStates((hidden, cell), (hidden, cell))
        outputs, values, log_probs, after = self._network(th.from_numpy(observations), states, th.zeros(len(rows)))
        self._states[:, :, index] = th.stack(after.pi)
        before = th.stack([hidden[0], cell[0]], dim=1)
        return outputs.numpy(), log_probs.numpy(), values.flatten().numpy(), before.numpy()
