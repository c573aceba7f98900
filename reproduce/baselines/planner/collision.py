"""Check whether the robot can stand in a configuration without touching anything, in a world that never steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.robot import ARM_JOINTS, ARMS

Array = NDArray[np.float64]

ROCK_MARGIN = 0.015  # m, motors lag and sag a little on the way
BODY_TOUCH = 0.006  # m, the plates are 3 cm thick and slide in under a suit that yields to a light touch
GROUND_TOUCH = 0.010  # m, plates skim over loose regolith


class CollisionChecker:
    """Hold robot, astronaut, ground and rocks of one scene, placed as at the start of an episode."""

    def __init__(self, env: LunarRescueEnv | None = None) -> None:
        """Build on an environment of its own, or on one that nobody steps."""
        self._env = env or LunarRescueEnv()
        self.body_touch = BODY_TOUCH  # how deep robot and resting astronaut may overlap [m]
        self.checks = 0  # configurations checked so far

    def set_scene(self, scene: Scene, margin: float = ROCK_MARGIN) -> None:
        """Place everything of a scene, with rocks ``margin`` [m] larger than they are."""
        self._env.reset_flat(options={"scene": scene})
        episode, simulation = self._env.episode, self._env.simulation
        self._astronaut = episode.astronaut.handle
        hulls = [_grow(rock.vertices(), margin) for rock in scene.rocks] if margin else []
        self._rocks = [*episode.rocks, *map(simulation.add_hull, hulls)]
        # An environment may load a new robot at a reset.
        by_name = {row[1]: row[0] for row in simulation.joint_table(self._env.robot.handle)}
        names = [f"{arm.name}_{joint}" for arm in ARMS for joint in ARM_JOINTS] + ["waist"]
        self._joints = [by_name[name] for name in names]
        relief = simulation.relief
        self._grounds = [simulation.ground] + ([] if relief is None else [relief])

    def close(self) -> None:
        """Disconnect from the simulation; nothing can be checked afterwards."""
        self._env.close()

    def free(self, angles: Array) -> bool:
        """Whether the robot at these angles (11,) [rad] touches no rock, itself or, beyond a light touch, anything."""
        self.checks += 1
        robot, simulation = self._env.robot.handle, self._env.simulation
        simulation.reset_joints(robot, self._joints, angles)
        # The first question also detects the contacts that the later ones read.
        if simulation.penetration(robot, self._astronaut) > self.body_touch:
            return False
        if any(simulation.touching(robot, other) for other in (*self._rocks, robot)):
            return False
        return all(simulation.penetration(robot, ground) <= GROUND_TOUCH for ground in self._grounds)


def _grow(vertices: Array, margin: float) -> Array:
    """Move the corners (M, 3) of a rock outwards by a margin [m]."""
    outward = vertices - vertices.mean(axis=0)
    grown: Array = vertices + margin * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    return grown
