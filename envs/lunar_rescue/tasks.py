"""The two tasks (I) and the two processes of section 4.1: when an episode succeeds, fails or runs out of time."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.astronaut import AstronautState

Array = NDArray[np.float64]

MAX_STEPS = 120  # phi_max: 12 s; a planner needs less than half of them on average
TARGET_RADIUS = 0.10  # m, an arm end is in its target area within this; the plate is 0.15 m wide
LIFT_HEIGHT = 0.20  # m, transport height: over the rocks of the work area
# "Attitude kept": the long axis stays within LIFT_TILT of level as at rest, and the body rolls about it by less than
# LIFT_ROLL, as a rigid body does when it settles into two arms. Beyond the second pair it has been dropped.
LIFT_TILT, LIFT_ROLL = math.radians(30.0), math.radians(45.0)
LOST_TILT, LOST_ROLL = math.radians(60.0), math.radians(110.0)
BACK_ANGLE = math.radians(35.0)  # "on the back": front within this of straight up
HOLD_STEPS = 5  # 0.5 s in the goal pose, so that passing through it does not count
BEARING_SHARE = 0.15  # of the weight, that each arm must bear in a lift; one that only touches does not carry
REST_SPEED, REST_SPIN = 0.1, 0.3  # m/s, rad/s; below both the body is at rest, as it must be at the end
# What a person would stand (assumptions): an arm presses no harder than a plate on Earth does under a person of 82 kg,
# the median of NASA-STD-3000; nobody is moved faster than bearers walk, or pushed harder than half of g on Earth.
GENTLE_FORCE, GENTLE_SPEED, GENTLE_ACCELERATION = 806.0, 1.0, 4.9  # N, m/s, m/s^2
# Horizontal way of the centre of gravity from its start beyond which the arms cannot follow, by process [m].
LOST_DISTANCE = {1: 0.6, 2: 1.6}
SMALLEST_ERROR = 1e-3  # keeps distances positive, as Eq. 2's exponent and the reward functions want them


def is_gentle(peak_force: float, peak_speed: float, peak_acceleration: float) -> bool:
    """Tell whether a person would stand these peaks [N, m/s, m/s^2]."""
    return peak_force <= GENTLE_FORCE and peak_speed <= GENTLE_SPEED and peak_acceleration <= GENTLE_ACCELERATION


@dataclass(frozen=True)
class Contacts:
    """Contacts that decide about success, asked for only when the pose is right."""

    ground: bool  # astronaut touches the ground
    rock: bool  # astronaut touches a rock
    shares: tuple[float, float]  # of the astronaut's weight, that arm A and arm B bear


class Task(ABC):
    """The goal of the second process; one instance an episode."""

    name: str

    def __init__(self, start: AstronautState) -> None:
        """Remember the pose at rest, from which the task counts."""
        self.start = start

    @abstractmethod
    def pose_error(self, state: AstronautState) -> float:
        """Return the distance of the pose from the goal pose, positive; about 1 at the start of the second process."""

    @abstractmethod
    def pose_reached(self, state: AstronautState) -> bool:
        """Tell whether pose and centre of gravity are in the target state, contacts aside."""

    @abstractmethod
    def contacts_right(self, contacts: Contacts) -> bool:
        """Tell whether the pose is held in the way that the task demands."""

    def at_rest(self, state: AstronautState) -> bool:
        """Tell whether the body neither moves nor turns."""
        return math.hypot(*state.velocity) < REST_SPEED and math.hypot(*state.spin) < REST_SPIN

    def failure(self, state: AstronautState, process: int) -> str | None:
        """Return a word for what went wrong beyond repair, or None."""
        moved = state.centre - self.start.centre
        if math.hypot(moved[0], moved[1]) > LOST_DISTANCE[process]:
            return "out_of_reach"
        return None


class Lift(Task):
    """Centre of gravity raised to transport height, attitude kept, off the ground, carried by both arms."""

    name = "lift"

    def rise(self, state: AstronautState) -> float:
        """Return the height gained by the centre of gravity [m]."""
        return float(state.centre[2] - self.start.centre[2])

    def tilt(self, state: AstronautState) -> float:
        """Return the change of the long axis' inclination since the start [rad]."""
        return abs(_asin(state.rotation[2, 2]) - _asin(self.start.rotation[2, 2]))

    def roll(self, state: AstronautState) -> float:
        """Return the change of the front's elevation since the start [rad], the roll about a level long axis."""
        return abs(_asin(state.front_up) - _asin(self.start.front_up))

    def pose_error(self, state: AstronautState) -> float:
        """Return the missing height over the transport height, plus tilt and roll beyond what is allowed [rad]."""
        missing = max(0.0, LIFT_HEIGHT - self.rise(state)) / LIFT_HEIGHT
        beyond = max(0.0, self.tilt(state) - LIFT_TILT) + max(0.0, self.roll(state) - LIFT_ROLL)
        return SMALLEST_ERROR + missing + beyond

    def pose_reached(self, state: AstronautState) -> bool:
        """Tell whether the body is high enough and level enough."""
        return self.rise(state) >= LIFT_HEIGHT and self.tilt(state) <= LIFT_TILT and self.roll(state) <= LIFT_ROLL

    def contacts_right(self, contacts: Contacts) -> bool:
        """Tell whether both arms carry the body, and neither ground nor rocks do."""
        return not contacts.ground and not contacts.rock and min(contacts.shares) >= BEARING_SHARE

    def failure(self, state: AstronautState, process: int) -> str | None:
        """Return a word also when the body has tilted or rolled out of the arms."""
        if self.tilt(state) > LOST_TILT or self.roll(state) > LOST_ROLL:
            return "attitude_lost"
        return super().failure(state, process)


class TurnOver(Task):
    """Rolled onto the back, lying on the ground."""

    name = "turn_over"

    def pose_error(self, state: AstronautState) -> float:
        """Return the angle that the body has still to roll [rad]."""
        return SMALLEST_ERROR + max(0.0, math.acos(min(1.0, max(-1.0, state.front_up))) - BACK_ANGLE)

    def pose_reached(self, state: AstronautState) -> bool:
        """Tell whether the front looks up."""
        return state.front_up >= math.cos(BACK_ANGLE)

    def contacts_right(self, contacts: Contacts) -> bool:
        """Tell whether the ground bears the astronaut."""
        return contacts.ground


def _asin(sine: float) -> float:
    return math.asin(min(1.0, max(-1.0, sine)))


TASK_TYPES: dict[str, type[Task]] = {task.name: task for task in (Lift, TurnOver)}
