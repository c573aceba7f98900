"""How finely the simulator follows time and contacts, chosen by a convergence study (docs/environment.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from lunar_rescue.scenes.records import checked

CONTROL_STEP = 0.1  # s, one action is held this long
SAMPLES = 10  # times in a control step, at most, at which contact forces between arms and body are read
# Of a position error that a motor makes good per second, in a substep of 20 ms a fifth: with set-points at most
# speed * time ahead no motor exceeds its speed limit, and arms follow alike at every substep.
POSITION_GAIN_PER_SECOND = 10.0


@checked
@dataclass(frozen=True)
class SolverSettings:
    """Substep and iterations of the contact solver."""

    substep: Annotated[float, Field(gt=0.0, le=0.02)] = 0.01
    """Length of a substep [s]; a control step holds a whole number of them."""
    iterations: Annotated[int, Field(ge=1)] = 50
    """Iterations of the solver while an arm touches the astronaut."""
    free_iterations: Annotated[int, Field(ge=1)] = 20
    """Iterations while none does: a body at rest and arms in the air need no more."""

    def __post_init__(self) -> None:
        """Refuse substeps that do not fill a control step."""
        number = CONTROL_STEP / self.substep
        if abs(number - round(number)) > 1e-9:
            raise ValueError(f"substep: expected {CONTROL_STEP:g} s over a whole number, got {self.substep!r}")

    @property
    def samples(self) -> int:
        """Return how often contact forces are read in a control step: after each substep, or ``SAMPLES`` times."""
        return math.gcd(SAMPLES, round(CONTROL_STEP / self.substep))

    @property
    def substeps_per_sample(self) -> int:
        """Return the number of substeps between two samples of the contact forces."""
        return round(CONTROL_STEP / self.substep) // self.samples

    @property
    def position_gain(self) -> float:
        """Return the share of a joint's position error that its motor makes good in a substep."""
        return POSITION_GAIN_PER_SECOND * self.substep


#: What every episode of this version of the environment is simulated with.
SETTINGS = SolverSettings()
