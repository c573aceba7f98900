"""SGN at work: a sub-goal at t = 0, N, 2N, ... of every episode, whether it is trained or acts as it was trained."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reproduce.hrl_dcs.goals import Goals
from reproduce.learning.networks import Memory, RecurrentNetwork

Floats = NDArray[np.float32]


class HighLevel:
    """SGN with its clock, its memory and its present sub-goals (n, goals.size) in several environments."""

    def __init__(self, sgn: RecurrentNetwork, goals: Goals, interval: int, count: int) -> None:
        """Begin with empty memories of ``count`` environments, in which N is ``interval``."""
        self.memory, self.goals, self._interval = Memory(sgn, count), goals, interval
        self.subgoals = np.zeros((count, goals.size), np.float32)
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
            outputs = np.zeros((len(observations), self.goals.outputs), np.float32)
            outputs[rows] = self.command(observations[rows], rows, starts[rows])
            self.subgoals[rows] = self.goals.subgoals(outputs)[rows]
            self._left[rows] = self._interval
        return rows

    def command(self, observations: Floats, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> Floats:
        """Return SGN's outputs (m, goals.outputs) for environments ``rows`` (m,), here its means."""
        return self.memory.act(observations, rows)

    def view(self, observations: Floats) -> Floats:
        """Return what LLN sees of observations (n, d), (n, goals.view_size)."""
        return self.goals.view(observations, self.subgoals, (self._left / self._interval).astype(np.float32))
