"""What an episode remembers besides the simulation's state, and the distances that its rewards are made of."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.astronaut import Astronaut, AstronautState
from lunar_rescue.observation import Observer
from lunar_rescue.robot import RobotState
from lunar_rescue.scene import Scene
from lunar_rescue.tasks import SMALLEST_ERROR, Task

Array = NDArray[np.float64]

OVER = 0.15  # m above a target; an end higher than this has not slid in under the body


@dataclass
class Episode:
    """What an episode remembers besides the simulation's state."""

    scene: Scene
    astronaut: Astronaut
    task: Task
    observer: Observer
    rocks: list[int]
    marks: Array  # (m, 3) [m]
    order: list[int]  # which target belongs to arm A and arm B
    robot: RobotState
    body: AstronautState
    recent: deque[Array]  # distances (2,) of the last steps; their least is D_m
    process: int = 1
    held: int = 0
    steps: int = 0
    rock_contact: bool = False

    def targets(self) -> Array:
        """P_G of arm A and arm B (2, 3) [m]."""
        return self.astronaut.targets(self.body)[self.order]

    def entries(self) -> Array:
        """Where the way in to each target begins, before the body, of arm A and arm B (2, 3) [m]."""
        return self.targets() + self.astronaut.ways_in[self.order]

    def distances(self) -> Array:
        """D of each arm end to its target area, plus a detour for an end over the body (2,) [m].

        The straight way from over the body leads through it: such an end must first go back before the body, or down
        beside it, so the smaller of height over ``OVER`` and depth behind the entry is added. This leaves no place but
        the target where every small motion makes D larger, and D stays continuous (a jump could be crossed again and
        again for reward; tried, see the training log).
        """
        from_target, ways = self.robot.ends - self.targets(), self.astronaut.ways_in[self.order]
        length = np.sqrt((ways * ways).sum(axis=1))
        depth = np.maximum(0.0, length - (from_target * ways).sum(axis=1) / length)
        height = np.maximum(0.0, from_target[:, 2] - OVER)
        return _lengths(from_target) + np.minimum(depth, height)


def _lengths(vectors: Array) -> Array:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors)) + SMALLEST_ERROR
