"""Rocks of the work area: size, shape and mark points, as data."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

MAX_ROCKS = 7  # most rocks of 10 cm or more that the cited laws put into a 2 m x 2 m work area
ROCK_SIZE_RANGE = (0.10, 0.30)  # m, diameter; larger rocks would be driven around
ROCK_EXPONENT = -1.755  # VIPER intercrater, N(>=D) ~ D^exponent (NASA rock specification)
# Height/diameter: mean, spread, least, most (same source; spread halved).
ROCK_ASPECT = (0.6, 0.14, 0.35, 0.95)
ROCK_BURIED = (0.40, 0.60)  # share of the height under the ground (same source)
WORK_AREA = 1.15  # m, half side of the square around the astronaut in which rocks lie


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
    """

    x: float
    y: float
    diameter: float
    height: float
    buried: float
    yaw: float
    shape: int

    def vertices(self) -> Array:
        """Corners of the convex hull in the world, (12, 3) [m]."""
        rng = np.random.default_rng(self.shape)
        bumps = rng.uniform(0.85, 1.1, (len(_ICOSAHEDRON), 1))
        scaled = _ICOSAHEDRON * bumps * [self.diameter / 2, self.diameter / 2, self.height / 2]
        turned = Rotation.from_euler("z", self.yaw).apply(scaled)
        return turned + [self.x, self.y, self.height * (0.5 - self.buried)]

    def marks(self) -> Array:
        """Mark points: the top and four round the flank, (5, 3) [m], which AAPF and observation use."""
        corners = self.vertices()
        top = corners[np.argmax(corners[:, 2])]
        centre = np.array([self.x, self.y, 0.5 * top[2]])
        radius = 0.5 * self.diameter * 0.95
        angles = self.yaw + np.arange(4) * np.pi / 2
        ring = centre + radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(4)])
        return np.vstack([top, ring])


def _icosahedron() -> Array:
    golden = (1 + math.sqrt(5)) / 2
    corners: list[tuple[float, float, float]] = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners += [(a, b * golden, 0) for a in (-1, 1) for b in (-1, 1)]
    corners += [(a * golden, 0, b) for a in (-1, 1) for b in (-1, 1)]
    array = np.array(corners, dtype=np.float64)
    return array / np.linalg.norm(array[0])


_ICOSAHEDRON = _icosahedron()


def draw_rock(rng: np.random.Generator, centre: tuple[float, float]) -> Rock:
    """Draw one rock around a point, size by the cited law."""
    smallest, largest = ROCK_SIZE_RANGE
    diameter = min(smallest * float(rng.uniform()) ** (1 / ROCK_EXPONENT), largest)
    mean, spread, least, most = ROCK_ASPECT
    aspect = float(np.clip(rng.normal(mean, spread), least, most))
    dx, dy = rng.uniform(-WORK_AREA, WORK_AREA, 2)
    return Rock(
        x=float(centre[0] + dx),
        y=float(centre[1] + dy),
        diameter=diameter,
        height=aspect * diameter,
        buried=float(rng.uniform(*ROCK_BURIED)),
        yaw=float(rng.uniform(0, 2 * np.pi)),
        shape=int(rng.integers(2**31)),
    )
