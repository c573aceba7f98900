"""What only FeUdal Networks have; everything they share with other learners is in ``LearnerConfig``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from reproduce.learning.checks import whole_numbers


@dataclass(frozen=True)
class FunConfig:
    """Sizes and weights of Manager and Worker."""

    horizon: int = 10
    """c, steps that a goal looks ahead and that goals are pooled over, and r, groups of the dilated LSTM; FuN: both."""
    goal_size: int = 256
    """d, size of Manager's state s and of a goal, and so the units of the dilated LSTM; FuN's."""
    embedding_size: int = 16
    """k, size of a goal as Worker sees it; FuN's."""
    intrinsic_weight: float = 0.05
    """alpha, weight of the intrinsic reward in Worker's. It is paid at each step, so a large one pays for not finishing
    (the small task's policies with 0.5 never did): what it pays on average, about a tenth of it (``fun_intrinsic`` in
    ``progress.csv`` is the mean before the weight), must stay under what the time bonus loses in a step."""
    random_goals: float = 0.05
    """epsilon, share of steps at which a random goal takes the place of Manager's; FuN says only "small"."""
    manager_gamma: float = 0.99
    """Manager's discount; Worker's is ``LearnerConfig.gamma``. 0.99 for both: paper, section 4.1."""
    manager_gae_lambda: float = 0.95
    """Lambda of Manager's advantage estimate; not in FuN, which has n-step returns. As for SGN."""
    concentration: float = 1.0
    """kappa of the von Mises-Fisher transition policy; 1 makes the clipped loss's first gradient that of Eq. 7."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        whole_numbers(self, "horizon", "goal_size", "embedding_size")
        for name, most in (("random_goals", 1.0), ("manager_gamma", 1.0), ("manager_gae_lambda", 1.0)):
            _check_number(name, getattr(self, name), most)
        _check_number("intrinsic_weight", self.intrinsic_weight, math.inf)
        _check_number("concentration", self.concentration, math.inf)


def _check_number(name: str, value: float, most: float) -> None:
    if not (0.0 <= value <= most and math.isfinite(value)):
        raise ValueError(f"{name}: expected a finite number from 0 to {most}, got {value!r}")
