"""Configuration of the two-layer method: what SGN and LLN have that no other method has."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveInt

from lunar_rescue.rewards import ApproachForm
from lunar_rescue.scenes.records import checked
from reproduce.learning.config import LearnerConfig, PolicyConfig, RecurrentConfig
from reproduce.storage.errors import UserError

#: What ``hrl_dcs.ablation`` can put out of action in a trained policy.
ABLATIONS = ("fixed_target", "untrained_lln")

# Bounds are what a policy file of somebody else may ask for, so that all numbers stay finite.
Interval = Annotated[int, Field(ge=1, le=10_000)]
PositiveLength = Annotated[float, Field(ge=1.0e-3, le=10.0)]


@checked
@dataclass(frozen=True)
class HierarchyConfig:
    """How the two layers work together."""

    interval: Interval = 5  # N, steps between sub-goals (0.5 s); the paper leaves it open
    beta: NonNegativeFloat = 2.0  # Weight of INR's approach term, towards the sub-goal
    form: ApproachForm = "signed"  # Form of INR's approach term
    sgn_every: PositiveInt = 2  # LLN's updates to one of SGN's: SGN decides once in N steps, few decisions teach noise


@checked
@dataclass(frozen=True)
class GoalConfig:
    """What SGN's outputs in [-1, 1] command: places of the two arm ends in the robot's base frame."""

    # Displacements from where the ends are, or places in a box before the robot; the paper leaves it open
    frame: Literal["displacement", "box"] = "displacement"
    # What LLN sees as g_t: the places, or the ways to them from where the ends are, as HIRO's goals move with the state
    # (Nachum et al. 2018); the paper leaves it open
    seen: Literal["place", "way"] = "way"
    # Furthest that a displacement leads along each axis [m]: an end moves some 0.06 m a step at most
    reach: PositiveLength = 0.3
    # Damping of the joint step [m], where LLN sees one: of the order of the smallest errors that matter
    damping: PositiveLength = 0.05
    # Where LLN's view of the joint step is cut, in largest changes of a step: further ahead tells nothing new
    furthest: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0


@checked
@dataclass(frozen=True)
class HierarchicalPolicyConfig(PolicyConfig):
    """What ``policy.json`` holds besides networks for a policy of two layers."""

    interval: Interval  # N, steps between sub-goals
    joint_step: bool  # Whether LLN sees the joint step to its sub-goal, see `PriorConfig`
    goals: GoalConfig  # What SGN's outputs command


@checked
@dataclass(frozen=True)
class HierarchicalConfig(RecurrentConfig):
    """A training of SGN and LLN."""

    high: LearnerConfig = field(default_factory=LearnerConfig)  # SGN; its rollout is what it decided during LLN's
    hierarchy: HierarchyConfig = field(default_factory=HierarchyConfig)  # How the two layers work together
    goals: GoalConfig = field(default_factory=GoalConfig)  # What SGN's outputs command

    @property
    def policy(self) -> HierarchicalPolicyConfig:
        """Return what ``policy.json`` holds of the trained policy besides its networks."""
        p = self.priors
        return HierarchicalPolicyConfig(
            p.mirror, p.set_point_changes, self.seen_places, self.hierarchy.interval, p.joint_step, self.goals
        )


def check_ablation(name: str) -> None:
    """Refuse the name of an ablation that is not there."""
    if name not in ABLATIONS:
        raise UserError(f"--ablation: expected one of {', '.join(ABLATIONS)}; got {name!r}")
