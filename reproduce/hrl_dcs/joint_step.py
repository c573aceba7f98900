"""Express the way to a sub-goal as changes of joint angles, by the arms' own kinematics.

A sub-goal is a place of the arms; LLN moves joints. With the place alone, LLN's network had to become the inverse
kinematics of two arms on one waist before it could follow anything, and at the end of a training it still hardly
answered errors under 5 cm (measured, see the training log). So, with this prior, LLN also sees the way to its sub-goal
as the damped least-squares step of arms and waist (Buss, "Introduction to inverse kinematics", 2004) that would close
it. It is an observation and nothing more: no output is added to LLN's, which has to learn what to make of it under
load, in contact and among rocks.
"""

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import ArmChain
from lunar_rescue.physics.robot import ARM_WINDOW, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.hrl_dcs.config import GoalConfig
from reproduce.learning.actions import LARGEST_CHANGE, LOWER, UPPER

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

_LARGEST = LARGEST_CHANGE * ARM_WINDOW  # rad in a step
_ANGLES = [slice(SLICES[key].start, SLICES[key].start + 5) for key in ("P_A", "P_B")]
_WAIST = SLICES["P_W"].start


def joint_step(observations: Floats, way: Floats, config: GoalConfig) -> Floats:
    """Return the step of all joints, arm A, arm B, waist (n, 11), that would close the way to a sub-goal.

    The way is from where both arm ends are to where they are wanted, (n, 6) [m]. The step is in units of the largest
    change of a step, cut at ``config.furthest``.
    """
    count = len(observations)
    angles = np.stack([observations[:, where] for where in _ANGLES]).astype(np.float64) * ARM_WINDOW + INITIAL_ARM
    waist = observations[:, _WAIST].astype(np.float64) * WAIST_WINDOW
    chain = ArmChain(np.tile(waist, 2), angles.reshape(-1, 5))
    changes = chain.jacobian()[:, :3].reshape(2, count, 3, 6)
    jacobian = np.zeros((count, 6, JOINTS))
    jacobian[:, :3, :5], jacobian[:, 3:, 5:WAIST] = changes[..., :5]
    jacobian[:, :3, WAIST], jacobian[:, 3:, WAIST] = changes[..., 5]
    error = way.astype(np.float64).reshape(count, 2, 3)
    error[:, 1, 1] *= -1.0  # arm B is arm A mirrored
    error = error.reshape(count, 6, 1)
    step = _damped_step(jacobian, error, config.damping)
    ahead = np.concatenate([*angles, waist[:, None]], axis=1) + np.clip(step, -_LARGEST, _LARGEST)
    # A joint that would leave its range is held, or the others would not make up for it.
    held = (ahead > UPPER) & (step > 0) | (ahead < LOWER) & (step < 0)
    rows = held.any(axis=1)
    if rows.any():
        step[rows] = _damped_step(jacobian[rows] * ~held[rows, None, :], error[rows], config.damping)
    return np.clip(step / _LARGEST, -config.furthest, config.furthest).astype(np.float32)


def _damped_step(jacobian: Array, error: Array, damping: float) -> Array:
    """Return the damped least-squares step (n, joints) that closes errors (n, rows, 1)."""
    across = jacobian.transpose(0, 2, 1)
    step: Array = (across @ np.linalg.solve(jacobian @ across + damping**2 * np.eye(error.shape[1]), error))[:, :, 0]
    return step
