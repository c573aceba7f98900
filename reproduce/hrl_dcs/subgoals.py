"""Sub-goals of the rescue: places of the two arm ends in the robot's base frame (section 2.2, point 2).

SGN's tanh-bounded outputs are the sub-goal, as the paper has it; frame and scale, which it leaves open, are in
``GoalConfig``. LLN sees s_t with a_{t-1}, and g_t; INR is Eq. 2 towards g_t.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.rewards import TERMS
from reproduce.hrl_dcs.config import GoalConfig
from reproduce.hrl_dcs.goals import PlainGoals
from reproduce.hrl_dcs.joint_step import joint_step
from reproduce.learning.actions import environment_actions
from reproduce.learning.config import PlacesConfig, PriorConfig
from reproduce.learning.networks import flat_spaces
from reproduce.learning.way_in import view_size

Floats = NDArray[np.float32]

SUBGOAL_SIZE = 6  # x, y, z of both arm ends
#: The box before the robot that ``frame`` "box" means: its lowest and highest corner, for arm A and for arm B [m].
BOX = np.array([[0.1, -0.9, 0.0] * 2, [1.3, 0.9, 1.2] * 2], np.float32)

_INDEX = {term.name: index for index, term in enumerate(TERMS)}
#: Eq. 2's terms that INR shares with the environment's reward; the approach term is towards the sub-goal instead.
SHARED_TERMS = [_INDEX[name] for name in ("obstacle_avoidance", "joint_motion", "time_bonus")]
#: Terms that the paper does not have, of which INR may have a share.
MILESTONES = [_INDEX[name] for name in ("rescued", "both_arms_under", "failure")]

_END_A, _END_B = (slice(SLICES[arm].start + 15, SLICES[arm].start + 18) for arm in ("P_A", "P_B"))
_TARGETS = slice(SLICES["P_G"].start, SLICES["P_G"].start + 6)


def lln_size(places: PlacesConfig | None, joint_steps: bool) -> int:
    """Return the size of what LLN sees: observation, sub-goal and, where it sees one, the joint step towards it."""
    return view_size(places) + SUBGOAL_SIZE + (JOINTS if joint_steps else 0)


def arm_ends(observations: Floats) -> Floats:
    """Return the two arm ends from flat observations (n, SIZE), as (n, 6) [m]."""
    return np.concatenate([observations[:, _END_A], observations[:, _END_B]], axis=1)


def targets(observations: Floats) -> Floats:
    """Return the two target areas P_G, (n, 6) [m]."""
    return observations[:, _TARGETS]


class RescueGoals(PlainGoals):
    """Sub-goals of several rescues, as ``reproduce.hrl_dcs.goals.Goals``: places of both arm ends."""

    distance_count = 2

    def __init__(self, config: GoalConfig, priors: PriorConfig, places: PlacesConfig | None = None) -> None:
        """Take over frame and scale, and the priors of LLN: what it sees and puts out besides, and what INR has.

        ``places`` are those to which both layers see the way, or None.
        """
        super().__init__(*flat_spaces(SIZE, JOINTS), arm_ends, config.reach)
        self.config, self.priors = config, priors
        self.view_size = lln_size(places, priors.joint_step)

    def subgoals(self, outputs: Floats) -> Floats:
        """Return the places (n, 6) [m] that SGN's outputs (n, 6) in [-1, 1] command."""
        if self.config.frame == "displacement":
            return super().subgoals(outputs)
        low, high = BOX
        return low + 0.5 * (np.clip(outputs, -1.0, 1.0) + 1.0) * (high - low)

    def outputs_of(self, subgoals: Floats, ends: Floats) -> Floats:
        """Return the outputs (n, 6) in [-1, 1] that command places (n, 6), or come nearest, with ends at (n, 6) [m]."""
        low, high = BOX
        displaced = self.config.frame == "displacement"
        outputs = (subgoals - ends) / self._reach if displaced else 2.0 * (subgoals - low) / (high - low) - 1.0
        cut: Floats = np.clip(outputs, -1.0, 1.0).astype(np.float32)
        return cut

    def distances(self, observations: Floats, subgoals: Floats) -> Floats:
        """Return how far each arm end is from its sub-goal, (n, 2) [m]."""
        way = (arm_ends(observations) - subgoals).reshape(-1, 2, 3)
        return np.sqrt(np.einsum("nak,nak->na", way, way))

    def view(self, observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
        """Return what LLN sees, s_t with a_{t-1}, and g_t, (n, view_size); see ``GoalConfig`` and ``joint_step``."""
        way = subgoals - arm_ends(observations)
        seen = [observations, way if self.config.seen == "way" else subgoals]
        if self.priors.joint_step:
            seen.append(joint_step(observations, way, self.config))
        return np.concatenate(seen, axis=1).astype(np.float32)

    def shared_reward(self, venv: Any, observations: Floats) -> Floats:
        """Return Eq. 2's other terms and, where it is a prior, a share of what comes once an episode, (n,)."""
        terms: Floats = venv.terms
        shared: Floats = terms[:, SHARED_TERMS].sum(axis=1)
        return shared + self.priors.milestone_share * terms[:, MILESTONES].sum(axis=1)

    def actions_of(self, observations: Floats, outputs: Floats) -> Floats:
        """Return Eq. 3's actions (n, JOINTS) for LLN's outputs (n, JOINTS)."""
        return environment_actions(observations, outputs, self.priors.set_point_changes)
