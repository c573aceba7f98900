"""Observations are standardised inside the network, by statistics that travel with its weights."""

from __future__ import annotations

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

LIMIT = 5.0  # standard deviations
LEAST_DEVIATION = 0.01  # in the observation's units; what hardly varies is not blown up further


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


def observe_all(network: nn.Module, observations: NDArray[np.float32]) -> None:
    """Let every standardiser inside a network see the observations of a rollout (m, d)."""
    for module in network.modules():
        if isinstance(module, Standardiser):
            module.observe(th.from_numpy(observations))
