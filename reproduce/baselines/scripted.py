"""`random`, and `scripted`: inverse kinematics and way-points, what a roboticist would try first; neither learns.

The script sees the same observation as the learners: retract, lower, slide in under the body, then lift or push over.
It knows nothing of rocks, so it also tells how hard the problem is without looking at them. Its way-points are data, in
``planner/data/script.json``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import solve_arm
from lunar_rescue.physics.robot import ARM_WINDOW, ARMS, INITIAL_ARM, INITIAL_WAIST, JOINTS, WAIST, WAIST_WINDOW
from reproduce.baselines.way_points import ARRIVED, SCRIPT, Variant, WayPoint, load_way_points
from reproduce.learning.actions import LOWER, UPPER
from reproduce.learning.policy import Actions, Observations, Policy

Array = NDArray[np.float64]

SIDE_FRONT = 0.75  # lying on a side, the front points up or down by less than this sine
_INITIAL = np.concatenate([INITIAL_ARM, INITIAL_ARM, [INITIAL_WAIST]])
_WINDOW = np.array([ARM_WINDOW] * 10 + [WAIST_WINDOW])


@dataclass
class _Progress:
    """How far the script has come in one environment."""

    targets: Array  # the two targets as first seen (2, 3) [m]
    points: Variant
    index: int = -1  # of the present way-point
    left: int = 0  # steps that may still be spent on it
    joints: Array = field(default_factory=_INITIAL.copy)  # it asks for (11,) [rad]

    def action(self, angles: NDArray[np.float32]) -> Array:
        """Return Eq. 3's action for joint angles (11,) in Eq. 3's units, going on where a way-point is reached."""
        arrived = bool(np.all(np.abs(angles - _to_action(self.joints)) * ARM_WINDOW < ARRIVED))
        if (arrived or self.left <= 0) and self.index + 1 < len(self.points):
            self.index += 1
            self.left = self.points[self.index].patience
            self.joints = _solve(self.points[self.index], self.targets, self.joints)
        self.left -= 1
        return _to_action(self.joints)


class RandomPolicy(Policy):
    """Uniform actions in [-1, 1], the same for the same seed and order of calls."""

    def __init__(self, seed: Any = 0) -> None:
        """Seed the generator; anything but an integer counts as 0."""
        self.reseed(seed if isinstance(seed, int) else 0)

    def reseed(self, seed: int) -> None:
        """Start a scene's own sequence of actions, so that the order of tests does not matter."""
        self._rng = np.random.default_rng(seed)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Draw actions (n, 11) without a look at the observations; see ``Policy.act``."""
        return self._rng.uniform(-1.0, 1.0, (len(observations), JOINTS)).astype(np.float32)


class ScriptedPolicy(Policy):
    """Go through the script's way-points, with one state machine for each environment."""

    def __init__(self) -> None:
        self._progress: dict[int, _Progress] = {}
        self._script = load_way_points(SCRIPT)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Go on to the next way-point where one is reached; see ``Policy.act``."""
        rows = [self._one(i, row, bool(start)) for i, (row, start) in enumerate(zip(observations, starts, strict=True))]
        return np.array(rows, dtype=np.float32)

    def _one(self, index: int, row: NDArray[np.float32], start: bool) -> Array:
        if start or index not in self._progress:
            targets = row[SLICES["P_G"]][:6].reshape(2, 3).astype(np.float64)
            self._progress[index] = _Progress(targets, self._script["get under"][0] + self._script[_kind(row)][0])
        angles = np.concatenate([row[SLICES["P_A"]][:5], row[SLICES["P_B"]][:5], row[SLICES["P_W"]][:1]])
        return self._progress[index].action(angles)


def _kind(row: NDArray[np.float32]) -> str:
    """Name the way-points that suit the task and the attitude that the robot sees."""
    front_up = row[SLICES["P_P"]][5]
    if row[SLICES["I"]][0] > 0.5:
        return "lift supine" if front_up > 0 else "lift prone"
    return "turn_over side" if abs(front_up) < SIDE_FRONT else "turn_over prone"


def _solve(point: WayPoint, targets: Array, before: Array) -> Array:
    joints = np.empty(JOINTS)
    joints[WAIST] = np.radians(point.waist)
    for arm, place in zip(ARMS, targets + [point.ahead, point.aside, point.up], strict=True):
        j = arm.joints
        joints[j] = solve_arm(place, np.radians(point.slope), joints[WAIST], arm.side, before[j], LOWER[j], UPPER[j])
    return joints


def _to_action(joints: Array) -> Array:
    return np.clip((joints - _INITIAL) / _WINDOW, -1.0, 1.0)
