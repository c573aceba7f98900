"""`scripted`: inverse kinematics and a few way-points, what a roboticist would try first; it learns nothing.

It sees the same observation as the learners: retract, lower, slide in under the body, then lift or push over. It knows
nothing of rocks, so it also tells how hard the problem is without looking at them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import solve_arm
from lunar_rescue.physics.robot import ARM_WINDOW, ARMS, INITIAL_ARM, INITIAL_WAIST, JOINTS, WAIST, WAIST_WINDOW
from reproduce.learning.actions import ARM_LOWER, ARM_UPPER
from reproduce.learning.policy import Actions, Observations

Array = NDArray[np.float64]

ARRIVED = np.radians(3.0)  # rad, a way-point is reached when every joint is this near


@dataclass(frozen=True)
class WayPoint:
    """A wanted place of both arm ends.

    Attributes:
        offset: From the targets as first seen: ahead, sideways, up (3,) [m].
        slope: Forearm above the horizontal [deg].
        waist: Waist angle [deg].
        patience: Most steps to spend.
    """

    offset: tuple[float, float, float]
    slope: float
    waist: float
    patience: int


GET_UNDER = (
    WayPoint((-0.66, 0.0, 0.45), 20, -15, 14),
    WayPoint((-0.62, 0.0, 0.06), -12, -10, 16),
    WayPoint((-0.50, 0.0, 0.00), -6, 8, 12),
    WayPoint((-0.25, 0.0, 0.00), -3, 24, 14),
    WayPoint((0.00, 0.0, 0.00), -3, 40, 20),
)
THEN = {
    # Face down the chest unit makes a body that rolls: further under, then forearms up as a cradle. This and turning
    # over from a side come from the planner's random search on training scenes (``baselines.planner.search``).
    "lift prone": (
        WayPoint((0.23, 0.0, -0.02), 13, 55, 14),
        WayPoint((0.01, 0.0, 0.42), 32, 35, 14),
        WayPoint((-0.05, 0.0, 0.47), 58, 15, 60),
    ),
    "lift supine": (
        WayPoint((-0.02, 0.0, 0.20), 6, 30, 14),
        WayPoint((-0.06, 0.0, 0.36), 10, 14, 14),
        WayPoint((-0.08, 0.0, 0.55), 12, 0, 60),
    ),
    # From face down: under the near half, up and away, then out of the way.
    "turn_over prone": (
        WayPoint((0.05, 0.0, 0.25), 10, 45, 12),
        WayPoint((0.20, 0.0, 0.50), 10, 42, 12),
        WayPoint((0.32, 0.0, 0.55), 10, 38, 12),
        WayPoint((0.00, 0.0, 0.20), 0, 35, 25),
        WayPoint((-0.30, 0.0, 0.10), 0, 10, 60),
    ),
    # From a side: lift the near edge, push on low with the waist, so that the body rolls over its far edge.
    "turn_over side": (
        WayPoint((-0.08, 0.0, 0.27), 1, 48, 12),
        WayPoint((0.26, 0.0, 0.08), 0, 59, 12),
        WayPoint((0.01, 0.0, 0.63), 16, -16, 16),
        WayPoint((-0.11, 0.0, 0.42), 12, -3, 36),
        WayPoint((-0.52, 0.0, 0.07), 18, 3, 60),
    ),
}
SIDE_FRONT = 0.75  # lying on a side, the front points up or down by less than this sine


@dataclass
class _Memory:
    targets: Array
    points: tuple[WayPoint, ...]
    index: int = -1
    left: int = 0
    joints: Array = field(default_factory=lambda: np.concatenate([INITIAL_ARM, INITIAL_ARM, [INITIAL_WAIST]]))


class ScriptedPolicy:
    """One state machine an environment."""

    def __init__(self) -> None:
        """Start without any memory."""
        self._memories: dict[int, _Memory] = {}

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        rows = [self._one(i, row, bool(start)) for i, (row, start) in enumerate(zip(observations, starts, strict=True))]
        return np.array(rows, dtype=np.float32)

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Nothing to draw."""
        return {}

    def _one(self, index: int, row: NDArray[np.float32], start: bool) -> Array:
        if start or index not in self._memories:
            targets = row[SLICES["P_G"]][:6].reshape(2, 3).astype(np.float64)
            self._memories[index] = _Memory(targets, GET_UNDER + THEN[_kind(row)])
        memory = self._memories[index]
        angles = np.concatenate([row[SLICES["P_A"]][:5], row[SLICES["P_B"]][:5], row[SLICES["P_W"]][:1]])
        wanted = _to_action(memory.joints)
        arrived = bool(np.all(np.abs(angles - wanted) * ARM_WINDOW < ARRIVED))
        if (arrived or memory.left <= 0) and memory.index + 1 < len(memory.points):
            memory.index += 1
            memory.left = memory.points[memory.index].patience
            memory.joints = _solve(memory.targets, memory.points[memory.index], memory.joints)
        memory.left -= 1
        return _to_action(memory.joints)


def _kind(row: NDArray[np.float32]) -> str:
    """Which way-points suit the task and the attitude that the robot sees."""
    front_up = row[SLICES["P_P"]][5]
    if row[SLICES["I"]][0] > 0.5:
        return "lift supine" if front_up > 0 else "lift prone"
    return "turn_over side" if abs(front_up) < SIDE_FRONT else "turn_over prone"


def _to_action(joints: Array) -> Array:
    initial = np.concatenate([INITIAL_ARM, INITIAL_ARM, [INITIAL_WAIST]])
    window = np.array([ARM_WINDOW] * 10 + [WAIST_WINDOW])
    return np.clip((joints - initial) / window, -1.0, 1.0)


def _solve(targets: Array, point: WayPoint, before: Array) -> Array:
    joints = np.empty(JOINTS)
    joints[WAIST] = np.radians(point.waist)
    for arm, target in zip(ARMS, targets, strict=True):
        joints[arm.joints], _ = solve_arm(
            target + np.array(point.offset),
            np.radians(point.slope),
            joints[WAIST],
            arm.side,
            before[arm.joints],
            ARM_LOWER,
            ARM_UPPER,
        )
    return joints
