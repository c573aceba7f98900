"""`fun`: Manager and Worker trained together on the environment's own reward, as `ppo_lstm` is."""

from __future__ import annotations

from typing import Any

from reproduce.baselines.feudal.config import FeudalConfig, FunConfig
from reproduce.baselines.feudal.learner import FunPPO
from reproduce.baselines.feudal.network import FunNetwork, FunSpec
from reproduce.baselines.feudal.policy import LEVEL
from reproduce.learning.config import LearnerConfig
from reproduce.learning.episodes import EpisodeLog
from reproduce.learning.training import RecurrentTraining, make_environments, make_learner


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
        env = EpisodeLog(venv)
        self.learner = make_fun_learner(env, config.low, config.fun, seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    def networks(self) -> dict[str, tuple[FunSpec, FunNetwork]]:
        """Return Manager and Worker, one network, with its sizes; see ``Training``."""
        return {LEVEL: (self.learner.policy.spec, self.learner.policy)}
