"""What the rest of the project asks of a simulator: the interface, and what every engine answers alike.

``bullet`` and ``mujoco_engine`` are the engines behind it, ``engines`` makes one by its name. A body has a handle; the
links of a robot are counted as the joints of its file, from 0 in the file's order, and -1 is its base.
"""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.client import ROBOT_FILE
from lunar_rescue.physics.solver import Pace, SolverSettings
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.suit import Limbs
from lunar_rescue.scenes.terrain import Terrain

Vector = tuple[float, ...]

LUNAR_GRAVITY = 1.62  # m/s^2


class RigidBody(NamedTuple):
    """A body that moves: handle and the frame that a simulator keeps (centre of gravity, principal axes)."""

    handle: int
    axes_inverse: Rotation


class Simulation(ABC):
    """A world with ground, to which a robot is added once, and astronaut, rocks and mounds for each episode.

    Attributes:
        settings: How finely it works, with an arm at the astronaut and without.
        pace: Which of the two it is at.
        ground: Handle of the plane.
        relief: Handle of the mounds, None where the ground is smooth.
        friction: Coulomb coefficient between any two surfaces.
        motor_gains: What gains are multiplied by (n,), in the order in which joints are driven; None for right ones.
    """

    settings: SolverSettings
    pace: Pace
    ground: int
    relief: int | None
    friction: float
    motor_gains: Array | None = None

    # -- building --------------------------------------------------------------------------------------------------
    @abstractmethod
    def renew(self) -> None:
        """Empty the world and load the ground again; every other body is gone."""

    @property
    @abstractmethod
    def needs_rebuild(self) -> bool:
        """Tell whether the world should be renewed before the next episode."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the world; a second call does nothing."""

    @abstractmethod
    def load_robot(self, path: Path = ROBOT_FILE) -> int:
        """Load the robot; its base stays where it is put (braced by outriggers, an assumption)."""

    @abstractmethod
    def joint_table(self, body: int) -> list[tuple[int, str, str, float, float, float, float]]:
        """Return rows (index, joint, link, lower, upper, effort, speed) of a body's joints."""

    @abstractmethod
    def collide_only(self, body: int, links: int, pairs: set[tuple[int, int]]) -> None:
        """Leave collisions within a body to these pairs of links (-1 is the base)."""

    @abstractmethod
    def limit_speed(self, body: int, links: int, speed: float) -> None:
        """Set the most that any joint of a body may turn [rad/s], also when it is driven from outside."""

    @abstractmethod
    def clear(self, staying: list[int]) -> None:
        """Remove all astronauts, rocks and mounds; what stays must be placed anew and remembers nothing."""

    @abstractmethod
    def set_up_vector(self, up: Array) -> None:
        """Let gravity pull against this unit vector (3,); a slope is a direction of gravity, see ``terrain``."""

    @abstractmethod
    def set_friction(self, coefficient: float, bodies: list[tuple[int, int]]) -> None:
        """Set the Coulomb coefficient between any two surfaces; ``bodies`` are (handle, links) that stay.

        Of those the links get it, not the base: the robot's, which stands apart from all this, keeps its own.
        """

    @abstractmethod
    def add_suit(self, limbs: Limbs, mass: float, offset: Array | None = None) -> RigidBody:
        """Make the astronaut's rigid body, far away; place it with ``place``.

        ``offset`` (3,) [m], in the body frame, leads from the limbs' centre of gravity to the one that the body has.
        """

    @abstractmethod
    def add_rock(self, rock: Rock) -> int:
        """Add a rock, a fixed convex body."""

    @abstractmethod
    def add_hull(self, vertices: Array) -> int:
        """Add a fixed convex body, corners in the world (M, 3) [m]; its shape is not kept."""

    @abstractmethod
    def add_relief(self, terrain: Terrain) -> int:
        """Add the mounds of a terrain as one fixed body."""

    # -- placing, only at reset ------------------------------------------------------------------------------------
    @abstractmethod
    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body at rest somewhere (centre of gravity, frame of the principal axes)."""

    def place_suit(self, body: RigidBody, centre: Array, rotation: Rotation) -> None:
        """Put the astronaut at rest: centre of gravity and rotation of the body frame."""
        self.place(body.handle, centre, (rotation * body.axes_inverse.inv()).as_quat())

    @abstractmethod
    def reset_joints(self, body: int, joints: list[int], angles: Array) -> None:
        """Set joint angles (n,) [rad], at rest."""

    # -- moving ----------------------------------------------------------------------------------------------------
    @abstractmethod
    def drive(self, body: int, joints: list[int], targets: list[float], torques: list[float]) -> None:
        """Set position targets of motors [rad] with torque limits [N m].

        A motor turns its joint at ``POSITION_GAIN_PER_SECOND`` times what is missing, as far as its torque suffices.
        """

    @abstractmethod
    def release(self, body: int, joints: list[int]) -> None:
        """Switch the motors of these joints off."""

    @abstractmethod
    def advance(self, substeps: int) -> None:
        """Let so many substeps pass."""

    def advance_by(self, seconds: float) -> None:
        """Let time pass [s], in whole substeps."""
        self.advance(round(seconds / self.pace.substep))

    @abstractmethod
    def solve_finely(self, fine: bool) -> None:
        """Choose how time passes from now on: as for an arm at the astronaut, or as for none."""

    # -- reading ---------------------------------------------------------------------------------------------------
    @abstractmethod
    def joint_states(self, body: int, joints: list[int]) -> tuple[Array, Array, Array]:
        """Read angles [rad], speeds [rad/s] and motor torques [N m], (n,) each."""

    @abstractmethod
    def link_positions(self, body: int, links: list[int]) -> Array:
        """Read the positions of link frames (joint origins), (n, 3) [m]."""

    @abstractmethod
    def raw_pose(self, body: RigidBody) -> tuple[Vector, Vector]:
        """Read the centre of gravity and quaternion x, y, z, w of the principal axes."""

    def pose(self, body: RigidBody) -> tuple[Array, Rotation]:
        """Read the centre of gravity (3,) [m] and rotation of the body frame."""
        position, quaternion = self.raw_pose(body)
        return np.array(position), Rotation.from_quat(quaternion) * body.axes_inverse

    @abstractmethod
    def velocity(self, body: RigidBody) -> tuple[Array, Array]:
        """Read linear [m/s] and angular [rad/s] velocity, (3,) each."""

    @abstractmethod
    def energy(self, bodies: list[int], up: Array) -> float:
        """Return kinetic and potential energy of bodies with all their links [J], heights against gravity (3,)."""

    @abstractmethod
    def touching(self, first: int, second: int) -> bool:
        """Tell whether two bodies are in contact after the last substep."""

    def touching_ground(self, body: int) -> bool:
        """Tell whether a body is in contact with plane or mounds after the last substep."""
        return self.touching(body, self.ground) or (self.relief is not None and self.touching(body, self.relief))

    @abstractmethod
    def contact_forces(self, first: int, second: int) -> list[tuple[int, int, Vector]]:
        """Return rows (link of first, link of second, force on first (3,) [N]) of the last substep.

        There may be rows, too, of surfaces that are about to touch, with a force of nothing.
        """

    @abstractmethod
    def overlaps(self, first: int, second: int) -> list[float]:
        """Return how deep two bodies overlap at each of their contacts after the last substep [m]."""

    @abstractmethod
    def penetration(self, first: int, second: int) -> float:
        """Measure how deep two bodies overlap as they are placed now [m]."""

    @abstractmethod
    def first_hit(self, start: Array, end: Array) -> tuple[int, Array]:
        """Return the first body on a ray (-1 for none) and where it is hit (3,) [m]."""

    def ray_hits(self, start: Array, end: Array, handle: int) -> bool:
        """Tell whether the first thing on a ray is this body."""
        return self.first_hit(start, end)[0] == handle
