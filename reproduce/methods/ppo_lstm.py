"""`ppo_lstm`: one recurrent PPO network on the environment's own reward; shows what the hierarchy adds."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from reproduce.actions import to_environment
from reproduce.config import TrainingConfig
from reproduce.learners.sequence_ppo import SequencePPO
from reproduce.methods.hrl_dcs import make_learner
from reproduce.methods.stepping import episode_summary, follow_schedule, make_environments, start_collecting


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
            kept = ("is_success", "failure", "both_arms_under", "task", "posture")
            episode = {k: infos[index][k] for k in kept}
            total, steps = self._totals[index]
            self.episodes.append({**episode, "exr": total, "inr": float("nan"), "steps": steps})
            self._totals[index] = 0.0
        self._last = observations
        return observations, rewards, dones, infos


class FlatTraining:
    """Trains one recurrent network."""

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        """Start environments and learner."""
        self.config = config
        self.venv = make_environments(config, seed)
        self.env = EpisodeLog(self.venv)
        self.learner = make_learner(self.env, config.low, seed, bounded_mean=False)
        self.callback = start_collecting(self.learner, config.steps)

    @property
    def learners(self) -> dict[str, SequencePPO]:
        """The only level."""
        return {"policy": self.learner}

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.config.low.n_steps * self.config.n_envs

    def restart(self, update: int) -> None:
        """Begin new episodes with empty memories."""
        self.venv.restart(update)
        start_collecting(self.learner, self.config.steps, self.callback)

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn; ``done`` steps were taken before."""
        follow_schedule([self.learner], done / self.config.steps)
        self.learner.collect_rollouts(self.env, self.callback, self.learner.rollout_buffer, self.config.low.n_steps)
        self.learner.train()
        row = episode_summary(self.env.episodes)
        self.env.episodes = []
        for key in ("approx_kl", "explained_variance", "std", "value_loss"):
            row[f"policy_{key}"] = self.learner.logger.name_to_value.get(f"train/{key}", np.nan)
        return row

    def close(self) -> None:
        """Stop the environments."""
        self.venv.close()
