"""Inverse kinematics of many arms at once: what ``kinematics.solve_arm`` solves, a hundred times as fast.

A planner asks for hundreds of poses a scene. The geometry is that of ``lunar_rescue.physics.kinematics``, against which
a test compares the results; arm B is arm A mirrored.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.kinematics import END_FROM_TIP, FOREARM, PLATE, SHOULDER_Y, TORSO, UPPER_ARM, WAIST_HEIGHT

Array = NDArray[np.float64]

ITERATIONS = 30
DAMPING = 1e-2  # to begin with; less after a step that helped, more after one that did not
# The weights of solve_arm's residual.
PLACE, LEVEL, POSTURE = 5.0, 0.3, 0.01
REACH = PLATE - END_FROM_TIP  # m, from wrist to end


def _about(axis: int, angle: Array) -> Array:
    """Rotations (n, 3, 3) about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.zeros((len(angle), 3, 3))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[:, axis, axis] = 1.0
    matrix[:, first, first] = matrix[:, second, second] = c
    matrix[:, first, second], matrix[:, second, first] = -s, s
    return matrix


def _chain(waist: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """End (n, 3), plate's direction and normal (n, 3) and, for each, its change with the joints (n, 9, 5)."""
    torso = _about(1, waist)
    lifted = torso @ _about(1, -q[:, 0])
    upper = lifted @ _about(0, q[:, 1])
    turned = upper @ _about(2, q[:, 2])
    fore = turned @ _about(1, -q[:, 3])
    plate = fore @ _about(2, q[:, 4])
    shoulder = torso @ np.array([0.0, SHOULDER_Y, TORSO]) + [0.0, 0.0, WAIST_HEIGHT]
    elbow = shoulder - UPPER_ARM * upper[:, :, 2]
    wrist = elbow - FOREARM * fore[:, :, 2]
    direction, normal = -fore[:, :, 2], plate[:, :, 0]
    end = wrist + REACH * direction
    axes = np.stack([-torso[:, :, 1], lifted[:, :, 0], upper[:, :, 2], -turned[:, :, 1], fore[:, :, 2]], axis=1)
    pivots = np.stack([shoulder, shoulder, shoulder, elbow, wrist], axis=1)
    moves = np.cross(axes, end[:, None] - pivots)
    tips = np.cross(axes, direction[:, None])
    tips[:, 4] = 0.0
    turns = np.cross(axes, normal[:, None])
    return end, direction, normal, np.concatenate([moves, tips, turns], axis=2).transpose(0, 2, 1)


def solve_arms(
    targets: Array, slopes: Array, waists: Array, side: int, starts: Array, lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Solve n poses of one arm by Levenberg-Marquardt steps.

    Args:
        targets: Wanted end positions, base frame (n, 3) [m].
        slopes: Wanted angles of the forearm above the horizontal (n,) [rad].
        waists: Waist angles, held (n,) [rad].
        side: +1 for arm A, -1 for arm B.
        starts: First guesses, also the preferred postures (n, 5) [rad].
        lower: Lower joint bounds (5,) [rad].
        upper: Upper joint bounds (5,) [rad].

    Returns:
        The joints (n, 5) [rad] and the remaining distances from the targets (n,) [m].
    """
    wanted = targets * [1.0, float(side), 1.0]
    q = np.clip(starts, lower, upper)
    damping = np.full(len(q), DAMPING)
    residual, jacobian = _residual(q, wanted, slopes, waists, starts)
    for _ in range(ITERATIONS):
        gradient = np.einsum("nij,ni->nj", jacobian, residual)
        # A joint at its bound that wants further out is held, or the others would not make up for it.
        held = ((q <= lower) & (gradient > 0)) | ((q >= upper) & (gradient < 0))
        free = jacobian * ~held[:, None, :]
        matrix = free.transpose(0, 2, 1) @ free + np.eye(5) * (damping[:, None, None] + held[:, :, None])
        step = np.linalg.solve(matrix, (gradient * ~held)[:, :, None])[:, :, 0]
        trial = np.clip(q - step, lower, upper)
        new_residual, new_jacobian = _residual(trial, wanted, slopes, waists, starts)
        better = (new_residual**2).sum(axis=1) <= (residual**2).sum(axis=1)
        q = np.where(better[:, None], trial, q)
        residual = np.where(better[:, None], new_residual, residual)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        damping = np.clip(np.where(better, damping * 0.2, damping * 6.0), 1e-7, 1e3)
    return q, np.linalg.norm(residual[:, :3], axis=1) / PLACE


def _residual(q: Array, wanted: Array, slopes: Array, waists: Array, starts: Array) -> tuple[Array, Array]:
    """The residual (n, 10) of ``solve_arm`` and its change with the joints (n, 10, 5)."""
    end, direction, normal, changes = _chain(waists, q)
    level = LEVEL * np.stack([normal[:, 1], direction[:, 2] - np.sin(slopes)], axis=1)
    residual = np.concatenate([PLACE * (end - wanted), level, POSTURE * (q - starts)], axis=1)
    posture = np.broadcast_to(POSTURE * np.eye(5), (len(q), 5, 5))
    return residual, np.concatenate([PLACE * changes[:, :3], LEVEL * changes[:, [7, 5]], posture], axis=1)


def plate_tips(waists: Array, q: Array, side: int) -> Array:
    """Tips of the plates in the base frame (n, 3) [m]."""
    end, direction, _, _ = _chain(waists, q)
    tips: Array = (end + END_FROM_TIP * direction) * [1.0, float(side), 1.0]
    return tips
