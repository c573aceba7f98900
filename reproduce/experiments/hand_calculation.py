"""Cases of contact with a closed solution, measured in a simulator: sliding, tipping and carrying.

They tell which of two engines is nearer to the truth where they part. Bodies and robot are those of the rescue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lunar_rescue import LunarRescueEnv
from lunar_rescue.arrays import Array
from lunar_rescue.physics.kinematics import WAIST_HEIGHT
from lunar_rescue.physics.robot import ARMS, WAIST
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, RigidBody, Simulation
from lunar_rescue.scenes.postures import postures

POSTURE, MASS = "supine_straight", 250.0  # kg; a backpack that is flat, with edges across the long axis
SLIDING_TIME, TIPPING_TIME = 2.0, 6.0  # s
TIPPED = 0.2  # rad, further than a body rocks that comes to rest again
TIPPING_RANGE, TIPPING_STEPS = (10.0, 40.0), 10  # deg, and halvings of it
ROLLING = 0.005  # m, rolling friction of the suit over the root of the friction coefficient
STEADY, READ = 1.0, 0.2  # s that a lifted body is held, and then torques are read
STILL = 0.005, 0.01  # m/s and rad/s below which it is at rest; a body that rocks slowly moves its weight

#: Masses of the robot above its waist [kg]: torso with its centre of gravity beside the waist's axis and above it [m],
#: and of each arm shoulder, upper arm, elbow, forearm, plate and end. Centres of bars are their middles.
TORSO_MASS, TORSO_CENTRE = 60.0, np.array([-0.03, 0.0, 0.24])
ARM_MASSES = np.array([4.0, 10.0, 2.0, 5.0, 4.0, 0.01])


@dataclass(frozen=True)
class Measured:
    """A figure of a simulator and the closed solution."""

    value: float
    expected: float

    @property
    def error(self) -> float:
        """Return by what share of the closed solution the figure is off."""
        return self.value / self.expected - 1.0


def _uphill(degrees: float) -> Array:
    """Return the unit vector against gravity on a slope that falls towards +x, (3,)."""
    return np.array([-math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])


def _lay(simulation: Simulation, friction: float, up: Array) -> RigidBody:
    """Lay the body at rest on an empty plane, its head towards +x."""
    posture = postures()[POSTURE]
    simulation.clear([])
    simulation.set_up_vector(up)
    simulation.set_friction(friction, [])
    body = simulation.add_suit(posture.limbs, MASS)
    simulation.place_suit(body, np.array([0.0, 0.0, posture.rest.height]), posture.rest_rotation())
    return body


def slide(simulation: Simulation, friction: float, slope: float) -> Measured:
    """Let the body slide down a slope [deg] and return the friction coefficient that its way tells of.

    The way is a t^2 / 2 with a = g (sin - mu cos), and half a substep's speed more, as engines integrate speed first.
    """
    body, angle = _lay(simulation, friction, _uphill(slope)), math.radians(slope)
    simulation.advance_by(SLIDING_TIME)
    way = float(simulation.pose(body)[0][0])
    acceleration = 2.0 * way / (SLIDING_TIME * (SLIDING_TIME + simulation.pace.substep))
    return Measured(math.tan(angle) - acceleration / (LUNAR_GRAVITY * math.cos(angle)), friction)


def tip(simulation: Simulation, friction: float) -> Measured:
    """Find the slope [deg] on which the body tips over the backpack's lower edge.

    Its tangent is the edge's distance from the centre of gravity, and what rolling friction adds, over the height.
    """
    posture = postures()[POSTURE]
    surface = posture.resting_surface()
    edge = -float(surface[surface[:, 2] < 1e-3][:, 0].min())
    low, high = TIPPING_RANGE
    for _ in range(TIPPING_STEPS):
        middle = 0.5 * (low + high)
        body = _lay(simulation, friction, _uphill(-middle))
        simulation.advance_by(TIPPING_TIME)
        turned = (simulation.pose(body)[1] * posture.rest_rotation().inv()).magnitude()
        low, high = (low, middle) if turned > TIPPED else (middle, high)
    expected = math.degrees(math.atan((edge + ROLLING * math.sqrt(friction)) / posture.rest.height))
    return Measured(0.5 * (low + high), expected)


def carry(env: LunarRescueEnv) -> Measured | None:
    """Hold a body that has just been lifted and return the waist's torque [N m], or None where it is not at rest.

    In equilibrium it is the moment of all weights above the waist about its axis, however plates and body touch.
    """
    episode, simulation, torques, moving = env.episode, env.simulation, [], False
    simulation.advance_by(STEADY)
    for _ in range(round(READ / simulation.pace.substep)):
        simulation.advance(1)
        torques.append(env.robot.state().torques[WAIST])
        body = episode.astronaut.state()
        moving |= bool(np.linalg.norm(body.velocity) > STILL[0] or np.linalg.norm(body.spin) > STILL[1])
    body, robot, scene = episode.astronaut.state(), env.robot.state(), episode.scene
    if moving or any(_borne_otherwise(env)):
        return None
    c, s = math.cos(scene.base_yaw), math.sin(scene.base_yaw)
    ahead, left, level = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
    axis = np.array([scene.base_x, scene.base_y, WAIST_HEIGHT])
    lean = float(robot.angles[WAIST])
    along = math.sin(lean) * ahead + math.cos(lean) * level  # of the torso
    across = math.cos(lean) * ahead - math.sin(lean) * level
    middle = axis + TORSO_CENTRE[0] * across + TORSO_CENTRE[2] * along
    moment = TORSO_MASS * (middle - axis) + scene.mass * (body.centre - axis)
    for arm in ARMS:
        moment = moment + ARM_MASSES @ (_centres(robot.points[arm.links], robot.directions[ARMS.index(arm)]) - axis)
    weight = -LUNAR_GRAVITY * scene.terrain.up()
    return Measured(float(np.mean(torques)), -float(np.cross(moment, weight) @ left))


def _borne_otherwise(env: LunarRescueEnv) -> Iterator[bool]:
    """Yield whether body or arms touch what does not turn with the waist."""
    episode, simulation, robot = env.episode, env.simulation, env.robot.handle
    for handle in (episode.astronaut.handle, robot):
        yield simulation.touching_ground(handle)
        yield from (simulation.touching(handle, rock) for rock in episode.rocks)
    yield any(-1 in (own, other) for own, other, _ in simulation.contact_forces(robot, robot))
    yield any(other == -1 for _, other, _ in simulation.contact_forces(episode.astronaut.handle, robot))


def _centres(points: Array, direction: Array) -> Array:
    """Return the centres of gravity of an arm's six links from its joints and end, (6, 3) [m]."""
    shoulder, _, elbow, _, wrist, end = points
    return np.array([shoulder, (shoulder + elbow) / 2, elbow, (elbow + wrist) / 2, wrist + 0.225 * direction, end])
