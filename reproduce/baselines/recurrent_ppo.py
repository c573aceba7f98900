"""`ppo_lstm`: one recurrent PPO network on the environment's own reward; shows what the hierarchy adds."""

from __future__ import annotations

from typing import Any

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.training import make_learner
from reproduce.learning.config import TrainingConfig
from reproduce.learning.episodes import EpisodeLog
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.training import RecurrentTraining, make_environments
from reproduce.storage.policies import NetworkSpec

LEVEL = "policy"  # name of the one learner, in checkpoints and run folders


class FlatTraining(RecurrentTraining):
    """Trains one recurrent network; an ``update`` is one rollout and one training on it."""

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        venv = make_environments(config, seed)
        env = EpisodeLog(venv)
        self.learner = make_learner(env, config.low, seed, bounded_mean=False)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    def update(self, done: int) -> dict[str, Any]:
        """Collect a rollout and learn from it; ``done`` steps were taken before."""
        self.collect(done)
        self.learner.train()
        return self.row()

    def networks(self) -> dict[str, tuple[NetworkSpec, RecurrentNetwork]]:
        """Return the one network with its sizes; see ``Training``."""
        return {LEVEL: (NetworkSpec(SIZE, JOINTS, self.config.low.hidden_units, False), self.learner.policy)}
