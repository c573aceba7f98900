"""Scenes drawn from a seed: posture, task, places, mass, ground and rocks."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from random import Random

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.scenes.postures import Posture, all_postures, footprint, heldout_postures, postures
from lunar_rescue.scenes.rocks import Rock, RockField, draw_field, draw_rocks
from lunar_rescue.scenes.scene import FRICTION_RANGE, HELDOUT_MASSES, MASS_RANGE, TASKS, Scene
from lunar_rescue.scenes.splits import split_of
from lunar_rescue.scenes.targets import approach_sides, target_areas
from lunar_rescue.scenes.terrain import Terrain, draw_terrain

Array = NDArray[np.float64]
Pose = tuple[float, float, float]  # x, y [m], yaw [rad]
Rocks = tuple[Rock, ...]
Fits = Callable[[Rock], bool]

_EDGES = (MASS_RANGE[0], *(edge for interval in HELDOUT_MASSES for edge in interval), MASS_RANGE[1])
MASS_PIECES = {False: tuple(itertools.pairwise(_EDGES))[::2], True: HELDOUT_MASSES}  # by whether held out
DISTANCE_RANGE = (0.85, 0.97)  # m, base to the body's long axis; assumption: within reach, not touching
NEAR_EDGE_FREE = 0.40  # m, a body that reaches further towards the robot than this moves the base back by the rest
SIDEWAYS_RANGE = (-0.08, 0.08)  # m, base along the body; assumption
YAW_ERROR_RANGE = (-6.0, 6.0)  # deg, base from facing the body squarely; assumption

CENTRE_RANGE = (-0.5, 0.5)  # m, the body's centre of gravity in the work area, along x and along y
# What drawn rocks keep free. A rock's bumps reach no further than this share of its diameter from its middle.
BUMPS = 0.55
STAND_FREE = 0.42  # m, around the middle of the robot's base
TARGET_FREE = 0.13  # m, around each target area
BODY_FREE = 0.04  # m, around the body
WAY_BEFORE, WAY_BEHIND, WAY_ASIDE = 0.35, 0.15, 0.10  # m, strip in which a plate slides in, about its target


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
    model, drawn_task = _draw_task(rng, posture, task, heldout_postures() if heldout else postures())
    pose = rng.uniform(*CENTRE_RANGE), rng.uniform(*CENTRE_RANGE), rng.uniform(0.0, 2 * math.pi)
    sides = approach_sides(model)
    side = rng.choice(sides)
    base = _draw_base(rng, model, drawn_task, side, pose)
    mass, friction = _draw_mass(rng, heldout), rng.uniform(*FRICTION_RANGE)
    terrain = draw_terrain(rng, pose, side if len(sides) == 1 else 0, heldout)
    fits = _room_for_rocks(model, drawn_task, side, pose, base)
    rocks = _draw_rocks(draw_field(rng, heldout), pose[:2], terrain, rng, fits)
    return Scene(int(seed), drawn_task, model.name, *pose, mass, friction, *base, rocks=rocks, terrain=terrain)


def _draw_mass(rng: Random, heldout: bool) -> float:
    """Draw a mass [kg], uniform over the held-out intervals, or over all the rest of the range."""
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


def _draw_base(rng: Random, model: Posture, task: str, side: int, pose: Pose) -> Pose:
    """Draw the base pose x, y [m], yaw [rad]: facing the middle of the two targets, with errors."""
    x, y, yaw = pose
    areas = target_areas(model, side, task)
    along = float(areas.offsets[:, 0].mean()) + rng.uniform(*SIDEWAYS_RANGE)
    # Bent knees need room to get the plates down before them.
    room = max(0.0, float(areas.near_edge.max()) - NEAR_EDGE_FREE)
    away = side * (room + rng.uniform(*DISTANCE_RANGE))
    c, s = math.cos(yaw), math.sin(yaw)
    facing = yaw - side * math.pi / 2 + math.radians(rng.uniform(*YAW_ERROR_RANGE))
    return x + c * along - s * away, y + s * along + c * away, facing


def _draw_rocks(field: RockField, centre: tuple[float, float], terrain: Terrain, rng: Random, fits: Fits) -> Rocks:
    """Draw the rocks of a field around a point, as many as find room, and put them on the ground."""
    rocks: list[Rock] = []
    for rock in draw_rocks(rng, centre, field):
        if len(rocks) == field.count:
            break
        if fits(rock):
            rocks.append(rock)
    if not terrain.rough or not rocks:
        return tuple(rocks)
    ground = terrain.height(np.array([rock.x for rock in rocks]), np.array([rock.y for rock in rocks])).tolist()
    return tuple(replace(rock, ground=height) for rock, height in zip(rocks, ground, strict=True))


def _room_for_rocks(model: Posture, task: str, side: int, pose: Pose, base: Pose) -> Fits:
    """Return what tells whether one more rock finds room: not in the body, the base, a target area or a way in.

    All is checked in the body's frame, where body and targets are the same in each scene of a posture. Rocks that fit
    are remembered, and the next ones keep off them.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])

    def to_body(x: float, y: float) -> tuple[float, float]:
        dx, dy = x - pose[0], y - pose[1]
        return c * dx + s * dy, c * dy - s * dx

    body, targets = footprint(model), target_areas(model, side, task).offsets[:, :2].tolist()
    stand, facing = to_body(base[0], base[1]), base[2] - pose[2]
    forward = math.cos(facing), math.sin(facing)
    placed: list[tuple[float, float, float]] = []

    def fits(rock: Rock) -> bool:
        x, y = to_body(rock.x, rock.y)
        radius = BUMPS * rock.diameter
        fit = (
            math.hypot(x - stand[0], y - stand[1]) > radius + STAND_FREE
            and all(math.hypot(x - o[0], y - o[1]) > 0.5 * (rock.diameter + o[2]) for o in placed)
            and all(math.hypot(x - t[0], y - t[1]) > radius + TARGET_FREE for t in targets)
            and not any(_blocks_way_in(x - t[0], y - t[1], radius, forward) for t in targets)
            and _least_distance(body, x, y) > radius + BODY_FREE
        )
        if fit:
            placed.append((x, y, rock.diameter))
        return fit

    return fits


def _blocks_way_in(dx: float, dy: float, radius: float, forward: tuple[float, float]) -> bool:
    """Tell whether a rock lies in the straight strip in which a plate must slide in at ground level."""
    ahead = dx * forward[0] + dy * forward[1]
    aside = abs(dy * forward[0] - dx * forward[1])
    return -WAY_BEFORE < ahead < WAY_BEHIND and aside < radius + WAY_ASIDE


def _least_distance(points: Array, x: float, y: float) -> float:
    dx, dy = points[:, 0] - x, points[:, 1] - y
    return math.sqrt(float((dx * dx + dy * dy).min()))
