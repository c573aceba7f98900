"""Rocks of the work area: size, shape and mark points, as data."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from random import Random
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.records import checked, within
from lunar_rescue.scenes.terrain import Place

MAX_ROCKS = 7  # most rocks of 10 cm or more that the cited laws put into a 2 m x 2 m work area
ROCK_SIZE_RANGE = (0.10, 0.30)  # m, diameter; larger rocks would be driven around
# N(>=D) ~ D^exponent (NASA rock specification): VIPER intercrater, and Haworth for held-out fields (more small ones).
ROCK_EXPONENT, HELDOUT_EXPONENT = -1.755, -2.661
# Height/diameter: mean, spread, least, most (same source; spread halved).
ROCK_ASPECT = (0.6, 0.14, 0.35, 0.95)
ROCK_BURIED = (0.40, 0.60)  # share of the height under the ground (same source)
FLANK = 0.475  # of the diameter, radius of the ring of flank marks
WORK_AREA = 1.15  # m, half side of the square around the astronaut in which scattered rocks lie
#: The stones that scenes are drawn from, by their shape's seed; the simulation keeps their shapes. Sizes are the law's
#: quantiles, the largest all of the greatest size. Small stones find room more easily, so those that lie in scenes are
#: a little smaller than the law has them.
ROCK_SHAPES = range(64)
HELDOUT_SHAPES = range(1000, 1032)
ROCK_TRIES = 4  # places tried for each rock, as many are taken up by body, base and the ways in
CLUSTER = 0.35  # m, spread of a held-out field's rocks about its middle, as of a block that broke
CLUSTER_DISTANCE = (0.5, 1.0)  # m, of that middle from the astronaut


@checked
@dataclass(frozen=True)
class Rock:
    """One rock, half buried; the ranges are those of any scene, drawn or not."""

    x: Place  # position in the world [m]
    y: Place  # position in the world [m]
    diameter: Annotated[float, within(ROCK_SIZE_RANGE)]  # mean horizontal diameter [m]
    height: Annotated[float, within((0.02, 0.5))]  # whole height, buried part included [m]
    buried: Annotated[float, within((0.0, 0.95))]  # share of the height under the ground
    yaw: Place  # heading [rad]
    shape: Annotated[int, Field(ge=0)]  # seed of the surface's bumps
    ground: Annotated[float, within((-1.0, 1.0))] = 0.0  # height of the ground here [m]

    @property
    def middle(self) -> tuple[float, float, float]:
        """Return the centre of the whole rock, buried part included [m]."""
        return self.x, self.y, self.ground + self.height * (0.5 - self.buried)

    @property
    def flank(self) -> float:
        """Return the radius of the ring of flank marks [m]."""
        return FLANK * self.diameter

    def corners(self) -> Array:
        """Return the corners of the convex hull about its own centre, not turned (12, 3) [m]."""
        return np.asarray(_bumpy(self.shape) * [self.diameter / 2, self.diameter / 2, self.height / 2])

    def vertices(self) -> Array:
        """Return the corners of the convex hull in the world, (12, 3) [m]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.asarray(self.corners() @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + self.middle)


def rock_marks(rocks: Sequence[Rock]) -> Array:
    """Return the mark points that AAPF and observation use, each rock's top and four round its flank, (5 n, 3) [m]."""
    rows: list[tuple[float, float, float]] = []
    for rock in rocks:
        c, s = math.cos(rock.yaw), math.sin(rock.yaw)
        x, y, z = _top(rock.shape)
        x, y, z = 0.5 * rock.diameter * x, 0.5 * rock.diameter * y, 0.5 * rock.height * z
        top = rock.middle[2] + z
        low, a, b = 0.5 * (rock.ground + top), rock.flank * c, rock.flank * s
        rows.append((rock.x + c * x - s * y, rock.y + s * x + c * y, top))
        rows += [(rock.x + a, rock.y + b, low), (rock.x - b, rock.y + a, low)]
        rows += [(rock.x - a, rock.y - b, low), (rock.x + b, rock.y - a, low)]
    return np.array(rows).reshape(-1, 3)


@lru_cache(maxsize=1024)
def _top(shape: int) -> tuple[float, float, float]:
    """Return the highest corner of a bumpy unit rock."""
    x, y, z = max(_bumpy(shape).tolist(), key=lambda corner: corner[2])
    return x, y, z


@lru_cache(maxsize=1024)
def _bumpy(shape: int) -> Array:
    """Return the corners of a bumpy unit rock, an icosahedron's moved in or out, (12, 3)."""
    g, signs = (1 + math.sqrt(5)) / 2, list(itertools.product((-1, 1), repeat=2))
    corners: list[tuple[float, float, float]] = [(0, a, b * g) for a, b in signs]
    corners += [(a, b * g, 0) for a, b in signs] + [(a * g, 0, b) for a, b in signs]
    bumps = np.random.default_rng(shape).uniform(0.85, 1.1, (len(corners), 1))
    return np.asarray(np.array(corners) / np.linalg.norm(corners[0]) * bumps)


class Stone(NamedTuple):
    """One stone of the quarry."""

    shape: int  # seed of its surface
    diameter: float  # mean horizontal diameter [m]
    height: float  # whole height [m]


@lru_cache(maxsize=4)
def quarry(shapes: range, exponent: float) -> tuple[Stone, ...]:
    """Return stones of these surfaces, sizes at the quantiles of N(>=D) ~ D^exponent, aspects as specified."""
    smallest, largest = ROCK_SIZE_RANGE
    mean, spread, least, most = ROCK_ASPECT
    rng = np.random.default_rng(shapes.start)
    stones = []
    for rank, shape in enumerate(shapes):
        diameter = min(smallest * ((rank + 0.5) / len(shapes)) ** (1 / exponent), largest)
        stones.append(Stone(shape, diameter, diameter * min(max(float(rng.normal(mean, spread)), least), most)))
    return tuple(stones)


@dataclass(frozen=True)
class RockField:
    """How the rocks of one scene are drawn."""

    count: int  # how many lie there, if they find room
    stones: tuple[Stone, ...]  # the quarry
    middle: tuple[float, float] | None  # of the cluster from the astronaut (2,) [m], or None where rocks lie anywhere


def draw_field(rng: Random, heldout: bool) -> RockField:
    """Draw a rock field: scattered rocks, or for held-out scenes the debris of one broken block."""
    count = rng.randint(0, MAX_ROCKS)
    if not heldout:
        return RockField(count, quarry(ROCK_SHAPES, ROCK_EXPONENT), None)
    distance, heading = rng.uniform(*CLUSTER_DISTANCE), rng.uniform(0.0, 2 * math.pi)
    middle = distance * math.cos(heading), distance * math.sin(heading)
    return RockField(max(count, 2), quarry(HELDOUT_SHAPES, HELDOUT_EXPONENT), middle)


def draw_rocks(rng: Random, centre: tuple[float, float], field: RockField) -> Iterator[Rock]:
    """Draw candidates for the rocks of a field around a point; a stone may come twice."""
    for _ in range(ROCK_TRIES * field.count):
        if field.middle is None:
            dx, dy = rng.uniform(-WORK_AREA, WORK_AREA), rng.uniform(-WORK_AREA, WORK_AREA)
        else:
            dx, dy = rng.gauss(field.middle[0], CLUSTER), rng.gauss(field.middle[1], CLUSTER)
        stone = rng.choice(field.stones)
        buried, yaw = rng.uniform(*ROCK_BURIED), rng.uniform(0.0, 2 * math.pi)
        yield Rock(centre[0] + dx, centre[1] + dy, buried=buried, yaw=yaw, **stone._asdict())
