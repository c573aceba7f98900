"""The second engine: the same worlds in MuJoCo, as a second opinion about contacts.

With ``mujoco_bodies``, ``mujoco_scene`` and ``mujoco_motors``, of which it is made, the only code that calls MuJoCo.
How it works, and why (measured, see ``docs/simulators.md``):

- Integrator ``discrete``: as in Bullet, forces of motors and contacts are those at the end of a substep and are found
  together; with the others, stiff motors push against contacts that do not know of them.
- Newton's solver, to its tolerance: some two to six iterations, so that their cap, the settings' ``iterations``, is of
  no account.
- Elliptic cones: with the pyramids friction falls to 0.7 of what it should be between two axes.
- ``impratio`` 10: who rests on the steepest slope creeps by 0.004 mm/s instead of 0.05.
- One substep, of 5 ms, for whatever happens: contacts overlap as little as Bullet's at 10 ms do.
"""

from typing import Any

import mujoco
import numpy as np

from lunar_rescue.arrays import Array
from lunar_rescue.physics.mujoco_bodies import MujocoBodies
from lunar_rescue.physics.mujoco_scene import World
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, RigidBody, Vector


class MujocoSimulation(MujocoBodies):
    """Ground, robot, astronaut and rocks in MuJoCo."""

    # -- moving and reading ----------------------------------------------------------------------------------------
    def drive(self, body: int, joints: list[int], targets: list[float], torques: list[float]) -> None:
        """Set position targets of motors [rad] with torque limits [N m]."""
        self._aim(dict(zip(joints, targets, strict=True)), dict(zip(joints, torques, strict=True)))

    def release(self, body: int, joints: list[int]) -> None:
        """Switch the motors of these joints off."""
        self._aim(*({i: v for i, v in values.items() if i not in joints} for values in self._aims))

    def _aim(self, targets: dict[int, float], limits: dict[int, float]) -> None:
        self._aims = targets, limits
        if self._world is not None:
            self._motors.aim(targets, limits)
            self._motors.gains = self.motor_gains

    def advance(self, substeps: int) -> None:
        """Let so many substeps pass."""
        speeds_of_all, motors = self._compiled().data.qvel, self._motors
        for _ in range(substeps):
            motors.substep()
            speeds = speeds_of_all.take(motors.places)
            if np.maximum.reduce(np.abs(speeds), initial=0.0) > self._speed:
                speeds_of_all[motors.places] = np.clip(speeds, -self._speed, self._speed)
        self._moved, self._unseen = True, False

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
        torques = self._motors.torques
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
        contact = world.data.contact
        shapes = contact.geom
        if not len(shapes):
            return world, [], []
        # Asked after each substep, so in few and plain steps.
        one, other = world.owners[:, 0].take(shapes.T)
        turned = (one == second) & (other == first)
        numbers = (((one == first) & (other == second) | turned) & (contact.dist <= 0.0)).nonzero()[0]
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
