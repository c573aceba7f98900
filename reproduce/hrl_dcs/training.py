"""HRL-DCS: both layers trained together on the same steps.

One rollout of LLN's feeds both: LLN learns from every step with INR, SGN from every N steps with the summed EXR.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.logger import Logger

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.goals import Goals, RescueGoals
from reproduce.hrl_dcs.subgoal_env import SubGoalVecEnv
from reproduce.hrl_dcs.subgoals import LLN_SIZE, SUBGOAL_SIZE
from reproduce.learning.config import LearnerConfig, TrainingConfig
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.training import (
    OnlySpaces,
    RecurrentTraining,
    make_environments,
    own_arguments,
    stock_arguments,
)
from reproduce.storage.policies import NetworkSpec


def make_learner(
    env: Any, config: LearnerConfig, seed: int, bounded_mean: bool, kind: type[RecurrentPPO] = SequencePPO
) -> Any:
    """One recurrent PPO learner as SB3 knows it; ``kind`` is ours or, to compare with, the stock one."""
    learner = kind(
        RecurrentNetwork,
        env,
        policy_kwargs={
            "hidden_units": config.hidden_units,
            "bounded_mean": bounded_mean,
            "log_std_init": config.log_std_init,
        },
        seed=seed,
        **stock_arguments(config),
        **(own_arguments(config) if issubclass(kind, SequencePPO) else {}),
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


def sub_goal_view(venv: Any, sgn: RecurrentNetwork, goals: Goals, config: TrainingConfig) -> SubGoalVecEnv:
    """LLN's view of environments in which ``sgn`` sets the sub-goals."""
    h = config.hierarchy
    return SubGoalVecEnv(venv, sgn, goals, h.interval, h.beta, h.form, config.high.gamma)


def rescue_goals(config: TrainingConfig) -> RescueGoals:
    """Sub-goals of the rescue."""
    h = config.hierarchy
    return RescueGoals(config.n_envs, h.subgoals, h.pose_share, h.milestone_share)


def sgn_space(goals: Goals) -> spaces.Box:
    """What SGN puts out."""
    return spaces.Box(-1.0, 1.0, (goals.outputs,), np.float32)


class TwoLayerTraining(RecurrentTraining):
    """Trains SGN and LLN over any environments; one ``update`` is one rollout and one training of each."""

    env: SubGoalVecEnv

    def __init__(self, venv: Any, goals: Goals, config: TrainingConfig, seed: int) -> None:
        """Make both learners.

        Args:
            venv: ``config.n_envs`` environments with flat observations.
            goals: What a sub-goal is in them.
            config: The configuration.
            seed: Of networks and minibatches.
        """
        high_env = OnlySpaces(venv.observation_space, sgn_space(goals), config.n_envs)
        self.sgn = make_learner(high_env, config.high, seed, bounded_mean=True)
        env = sub_goal_view(venv, self.sgn.policy, goals, config)
        self.lln = make_learner(env, config.low, seed + 1, bounded_mean=False)
        super().__init__(config, venv, env, self.lln, {"sgn": self.sgn, "lln": self.lln})

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn; ``done`` steps were taken before."""
        self.env.cuts.clear()
        self.collect(done)
        self.lln.return_cuts = np.array(self.env.cuts)
        self.lln.train()
        if (done // self.steps_per_update + 1) % self.config.hierarchy.sgn_every == 0:
            self._train_sgn(done)
        return self.row()

    def _train_sgn(self, done: int) -> None:
        """On what it decided since the last time."""
        high = self.config.high
        rollout = self.env.recorder.rollout(high.gamma, high.gae_lambda, high.sequence_length)
        if rollout is not None and done >= self.config.hierarchy.warmup * self.config.steps:
            self.sgn.external_rollout = rollout
            self.sgn.train()


class HierarchicalTraining(TwoLayerTraining):
    """Of the rescue."""

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        """Start environments and learners."""
        super().__init__(make_environments(config, seed), rescue_goals(config), config, seed)

    def networks(self) -> dict[str, tuple[NetworkSpec, RecurrentNetwork]]:
        """Both layers; see ``Training``."""
        high, low = self.config.high.hidden_units, self.config.low.hidden_units
        return {
            "sgn": (NetworkSpec(SIZE, SUBGOAL_SIZE, high, bounded_mean=True), self.sgn.policy),
            "lln": (NetworkSpec(LLN_SIZE, JOINTS, low, bounded_mean=False), self.lln.policy),
        }

    def policy_metadata(self) -> dict[str, Any]:
        """N and what sub-goals mean."""
        return {"interval": self.config.hierarchy.interval, "subgoals": self.config.hierarchy.subgoals}
