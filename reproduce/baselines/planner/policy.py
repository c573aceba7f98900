"""`planner`: knows the scene and the simulator and tries its plans out before it acts; what can be done at all."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import Scene
from reproduce.baselines.planner.planner import Plan, RescuePlanner
from reproduce.learning.policy import Actions, Observations
from reproduce.storage.errors import UserError


class PlannerPolicy:
    """Does what was planned for the scene, whatever it sees; one environment at a time."""

    def __init__(self, planner: RescuePlanner | None = None) -> None:
        """Plan with ``planner``, or one of its own."""
        self._planner = planner or RescuePlanner()
        self._step = 0
        self.plan: Plan | None = None

    def prepare(self, scene: Scene) -> None:
        """Plan for the episode that is about to begin."""
        self.plan, self._step = self._planner.plan(scene), 0

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        if self.plan is None:
            raise UserError("planner: needs the scene before it can act; call prepare(scene)")
        if len(observations) != 1:
            raise UserError(f"planner: acts in one environment at a time, got observations of {len(observations)}")
        # Past its end, the plan's last action goes on.
        action = self.plan.actions[min(self._step, len(self.plan.actions) - 1)]
        self._step += 1
        return action[None].copy()

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Nothing to draw."""
        return {}
