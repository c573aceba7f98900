"""A scene is data: what lies where, drawn from a seed, independent of any simulator."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.scenes.postures import Posture, all_postures, heldout_postures, postures
from lunar_rescue.scenes.rocks import MAX_ROCKS, ROCK_SIZE_RANGE, Rock, RockField, draw_field, draw_rocks
from lunar_rescue.scenes.splits import split_of
from lunar_rescue.scenes.suit import mass_properties, surface_points
from lunar_rescue.scenes.targets import approach_sides, target_areas
from lunar_rescue.scenes.terrain import SMOOTH, Terrain, draw_terrain

Array = NDArray[np.float64]

TASKS = ("lift", "turn_over")

MASS_RANGE = (160.0, 343.0)  # kg, Apollo suited person to NASA's suited, incapacitated Artemis crew member
HELDOUT_MASSES = ((200.0, 215.0), (290.0, 305.0))  # kg, only held-out scenes have these, and they have no other
FRICTION_RANGE = (0.7, 0.9)  # regolith friction angle 35 to 42 deg (NTRS 19730039283)
_EDGES = (MASS_RANGE[0], *(edge for interval in HELDOUT_MASSES for edge in interval), MASS_RANGE[1])
MASS_PIECES = {False: tuple(itertools.pairwise(_EDGES))[::2], True: HELDOUT_MASSES}  # by whether held out
DISTANCE_RANGE = (0.85, 0.97)  # m, base to the body's long axis; assumption: within reach, not touching
BASE_RANGE = (0.75, 2.5)  # m, base to centre of gravity in any scene; nearer the robot would stand in the body
BASE_RADIUS = 0.30  # m, in any scene; drawn rocks keep further away
NEAR_EDGE_FREE = 0.40  # m, a body that reaches further towards the robot than this moves the base back by the rest
SIDEWAYS_RANGE = (-0.08, 0.08)  # m, base along the body; assumption
YAW_ERROR_RANGE = (-6.0, 6.0)  # deg, base from facing the body squarely; assumption


@dataclass(frozen=True)
class Scene:
    """One rescue to be made. The frame stands on the ground: z is its normal, and at z = 0 the body lies on it.

    Attributes:
        seed: Seed that it was drawn from, or -1.
        task: ``"lift"`` or ``"turn_over"``; the task code I.
        posture: Name of one of the 20 postures, or of a held-out one.
        astronaut_x: Centre of gravity at rest [m].
        astronaut_y: Centre of gravity at rest [m].
        astronaut_yaw: Heading of the head [rad].
        mass: Whole suited mass [kg].
        friction: Coulomb coefficient of ground, suit, rocks and plates.
        base_x: Robot base P_R [m].
        base_y: Robot base P_R [m].
        base_yaw: Robot base heading [rad].
        rocks: The rocks.
        terrain: The ground.
    """

    seed: int
    task: str
    posture: str
    astronaut_x: float
    astronaut_y: float
    astronaut_yaw: float
    mass: float
    friction: float
    base_x: float
    base_y: float
    base_yaw: float
    rocks: tuple[Rock, ...] = ()
    terrain: Terrain = SMOOTH

    def __post_init__(self) -> None:
        """Refuse a scene that is malformed or out of range, naming the field."""
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < -1:
            raise ValueError(f"Scene.seed: expected an integer >= -1, got {self.seed!r}")
        for name in ("posture", "task"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"Scene.{name}: expected a name, got {getattr(self, name)!r}")
        known = all_postures()
        if self.posture not in known:
            raise ValueError(f"Scene.posture: expected one of {', '.join(known)}; got {self.posture!r}")
        if self.task not in known[self.posture].tasks:
            raise ValueError(f"Scene.task: posture {self.posture!r} has {known[self.posture].tasks}, got {self.task!r}")
        if not isinstance(self.terrain, Terrain):
            raise ValueError(f"Scene.terrain: expected a Terrain, got {self.terrain!r}")
        _in_range("mass", self.mass, MASS_RANGE)
        _in_range("friction", self.friction, FRICTION_RANGE)
        for name in ("astronaut_x", "astronaut_y", "astronaut_yaw", "base_x", "base_y", "base_yaw"):
            _in_range(name, getattr(self, name), (-100.0, 100.0))
        self._check_rocks()
        self._check_places()

    def _check_rocks(self) -> None:
        """Refuse rocks that are malformed or out of range."""
        if not isinstance(self.rocks, tuple) or not all(isinstance(rock, Rock) for rock in self.rocks):
            raise ValueError(f"Scene.rocks: expected a tuple of Rock, got {self.rocks!r}")
        if len(self.rocks) > MAX_ROCKS:
            raise ValueError(f"Scene.rocks: expected at most {MAX_ROCKS}, got {len(self.rocks)}")
        for index, rock in enumerate(self.rocks):
            where = f"rocks[{index}]"
            _in_range(f"{where}.diameter", rock.diameter, ROCK_SIZE_RANGE)
            _in_range(f"{where}.height", rock.height, (0.02, 0.5))
            _in_range(f"{where}.buried", rock.buried, (0.0, 0.95))
            _in_range(f"{where}.x", rock.x, (-100.0, 100.0))
            _in_range(f"{where}.y", rock.y, (-100.0, 100.0))
            _in_range(f"{where}.ground", rock.ground, (-1.0, 1.0))
            _in_range(f"{where}.yaw", rock.yaw, (-100.0, 100.0))
            if isinstance(rock.shape, bool) or not isinstance(rock.shape, int) or rock.shape < 0:
                raise ValueError(f"Scene.{where}.shape: expected an integer >= 0, got {rock.shape!r}")

    def _check_ground(self) -> None:
        """Refuse a side to come from, or a relief, that does not suit how the body lies."""
        sides = approach_sides(self.model)
        if self.side not in sides:
            raise ValueError("Scene.base_x, base_y: the robot stands behind the back of who lies on a side")
        if self.terrain.rough:
            turned = (self.terrain.yaw - self.astronaut_yaw) / math.pi
            aside = math.dist((self.terrain.x, self.terrain.y), (self.astronaut_x, self.astronaut_y))
            if max(aside, abs(turned - round(turned))) > 1e-6:
                raise ValueError(
                    "Scene.terrain: expected x, y and yaw (or yaw + pi) of the astronaut, who lies on its patch"
                )
            if self.terrain.patch != ("lying" if len(sides) == 2 else "on_side"):
                raise ValueError(f"Scene.terrain.patch: not that of {self.posture!r}: {self.terrain.patch!r}")
            if len(sides) == 1 and round(turned) % 2 != (sides[0] < 0):
                raise ValueError("Scene.terrain.yaw: the patch is turned to the back of who lies on a side")

    def _check_places(self) -> None:
        """Refuse what cannot lie where it is said to lie."""
        x, y = self.astronaut_x, self.astronaut_y
        _in_range("base_x, base_y: distance to the astronaut", math.hypot(self.base_x - x, self.base_y - y), BASE_RANGE)
        self._check_ground()
        if not self.rocks:
            return
        c, s = math.cos(self.astronaut_yaw), math.sin(self.astronaut_yaw)
        away = np.array([(rock.x - x, rock.y - y) for rock in self.rocks]) @ np.array([[c, -s], [s, c]])
        between = away[:, None, :] - _footprint(self.model)
        nearest = np.sqrt(np.einsum("ijk,ijk->ij", between, between).min(axis=1)).tolist()
        heights = self.terrain.height(*np.array([(rock.x, rock.y) for rock in self.rocks]).T).tolist()
        for index, rock in enumerate(self.rocks):
            if abs(rock.ground - heights[index]) > 1e-6:
                raise ValueError(f"Scene.rocks[{index}].ground: expected {heights[index]:g}, got {rock.ground!r}")
            if nearest[index] < 0.5 * rock.diameter:
                raise ValueError(f"Scene.rocks[{index}]: lies in the astronaut")
            if math.hypot(rock.x - self.base_x, rock.y - self.base_y) < 0.5 * rock.diameter + BASE_RADIUS:
                raise ValueError(f"Scene.rocks[{index}]: lies under the robot's base")

    @property
    def model(self) -> Posture:
        """The posture itself."""
        return all_postures()[self.posture]

    @property
    def side(self) -> int:
        """Side of the body on which the base stands, +1 or -1 (see ``approach_sides``)."""
        to_base = np.array([self.base_x - self.astronaut_x, self.base_y - self.astronaut_y])
        left = np.array([-math.sin(self.astronaut_yaw), math.cos(self.astronaut_yaw)])
        return 1 if float(to_base @ left) > 0 else -1

    def to_json(self) -> str:
        """Return the scene as JSON text."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Read a scene back, bit for bit; ``ValueError`` names what is wrong."""
        try:
            raw = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"Scene: not JSON: {error}") from None
        fields = _checked_fields(raw, cls, "Scene", optional=("rocks", "terrain"))
        rocks = fields.get("rocks", [])
        if not isinstance(rocks, list):
            raise ValueError(f"Scene.rocks: expected a list, got {type(rocks).__name__}")
        fields["rocks"] = tuple(
            Rock(**_checked_fields(rock, Rock, f"Scene.rocks[{i}]")) for i, rock in enumerate(rocks)
        )
        if "terrain" in fields:
            fields["terrain"] = Terrain(**_checked_fields(fields["terrain"], Terrain, "Scene.terrain"))
        return cls(**fields)


