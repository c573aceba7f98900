"""One view of two scenes that are mirror images: the astronaut's head always lies on arm A's side.

The robot is its own mirror image, and so is a rescue: what arm A does for a head on the left, arm B does for a head on
the right. Every learner therefore sees, and acts in, a frame that is reflected where the head lies on arm B's side
when the episode begins, so that it learns half as many different rescues. It is a change of coordinates of observation
and action, exact and the same for all methods that learn; the environment knows nothing of it.

A reflection at the robot's plane of symmetry swaps the arms and left and right limbs and turns y of points and
directions round. Spin is an axial vector, and the astronaut's left axis becomes the right one of the mirror image, so
of these x and z turn round instead. Joint angles are counted alike for both arms (``lunar_rescue.kinematics``), so they
are swapped and keep their signs.
"""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import GROUND_POINTS, SIZE, SLICES
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.suit import KEYPOINT_NAMES

Floats = NDArray[np.float32]

POLAR = (1.0, -1.0, 1.0)  # points and directions
AXIAL = (-1.0, 1.0, -1.0)
_OTHER = {"left": "right", "right": "left"}

#: Where each joint's action comes from: arm B's, arm A's, the waist's own.
ACTIONS = np.r_[5:10, 0:5, 10]


def _observation_map() -> tuple[NDArray[np.int64], Floats]:
    """Return where each entry of a mirrored observation comes from, and its sign, (SIZE,) each."""
    source, sign = np.arange(SIZE), np.ones(SIZE, np.float32)

    def put(key: str, order: Any, signs: Any = 1.0) -> None:
        where = SLICES[key]
        source[where], sign[where] = where.start + np.asarray(order), signs

    arm_a, arm_b = SLICES["P_A"], SLICES["P_B"]
    source[arm_a], source[arm_b] = np.arange(arm_b.start, arm_b.stop), np.arange(arm_a.start, arm_a.stop)
    sign[arm_a] = sign[arm_b] = [1.0] * 15 + [*POLAR] * 2  # angles, speeds, torques; end, direction
    put("P_G", np.arange(18).reshape(3, 2, 3)[:, ::-1].ravel(), [*POLAR] * 6)
    names = [re.sub("left|right", lambda side: _OTHER[side[0]], name, count=1) for name in KEYPOINT_NAMES]
    points = 15 + 3 * np.array([KEYPOINT_NAMES.index(name) for name in names])
    body = [*POLAR, *POLAR, *AXIAL, *POLAR, *AXIAL]  # centre, front, left, velocity, spin
    put("P_P", [*range(15), *(points[:, None] + np.arange(3)).ravel()], body + [*POLAR] * len(KEYPOINT_NAMES))
    put("P_E", np.arange(5 * MAX_ROCKS), [*POLAR, 1.0, 1.0] * MAX_ROCKS)
    ground = 3 + np.arange(2 * GROUND_POINTS).reshape(2, GROUND_POINTS)[::-1].ravel()
    put("P_T", [0, 1, 2, *ground], [*POLAR] + [1.0] * 2 * GROUND_POINTS)
    put("P_R", np.arange(4), [1.0, -1.0, 1.0, -1.0])  # x, y, cos and sin of the heading
    put("a_prev", ACTIONS)
    return source, sign


_SOURCE, _SIGN = _observation_map()
_HEAD = SLICES["P_P"].start + 15 + 3 * KEYPOINT_NAMES.index("head") + 1  # y of the head
_CENTRE = SLICES["P_P"].start + 1  # y of the centre of gravity


def mirror_observations(observations: Floats) -> Floats:
    """Return observations (n, SIZE) as they would be in the mirror image; twice gives what was there."""
    return observations[:, _SOURCE] * _SIGN


def mirror_actions(actions: Floats) -> Floats:
    """Return actions (n, JOINTS) for the mirror image."""
    return actions[:, ACTIONS]


def mirror_points(points: Floats) -> Floats:
    """Return a point per arm, (n, 2, 3) [m], in the mirror image."""
    return points[:, ::-1] * np.array(POLAR, np.float32)


class Mirror:
    """Which of several environments are seen mirrored; decided when an episode begins."""

    def __init__(self, count: int) -> None:
        """Begin with no environment seen mirrored."""
        self.mirrored = np.zeros(count, bool)

    def begin(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Decide for environments that begin an episode with these observations (n, SIZE)."""
        self.mirrored = np.where(starts, observations[:, _HEAD] < observations[:, _CENTRE], self.mirrored)

    def observations(self, observations: Floats) -> Floats:
        """Return observations as the learner sees them, (n, SIZE)."""
        return np.where(self.mirrored[:, None], mirror_observations(observations), observations)

    def actions(self, actions: Floats) -> Floats:
        """Return the learner's actions as the environments want them, or the other way round, (n, JOINTS)."""
        return np.where(self.mirrored[:, None], mirror_actions(actions), actions)

    def points(self, points: Floats) -> Floats:
        """Return what the learner points at, as it lies in the environments, (n, 2, 3) [m]."""
        return np.where(self.mirrored[:, None, None], mirror_points(points), points)
