"""A scene is data: what lies where, drawn from a seed, independent of any simulator."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.postures import Posture, postures
from lunar_rescue.rocks import MAX_ROCKS, ROCK_SIZE_RANGE, Rock, draw_rock
from lunar_rescue.suit import mass_properties, surface_points
from lunar_rescue.targets import approach_sides, target_areas

Array = NDArray[np.float64]

TASKS = ("lift", "turn_over")
TERRAINS = ("smooth",)

MASS_RANGE = (160.0, 343.0)  # kg, Apollo suited person to NASA's suited, incapacitated Artemis crew member
FRICTION_RANGE = (0.7, 0.9)  # regolith friction angle 35 to 42 deg (NTRS 19730039283)
DISTANCE_RANGE = (0.85, 0.97)  # m, base to the body's long axis; assumption: within reach, not touching
NEAR_EDGE_FREE = 0.40  # m, a body that reaches further towards the robot than this moves the base back by the rest
SIDEWAYS_RANGE = (-0.08, 0.08)  # m, base along the body; assumption
YAW_ERROR_RANGE = (-6.0, 6.0)  # deg, base from facing the body squarely; assumption


@dataclass(frozen=True)
class Scene:
    """One rescue to be made. World frame: z up, ground at z = 0.

    Attributes:
        seed: Seed that it was drawn from, or -1.
        task: ``"lift"`` or ``"turn_over"``; the task code I.
        posture: Name of one of the 20 postures.
        astronaut_x: Centre of gravity at rest [m].
        astronaut_y: Centre of gravity at rest [m].
        astronaut_yaw: Heading of the head [rad].
        mass: Whole suited mass [kg].
        friction: Coulomb coefficient of ground, suit, rocks and plates.
        base_x: Robot base P_R [m].
        base_y: Robot base P_R [m].
        base_yaw: Robot base heading [rad].
        rocks: The rocks.
        terrain: Kind of ground.
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
    terrain: str = "smooth"

    def __post_init__(self) -> None:
        """Refuse a scene that is malformed or out of range, naming the field."""
        known = postures()
        if self.posture not in known:
            raise ValueError(f"Scene.posture: expected one of {', '.join(known)}; got {self.posture!r}")
        if self.task not in known[self.posture].tasks:
            raise ValueError(f"Scene.task: posture {self.posture!r} has {known[self.posture].tasks}, got {self.task!r}")
        if self.terrain not in TERRAINS:
            raise ValueError(f"Scene.terrain: expected one of {TERRAINS}, got {self.terrain!r}")
        _in_range("mass", self.mass, MASS_RANGE)
        _in_range("friction", self.friction, FRICTION_RANGE)
        for name in ("astronaut_x", "astronaut_y", "astronaut_yaw", "base_x", "base_y", "base_yaw"):
            _in_range(name, getattr(self, name), (-100.0, 100.0))
        if len(self.rocks) > MAX_ROCKS:
            raise ValueError(f"Scene.rocks: expected at most {MAX_ROCKS}, got {len(self.rocks)}")
        for index, rock in enumerate(self.rocks):
            where = f"rocks[{index}]"
            _in_range(f"{where}.diameter", rock.diameter, ROCK_SIZE_RANGE)
            _in_range(f"{where}.height", rock.height, (0.02, 0.5))
            _in_range(f"{where}.buried", rock.buried, (0.0, 0.95))
            _in_range(f"{where}.x", rock.x, (-100.0, 100.0))
            _in_range(f"{where}.y", rock.y, (-100.0, 100.0))

    @property
    def model(self) -> Posture:
        """The posture itself."""
        return postures()[self.posture]

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
        except json.JSONDecodeError as error:
            raise ValueError(f"Scene: not JSON: {error}") from None
        fields = _checked_fields(raw, cls, "Scene", optional=("rocks", "terrain"))
        rocks = fields.get("rocks", [])
        if not isinstance(rocks, list):
            raise ValueError(f"Scene.rocks: expected a list, got {type(rocks).__name__}")
        fields["rocks"] = tuple(
            Rock(**_checked_fields(rock, Rock, f"Scene.rocks[{i}]")) for i, rock in enumerate(rocks)
        )
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
    if not (math.isfinite(value) and bounds[0] <= value <= bounds[1]):
        raise ValueError(f"Scene.{name}: expected {bounds[0]:g} to {bounds[1]:g}, got {value!r}")


def task_distribution() -> list[tuple[str, str]]:
    """All pairs (posture, task); rho(I) is uniform over postures, then over a posture's tasks."""
    return [(name, task) for name, posture in postures().items() for task in posture.tasks]


