"""Sub-goals: the one metric space in which SGN commands and LLN obeys (section 2.2, point 2).

A sub-goal is a wanted position of the two arm ends in the robot's base frame. SGN's tanh-bounded output moves it by at
most ``REACH`` from an anchor. In process 1 that is, for each arm, the entry before the body while its end is high, and
the target area once it is low; in process 2 it is the target area as it was when both arms had got under. With the
target areas alone as anchors an untrained SGN sends the arms straight at them and onto the body, and learning starts in
a trap (tried, see the training log).

What the six numbers mean is a choice, ``MEANINGS``: a displacement of each arm's sub-goal, or one of both together and
one of the two apart. The arms have to work together on one body, and with the second SGN's exploration moves them so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.episode import OVER
from lunar_rescue.observation import SIZE, SLICES

Floats = NDArray[np.float32]

SUBGOAL_SIZE = 6  # two arm ends in three dimensions
REACH = 0.6  # m, furthest that SGN moves a sub-goal from its anchor along each axis, or both together
APART = 0.25  # m, furthest that it moves either of them away from their common displacement, along each axis
MEANINGS = ("each", "together")
LLN_SIZE = SIZE + 2 * SUBGOAL_SIZE + 1

_END_A = slice(SLICES["P_A"].start + 15, SLICES["P_A"].start + 18)
_END_B = slice(SLICES["P_B"].start + 15, SLICES["P_B"].start + 18)
_TARGETS = slice(SLICES["P_G"].start, SLICES["P_G"].start + 6)
_TO_ENTRIES = slice(SLICES["P_G"].start + 12, SLICES["P_G"].start + 18)
_PROCESS_2 = SLICES["phase"].start


def arm_ends(observations: Floats) -> Floats:
    """The two arm ends from flat observations (n, SIZE), as (n, 6) [m]."""
    return np.concatenate([observations[:, _END_A], observations[:, _END_B]], axis=1)


def targets(observations: Floats) -> Floats:
    """The two target areas P_G, (n, 6) [m]."""
    return observations[:, _TARGETS]


def entries(observations: Floats) -> Floats:
    """The entries before the body, (n, 6) [m]."""
    return observations[:, _TO_ENTRIES] + arm_ends(observations)


def next_points(observations: Floats) -> Floats:
    """For each arm the entry while its end is high, the target area once it is low, (n, 6) [m]."""
    ends, goals = arm_ends(observations), targets(observations)
    high = ends[:, [2, 5]] > goals[:, [2, 5]] + OVER
    return np.where(np.repeat(high, 3, axis=1), entries(observations), goals)


def in_process_2(observations: Floats) -> NDArray[np.bool_]:
    """Whether both arms have got under, (n,)."""
    return observations[:, _PROCESS_2] > 0.5


def lln_observations(observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
    """What LLN sees: s_t (with a_{t-1}), the sub-goal, the way to it and the share of N steps left, (n, LLN_SIZE)."""
    way = subgoals - arm_ends(observations)
    return np.concatenate([observations, subgoals, way, remaining[:, None]], axis=1).astype(np.float32)


class Anchors:
    """Where sub-goals are measured from, for several environments."""

    def __init__(self, count: int, meaning: str) -> None:
        """Start with nothing known.

        Args:
            count: Environments.
            meaning: One of ``MEANINGS``.
        """
        if meaning not in MEANINGS:
            raise ValueError(f"subgoals: expected one of {MEANINGS}, got {meaning!r}")
        self._together = meaning == "together"
        self._kept = np.zeros((count, SUBGOAL_SIZE), np.float32)
        self._was_2 = np.zeros(count, bool)

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Follow the entries in process 1, stay where the targets were when process 2 began."""
        now_2 = in_process_2(observations)
        begins_2 = now_2 & (starts | ~self._was_2)
        self._kept[~now_2] = next_points(observations)[~now_2]
        self._kept[begins_2] = targets(observations)[begins_2]
        self._was_2 = now_2

    def subgoals(self, outputs: Floats) -> Floats:
        """Positions (n, 6) [m] commanded by SGN's outputs (n, 6) in [-1, 1]."""
        moved: Floats = np.clip(outputs, -1.0, 1.0)
        if self._together:
            common, apart = REACH * moved[:, :3], APART * moved[:, 3:]
            return self._kept + np.concatenate([common + apart, common - apart], axis=1)
        return self._kept + REACH * moved
