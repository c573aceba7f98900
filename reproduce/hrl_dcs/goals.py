"""What two layers must know of a task: what a sub-goal is, how far away it is, and what LLN sees and does.

``hrl_dcs.subgoal_env`` works over any vectorised Gymnasium environment with flat observations and a Box action, given
``Goals``. Those of the rescue are ``hrl_dcs.subgoals.RescueGoals``; ``PlainGoals`` need only a function from
observations to a goal space (see docs/extending.md).
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from reproduce.learning.networks import flat_box

Floats = NDArray[np.float32]


class Goals(Protocol):
    """What a sub-goal is."""

    outputs: int  # numbers that SGN puts out
    size: int  # numbers of a sub-goal
    distance_count: int  # distances to a sub-goal, whose approach counts on the average
    view_size: int  # size of what LLN sees
    actions: int  # numbers that LLN puts out

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Follow the environments; called with each observation (n, d) and which of them begin an episode (n,)."""

    def subgoals(self, outputs: Floats) -> Floats:
        """Return the sub-goals (n, size) that SGN's outputs (n, outputs) in [-1, 1] command."""

    def distances(self, observations: Floats, subgoals: Floats) -> Floats:
        """Return how far sub-goals are, (n, distance_count), at least 0."""

    def view(self, observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
        """Return what LLN sees, (n, view_size); ``remaining`` is the share of N steps left, (n,)."""

    def shared_reward(self, venv: Any, observations: Floats) -> Floats:
        """Return what INR has besides the approach to the sub-goal, (n,)."""

    def actions_of(self, observations: Floats, outputs: Floats) -> Floats:
        """Return the environments' actions for LLN's outputs (n, actions) in [-1, 1]."""


class PlainGoals:
    """Goals of any environment: points of a goal space, at most ``reach`` from where the state is now."""

    distance_count = 1

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        goal_of: Callable[[Floats], Floats],
        reach: float,
    ) -> None:
        """Check the spaces, which are flat boxes, the action's with bounds, or a ``ValueError``.

        ``goal_of`` leads from observations (n, d) to the goal space (n, g), along each axis of which a sub-goal is at
        most ``reach`` away. LLN's outputs in [-1, 1] are stretched over the actions.
        """
        sees, acts = flat_box("observation_space", observation_space), flat_box("action_space", action_space)
        if not (np.isfinite(acts.low).all() and np.isfinite(acts.high).all()):
            raise ValueError(f"action_space: expected bounds, got {acts}")
        self._goal_of, self._reach = goal_of, np.float32(reach)
        self._low, self._high = acts.low, acts.high
        self.size = self.outputs = int(goal_of(np.zeros((1, *sees.shape), np.float32)).shape[1])
        self.view_size, self.actions = sees.shape[0] + 2 * self.size + 1, acts.shape[0]

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Note where the state is: sub-goals are measured from there."""
        self._now = self._goal_of(observations).astype(np.float32)

    def subgoals(self, outputs: Floats) -> Floats:
        """Return sub-goals (n, size) around where the state is."""
        return self._now + self._reach * np.clip(outputs, -1.0, 1.0)

    def distances(self, observations: Floats, subgoals: Floats) -> Floats:
        """Return the distance straight through the goal space, (n, 1)."""
        away: Floats = np.linalg.norm(self._goal_of(observations) - subgoals, axis=1, keepdims=True)
        return away.astype(np.float32)

    def view(self, observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
        """Return the observation, the sub-goal, the way to it and the share of N steps left, (n, view_size)."""
        parts = [observations, subgoals, subgoals - self._goal_of(observations), remaining[:, None]]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def shared_reward(self, venv: Any, observations: Floats) -> Floats:
        """Return nothing (n,): LLN is paid for its sub-goal alone."""
        return np.zeros(len(observations), np.float32)

    def actions_of(self, observations: Floats, outputs: Floats) -> Floats:
        """Return LLN's outputs (n, actions) stretched over the action space."""
        share = 0.5 * (np.clip(outputs, -1.0, 1.0) + 1.0)
        return (self._low + share * (self._high - self._low)).astype(np.float32)
