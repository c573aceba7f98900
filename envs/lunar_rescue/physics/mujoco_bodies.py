"""The bodies of an episode in MuJoCo: described as they are added, compiled when the world is first asked about."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

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
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, RigidBody, Simulation
from lunar_rescue.physics.solver import MUJOCO_SETTINGS, Pace, SolverSettings
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.suit import Limbs, mass_properties
from lunar_rescue.scenes.terrain import Terrain

LEVEL = np.array([0.0, 0.0, 1.0])
TOLERANCE = 1e-12  # of the solver; forces are then those that move a body to a hundredth of a newton
IMPRATIO = 10.0  # how much stiffer contacts are against slipping than against sinking in


class MujocoBodies(NotCopied, Simulation):
    """A world with ground, to which the bodies of one episode after another are added."""

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
        self._motors: Any = None  # of the compiled world
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
            lower, upper = self._robot.joint(joint.name).range.tolist() if turns else (0.0, -1.0)
            effort = float(self._robot.joint(joint.name).actfrcrange[1]) if turns else 0.0
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

    def add_suit(self, limbs: Limbs, mass: float, offset: Array | None = None) -> RigidBody:
        """Make the astronaut's rigid body, far away; place it with ``place``."""
        handle = self._number()
        self._contents.suits[handle] = limbs, mass, np.zeros(3) if offset is None else offset
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
                pose = world.data.qpos[at : at + 7]
                self._poses[handle] = pose[:3].copy(), pose[[4, 5, 6, 3]]

    def _compiled(self) -> World:
        """Return the world, compiled anew if anything was added to it."""
        if self._world is None:
            self._world = world = compile_world(self._contents, self._robot)
            option = world.model.opt
            option.gravity = -LUNAR_GRAVITY * self._up
            option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_DISCRETE, mujoco.mjtCone.mjCONE_ELLIPTIC
            option.impratio, option.tolerance = IMPRATIO, TOLERANCE
            self._set_pace(self.pace)
            for index, angle in self._angles.items():
                world.data.qpos[world.angles[index]] = angle
            self._motors = Motors(world, *self._aims, gains=self.motor_gains)
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

    def solve_finely(self, fine: bool) -> None:
        """Choose how time passes from now on: as for an arm at the astronaut, or as for none."""
        self._set_pace(self.settings.fine if fine else self.settings.free)

    def _set_pace(self, pace: Pace) -> None:
        self.pace = pace
        if self._world is not None:
            option = self._world.model.opt
            option.timestep, option.iterations = pace.substep, pace.iterations

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
