"""The observation s_t: what each key holds, its shape and unit, and how it is filled.

Positions are in the robot's base frame (x forward, y left, z up), which is what the robot's own sensors give. All
entries lie in one flat vector, which learners read as it is; the Dict observation's arrays are copies of its slices.
"""

import json
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.physics.astronaut import AstronautState
from lunar_rescue.physics.client import DATA
from lunar_rescue.physics.robot import WAIST, Robot, RobotState
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.scene import TASKS, Scene

BOUND = 5.0  # every entry is scaled to about [-1, 1] and clipped here


class Entry(NamedTuple):
    """One key of the observation."""

    key: str  # the paper's symbol
    size: int  # number of values
    meaning: str  # what they are, in order, with units


#: Distances before a target at which the ground's height is seen [m].
GROUND_AT = (0.95, 0.75, 0.55, -0.60, -0.90)
GROUND_POINTS = len(GROUND_AT)
GROUND_UNIT = 0.1  # m

#: Sizes follow from the numbers of joints, rocks, key points and ``GROUND_AT``; ``Observer`` fails if they do not.
ENTRIES = tuple(Entry(**row) for row in json.loads((DATA / "observation.json").read_text(encoding="utf-8")))

SIZE = sum(entry.size for entry in ENTRIES)
_STARTS = np.cumsum([0] + [entry.size for entry in ENTRIES])
SLICES: dict[str, slice] = {e.key: slice(int(a), int(a) + e.size) for e, a in zip(ENTRIES, _STARTS, strict=False)}
_ARMS = slice(SLICES["P_A"].start, SLICES["P_B"].stop)
_WAIST, _GOALS, _BODY, _ACTION, _PHASE = (SLICES[key] for key in ("P_W", "P_G", "P_P", "a_prev", "phase"))


def observation_space() -> spaces.Dict:
    """Return the Dict space; its keys keep the order of ``ENTRIES``, so that flattened it is the flat observation."""
    return spaces.Dict([(e.key, spaces.Box(-BOUND, BOUND, (e.size,), np.float32)) for e in ENTRIES])


def as_dict(vector: Floats) -> dict[str, Floats]:
    """Slice flat observations, (..., SIZE), into the Dict's arrays."""
    return {key: vector[..., where].copy() for key, where in SLICES.items()}


def as_flat(observation: Mapping[str, Floats]) -> Floats:
    """Join the Dict's arrays (..., size) to flat observations (..., SIZE), whatever order its keys are in."""
    return np.concatenate([observation[key] for key in SLICES], axis=-1)


def observation_table() -> list[dict[str, object]]:
    """Return rows of key, shape, meaning for notebooks and documentation."""
    return [{"key": e.key, "shape": (e.size,), "meaning": e.meaning} for e in ENTRIES]


class Observer:
    """Fills the observation of one episode."""

    def __init__(self, scene: Scene, robot: Robot, targets: Array, entries: Array, marks: Array) -> None:
        """Prepare what stays the same during the episode.

        Targets (their middle orders the rocks) and entries, where the ways in begin, are those of arm A and arm B at
        the start (2, 3) [m]; ``marks`` are five of each rock (5 n, 3) [m].
        """
        self._robot = robot
        c, s = math.cos(scene.base_yaw), math.sin(scene.base_yaw)
        self._world_to_base = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]).T  # rows times this
        self._base = np.array([scene.base_x, scene.base_y, 0.0])
        self._scales = 1.0 / np.array([robot.window, robot.speed_limits, robot.torque_limits])
        self._template = np.zeros(SIZE)
        self._template[SLICES["P_R"]] = [scene.base_x, scene.base_y, c, s]
        self._template[SLICES["I"]] = [float(scene.task == task) for task in TASKS]
        self._template[SLICES["P_E"]] = self._obstacles(scene, targets, marks).ravel()
        self._template[SLICES["P_T"]] = self._ground(scene, targets, entries)

    def _ground(self, scene: Scene, targets: Array, entries: Array) -> Array:
        ways = (entries - targets)[:, None, :2]
        ways = ways / np.sqrt((ways * ways).sum(axis=-1, keepdims=True))
        spots = targets[:, None, :2] + ways * np.array(GROUND_AT)[:, None]
        heights = scene.terrain.height(spots[..., 0], spots[..., 1]) / GROUND_UNIT
        return np.concatenate([scene.terrain.up() @ self._world_to_base, heights.ravel()])

    def _obstacles(self, scene: Scene, targets: Array, marks: Array) -> Array:
        rows = np.zeros((MAX_ROCKS, 5))
        if scene.rocks:
            x, y = (0.5 * float(targets[0, i] + targets[1, i]) for i in (0, 1))
            order = sorted(
                range(len(scene.rocks)), key=lambda i: math.hypot(scene.rocks[i].x - x, scene.rocks[i].y - y)
            )
            flanks = [(scene.rocks[index].flank, 1.0) for index in order]
            rows[: len(order)] = np.column_stack([self.to_base(marks[::5][order]), flanks])
        return rows

    def to_base(self, points: Array) -> Array:
        """Express points (n, 3) [m] of the world in the robot's base frame."""
        return np.asarray((points - self._base) @ self._world_to_base)

    def fill(
        self,
        robot: RobotState,
        body: AstronautState,
        targets: Array,
        entries: Array,
        skeleton: Array,
        action: Array,
        phase: Array,
    ) -> Floats:
        """Return the flat observation (SIZE,), float32, every entry clipped to ``BOUND``."""
        out = self._template.copy()
        points = self.to_base(np.concatenate([robot.ends, targets, entries, body.centre[None], skeleton]))
        turned = np.concatenate([robot.directions, body.rotation[:, :2].T, body.velocity[None], body.spin[None]])
        turned = turned @ self._world_to_base
        joints = np.array([robot.angles - self._robot.initial, robot.speeds, robot.torques]) * self._scales
        arms = out[_ARMS].reshape(2, -1)
        arms[:, :15] = joints[:, :WAIST].reshape(3, 2, 5).transpose(1, 0, 2).reshape(2, 15)
        arms[:, 15:18], arms[:, 18:] = points[:2], turned[:2]
        out[_WAIST] = joints[:, WAIST]
        goals = out[_GOALS].reshape(3, 2, 3)
        goals[0] = points[2:4]
        goals[1:] = points[2:6].reshape(2, 2, 3) - points[:2]
        out[_BODY] = np.concatenate([points[6], turned[2:6].ravel(), points[7:].ravel()])
        out[_ACTION], out[_PHASE] = action, phase
        return np.minimum(np.maximum(out, -BOUND), BOUND).astype(np.float32)
