"""Kinematics of the arms on the waist, for many arms at once, in NumPy and independent of the simulator.

The chain follows ``data/robot.urdf``; a test compares it with the simulator's link positions. Frames: robot base
frame, x forward, y left, z up [m]; angles [rad]. Everything is that of arm A (left). Joints are counted alike for both
arms, so arm B (right) is arm A mirrored: y of its points and directions turns round.
"""

from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lunar_rescue.arrays import Array

Floats = TypeVar("Floats", NDArray[np.float32], Array)

WAIST_HEIGHT, TORSO, SHOULDER_Y = 0.30, 0.42, 0.36
UPPER_ARM, FOREARM, PLATE = 0.50, 0.45, 0.45
END_FROM_TIP = 0.12  # m, the arm's end point lies this far behind the plate's tip, where it carries
SHOULDER, ELBOW, WRIST, END, TIP = range(5)  # rows of ``ArmChain.points``

# Levenberg-Marquardt steps of ``solve_arms``.
ITERATIONS = 15
SETTLED = 1.0e-3  # rad, smaller steps end the search
DAMPING = 1e-2  # to begin with; less after a step that helped, more after one that did not
WEIGHTS = np.array([5.0, 5.0, 5.0, 0.3, 0.3])  # of the end [1/m], the slope and the level across
POSTURE = 0.01  # weight of the distance from the preferred joints [1/rad]


class ArmChain:
    """Place n arms and tell how joints and waist move them.

    ``direction`` are unit vectors along forearm and plate, ``normal`` those normal to the plates' faces (n, 3).
    """

    def __init__(self, waists: Array, joints: Array) -> None:
        """Compute the poses for waist angles (n,), positive leaning forward, and joints (n, 5) [rad].

        The joints are shoulder pitch, shoulder roll, elbow yaw, elbow roll and wrist yaw.
        """
        s, c = np.sin(joints), np.cos(joints)
        pitch = waists - joints[:, 0]  # both turn about the same axis
        sp, cp, s1, c1 = np.sin(pitch), np.cos(pitch), s[:, 1], c[:, 1]
        zeros = np.zeros_like(waists)
        self._upper_x = np.stack([cp, zeros, -sp], axis=1)
        upper_y = np.stack([sp * s1, c1, cp * s1], axis=1)
        self._upper_z = np.stack([sp * c1, -s1, cp * c1], axis=1)
        s, c = s[:, :, None], c[:, :, None]
        turned_x = c[:, 2] * self._upper_x + s[:, 2] * upper_y
        self._turned_y = c[:, 2] * upper_y - s[:, 2] * self._upper_x
        fore_x = c[:, 3] * turned_x + s[:, 3] * self._upper_z
        self._fore_z = c[:, 3] * self._upper_z - s[:, 3] * turned_x
        self.normal: Array = c[:, 4] * fore_x + s[:, 4] * self._turned_y
        self.direction: Array = -self._fore_z
        self._to_end = (PLATE - END_FROM_TIP) * self.direction  # from the wrist
        self._from_elbow = FOREARM * self.direction + self._to_end
        self._from_shoulder = self._from_elbow - UPPER_ARM * self._upper_z
        #: Shoulders above the waist's axis (n, 3) [m].
        self._shoulder = np.stack([TORSO * np.sin(waists), zeros + SHOULDER_Y, TORSO * np.cos(waists)], axis=1)

    @cached_property
    def points(self) -> Array:
        """Shoulder, elbow, wrist, end and tip of the plate, (n, 5, 3) [m]."""
        shoulder = self._shoulder + [0.0, 0.0, WAIST_HEIGHT]
        end = shoulder + self._from_shoulder
        tip = end + END_FROM_TIP * self.direction
        return np.stack([shoulder, end - self._from_elbow, end - self._to_end, end, tip], axis=1)

    @property
    def pose(self) -> Array:
        """What tasks ask of an arm: its end [m], the z of ``direction`` and the y of ``normal``, (n, 5)."""
        return np.column_stack([self.points[:, END], self.direction[:, 2], self.normal[:, 1]])

    def jacobian(self) -> Array:
        """Return the changes of ``pose`` with the five joints and the waist, (n, 5, 6) [m/rad, 1/rad]."""
        down = np.zeros_like(self._upper_x)
        down[:, 1] = -1.0
        axes = np.stack([down, self._upper_x, self._upper_z, -self._turned_y, self._fore_z, -down], axis=2)
        shoulder, from_waist = self._from_shoulder, self._from_shoulder + self._shoulder
        arms = np.stack([shoulder, shoulder, shoulder, self._from_elbow, self._to_end, from_waist], axis=2)
        (ax, ay, az), (rx, ry, rz) = axes.transpose(1, 0, 2), arms.transpose(1, 0, 2)
        dx, dy, nx, nz = self.direction[:, :1], self.direction[:, 1:2], self.normal[:, :1], self.normal[:, 2:]
        rows = [ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx, ax * dy - ay * dx, az * nx - ax * nz]
        return np.stack(rows, axis=1)


