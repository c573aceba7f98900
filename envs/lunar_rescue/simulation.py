"""The only module that calls PyBullet: one client, ground, robot, astronaut and rocks as rigid bodies in contact.

Speed matters here: state is read in as few calls as possible, the astronaut's and rocks' bodies are made anew at each
reset (which also empties the contact cache, without which seeded resets do not repeat), and nothing is queried by
closest points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.quiet import no_greeting
from lunar_rescue.suit import Limbs, MassProperties, Part, mass_properties, suit_parts

with no_greeting():
    import pybullet as pb
    from pybullet_utils.bullet_client import BulletClient

Array = NDArray[np.float64]

LUNAR_GRAVITY = 1.62  # m/s^2
SUBSTEP = 0.02  # s; coarser than on Earth will do, as everything falls six times slower (see the physics tests)
SOLVER_ITERATIONS = 20
POSITION_GAIN = 0.2  # per substep; with set-points at most SPEED * dt ahead no motor exceeds its speed limit
RESTITUTION = 0.0  # regolith does not bounce
# Small, they stop a rocking body as dust would (assumption) [m].
SPINNING_FRICTION, ROLLING_FRICTION = 0.01, 0.005
# Colours (red, green, blue, opacity), and the black sky of a place without air.
REGOLITH, SUIT, ROCK = (0.62, 0.60, 0.56, 1.0), (0.95, 0.94, 0.90, 1.0), (0.36, 0.33, 0.30, 1.0)
SKY = (12, 12, 18)
SUN_BESIDE = 40.0  # deg, the sun stands this far beside the camera, so that shapes show
ROBOT_FILE = Path(__file__).parent / "data" / "robot.urdf"


@dataclass(frozen=True)
class RigidBody:
    """A body that moves: handle and the frame that Bullet keeps (centre of gravity, principal axes)."""

    handle: int
    axes_inverse: Rotation


class Simulation:
    """One PyBullet client in DIRECT mode (or with a window)."""

    def __init__(self, gui: bool = False) -> None:
        """Connect and load what never changes: ground and robot."""
        with no_greeting():
            self._client: Any = BulletClient(pb.GUI if gui else pb.DIRECT)
        self._client.setGravity(0, 0, -LUNAR_GRAVITY)
        self._client.setPhysicsEngineParameter(
            fixedTimeStep=SUBSTEP, numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
        )
        shape = self._client.createCollisionShape(pb.GEOM_PLANE)
        sight = self._client.createVisualShape(
            pb.GEOM_BOX, halfExtents=(30, 30, 0.01), visualFramePosition=(0, 0, -0.01), rgbaColor=REGOLITH
        )
        self.ground: int = self._client.createMultiBody(0, shape, sight)
        self._removable: list[int] = []
        self.friction = 0.8

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._client is not None:
            self._client.disconnect()
            self._client = None

    # -- building --------------------------------------------------------------------------------------------------
    def load_robot(self, path: Path = ROBOT_FILE) -> int:
        """Load the robot with a base that stays where it is put (braced by outriggers, an assumption)."""
        flags = pb.URDF_USE_INERTIA_FROM_FILE | pb.URDF_USE_SELF_COLLISION
        return int(self._client.loadURDF(str(path), useFixedBase=True, flags=flags))

    def joint_table(self, body: int) -> list[tuple[int, str, str, float, float, float, float]]:
        """Rows (index, joint, link, lower, upper, effort, speed) of a body's joints."""
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

    def add_suit(self, limbs: Limbs, mass: float) -> RigidBody:
        """Make the astronaut's rigid body, far away; place it with ``place``."""
        properties = mass_properties(limbs)
        shape = self._compound(suit_parts(limbs))
        handle = self._client.createMultiBody(
            mass, shape, -1, (0, 0, 50), (0, 0, 0, 1), properties.centre.tolist(), properties.axes.tolist()
        )
        self._client.changeDynamics(
            handle,
            -1,
            localInertiaDiagonal=(properties.inertia * mass).tolist(),
            linearDamping=0.0,
            angularDamping=0.0,
            spinningFriction=SPINNING_FRICTION,
            rollingFriction=ROLLING_FRICTION,
        )
        self._client.changeVisualShape(handle, -1, rgbaColor=SUIT)
        self._set_friction(handle)
        self._removable.append(handle)
        return RigidBody(handle, _inverse_axes(properties))

    def _compound(self, parts: tuple[Part, ...]) -> int:
        kinds = {"box": pb.GEOM_BOX, "capsule": pb.GEOM_CAPSULE, "sphere": pb.GEOM_SPHERE}
        return int(
            self._client.createCollisionShapeArray(
                shapeTypes=[kinds[p.kind] for p in parts],
                halfExtents=[p.size if p.kind == "box" else (1, 1, 1) for p in parts],
                radii=[0.1 if p.kind == "box" else p.size[0] for p in parts],
                lengths=[p.size[1] if p.kind == "capsule" else 0.1 for p in parts],
                collisionFramePositions=[p.position for p in parts],
                collisionFrameOrientations=[p.quaternion for p in parts],
            )
        )

    def add_hull(self, vertices: Array) -> int:
        """Add a fixed convex body (a rock), corners in the world (M, 3) [m]."""
        centre = vertices.mean(axis=0)
        shape = self._client.createCollisionShape(pb.GEOM_MESH, vertices=(vertices - centre).tolist())
        handle = int(self._client.createMultiBody(0, shape, -1, centre.tolist()))
        self._client.changeVisualShape(handle, -1, rgbaColor=ROCK)
        self._set_friction(handle)
        self._removable.append(handle)
        return handle

    def clear(self, staying: list[int]) -> None:
        """Remove all astronauts and rocks, and empty the contact cache of the bodies that stay.

        Cached contacts would leak from one episode into the next (a seeded reset would not repeat): with every body
        far from every other, one collision detection empties the cache. The bodies that stay must be placed anew.
        """
        for handle in self._removable:
            self._client.removeBody(handle)
        self._removable.clear()
        for index, handle in enumerate(staying):
            self.place(handle, np.array([0.0, 0.0, 100.0 * (index + 1)]), np.array([0.0, 0.0, 0.0, 1.0]))
        self._client.performCollisionDetection()

    def set_friction(self, coefficient: float, bodies: list[tuple[int, int]]) -> None:
        """Set the Coulomb coefficient between any two surfaces; ``bodies`` are (handle, links) that stay."""
        self.friction = coefficient
        self._set_friction(self.ground)
        for handle, links in bodies:
            for link in range(links):
                self._set_friction(handle, link)

    def _set_friction(self, handle: int, link: int = -1) -> None:
        # Bullet multiplies the two surfaces' coefficients: the square root makes the product the wanted one.
        self._client.changeDynamics(handle, link, lateralFriction=math.sqrt(self.friction), restitution=RESTITUTION)

    # -- placing, only at reset ------------------------------------------------------------------------------------
    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body at rest somewhere (centre of gravity, Bullet's frame)."""
        self._client.resetBasePositionAndOrientation(handle, position.tolist(), quaternion.tolist())
        self._client.resetBaseVelocity(handle, (0, 0, 0), (0, 0, 0))

    def place_suit(self, body: RigidBody, centre: Array, rotation: Rotation) -> None:
        """Put the astronaut at rest: centre of gravity and rotation of the body frame."""
        self.place(body.handle, centre, (rotation * body.axes_inverse.inv()).as_quat())

    def reset_joints(self, body: int, joints: list[int], angles: Array) -> None:
        """Set joint angles, at rest."""
        self._client.resetJointStatesMultiDof(body, joints, [(a,) for a in angles.tolist()], [(0.0,)] * len(joints))

    # -- moving and reading ----------------------------------------------------------------------------------------
    def drive(self, body: int, joints: list[int], targets: list[float], torques: list[float]) -> None:
        """Set position targets of motors [rad] with torque limits [N m]."""
        self._client.setJointMotorControlArray(
            body,
            joints,
            pb.POSITION_CONTROL,
            targetPositions=targets,
            forces=torques,
            positionGains=[POSITION_GAIN] * len(joints),
        )

    def release(self, body: int, joints: list[int]) -> None:
        """Switch motors off."""
        self._client.setJointMotorControlArray(
            body,
            joints,
            pb.VELOCITY_CONTROL,
            targetVelocities=[0.0] * len(joints),
            forces=[0.0] * len(joints),
        )

    def advance(self, substeps: int) -> None:
        """Let time pass."""
        for _ in range(substeps):
            self._client.stepSimulation()

    def joint_states(self, body: int, joints: list[int]) -> tuple[Array, Array, Array]:
        """Angles [rad], speeds [rad/s] and motor torques [N m], (n,) each."""
        rows = self._client.getJointStates(body, joints)
        return np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[3] for r in rows])

    def link_positions(self, body: int, links: list[int]) -> Array:
        """Positions of link frames (joint origins), (n, 3) [m]."""
        rows = self._client.getLinkStates(body, links, computeForwardKinematics=1)
        return np.array([r[4] for r in rows])

    def pose(self, body: RigidBody) -> tuple[Array, Rotation]:
        """Centre of gravity (3,) [m] and rotation of the body frame."""
        position, quaternion = self._client.getBasePositionAndOrientation(body.handle)
        return np.array(position), Rotation.from_quat(quaternion) * body.axes_inverse

    def raw_pose(self, body: RigidBody) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Centre of gravity and quaternion of the principal axes, as Bullet keeps them."""
        pose: tuple[tuple[float, ...], tuple[float, ...]] = self._client.getBasePositionAndOrientation(body.handle)
        return pose

    def velocity(self, body: RigidBody) -> tuple[Array, Array]:
        """Linear [m/s] and angular [rad/s] velocity, (3,) each."""
        linear, angular = self._client.getBaseVelocity(body.handle)
        return np.array(linear), np.array(angular)

    def touching(self, first: int, second: int) -> bool:
        """Whether two bodies are in contact after the last substep."""
        return any(row[8] <= 0.0 or row[9] > 0.0 for row in self._client.getContactPoints(first, second))

    def contact_forces(self, first: int, second: int) -> list[tuple[int, int, Array]]:
        """Rows (link of first, link of second, force on first (3,) [N]) of the last substep."""
        rows = []
        for row in self._client.getContactPoints(first, second):
            force = row[9] * np.array(row[7]) + row[10] * np.array(row[11]) + row[12] * np.array(row[13])
            rows.append((int(row[3]), int(row[4]), force))
        return rows

    def penetration(self, first: int, second: int) -> float:
        """How deep two bodies overlap as they are placed now [m]; slow, for tests."""
        self._client.performCollisionDetection()
        return max((-row[8] for row in self._client.getContactPoints(first, second)), default=0.0)

    def ray_hits(self, start: Array, end: Array, handle: int) -> bool:
        """Whether the first thing on a ray is this body."""
        return bool(self._client.rayTest(start.tolist(), end.tolist())[0][0] == handle)

    def camera(
        self, target: list[float], distance: float, yaw: float, pitch: float, size: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Take a picture with the software renderer, (height, width, 3); angles [deg], distance [m]."""
        width, height = size
        sun = math.radians(yaw + SUN_BESIDE)
        view = self._client.computeViewMatrixFromYawPitchRoll(target, distance, yaw, pitch, 0, 2)
        projection = self._client.computeProjectionMatrixFOV(45, width / height, 0.05, 30)
        _, _, colours, _, bodies = self._client.getCameraImage(
            width,
            height,
            view,
            projection,
            renderer=pb.ER_TINY_RENDERER,
            shadow=1,
            lightDirection=(math.sin(sun), -math.cos(sun), 0.9),
            lightAmbientCoeff=0.5,
            lightDiffuseCoeff=0.65,
            lightSpecularCoeff=0.05,
        )
        picture = np.reshape(np.asarray(colours, dtype=np.uint8), (height, width, 4))[:, :, :3].copy()
        picture[np.reshape(bodies, (height, width)) < 0] = SKY
        return picture


def _inverse_axes(properties: MassProperties) -> Rotation:
    return Rotation.from_quat(properties.axes).inv()
