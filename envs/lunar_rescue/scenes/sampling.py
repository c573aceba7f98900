"""Scenes drawn from a seed: posture, task, places, mass, ground and rocks."""

import itertools
import math
from dataclasses import replace
from random import Random

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.scenes.postures import Posture, all_postures, footprint, postures, skyline
from lunar_rescue.scenes.rocks import (
    MAX_ROCKS,
    ROCK_EXPONENT,
    ROCK_SHAPES,
    Rock,
    RockField,
    draw_field,
    draw_rocks,
    quarry,
)
from lunar_rescue.scenes.scene import FRICTION_RANGE, HELDOUT_MASSES, MASS_RANGE, TASKS, Scene
from lunar_rescue.scenes.splits import HELD_OUT, split_of
from lunar_rescue.scenes.targets import BEFORE_EDGE, approach_sides, target_areas
from lunar_rescue.scenes.terrain import Terrain, draw_terrain

Array = NDArray[np.float64]
Pose = tuple[float, float, float]  # x, y [m], yaw [rad]
Rocks = tuple[Rock, ...]

_EDGES = (MASS_RANGE[0], *(edge for interval in HELDOUT_MASSES for edge in interval), MASS_RANGE[1])
MASS_PIECES = {False: tuple(itertools.pairwise(_EDGES))[::2], True: HELDOUT_MASSES}  # by whether held out
DISTANCE_RANGE = (0.85, 1.05)  # m, base to the body's long axis; assumption: within reach, not touching
NEAR_EDGE_FREE = 0.40  # m, a body that reaches further towards the robot than this moves the base back by the rest
SIDEWAYS_RANGE = (-0.25, 0.25)  # m, base along the body from the middle of the targets; assumption
YAW_ERROR_RANGE = (-20.0, 20.0)  # deg, base from facing the body squarely; assumption
SHOULDER = 0.36  # m, shoulders from the robot's middle
REACH = 1.10  # m, on the ground from a shoulder to its target; a base that leaves more is drawn again
# A robot at q_init, with some room: what stands before it lies between its arms, or outside, or under the forearms,
# which lead forwards and up from the elbows [m].
ELBOW, ARMS_INSIDE, ARMS_OUTSIDE, ARMS_AHEAD, ARMS_SLOPE = 0.18, 0.24, 0.53, 0.16, 0.85
BASE_TRIES = 30  # then the robot faces the middle of the targets squarely

CENTRE_RANGE = (-0.5, 0.5)  # m, the body's centre of gravity in the work area, along x and along y
# What drawn rocks keep free. A rock's bumps reach no further than this share of its diameter from its middle.
BUMPS = 0.55
STAND_FREE = 0.42  # m, around the middle of the robot's base
BODY_FREE = 0.02  # m, around the body
# Of the strip in which a plate lies in the end: from behind the target to so far before the body, and aside [m].
UNDER_BEHIND, UNDER_BEFORE, UNDER_ASIDE = 0.15, 0.16, 0.10
# Rocks that lie in the way: the share of fields with rocks that have one, and where it lies before the body's edge on
# the straight way to a target, and aside of it [m]. Arms that go round or over it pass.
IN_THE_WAY = 0.8
WAY_AHEAD, WAY_ASIDE = (0.20, 0.45), (-0.18, 0.18)
UNSEEN_TRIES = 10  # times ROCK_TRIES places for a rock that was not seen


