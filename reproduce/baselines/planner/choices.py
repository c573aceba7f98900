"""What the planner may choose in process 1: stances of the waist and goals of the plates, the likeliest first."""

from functools import lru_cache
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass as strict_dataclass

from reproduce.baselines.scripted import DATA, STRICT, Degrees, Metres, read_data


@strict_dataclass(frozen=True, config=STRICT)
class Stance:
    """How the waist leans while the plates slide in."""

    under: Degrees  # waist angle with the plates under the body [deg]
    lean: Annotated[float, Field(ge=-200.0, le=200.0)]  # how much further it leans per metre slid in [deg/m]


@strict_dataclass(frozen=True, config=STRICT)
class Leaning:
    """The stances that are tried first, by how far away the body lies.

    They follow the distance without a jump, so that plans are much alike from scene to scene and can be imitated.
    """

    under: Degrees  # waist angle with the plates under a body that is far away [deg]
    far: Metres  # mean distance of the targets from which on a body is far away [m]
    less: Annotated[float, Field(ge=0.0, le=500.0)]  # how much less it leans for a nearer one [deg/m]
    least: Degrees  # waist angle for the nearest bodies [deg]
    lean: Annotated[float, Field(ge=-200.0, le=200.0)]  # see `Stance`
    more: list[Degrees]  # what is added to the waist angle, one after the other [deg]

    def stances(self, distance: float) -> list[Stance]:
        """Return the stances for targets at a mean distance [m], the likeliest first."""
        under = max(self.least, self.under - self.less * max(0.0, self.far - distance))
        return [Stance(max(self.least, under + more), self.lean) for more in self.more]


@strict_dataclass(frozen=True, config=STRICT)
class Goal:
    """Where one plate goes, beside its target."""

    ahead: Metres = 0.0  # further under the body [m]
    aside: Metres = 0.0  # outwards, away from the other arm [m]
    up: Metres = 0.0  # higher [m]
    slope: Degrees = -3.0  # forearm above the horizontal [deg]
    turn: Degrees = 0.0  # direction of the slide, outwards from straight ahead [deg]


@strict_dataclass(frozen=True, config=STRICT)
class Choices:
    """Stances of the waist and goals of each arm, from the likeliest on, and a word about them."""

    how: str
    leaning: Leaning
    stances: list[Stance]  # after those
    goals: list[Goal]


@lru_cache
def load_choices() -> Choices:
    """Read stances and goals from the planner's data."""
    return read_data(DATA / "approach.json", "file of stances and goals", Choices)
