"""Pictures of an episode: camera, sun and soft shadows (PyBullet's software renderer, no display needed).

A picture is made from data (the scene, the robot's joint angles, the astronaut's pose) on a stage of its own, never in
the simulation. PyBullet's software renderer tells per pixel what is seen, how deep and how it faces the sun; colours,
shadows and ground are worked out from that in NumPy, which is faster and finer than the renderer's own. The ground does
not move: it is drawn once for each scene and camera.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lunar_rescue.arrays import Floats
from lunar_rescue.episode import Episode
from lunar_rescue.pictures import regolith, shapes
from lunar_rescue.pictures.camera import SUN_CELLS, Camera, scene_camera, sun_camera
from lunar_rescue.pictures.stage import Stage
from lunar_rescue.pictures.stage_set import GAMMA, StageSet
from lunar_rescue.scenes.scene import Scene

Picture = NDArray[np.uint8]

SUNLIGHT, AMBIENT, FILL = 1.25, 0.10, 0.16  # of what regolith and instruments throw back into the shadows
WHITE = (1.0, 1.0, 1.0)


class _Ground(NamedTuple):
    """What stays the same between the pictures of one scene and camera; images at the renderer's size."""

    camera: Camera
    sun: Camera
    rays: Floats
    colour: Floats  # (h, w, 3), black where the sky is
    sunlight: Floats  # (h, w), sun on the ground where nothing is in the way
    cell: NDArray[np.int32]  # (h, w), cell of the shadow map
    depth: Floats  # (cells, cells), of the ground from the sun [m]


