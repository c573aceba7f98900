"""The way to a sub-goal as changes of joint angles: what the arms' own kinematics tell of it.

A sub-goal is a place of the arms; LLN moves joints. With the place alone, LLN's network had to become the inverse
kinematics of two arms on one waist before it could follow anything, and at the end of a training it still hardly
answered errors under 5 cm (measured, see the training log). So LLN sees the way to its sub-goal twice: in metres, and
as the damped least-squares step of arms and waist (Buss, "Introduction to inverse kinematics", 2004) that would close
it. It is an observation and nothing more: no output is added to LLN's, which has to learn what to make of it under
load, in contact and among rocks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import END_FROM_TIP, FOREARM, PLATE, SHOULDER_Y, TORSO, UPPER_ARM
from lunar_rescue.physics.robot import ARM_WINDOW, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.learning.actions import LARGEST_CHANGE, LOWER, UPPER

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

DAMPING = 0.05  # m, of the same order as the smallest errors that matter
FURTHEST = 2.0  # LARGEST_CHANGE, what is seen is cut there: further ahead tells nothing new
LEVEL = 0.15  # m, what a plate that is not level across counts beside places
_LARGEST = LARGEST_CHANGE * ARM_WINDOW  # rad in a step
_START = INITIAL_ARM.astype(np.float32)
_SIDES = np.array([1.0, -1.0])[:, None]
_ANGLES = [slice(SLICES[key].start, SLICES[key].start + 5) for key in ("P_A", "P_B")]
_WAIST = SLICES["P_W"].start


def changes_with_joints(waist: Array, q: Array) -> tuple[Array, Array]:
    """What an arm's joints and the waist do to its end and plate; arm B is arm A mirrored.

    Args:
        waist: Waist angle (n,) [rad].
        q: Joints of one arm (n, 5) [rad].

    Returns:
        Changes of the end (3) [m], of the height of the unit vector along the plate and of the y of its normal with the
        five joints and the waist (n, 5, 6) [1/rad], and that y now (n,).
    """
    s, c = np.sin(q), np.cos(q)
    pitch = waist - q[:, 0]  # both turn about the same axis
    sp, cp, s1, c1 = np.sin(pitch), np.cos(pitch), s[:, 1], c[:, 1]
    nothing = np.zeros_like(waist)
    upper_x = np.stack([cp, nothing, -sp], axis=1)
    upper_y = np.stack([sp * s1, c1, cp * s1], axis=1)
    upper_z = np.stack([sp * c1, -s1, cp * c1], axis=1)
    s, c = s[:, :, None], c[:, :, None]
    turned_x, turned_y = c[:, 2] * upper_x + s[:, 2] * upper_y, c[:, 2] * upper_y - s[:, 2] * upper_x
    fore_x, fore_z = c[:, 3] * turned_x + s[:, 3] * upper_z, c[:, 3] * upper_z - s[:, 3] * turned_x
    normal = c[:, 4] * fore_x + s[:, 4] * turned_y
    direction = -fore_z
    to_wrist = FOREARM * direction
    to_end = (PLATE - END_FROM_TIP) * direction
    from_elbow = to_wrist + to_end
    from_shoulder = from_elbow - UPPER_ARM * upper_z
    shoulder = [TORSO * np.sin(waist), nothing + SHOULDER_Y, TORSO * np.cos(waist)]  # above the waist
    from_waist = from_shoulder + np.stack(shoulder, axis=1)
    down = np.zeros_like(upper_x)
    down[:, 1] = -1.0
    axes = np.stack([down, upper_x, upper_z, -turned_y, fore_z, -down], axis=2)
    arms = np.stack([from_shoulder, from_shoulder, from_shoulder, from_elbow, to_end, from_waist], axis=2)
    ax, ay, az = axes[:, 0], axes[:, 1], axes[:, 2]
    rx, ry, rz = arms[:, 0], arms[:, 1], arms[:, 2]
    dx, dy, nx, nz = direction[:, :1], direction[:, 1:2], normal[:, :1], normal[:, 2:]
    rows = [ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx, ax * dy - ay * dx, az * nx - ax * nz]
    return np.stack(rows, axis=1), normal[:, 1]


def sideways_tilt(observations: Floats) -> Floats:
    """How far each plate is from level across, (n, 2) [m], counting ``LEVEL`` for a plate on edge."""
    q = np.stack([observations[:, where] for where in _ANGLES], axis=1) * np.float32(ARM_WINDOW) + _START
    s, c = np.sin(q), np.cos(q)
    across = c[..., 4] * (c[..., 3] * s[..., 2] * c[..., 1] - s[..., 3] * s[..., 1]) + s[..., 4] * c[..., 2] * c[..., 1]
    return np.float32(LEVEL) * across


def joint_step(observations: Floats, way: Floats, rise: float) -> Floats:
    """The step of all joints towards a sub-goal.

    Args:
        observations: Flat observations (n, SIZE).
        way: From where the arms are to where they are wanted: both ends, then the rise of both plates (n, 8) [m].
        rise: What the slope of a plate counts beside places [m].

    Returns:
        Arm A, arm B, waist (n, 11), in units of the largest change of a step, cut at ``FURTHEST``.
    """
    count = len(observations)
    angles = np.stack([observations[:, where] for where in _ANGLES]).astype(np.float64) * ARM_WINDOW + INITIAL_ARM
    waist = observations[:, _WAIST].astype(np.float64) * WAIST_WINDOW
    changes, normal_y = changes_with_joints(np.tile(waist, 2), angles.reshape(-1, 5))
    changes[:, 3] *= rise
    changes[:, 4] *= LEVEL
    wanted = np.zeros((2, count, 5))
    wanted[:, :, :3] = way[:, :6].reshape(count, 2, 3).transpose(1, 0, 2)
    wanted[:, :, 1] *= _SIDES
    wanted[:, :, 3] = way[:, 6:].T
    wanted[:, :, 4] = -LEVEL * normal_y.reshape(2, count)
    blocks = changes.reshape(2, count, 5, 6)
    jacobian = np.zeros((count, 10, JOINTS))
    jacobian[:, :5, :5], jacobian[:, 5:, 5:WAIST] = blocks[0, :, :, :5], blocks[1, :, :, :5]
    jacobian[:, :5, WAIST], jacobian[:, 5:, WAIST] = blocks[0, :, :, 5], blocks[1, :, :, 5]
    error = wanted.transpose(1, 0, 2).reshape(count, 10, 1)
    step = _damped_step(jacobian, error)
    now = np.concatenate([angles[0], angles[1], waist[:, None]], axis=1)
    ahead = now + np.clip(step, -_LARGEST, _LARGEST)
    # A joint that would leave its range is held, or the others would not make up for it.
    held = (ahead > UPPER) & (step > 0) | (ahead < LOWER) & (step < 0)
    rows = held.any(axis=1)
    if rows.any():
        step[rows] = _damped_step(jacobian[rows] * ~held[rows, None, :], error[rows])
    return np.clip(step / _LARGEST, -FURTHEST, FURTHEST).astype(np.float32)


def _damped_step(jacobian: Array, error: Array) -> Array:
    """The step (n, joints) that closes errors (n, rows, 1), damped."""
    across = jacobian.transpose(0, 2, 1)
    step: Array = (across @ np.linalg.solve(jacobian @ across + DAMPING**2 * np.eye(error.shape[1]), error))[:, :, 0]
    return step