def _checked_fields(raw: Any, cls: type, where: str, optional: tuple[str, ...] = ()) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise ValueError(f"{where}: expected an object, got {type(raw).__name__}")
    types = {f.name: str(f.type) for f in dataclasses.fields(cls)}
    for name in types:
        if name not in raw and name not in optional:
            raise ValueError(f"{where}: missing {name}")
    for name, value in raw.items():
        if name not in types:
            raise ValueError(f"{where}: unknown field {name!r}")
        wanted = {"float": (int, float), "int": (int,), "str": (str,)}.get(types[name])
        if wanted and (isinstance(value, bool) or not isinstance(value, wanted)):
            raise ValueError(f"{where}.{name}: expected {types[name]}, got {value!r}")
    return dict(raw)


def _in_range(name: str, value: float, bounds: tuple[float, float]) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not bounds[0] <= value <= bounds[1]:
        raise ValueError(f"Scene.{name}: expected {bounds[0]:g} to {bounds[1]:g}, got {value!r}")


def task_distribution() -> list[tuple[str, str]]:
    """All pairs (posture, task); rho(I) is uniform over postures, then over a posture's tasks."""
    return [(name, task) for name, posture in postures().items() for task in posture.tasks]


def sample_scene(seed: int, *, posture: str | None = None, task: str | None = None) -> Scene:
    """Draw a scene, a pure function of its arguments.

    Args:
        seed: Any integer >= 0; its split (``lunar_rescue.scenes.splits``) decides about postures, masses, rocks
            and reliefs.
        posture: Fix the posture, whatever the split has.
        task: Fix the task; without a posture, one that has the task is drawn.

    Raises:
        ValueError: On a negative seed, an unknown posture or task, or a task that the posture does not have.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed: expected an integer >= 0, got {seed!r}")
    heldout = split_of(int(seed)) == "heldout"
    # The standard library's generator: some forty single numbers cost NumPy's ten times as much.
    rng = Random(int(seed))
    model, chosen = _draw_task(rng, posture, task, heldout_postures() if heldout else postures())
    pose = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(0.0, 2 * math.pi)
    sides = approach_sides(model)
    side = rng.choice(sides)
    base = _draw_base(rng, model, chosen, side, pose)
    mass, friction = _draw_mass(rng, heldout), rng.uniform(*FRICTION_RANGE)
    terrain = draw_terrain(rng, pose, side if len(sides) == 1 else 0, heldout)
    rocks = _draw_rocks(rng, model, chosen, side, pose, base, terrain, draw_field(rng, heldout))
    return Scene(int(seed), chosen, model.name, *pose, mass, friction, *base, rocks=rocks, terrain=terrain)


def _draw_mass(rng: Random, heldout: bool) -> float:
    """Uniform over the held-out intervals, or over all the rest of the range."""
    pieces = MASS_PIECES[heldout]
    along = rng.random() * sum(high - low for low, high in pieces)
    for low, high in pieces:
        if along < high - low:
            return low + along
        along -= high - low
    return pieces[-1][1]


def _draw_task(rng: Random, posture: str | None, task: str | None, drawn: dict[str, Posture]) -> tuple[Posture, str]:
    known = all_postures()
    if posture is not None and posture not in known:
        raise ValueError(f"posture: expected one of {', '.join(known)}; got {posture!r}")
    if task is not None and task not in TASKS:
        raise ValueError(f"task: expected one of {TASKS}, got {task!r}")
    names = [posture] if posture else [n for n, p in drawn.items() if task is None or task in p.tasks]
    model = known[rng.choice(names)]
    if task is not None and task not in model.tasks:
        raise ValueError(f"task: posture {model.name!r} has {model.tasks}, not {task!r}")
    return model, task or rng.choice(model.tasks)


def _draw_base(
    rng: Random, model: Posture, task: str, side: int, pose: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Base pose facing the middle of the two targets, with errors."""
    x, y, yaw = pose
    areas = target_areas(model, side, task)
    along = float(areas.offsets[:, 0].mean()) + rng.uniform(*SIDEWAYS_RANGE)
    # Bent knees need room to get the plates down before them.
    room = max(0.0, float(areas.near_edge.max()) - NEAR_EDGE_FREE)
    away = side * (room + rng.uniform(*DISTANCE_RANGE))
    c, s = math.cos(yaw), math.sin(yaw)
    facing = yaw - side * math.pi / 2 + math.radians(rng.uniform(*YAW_ERROR_RANGE))
    return x + c * along - s * away, y + s * along + c * away, facing


