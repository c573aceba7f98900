"""The camera of a picture: from the scene to pixels and back."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.scenes.scene import Scene

SIZE = (480, 352)  # px, multiples of 16 as films want them
TURN = 68.0  # deg, camera beside the line from robot to astronaut
GALLERY_TURN = 150.0  # deg, camera beyond the astronaut
SUN_BESIDE, SUN_HEIGHT = -72.0, 33.0  # deg, the sun stands beside the camera, so that shapes show
SUN_AWAY, SUN_RADIUS, SUN_CELLS = 40.0, 2.2, 480  # m, m around the middle that cast shadows, cells of the shadow map


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    target: tuple[float, float, float]  # point looked at, in the scene (3,) [m]
    distance: float = 3.1  # from there [m]
    yaw: float = 0.0  # heading of the view; 0 looks along y [deg]
    pitch: float = -18.0  # negative looks down [deg]
    size: tuple[int, int] = SIZE  # width and height [px]
    # turns the scene so that gravity points down (3, 3): on a slope the ground leans, not the camera
    upright: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    field_of_view: float = 42.0  # upright [deg]
    near: float = 0.3  # nearest that is seen [m]
    far: float = 90.0  # furthest that is seen [m]

    @cached_property
    def view(self) -> Array:
        """Return the transformation from scene to camera, (4, 4)."""
        turn = Rotation.from_euler("zx", [-self.yaw, -90.0 - self.pitch], degrees=True).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3] = turn @ np.array(self.upright)
        matrix[:3, 3] = -matrix[:3, :3] @ np.array(self.target) - [0.0, 0.0, self.distance]
        return matrix

    @cached_property
    def projection(self) -> Array:
        """Return the transformation from camera to clip coordinates, (4, 4)."""
        f = 1.0 / np.tan(np.radians(self.field_of_view) / 2)
        near, far = self.near, self.far
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1] = f * self.size[1] / self.size[0], f
        matrix[2, 2], matrix[2, 3], matrix[3, 2] = (far + near) / (near - far), 2 * far * near / (near - far), -1.0
        return matrix

    @property
    def eye(self) -> Array:
        """Return where the camera is in the scene, (3,) [m]."""
        return np.asarray(-self.view[:3, :3].T @ self.view[:3, 3])

    @property
    def towards(self) -> Array:
        """Return the direction from what the camera looks at to the camera, unit vector (3,)."""
        return np.asarray(self.view[2, :3])

    def project(self, points: Array) -> Array:
        """Return pixels (x to the right, y down) and depth [m] of points (n, 3) of the scene, (n, 3)."""
        seen = points @ self.view[:3, :3].T + self.view[:3, 3]
        depth = -seen[:, 2]
        across, up = self.projection[0, 0] * seen[:, 0] / depth, self.projection[1, 1] * seen[:, 1] / depth
        width, height = self.size
        return np.column_stack([(across + 1) * width / 2, (1 - up) * height / 2, depth])

    def pixels_per_metre(self, depth: float) -> float:
        """Return how large a metre looks at this depth [m]."""
        return float(self.projection[1, 1] * self.size[1] / 2 / depth)

    def depth_in_metres(self, depth: Floats) -> Floats:
        """Return depth along the view [m] from the renderer's [0, 1]."""
        near, far = np.float32(self.near), np.float32(self.far)
        return near * far / (far - depth * (far - near))

    def rays(self) -> Floats:
        """Return vectors in the scene from the camera through each pixel to depth 1, (height, width, 3)."""
        width, height = self.size
        x = ((np.arange(width) + 0.5) * 2 / width - 1) / self.projection[0, 0]
        y = (1 - (np.arange(height) + 0.5) * 2 / height) / self.projection[1, 1]
        rays = np.stack([*np.meshgrid(x, y), np.full((height, width), -1.0)], -1) @ self.view[:3, :3]
        return np.asarray(rays, np.float32)


def scene_camera(scene: Scene, size: tuple[int, int] = SIZE, turn: float = TURN) -> Camera:
    """Return the camera beside the robot, looking at robot and astronaut; ``turn`` [deg] leads it round them."""
    x, y = (scene.base_x + scene.astronaut_x) / 2, (scene.base_y + scene.astronaut_y) / 2
    z = float(scene.terrain.height(x, y))
    yaw = float(np.degrees(scene.base_yaw)) - 90.0 + turn
    turned, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [scene.terrain.up()])
    upright = tuple(tuple(row) for row in turned.as_matrix().tolist())
    return Camera((x, y, z + 0.28), yaw=yaw, size=size, upright=upright)


def sun_camera(camera: Camera) -> Camera:
    """Return the sun as a camera that sees the middle of the scene; it stands beside the camera."""
    placed = replace(camera, distance=SUN_AWAY, yaw=camera.yaw + SUN_BESIDE, pitch=-SUN_HEIGHT)
    opening = float(np.degrees(2 * np.arctan(SUN_RADIUS / SUN_AWAY)))
    size, near, far = (SUN_CELLS, SUN_CELLS), SUN_AWAY - 5.0, SUN_AWAY + 5.0
    return replace(placed, size=size, field_of_view=opening, near=near, far=far)
