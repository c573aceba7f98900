"""The robot's head camera (section 3.1): colour and depth of what stands before it, drawn without a display.

The camera stands on a mast on the torso, so that it sees over raised arms and leans with the waist, and looks 50
degrees down: 96 x 72 pixels, 66 degrees upright. Bodies are drawn by PyBullet's software renderer from coarse shapes
and without shadows; the ground, a plane with mounds, is met by each ray in closed form, as drawing it would cost most
of the time. What a robot cannot choose, the light, the regolith, the suit's colour and how exactly the camera is
mounted, is drawn from a seed.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.episode import Episode
from lunar_rescue.physics.robot import WAIST
from lunar_rescue.pictures import regolith
from lunar_rescue.pictures.camera import Camera
from lunar_rescue.pictures.stage import Stage
from lunar_rescue.pictures.stage_set import GAMMA, StageSet, base_frame
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.scenes.terrain import mounds

WIDTH, HEIGHT = 96, 72  # px
FIELD_OF_VIEW = 66.0  # deg, upright; 82 deg across
NEAR, RANGE = 0.1, 4.0  # m, of the depth sensor; what is further away has depth 0, as nothing came back
WAIST_HEIGHT = 0.3  # m, of the waist's axis above the ground
MOUNT = (0.06, 0.0, 0.95)  # m, of the camera from there, in the torso
PITCH = math.radians(50.0)  # downwards, with an upright torso
#: How exactly the camera is mounted: standard deviations of place [m] and attitude [rad].
MOUNT_ERROR, TURN_ERROR = 0.004, math.radians(0.4)
DEPTH_NOISE = 0.004  # of the depth, standard deviation of a pixel
COLOUR_NOISE = 2.5  # of 255, the same of a colour
SUN_HEIGHT, SUNLIGHT, AMBIENT = (15.0, 60.0), (0.7, 1.4), (0.15, 0.4)  # deg; brightness
SCENES_OF_A_STAGE = 300  # then it is made anew: PyBullet keeps some memory of every shape that it ever had
_RIGHT_UP_BACK = np.array(
    [[0.0, -1.0, 0.0], [math.sin(PITCH), 0.0, math.cos(PITCH)], [-math.cos(PITCH), 0.0, math.sin(PITCH)]]
)  # the camera's axes in the torso, in rows

Colours = NDArray[np.uint8]
Depths = NDArray[np.uint16]


class Sight(NamedTuple):
    """One picture of the head camera."""

    colour: Colours  # (HEIGHT, WIDTH, 3)
    depth: Depths  # along the view (HEIGHT, WIDTH) [mm], 0 where nothing is within RANGE


@dataclass(frozen=True)
class Looks:
    """What a picture's seed decides of one episode's pictures."""

    sun: tuple[float, float]  # heading and height of the sun in the scene [deg]
    sunlight: float  # brightness of what the sun falls on squarely
    ambient: float  # brightness of what it does not fall on
    ground: tuple[float, float, float]  # brightness of the regolith, and where in its pattern the scene lies (2,) [m]
    suit: tuple[float, float, float]  # what the suit's red, green and blue are multiplied by
    mount: tuple[float, float, float]  # of the camera from where it should be, in the torso [m]
    turn: tuple[float, float, float]  # rotation vector from how it should look, in the torso [rad]


def draw_looks(seed: int) -> Looks:
    """Draw light, ground, suit and camera pose, a pure function of the seed."""
    rng = np.random.default_rng([abs(seed), 96])
    sun = float(rng.uniform(0.0, 360.0)), float(rng.uniform(*SUN_HEIGHT))
    light = float(rng.uniform(*SUNLIGHT)), float(rng.uniform(*AMBIENT))
    ground = float(rng.uniform(0.7, 1.3)), *rng.uniform(-50.0, 50.0, 2).tolist()
    suit = rng.uniform(0.75, 1.0) * rng.uniform(0.85, 1.0, 3)
    mount, turn = MOUNT_ERROR * rng.standard_normal(3), TURN_ERROR * rng.standard_normal(3)
    return Looks(sun, *light, ground, tuple(suit.tolist()), tuple(mount.tolist()), tuple(turn.tolist()))


def camera_pose(waist: float, looks: Looks | None = None) -> tuple[Array, Array]:
    """Return the camera's place (3,) [m] and its axes right, up and back, in rows (3, 3), in the robot's base frame.

    ``waist`` is that joint's angle [rad]; without ``looks`` the camera is mounted as it should be.
    """
    lean = Rotation.from_euler("y", waist).as_matrix()
    place, axes = np.array(MOUNT), _RIGHT_UP_BACK
    if looks is not None:
        place = place + looks.mount
        axes = axes @ Rotation.from_rotvec(looks.turn).as_matrix().T
    return lean @ place + [0.0, 0.0, WAIST_HEIGHT], axes @ lean.T


def head_camera(place: Array, axes: Array) -> Camera:
    """Return the camera at a place (3,) [m] with axes right, up and back, in rows (3, 3)."""
    upright, target = tuple(tuple(row) for row in axes.tolist()), tuple(place.tolist())
    return Camera(target, 0.0, 0.0, -90.0, (WIDTH, HEIGHT), upright, FIELD_OF_VIEW, NEAR, 2 * RANGE)


@lru_cache(maxsize=1)
def pixel_rays() -> Floats:
    """Return vectors through each pixel to depth 1 in the camera's axes right, up and back, (HEIGHT, WIDTH, 3)."""
    return head_camera(np.zeros(3), np.eye(3)).rays()


