"""Vectorised environments as learners see them; apart from ``mirror`` and ``way_in``, as acting does without SB3."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue.physics.robot import JOINTS
from reproduce.learning.config import PlacesConfig
from reproduce.learning.mirror import Floats, Mirror, mirror_observations
from reproduce.learning.networks import flat_spaces
from reproduce.learning.way_in import WayIn, view_size
from reproduce.learning.workers import WorkerVecEnv


class MirroredVecEnv(VecEnvWrapper):
    """Vectorised environments in the learner's view of them."""

    venv: WorkerVecEnv

    def __init__(self, venv: WorkerVecEnv) -> None:
        super().__init__(venv)
        self._mirror = Mirror(venv.num_envs)
        self._everything = np.ones(venv.num_envs, bool)

    def reset(self) -> Floats:
        """Begin new episodes everywhere; return the first observations as the learner sees them."""
        observations = self.venv.reset()
        self._mirror.begin(observations, self._everything)
        return self._mirror.observations(observations)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Send Eq. 3's actions (n, JOINTS)."""
        self.venv.step_async(self._mirror.actions(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for all workers; an ended episode's last observation, in its info, is seen as the episode was."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for index in np.flatnonzero(dones):
            if self._mirror.mirrored[index]:
                last = infos[index]["terminal_observation"]
                infos[index]["terminal_observation"] = mirror_observations(last[None])[0]
        self._mirror.begin(observations, dones)
        return self._mirror.observations(observations), rewards, dones, infos


class WayInVecEnv(VecEnvWrapper):
    """Vectorised environments whose observations hold the way in, too."""

    venv: Any  # a WorkerVecEnv, or its mirrored view

    def __init__(self, venv: Any, config: PlacesConfig) -> None:
        """Wrap environments in the learner's view; see ``WayIn``."""
        super().__init__(venv, observation_space=flat_spaces(view_size(config), JOINTS)[0])
        self._way = WayIn(venv.num_envs, config)

    def reset(self) -> Floats:
        """Begin new episodes everywhere; return the first observations (n, SIZE or more)."""
        self._way.begin(np.ones(self.num_envs, bool))
        return self._way.view(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for all workers; an ended episode's last observation, in its info, is completed as well."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            infos[index]["terminal_observation"] = self._way.complete(last[None], [int(index)])[0]
        self._way.begin(dones)
        return self._way.view(observations), rewards, dones, infos


Environments = WorkerVecEnv | MirroredVecEnv | WayInVecEnv
