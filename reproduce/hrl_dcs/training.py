"""HRL-DCS: both layers trained together on the same steps.

One rollout of LLN's feeds both: LLN learns from every step with INR, SGN from every N steps with the summed EXR.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from reproduce.hrl_dcs.config import HierarchicalConfig
from reproduce.hrl_dcs.goals import Goals
from reproduce.hrl_dcs.hindsight import commanded, lln_example, reached, sgn_examples
from reproduce.hrl_dcs.subgoal_env import SubGoalVecEnv
from reproduce.hrl_dcs.subgoals import RescueGoals, arm_ends
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.networks import NetworkSpec, RecurrentNetwork, flat_spaces
from reproduce.learning.training import OnlySpaces, RecurrentTraining, imitate, make_environments, make_learner


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
        self.rescue_goals = RescueGoals(config.goals, config.priors, config.seen_places)
        super().__init__(make_environments(config, seed), self.rescue_goals, config, seed)

    def imitate(self, played: Sequence[PlayedBack], seed: int) -> Iterator[dict[str, Any]]:
        """Imitate demonstrations, SGN first; see ``Training`` and ``reproduce.hrl_dcs.hindsight``."""
        goals, interval, config = self.rescue_goals, self.config.hierarchy.interval, self.config.imitation
        places = [example for one in played for example in sgn_examples(goals, one, interval)]
        yield from imitate("sgn", self.sgn.policy, places, config, seed)
        hindsight = [reached(arm_ends(one.observations), interval) for one in played]
        versions = (hindsight, commanded(self.sgn.policy, goals, played, interval))
        moves = [lln_example(goals, *pair) for subgoals in versions for pair in zip(played, subgoals, strict=True)]
        yield from imitate("lln", self.lln.policy, moves, config, seed + 1)
