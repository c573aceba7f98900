"""Forward and inverse kinematics of one arm on the waist, in NumPy, independent of the simulator.

The chain follows ``data/robot.urdf``; a test compares it with the simulator's link positions. Frames: robot base
frame, x forward, y left, z up [m]; angles [rad]. ``side`` is +1 for arm A (left) and -1 for arm B (right).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

WAIST_HEIGHT, TORSO, SHOULDER_Y = 0.30, 0.42, 0.36
UPPER_ARM, FOREARM, PLATE = 0.50, 0.45, 0.45
END_FROM_TIP = 0.12  # m, the arm's end point lies this far behind the plate's tip, where it carries


@dataclass(frozen=True)
class ArmPose:
    """Where an arm is.

    Attributes:
        points: Shoulder, elbow, wrist and end (4, 3) [m].
        direction: Unit vector along forearm and plate (3,).
        normal: Unit vector normal to the plate's face (3,).
    """

    points: Array
    direction: Array
    normal: Array


def _about(axis: str, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def arm_pose(waist: float, joints: Array, side: int) -> ArmPose:
    """Forward kinematics of one arm.

    Args:
        waist: Waist angle [rad], positive leans forward.
        joints: Shoulder pitch, shoulder roll, elbow yaw, elbow roll, wrist yaw (5,) [rad].
        side: +1 for arm A, -1 for arm B.
    """
    torso = _about("y", waist)
    shoulder = np.array([0.0, 0.0, WAIST_HEIGHT]) + torso @ np.array([0.0, side * SHOULDER_Y, TORSO])
    upper = torso @ _about("y", -joints[0]) @ _about("x", side * joints[1])
    fore = upper @ _about("z", side * joints[2]) @ _about("y", -joints[3])
    plate = fore @ _about("z", side * joints[4])
    elbow = shoulder - UPPER_ARM * upper[:, 2]
    wrist = elbow - FOREARM * fore[:, 2]
    end = wrist - (PLATE - END_FROM_TIP) * fore[:, 2]
    return ArmPose(np.array([shoulder, elbow, wrist, end]), -fore[:, 2], plate[:, 0])


def solve_arm(
    target: Array, slope: float, waist: float, side: int, start: Array, lower: Array, upper: Array
) -> tuple[Array, float]:
    """Inverse kinematics of one arm: end at ``target``, plate level across, forearm sloping by ``slope``.

    Args:
        target: Wanted end position (3,) [m].
        slope: Wanted angle of the forearm above the horizontal [rad].
        waist: Waist angle, held [rad].
        side: +1 for arm A, -1 for arm B.
        start: First guess, also the preferred posture (5,) [rad].
        lower: Lower joint bounds (5,) [rad].
        upper: Upper joint bounds (5,) [rad].

    Returns:
        The joints (5,) [rad] and the remaining distance of the end from the target [m].
    """

    def residual(joints: Array) -> Array:
        pose = arm_pose(waist, joints, side)
        level = [0.3 * pose.normal[1], 0.3 * (pose.direction[2] - np.sin(slope))]
        return np.concatenate([5.0 * (pose.points[-1] - target), level, 0.01 * (joints - start)])

    inside = np.clip(start, lower + 1e-6, upper - 1e-6)
    solution = least_squares(residual, inside, bounds=(lower, upper), xtol=1e-6, ftol=1e-6, max_nfev=60)
    error = float(np.linalg.norm(arm_pose(waist, solution.x, side).points[-1] - target))
    return solution.x, error