EASY_POSTURE = "left_side_stride"


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
    split = split_of(int(seed))
    heldout = split in HELD_OUT
    # The standard library's generator: some forty single numbers cost NumPy's ten times as much.
    rng = Random(int(seed))
    model, drawn_task = _draw_task(rng, posture, task, postures(split if heldout else "train"))
    pose = rng.uniform(*CENTRE_RANGE), rng.uniform(*CENTRE_RANGE), rng.uniform(0.0, 2 * math.pi)
    sides = approach_sides(model)
    side = rng.choice(sides)
    base = _draw_base(rng, model, drawn_task, side, pose)
    mass, friction = _draw_mass(rng, heldout), rng.uniform(*FRICTION_RANGE)
    terrain = draw_terrain(rng, pose, side if len(sides) == 1 else 0, heldout)
    room = _Room(model, drawn_task, side, pose, base)
    rocks = _draw_rocks(draw_field(rng, heldout), pose[:2], terrain, rng, room)
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
    """Draw the base pose x, y [m], yaw [rad]: facing the middle of the two targets, with errors within reach."""
    x, y, yaw = pose
    areas = target_areas(model, side, task)
    middle = float(areas.offsets[:, 0].mean())
    # Bent knees need room to get the plates down before them.
    room = max(0.0, float(areas.near_edge.max()) - NEAR_EDGE_FREE)
    targets, body = areas.offsets.tolist(), skyline(model)
    for _ in range(BASE_TRIES):
        away = side * (room + rng.uniform(*DISTANCE_RANGE))
        along, error = middle + rng.uniform(*SIDEWAYS_RANGE), math.radians(rng.uniform(*YAW_ERROR_RANGE))
        facing = error - side * math.pi / 2
        if _furthest_target(targets, along, away, facing) < REACH and _stands_clear(body, along, away, facing):
            break
    else:
        along, error = middle, 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    return x + c * along - s * away, y + s * along + c * away, yaw - side * math.pi / 2 + error


def _furthest_target(targets: list[list[float]], along: float, away: float, facing: float) -> float:
    """Return how far on the ground the targets are at most from the shoulders of a base in the body's frame [m]."""
    left_x, left_y = -SHOULDER * math.sin(facing), SHOULDER * math.cos(facing)
    ordered = sorted(targets, key=lambda t: (t[0] - along) * left_x + (t[1] - away) * left_y, reverse=True)
    return max(
        math.hypot(t[0] - along - sign * left_x, t[1] - away - sign * left_y)
        for t, sign in zip(ordered, (1, -1), strict=True)
    )


def _stands_clear(body: Array, along: float, away: float, facing: float) -> bool:
    """Tell whether a base in the body's frame can raise its arms at q_init without touching the body.

    Forearms lead from the elbows, at the base and 0.2 m high, forwards and up; what lies under them is clear.
    """
    c, s = math.cos(facing), math.sin(facing)
    x, y = body[:, 0] - along, body[:, 1] - away
    ahead, aside = c * x + s * y, c * y - s * x
    off = np.abs(aside)
    raised = np.where(off > ARMS_INSIDE, np.maximum(0.0, body[:, 2] - ELBOW) * ARMS_SLOPE, 0.0)
    return bool((ahead > ARMS_AHEAD + raised)[off < ARMS_OUTSIDE].all())


