"""`fun`: Manager and Worker trained together on the environment's own reward, as `ppo_lstm` is, and acting."""

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from reproduce.baselines.feudal.learner import FunPPO
from reproduce.baselines.feudal.network import FeudalConfig, FunConfig, FunNetwork, FunSpec
from reproduce.learning.config import LearnerConfig, PolicyConfig
from reproduce.learning.policy import Actions, MirroredPolicy, Observations, load_only_network
from reproduce.learning.training import EpisodeLog, RecurrentTraining, make_environments, make_learner

LEVEL = "fun"  # name of the one learner, in checkpoints and run folders


class FunPolicy(MirroredPolicy):
    """Manager and Worker, both acting every step, with no random goals."""

    def __init__(self, network: FunNetwork, config: PolicyConfig, deterministic: bool = True) -> None:
        """Make a policy, by Worker's mean if ``deterministic``, that acts in no environment yet."""
        super().__init__(config)
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
    """Read the policy of a run folder; see ``load_only_network``."""
    return FunPolicy(*load_only_network(folder, LEVEL, FunSpec))


def make_fun_learner(env: Any, config: LearnerConfig, fun: FunConfig, seed: int) -> FunPPO:
    """Make FuN's learner for SB3's environments; ``config`` says what it shares with the other learners."""
    learner: FunPPO = make_learner(env, config, seed, kind=FunPPO, network=FunNetwork, fun=fun)
    return learner


class FunTraining(RecurrentTraining):
    """Trains Manager and Worker; an ``update`` is one rollout and one training of both on it."""

    config: FeudalConfig
    logged = (*RecurrentTraining.logged, "intrinsic", "goal_cosine", "manager_explained_variance")

    def __init__(self, config: FeudalConfig, seed: int) -> None:
        venv = make_environments(config, seed)
        env = EpisodeLog(venv, config.priors.set_point_changes)
        self.learner = make_fun_learner(env, config.low, config.fun, seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    def networks(self) -> dict[str, tuple[FunSpec, FunNetwork]]:
        """Return Manager and Worker, one network, with its sizes; see ``Training``."""
        return {LEVEL: (self.learner.policy.spec, self.learner.policy)}
