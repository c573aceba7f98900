"""`ppo_lstm`: one recurrent PPO network on the environment's own reward; shows what the hierarchy adds."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue.env import OUTCOME
from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.training import make_learner
from reproduce.learning.actions import to_environment
from reproduce.learning.config import TrainingConfig
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.training import RecurrentTraining, make_environments
from reproduce.learning.workers import RETURN
from reproduce.storage.policies import NetworkSpec


class EpisodeLog(VecEnvWrapper):
    """Adds up the environment's reward of each episode."""

    def __init__(self, venv: Any) -> None:
        """Wrap environments."""
        super().__init__(venv)
        self.episodes: list[dict[str, Any]] = []
        self._totals = np.zeros((self.num_envs, 2))

    def reset(self) -> Any:
        """Begin new episodes."""
        self._totals[:] = 0.0
        self._last: Any = self.venv.reset()
        return self._last

    def step_async(self, actions: Any) -> None:
        """Send the network's outputs on as Eq. 3's actions."""
        self.venv.step_async(to_environment(self._last, actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Step and keep what ended."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._totals += np.column_stack([rewards, np.ones(self.num_envs)])
        for index in np.flatnonzero(dones):
            episode = {k: infos[index][k] for k in OUTCOME}
            total, steps = self._totals[index]
            total = infos[index].get(RETURN, total)
            self.episodes.append({**episode, "exr": total, "inr": float("nan"), "steps": steps})
            self._totals[index] = 0.0
        self._last = observations
        return observations, rewards, dones, infos


class FlatTraining(RecurrentTraining):
    """Trains one recurrent network."""

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        """Start environments and learner."""
        venv = make_environments(config, seed)
        env = EpisodeLog(venv)
        self.learner = make_learner(env, config.low, seed, bounded_mean=False)
        super().__init__(config, venv, env, self.learner, {"policy": self.learner})

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn; ``done`` steps were taken before."""
        self.collect(done)
        self.learner.train()
        return self.row()

    def networks(self) -> dict[str, tuple[NetworkSpec, RecurrentNetwork]]:
        """The one network; see ``Training``."""
        return {"policy": (NetworkSpec(SIZE, JOINTS, self.config.low.hidden_units, False), self.learner.policy)}
