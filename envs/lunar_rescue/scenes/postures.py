"""The 20 postures, read and checked from one data file (P8), and those of the held-out split from a second."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.scenes.suit import LIMB_LIMITS, LIMB_NAMES, Limbs, mass_properties, surface_points

DATA_FILE = Path(__file__).parent.parent / "data" / "postures.json"
HELDOUT_FILE = Path(__file__).parent.parent / "data" / "heldout_postures.json"

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


# Compared and hashed by identity, as each is read once: a look-up in a cache then costs nothing.
@dataclass(frozen=True, eq=False)
class Posture:
    """One posture of the astronaut.

    Attributes:
        name: Unique name, attitude and limb configuration.
        attitude: Key of ``ATTITUDE_FRONT``.
        configuration: Name of the limb configuration.
        limbs: Limb angles [deg].
        rest_height: Height of the centre of gravity at rest on level ground [m].
        rest_quaternion: Body frame at rest, x, y, z, w, head along world +x.
    """

    name: str
    attitude: str
    configuration: str
    limbs: Limbs
    rest_height: float
    rest_quaternion: tuple[float, float, float, float]

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks of this posture, from its attitude."""
        return ATTITUDE_TASKS[self.attitude]

    def rest_rotation(self) -> Rotation:
        """Rotation of the body frame at rest, head along +x."""
        return Rotation.from_quat(self.rest_quaternion)

    def resting_surface(self) -> NDArray[np.float64]:
        """Surface points at rest, centre of gravity above the origin, head along +x, (M, 3) [m]."""
        return _resting_surface(self)


@lru_cache(maxsize=64)
def _resting_surface(posture: Posture) -> NDArray[np.float64]:
    local = surface_points(posture.limbs) - mass_properties(posture.limbs).centre
    return posture.rest_rotation().apply(local) + [0.0, 0.0, posture.rest_height]


def attitude_rotation(attitude: str) -> Rotation:
    """Rotation of the body frame for an attitude before settling, head along +x."""
    head = np.array([1.0, 0.0, 0.0])
    front = np.array(ATTITUDE_FRONT[attitude])
    return Rotation.from_matrix(np.column_stack([front, np.cross(head, front), head]))


def load_postures(path: Path | str = DATA_FILE) -> dict[str, Posture]:
    """Read a posture file.

    Raises:
        ValueError: Naming file, posture and entry, on anything missing, unknown, of a wrong type or out of range.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path}: no such posture file") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
    entries = document.get("postures") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: expected an object with a non-empty list 'postures'")
    postures: dict[str, Posture] = {}
    for index, entry in enumerate(entries):
        posture = _parse(entry, f"{path}: posture {index}")
        if posture.name in postures:
            raise ValueError(f"{path}: posture {index}: name {posture.name!r} appears twice")
        postures[posture.name] = posture
    return postures


def _parse(entry: Any, where: str) -> Posture:
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected an object, got {type(entry).__name__}")
    _keys(entry, ("name", "attitude", "configuration", "limbs", "rest"), where)
    if not isinstance(entry["name"], str) or not entry["name"]:
        raise ValueError(f"{where}: name: expected a non-empty string, got {entry['name']!r}")
    where = f"{where} ({entry['name']})"
    if entry["attitude"] not in ATTITUDE_FRONT:
        raise ValueError(f"{where}: attitude: expected one of {sorted(ATTITUDE_FRONT)}, got {entry['attitude']!r}")
    limbs = _parse_limbs(entry["limbs"], f"{where}: limbs")
    rest = entry["rest"]
    if not isinstance(rest, dict):
        raise ValueError(f"{where}: rest: expected an object, got {type(rest).__name__}")
    _keys(rest, ("height", "quaternion"), f"{where}: rest")
    height = _number(rest["height"], f"{where}: rest.height", 0.05, 1.5)
    quaternion = rest["quaternion"]
    if not isinstance(quaternion, list) or len(quaternion) != 4:
        raise ValueError(f"{where}: rest.quaternion: expected 4 numbers, got {quaternion!r}")
    x, y, z, w = (_number(value, f"{where}: rest.quaternion", -1.0, 1.0) for value in quaternion)
    if not math.isclose(x * x + y * y + z * z + w * w, 1.0, abs_tol=1e-3):
        raise ValueError(f"{where}: rest.quaternion: expected unit length, got {quaternion!r}")
    return Posture(entry["name"], entry["attitude"], str(entry["configuration"]), limbs, height, (x, y, z, w))


def _parse_limbs(limbs: Any, where: str) -> Limbs:
    if not isinstance(limbs, dict):
        raise ValueError(f"{where}: expected an object, got {type(limbs).__name__}")
    _keys(limbs, LIMB_NAMES, where)
    angles = {}
    for name in LIMB_NAMES:
        low, high = LIMB_LIMITS[name.split("_", 1)[1]]
        angles[name] = _number(limbs[name], f"{where}.{name}", low, high, unit=" deg")
    return Limbs(**angles)


def _keys(entry: dict[str, Any], expected: tuple[str, ...], where: str) -> None:
    missing = [key for key in expected if key not in entry]
    unknown = [key for key in entry if key not in expected]
    if missing:
        raise ValueError(f"{where}: missing {', '.join(missing)}")
    if unknown:
        raise ValueError(f"{where}: unknown {', '.join(map(repr, unknown))}; expected {', '.join(expected)}")


def _number(value: Any, where: str, low: float, high: float, unit: str = "") -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{where}: expected a number from {low:g} to {high:g}{unit}, got {value!r}")
    return float(value)


@lru_cache(maxsize=1)
def postures() -> dict[str, Posture]:
    """The project's 20 postures by name, in the file's order."""
    return load_postures()


@lru_cache(maxsize=1)
def heldout_postures() -> dict[str, Posture]:
    """Postures that no training scene has, by name; see ``lunar_rescue.scenes.splits``."""
    held = load_postures(HELDOUT_FILE)
    twice = sorted(set(held) & set(postures()))
    if twice:
        raise ValueError(f"{HELDOUT_FILE}: also in {DATA_FILE.name}: {', '.join(twice)}")
    return held


@lru_cache(maxsize=1)
def all_postures() -> dict[str, Posture]:
    """Every posture that a scene may name."""
    return {**postures(), **heldout_postures()}
