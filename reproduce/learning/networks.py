"""The two networks of Fig. 3, side by side: SGN sets sub-goals, LLN moves joints. Both hold an LSTM.

```
SGN  s_t, I            -> encoder (tanh) -> LSTM -> fully connected -> tanh -> sub-goal g_t of the two arm ends
LLN  s_t, g_t, a_{t-1} -> encoder (tanh) -> LSTM -> fully connected -> joint action a_t
```
Task code I and previous action a_{t-1} are part of the observation. Each has a feed-forward critic of its own.
"""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from reproduce.learning.standardiser import Standardiser


class StateEncoder(BaseFeaturesExtractor):
    """Standardised observations through one fully connected layer, so that the LSTM sees features."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128) -> None:
        """Make the layer.

        Args:
            observation_space: Flat observations (d,).
            features_dim: Units.
        """
        super().__init__(observation_space, features_dim)
        size = observation_space.shape[0]
        self.layer = nn.Sequential(Standardiser(size), nn.Linear(size, features_dim), nn.Tanh())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(n, d) to (n, features_dim)."""
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
        """Build the network.

        Args:
            observation_space: Flat observations.
            action_space: Box in [-1, 1].
            lr_schedule: Learning rate.
            hidden_units: Units of every layer and of the LSTM; paper: 128.
            bounded_mean: Whether the mean passes a tanh, as SGN's sub-goals do.
            **kwargs: See SB3's policies.
        """
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[hidden_units],
            features_extractor_class=StateEncoder,
            features_extractor_kwargs={"features_dim": hidden_units},
            share_features_extractor=False,
            lstm_hidden_size=hidden_units,
            enable_critic_lstm=False,
            **kwargs,
        )
        if bounded_mean:
            self.action_net = nn.Sequential(self.action_net, nn.Tanh())
        make_optimizer: Any = self.optimizer_class
        self.optimizer = make_optimizer(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


def layer_table(network: nn.Module) -> list[dict[str, object]]:
    """Rows layer, kind, shape, parameters of a network, for notebooks."""
    rows = []
    for name, parameter in network.named_parameters():
        rows.append({"layer": name, "shape": tuple(parameter.shape), "parameters": parameter.numel()})
    return rows
