"""Express the way to a sub-goal as changes of joint angles, by the arms' own kinematics.

A sub-goal is a place of the arms; LLN moves joints. With the place alone, LLN's network had to become the inverse
kinematics of two arms on one waist before it could follow anything, and at the end of a training it still hardly
answered errors under 5 cm (measured, see the training log). So LLN sees the way to its sub-goal twice: in metres, and
as the damped least-squares step of arms and waist (Buss, "Introduction to inverse kinematics", 2004) that would close
it. It is an observation and nothing more: no output is added to LLN's, which has to learn what to make of it under
load, in contact and among rocks.
"""

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import ArmChain, normal_y
from lunar_rescue.physics.robot import ARM_WINDOW, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.hrl_dcs.config import AnchorConfig
from reproduce.learning.actions import LARGEST_CHANGE, LOWER, UPPER

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

_LARGEST = LARGEST_CHANGE * ARM_WINDOW  # rad in a step
_START = INITIAL_ARM.astype(np.float32)
_ANGLES = [slice(SLICES[key].start, SLICES[key].start + 5) for key in ("P_A", "P_B")]
_WAIST = SLICES["P_W"].start


def sideways_tilt(observations: Floats, level: float) -> Floats:
    """Return the sideways tilt of each plate as a distance, (n, 2) [m]: 0 where level, ``level`` where on edge."""
    joints = np.stack([observations[:, where] for where in _ANGLES], axis=1) * np.float32(ARM_WINDOW) + _START
    return np.float32(level) * normal_y(joints)


def joint_step(observations: Floats, way: Floats, anchors: AnchorConfig) -> Floats:
    """Return the step of all joints, arm A, arm B, waist (n, 11), that would close the way to a sub-goal.

    The way is from where the arms are to where they are wanted: both ends, then the rise of both plates (n, 8) [m]. The
    step is in units of the largest change of a step, cut at ``anchors.furthest``.
    """
    count = len(observations)
    angles = np.stack([observations[:, where] for where in _ANGLES]).astype(np.float64) * ARM_WINDOW + INITIAL_ARM
    waist = observations[:, _WAIST].astype(np.float64) * WAIST_WINDOW
    chain = ArmChain(np.tile(waist, 2), angles.reshape(-1, 5))
    weights = np.array([1.0, 1.0, 1.0, anchors.rise, anchors.level])
    changes = (chain.jacobian() * weights[:, None]).reshape(2, count, 5, 6)
    jacobian = np.zeros((count, 10, JOINTS))
    jacobian[:, :5, :5], jacobian[:, 5:, 5:WAIST] = changes[..., :5]
    jacobian[:, :5, WAIST], jacobian[:, 5:, WAIST] = changes[..., 5]
    error = np.zeros((count, 2, 5))
    error[:, :, :3] = way[:, :6].reshape(count, 2, 3)
    error[:, 1, 1] *= -1.0  # arm B is arm A mirrored
    error[:, :, 3] = way[:, 6:]
    error[:, :, 4] = -anchors.level * chain.normal[:, 1].reshape(2, count).T
    error = error.reshape(count, 10, 1)
    step = _damped_step(jacobian, error, anchors.damping)
    ahead = np.concatenate([*angles, waist[:, None]], axis=1) + np.clip(step, -_LARGEST, _LARGEST)
    # A joint that would leave its range is held, or the others would not make up for it.
    held = (ahead > UPPER) & (step > 0) | (ahead < LOWER) & (step < 0)
    rows = held.any(axis=1)
    if rows.any():
        step[rows] = _damped_step(jacobian[rows] * ~held[rows, None, :], error[rows], anchors.damping)
    return np.clip(step / _LARGEST, -anchors.furthest, anchors.furthest).astype(np.float32)


def _damped_step(jacobian: Array, error: Array, damping: float) -> Array:
    """Return the damped least-squares step (n, joints) that closes errors (n, rows, 1)."""
    across = jacobian.transpose(0, 2, 1)
    step: Array = (across @ np.linalg.solve(jacobian @ across + damping**2 * np.eye(error.shape[1]), error))[:, :, 0]
    return step
