"""What only FeUdal Networks have; everything they share with other learners is in ``LearnerConfig``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field, NonNegativeFloat

from lunar_rescue.scenes.records import checked
from reproduce.learning.config import RecurrentConfig, Share
from reproduce.storage.records import Units

#: c and r; the bound is what a policy file may make us allocate.
Horizon = Annotated[int, Field(ge=1, le=1000)]


@checked
@dataclass(frozen=True)
class FunConfig:
    """Sizes and weights of Manager and Worker."""

    horizon: Horizon = 10  # c, steps that a goal looks ahead and goals are pooled over, and r, the LSTM's groups
    goal_size: Units = 256  # d, size of Manager's state s and of a goal, and so the units of the dilated LSTM; FuN's
    embedding_size: Units = 16  # k, size of a goal as Worker sees it; FuN's
    # alpha, weight of the intrinsic reward in Worker's. It is paid at each step, so a large one pays for not
    # finishing (the small task's policies with 0.5 never did): what it pays on average, about a tenth of it
    # (`fun_intrinsic` in `progress.csv` is the mean before the weight), must stay under what the time bonus loses
    # in a step.
    intrinsic_weight: NonNegativeFloat = 0.05
    random_goals: Share = 0.05  # epsilon, share of steps with a random goal instead of Manager's; FuN says only "small"
    manager_gamma: Share = 0.99  # Manager's discount, Worker's is `LearnerConfig.gamma`; both: paper, section 4.1
    manager_gae_lambda: Share = 0.95  # Lambda of Manager's advantages; not in FuN, which has n-step returns; as for SGN
    # kappa of the von Mises-Fisher transition policy; 1 makes the clipped loss's first gradient that of Eq. 7
    concentration: NonNegativeFloat = 1.0


@checked
@dataclass(frozen=True)
class FeudalConfig(RecurrentConfig):
    """A training of Manager and Worker."""

    fun: FunConfig = field(default_factory=FunConfig)  # What only FeUdal Networks have
