"""HRL-DCS: both layers trained together on the same steps.

One rollout of LLN's feeds both: LLN learns from every step with INR, SGN from every N steps with the summed EXR.
"""

from typing import Any

import numpy as np

from reproduce.hrl_dcs.config import HierarchicalConfig
from reproduce.hrl_dcs.goals import Goals
from reproduce.hrl_dcs.subgoal_env import SubGoalVecEnv
from reproduce.hrl_dcs.subgoals import RescueGoals
from reproduce.learning.networks import NetworkSpec, RecurrentNetwork, flat_spaces
from reproduce.learning.training import OnlySpaces, RecurrentTraining, make_environments, make_learner


class TwoLayerTraining(RecurrentTraining):
    """Trains SGN and LLN over any environments; one ``update`` is one rollout and one training of each."""

    config: HierarchicalConfig
    env: SubGoalVecEnv

    def __init__(self, venv: Any, goals: Goals, config: HierarchicalConfig, seed: int) -> None:
        """Make both learners for ``config.n_envs`` environments with flat observations; ``seed`` is the networks'."""
        self.goals = goals
        high_env = OnlySpaces(config.n_envs, venv.observation_space, flat_spaces(1, goals.outputs)[1])
        self.sgn = make_learner(high_env, config.high, seed, bounded_mean=True)
        env = SubGoalVecEnv(venv, self.sgn.policy, goals, config)
        self.lln = make_learner(env, config.low, seed + 1, bounded_mean=False)
        super().__init__(config, venv, env, self.lln, {"sgn": self.sgn, "lln": self.lln})

    def update(self, done: int) -> dict[str, Any]:
        """Collect a rollout and learn from it; ``done`` steps were taken before."""
        self.env.cuts.clear()
        self.collect(done)
        self.lln.return_cuts = np.array(self.env.cuts)
        self.lln.train()
        if (done // self.steps_per_update + 1) % self.config.hierarchy.sgn_every == 0:
            high = self.config.high
            rollout = self.env.high.rollout(high.gamma, high.gae_lambda, high.sequence_length)
            if rollout is not None:  # what SGN decided since the last time
                self.sgn.external_rollout = rollout
                self.sgn.train()
        return self.row()

    def networks(self) -> dict[str, tuple[NetworkSpec, RecurrentNetwork]]:
        """Return both layers with their sizes; see ``Training``."""
        high, low, goals = self.config.high.hidden_units, self.config.low.hidden_units, self.goals
        observations = int(np.prod(self.venv.observation_space.shape or ()))
        return {
            "sgn": (NetworkSpec(observations, goals.outputs, high, bounded_mean=True), self.sgn.policy),
            "lln": (NetworkSpec(goals.view_size, goals.actions, low, bounded_mean=False), self.lln.policy),
        }


class HierarchicalTraining(TwoLayerTraining):
    """Trains SGN and LLN on the rescue."""

    def __init__(self, config: HierarchicalConfig, seed: int) -> None:
        goals = RescueGoals(config.n_envs, config.anchors, config.hierarchy.milestone_share)
        super().__init__(make_environments(config, seed), goals, config, seed)
