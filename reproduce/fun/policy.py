"""Acting with a trained FuN policy, and reading it from a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from reproduce.actions import to_environment
from reproduce.fun.network import FunNetwork, FunSpec, Memory
from reproduce.mirror import Mirror
from reproduce.policy import Actions, Observations
from reproduce.run_folder import load_networks

LEVEL = "fun"  # name of the one learner, in checkpoints and run folders


class FunPolicy:
    """Manager and Worker, both acting every step, with no random goals."""

    def __init__(self, network: FunNetwork, mirrored: bool = True, deterministic: bool = True) -> None:
        """Keep the network.

        Args:
            network: Trained.
            mirrored: Whether it sees scenes through ``reproduce.mirror``.
            deterministic: Whether Worker acts by its mean.
        """
        self.network, self.mirrored, self._deterministic = network, mirrored, deterministic
        self._memory: Memory | None = None

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        if self._memory is None or len(self._memory.clock) != len(observations):
            self._memory, self._mirror = self.network.empty_memory(len(observations)), Mirror(len(observations))
        self._memory.forget(th.from_numpy(np.asarray(starts, bool)))
        if self.mirrored:
            self._mirror.begin(observations, starts)
        seen = self._mirror.observations(observations)
        outputs = self.network.step(th.from_numpy(seen), self._memory, self._deterministic).actions.numpy()
        return self._mirror.actions(to_environment(seen, outputs))

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Nothing to draw: goals are directions in a space that only Manager knows."""
        return {}


def load_network(folder: Path, sizes: tuple[int, int]) -> FunNetwork:
    """The network of a run folder whose observation and action have these sizes; see ``load_networks``."""
    network = load_networks(folder, {LEVEL: sizes}, FunSpec)[LEVEL]
    assert isinstance(network, FunNetwork)
    return network
