"""How an episode begins, what it remembers besides the simulation's state, and the distances its rewards use."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import Observer
from lunar_rescue.physics.astronaut import Astronaut, AstronautState
from lunar_rescue.physics.robot import Robot, RobotState
from lunar_rescue.physics.simulation import Simulation
from lunar_rescue.physics.solver import CONTROL_STEP
from lunar_rescue.scenes.rocks import rock_marks
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.tasks import SMALLEST_ERROR, TASK_TYPES, Task, is_gentle

Array = NDArray[np.float64]

OVER = 0.15  # m above a target; an end higher than this has not slid in under the body


@dataclass
class Episode:
    """What an episode remembers besides the simulation's state."""

    scene: Scene
    astronaut: Astronaut
    task: Task
    observer: Observer
    rocks: list[int]
    marks: Array  # (m, 3) [m]
    order: list[int]  # which target belongs to arm A and arm B
    robot: RobotState
    body: AstronautState
    recent: deque[Array]  # distances (2,) of the last steps; their least is D_m
    process: int = 1
    held: int = 0
    steps: int = 0
    rock_contact: bool = False
    touched: bool = False  # whether an arm was within some 2 cm of the suit at the end of the last substep
    aapf: float = 0.0  # AAPF term of the last step
    nearest_mark: float = math.inf  # least distance of a joint to a mark point in any step [m]
    # Of the arms on the body, mean of the last step (2, 3) [N]
    forces: Array = field(default_factory=lambda: np.zeros((2, 3)))
    peak_force: float = 0.0  # greatest of an arm on the body in any step [N]
    peak_speed: float = 0.0  # greatest of the body's centre of gravity after any step [m/s]
    peak_acceleration: float = 0.0  # greatest mean of a step [m/s^2]
    _ways: Array = field(init=False)  # from targets to entries (2, 3) [m]
    _directions: Array = field(init=False)  # the same, unit length
    _lengths: Array = field(init=False)
    _targets: Array = field(init=False)

    def __post_init__(self) -> None:
        """Compute what stays the same during the episode."""
        self._ways = self.astronaut.ways_in[self.order]
        self._lengths = _lengths(self._ways)
        self._directions = self._ways / self._lengths[:, None]
        self._targets = self.astronaut.targets(self.body)[self.order]

    def update(self, robot: RobotState, body: AstronautState, forces: Array) -> None:
        """Take over the state of robot and body after a step, and the arms' forces (2, 3) [N] on the body in it."""
        gained = math.dist(body.velocity, self.body.velocity) / CONTROL_STEP
        self.peak_acceleration = max(self.peak_acceleration, gained)
        self.peak_speed = max(self.peak_speed, math.hypot(*body.velocity))
        self.peak_force = max(self.peak_force, float(_lengths(forces).max()))
        self.robot, self.body, self.forces = robot, body, forces
        self._targets = self.astronaut.targets(body)[self.order]
        self.steps += 1

    @property
    def gentle(self) -> bool:
        """Tell whether so far nothing was done to the astronaut that a person would not stand."""
        return is_gentle(self.peak_force, self.peak_speed, self.peak_acceleration)

    def targets(self) -> Array:
        """Return P_G, the target areas of arm A and arm B, (2, 3) [m]."""
        return self._targets

    def entries(self) -> Array:
        """Return where the way in to each target begins, before the body, for arm A and arm B, (2, 3) [m]."""
        return self._targets + self._ways

    def distances(self) -> Array:
        """Return D of each arm end to its target area, plus a detour for an end over the body, (2,) [m].

        The straight way from over the body leads through it: such an end must first go back before the body, or down
        beside it, so the smaller of height over ``OVER`` and depth behind the entry is added. This leaves no place but
        the target where every small motion makes D larger, and D stays continuous (a jump could be crossed again and
        again for reward; tried, see the training log).
        """
        from_target = self.robot.ends - self._targets
        depth = np.maximum(0.0, self._lengths - np.einsum("ij,ij->i", from_target, self._directions))
        height = np.maximum(0.0, from_target[:, 2] - OVER)
        return _lengths(from_target) + SMALLEST_ERROR + np.minimum(depth, height)


def _lengths(vectors: Array) -> Array:
    lengths: Array = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths


def begin_episode(
    simulation: Simulation,
    robot: Robot,
    scene: Scene,
    memory: int,
    *,
    seen: Scene | None = None,
    friction: float = 1.0,
    offset: Array | None = None,
) -> Episode:
    """Build a scene in an empty world, put the robot at q_init and return the episode.

    Args:
        simulation: The world; of the last episode only ground and robot are left.
        robot: The robot in it.
        scene: What lies where.
        memory: Steps whose least distance is D_m.
        seen: What the robot takes the scene for, where that is another one.
        friction: What the scene's friction is multiplied by.
        offset: What the astronaut's centre of gravity is off by (3,) [m], see ``Astronaut``.
    """
    simulation.set_up_vector(scene.terrain.up())
    simulation.set_friction(scene.friction * friction, [(robot.handle, robot.links)])
    robot.reset(scene.base_x, scene.base_y, scene.base_yaw)
    astronaut = Astronaut(simulation, scene, offset)
    if scene.terrain.rough:
        simulation.add_relief(scene.terrain)
    rocks = [simulation.add_rock(rock) for rock in scene.rocks]
    marks = rock_marks(scene.rocks)
    state, body = robot.state(fresh=True), astronaut.state()
    targets = astronaut.targets(body)
    left = np.array([-math.sin(scene.base_yaw), math.cos(scene.base_yaw), 0.0])
    order = [0, 1] if (targets[0] - targets[1]) @ left > 0 else [1, 0]
    places = targets[order], (targets + astronaut.ways_in)[order], rock_marks(seen.rocks) if seen else marks
    observer = Observer(seen or scene, robot, *places)
    task = TASK_TYPES[scene.task](astronaut.start)
    recent: deque[Array] = deque(maxlen=memory)
    episode = Episode(scene, astronaut, task, observer, rocks, marks, order, state, body, recent)
    recent.append(episode.distances())
    return episode
