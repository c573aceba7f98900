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
    """Turns a network's outputs into Eq. 3's actions and adds up the rewards of each episode."""

    def __init__(self, venv: Any, **spaces: Any) -> None:
        super().__init__(venv, **spaces)
        self.episodes: list[dict[str, Any]] = []  # outcome, returns and steps; whoever reads the list empties it
        self._totals = np.zeros((self.num_envs, 3))  # EXR, INR, steps

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
        self._last, rewards, dones, infos = self.venv.step_wait()
        self.add_up(rewards, np.full(self.num_envs, np.nan), dones, infos)
        return self._last, rewards, dones, infos

    def add_up(self, exr: Any, inr: Any, dones: Any, infos: list[dict[str, Any]]) -> None:
        """Add a step's rewards (n,), from outside and, where there are two layers, inside; list what ended."""
        self._totals += np.column_stack([exr, inr, np.ones(self.num_envs)])
        for index in np.flatnonzero(dones):
            info, totals = infos[index], dict(zip(("exr", "inr", "steps"), self._totals[index], strict=True))
            outcome = {key: info[key] for key in OUTCOME if key in info}
            self.episodes.append({**outcome, **totals, "exr": info.get(RETURN, totals["exr"])})
        self._totals[np.asarray(dones, bool)] = 0.0
