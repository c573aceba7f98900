"""The first engine: one PyBullet client with ground, robot, astronaut and rocks as rigid bodies in contact.

With ``client`` and ``bodies``, of which it is made, and the stage of ``pictures`` the only code that calls PyBullet.
Speed matters here: state is read in as few calls as possible, and nothing is queried by closest points.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.bodies import Bodies
from lunar_rescue.physics.client import ROBOT_FILE, pb
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, RigidBody, Simulation, Vector
from lunar_rescue.physics.solver import SETTINGS, Pace, SolverSettings

# Collision detections that look at every pair of the robot's (some 26) at least once; a third of a millisecond.
CLEARING = 30


class BulletSimulation(Bodies, Simulation):
    """Ground, robot, astronaut and rocks in one PyBullet client."""

    def __init__(self, settings: SolverSettings = SETTINGS) -> None:
        """Connect to PyBullet and load the ground; other settings are for convergence studies."""
        super().__init__()
        self.settings = settings
        # Looked up once: the client binds a function anew at each access.
        self._step = self._client.stepSimulation
        self._joint_states, self._link_states = self._client.getJointStates, self._client.getLinkStates
        self._base_pose, self._base_velocity = self._client.getBasePositionAndOrientation, self._client.getBaseVelocity
        self._ray = self._client.rayTest
        self._set_motors, self._contact_points = self._client.setJointMotorControlArray, self._client.getContactPoints
        self.renew()

    def renew(self) -> None:
        """Empty the world and load the ground again; every other body is gone."""
        self._client.resetSimulation()
        self.set_up_vector(np.array([0.0, 0.0, 1.0]))
        self._client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        self._motors: tuple[int, list[int], list[float], list[float]] | None = None
        self._set_pace(self.settings.free)
        self._begin()

    @property
    def client(self) -> int:
        """Return PyBullet's number of this client, for experiments that need PyBullet itself."""
        return int(self._client._client)

    # -- building --------------------------------------------------------------------------------------------------
    def load_robot(self, path: Path = ROBOT_FILE) -> int:
        """Load the robot; its base stays where it is put (braced by outriggers, an assumption)."""
        return self._load_urdf(path, pb.URDF_USE_INERTIA_FROM_FILE | pb.URDF_USE_SELF_COLLISION)

    def joint_table(self, body: int) -> list[tuple[int, str, str, float, float, float, float]]:
        """Return rows (index, joint, link, lower, upper, effort, speed) of a body's joints."""
        rows = [self._client.getJointInfo(body, i) for i in range(self._client.getNumJoints(body))]
        return [(r[0], r[1].decode(), r[12].decode(), r[8], r[9], r[10], r[11]) for r in rows]

    def collide_only(self, body: int, links: int, pairs: set[tuple[int, int]]) -> None:
        """Leave collisions within a body to these pairs of links (-1 is the base)."""
        for first in range(-1, links):
            for second in range(first + 1, links):
                enabled = int((first, second) in pairs or (second, first) in pairs)
                self._client.setCollisionFilterPair(body, body, first, second, enabled)

    def limit_speed(self, body: int, links: int, speed: float) -> None:
        """Set the most that any joint of a body may turn [rad/s], also when it is driven from outside."""
        for link in range(-1, links):
            self._client.changeDynamics(body, link, maxJointVelocity=speed, linearDamping=0.0, angularDamping=0.0)

    def clear(self, staying: list[int]) -> None:
        """Remove all astronauts, rocks and mounds, and empty the contact cache of the bodies that stay.

        Cached contacts would leak from one episode into the next (a seeded reset would not repeat): the solver takes
        contacts in the order in which their pairs met. So the bodies that stay are moved far from every other, and
        about again and again, as a collision detection looks at some of the pairs alone and only where something has
        moved. They must not touch themselves, and must be placed anew.
        """
        self.remove_bodies()
        self.solve_finely(False)
        for turn in range(CLEARING):
            for index, handle in enumerate(staying):
                height = 200.0 * (index + 1) + 100.0 * (turn % 2)
                self.place(handle, np.array([0.0, 0.0, height]), np.array([0.0, 0.0, 0.0, 1.0]))
            self._client.performCollisionDetection()

    def set_up_vector(self, up: Array) -> None:
        """Let gravity pull against this unit vector (3,); a slope is a direction of gravity, see ``terrain``."""
        self._client.setGravity(*(-LUNAR_GRAVITY * up).tolist())

    def set_friction(self, coefficient: float, bodies: list[tuple[int, int]]) -> None:
        """Set the Coulomb coefficient between any two surfaces; ``bodies`` are (handle, links) that stay.

        Of those the links get it, not the base: the robot's, which stands apart from all this, keeps its own.
        """
        self.friction = coefficient
        self._set_friction(self.ground)
        for handle, links in bodies:
            for link in range(links):
                self._set_friction(handle, link)

    # -- placing, only at reset ------------------------------------------------------------------------------------
    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body at rest somewhere (centre of gravity, Bullet's frame)."""
        self._client.resetBasePositionAndOrientation(handle, position.tolist(), quaternion.tolist())
        self._client.resetBaseVelocity(handle, (0, 0, 0), (0, 0, 0))

    def reset_joints(self, body: int, joints: list[int], angles: Array) -> None:
        """Set joint angles (n,) [rad], at rest."""
        self._client.resetJointStatesMultiDof(body, joints, [(a,) for a in angles.tolist()], [(0.0,)] * len(joints))

    # -- moving and reading ----------------------------------------------------------------------------------------
    def drive(self, body: int, joints: list[int], targets: list[float], torques: list[float]) -> None:
        """Set position targets of motors [rad] with torque limits [N m]."""
        self._motors = body, joints, targets, torques
        gains = [self.pace.position_gain] * len(joints)
        if self.motor_gains is not None:
            gains = (self.pace.position_gain * self.motor_gains).tolist()
        self._set_motors(
            body, joints, pb.POSITION_CONTROL, targetPositions=targets, forces=torques, positionGains=gains
        )

    def release(self, body: int, joints: list[int]) -> None:
        """Switch the motors of these joints off."""
        self._motors = None
        self._client.setJointMotorControlArray(
            body,
            joints,
            pb.VELOCITY_CONTROL,
            targetVelocities=[0.0] * len(joints),
            forces=[0.0] * len(joints),
        )

    def advance(self, substeps: int) -> None:
        """Let so many substeps pass."""
        for _ in range(substeps):
            self._step()

    def solve_finely(self, fine: bool) -> None:
        """Choose how time passes from now on: as for an arm at the astronaut, or as for none."""
        pace = self.settings.fine if fine else self.settings.free
        if pace != self.pace:
            self._set_pace(pace)
            if self._motors:  # their gains are those of a substep
                self.drive(*self._motors)

    def _set_pace(self, pace: Pace) -> None:
        self.pace = pace
        self._client.setPhysicsEngineParameter(fixedTimeStep=pace.substep, numSolverIterations=pace.iterations)

    def joint_states(self, body: int, joints: list[int]) -> tuple[Array, Array, Array]:
        """Read angles [rad], speeds [rad/s] and motor torques [N m], (n,) each."""
        rows = self._joint_states(body, joints)
        angles, speeds, _, torques = zip(*rows, strict=True)
        table = np.array((angles, speeds, torques))
        return table[0], table[1], table[2]

    def link_positions(self, body: int, links: list[int]) -> Array:
        """Read the positions of link frames (joint origins), (n, 3) [m]."""
        rows = self._link_states(body, links, computeForwardKinematics=1)
        return np.array([r[4] for r in rows])

    def raw_pose(self, body: RigidBody) -> tuple[Vector, Vector]:
        """Read the centre of gravity and quaternion of the principal axes, as Bullet keeps them."""
        pose: tuple[Vector, Vector] = self._base_pose(body.handle)
        return pose

    def velocity(self, body: RigidBody) -> tuple[Array, Array]:
        """Read linear [m/s] and angular [rad/s] velocity, (3,) each."""
        linear, angular = self._base_velocity(body.handle)
        return np.array(linear), np.array(angular)

    def energy(self, bodies: list[int], up: Array) -> float:
        """Return kinetic and potential energy of bodies with all their links [J], heights against gravity (3,)."""
        parts = [(body, link) for body in bodies for link in range(-1, self._client.getNumJoints(body))]
        return sum(self._part_energy(body, link, up) for body, link in parts)

    def _part_energy(self, body: int, link: int, up: Array) -> float:
        mass, _, inertia, *_ = self._client.getDynamicsInfo(body, link)
        if link < 0:
            position, turned = self._base_pose(body)
            velocity, spin = self._base_velocity(body)
        else:
            row = self._client.getLinkState(body, link, 1, 1)
            position, turned, velocity, spin = row[0], row[1], row[6], row[7]
        own = Rotation.from_quat(turned).inv().apply(spin)
        moving = mass * np.dot(velocity, velocity) + np.dot(np.array(inertia) * own, own)
        return float(0.5 * moving + mass * LUNAR_GRAVITY * (up @ np.array(position)))

    def touching(self, first: int, second: int) -> bool:
        """Tell whether two bodies are in contact after the last substep."""
        return any(row[8] <= 0.0 or row[9] > 0.0 for row in self._contact_points(first, second))

    def contact_forces(self, first: int, second: int) -> list[tuple[int, int, Vector]]:
        """Return rows (link of first, link of second, force on first (3,) [N]) of the last substep.

        Also of surfaces that have come within some 2 cm of each other, with a force of nothing.
        """
        rows: list[tuple[int, int, Vector]] = []
        if not self._contact_points(first, second):
            return rows
        # All contacts, as what PyBullet filters by body it turns about, but for the directions of friction.
        for row in self._contact_points():
            if row[1] == first and row[2] == second:
                sign, own, other = 1.0, row[3], row[4]
            elif row[1] == second and row[2] == first:
                sign, own, other = -1.0, row[4], row[3]
            else:
                continue
            # Plain numbers, as this is read after each substep: normal force, then friction along two directions.
            n, f, g = sign * row[9], sign * row[10], sign * row[12]
            rows.append(
                (own, other, tuple(n * a + f * b + g * c for a, b, c in zip(row[7], row[11], row[13], strict=True)))
            )
        return rows

    def overlaps(self, first: int, second: int) -> list[float]:
        """Return how deep two bodies overlap at each of their contacts after the last substep [m]."""
        return [-row[8] for row in self._contact_points(first, second)]

    def penetration(self, first: int, second: int) -> float:
        """Measure how deep two bodies overlap as they are placed now [m]; slow, for tests."""
        self._client.performCollisionDetection()
        return max((-row[8] for row in self._contact_points(first, second)), default=0.0)

    def first_hit(self, start: Array, end: Array) -> tuple[int, Array]:
        """Return the first body on a ray (-1 for none) and where it is hit (3,) [m]."""
        row = self._ray(start.tolist(), end.tolist())[0]
        return int(row[0]), np.array(row[3])

    def ray_hits(self, start: Array, end: Array, handle: int) -> bool:
        """Tell whether the first thing on a ray is this body."""
        return bool(self._ray(start.tolist(), end.tolist())[0][0] == handle)