def pixels(points: Array, waist: float) -> Array:
    """Return pixels (x to the right, y down) and depth [m] of points (n, 3) [m] in the base frame, (n, 3)."""
    return head_camera(*camera_pose(waist)).project(points)


class Head:
    """Takes the head camera's pictures of episodes, on a coarse stage of its own.

    Attributes:
        parts: What the last picture shows in each pixel, (HEIGHT, WIDTH): 0 ground or sky, 1 robot, 2 suit, 3 the
            scene's first rock and so on. For labels; no picture holds it.
    """

    def __init__(self) -> None:
        """Prepare a stage on which nothing stands yet."""
        self._set, self._scenes = StageSet(Stage(), coarse=True), 0
        self.parts = np.zeros((HEIGHT, WIDTH), np.int64)

    def close(self) -> None:
        """Free the stage and its files."""
        self._set.close()

    def look(self, episode: Episode, seed: int | None = None) -> Sight:
        """Take a picture of an episode as it is now; its looks follow from ``seed``, or else from the scene's."""
        seed = episode.scene.seed if seed is None else seed
        if self._scenes >= SCENES_OF_A_STAGE:
            self._set.close()
            self._set, self._scenes = StageSet(Stage(), coarse=True), 0
        if self._set.show(episode, (1.0, 1.0, 1.0)):
            self._paint()
        looks, camera = self._camera(episode, seed)
        sun = Camera((0.0, 0.0, 0.0), yaw=looks.sun[0], pitch=-looks.sun[1])
        shade, depth, bodies = self._set.stage.look(camera, sun)
        seen = bodies >= 0
        body, link = np.where(seen, bodies & 0xFFFFFF, 0), np.where(seen, bodies >> 24, 0)
        away, colour, ground_shade = _ground(episode.scene, camera, looks, sun.towards)
        near = seen & ((metres := camera.depth_in_metres(depth)) < away)
        tint = np.where((body == self._set.suit)[..., None], np.array(looks.suit, np.float32), np.float32(1.0))
        colour = np.where(near[..., None], self._set.colours[body, link] * tint, colour)
        light = looks.ambient + looks.sunlight * np.where(near, shade, ground_shade)
        self.parts = np.where(near, self._labels[body], 0)
        return _noisy(colour * light[..., None], np.where(near, metres, away), [abs(seed), episode.steps])

    def hidden(self, episode: Episode) -> float:
        """Return the share of the suit's pixels, of those without the robot before it, that the robot hides now."""
        _, camera = self._camera(episode, episode.scene.seed)
        whole = self._set.stage
        visible = float((self.parts == 2).sum())
        origin, axes = base_frame(episode)
        turn = Rotation.from_matrix(axes).as_quat()
        whole.place(self._set.robot, origin - [0.0, 0.0, 50.0], turn)
        _, _, bodies = whole.look(camera, camera)
        whole.place(self._set.robot, origin, turn)
        alone = float(((bodies >= 0) & (bodies & 0xFFFFFF == self._set.suit)).sum())
        return 1.0 - min(1.0, visible / alone) if alone else 0.0

    def _camera(self, episode: Episode, seed: int) -> tuple[Looks, Camera]:
        looks, (origin, turned) = draw_looks(seed), base_frame(episode)
        place, axes = camera_pose(float(episode.robot.angles[WAIST]), looks)
        return looks, head_camera(origin + turned @ place, axes @ turned.T)

    def _paint(self) -> None:
        self._scenes += 1
        self._labels = np.zeros(len(self._set.colours), np.int64)
        self._labels[self._set.robot], self._labels[self._set.suit] = 1, 2
        self._labels[self._set.stones] = 3 + np.arange(len(self._set.stones))


