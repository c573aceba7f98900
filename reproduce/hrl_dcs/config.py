"""Configuration of the two-layer method: what SGN and LLN have that no other method has."""

from dataclasses import dataclass, field, replace
from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveInt

from lunar_rescue.rewards import ApproachForm
from lunar_rescue.scenes.records import checked
from reproduce.learning.config import LearnerConfig, PolicyConfig, RecurrentConfig

# Bounds are what a policy file of somebody else may ask for, so that all numbers stay finite.
Interval = Annotated[int, Field(ge=1, le=10_000)]
Length = Annotated[float, Field(ge=0.0, le=10.0)]
PositiveLength = Annotated[float, Field(ge=1.0e-3, le=10.0)]
Height = Annotated[float, Field(ge=-10.0, le=10.0)]


@checked
@dataclass(frozen=True)
class HierarchyConfig:
    """How the two layers work together."""

    interval: Interval = 5  # N, steps between sub-goals (0.5 s); the paper leaves it open
    beta: NonNegativeFloat = 2.0  # Weight of INR's approach term, towards the sub-goal
    form: ApproachForm = "signed"  # Form of INR's approach term
    # Weight in INR of what comes once an episode; in full it hides how well LLN follows its sub-goals (training log)
    milestone_share: NonNegativeFloat = 0.1
    sgn_every: PositiveInt = 2  # LLN's updates to one of SGN's: SGN decides once in N steps, few decisions teach noise


@checked
@dataclass(frozen=True)
class CarryConfig:
    """Shape of the anchors of process 2 for one task and one way the body lies.

    Both quantities move on a line, from where nothing is raised yet to where the arms are up.
    """

    rise: Height  # Rise of the plates before anything is raised [m]. A body slides off level plates
    final_rise: Height  # Rise of the plates once the arms are up [m]
    further: Height  # How much further under the body than the target areas the ends are, before anything is raised [m]
    final_further: Height  # The same once the arms are up [m]


@checked
@dataclass(frozen=True)
class AnchorConfig:
    """From where and how far SGN moves sub-goals, and how LLN sees the way to them; not in the paper.

    All of it decides how a trained policy acts, so it is in ``config.json`` and in ``policy.json``.
    """

    reach_in: PositiveLength = 0.25  # Furthest that SGN moves both ends from anchors along each axis, process 1 [m]
    reach_carrying: PositiveLength = 0.3  # The same in process 2 [m], where the body has to be taken along
    apart: Length = 0.12  # Furthest that SGN moves either end away from their common displacement, along each axis [m]
    rise: PositiveLength = 0.15  # What the slope of a plate counts beside positions: the rise of so much of a plate [m]
    rise_apart: Length = 0.05  # Furthest that one plate's rise moves away from that of both together [m]
    rise_in: Height = -0.052  # Rise of the plates in process 1's anchors [m]: tips down (20 deg) slide in, level push
    # Anchors for lifting a body that is not face down
    lift: CarryConfig = CarryConfig(rise=0.015, final_rise=0.015, further=0.10, final_further=0.10)
    # Anchors for lifting one face down: it rolls off unless plates slope more and come back as they rise
    lift_face_down: CarryConfig = CarryConfig(rise=0.015, final_rise=0.105, further=0.15, final_further=0.0)
    # Anchors for turning a body that is not face down
    turn: CarryConfig = CarryConfig(rise=0.0, final_rise=0.0, further=0.0, final_further=0.0)
    # Anchors for turning one face down: the arms go on under it
    turn_face_down: CarryConfig = CarryConfig(rise=0.03, final_rise=0.03, further=0.0, final_further=0.30)
    rising_from: Height = 0.05  # Height of the arms over their beginning from which anchors change their shape [m]
    rising_to: Height = 0.30  # Height at which they have it [m]
    in_place: Length = 0.05  # How near ends come to the beginning of a lift before they are raised [m]
    in_place_face_down: Length = 0.08  # The same for a body face down [m]
    patience: Annotated[int, Field(ge=0, le=10_000)] = 15  # Steps that a lift waits for that
    face_down_below: Height = -0.3  # A body is face down where its front's upward part is below this at the beginning
    raised: Height = 0.15  # Ends so far above their beginning no longer need to get into place first [m]
    # How far the anchors of process 2 lead the arms upwards [m]: what is raised fast flies off on the Moon (1 m/s
    # is 0.3 m up), so no anchor waits at transport height.
    lead: Height = 0.10
    highest: Height = 0.50  # Where a body is turned, anchors lie no higher over the target areas as they were [m]
    wanted_rise: Height = 0.30  # Where it is lifted, they lead until its centre of gravity rose so much, and hold [m]
    # Where a lifted body is higher than wanted, anchors go down by at most so much [m]. Where they hold, a bias
    # of SGN's upwards adds up; the policy that was trained with them going down was no better (training log, 33).
    lowered: Length = 0.0
    # No sub-goal lies further than this from its arm's end when it is set [m]: within reach of N steps, and no
    # faster on the average than 0.6 m/s. Faster arms push a body face down away.
    stride: PositiveLength = 0.30
    slipped_away: PositiveLength = 0.40  # An end further than this from its target area carries no body [m]
    slipped_above: PositiveLength = 0.30  # An end so far above its target area carries no body [m]
    level: PositiveLength = 0.15  # What a plate that is not level across counts beside places [m]
    damping: PositiveLength = 0.05  # Damping of the joint step [m], of the order of the smallest errors that matter
    # Where LLN's view of the joint step is cut, in largest changes of a step: further ahead tells nothing new
    furthest: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0

    def __post_init__(self) -> None:
        """Refuse a rise that ends where it begins."""
        if self.rising_from >= self.rising_to:
            raise ValueError(f"rising_to: expected more than {self.rising_from}, got {self.rising_to}")


@checked
@dataclass(frozen=True)
class ActingConfig:
    """Anchors of a trained policy that differ from those in training: it acts with more care."""

    stride: PositiveLength = 0.25  # `AnchorConfig.stride` of a trained policy [m]
    lowered: Length = 0.10  # `AnchorConfig.lowered` of a trained policy [m]


@checked
@dataclass(frozen=True)
class HierarchicalPolicyConfig(PolicyConfig):
    """What ``policy.json`` holds besides networks for a policy of two layers."""

    interval: Interval  # N, steps between sub-goals
    anchors: AnchorConfig  # From where and how far SGN moves sub-goals


@checked
@dataclass(frozen=True)
class HierarchicalConfig(RecurrentConfig):
    """A training of SGN and LLN."""

    high: LearnerConfig = field(default_factory=LearnerConfig)  # SGN; its rollout is what it decided during LLN's
    hierarchy: HierarchyConfig = field(default_factory=HierarchyConfig)  # How the two layers work together
    anchors: AnchorConfig = field(default_factory=AnchorConfig)  # How SGN moves sub-goals in training
    acting: ActingConfig = field(default_factory=ActingConfig)  # What of that differs once the policy is trained

    @property
    def policy(self) -> HierarchicalPolicyConfig:
        """Return what ``policy.json`` holds of the trained policy besides its networks."""
        anchors = replace(self.anchors, stride=self.acting.stride, lowered=self.acting.lowered)
        return HierarchicalPolicyConfig(self.mirrored, self.hierarchy.interval, anchors)
