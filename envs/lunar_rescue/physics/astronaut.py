"""The suited astronaut in the simulation: one rigid body, moved by contact and friction alone."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.simulation import Simulation
from lunar_rescue.scenes.postures import Posture
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.scenes.suit import keypoints, mass_properties
from lunar_rescue.scenes.targets import target_areas


@dataclass(frozen=True)
class AstronautState:
    """Where the astronaut is, as posture recognition and tracking would tell."""

    centre: Array  # centre of gravity P_P (3,) [m]
    rotation: Array  # body frame in the world, columns front, left, head (3, 3)
    velocity: Array  # of the centre of gravity (3,) [m/s]
    spin: Array  # angular velocity (3,) [rad/s]

    @property
    def front_up(self) -> float:
        """Return the cosine between the front and straight up: 1 on the back, -1 face down."""
        return float(self.rotation[2, 0])


class Astronaut:
    """Builds the body of a scene and reads its state.

    ``ways_in`` lead from each target (head's side, feet's side) to the entry before the body, in the world (2, 3) [m].
    """

    def __init__(self, simulation: Simulation, scene: Scene, offset: Array | None = None) -> None:
        """Build the body at rest in its posture.

        ``offset`` (3,) [m], front, left and head, is where its centre of gravity is beside the one that it should have;
        states and targets are those of the suit, wherever its centre of gravity is.
        """
        fixed = body_geometry(scene.model, scene.side, scene.task)
        c, s = math.cos(scene.astronaut_yaw), math.sin(scene.astronaut_yaw)
        heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        centre = np.array([scene.astronaut_x, scene.astronaut_y, scene.model.rest.height])
        self._simulation = simulation
        self._body = simulation.add_suit(scene.model.limbs, scene.mass, offset)
        self.handle = self._body.handle
        self.start = AstronautState(centre, heading @ fixed.rotation, np.zeros(3), np.zeros(3))
        self._fixed, self._offset = fixed, offset
        placed = centre if offset is None else centre + self.start.rotation @ offset
        simulation.place(self.handle, placed, _turned(0.5 * scene.astronaut_yaw, fixed.quaternion))
        self.ways_in = fixed.way_in[:, None] * np.array([-s, c, 0.0]) * scene.side

    def state(self) -> AstronautState:
        """Read pose and velocity from the simulation."""
        position, quaternion = self._simulation.raw_pose(self._body)
        linear, angular = self._simulation.velocity(self._body)
        rotation = _matrix(quaternion) @ self._fixed.to_body
        centre = np.array(position)
        if self._offset is not None:
            away = rotation @ self._offset
            centre, linear = centre - away, linear - np.cross(angular, away)
        return AstronautState(centre, rotation, linear, angular)

    def targets(self, state: AstronautState) -> Array:
        """Return the two target areas P_G now (head's side, feet's side), moving with the body, (2, 3) [m]."""
        points: Array = self._fixed.targets @ state.rotation.T + state.centre
        points[:, 2] = np.maximum(points[:, 2], 0.03)
        return points

    def keypoints(self, state: AstronautState) -> Array:
        """Return the skeleton's 13 key points now, (13, 3) [m]."""
        return np.asarray(self._fixed.keypoints @ state.rotation.T + state.centre)


class BodyGeometry(NamedTuple):
    """What is the same in each scene of a posture, a side and a task."""

    rotation: Array  # body frame at rest, head along +x (3, 3)
    quaternion: Array  # principal axes at rest, x, y, z, w
    to_body: Array  # from principal axes to the body frame (3, 3)
    targets: Array  # in the body frame (2, 3) [m]
    keypoints: Array  # in the body frame (13, 3) [m]
    way_in: Array  # length of the ways in (2,) [m]


@lru_cache(maxsize=256)
def body_geometry(posture: Posture, side: int, task: str) -> BodyGeometry:
    """Return what follows from posture, side of the robot (+1 or -1) and task, wherever the body lies."""
    properties, rest, areas = mass_properties(posture.limbs), posture.rest_rotation(), target_areas(posture, side, task)
    axes = Rotation.from_quat(properties.axes)
    targets, skeleton = rest.inv().apply(areas.offsets), keypoints(posture.limbs) - properties.centre
    quaternion, to_body = (rest * axes).as_quat(), axes.inv().as_matrix()
    return BodyGeometry(rest.as_matrix(), quaternion, to_body, targets, skeleton, areas.way_in)


def _turned(half: float, q: Array) -> Array:
    """Return the quaternion of a turn about z by twice ``half`` [rad] after ``q``, x, y, z, w."""
    c, s = math.cos(half), math.sin(half)
    x, y, z, w = q.tolist()
    return np.array([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])


def _matrix(q: tuple[float, ...]) -> Array:
    """Return the rotation matrix of a quaternion x, y, z, w; SciPy's takes ten times as long for one."""
    x, y, z, w = q
    first = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    second = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    third = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return np.array([first, second, third])
