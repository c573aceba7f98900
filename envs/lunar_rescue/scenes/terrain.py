"""The ground as data: level and smooth, or a slope with the relief of hummocky regolith.

The scene's frame stands on the ground: z is the normal of its mean plane. A slope is therefore a direction of gravity,
not of the ground, and everything that lies on the ground keeps its coordinates; a picture is taken with its up against
gravity and shows the slope.

The relief is a field of mounds above the plane on which the body lies, each a convex cap. Convex pieces cost the
simulation next to nothing, whereas Bullet's heightfields and meshes cost half as much again as a plane or more
(measured, see ``docs/environment.md``), and being solid they cannot hold a part of an arm from below.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from random import Random
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.records import checked, within

KINDS = ("smooth", "rough")
MAX_SLOPE = 10.0  # deg
ROUGH_SHARE = 0.5  # of the scenes, in every split
RELIEF_HALF = (1.9, 1.6)  # m, half sides of the ground on which mounds lie, along and across the body
#: The patch without mounds, which the body pressed flat as it fell: to head and feet, and to the front's and the back's
#: side; who lies on a side has arms and knees before them [m].
FLAT_ALONG = 1.2
FLAT_ACROSS: dict[str, tuple[float, float]] = {"lying": (0.43, 0.43), "on_side": (0.60, 0.32)}
MOUNDS = 16  # a relief; as many as PyBullet takes into one body
MOUND_RADIUS = (0.25, 0.60)  # m; assumption: decimetre hummocks, the scale on which arms and body meet the ground
MOUND_STEEPNESS = (0.05, 0.18)  # height over radius; flanks of up to twice that, about 20 deg
MOUND_OVAL = (0.7, 1.0)  # ratio of the radii
#: Mounds whose top is this near the body (along, across) are no higher than the last number: forearm and plate are one
#: straight bar, and must come in over them at a slope at which the plate still passes under the body [m].
NEAR = (0.9, 1.1, 0.07)
RELIEFS = range(16)  # reliefs that scenes are drawn from; the simulation keeps their shapes
HELDOUT_RELIEFS = range(1000, 1008)  # no training scene has these
RELIEF_STREAM = 1622  # keeps the generator of reliefs apart from others with the same seed

Place = Annotated[float, within((-100.0, 100.0))]  # m or rad, where anything in a scene may lie and turn to


class Mound(NamedTuple):
    """One convex cap; its surface is ``height * (1 - rho^2)`` with rho the distance in units of the radii."""

    x: float  # centre in the relief's frame [m]
    y: float  # centre in the relief's frame [m]
    along: float  # radius along its own x axis [m]
    across: float  # radius along its own y axis [m]
    height: float  # of the top [m]
    yaw: float  # heading of its x axis [rad]


@checked
@dataclass(frozen=True)
class Terrain:
    """The ground of one scene."""

    kind: str = "smooth"  # ``"smooth"`` (level, no relief) or ``"rough"``
    slope: Annotated[float, within((0.0, MAX_SLOPE))] = 0.0  # between the ground's normal and the vertical [deg]
    downhill: Place = 0.0  # heading of the steepest descent in the scene's frame [rad]
    relief: Annotated[int, Field(ge=0)] = 0  # seed of the mounds, see ``mounds``
    patch: str = "lying"  # key of ``FLAT_ACROSS``, the patch's shape
    x: Place = 0.0  # origin of the relief, where the body lies [m]
    y: Place = 0.0  # origin of the relief [m]
    yaw: Place = 0.0  # heading of the relief, along the body: its +y is the front's side of who lies on a side [rad]

    def __post_init__(self) -> None:
        """Refuse an unknown kind or patch, and smooth ground that is not level."""
        for name, value, known in (("kind", self.kind, KINDS), ("patch", self.patch, tuple(FLAT_ACROSS))):
            if value not in known:
                raise ValueError(f"Scene.terrain.{name}: expected one of {known}, got {value!r}")
        if self.kind == "smooth" and self.slope != 0.0:
            raise ValueError(f"Scene.terrain.slope: smooth ground is level, got {self.slope!r}")

    @property
    def rough(self) -> bool:
        """Tell whether the ground has a relief."""
        return self.kind == "rough"

    def up(self) -> Array:
        """Return the unit vector against gravity in the scene's frame, (3,)."""
        away, z = -math.sin(math.radians(self.slope)), math.cos(math.radians(self.slope))
        return np.array([away * math.cos(self.downhill), away * math.sin(self.downhill), z])

    def height(self, x: Array | float, y: Array | float) -> Array:
        """Return the ground's height above its mean plane at points of the scene's frame, same shape as x [m]."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        highest = np.zeros(np.broadcast(x, y).shape)
        if not self.rough:
            return highest
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        local_x, local_y = c * (x - self.x) + s * (y - self.y), -s * (x - self.x) + c * (y - self.y)
        centres, turns, inverse_radii, heights = _arrays(self.relief, self.patch)
        dx, dy = local_x[..., None] - centres[:, 0], local_y[..., None] - centres[:, 1]
        along = (turns[:, 0] * dx + turns[:, 1] * dy) * inverse_radii[:, 0]
        across = (turns[:, 0] * dy - turns[:, 1] * dx) * inverse_radii[:, 1]
        caps = heights * (1.0 - along * along - across * across)
        return np.maximum(caps.max(axis=-1), 0.0)


SMOOTH = Terrain()


@lru_cache(maxsize=64)
def mounds(relief: int, patch: str) -> tuple[Mound, ...]:
    """Return the mounds of a relief, a pure function of seed and patch; none reaches into the flat patch."""
    rng = np.random.default_rng([relief, RELIEF_STREAM])
    front, back = FLAT_ACROSS[patch]
    field: list[Mound] = []
    while len(field) < MOUNDS:
        along = float(rng.uniform(*MOUND_RADIUS))
        across = along * float(rng.uniform(*MOUND_OVAL))
        height = along * float(rng.uniform(*MOUND_STEEPNESS))
        x, y = (float(rng.uniform(-half, half)) for half in RELIEF_HALF)
        yaw = float(rng.uniform(0, np.pi))
        c, s = math.cos(yaw), math.sin(yaw)
        reach_x, reach_y = math.hypot(along * c, across * s), math.hypot(along * s, across * c)
        if abs(x) < NEAR[0] and abs(y) < NEAR[1]:
            height = min(height, NEAR[2])
        if abs(x) > FLAT_ALONG + reach_x or y > front + reach_y or y < -back - reach_y:
            field.append(Mound(x, y, along, across, height, yaw))
    return tuple(field)


@lru_cache(maxsize=64)
def _arrays(relief: int, patch: str) -> tuple[Array, Array, Array, Array]:
    field = np.array(mounds(relief, patch))
    turns = np.array([[math.cos(yaw), math.sin(yaw)] for yaw in field[:, 5].tolist()])
    return field[:, :2], turns, 1.0 / field[:, 2:4], field[:, 4]


def draw_terrain(rng: Random, pose: tuple[float, float, float], front: int, heldout: bool) -> Terrain:
    """Draw the ground under a body.

    ``pose`` is where it lies, x, y [m] and yaw [rad]; ``front`` the side that the front of who lies on a side looks to,
    +1 or -1 (+1 is +y with the head along +x), else 0.
    """
    if rng.random() >= ROUGH_SHARE:
        return SMOOTH
    slope, downhill = rng.uniform(0.0, MAX_SLOPE), rng.uniform(0.0, 2 * math.pi)
    relief = rng.choice(HELDOUT_RELIEFS if heldout else RELIEFS)
    turned = front < 0 or (front == 0 and rng.random() < 0.5)
    patch = "on_side" if front else "lying"
    return Terrain("rough", slope, downhill, relief, patch, pose[0], pose[1], pose[2] + math.pi * turned)
