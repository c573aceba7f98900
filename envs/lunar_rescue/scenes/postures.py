"""The 20 postures, read and checked from one data file (P8), and those of each held-out split from one of its own."""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from lunar_rescue.scenes.records import checked, from_json, within
from lunar_rescue.scenes.suit import Limbs, mass_properties, surface_points

DATA = Path(__file__).parent.parent / "data"
DATA_FILE = DATA / "postures.json"
#: Posture files by the split that first has them; validation and test scenes have those of training.
FILES = {
    "train": DATA_FILE,
    "validation-heldout": DATA / "validation_heldout_postures.json",
    "heldout": DATA / "heldout_postures.json",
}
ROCK_HEIGHT, GRID = 0.35, 0.04  # m, of a footprint: higher than any rock, and its points' spacing

Component = Annotated[float, within((-1.0, 1.0))]

#: Front (ventral) direction of each body attitude before it settles, head along +x.
ATTITUDE_FRONT: dict[str, tuple[float, float, float]] = {
    "supine": (0.0, 0.0, 1.0),
    "prone": (0.0, 0.0, -1.0),
    "left_side": (0.0, -1.0, 0.0),
    "right_side": (0.0, 1.0, 0.0),
}

#: Tasks of each attitude. Who lies on the back is ready for transport; who lies face down can be turned over, or be
#: carried out of danger as they are; who lies on a side has no stable lift on two plates (the rigid body rolls off,
#: tried) and is turned onto the back first, as a rescuer would.
ATTITUDE_TASKS: dict[str, tuple[str, ...]] = {
    "supine": ("lift",),
    "prone": ("lift", "turn_over"),
    "left_side": ("turn_over",),
    "right_side": ("turn_over",),
}


@checked
@dataclass(frozen=True)
class Rest:
    """How a posture lies on level ground."""

    height: Annotated[float, within((0.05, 1.5))]  # height of the centre of gravity [m]
    quaternion: tuple[Component, Component, Component, Component]  # body frame, x, y, z, w, head along world +x

    def __post_init__(self) -> None:
        """Refuse a quaternion that is not of unit length."""
        if not math.isclose(sum(value * value for value in self.quaternion), 1.0, abs_tol=1e-3):
            raise ValueError(f"rest.quaternion: expected unit length, got {self.quaternion!r}")


# Compared and hashed by identity, as each is read once: a look-up in a cache then costs nothing.
@checked
@dataclass(frozen=True, eq=False)
class Posture:
    """One posture of the astronaut."""

    name: Annotated[str, Field(min_length=1)]  # unique name, attitude and limb configuration
    attitude: Literal["supine", "prone", "left_side", "right_side"]  # key of ``ATTITUDE_FRONT``
    configuration: str  # name of the limb configuration
    limbs: Limbs  # limb angles [deg]
    rest: Rest  # how it lies on level ground

    @property
    def tasks(self) -> tuple[str, ...]:
        """Return the tasks of this posture, which follow from its attitude."""
        return ATTITUDE_TASKS[self.attitude]

    def rest_rotation(self) -> Rotation:
        """Return the rotation of the body frame at rest, head along +x."""
        return Rotation.from_quat(self.rest.quaternion)

    def resting_surface(self) -> NDArray[np.float64]:
        """Return surface points at rest, centre of gravity above the origin, head along +x, (M, 3) [m]."""
        return _resting_surface(self)


@lru_cache(maxsize=64)
def _resting_surface(posture: Posture) -> NDArray[np.float64]:
    local = surface_points(posture.limbs) - mass_properties(posture.limbs).centre
    return posture.rest_rotation().apply(local) + [0.0, 0.0, posture.rest.height]


@lru_cache(maxsize=64)
def footprint(posture: Posture) -> NDArray[np.float64]:
    """Return points of the resting body below rocks' height, in its own frame, thinned to a grid, (M, 2) [m]."""
    surface = posture.resting_surface()
    cells = np.unique(np.round(surface[surface[:, 2] < ROCK_HEIGHT][:, :2] / GRID).astype(np.int64), axis=0)
    return GRID * cells.astype(np.float64)


@lru_cache(maxsize=64)
def skyline(posture: Posture) -> NDArray[np.float64]:
    """Return the highest points of the resting body above a grid on the ground, in its own frame, (M, 3) [m]."""
    surface = posture.resting_surface()
    cells, index = np.unique(np.round(surface[:, :2] / GRID).astype(np.int64), axis=0, return_inverse=True)
    heights = np.full(len(cells), -np.inf)
    np.maximum.at(heights, index.ravel(), surface[:, 2])
    return np.column_stack([GRID * cells, heights])


def attitude_rotation(attitude: str) -> Rotation:
    """Return the rotation of the body frame for an attitude before settling, head along +x."""
    head = np.array([1.0, 0.0, 0.0])
    front = np.array(ATTITUDE_FRONT[attitude])
    return Rotation.from_matrix(np.column_stack([front, np.cross(head, front), head]))


@checked
@dataclass(frozen=True)
class _PostureFile:
    postures: Annotated[tuple[Posture, ...], Field(min_length=1)]
    about: Any = None


def load_postures(path: Path | str = DATA_FILE) -> dict[str, Posture]:
    """Read a posture file.

    Raises:
        ValueError: Naming file, posture and entry, on anything missing, unknown, of a wrong type or out of range.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{path}: no such posture file") from None
    except OSError as error:
        raise ValueError(f"{path}: not readable: {error}") from None
    by_name: dict[str, Posture] = {}
    for index, posture in enumerate(from_json(_PostureFile, text, f"{path}: ").postures):
        if posture.name in by_name:
            raise ValueError(f"{path}: postures[{index}].name: {posture.name!r} appears twice")
        by_name[posture.name] = posture
    return by_name


_read_once = lru_cache(maxsize=len(FILES))(load_postures)


def postures(split: str = "train") -> dict[str, Posture]:
    """Return the postures of a key of ``FILES`` by name, in the file's order; the 20 unless told otherwise."""
    return _read_once(FILES[split])


@lru_cache(maxsize=1)
def all_postures() -> dict[str, Posture]:
    """Return every posture that a scene may name.

    Raises:
        ValueError: Where two files have a posture of the same name.
    """
    known: dict[str, Posture] = {}
    for split, path in FILES.items():
        if twice := sorted(set(postures(split)) & set(known)):
            raise ValueError(f"{path}: also in another file: {', '.join(twice)}")
        known |= postures(split)
    return known
