"""The only module that calls PyBullet: one client, ground, robot, astronaut and rocks as rigid bodies in contact.

Speed matters here: state is read in as few calls as possible, nothing is queried by closest points, and the bodies of
an episode (astronaut, rocks, mounds) are made anew at each reset from shapes that are kept, with next to nothing to be
seen (pictures are taken in a client of their own). A body that is removed leaves some hundred bytes behind in PyBullet,
so the whole world is made anew every ``WORLD_LIFE`` episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.physics.quiet import no_greeting
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.suit import Limbs, Part, mass_properties, suit_parts
from lunar_rescue.scenes.terrain import Mound, Terrain, mounds

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
WORLD_LIFE = 2048  # episodes
# Collision detections that look at every pair of the robot's (some 26) at least once; a third of a millisecond.
CLEARING = 30
ROBOT_FILE = Path(__file__).parent.parent / "data" / "robot.urdf"
MOUND_FILE = Path(__file__).parent.parent / "data" / "mound.obj"  # a unit cap, ``1 - rho^2`` in rings of ten corners


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
        self._client.setPhysicsEngineParameter(
            fixedTimeStep=SUBSTEP, numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
        )
        shape = self._client.createCollisionShape(pb.GEOM_PLANE)
        # Without a shape to be seen PyBullet makes one of each collision shape, which costs more than the body itself.
        speck = [(0.0, 0.0, 0.0), (1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0)]
        self._unseen = int(self._client.createVisualShape(pb.GEOM_MESH, vertices=speck, indices=[0, 1, 2]))
        self.ground = int(self._client.createMultiBody(0, shape, self._unseen))
        self.relief: int | None = None
        self._shapes: dict[Any, int] = {}
        self._removable: list[int] = []
        self._episodes = 0
        self.friction = 0.8

    @property
    def client(self) -> int:
        """PyBullet's number of this client, for experiments that need PyBullet itself."""
        return int(self._client._client)

    @property
    def needs_rebuild(self) -> bool:
        """Whether the world should be renewed before the next episode."""
        return self._episodes >= WORLD_LIFE

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
        shape = self._kept(limbs, lambda: self._compound(suit_parts(limbs)))
        centre, axes = properties.centre.tolist(), properties.axes.tolist()
        handle = self._client.createMultiBody(mass, shape, self._unseen, (0, 0, 50), (0, 0, 0, 1), centre, axes)
        self._client.changeDynamics(
            handle,
            -1,
            localInertiaDiagonal=(properties.inertia * mass).tolist(),
            linearDamping=0.0,
            angularDamping=0.0,
            spinningFriction=SPINNING_FRICTION,
            rollingFriction=ROLLING_FRICTION,
            lateralFriction=math.sqrt(self.friction),
            restitution=RESTITUTION,
        )
        self._removable.append(handle)
        return RigidBody(handle, _inverse_axes(limbs))

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

    def _kept(self, key: Any, make: Callable[[], int]) -> int:
        """A collision shape that is made once in a world's life."""
        if key not in self._shapes:
            self._shapes[key] = make()
        return self._shapes[key]

    def add_rock(self, rock: Rock) -> int:
        """Add a rock, a fixed convex body."""
        key = rock.shape, rock.diameter, rock.height
        shape = self._kept(key, lambda: self._hull(rock.corners()))
        return self._add_fixed(shape, rock.middle, rock.yaw)

    def add_hull(self, vertices: Array) -> int:
        """Add a fixed convex body, corners in the world (M, 3) [m]; its shape is not kept."""
        return self._add_fixed(self._hull(vertices), (0.0, 0.0, 0.0), 0.0)

    def _hull(self, corners: Array) -> int:
        return int(self._client.createCollisionShape(pb.GEOM_MESH, vertices=corners.tolist()))

    def add_relief(self, terrain: Terrain) -> int:
        """Add the mounds of a terrain as one fixed body."""
        field = mounds(terrain.relief, terrain.patch)
        shape = self._kept(field, lambda: self._mounds(field))
        self.relief = self._add_fixed(shape, (terrain.x, terrain.y, 0.0), terrain.yaw)
        return self.relief

    def _mounds(self, field: tuple[Mound, ...]) -> int:
        return int(
            self._client.createCollisionShapeArray(
                shapeTypes=[pb.GEOM_MESH] * len(field),
                fileNames=[str(MOUND_FILE)] * len(field),
                meshScales=[(m.along, m.across, m.height) for m in field],
                collisionFramePositions=[(m.x, m.y, 0.0) for m in field],
                collisionFrameOrientations=[_about_z(m.yaw) for m in field],
            )
        )

    def _add_fixed(self, shape: int, position: tuple[float, float, float], yaw: float) -> int:
        handle = int(self._client.createMultiBody(0, shape, self._unseen, position, _about_z(yaw)))
        self._set_friction(handle)
        self._removable.append(handle)
        return handle

    def clear(self, staying: list[int]) -> None:
        """Remove all astronauts, rocks and mounds, and empty the contact cache of the bodies that stay.

        Cached contacts would leak from one episode into the next (a seeded reset would not repeat): the solver takes
        contacts in the order in which their pairs met. So the bodies that stay are moved far from every other, and
        about again and again, as a collision detection looks at some of the pairs alone and only where something has
        moved. They must not touch themselves, and must be placed anew.
        """
        for handle in self._removable:
            self._client.removeBody(handle)
        self._removable.clear()
        self.relief = None
        self._episodes += 1
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
        gains = [POSITION_GAIN] * len(joints)
        self._set_motors(
            body, joints, pb.POSITION_CONTROL, targetPositions=targets, forces=torques, positionGains=gains
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
            self._step()

    def joint_states(self, body: int, joints: list[int]) -> tuple[Array, Array, Array]:
        """Angles [rad], speeds [rad/s] and motor torques [N m], (n,) each."""
        rows = self._joint_states(body, joints)
        angles, speeds, _, torques = zip(*rows, strict=True)
        table = np.array((angles, speeds, torques))
        return table[0], table[1], table[2]

    def link_positions(self, body: int, links: list[int]) -> Array:
        """Positions of link frames (joint origins), (n, 3) [m]."""
        rows = self._link_states(body, links, computeForwardKinematics=1)
        return np.array([r[4] for r in rows])

    def pose(self, body: RigidBody) -> tuple[Array, Rotation]:
        """Centre of gravity (3,) [m] and rotation of the body frame."""
        position, quaternion = self._base_pose(body.handle)
        return np.array(position), Rotation.from_quat(quaternion) * body.axes_inverse

    def raw_pose(self, body: RigidBody) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Centre of gravity and quaternion of the principal axes, as Bullet keeps them."""
        pose: tuple[tuple[float, ...], tuple[float, ...]] = self._base_pose(body.handle)
        return pose

    def velocity(self, body: RigidBody) -> tuple[Array, Array]:
        """Linear [m/s] and angular [rad/s] velocity, (3,) each."""
        linear, angular = self._base_velocity(body.handle)
        return np.array(linear), np.array(angular)

    def touching(self, first: int, second: int) -> bool:
        """Whether two bodies are in contact after the last substep."""
        return any(row[8] <= 0.0 or row[9] > 0.0 for row in self._contact_points(first, second))

    def touching_ground(self, body: int) -> bool:
        """Whether a body is in contact with plane or mounds after the last substep."""
        return self.touching(body, self.ground) or (self.relief is not None and self.touching(body, self.relief))

    def contact_forces(self, first: int, second: int) -> list[tuple[int, int, Array]]:
        """Rows (link of first, link of second, force on first (3,) [N]) of the last substep."""
        rows = []
        for row in self._contact_points(first, second):
            force = row[9] * np.array(row[7]) + row[10] * np.array(row[11]) + row[12] * np.array(row[13])
            rows.append((int(row[3]), int(row[4]), force))
        return rows

    def penetration(self, first: int, second: int) -> float:
        """How deep two bodies overlap as they are placed now [m]; slow, for tests."""
        self._client.performCollisionDetection()
        return max((-row[8] for row in self._contact_points(first, second)), default=0.0)

    def first_hit(self, start: Array, end: Array) -> tuple[int, Array]:
        """The first body on a ray (-1 for none) and where it is hit (3,) [m]."""
        row = self._ray(start.tolist(), end.tolist())[0]
        return int(row[0]), np.array(row[3])

    def ray_hits(self, start: Array, end: Array, handle: int) -> bool:
        """Whether the first thing on a ray is this body."""
        return bool(self._ray(start.tolist(), end.tolist())[0][0] == handle)

    def energy(self, body: int, up: Array) -> float:
        """Kinetic and potential energy of a body with all its links [J]; slow, for tests."""
        total = 0.0
        for link in range(-1, self._client.getNumJoints(body)):
            mass, _, inertia, *_ = self._client.getDynamicsInfo(body, link)
            if mass == 0.0:
                continue
            if link < 0:
                position, turned = self._base_pose(body)
                velocity, spin = self._base_velocity(body)
            else:
                row = self._link_states(body, [link], computeLinkVelocity=1, computeForwardKinematics=1)[0]
                position, turned, velocity, spin = row[0], row[1], row[6], row[7]
            own = Rotation.from_quat(turned).inv().apply(spin)
            moving = mass * np.dot(velocity, velocity) + np.dot(np.array(inertia) * own, own)
            total += 0.5 * moving + mass * LUNAR_GRAVITY * float(up @ np.array(position))
        return float(total)


@lru_cache(maxsize=256)
def _inverse_axes(limbs: Limbs) -> Rotation:
    return Rotation.from_quat(mass_properties(limbs).axes).inv()


def _about_z(yaw: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of a heading [rad]."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


#: Geometries of ``Stage.visual_shapes``.
_SHAPES = {
    pb.GEOM_SPHERE: "sphere",
    pb.GEOM_BOX: "box",
    pb.GEOM_CYLINDER: "cylinder",
    pb.GEOM_CAPSULE: "capsule",
    pb.GEOM_MESH: "mesh",
}


@dataclass(frozen=True)
class VisualShape:
    """One shape of a link.

    Attributes:
        link: Its index, -1 for the base.
        kind: sphere, box, cylinder, capsule or mesh.
        size: Extents of a box; length and radius of a cylinder or capsule; radius first of a sphere [m].
        position: In the link's frame [m].
        quaternion: In the link's frame, x y z w.
        colour: Red, green, blue from 0 to 1.
    """

    link: int
    kind: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    colour: tuple[float, float, float]


class Stage:
    """Bodies that are only seen, in a client of their own that never steps: no picture can change what happens."""

    def __init__(self, window: bool = False) -> None:
        """Connect; ``window`` opens PyBullet's, which needs a display."""
        with no_greeting():
            self._client: Any = BulletClient(pb.GUI if window else pb.DIRECT)
            if window:
                self._client.configureDebugVisualizer(pb.COV_ENABLE_GUI, 0)
                self._client.configureDebugVisualizer(rgbBackground=(0, 0, 0))
                self._client.configureDebugVisualizer(lightPosition=(6, -8, 9), shadowMapResolution=4096)
        self._drawn: list[int] = []
        self._words: list[int] = []
        self._points = -1

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._client is not None and self._client.isConnected():
            with no_greeting():
                self._client.disconnect()
        self._client = None

    @property
    def is_open(self) -> bool:
        """Whether there is still a window to draw in."""
        return self._client is not None and bool(self._client.isConnected())

    def add_mesh(self, *pieces: tuple[Array, Array, NDArray[np.int64], tuple[float, ...]]) -> int:
        """Add one body of triangles; each piece has corners (V, 3) [m], normals (V, 3), indices (F, 3) and a colour.

        The first piece is the body's base, each other one a link of it.
        """
        first, *rest = [
            self._client.createVisualShape(
                pb.GEOM_MESH,
                vertices=vertices.tolist(),
                indices=faces.ravel().tolist(),
                normals=normals.tolist(),
                uvs=[(0.0, 0.0)] * len(vertices),
                rgbaColor=(*colour, 1.0),
                specularColor=(0, 0, 0),
            )
            for vertices, normals, faces, colour in pieces
        ]
        nowhere, level = [(0.0, 0.0, 0.0)] * len(rest), [(0.0, 0.0, 0.0, 1.0)] * len(rest)
        body = self._client.createMultiBody(
            0,
            -1,
            first,
            linkMasses=[0.0] * len(rest),
            linkCollisionShapeIndices=[-1] * len(rest),
            linkVisualShapeIndices=rest,
            linkPositions=nowhere,
            linkOrientations=level,
            linkInertialFramePositions=nowhere,
            linkInertialFrameOrientations=level,
            linkParentIndices=[0] * len(rest),
            linkJointTypes=[pb.JOINT_FIXED] * len(rest),
            linkJointAxis=[(0.0, 0.0, 1.0)] * len(rest),
        )
        return int(body)

    def add_robot(self, path: Path) -> tuple[int, dict[str, int], dict[int, tuple[float, ...]]]:
        """Load a robot file; return its handle, the joints' indices by name and the links' colours by index."""
        with no_greeting():
            handle = int(self._client.loadURDF(str(path), useFixedBase=True))
        rows = [self._client.getJointInfo(handle, i) for i in range(self._client.getNumJoints(handle))]
        colours = {int(row[1]): tuple(row[7][:3]) for row in self._client.getVisualShapeData(handle)}
        return handle, {row[1].decode(): row[0] for row in rows}, colours

    def visual_shapes(self, handle: int) -> list[VisualShape]:
        """What of a body is seen."""
        return [
            VisualShape(int(row[1]), _SHAPES[row[2]], tuple(row[3]), tuple(row[5]), tuple(row[6]), tuple(row[7][:3]))
            for row in self._client.getVisualShapeData(handle)
        ]

    def link_poses(self, handle: int) -> dict[int, tuple[Array, Array]]:
        """Place (3,) [m] and quaternion (4,), x y z w, of each link's frame; -1 is the base."""
        links = range(self._client.getNumJoints(handle))
        poses = {-1: self._client.getBasePositionAndOrientation(handle)}
        states = self._client.getLinkStates(handle, list(links), computeForwardKinematics=True)
        poses |= {link: state[4:6] for link, state in zip(links, states, strict=True)}
        return {link: (np.array(place), np.array(turn)) for link, (place, turn) in poses.items()}

    def paint(self, handle: int, link: int, colour: tuple[float, ...]) -> None:
        """Give one link (-1 is the base) another colour."""
        self._client.changeVisualShape(handle, link, rgbaColor=(*colour, 1.0))

    def remove(self, handle: int) -> None:
        """Take a body away."""
        self._client.removeBody(handle)

    def clear(self) -> None:
        """Take everything away; handles begin anew."""
        self._client.resetSimulation()
        self._drawn, self._words, self._points = [], [], -1

    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body somewhere."""
        self._client.resetBasePositionAndOrientation(handle, position.tolist(), quaternion.tolist())

    def turn_joints(self, handle: int, joints: list[int], angles: Array) -> None:
        """Set joint angles [rad]."""
        self._client.resetJointStatesMultiDof(handle, joints, [(a,) for a in angles.tolist()], [(0.0,)] * len(joints))

    def look(
        self, view: Array, projection: Array, size: tuple[int, int], sun: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
        """What a camera sees by the software renderer, all (height, width).

        Args:
            view: World to camera (4, 4).
            projection: Camera to clip coordinates (4, 4), with perspective: the renderer draws no other.
            size: Width and height [px].
            sun: Towards the light (3,).

        Returns:
            Cosine between surface and light (of what is white), depth in [0, 1], and the body seen with its link in
            the upper bits, -1 for nothing.
        """
        width, height = size
        _, _, colours, depth, bodies = self._client.getCameraImage(
            width,
            height,
            view.T.ravel().tolist(),
            projection.T.ravel().tolist(),
            renderer=pb.ER_TINY_RENDERER,
            flags=pb.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
            shadow=0,
            lightDirection=sun.tolist(),
            lightAmbientCoeff=0.0,
            lightDiffuseCoeff=1.0,
            lightSpecularCoeff=0.0,
        )
        shade = (np.reshape(colours, (height, width, 4))[:, :, 0] / 255).astype(np.float32)
        return shade, np.reshape(depth, (height, width)), np.reshape(bodies, (height, width))

    def aim(self, target: Array, distance: float, yaw: float, pitch: float) -> None:
        """Point the window's camera; angles [deg], distance [m]."""
        self._client.resetDebugVisualizerCamera(distance, yaw, pitch, target.tolist())

    def draw(
        self,
        lines: list[tuple[Array, Array, tuple[float, ...]]],
        points: tuple[Array, Array],
        words: list[str],
        place: Array,
    ) -> None:
        """Draw into the window, instead of what the last call drew; every item costs the window a frame.

        Args:
            lines: Start (3,), end (3,) [m] and colour of each.
            points: Places (n, 3) [m] and colours (n, 3).
            words: Lines of text.
            place: Where the first of them begins (3,) [m].
        """
        self._points = self._client.addUserDebugPoints(
            points[0].tolist(), points[1].tolist(), 5.0, replaceItemUniqueId=self._points
        )
        drawn = self._drawn + [-1] * (len(lines) - len(self._drawn))
        for index, (start, end, colour) in enumerate(lines):
            drawn[index] = self._client.addUserDebugLine(
                start.tolist(), end.tolist(), colour, 3.0, replaceItemUniqueId=drawn[index]
            )
        for item in drawn[len(lines) :]:
            self._client.removeUserDebugItem(item)
        self._drawn = drawn[: len(lines)]
        below = np.array([0.0, 0.0, 0.09])
        self._words += [-1] * (len(words) - len(self._words))
        for index, line in enumerate(words):
            self._words[index] = self._client.addUserDebugText(
                line, (place - index * below).tolist(), (1, 1, 1), 1.1, replaceItemUniqueId=self._words[index]
            )
