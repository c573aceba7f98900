"""The suited astronaut in the simulation: one rigid body, moved by contact and friction alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.scene import Scene, rest_pose
from lunar_rescue.simulation import RigidBody, Simulation
from lunar_rescue.suit import keypoints, mass_properties
from lunar_rescue.targets import target_areas

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AstronautState:
    """Where the astronaut is, as posture recognition and tracking would tell.

    Attributes:
        centre: Centre of gravity P_P (3,) [m].
        rotation: Body frame in the world, columns front, left, head (3, 3).
        velocity: Of the centre of gravity (3,) [m/s].
        spin: Angular velocity (3,) [rad/s].
    """

    centre: Array
    rotation: Array
    velocity: Array
    spin: Array

    @property
    def front_up(self) -> float:
        """Cosine between the front and straight up: 1 on the back, -1 face down."""
        return float(self.rotation[2, 0])


class Astronaut:
    """Builds the body of a scene and reads its state.

    Attributes:
        ways_in: From each target (head's side, feet's side) to the entry before the body, in the world (2, 3) [m].
    """

    def __init__(self, simulation: Simulation, scene: Scene) -> None:
        """Build the body at rest in its posture."""
        limbs = scene.model.limbs
        self._simulation = simulation
        self._body: RigidBody = simulation.add_suit(limbs, scene.mass)
        self._to_body = self._body.axes_inverse.as_matrix()
        centre, rotation = rest_pose(scene)
        simulation.place_suit(self._body, centre, rotation)
        self.start = AstronautState(centre, rotation.as_matrix(), np.zeros(3), np.zeros(3))
        areas = target_areas(scene.model, scene.side, scene.task)
        self._targets = scene.model.rest_rotation().inv().apply(areas.offsets)
        towards = np.array([-np.sin(scene.astronaut_yaw), np.cos(scene.astronaut_yaw), 0.0]) * scene.side
        self.ways_in = areas.way_in[:, None] * towards
        self._keypoints = keypoints(limbs) - mass_properties(limbs).centre

    @property
    def handle(self) -> int:
        """The body in the simulation."""
        return self._body.handle

    def state(self) -> AstronautState:
        """Read the pose and velocity."""
        position, quaternion = self._simulation.raw_pose(self._body)
        linear, angular = self._simulation.velocity(self._body)
        rotation = _matrix(quaternion) @ self._to_body
        return AstronautState(np.array(position), rotation, linear, angular)

    def targets(self, state: AstronautState) -> Array:
        """The two target areas P_G now (head's side, feet's side), moving with the body, (2, 3) [m]."""
        points: Array = self._targets @ state.rotation.T + state.centre
        points[:, 2] = np.maximum(points[:, 2], 0.03)
        return points

    def keypoints(self, state: AstronautState) -> Array:
        """The skeleton's 13 key points now, (13, 3) [m]."""
        points: Array = self._keypoints @ state.rotation.T + state.centre
        return points


def _matrix(q: tuple[float, ...]) -> Array:
    """Rotation matrix of a quaternion x, y, z, w; SciPy's takes ten times as long for one."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
