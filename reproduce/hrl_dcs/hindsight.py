"""Hindsight: what SGN and LLN should have put out in a demonstration that knows of no sub-goals.

Where the arms really were N steps later is the sub-goal that SGN should have set, and LLN's actions are those that led
there. LLN learns from two versions of each demonstration: with these sub-goals, and with those that the trained SGN
sets, which are what it will be given.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from reproduce.hrl_dcs.policy import HighLevel
from reproduce.hrl_dcs.subgoals import RescueGoals, arm_ends
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.imitation import Example
from reproduce.learning.networks import RecurrentNetwork

Floats = NDArray[np.float32]


def reached(ends: Floats, interval: int) -> Floats:
    """Return for each step where the arm ends (t, 6) [m] were when its sub-goal was due, at 0, N, 2N, ... (t, 6)."""
    due = np.minimum((np.arange(len(ends)) // interval + 1) * interval, len(ends) - 1)
    return ends[due]


def sgn_examples(goals: RescueGoals, played: PlayedBack, interval: int) -> Iterator[Example]:
    """Yield what SGN should learn of a demonstration: one example for each step at which its clock could have begun."""
    ends = arm_ends(played.observations)
    for first in range(min(interval, len(ends))):
        rows = np.arange(first, len(ends), interval)
        due = np.minimum(rows + interval, len(ends) - 1)
        outputs = goals.outputs_of(ends[due], ends[rows])
        begin = int(np.searchsorted(rows, min(played.begin, rows[-1])))
        yield Example(played.observations[rows], outputs, played.returns[rows], begin)


def lln_example(goals: RescueGoals, played: PlayedBack, subgoals: Floats) -> Example:
    """Return what LLN should learn of a demonstration under these sub-goals (t, 6) [m]; its critic learns nothing."""
    views = goals.view(played.observations, subgoals, np.zeros(len(subgoals), np.float32))
    return Example(views, played.outputs, np.zeros(len(subgoals), np.float32), played.begin)


def commanded(sgn: RecurrentNetwork, goals: RescueGoals, played: Sequence[PlayedBack], interval: int) -> list[Floats]:
    """Return for each demonstration the sub-goals (t, 6) [m] that SGN sets in its states, by its means."""
    longest = max(len(one.observations) for one in played)
    seen = np.stack([one.observations[np.minimum(np.arange(longest), len(one.observations) - 1)] for one in played])
    high = HighLevel(sgn, goals, interval, len(played))
    subgoals = np.zeros((longest, len(played), goals.size), np.float32)
    for step in range(longest):
        high.advance(seen[:, step], np.full(len(played), step == 0))
        subgoals[step] = high.subgoals
    return [subgoals[: len(one.observations), index] for index, one in enumerate(played)]
