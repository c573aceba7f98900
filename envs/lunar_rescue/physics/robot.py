"""The robot: a waist and two arms, read and driven through the simulation (P6)."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.client import ROBOT_FILE
from lunar_rescue.physics.simulation import Simulation
from lunar_rescue.physics.solver import CONTROL_STEP

Array = NDArray[np.float64]

ARM_JOINTS = ("shoulder_pitch", "shoulder_roll", "elbow_yaw", "elbow_roll", "wrist_yaw")
ARM_LINKS = ("shoulder", "upper_arm", "elbow", "forearm", "plate", "end")
JOINT_SPEED = 1.5  # rad/s, every joint; the robot file has the same
ARM_WINDOW = np.radians(60.0)  # rad, Eq. 3
WAIST_WINDOW = np.radians(60.0)  # rad; Eq. 3 leaves the waist out, the same window is our choice
INITIAL_ARM = np.radians([0.0, 8.0, 0.0, 140.0, 0.0])  # rad, q_init: forearms raised, clear of any posture
INITIAL_WAIST = 0.0  # rad, upright
INITIAL = np.concatenate([INITIAL_ARM, INITIAL_ARM, [INITIAL_WAIST]])  # rad, of arm A, arm B, waist (11,)
WINDOW = np.array([ARM_WINDOW] * 10 + [WAIST_WINDOW])  # rad, of the same joints


@dataclass(frozen=True)
class Arm:
    """Indices of one arm; the same class serves both."""

    name: str  # ``"A"`` (left) or ``"B"`` (right)
    side: int  # +1 for left, -1 for right
    joints: slice  # slice of this arm in joint vectors
    links: slice  # slice of this arm in link arrays; its last row is the arm's end


ARM_A = Arm("A", 1, slice(0, 5), slice(0, 6))
ARM_B = Arm("B", -1, slice(5, 10), slice(6, 12))
ARMS = (ARM_A, ARM_B)
WAIST = 10  # index of the waist in joint vectors
JOINTS = 11
ENDS = np.array([5, 11])  # rows of the two arm ends in link arrays
PLATES = np.array([4, 10])  # and of the two plates' joints


JOINT_NAMES = (*(f"{arm.name}_{joint}" for arm in ARMS for joint in ARM_JOINTS), "waist")


@dataclass(frozen=True)
class JointLimits:
    """What the robot file allows each joint, arm A, arm B, waist."""

    lower: Array  # least angles (11,) [rad]
    upper: Array  # greatest angles (11,) [rad]
    torque: Array  # most that each motor exerts (11,) [N m]
    speed: Array  # most that each joint turns (11,) [rad/s]


@lru_cache(maxsize=1)
def joint_limits() -> JointLimits:
    """Read the limits of all joints from the robot file, which is the only place where they stand."""
    joints = {joint.get("name"): joint.find("limit") for joint in ElementTree.parse(ROBOT_FILE).iter("joint")}
    rows = []
    for name in JOINT_NAMES:
        limit = joints.get(name)
        if limit is None:
            raise ValueError(f"{ROBOT_FILE}: expected a joint {name!r} with limits")
        rows.append([float(limit.get(key, "nan")) for key in ("lower", "upper", "effort", "velocity")])
    table = np.array(rows)
    table.flags.writeable = False
    return JointLimits(*table.T)


@dataclass(frozen=True)
class RobotState:
    """What the robot's own sensors tell."""

    angles: Array  # arm A, arm B, waist (11,) [rad]
    speeds: Array  # (11,) [rad/s]
    torques: Array  # motor torques (11,) [N m]
    points: Array  # five joints and the end of each arm in the world (12, 3) [m]
    directions: Array  # unit vectors along the two plates in the world (2, 3)

    @property
    def ends(self) -> Array:
        """Return the two arm ends, (2, 3) [m]."""
        return self.points[ENDS]


