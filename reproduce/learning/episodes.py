"""The view of the environments in which a flat learner collects: it sends changes as actions and sums up episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue.env import OUTCOME
from reproduce.learning.actions import to_environment
from reproduce.learning.workers import RETURN


class EpisodeLog(VecEnvWrapper):
    """Turns a network's outputs into Eq. 3's actions and adds up the environment's reward of each episode.

    Attributes:
        episodes: Outcome, return and steps of the episodes that ended; whoever reads the list empties it.
    """

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.episodes: list[dict[str, Any]] = []
        self._totals = np.zeros((self.num_envs, 2))  # reward, steps

    def reset(self) -> Any:
        """Begin new episodes in all environments; those under way are not listed."""
        self._totals[:] = 0.0
        self._last: Any = self.venv.reset()
        return self._last

    def step_async(self, actions: Any) -> None:
        """Send the network's outputs (n, 11) on as Eq. 3's actions."""
        self.venv.step_async(to_environment(self._last, actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the environments and list the episodes that ended."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._totals += np.column_stack([rewards, np.ones(self.num_envs)])
        for index in np.flatnonzero(dones):
            total, steps = self._totals[index]
            outcome = {key: infos[index][key] for key in OUTCOME}
            total = infos[index].get(RETURN, total)
            self.episodes.append({**outcome, "exr": total, "inr": float("nan"), "steps": steps})
            self._totals[index] = 0.0
        self._last = observations
        return observations, rewards, dones, infos
