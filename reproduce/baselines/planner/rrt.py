"""RRT-Connect and shortcutting over any collision check, limited by iterations so that results repeat exactly.

Distances are the largest change of any joint: all joints have the same speed limit, so that is the time a motion takes.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Free = Callable[[Array], bool]

RESOLUTION = 0.04  # rad, between two checks on a straight line; an arm's end moves about 5 cm at most in that
STEP = 0.30  # rad, longest new branch


def line_is_free(start: Array, end: Array, free: Free, resolution: float = RESOLUTION) -> bool:
    """Whether the straight line between two configurations (n,) is free, its beginning left out."""
    count = max(1, int(np.ceil(np.abs(end - start).max() / resolution)))
    return all(free(start + (end - start) * (i / count)) for i in range(count, 0, -1))


def path_is_free(path: Array, free: Free, resolution: float = RESOLUTION) -> bool:
    """Whether a path (m, n) of straight lines is free, its first configuration left out."""
    return all(line_is_free(a, b, free, resolution) for a, b in pairwise(path))


def length(path: Array) -> float:
    """Measure a path (m, n) in the largest-joint distance [rad]."""
    return float(np.abs(np.diff(path, axis=0)).max(axis=1).sum())


def resample(path: Array, spacing: float) -> Array:
    """Return points (k, n) along a path, no further apart than ``spacing`` [rad], with its corners."""
    points = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.abs(b - a).max() / spacing)))
        points.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(points)


class _Tree:
    """A tree of configurations and their parents, grown from one end."""

    def __init__(self, root: Array) -> None:
        self.points = np.empty((64, len(root)))  # doubled when they are full
        self.points[0] = root
        self._parents = [-1]

    def nearest(self, point: Array) -> int:
        return int(np.abs(self.points[: len(self._parents)] - point).max(axis=1).argmin())

    def add(self, point: Array, parent: int) -> int:
        index = len(self._parents)
        if index == len(self.points):
            self.points = np.concatenate([self.points, np.empty_like(self.points)])
        self.points[index] = point
        self._parents.append(parent)
        return index

    def branch(self, index: int) -> list[Array]:
        """Return the configurations from the root to this one."""
        points = []
        while index >= 0:
            points.append(self.points[index])
            index = self._parents[index]
        return points[::-1]


def _extend(tree: _Tree, towards: Array, free: Free, resolution: float) -> tuple[int, bool]:
    """Grow by one branch as far as it is free; return its end (-1 when blocked) and whether that is ``towards``."""
    near = tree.nearest(towards)
    start = tree.points[near]
    way = towards - start
    distance = float(np.abs(way).max())
    part = min(1.0, STEP / max(distance, 1e-12))
    count = max(1, int(np.ceil(distance * part / resolution)))
    reached = 0
    while reached < count and free(start + way * (part * (reached + 1) / count)):
        reached += 1
    if reached == 0:
        return -1, False
    met = reached == count and part == 1.0
    return tree.add(towards if met else start + way * (part * reached / count), near), met


def _greedily(tree: _Tree, target: Array, free: Free, resolution: float) -> tuple[int, bool]:
    """Grow towards a target until it is met or nothing is gained."""
    grown, met, gap = 0, False, np.inf
    while not met:
        grown, met = _extend(tree, target, free, resolution)
        left = float(np.abs(tree.points[grown] - target).max()) if grown >= 0 else np.inf
        if left >= gap - 1e-9 and not met:
            return -1, False
        gap = left
    return grown, met


def connect(
    start: Array,
    goal: Array,
    free: Free,
    bounds: tuple[Array, Array],
    rng: np.random.Generator,
    *,
    draws: int = 500,
    resolution: float = RESOLUTION,
) -> Array | None:
    """Find a way by RRT-Connect (Kuffner and LaValle 2000): two trees that grow towards each other.

    Configurations (n,) are drawn between ``bounds``, and lines checked every ``resolution`` [rad]. Returns a path
    (m, n) from start to goal, or None when an end is not free or the draws did not suffice.
    """
    if not (free(start) and free(goal)):
        return None
    if line_is_free(start, goal, free, resolution):
        return np.array([start, goal])
    first, second = _Tree(start), _Tree(goal)
    forward = True
    for _ in range(draws):
        new, _ = _extend(first, rng.uniform(*bounds), free, resolution)
        if new >= 0:
            grown, met = _greedily(second, first.points[new], free, resolution)
            if met:
                ways = first.branch(new), second.branch(grown)
                here, there = ways if forward else ways[::-1]
                return np.array(here + there[-2::-1])
        first, second, forward = second, first, not forward
    return None


def shortcut(
    path: Array, free: Free, rng: np.random.Generator, *, iterations: int = 80, resolution: float = RESOLUTION
) -> Array:
    """Shorten a path (m, n) by straight lines between random pairs of its points where they are free."""
    points = resample(path, 0.15)
    for _ in range(iterations):
        if len(points) < 3:
            break
        i, j = sorted(rng.choice(len(points), 2, replace=False))
        if j - i < 2 or length(points[i : j + 1]) < np.abs(points[j] - points[i]).max() + 1e-6:
            continue
        if line_is_free(points[i], points[j], free, resolution):
            middle = resample(points[[i, j]], 0.15)
            points = np.concatenate([points[:i], middle, points[j + 1 :]])
    return points
