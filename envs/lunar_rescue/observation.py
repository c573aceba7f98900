"""The observation s_t: what each key holds, its shape and unit, and how it is filled.

Positions are in the robot's base frame (x forward, y left, z up), which is what the robot's own sensors give. All
entries lie in one flat vector, which learners read as it is; the Dict observation's arrays are copies of its slices.
"""

import math
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lunar_rescue.arrays import Array
from lunar_rescue.physics.astronaut import AstronautState
from lunar_rescue.physics.robot import JOINTS, WAIST, Robot, RobotState
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.scene import TASKS, Scene
from lunar_rescue.scenes.suit import KEYPOINT_NAMES

BOUND = 5.0  # every entry is scaled to about [-1, 1] and clipped here


@dataclass(frozen=True)
class Entry:
    """One key of the observation."""

    key: str  # the paper's symbol
    size: int  # number of values
    meaning: str  # what they are, in order, with units


#: Distances before a target at which the ground's height is seen [m].
GROUND_AT = (0.95, 0.75, 0.55, -0.60, -0.90)
GROUND_POINTS = len(GROUND_AT)
GROUND_UNIT = 0.1  # m

_ARM = (
    "5 angles from q_init [60 deg], 5 speeds [1.5 rad/s], 5 motor torques [limit], end position (3) [m], "
    "plate direction (3)"
)
ENTRIES = (
    Entry("P_A", 21, f"arm A (left): {_ARM}"),
    Entry("P_B", 21, f"arm B (right): {_ARM}"),
    Entry("P_W", 3, "waist: angle from its initial value [60 deg], speed [1.5 rad/s], torque [limit]"),
    Entry(
        "P_G",
        18,
        "target areas of arm A and arm B: position (2 x 3) [m], from arm end to target (2 x 3) [m], "
        "from arm end to the entry before the body (2 x 3) [m]",
    ),
    Entry(
        "P_P",
        15 + 3 * len(KEYPOINT_NAMES),
        "astronaut: centre of gravity (3) [m], front and left axes (6), velocity (3) [m/s], spin (3) [rad/s], "
        "13 key points of the skeleton (39) [m]",
    ),
    Entry(
        "P_E",
        5 * MAX_ROCKS,
        f"obstacles, nearest to the middle of the targets at the start first, {MAX_ROCKS} rows, unused ones zero: "
        "position of the top mark (3) [m], radius of the ring of flank marks [m], present (1 or 0)",
    ),
    Entry(
        "P_T",
        3 + 2 * GROUND_POINTS,
        "ground: up vector (3), then for arm A and arm B the ground's height along the way in, at "
        f"{', '.join(f'{d:g}' for d in GROUND_AT)} m before the target (negative is beyond) (2 x {GROUND_POINTS}) "
        "[0.1 m]",
    ),
    Entry("P_R", 4, "robot base in the work area: x, y [m], cos and sin of its heading"),
    Entry("a_prev", JOINTS, "previous action"),
    Entry("I", 2, "task code: one-hot of lift, turn_over"),
    Entry("phase", 2, "process 2 reached (0 or 1), share of the step limit used"),
)

SIZE = sum(entry.size for entry in ENTRIES)
_STARTS = np.cumsum([0] + [entry.size for entry in ENTRIES])
SLICES: dict[str, slice] = {e.key: slice(int(a), int(a) + e.size) for e, a in zip(ENTRIES, _STARTS, strict=False)}
_ARMS = slice(SLICES["P_A"].start, SLICES["P_B"].stop)
_WAIST, _GOALS, _BODY, _ACTION, _PHASE = (SLICES[key] for key in ("P_W", "P_G", "P_P", "a_prev", "phase"))


def observation_space() -> spaces.Dict:
    """Return the Dict space; its keys keep the order of ``ENTRIES``, so that flattened it is the flat observation."""
    return spaces.Dict([(e.key, spaces.Box(-BOUND, BOUND, (e.size,), np.float32)) for e in ENTRIES])


def as_dict(vector: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Slice flat observations, (..., SIZE), into the Dict's arrays."""
    return {key: vector[..., where].copy() for key, where in SLICES.items()}


def observation_table() -> list[dict[str, object]]:
    """Return rows of key, shape, meaning for notebooks and documentation."""
    return [{"key": e.key, "shape": (e.size,), "meaning": e.meaning} for e in ENTRIES]


class Observer:
    """Fills the observation of one episode."""

    def __init__(self, scene: Scene, robot: Robot, targets: Array, entries: Array, marks: Array) -> None:
        """Prepare everything that stays the same during the episode.

        Args:
            scene: The scene.
            robot: For its limits.
            targets: Of arm A and arm B at the start, also order the rocks (2, 3) [m].
            entries: Where the ways in begin, of arm A and arm B (2, 3) [m].
            marks: Mark points of the scene's rocks, five each (5 n, 3) [m].
        """
        self._robot = robot
        c, s = math.cos(scene.base_yaw), math.sin(scene.base_yaw)
        self._world_to_base = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]).T  # rows times this
        self._base = np.array([scene.base_x, scene.base_y, 0.0])
        self._scales = 1.0 / np.array([robot.window, robot.speed_limits, robot.torque_limits])
        self._joints = np.empty((3, JOINTS))
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
            far = [math.hypot(rock.x - x, rock.y - y) for rock in scene.rocks]
            order = sorted(range(len(far)), key=far.__getitem__)
            used = rows[: len(order)]
            used[:, :3] = self.to_base(marks[::5][order])
            used[:, 3] = [scene.rocks[index].flank for index in order]
            used[:, 4] = 1.0
        return rows

    def to_base(self, points: Array) -> Array:
        """Express points (n, 3) [m] of the world in the robot's base frame."""
        moved: Array = (points - self._base) @ self._world_to_base
        return moved

    def fill(
        self,
        robot: RobotState,
        body: AstronautState,
        targets: Array,
        entries: Array,
        skeleton: Array,
        action: Array,
        phase: Array,
    ) -> NDArray[np.float32]:
        """Return the flat observation (SIZE,), float32, every entry clipped to ``BOUND``."""
        out = self._template.copy()
        points = self.to_base(np.concatenate([robot.ends, targets, entries, body.centre[None], skeleton]))
        turned = np.concatenate([robot.directions, body.rotation[:, :2].T, body.velocity[None], body.spin[None]])
        turned = turned @ self._world_to_base
        joints = self._joints
        joints[0] = robot.angles - self._robot.initial
        joints[1], joints[2] = robot.speeds, robot.torques
        joints *= self._scales
        arms = out[_ARMS].reshape(2, -1)
        arms[:, :15] = joints[:, :WAIST].reshape(3, 2, 5).transpose(1, 0, 2).reshape(2, 15)
        arms[:, 15:18], arms[:, 18:] = points[:2], turned[:2]
        out[_WAIST] = joints[:, WAIST]
        goals = out[_GOALS].reshape(3, 2, 3)
        goals[0] = points[2:4]
        goals[1:] = points[2:6].reshape(2, 2, 3) - points[:2]
        astronaut = out[_BODY]
        astronaut[:3] = points[6]
        astronaut[3:15] = turned[2:6].ravel()
        astronaut[15:] = points[7:].ravel()
        out[_ACTION] = action
        out[_PHASE] = phase
        np.maximum(out, -BOUND, out=out)
        np.minimum(out, BOUND, out=out)
        return out.astype(np.float32)
