"""The second engine: the same worlds in MuJoCo, as a second opinion about contacts.

With ``mujoco_scene`` and ``mujoco_motors``, of which it is made, the only code that calls MuJoCo.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lunar_rescue.arrays import Array
from lunar_rescue.physics.client import ROBOT_FILE, NotCopied
from lunar_rescue.physics.mujoco_motors import Motors
from lunar_rescue.physics.mujoco_scene import (
    GROUND,
    Contents,
    Hull,
    World,
    compile_world,
    read_joints,
    read_robot,
    relief_hulls,
)
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, RigidBody, Simulation, Vector
from lunar_rescue.physics.solver import MUJOCO_SETTINGS, Pace, SolverSettings
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.suit import Limbs, mass_properties
from lunar_rescue.scenes.terrain import Terrain
from scipy.spatial.transform import Rotation

LEVEL = np.array([0.0, 0.0, 1.0])
IMPRATIO = 10.0


class MujocoSimulation(NotCopied, Simulation):
    """Ground, robot, astronaut and rocks in MuJoCo; compiled when the world is first asked about."""

    def __init__(self, settings: SolverSettings = MUJOCO_SETTINGS) -> None:
        """Make a world with nothing but ground; other settings are for convergence studies."""
        self.settings = settings
        self.renew()

    # -- building --------------------------------------------------------------------------------------------------
    def renew(self) -> None:
        """Empty the world and load the ground again; every other body is gone."""
        self.ground, self.relief = GROUND, None
        self.pace = self.settings.free
        self._contents = Contents()
        self.friction = self._contents.friction
        self._robot: Any = mujoco.MjSpec()
        self._up = LEVEL
        self._next = GROUND + 1
        self._speed = np.inf
        self._forget()

    def _forget(self) -> None:
        """Forget the state of all that moves, and whatever drives it."""
        self._world: World | None = None
        self._motors: Motors | None = None
        self._aims: tuple[dict[int, float], dict[int, float]] = ({}, {})
        self._angles: dict[int, float] = {}  # of joints that are not compiled yet [rad]
        self._poses: dict[int, tuple[Array, Array]] = {}  # and of suits

    @property
    def needs_rebuild(self) -> bool:
        """Tell whether the world should be renewed; nothing of an episode is left in it, so it need not."""
        return False

    def close(self) -> None:
        """Let go of the world; a second call does nothing."""
        self._forget()

    def load_robot(self, path: Path = ROBOT_FILE) -> int:
        """Load the robot; its base stays where it is put (braced by outriggers, an assumption)."""
        self._robot = read_robot(path)
        self._contents.robot, self._contents.joints = path, read_joints(path)
        self._contents.robot_handle = self._number()
        return self._contents.robot_handle

    def _number(self) -> int:
        """Return a handle that no body has had, for one that is being added."""
        self._reopen()
        self._next += 1
        return self._next - 1

    def joint_table(self, body: int) -> list[tuple[int, str, str, float, float, float, float]]:
        """Return rows (index, joint, link, lower, upper, effort, speed) of a body's joints."""
        rows = []
        for index, joint in enumerate(self._contents.joints):
            turns = joint.kind != "fixed"
            spec = self._robot.joint(joint.name) if turns else None
            lower, upper = spec.range.tolist() if turns else (0.0, -1.0)
            effort = float(spec.actfrcrange[1]) if turns else 0.0
            rows.append((index, joint.name, joint.link, lower, upper, effort, joint.speed))
        return rows

    def collide_only(self, body: int, links: int, pairs: set[tuple[int, int]]) -> None:
        """Leave collisions within a body to these pairs of links (-1 is the base)."""
        self._reopen()
        self._contents.pairs = pairs

    def limit_speed(self, body: int, links: int, speed: float) -> None:
        """Set the most that any joint of a body may turn [rad/s], also when it is driven from outside."""
        self._speed = speed

    def clear(self, staying: list[int]) -> None:
        """Remove all astronauts, rocks and mounds; the next world is compiled anew, so that nothing is remembered."""
        self._contents.suits, self._contents.fixed = {}, {}
        self.relief = None
        self._forget()
        self.solve_finely(False)

    def set_up_vector(self, up: Array) -> None:
        """Let gravity pull against this unit vector (3,); a slope is a direction of gravity, see ``terrain``."""
        self._up = up
        if self._world is not None:
            self._world.model.opt.gravity = -LUNAR_GRAVITY * up

    def set_friction(self, coefficient: float, bodies: list[tuple[int, int]]) -> None:
        """Set the Coulomb coefficient between any two surfaces; the base of the robot keeps its own."""
        self._reopen()
        self.friction = self._contents.friction = coefficient

    def add_suit(self, limbs: Limbs, mass: float) -> RigidBody:
        """Make the astronaut's rigid body, far away; place it with ``place``."""
        handle = self._number()
        self._contents.suits[handle] = limbs, mass
        return RigidBody(handle, Rotation.from_quat(mass_properties(limbs).axes).inv())

    def add_rock(self, rock: Rock) -> int:
        """Add a rock, a fixed convex body."""
        return self._add_fixed([Hull(rock.corners(), rock.middle, rock.yaw)])

    def add_hull(self, vertices: Array) -> int:
        """Add a fixed convex body, corners in the world (M, 3) [m]."""
        return self._add_fixed([Hull(vertices, (0.0, 0.0, 0.0), 0.0)])

    def add_relief(self, terrain: Terrain) -> int:
        """Add the mounds of a terrain as one fixed body."""
        self.relief = self._add_fixed(relief_hulls(terrain))
        return self.relief

    def _add_fixed(self, hulls: list[Hull]) -> int:
        handle = self._number()
        self._contents.fixed[handle] = hulls
        return handle

    # -- the world, compiled when it is needed ---------------------------------------------------------------------
    def _reopen(self) -> None:
        """Take the compiled world apart again, as something is to be added; poses are kept, at rest."""
        if self._world is not None:
            world, self._world = self._world, None
            self._angles = {i: float(world.data.qpos[at]) for i, at in world.angles.items()}
            for handle, (_, at, _) in world.suits.items():
                self._poses[handle] = world.data.qpos[at : at + 3].copy(), world.data.qpos[[at + 4, at + 5, at + 6, at + 3]]

    def _compiled(self) -> World:
        """Return the world, compiled anew if anything was added to it."""
        if self._world is None:
            self._world = world = compile_world(self._contents, self._robot)
            world.model.opt.gravity = -LUNAR_GRAVITY * self._up
            option = world.model.opt
            option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
            option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
            option.impratio = IMPRATIO
            self._set_pace(self.pace)
            for index, angle in self._angles.items():
                world.data.qpos[world.angles[index]] = angle
            self._motors = Motors(world, *self._aims)
            self._rods = np.array(list(world.speeds.values()), np.int64)
            for handle, pose in self._poses.items():
                self._put(world, handle, *pose)
            self._placed()
        return self._world

    def _placed(self) -> None:
        """Note that bodies were placed, so that nothing of what was computed is so any more."""
        self._moved = self._unseen = True

    def _put(self, world: World, handle: int, position: Array, quaternion: Array) -> None:
        _, at, of_speed = world.suits[handle]
        x, y, z, w = quaternion
        world.data.qpos[at : at + 7] = [*position, w, x, y, z]
        world.data.qvel[of_speed : of_speed + 6] = 0.0

    # -- placing, only at reset ------------------------------------------------------------------------------------
    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body at rest somewhere (centre of gravity, frame of the principal axes)."""
        if handle == self._contents.robot_handle:
            self._reopen()
            self._contents.base = position, quaternion
            return
        self._poses[handle] = position, quaternion
        if self._world is not None:
            self._put(self._world, handle, position, quaternion)
            self._placed()

    def reset_joints(self, body: int, joints: list[int], angles: Array) -> None:
        """Set joint angles (n,) [rad], at rest."""
        self._angles.update(zip(joints, angles.tolist(), strict=True))
        if self._world is not None:
            self._world.data.qpos[[self._world.angles[i] for i in joints]] = angles
            self._world.data.qvel[[self._world.speeds[i] for i in joints]] = 0.0
            self._placed()

    # -- moving and reading ----------------------------------------------------------------------------------------
    def drive(self, body: int, joints: list[int], targets: list[float], torques: list[float]) -> None:
        """Set position targets of motors [rad] with torque limits [N m]."""
        self._aim(dict(zip(joints, targets, strict=True)), dict(zip(joints, torques, strict=True)))

    def release(self, body: int, joints: list[int]) -> None:
        """Switch the motors of these joints off."""
        self._aim(*({i: v for i, v in values.items() if i not in joints} for values in self._aims))

    def _aim(self, targets: dict[int, float], limits: dict[int, float]) -> None:
        self._aims = targets, limits
        if self._world is not None and self._motors is not None:
            self._motors.aim(targets, limits)

    def advance(self, substeps: int) -> None:
        """Let so many substeps pass."""
        data = self._compiled().data
        assert self._motors is not None
        for _ in range(substeps):
            self._motors.substep()
            speeds = data.qvel[self._rods]
            if np.abs(speeds).max(initial=0.0) > self._speed:
                data.qvel[self._rods] = np.clip(speeds, -self._speed, self._speed)
        self._moved, self._unseen = True, False

    def solve_finely(self, fine: bool) -> None:
        """Choose how time passes from now on: as for an arm at the astronaut, or as for none."""
        self._set_pace(self.settings.fine if fine else self.settings.free)

    def _set_pace(self, pace: Pace) -> None:
        self.pace = pace
        if self._world is not None:
            option = self._world.model.opt
            option.timestep, option.iterations = pace.substep, pace.iterations

    def _seen(self) -> World:
        """Return the world with the poses of all bodies up to date."""
        world = self._compiled()
        if self._moved:
            mujoco.mj_kinematics(world.model, world.data)
            self._moved = False
        return world

    def _touched(self) -> World:
        """Return the world with contacts: of the last substep, or as bodies were placed since."""
        world = self._compiled()
        if self._unseen:
            mujoco.mj_fwdPosition(world.model, world.data)
            self._moved = self._unseen = False
        return world

    def joint_states(self, body: int, joints: list[int]) -> tuple[Array, Array, Array]:
        """Read angles [rad], speeds [rad/s] and motor torques [N m], (n,) each."""
        world = self._compiled()
        torques = self._motors.torques if self._motors else {}
        angles = world.data.qpos[[world.angles[i] for i in joints]]
        speeds = world.data.qvel[[world.speeds[i] for i in joints]]
        return angles, speeds, np.array([torques.get(i, 0.0) for i in joints])

    def link_positions(self, body: int, links: list[int]) -> Array:
        """Read the positions of link frames (joint origins), (n, 3) [m]."""
        world = self._seen()
        return np.array(world.data.xpos[world.links[links]])

    def raw_pose(self, body: RigidBody) -> tuple[Vector, Vector]:
        """Read the centre of gravity and quaternion x, y, z, w of the principal axes."""
        world = self._compiled()
        _, at, _ = world.suits[body.handle]
        px, py, pz, w, x, y, z = world.data.qpos[at : at + 7].tolist()
        return (px, py, pz), (x, y, z, w)

    def velocity(self, body: RigidBody) -> tuple[Array, Array]:
        """Read linear [m/s] and angular [rad/s] velocity, (3,) each."""
        world = self._compiled()
        _, at, of_speed = world.suits[body.handle]
        spin = np.empty(3)  # MuJoCo keeps it in the body's own frame
        mujoco.mju_rotVecQuat(spin, world.data.qvel[of_speed + 3 : of_speed + 6], world.data.qpos[at + 3 : at + 7])
        return world.data.qvel[of_speed : of_speed + 3].copy(), spin

    def energy(self, bodies: list[int], up: Array) -> float:
        """Return kinetic and potential energy of bodies with all their links [J], heights against gravity (3,)."""
        world = self._seen()
        model, data = world.model, world.data
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        parts = [p for p, h in ((p, world.suits[h][0]) for h in bodies if h in world.suits for p in ())]
        parts = [world.suits[h][0] for h in bodies if h in world.suits]
        parts += [int(p) for p in world.links] if self._contents.robot_handle in bodies else []
        total, speed = 0.0, np.empty(6)
        for part in parts:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, part, speed, 1)
            moving = model.body_mass[part] * (speed[3:] @ speed[3:]) + model.body_inertia[part] @ speed[:3] ** 2
            total += 0.5 * float(moving) + float(model.body_mass[part] * LUNAR_GRAVITY * (up @ data.xipos[part]))
        return total

    def _contacts(self, first: int, second: int) -> tuple[World, Any, Any]:
        """Return the world and, of contacts of two bodies, their numbers and which way round they are."""
        world = self._touched()
        shapes = world.data.contact.geom
        if not len(shapes):
            return world, [], []
        owners = world.owners[shapes, 0]
        straight = (owners[:, 0] == first) & (owners[:, 1] == second)
        turned = (owners[:, 0] == second) & (owners[:, 1] == first)
        numbers = np.flatnonzero((straight | turned) & (world.data.contact.dist <= 0.0))
        return world, numbers, turned[numbers]

    def touching(self, first: int, second: int) -> bool:
        """Tell whether two bodies are in contact after the last substep."""
        return len(self._contacts(first, second)[1]) > 0

    def contact_forces(self, first: int, second: int) -> list[tuple[int, int, Vector]]:
        """Return rows (link of first, link of second, force on first (3,) [N]) of the last substep."""
        world, numbers, turned = self._contacts(first, second)
        rows: list[tuple[int, int, Vector]] = []
        force = np.empty(6)
        for number, other_way in zip(numbers, turned, strict=True):
            contact = world.data.contact[number]
            mujoco.mj_contactForce(world.model, world.data, number, force)
            # In the contact's frame, whose rows are its axes; it pushes the second shape.
            pushed = force[:3] @ contact.frame.reshape(3, 3)
            links = world.owners[contact.geom, 1].tolist()
            own, other = reversed(links) if other_way else links
            rows.append((own, other, tuple((pushed if other_way else -pushed).tolist())))
        return rows

    def overlaps(self, first: int, second: int) -> list[float]:
        """Return how deep two bodies overlap at each of their contacts after the last substep [m]."""
        world, numbers, _ = self._contacts(first, second)
        return [-float(world.data.contact.dist[number]) for number in numbers]

    def penetration(self, first: int, second: int) -> float:
        """Measure how deep two bodies overlap as they are placed now [m]."""
        self._unseen = True
        return max(self.overlaps(first, second), default=0.0)

    def first_hit(self, start: Array, end: Array) -> tuple[int, Array]:
        """Return the first body on a ray (-1 for none) and where it is hit (3,) [m]."""
        world = self._seen()
        shape, way = np.array([-1], np.int32), end - start
        share = mujoco.mj_ray(world.model, world.data, start, way, None, 1, -1, shape)
        if shape[0] < 0 or share > 1.0:
            return -1, np.zeros(3)
        return int(world.owners[shape[0], 0]), start + share * way
