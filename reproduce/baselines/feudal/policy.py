"""Acting with a trained FuN policy, and reading it from a run folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch as th
from numpy.typing import NDArray

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.feudal.network import FunNetwork, FunSpec
from reproduce.learning.config import PolicyConfig
from reproduce.learning.policy import Actions, MirroredPolicy, Observations
from reproduce.storage.policies import load_networks, load_policy_config

LEVEL = "fun"  # name of the one learner, in checkpoints and run folders


class FunPolicy(MirroredPolicy):
    """Manager and Worker, both acting every step, with no random goals."""

    def __init__(self, network: FunNetwork, mirrored: bool = True, deterministic: bool = True) -> None:
        """Make a policy, by Worker's mean if ``deterministic``, that acts in no environment yet."""
        super().__init__(mirrored)
        self.network, self._deterministic = network, deterministic

    def begin(self, count: int) -> None:
        """Begin with empty memories of ``count`` environments; see ``MirroredPolicy``."""
        self._memory = self.network.empty_memory(count)

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return Worker's actions (n, 11); see ``MirroredPolicy``."""
        self._memory.forget(th.from_numpy(np.asarray(starts, bool)))
        step = self.network.step(th.from_numpy(observations), self._memory, self._deterministic)
        actions: Actions = step.actions.numpy()
        return actions


def load_feudal_policy(folder: Path) -> FunPolicy:
    """Read the policy of a run folder; see ``load_networks``."""
    networks = load_networks(folder, {LEVEL: (SIZE, JOINTS)}, FunSpec)
    return FunPolicy(networks[LEVEL], load_policy_config(folder, PolicyConfig).mirrored)
