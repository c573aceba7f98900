"""Train HRL-DCS with stock parts: SB3's SubprocVecEnv and sb3-contrib's RecurrentPPO, to compare our parts' speed with.

The same environments, networks, rollouts, batches and epochs; only who steps and who learns differ. It is for ``bench``
alone: SGN's decisions are cut to a rectangle, as a stock buffer wants, so it is not meant to learn well.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue import LunarRescueEnv
from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.config import HierarchicalConfig
from reproduce.hrl_dcs.subgoal_env import SubGoalVecEnv
from reproduce.hrl_dcs.subgoals import RescueGoals
from reproduce.learning.networks import flat_spaces
from reproduce.learning.training import OnlySpaces, make_learner, start_collecting
from reproduce.learning.worker_process import TERMS


class FlatEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The environment with its flat observation, as SB3's vectorised environments want it."""

    env: LunarRescueEnv

    def __init__(self) -> None:
        super().__init__(LunarRescueEnv())
        self.observation_space = spaces.Box(-BOUND, BOUND, (SIZE,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)

    def reset(self, **arguments: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode on a training scene."""
        return self.env.reset_flat(None, arguments.get("options"))

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one step with joint actions (JOINTS,)."""
        return self.env.step_flat(action)


class TermsFromInfos(VecEnvWrapper):
    """Gather the reward terms of the last step from infos into ``terms`` (n, len(TERMS)), which our workers share."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.terms = np.zeros((venv.num_envs, len(TERMS)), np.float32)

    def reset(self) -> Any:
        """Begin an episode in each environment."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step and gather its terms."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self.terms[:] = [[info["reward_terms"][name] for name in TERMS] for info in infos]
        return observations, rewards, dones, infos


class StockTraining:
    """Train HRL-DCS with stock parts; ``update`` is one rollout and one training of each layer."""

    def __init__(self, config: HierarchicalConfig, seed: int) -> None:
        self.config = config
        venv = TermsFromInfos(SubprocVecEnv([FlatEnv] * config.n_envs, start_method="forkserver"))
        self.rows = config.low.n_steps // config.hierarchy.interval - 1
        make = partial(make_learner, seed=seed, kind=RecurrentPPO)
        goals = RescueGoals(config.goals, config.priors)
        high_env = OnlySpaces(config.n_envs, venv.observation_space, flat_spaces(1, goals.outputs)[1])
        self.sgn: Any = make(high_env, replace(config.high, n_steps=self.rows), bounded_mean=True)
        self.env = SubGoalVecEnv(venv, self.sgn.policy, goals, config)
        self.lln: Any = make(self.env, config.low, bounded_mean=False)
        self._callback = start_collecting(self.lln, config.steps)

    def collect(self) -> None:
        """Take one rollout into LLN's buffer."""
        self.lln.collect_rollouts(self.env, self._callback, self.lln.rollout_buffer, self.config.low.n_steps)

    def update(self) -> None:
        """Take one rollout and train both layers on it."""
        self.collect()
        self.lln.train()
        fill_buffer(self.sgn.rollout_buffer, self.env, self.rows)
        self.sgn.train()

    def close(self) -> None:
        """Stop the environments and their processes."""
        self.env.close()


def fill_buffer(buffer: RecurrentRolloutBuffer, env: SubGoalVecEnv, rows: int) -> None:
    """Fill a stock buffer with SGN's first decisions of every environment; a last one stays, as its return is open."""
    histories = env.high.decisions
    buffer.reset()
    for row in range(rows):
        at = [decisions[min(row, len(decisions) - 1)] for decisions in histories]
        hidden = th.from_numpy(np.stack([d.hidden for d in at])).unsqueeze(0)
        pair = (hidden[:, :, 0].contiguous(), hidden[:, :, 1].contiguous())
        buffer.add(
            np.stack([d.observation for d in at]),
            np.stack([d.output for d in at]),
            np.array([d.reward for d in at], np.float32),
            np.array([d.start for d in at], np.float32),
            th.tensor([d.value for d in at]),
            th.tensor([d.log_prob for d in at]),
            lstm_states=RNNStates(pair, pair),
        )
    buffer.compute_returns_and_advantage(th.zeros(len(histories)), np.zeros(len(histories)))
    for index, decisions in enumerate(histories):
        histories[index] = decisions[-1:]


def copy_rollout(source: RecurrentRolloutBuffer, target: RecurrentRolloutBuffer) -> None:
    """Copy a rollout's transitions into another learner's buffer."""
    for name, value in vars(source).items():
        if isinstance(value, np.ndarray):
            setattr(target, name, value.copy())
    target.pos, target.full, target.generator_ready = source.pos, source.full, False
