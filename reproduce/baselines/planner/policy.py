"""`planner`: knows the scene and the simulator and tries plans out before it acts, which tells what can be done."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import Scene
from reproduce.baselines.planner.planner import Plan, RescuePlanner
from reproduce.learning.policy import Actions, Observations, Policy
from reproduce.storage.errors import UserError


class PlannerPolicy(Policy):
    """Do what was planned for the scene, whatever is seen; one environment at a time."""

    def __init__(self, planner: RescuePlanner | None = None) -> None:
        """Plan with ``planner``, or one of its own."""
        self._planner = planner or RescuePlanner()
        self._step = 0
        self._plan: Plan | None = None

    @property
    def plan(self) -> Plan:
        """The plan for the present episode; ``UserError`` where no scene was given yet."""
        if self._plan is None:
            raise UserError("planner: needs the scene before it can act; call prepare(scene)")
        return self._plan

    def prepare(self, scene: Scene) -> None:
        """Plan for the episode that is about to begin."""
        self._plan, self._step = self._planner.plan(scene), 0

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``; past its end, the plan's last action goes on."""
        actions = self.plan.actions
        if len(observations) != 1:
            raise UserError(f"planner: acts in one environment at a time, got observations of {len(observations)}")
        action = actions[min(self._step, len(actions) - 1)]
        self._step += 1
        return action[None].copy()