def _ground(scene: Scene, camera: Camera, looks: Looks, sun: Array) -> tuple[Floats, Floats, Floats]:
    """Return depth [m], colour and shade of the ground alone, (HEIGHT, WIDTH), (HEIGHT, WIDTH, 3), (HEIGHT, WIDTH)."""
    rays, eye = camera.rays().reshape(-1, 3), camera.eye.astype(np.float32)
    down = np.maximum(-rays[:, 2], np.float32(1e-6))
    away = np.minimum(eye[2] / down, np.float32(2 * RANGE))
    flat, level = np.sqrt((rays[:, :2] ** 2).sum(axis=1)) / down, eye[:2] + away[:, None] * rays[:, :2]
    normal = np.zeros_like(rays)
    normal[:, 2] = 1.0
    for mound in _relief(scene):
        _add_mound(mound, rays, eye, level, flat, away, normal)
    cell = ((eye[:2] + away[:, None] * rays[:, :2] + looks.ground[1:]) * (regolith.CELLS / regolith.TILE)).astype(int)
    brightness, relief = (field[tuple(cell.T % regolith.CELLS)] for field in regolith.tile())
    normal[:, :2] -= relief
    shade = (normal @ sun).clip(0.0) / np.sqrt((normal * normal).sum(axis=1))
    grey = (looks.ground[0] * np.array(regolith.GREY, np.float32)) ** np.float32(GAMMA)
    colour = (brightness * (away < 2 * RANGE))[:, None] * grey
    shape = HEIGHT, WIDTH
    return away.reshape(shape), colour.reshape(*shape, 3), shade.reshape(shape).astype(np.float32)


def _add_mound(
    mound: Floats, rays: Floats, eye: Floats, level: Floats, flat: Floats, away: Floats, normal: Floats
) -> None:
    """Let rays (n, 3) from the eye end on a mound where they meet it first: depths (n,) and normals (n, 3) change.

    ``level`` is where rays meet the plane (n, 2), ``flat`` how far they go along it for each metre down (n,).
    """
    x, y, along, across, height, yaw = mound
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cosine / along, sine / along], [-sine / across, cosine / across]], np.float32)
    at = (level - [x, y]).astype(np.float32) @ turn.T
    (near,) = np.nonzero((at * at).sum(axis=1) < (1.0 + flat * height / min(along, across)) ** 2)
    # On the cap z = height (1 - |start + t way|^2), where t is the depth.
    start, way = turn @ (eye[:2] - [x, y]), rays[near, :2] @ turn.T
    a, c = height * (way * way).sum(axis=1), eye[2] - height * (1.0 - start @ start)
    b = 0.5 * rays[near, 2] + height * way @ start
    root = b * b - a * c
    t = c / (np.sqrt(root.clip(0.0)) - b)  # the nearer of two, in the form that a ray straight down does not upset
    meets = (root > 0.0) & (t > 0.0) & (t < away[near])
    hit, t = near[meets], t[meets]
    away[hit] = t
    normal[hit, :2] = 2.0 * height * (start + t[:, None] * way[meets]) @ turn


def _relief(scene: Scene) -> Floats:
    """Return the mounds of a scene's ground in its frame (m, 6), in the order of ``Mound``."""
    terrain = scene.terrain
    if not terrain.rough:
        return np.zeros((0, 6), np.float32)
    field = np.array(mounds(terrain.relief, terrain.patch))
    turned = Rotation.from_euler("z", terrain.yaw).as_matrix()[:2, :2]
    field[:, :2] = field[:, :2] @ turned.T + [terrain.x, terrain.y]
    field[:, 5] += terrain.yaw
    return field.astype(np.float32)


def _noisy(light: NDArray[Any], away: NDArray[Any], seed: list[int]) -> Sight:
    """Return what the sensors make of light (h, w, 3) and depth (h, w) [m]."""
    rng = np.random.default_rng([*seed, 72])
    colour = 255 * light.clip(0.0, 1.0) ** np.float32(1 / GAMMA)
    colour = colour + np.float32(COLOUR_NOISE) * rng.standard_normal(light.shape, np.float32)
    depth = 1000 * away * (1 + np.float32(DEPTH_NOISE) * rng.standard_normal(away.shape, np.float32))
    depth = np.where((away < RANGE) & (away > NEAR), depth, 0.0)
    return Sight(colour.clip(0, 255).astype(np.uint8), depth.clip(0, 65535).astype(np.uint16))