def sample_scene(seed: int, *, posture: str | None = None, task: str | None = None) -> Scene:
    """Draw a scene, a pure function of its arguments.

    Args:
        seed: Any integer >= 0.
        posture: Fix the posture.
        task: Fix the task; without a posture, one that has the task is drawn.

    Raises:
        ValueError: On a negative seed, an unknown posture or task, or a task that the posture does not have.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed: expected an integer >= 0, got {seed!r}")
    rng = np.random.default_rng(int(seed))
    model, chosen = _draw_task(rng, posture, task)
    yaw = float(rng.uniform(0, 2 * np.pi))
    x, y = (float(v) for v in rng.uniform(-0.5, 0.5, 2))
    side = int(rng.choice(approach_sides(model)))
    base = _draw_base(rng, model, chosen, side, (x, y, yaw))
    mass, friction = float(rng.uniform(*MASS_RANGE)), float(rng.uniform(*FRICTION_RANGE))
    rocks = _draw_rocks(rng, model, chosen, side, (x, y, yaw), base)
    return Scene(int(seed), chosen, model.name, x, y, yaw, mass, friction, *base, rocks=rocks)


def _draw_task(rng: np.random.Generator, posture: str | None, task: str | None) -> tuple[Posture, str]:
    known = postures()
    if posture is not None and posture not in known:
        raise ValueError(f"posture: expected one of {', '.join(known)}; got {posture!r}")
    if task is not None and task not in TASKS:
        raise ValueError(f"task: expected one of {TASKS}, got {task!r}")
    names = [posture] if posture else [n for n, p in known.items() if task is None or task in p.tasks]
    model = known[names[int(rng.integers(len(names)))]]
    if task is not None and task not in model.tasks:
        raise ValueError(f"task: posture {model.name!r} has {model.tasks}, not {task!r}")
    return model, task or model.tasks[int(rng.integers(len(model.tasks)))]


def _draw_base(
    rng: np.random.Generator, model: Posture, task: str, side: int, pose: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Base pose facing the middle of the two targets, with errors."""
    x, y, yaw = pose
    areas = target_areas(model, side, task)
    along = float(areas.offsets[:, 0].mean()) + rng.uniform(*SIDEWAYS_RANGE)
    # Bent knees need room to get the plates down before them.
    room = max(0.0, float(areas.near_edge.max()) - NEAR_EDGE_FREE)
    away = side * (room + rng.uniform(*DISTANCE_RANGE))
    c, s = math.cos(yaw), math.sin(yaw)
    facing = yaw - side * np.pi / 2 + math.radians(rng.uniform(*YAW_ERROR_RANGE))
    return float(x + c * along - s * away), float(y + s * along + c * away), float(facing)


def _draw_rocks(
    rng: np.random.Generator,
    model: Posture,
    task: str,
    side: int,
    pose: tuple[float, float, float],
    base: tuple[float, float, float],
) -> tuple[Rock, ...]:
    """Rocks around the body, never in it, in the base or right in a target area."""
    x, y, yaw = pose
    spin = Rotation.from_euler("z", yaw)
    low = model.resting_surface()
    body = (spin.apply(low[low[:, 2] < 0.35])[:, :2] + [x, y])[::7]
    areas = target_areas(model, side, task).offsets
    targets = spin.apply(areas)[:, :2] + [x, y]
    rocks: list[Rock] = []
    for _ in range(int(rng.integers(0, MAX_ROCKS + 1))):
        rock = draw_rock(rng, (x, y))
        spot, radius = np.array([rock.x, rock.y]), 0.55 * rock.diameter
        clear = [
            np.linalg.norm(body - spot, axis=1).min() > radius + 0.04,
            np.linalg.norm(targets - spot, axis=1).min() > radius + 0.13,
            math.hypot(rock.x - base[0], rock.y - base[1]) > radius + 0.42,
            all(math.hypot(rock.x - o.x, rock.y - o.y) > 0.5 * (rock.diameter + o.diameter) for o in rocks),
            not _in_corridor(spot, radius, targets, base),
        ]
        if all(clear):
            rocks.append(rock)
    return tuple(rocks)


def _in_corridor(spot: Array, radius: float, targets: Array, base: tuple[float, float, float]) -> bool:
    """Whether a rock blocks the straight strip in which a plate must slide in at ground level, 0.35 m before it."""
    forward = np.array([math.cos(base[2]), math.sin(base[2])])
    relative = spot - targets
    ahead = relative @ forward
    aside = np.abs(relative @ np.array([-forward[1], forward[0]]))
    return bool(np.any((ahead > -0.35) & (ahead < 0.15) & (aside < radius + 0.10)))


def rest_pose(scene: Scene) -> tuple[Array, Rotation]:
    """Centre of gravity (3,) [m] and rotation of the body frame at the start of an episode."""
    centre = np.array([scene.astronaut_x, scene.astronaut_y, scene.model.rest_height])
    return centre, Rotation.from_euler("z", scene.astronaut_yaw) * scene.model.rest_rotation()


def body_surface(scene: Scene) -> Array:
    """Surface points of the resting astronaut in the world, (M, 3) [m]."""
    centre, rotation = rest_pose(scene)
    local = surface_points(scene.model.limbs) - mass_properties(scene.model.limbs).centre
    return rotation.apply(local) + centre