class Robot:
    """Loads the robot once; ``reset`` puts it somewhere, ``drive`` sends an action."""

    def __init__(self, simulation: Simulation) -> None:
        """Load the robot file and look joints and links up by name."""
        self._simulation = simulation
        self.handle = simulation.load_robot()
        table = simulation.joint_table(self.handle)
        self.links = len(table)
        by_joint = {row[1]: row for row in table}
        by_link = {row[2]: row[0] for row in table}
        self.names = list(JOINT_NAMES)
        rows = [by_joint[name] for name in self.names]
        self._joints = [row[0] for row in rows]
        self._points = [by_link[f"{arm.name}_{link}"] for arm in ARMS for link in ARM_LINKS]
        self.arm_links = [{by_link[f"{arm.name}_{link}"] for link in ARM_LINKS} for arm in ARMS]
        limits = joint_limits()
        _check_limits(np.array([row[3:7] for row in rows]), limits)
        self.lower, self.upper = limits.lower, limits.upper
        self.torque_limits, self.speed_limits = limits.torque, limits.speed
        self.initial, self.window = INITIAL.copy(), WINDOW.copy()
        self._torque_list = self.torque_limits.tolist()
        self._reach_per_step = JOINT_SPEED * CONTROL_STEP
        self._keep_apart(by_link)

    def _keep_apart(self, by_link: dict[str, int]) -> None:
        """Let arms collide with each other and with base and torso, and leave out pairs that can never meet."""
        lower_arms = [[by_link[f"{arm.name}_{part}"] for part in ("forearm", "plate")] for arm in ARMS]
        pairs = {(a, b) for a in lower_arms[0] for b in lower_arms[1]}
        pairs |= {(body, link) for body in (-1, by_link["torso"]) for arm in lower_arms for link in arm}
        self._simulation.collide_only(self.handle, self.links, pairs)
        self._simulation.limit_speed(self.handle, self.links, JOINT_SPEED)

    def joint_targets(self, action: Array) -> Array:
        """Return Eq. 3's q = q_init + 60 deg * action, the waist too, clipped to the joints' limits, (11,) [rad]."""
        wanted: Array = np.minimum(np.maximum(self.initial + self.window * action, self.lower), self.upper)
        return wanted

    def action_for(self, angles: Array) -> Array:
        """Return the action that asks for these angles (11,) [rad], the inverse of Eq. 3, clipped to [-1, 1]."""
        return np.clip((angles - self.initial) / self.window, -1.0, 1.0)

    def set_motors(self, torque: tuple[float, ...] = (), gains: tuple[float, ...] = ()) -> None:
        """Give each motor a share of its torque limit and of its gain, (11,) each, from the next set-points on.

        Without them motors are as they should be. What the robot knows of itself, its limits among it, stays the same.
        """
        self._torque_list = (self.torque_limits * torque if torque else self.torque_limits).tolist()
        self._simulation.motor_gains = np.array(gains) if gains else None

    def rest(self) -> None:
        """Put the joints at q_init, where no link is near another."""
        self._simulation.reset_joints(self.handle, self._joints, self.initial)

    def reset(self, x: float, y: float, yaw: float) -> None:
        """Put the base somewhere and the joints at q_init, at rest, motors holding."""
        quaternion = np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
        self._simulation.place(self.handle, np.array([x, y, 0.0]), quaternion)
        self.rest()
        self._simulation.drive(self.handle, self._joints, self.initial.tolist(), self._torque_list)

    def drive(self, action: Array, angles: Array) -> None:
        """Send an action; the set-point runs ahead of ``angles`` by no more than the speed limit allows."""
        reach = self._reach_per_step
        ahead = np.minimum(np.maximum(self.joint_targets(action) - angles, -reach), reach)
        self._simulation.drive(self.handle, self._joints, (angles + ahead).tolist(), self._torque_list)

    def switch_off(self) -> None:
        """Switch all motors off, so that every joint swings freely."""
        self._simulation.release(self.handle, self._joints)

    def state(self, *, fresh: bool = False) -> RobotState:
        """Read the robot's sensors; right after a reset (``fresh``) Bullet still reports the last episode's torques."""
        angles, speeds, torques = self._simulation.joint_states(self.handle, self._joints)
        torques = np.zeros_like(torques) if fresh else torques
        points = self._simulation.link_positions(self.handle, self._points)
        along = points[ENDS] - points[PLATES]
        along /= np.sqrt(np.einsum("ij,ij->i", along, along))[:, None]
        return RobotState(angles, speeds, torques, points, along)


def checked_action(action: NDArray[np.floating[Any]]) -> Array:
    """Return an action (11,) clipped to [-1, 1]; one of another shape, or that is not finite, is a ``ValueError``."""
    array = np.asarray(action, dtype=np.float64)
    if array.shape != (JOINTS,) or not math.isfinite(array.sum()):
        raise ValueError(f"action: expected {JOINTS} finite numbers, got shape {array.shape}: {action!r}")
    return np.minimum(np.maximum(array, -1.0), 1.0)


def _check_limits(read: Array, limits: JointLimits) -> None:
    """Refuse a robot whose limits, (11, 4) as the simulator read them, are not those of the file.

    Bullet reads numbers in the process's locale: with a decimal comma it would take -1.745 for -1.
    """
    for name, own, expected in zip(
        JOINT_NAMES, read, np.column_stack([limits.lower, limits.upper, limits.torque, limits.speed]), strict=True
    ):
        if not np.array_equal(own, expected):
            raise RuntimeError(f"{ROBOT_FILE}: joint {name!r}: expected limits {expected}, the simulator read {own}")
