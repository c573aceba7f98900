"""SGN at work, at t = 0, N, 2N, ... of every episode, and acting with both layers, batched over environments."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.config import GoalConfig, HierarchicalPolicyConfig
from reproduce.hrl_dcs.goals import Floats, Goals
from reproduce.hrl_dcs.subgoals import SUBGOAL_SIZE, RescueGoals, lln_size
from reproduce.learning.config import PlacesConfig, PriorConfig
from reproduce.learning.networks import Memory, NetworkSpec, RecurrentNetwork
from reproduce.learning.policy import Actions, MirroredPolicy, Observations
from reproduce.learning.way_in import view_size
from reproduce.storage.policies import load_networks, load_policy_config


class HighLevel:
    """SGN with its clock, its memory and its present sub-goals (n, goals.size) in several environments."""

    def __init__(self, sgn: RecurrentNetwork, goals: Goals, interval: int, count: int) -> None:
        """Begin with empty memories of ``count`` environments, in which N is ``interval``."""
        self.memory, self.goals, self._interval = Memory(sgn, count), goals, interval
        self.subgoals = np.zeros((count, goals.size), np.float32)
        self.outputs = np.zeros((count, goals.outputs), np.float32)  # that commanded them
        self._left = np.zeros(count, np.int64)  # steps until the next sub-goal

    def advance(self, observations: Floats, starts: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Go on by one step, asking SGN for a sub-goal where one is due; return in which environments that was.

        ``starts`` (n,) says which environments begin an episode with these observations (n, d).
        """
        self._left -= 1
        self.goals.update(observations, starts)
        self.memory.forget(starts)
        rows = np.flatnonzero(starts | (self._left <= 0))
        if len(rows):
            self.outputs[rows] = self.command(observations[rows], rows, starts[rows])
            self.subgoals[rows] = self.goals.subgoals(self.outputs)[rows]
            self._left[rows] = self._interval
        return rows

    def command(self, observations: Floats, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> Floats:
        """Return SGN's outputs (m, goals.outputs) for environments ``rows`` (m,), here its means."""
        return self.memory.act(observations, rows)

    def view(self, observations: Floats) -> Floats:
        """Return what LLN sees of observations (n, d), (n, goals.view_size)."""
        return self.goals.view(observations, self.subgoals, (self._left / self._interval).astype(np.float32))


class HierarchicalPolicy(MirroredPolicy):
    """SGN every N steps, LLN every step, both by their means."""

    def __init__(
        self,
        sgn: RecurrentNetwork,
        lln: RecurrentNetwork,
        config: HierarchicalPolicyConfig,
        make_goals: Callable[[GoalConfig, PriorConfig, PlacesConfig | None], RescueGoals] = RescueGoals,
    ) -> None:
        """Make a policy that acts in no environment yet; ablations make other sub-goals of SGN's outputs."""
        super().__init__(config)
        self.networks, self.layers = (sgn, lln), config
        priors = PriorConfig(set_point_changes=config.set_point_changes, joint_step=config.joint_step)
        self._goals = make_goals(config.goals, priors, config.places)

    def begin(self, count: int) -> None:
        """Begin with empty memories of ``count`` environments; see ``MirroredPolicy``."""
        self.high = HighLevel(self.networks[0], self._goals, self.layers.interval, count)
        self.low = Memory(self.networks[1], count)

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return LLN's outputs (n, JOINTS); see ``MirroredPolicy``."""
        self.high.advance(observations, starts)
        self.low.forget(starts)
        return self.low.act(self.high.view(observations), np.arange(len(observations)))

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Return the sub-goals in the base frame, (n, 2, 3) [m]."""
        return {"sub-goal": self._mirror.points(self.high.subgoals.reshape(-1, 2, 3))}

    def commands(self) -> NDArray[Any]:
        """Return SGN's outputs for arm A and arm B of the robot, however scenes are seen, (n, 2, 3) in [-1, 1]."""
        return self._mirror.points(self.high.outputs.reshape(-1, 2, 3))


def network_sizes(config: HierarchicalPolicyConfig) -> dict[str, tuple[int, int]]:
    """Return how many numbers each layer sees and puts out."""
    return {
        "sgn": (view_size(config.places), SUBGOAL_SIZE),
        "lln": (lln_size(config.places, config.joint_step), JOINTS),
    }


def load_hierarchical_policy(folder: Path) -> HierarchicalPolicy:
    """Read the policy of a run folder; see ``load_networks``."""
    config = load_policy_config(folder, HierarchicalPolicyConfig)
    return HierarchicalPolicy(**load_networks(folder, network_sizes(config), NetworkSpec), config=config)