def _draw_rocks(
    rng: Random,
    model: Posture,
    task: str,
    side: int,
    pose: tuple[float, float, float],
    base: tuple[float, float, float],
    terrain: Terrain,
    field: RockField,
) -> tuple[Rock, ...]:
    """Rocks around the body, never in it, in the base or right in a target area.

    All is checked in the body's frame, where body and targets are the same in each scene of a posture.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])

    def to_body(x: float, y: float) -> tuple[float, float]:
        dx, dy = x - pose[0], y - pose[1]
        return c * dx + s * dy, c * dy - s * dx

    body = _footprint(model)
    targets = target_areas(model, side, task).offsets[:, :2].tolist()
    stand = to_body(base[0], base[1])
    facing = base[2] - pose[2]
    forward = math.cos(facing), math.sin(facing)
    placed: list[tuple[float, float, float]] = []
    rocks: list[Rock] = []
    for rock in draw_rocks(rng, pose[:2], field):
        if len(rocks) == field.count:
            break
        x, y = to_body(rock.x, rock.y)
        radius = 0.55 * rock.diameter
        if (
            math.hypot(x - stand[0], y - stand[1]) > radius + 0.42
            and all(math.hypot(x - o[0], y - o[1]) > 0.5 * (rock.diameter + o[2]) for o in placed)
            and all(math.hypot(x - t[0], y - t[1]) > radius + 0.13 for t in targets)
            and not any(_blocks_way_in(x - t[0], y - t[1], radius, forward) for t in targets)
            and _least_distance(body, x, y) > radius + 0.04
        ):
            placed.append((x, y, rock.diameter))
            rocks.append(rock)
    if not terrain.rough or not rocks:
        return tuple(rocks)
    ground = terrain.height(np.array([rock.x for rock in rocks]), np.array([rock.y for rock in rocks])).tolist()
    return tuple(replace(rock, ground=height) for rock, height in zip(rocks, ground, strict=True))


def _blocks_way_in(dx: float, dy: float, radius: float, forward: tuple[float, float]) -> bool:
    """Whether a rock lies in the straight strip in which a plate must slide in at ground level, 0.35 m before it."""
    ahead = dx * forward[0] + dy * forward[1]
    aside = abs(dy * forward[0] - dx * forward[1])
    return -0.35 < ahead < 0.15 and aside < radius + 0.10


@lru_cache(maxsize=64)
def _footprint(model: Posture) -> Array:
    """Points of the resting body below rocks' height, in its own frame (M, 2) [m], thinned to a 4 cm grid."""
    low = model.resting_surface()
    cells = np.unique(np.round(low[low[:, 2] < 0.35][:, :2] / 0.04).astype(np.int64), axis=0)
    return 0.04 * cells.astype(np.float64)


def _least_distance(points: Array, x: float, y: float) -> float:
    dx, dy = points[:, 0] - x, points[:, 1] - y
    return math.sqrt(float((dx * dx + dy * dy).min()))


def rest_pose(scene: Scene) -> tuple[Array, Rotation]:
    """Centre of gravity (3,) [m] and rotation of the body frame at the start of an episode."""
    centre = np.array([scene.astronaut_x, scene.astronaut_y, scene.model.rest_height])
    return centre, Rotation.from_euler("z", scene.astronaut_yaw) * scene.model.rest_rotation()


def body_surface(scene: Scene) -> Array:
    """Surface points of the resting astronaut in the world, (M, 3) [m]."""
    centre, rotation = rest_pose(scene)
    local = surface_points(scene.model.limbs) - mass_properties(scene.model.limbs).centre
    return rotation.apply(local) + centre
