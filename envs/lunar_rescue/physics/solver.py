"""How finely the simulator follows time and contacts, chosen by a convergence study (docs/environment.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from pydantic import Field

from lunar_rescue.scenes.records import checked

CONTROL_STEP = 0.1  # s, one action is held this long
# Of a position error that a motor makes good per second, in a substep of 20 ms a fifth: with set-points at most
# speed * time ahead no motor exceeds its speed limit, and arms follow alike at every substep.
POSITION_GAIN_PER_SECOND = 10.0

Substep = Annotated[float, Field(gt=0.0, le=0.02)]
Iterations = Annotated[int, Field(ge=1)]


class Pace(NamedTuple):
    """One way in which time passes: the length of a substep [s] and the iterations of the contact solver in it."""

    substep: float
    iterations: int

    @property
    def position_gain(self) -> float:
        """Return the share of a joint's position error that its motor makes good in a substep."""
        return POSITION_GAIN_PER_SECOND * self.substep


@checked
@dataclass(frozen=True)
class SolverSettings:
    """Substeps and iterations of the contact solver, with an arm at the astronaut and without."""

    substep: Substep = 0.01
    """Length of a substep while an arm is at the astronaut [s]."""
    iterations: Iterations = 50
    """Iterations of the solver while an arm is at the astronaut."""
    free_substep: Substep = 0.02
    """Length of a substep while none is [s]: a body at rest and arms in the air need no less."""
    free_iterations: Iterations = 10
    """Iterations while none is."""
    near: Annotated[float, Field(ge=0.0, le=10.0)] = 0.25
    """Distance of an arm's end to its target from which on it counts as at the astronaut [m], as does an arm within
    some 2 cm of the suit, and all of process 2."""

    def __post_init__(self) -> None:
        """Refuse substeps that do not fill a control step, or that do not fit into each other."""
        for name, whole in (("free_substep", CONTROL_STEP), ("substep", self.free_substep)):
            number = whole / getattr(self, name)
            if abs(number - round(number)) > 1e-9:
                raise ValueError(f"{name}: expected {whole:g} s over a whole number, got {getattr(self, name)!r}")

    @property
    def fine(self) -> Pace:
        """Return how time passes while an arm is at the astronaut."""
        return Pace(self.substep, self.iterations)

    @property
    def free(self) -> Pace:
        """Return how time passes while none is."""
        return Pace(self.free_substep, self.free_iterations)


#: What every episode of this version of the environment is simulated with.
SETTINGS = SolverSettings()

#: The same in MuJoCo, where it is one substep throughout and iterations only cap what takes two to six.
MUJOCO_SETTINGS = SolverSettings(substep=0.005, iterations=50, free_substep=0.005, free_iterations=50)