class _Room:
    """Where rocks may lie: not in the body, the base, or where a plate lies in the end.

    All is checked in the body's frame, where body and targets are the same in each scene of a posture. Rocks that fit
    are remembered, and the next ones keep off them.
    """

    def __init__(self, model: Posture, task: str, side: int, pose: Pose, base: Pose) -> None:
        areas = target_areas(model, side, task)
        self._pose, self._side, self._body = pose, side, footprint(model)
        self._targets = areas.offsets[:, :2].tolist()
        self._ways = (areas.way_in - BEFORE_EDGE).tolist()  # from each target to the body's edge [m]
        self._stand = self._to_body(base[0], base[1])
        self._placed: list[tuple[float, float, float]] = []

    def _to_body(self, x: float, y: float) -> tuple[float, float]:
        c, s = math.cos(self._pose[2]), math.sin(self._pose[2])
        dx, dy = x - self._pose[0], y - self._pose[1]
        return c * dx + s * dy, c * dy - s * dx

    def into_the_way(self, rng: Random, rock: Rock) -> Rock:
        """Return the rock moved onto the straight way to one of the targets."""
        which = rng.randrange(2)
        along = self._targets[which][0] + rng.uniform(*WAY_ASIDE)
        before = BUMPS * rock.diameter + self._ways[which] + rng.uniform(*WAY_AHEAD)
        across = self._targets[which][1] + self._side * before
        c, s = math.cos(self._pose[2]), math.sin(self._pose[2])
        return replace(rock, x=self._pose[0] + c * along - s * across, y=self._pose[1] + s * along + c * across)

    def fits(self, rock: Rock) -> bool:
        """Tell whether one more rock finds room, and remember it."""
        x, y = self._to_body(rock.x, rock.y)
        radius = BUMPS * rock.diameter
        fit = (
            math.hypot(x - self._stand[0], y - self._stand[1]) > radius + STAND_FREE
            and all(math.hypot(x - o[0], y - o[1]) > 0.5 * (rock.diameter + o[2]) for o in self._placed)
            and not any(
                abs(x - t[0]) < radius + UNDER_ASIDE
                and -UNDER_BEHIND - radius < self._side * (y - t[1]) < way + UNDER_BEFORE + radius
                for t, way in zip(self._targets, self._ways, strict=True)
            )
            and _least_distance(self._body, x, y) > radius + BODY_FREE
        )
        if fit:
            self.remember(rock)
        return fit

    def remember(self, rock: Rock) -> None:
        """Let the next rocks keep off this one."""
        self._placed.append((*self._to_body(rock.x, rock.y), rock.diameter))


def _draw_rocks(field: RockField, centre: tuple[float, float], terrain: Terrain, rng: Random, room: _Room) -> Rocks:
    """Draw the rocks of a field around a point, as many as find room, and put them on the ground."""
    rocks: list[Rock] = []
    in_the_way = rng.random() < IN_THE_WAY
    for rock in draw_rocks(rng, centre, field):
        if len(rocks) == field.count:
            break
        moved = room.into_the_way(rng, rock) if in_the_way and not rocks else rock
        if room.fits(moved):
            rocks.append(moved)
    if not terrain.rough or not rocks:
        return tuple(rocks)
    ground = terrain.height(np.array([rock.x for rock in rocks]), np.array([rock.y for rock in rocks])).tolist()
    return tuple(replace(rock, ground=height) for rock, height in zip(rocks, ground, strict=True))


def unseen_rock(scene: Scene, diameter: float, rng: Random) -> Rock | None:
    """Draw one more rock of a diameter [m] in the way to a target of a scene, where drawn rocks may lie.

    A scene that has as many rocks as there may be gives one of its own; None where no place was found.
    """
    if len(scene.rocks) == MAX_ROCKS:
        return rng.choice(scene.rocks)
    pose, base = (
        (scene.astronaut_x, scene.astronaut_y, scene.astronaut_yaw),
        (scene.base_x, scene.base_y, scene.base_yaw),
    )
    room = _Room(scene.model, scene.task, scene.side, pose, base)
    for rock in scene.rocks:
        room.remember(rock)
    for rock in draw_rocks(rng, pose[:2], RockField(UNSEEN_TRIES, quarry(ROCK_SHAPES, ROCK_EXPONENT), None)):
        sized = replace(rock, diameter=diameter, height=rock.height * diameter / rock.diameter)
        moved = room.into_the_way(rng, sized)
        if room.fits(moved):
            return replace(moved, ground=float(scene.terrain.height(np.array([moved.x]), np.array([moved.y]))[0]))
    return None


def _least_distance(points: Array, x: float, y: float) -> float:
    dx, dy = points[:, 0] - x, points[:, 1] - y
    return math.sqrt(float((dx * dx + dy * dy).min()))


def easy_scene(seed: int) -> Scene:
    """Draw a scene of one posture with the lightest astronaut and no rocks, which any method that works can learn."""
    return replace(sample_scene(seed, posture=EASY_POSTURE), rocks=(), mass=MASS_RANGE[0])
