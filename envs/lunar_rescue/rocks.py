"""Rocks of the work area: size, shape and mark points, as data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ROCKS = 7  # most rocks of 10 cm or more that the cited laws put into a 2 m x 2 m work area
ROCK_SIZE_RANGE = (0.10, 0.30)  # m, diameter; larger rocks would be driven around
# N(>=D) ~ D^exponent (NASA rock specification): VIPER intercrater, and Haworth for held-out fields (more small ones).
ROCK_EXPONENT, HELDOUT_EXPONENT = -1.755, -2.661
# Height/diameter: mean, spread, least, most (same source; spread halved).
ROCK_ASPECT = (0.6, 0.14, 0.35, 0.95)
ROCK_BURIED = (0.40, 0.60)  # share of the height under the ground (same source)
WORK_AREA = 1.15  # m, half side of the square around the astronaut in which rocks lie
ROCK_SHAPES = 64  # surfaces that rocks are drawn from
HELDOUT_SHAPES = range(1000, 1032)
CLUSTER = 0.35  # m, spread of a held-out field's rocks about its middle, as of a block that broke
CLUSTER_DISTANCE = (0.5, 1.0)  # m, of that middle from the astronaut


@dataclass(frozen=True)
class Rock:
    """One rock, half buried.

    Attributes:
        x: Position in the world [m].
        y: Position in the world [m].
        diameter: Mean horizontal diameter [m].
        height: Whole height, buried part included [m].
        buried: Share of the height under the ground.
        yaw: Heading [rad].
        shape: Seed of the surface's bumps.
        ground: Height of the ground here [m].
    """

    x: float
    y: float
    diameter: float
    height: float
    buried: float
    yaw: float
    shape: int
    ground: float = 0.0

    def vertices(self) -> Array:
        """Corners of the convex hull in the world, (12, 3) [m]."""
        corners = _bumpy(self.shape) * [self.diameter / 2, self.diameter / 2, self.height / 2]
        c, sine = math.cos(self.yaw), math.sin(self.yaw)
        turned = corners @ np.array([[c, sine, 0.0], [-sine, c, 0.0], [0.0, 0.0, 1.0]])
        return turned + [self.x, self.y, self.ground + self.height * (0.5 - self.buried)]

    def marks(self) -> Array:
        """Mark points: the top and four round the flank, (5, 3) [m], which AAPF and observation use."""
        corners = self.vertices()
        marks = np.empty((5, 3))
        marks[0] = corners[np.argmax(corners[:, 2])]
        radius = 0.5 * self.diameter * 0.95
        across, along = radius * math.cos(self.yaw), radius * math.sin(self.yaw)
        marks[1:, 0] = self.x + np.array([across, -along, -across, along])
        marks[1:, 1] = self.y + np.array([along, across, -along, -across])
        marks[1:, 2] = 0.5 * (self.ground + marks[0, 2])
        return marks


def _icosahedron() -> Array:
    golden = (1 + math.sqrt(5)) / 2
    corners: list[tuple[float, float, float]] = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners += [(a, b * golden, 0) for a in (-1, 1) for b in (-1, 1)]
    corners += [(a * golden, 0, b) for a in (-1, 1) for b in (-1, 1)]
    array = np.array(corners, dtype=np.float64)
    return array / np.linalg.norm(array[0])


_ICOSAHEDRON = _icosahedron()


@lru_cache(maxsize=1024)
def _bumpy(shape: int) -> Array:
    """Corners of a bumpy unit rock, (12, 3)."""
    bumps = np.random.default_rng(shape).uniform(0.85, 1.1, (len(_ICOSAHEDRON), 1))
    return _ICOSAHEDRON * bumps


@dataclass(frozen=True)
class RockField:
    """How the rocks of one scene are drawn.

    Attributes:
        count: How many are tried.
        exponent: Of the size-frequency law.
        shapes: Seeds of their surfaces.
        middle: Of the cluster from the astronaut (2,) [m], or None where rocks lie anywhere.
    """

    count: int
    exponent: float
    shapes: range
    middle: tuple[float, float] | None


def draw_field(rng: np.random.Generator, heldout: bool) -> RockField:
    """Draw a rock field: scattered rocks, or for held-out scenes the debris of one broken block."""
    count = int(rng.integers(0, MAX_ROCKS + 1))
    if not heldout:
        return RockField(count, ROCK_EXPONENT, range(ROCK_SHAPES), None)
    distance, heading = float(rng.uniform(*CLUSTER_DISTANCE)), float(rng.uniform(0, 2 * np.pi))
    middle = distance * math.cos(heading), distance * math.sin(heading)
    return RockField(max(count, 2), HELDOUT_EXPONENT, HELDOUT_SHAPES, middle)


def draw_rock(rng: np.random.Generator, centre: tuple[float, float], field: RockField) -> Rock:
    """Draw one rock around a point, size by the cited law."""
    smallest, largest = ROCK_SIZE_RANGE
    diameter = min(smallest * (1.0 - float(rng.uniform())) ** (1 / field.exponent), largest)
    mean, spread, least, most = ROCK_ASPECT
    aspect = min(max(float(rng.normal(mean, spread)), least), most)
    if field.middle is None:
        dx, dy = (float(v) for v in rng.uniform(-WORK_AREA, WORK_AREA, 2))
    else:
        dx, dy = (m + float(v) for m, v in zip(field.middle, rng.normal(0, CLUSTER, 2), strict=True))
    low, high = ROCK_BURIED
    return Rock(
        x=centre[0] + dx,
        y=centre[1] + dy,
        diameter=diameter,
        height=aspect * diameter,
        buried=low + (high - low) * float(rng.uniform()),
        yaw=2 * math.pi * float(rng.uniform()),
        shape=int(rng.integers(field.shapes.start, field.shapes.stop)),
    )
