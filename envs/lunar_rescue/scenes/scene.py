"""A scene is data: what lies where, independent of any simulator."""

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.postures import Posture, all_postures, footprint, postures
from lunar_rescue.scenes.records import checked, from_json, within
from lunar_rescue.scenes.rocks import MAX_ROCKS, Rock
from lunar_rescue.scenes.suit import mass_properties, surface_points
from lunar_rescue.scenes.targets import approach_sides
from lunar_rescue.scenes.terrain import SMOOTH, Place, Terrain

TASKS = ("lift", "turn_over")

MASS_RANGE = (160.0, 343.0)  # kg, Apollo suited person to NASA's suited, incapacitated Artemis crew member
HELDOUT_MASSES = ((200.0, 215.0), (290.0, 305.0))  # kg, only held-out scenes have these, and they have no other
FRICTION_RANGE = (0.7, 0.9)  # regolith friction angle 35 to 42 deg (NTRS 19730039283)
BASE_RANGE = (0.75, 2.5)  # m, base to centre of gravity in any scene; nearer the robot would stand in the body
BASE_RADIUS = 0.30  # m, in any scene; drawn rocks keep further away
SAME = 1e-6  # m or half turns, what is written twice in a scene agrees within this


@checked
@dataclass(frozen=True)
class Scene:
    """One rescue task. The frame stands on the ground: z is its normal, and at z = 0 the body lies on it."""

    seed: Annotated[int, Field(ge=-1)]  # seed that it was drawn from, or -1
    task: str  # ``"lift"`` or ``"turn_over"``; the task code I
    posture: str  # name of one of the 20 postures, or of a held-out one
    astronaut_x: Place  # centre of gravity at rest [m]
    astronaut_y: Place  # centre of gravity at rest [m]
    astronaut_yaw: Place  # heading of the head [rad]
    mass: Annotated[float, within(MASS_RANGE)]  # whole suited mass [kg]
    friction: Annotated[float, within(FRICTION_RANGE)]  # Coulomb coefficient of ground, suit, rocks and plates
    base_x: Place  # robot base P_R [m]
    base_y: Place  # robot base P_R [m]
    base_yaw: Place  # robot base heading [rad]
    rocks: Annotated[tuple[Rock, ...], Field(max_length=MAX_ROCKS)] = ()  # the rocks
    terrain: Terrain = SMOOTH  # the ground

    def __post_init__(self) -> None:
        """Refuse what is known to nobody, or cannot lie where it is said to lie, naming the field."""
        known = all_postures()
        if self.posture not in known:
            raise ValueError(f"Scene.posture: expected one of {', '.join(known)}; got {self.posture!r}")
        if self.task not in known[self.posture].tasks:
            raise ValueError(f"Scene.task: posture {self.posture!r} has {known[self.posture].tasks}, got {self.task!r}")
        (least, most), away = BASE_RANGE, math.hypot(self.base_x - self.astronaut_x, self.base_y - self.astronaut_y)
        if not least <= away <= most:
            raise ValueError(f"Scene.base_x, base_y: expected {least:g} to {most:g} m from the astronaut, got {away:g}")
        self._check_ground()
        if self.rocks:
            self._check_rocks()

    def _check_ground(self) -> None:
        """Refuse a side to come from, or a relief, that does not suit how the body lies."""
        sides = approach_sides(self.model)
        if self.side not in sides:
            raise ValueError("Scene.base_x, base_y: the robot stands behind the back of who lies on a side")
        if self.terrain.rough:
            turned = (self.terrain.yaw - self.astronaut_yaw) / math.pi
            aside = math.dist((self.terrain.x, self.terrain.y), (self.astronaut_x, self.astronaut_y))
            if max(aside, abs(turned - round(turned))) > SAME:
                raise ValueError("Scene.terrain: expected x, y and yaw (or yaw + pi) of who lies on its patch")
            if self.terrain.patch != ("lying" if len(sides) == 2 else "on_side"):
                raise ValueError(f"Scene.terrain.patch: not that of {self.posture!r}: {self.terrain.patch!r}")
            if len(sides) == 1 and round(turned) % 2 != (sides[0] < 0):
                raise ValueError("Scene.terrain.yaw: the patch is turned to the back of who lies on a side")

    def _check_rocks(self) -> None:
        """Refuse rocks in the astronaut, under the robot, or above or below the ground."""
        x, y = self.astronaut_x, self.astronaut_y
        c, s = math.cos(self.astronaut_yaw), math.sin(self.astronaut_yaw)
        away = np.array([(rock.x - x, rock.y - y) for rock in self.rocks]) @ np.array([[c, -s], [s, c]])
        between = away[:, None, :] - footprint(self.model)
        nearest = np.sqrt(np.einsum("ijk,ijk->ij", between, between).min(axis=1)).tolist()
        heights = self.terrain.height(*np.array([(rock.x, rock.y) for rock in self.rocks]).T).tolist()
        for index, rock in enumerate(self.rocks):
            if abs(rock.ground - heights[index]) > SAME:
                raise ValueError(f"Scene.rocks[{index}].ground: expected {heights[index]:g}, got {rock.ground!r}")
            if nearest[index] < 0.5 * rock.diameter:
                raise ValueError(f"Scene.rocks[{index}]: lies in the astronaut")
            if math.hypot(rock.x - self.base_x, rock.y - self.base_y) < 0.5 * rock.diameter + BASE_RADIUS:
                raise ValueError(f"Scene.rocks[{index}]: lies under the robot's base")

    @property
    def model(self) -> Posture:
        """Return the posture that the scene names."""
        return all_postures()[self.posture]

    @property
    def side(self) -> int:
        """Return the side of the body on which the base stands, +1 or -1 (see ``approach_sides``)."""
        to_base = np.array([self.base_x - self.astronaut_x, self.base_y - self.astronaut_y])
        left = np.array([-math.sin(self.astronaut_yaw), math.cos(self.astronaut_yaw)])
        return 1 if float(to_base @ left) > 0 else -1

    def to_json(self) -> str:
        """Return the scene as JSON text."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """Read a scene back, bit for bit; ``ValueError`` names what is wrong."""
        return from_json(cls, text, "Scene.")


def task_distribution() -> list[tuple[str, str]]:
    """Return all pairs (posture, task); rho(I) is uniform over postures, then over a posture's tasks."""
    return [(name, task) for name, posture in postures().items() for task in posture.tasks]


def body_surface(scene: Scene) -> Array:
    """Return surface points of the resting astronaut in the world, (M, 3) [m]."""
    rotation = Rotation.from_euler("z", scene.astronaut_yaw) * scene.model.rest_rotation()
    local = surface_points(scene.model.limbs) - mass_properties(scene.model.limbs).centre
    return rotation.apply(local) + [scene.astronaut_x, scene.astronaut_y, scene.model.rest.height]