def solve_arms(
    targets: Array, slopes: Array, waists: Array, side: int, starts: Array, lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Solve the inverse kinematics of n poses of one arm: ends at targets, plates level across, forearms sloping.

    Ends are wanted at ``targets`` (n, 3) [m] and forearms ``slopes`` (n,) [rad] above the horizontal; the waist stays
    at ``waists`` (n,) [rad]. ``side`` is +1 for arm A, -1 for arm B; ``starts`` (n, 5) [rad] are the first guesses and
    also the preferred postures, within the joints' bounds ``lower`` and ``upper`` (5,) [rad].

    Returns the joints (n, 5) [rad] and the remaining distances of the ends from the targets (n,) [m].
    """
    wanted = np.column_stack([targets * [1.0, float(side), 1.0], np.sin(slopes), np.zeros(len(slopes))])

    def linearise(q: Array) -> tuple[Array, Array]:
        """Return residuals (n, 10) and their changes with the joints (n, 10, 5)."""
        chain = ArmChain(waists, q)
        residual = np.column_stack([WEIGHTS * (chain.pose - wanted), POSTURE * (q - starts)])
        posture = np.broadcast_to(POSTURE * np.eye(5), (len(q), 5, 5))
        return residual, np.concatenate([WEIGHTS[:, None] * chain.jacobian()[:, :, :5], posture], axis=1)

    q = np.clip(starts, lower, upper)
    damping = np.full(len(q), DAMPING)
    residual, jacobian = linearise(q)
    for _ in range(ITERATIONS):
        trial = np.clip(q - _bounded_step(q, residual, jacobian, damping, lower, upper), lower, upper)
        if np.abs(trial - q).max() < SETTLED:
            break
        new_residual, new_jacobian = linearise(trial)
        better = (new_residual**2).sum(axis=1) <= (residual**2).sum(axis=1)
        q = np.where(better[:, None], trial, q)
        residual = np.where(better[:, None], new_residual, residual)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        damping = np.clip(np.where(better, damping * 0.2, damping * 6.0), 1e-7, 1e3)
    return q, np.linalg.norm(residual[:, :3], axis=1) / WEIGHTS[0]


def solve_arm(target: Array, slope: float, waist: float, side: int, start: Array, lower: Array, upper: Array) -> Array:
    """Solve one pose of what ``solve_arms`` solves with SciPy, which stops a little sooner; return the joints (5,)."""
    wanted = np.array([target[0], side * target[1], target[2], np.sin(slope), 0.0])

    def residual(joints: Array) -> Array:
        off = WEIGHTS * (ArmChain(np.array([waist]), joints[None]).pose[0] - wanted)
        return np.concatenate([off, POSTURE * (joints - start)])

    inside = np.clip(start, lower + 1e-6, upper - 1e-6)
    solution = least_squares(residual, inside, bounds=(lower, upper), xtol=1e-6, ftol=1e-6, max_nfev=60)
    return np.asarray(solution.x)


def _bounded_step(q: Array, residual: Array, jacobian: Array, damping: Array, lower: Array, upper: Array) -> Array:
    """Return the damped step (n, 5) against the residuals; a joint at its bound that wants further out is held."""
    gradient = np.einsum("nij,ni->nj", jacobian, residual)
    held = ((q <= lower) & (gradient > 0)) | ((q >= upper) & (gradient < 0))
    free = jacobian * ~held[:, None, :]
    matrix = free.transpose(0, 2, 1) @ free + np.eye(5) * (damping[:, None, None] + held[:, :, None])
    return np.linalg.solve(matrix, (gradient * ~held)[:, :, None])[:, :, 0]
