"""Acting with a trained two-layer policy: batched over environments, both memories kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from reproduce.hrl_dcs.subgoals import ENDS_SIZE, SUBGOAL_SIZE, Anchors, lln_observations
from reproduce.learning.actions import to_environment
from reproduce.learning.mirror import Mirror
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.policy import Actions, MirroredPolicy, Observations


class Memory:
    """LSTM states of one network for several environments."""

    def __init__(self, network: RecurrentNetwork, count: int) -> None:
        """Start empty."""
        self.network = network
        hidden = network.lstm_actor.hidden_size
        self._h, self._c = th.zeros(1, count, hidden), th.zeros(1, count, hidden)

    def act(
        self, observations: NDArray[np.float32], rows: NDArray[np.int64], deterministic: bool
    ) -> NDArray[np.float32]:
        """Actions for some of the environments."""
        index = th.from_numpy(rows)
        with th.no_grad():
            distribution, (h, c) = self.network.get_distribution(
                th.from_numpy(observations), (self._h[:, index], self._c[:, index]), th.zeros(len(rows))
            )
            self._h[:, index], self._c[:, index] = h, c
            chosen: NDArray[np.float32] = distribution.get_actions(deterministic=deterministic).numpy()
        return np.clip(chosen, -1.0, 1.0)

    def forget(self, starts: NDArray[np.bool_]) -> None:
        """Empty the memory of environments that begin an episode."""
        which = th.from_numpy(np.asarray(starts, bool))
        self._h[:, which] = 0.0
        self._c[:, which] = 0.0


class HierarchicalPolicy:
    """SGN every N steps, LLN every step (deterministic unless told otherwise)."""

    def __init__(
        self,
        sgn: RecurrentNetwork,
        lln: RecurrentNetwork,
        interval: int,
        subgoals: str,
        mirrored: bool = True,
        deterministic: bool = True,
    ) -> None:
        """Keep the networks.

        Args:
            sgn: High level.
            lln: Low level.
            interval: N.
            subgoals: What SGN's numbers mean, see ``reproduce.hrl_dcs.subgoals``.
            mirrored: Whether the networks see scenes through ``reproduce.learning.mirror``.
            deterministic: Whether both act by their means.
        """
        self.networks = (sgn, lln)
        self.interval, self.meaning, self.mirrored = interval, subgoals, mirrored
        self._deterministic = deterministic
        self._count = 0

    def _begin(self, count: int) -> None:
        self._count = count
        self._sgn, self._lln = (Memory(network, count) for network in self.networks)
        self._mirror = Mirror(count)
        self._anchors = Anchors(count, self.meaning, acting=True)
        self._left = np.zeros(count, np.int64)
        self._subgoals = np.zeros((count, SUBGOAL_SIZE), np.float32)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        if len(observations) != self._count:
            self._begin(len(observations))
        if self.mirrored:
            self._mirror.begin(observations, starts)
        observations = self._mirror.observations(observations)
        self._sgn.forget(starts)
        self._lln.forget(starts)
        self._left[starts] = 0
        self._anchors.update(observations, starts)
        rows = np.flatnonzero(self._left <= 0)
        if len(rows):
            self._subgoals[rows] = self.command(observations, rows)
            self._left[rows] = self.interval
        view = lln_observations(observations, self._subgoals, (self._left / self.interval).astype(np.float32))
        self._left -= 1
        outputs = self._lln.act(view, np.arange(len(observations)), self._deterministic)
        return self._mirror.actions(to_environment(observations, outputs))

    def command(self, observations: Observations, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """New sub-goals (len(rows), SUBGOAL_SIZE) [m] of some of the environments, by SGN."""
        outputs = np.zeros_like(self._subgoals)
        outputs[rows] = self._sgn.act(observations[rows], rows, self._deterministic)
        return self._anchors.subgoals(outputs)[rows]

    def overlay(self) -> dict[str, NDArray[Any]]:
        """The sub-goals in the base frame, (n, 2, 3) [m]."""
        return {"sub-goal": self._mirror.points(self._subgoals[:, :ENDS_SIZE].reshape(-1, 2, 3))}


class FlatPolicy(MirroredPolicy):
    """One recurrent network, acting every step."""

    def __init__(self, network: RecurrentNetwork, mirrored: bool = True, deterministic: bool = True) -> None:
        """Keep the network; see ``HierarchicalPolicy``."""
        super().__init__(mirrored)
        self._network, self._deterministic = network, deterministic

    def begin(self, count: int) -> None:
        """See ``MirroredPolicy``."""
        self._memory = Memory(self._network, count)

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``MirroredPolicy``."""
        self._memory.forget(starts)
        return self._memory.act(observations, np.arange(len(observations)), self._deterministic)