class Studio:
    """Takes pictures of episodes; keeps the stage of the last scene."""

    def __init__(self, fine: int = 2) -> None:
        """Prepare an empty stage; the renderer works with ``fine`` times the pixels each way, which smooths edges."""
        self._fine = fine
        self._set, self._bare = StageSet(Stage()), Stage()  # the bodies, and the ground without them
        self._ground: _Ground | None = None

    def close(self) -> None:
        """Free both stages and their files."""
        self._set.close()
        self._bare.close()

    def picture(self, episode: Episode, camera: Camera | None = None) -> Picture:
        """Take a picture of an episode as it is now, (height, width, 3), by ``scene_camera`` unless told."""
        camera = camera or scene_camera(episode.scene)
        if self._set.show(episode, WHITE):
            self._ground = None
        if self._ground is None or self._ground.camera != camera:
            self._ground = self._draw_ground(episode.scene, camera)
        ground, light = self._ground, self._light(self._ground)
        image = ground.colour * (ground.sunlight * light.ravel()[ground.cell] + AMBIENT + FILL)[..., None]
        self._draw_bodies(image, ground)
        fine = self._fine
        small = sum(image[i::fine, j::fine] for i in range(fine) for j in range(fine)) / np.float32(fine * fine)
        return np.asarray(255 * small.clip(0.0, 1.0) ** np.float32(1 / GAMMA)).astype(np.uint8)  # as screens expect it

    def _fine_camera(self, camera: Camera) -> Camera:
        return replace(camera, size=(camera.size[0] * self._fine, camera.size[1] * self._fine))

    def _draw_ground(self, scene: Scene, camera: Camera) -> _Ground:
        fine, sun = self._fine_camera(camera), sun_camera(camera)
        self._bare.clear()
        mesh = shapes.ground(scene.terrain.height, scene.terrain.up(), np.array(camera.target[:2]))
        self._bare.add_mesh((*mesh, WHITE))
        _, depth, seen = self._bare.look(fine, sun)
        _, sun_depth, _ = self._bare.look(sun, sun)
        rays = fine.rays()
        away = fine.depth_in_metres(depth)
        points = (fine.eye + rays * away[..., None]).reshape(-1, 3)
        brightness, slopes = regolith.surface(points[:, 0], points[:, 1], away.ravel())
        tilt = _slopes(scene, points[:, :2], camera.target)
        normals = np.column_stack([-(slopes + tilt), np.ones(len(points))])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        cosine = (normals @ sun.towards).clip(0.0).astype(np.float32).reshape(away.shape)
        colour = brightness[:, None] * np.array(regolith.GREY, np.float32) ** GAMMA
        colour[seen.ravel() < 0] = 0.0
        colour = colour.reshape(*away.shape, 3).astype(np.float32)
        cell, ground_depth = _cells(sun, points)[0].reshape(away.shape), sun.depth_in_metres(sun_depth)
        return _Ground(camera, sun, rays, colour, SUNLIGHT * cosine, cell, ground_depth)

    def _light(self, ground: _Ground) -> Floats:
        """Return the share of sun on the ground in each cell of the shadow map; keep the map of the bodies."""
        _, depth, bodies = self._set.stage.look(ground.sun, ground.sun)
        self._map = np.where(bodies >= 0, ground.sun.depth_in_metres(depth), np.float32(1e3))
        lit = (self._map > ground.depth - 0.01).astype(np.float32)
        lit[[0, -1], :] = lit[:, [0, -1]] = 1.0  # beyond the map there is no shadow
        return np.asarray(gaussian_filter(lit, 1.3))

    def _draw_bodies(self, image: Floats, ground: _Ground) -> None:
        camera, sun = self._fine_camera(ground.camera), ground.sun
        shade, depth, bodies = self._set.stage.look(camera, sun)
        mask = bodies >= 0
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if not len(rows):
            return
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        mask, bodies = mask[box], bodies[box]
        points = camera.eye.astype(np.float32) + ground.rays[box] * camera.depth_in_metres(depth[box])[..., None]
        normals = _normals(points)[mask]
        points = points[mask]
        colour = self._set.colours[bodies[mask] & 0xFFFFFF, bodies[mask] >> 24]
        rocky = self._set.rocky[bodies[mask] & 0xFFFFFF]
        if rocky.any():
            grain = points[rocky] @ np.array([[1.0, 0.3], [0.4, 1.0], [0.7, -0.6]], np.float32)
            colour[rocky] *= regolith.surface(grain[:, 0], grain[:, 1], np.zeros(len(grain), np.float32))[0][:, None]
        lit = self._lit(sun, points) * shade[box][mask]
        fill = replace(sun, yaw=ground.camera.yaw + 40.0, pitch=-25.0).towards.astype(np.float32)
        up = np.array(ground.camera.upright, np.float32)[2]
        rest = AMBIENT + FILL * (0.55 + 0.45 * (normals @ up)) + 0.14 * (normals @ fill).clip(0.0)
        image[box][mask] = colour * (SUNLIGHT * lit + rest)[:, None]

    def _lit(self, sun: Camera, points: Floats) -> Floats:
        """Return the share of sun on points of bodies (n, 3), soft over a few cells of the shadow map, (n,)."""
        cell, away = _cells(sun, points)
        flat = self._map.ravel()
        taps = [cell + dx + dy * SUN_CELLS for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        nearest = away - np.float32(0.04)
        lit = sum((flat.take(tap, mode="clip") > nearest).astype(np.float32) for tap in taps)
        return np.asarray(lit / np.float32(len(taps)), np.float32)


def _cells(sun: Camera, points: NDArray[Any]) -> tuple[NDArray[np.int32], Floats]:
    """Return the shadow map's cell (n,), its border beyond the map, and the distance from the sun (n,) [m]."""
    half = np.float32(SUN_CELLS / 2)
    rows = (sun.projection @ sun.view)[[0, 1, 3]].astype(np.float32)
    across, up, away = rows[:, :3] @ np.asarray(points, np.float32).T + rows[:, 3:]
    column = ((across / away + 1) * half).clip(0, SUN_CELLS - 1).astype(np.int32)
    row = ((1 - up / away) * half).clip(0, SUN_CELLS - 1).astype(np.int32)
    return row * np.int32(SUN_CELLS) + column, away


def _normals(points: Floats) -> Floats:
    """Return normals of a surface seen from a camera, (h, w, 3), from its points (h, w, 3); rough at outlines."""
    right, down = np.zeros_like(points), np.zeros_like(points)
    right[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    (ax, ay, az), (bx, by, bz) = np.moveaxis(down, -1, 0), np.moveaxis(right, -1, 0)
    normals = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)
    return np.asarray(normals / np.sqrt((normals * normals).sum(axis=-1, keepdims=True) + 1e-20))


def _slopes(scene: Scene, places: NDArray[Any], middle: tuple[float, ...], step: float = 0.02) -> NDArray[Any]:
    """Return slopes of the scene's ground along x and y at places (n, 2), none far away, (n, 2)."""
    x, y = places.T.astype(np.float64)
    near = (np.hypot(x - middle[0], y - middle[1]) < 2.5)[:, None]
    x, y = np.where(near[:, 0], x, middle[0]), np.where(near[:, 0], y, middle[1])
    along = (scene.terrain.height(x + step, y) - scene.terrain.height(x - step, y)) / (2 * step)
    across = (scene.terrain.height(x, y + step) - scene.terrain.height(x, y - step)) / (2 * step)
    return np.column_stack([along, across]) * near
