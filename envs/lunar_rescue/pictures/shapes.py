"""Shapes that are only seen: the suit with visor and gloves, rocks and ground."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.suit import Limbs, Part, suit_parts

Colour = tuple[float, float, float]

CLOTH, HARD, TRIM = (0.90, 0.89, 0.86), (0.70, 0.73, 0.78), (0.75, 0.16, 0.12)
VISOR, DARK = (0.80, 0.55, 0.12), (0.22, 0.22, 0.24)
BASALT = (0.30, 0.28, 0.26)
#: Colour of each suit part by the last word of its name.
SUIT_COLOURS: dict[str, Colour] = {"backpack": HARD, "unit": HARD, "boot": DARK}
HALF, FAR = 2.5, 45.0  # m, half sides of the work area and of what is seen of the ground
ROUNDNESS = 0.25  # exponent of the rounded boxes: 0 is a box, 1 an ellipsoid
FINE, COARSE = (25, 14), (9, 8)  # corners around and along a rounded shape: for people, and for small pictures


class Mesh(NamedTuple):
    """Triangles with smooth normals."""

    vertices: Array  # corners (V, 3) [m]
    normals: Array  # unit vectors outwards (V, 3)
    faces: NDArray[np.int64]  # indices of corners (F, 3)


def lattice(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the triangles of a lattice of points, ((rows - 1) * (columns - 1) * 2, 3)."""
    i = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.concatenate([np.stack([i, i + 1, i + columns + 1], -1), np.stack([i, i + columns + 1, i + columns], -1)])


def rounded(
    half: tuple[float, ...],
    exponent: float = 1.0,
    stretch: float = 0.0,
    by: tuple[float, ...] = (0,),
    detail: tuple[int, int] = FINE,
) -> Mesh:
    """Return a superellipsoid of these half extents [m], stretched along z (a capsule) and moved [m]."""
    turns, heights = detail
    around, up = np.meshgrid(np.linspace(-np.pi, np.pi, turns), np.linspace(-np.pi / 2, np.pi / 2, heights))

    def surface(power: float) -> Array:
        def of(wave: Array) -> Array:
            return np.sign(wave) * np.abs(wave) ** power

        return np.stack([of(np.cos(up)) * of(np.cos(around)), of(np.cos(up)) * of(np.sin(around)), of(np.sin(up))], -1)

    points = surface(exponent).reshape(-1, 3) * half
    points[:, 2] += np.sign(up).ravel() * stretch / 2
    normals = surface(2 - exponent).reshape(-1, 3) / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(points + by, normals, lattice(*up.shape))


def hull(corners: Array) -> Mesh:
    """Return the convex hull of some points (M, 3) [m] with flat faces."""
    solid = ConvexHull(corners)
    vertices = corners[solid.simplices]
    outwards = solid.equations[:, :3]
    turned = np.einsum("ij,ij->i", np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]), outwards)
    vertices[turned < 0] = vertices[turned < 0][:, ::-1]
    return Mesh(vertices.reshape(-1, 3), np.repeat(outwards, 3, axis=0), np.arange(vertices.size // 3).reshape(-1, 3))


def ground(height: Callable[[Array, Array], Array], up: Array, centre: Array) -> Mesh:
    """Return the ground, coarser beyond ``HALF`` of ``centre`` (2,) [m], out to ``FAR``, where hills close the view.

    ``height`` gives heights [m] at places x, y [m]; ``up`` is against gravity (3,): a slope levels off beyond the work
    area, so that the horizon stays level.
    """
    fine = np.linspace(-HALF, HALF, 101)
    out = HALF * (FAR / HALF) ** np.linspace(0, 1, 25)[1:]
    line = np.concatenate([-out[::-1], fine, out])
    dx, dy = np.meshgrid(line, line)
    near = np.hypot(dx, dy).clip(1e-9)
    # Beyond the work area the ground goes on as at its edge.
    within = np.minimum(1.0, HALF / np.maximum(np.abs(dx), np.abs(dy)).clip(1e-9))
    z = height(centre[0] + dx * within, centre[1] + dy * within)
    bearing = np.arctan2(dy, dx)
    ridge = 1.0 + 0.5 * np.sin(3 * bearing + 1.0) + 0.35 * np.sin(7 * bearing) + 0.15 * np.sin(17 * bearing + 2.0)
    z = z + 1.3 * ridge * ((near - 12.0) / (FAR - 12.0)).clip(0.0) ** 1.5
    level = -(up[0] * dx + up[1] * dy) / up[2]
    share = ((near - 3.0) / 9.0).clip(0.0, 1.0)
    z = z + level * share * share * (3 - 2 * share)
    points = np.stack([centre[0] + dx, centre[1] + dy, z], -1)
    slope_y, slope_x = np.gradient(z, line, line)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), lattice(len(line), len(line)))


@lru_cache(maxsize=64)
def suit_shapes(limbs: Limbs, detail: tuple[int, int] = FINE) -> dict[Colour, Mesh]:
    """Return the suit in the body frame, a mesh for each colour; its outlines are those of the colliding parts."""
    shapes: dict[Colour, list[Mesh]] = {}
    for part in suit_parts(limbs):
        turn = Rotation.from_quat(part.quaternion)
        for mesh, colour in _pieces(part, detail):
            placed = Mesh(turn.apply(mesh.vertices) + part.position, turn.apply(mesh.normals), mesh.faces)
            shapes.setdefault(colour, []).append(placed)
    return {colour: _joined(meshes) for colour, meshes in shapes.items()}


def _joined(meshes: list[Mesh]) -> Mesh:
    vertices, normals, faces = zip(*meshes, strict=True)
    starts = np.cumsum([0] + [len(corners) for corners in vertices[:-1]])
    moved = [own + start for own, start in zip(faces, starts, strict=True)]
    return Mesh(np.concatenate(vertices), np.concatenate(normals), np.concatenate(moved))


def _pieces(part: Part, detail: tuple[int, int]) -> list[tuple[Mesh, Colour]]:
    """Return a part and its visor, glove or coloured band, which sits a hair's breadth outside of it."""
    own, shape = SUIT_COLOURS.get(part.name.rsplit("_", 1)[-1], CLOTH), partial(rounded, detail=detail)
    if part.kind == "box":
        return [(shape(part.size, ROUNDNESS), own)]
    radius, length = part.size if part.kind == "capsule" else (*part.size, 0.0)
    pieces = [(shape((radius,) * 3, stretch=length), own)]
    if part.name == "helmet":
        pieces.append((shape((0.75 * radius, 0.8 * radius, 0.66 * radius), by=(0.36 * radius, 0.0, 0.0)), VISOR))
    elif part.name.endswith("forearm"):
        pieces.append((shape((1.06 * radius,) * 3, stretch=0.06, by=(0.0, 0.0, length / 2 - 0.01)), DARK))
    elif part.name.endswith(("upper_arm", "thigh")):
        pieces.append((shape((1.05 * radius, 1.05 * radius, 0.008), stretch=0.05), TRIM))
    return pieces
