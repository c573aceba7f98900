"""Configurations that methods share: frozen records with a sentence beside each field.

Each method has a class of its own that adds its sections, such as ``reproduce.hrl_dcs.config.HierarchicalConfig``.
What the presets hold for them is in ``reproduce.experiments.presets``.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from lunar_rescue.rewards import RewardWeights
from lunar_rescue.scenes.records import checked
from reproduce.storage.records import Units

#: A number from 0 to 1, such as a discount or a probability.
Share = Annotated[float, Field(ge=0.0, le=1.0)]


@checked
@dataclass(frozen=True)
class LearnerConfig:
    """Settings of one recurrent PPO learner."""

    n_steps: PositiveInt = 128  # Steps a rollout and environment; ML-Agents' buffer is 640, shorter updates more often
    batch_size: PositiveInt = 512  # Transitions a minibatch; ML-Agents' default is 1024
    n_epochs: PositiveInt = 4  # Passes over a rollout; ML-Agents' default is 3
    learning_rate: PositiveFloat = 3.0e-4  # Falls linearly to `final_learning_rate`; ML-Agents' default start
    final_learning_rate: NonNegativeFloat = 3.0e-5  # Learning rate at the last step; ML-Agents falls to 1e-10
    gamma: Share = 0.99  # Discount; paper, section 4.1
    # Lambda of the advantage estimate; ML-Agents' default. LLN's is 0.7: its returns end after N steps anyway.
    # That of flat methods is by their tuning trials (`reproduce/experiments/trials.toml`).
    gae_lambda: Share = 0.95
    clip_range: PositiveFloat = 0.2  # epsilon, acceptable difference of old and new policy; paper, section 4.1
    ent_coef: NonNegativeFloat = 1.0e-4  # Entropy weight; paper beta = 1e-3 is on a mean over actions, SB3's on a sum
    vf_coef: NonNegativeFloat = 0.5  # Weight of the value loss; SB3's default
    max_grad_norm: PositiveFloat = 0.5  # Gradient clipping; SB3's default, ML-Agents has none
    hidden_units: Units = 128  # Units of each layer and of the LSTM; paper, section 4.1 ("128 hidden layers")
    sequence_length: PositiveInt = 32  # Steps through time in a gradient; ML-Agents' default is 64
    log_std_init: float = -1.1  # Logarithm of the first standard deviation; the equal of ML-Agents' clamp(x, -3, 3) / 3
    final_log_std: float = 0.0  # The logarithm stays under a line from `log_std_init` to this; not under it if above
    noise_share: Share = 0.6  # Share of the steps at which that line has come down
    desired_kl: NonNegativeFloat = 0.0  # Where positive, the learning rate follows the last update's KL
    final_desired_kl: NonNegativeFloat = 0.0  # `desired_kl` at the last step, on a line between; unused where that is 0


@checked
@dataclass(frozen=True)
class PlacesConfig:
    """The places of both arm ends to which `learning.way_in` tells the way, as the planner goes."""

    above: PositiveFloat = 0.4  # How far above where the slide begins [m]
    before: NonNegativeFloat = 0.04  # How far before the entry the slide begins [m]
    above_slope: float = 20.0  # Slope of the forearms up there [deg]
    begin_slope: float = -9.0  # Slope where the slide begins [deg]
    under_slope: float = -3.0  # Slope with the plates under the body [deg]
    waist: float = 40.0  # Waist angle with the plates under the body [deg]
    lean: float = 64.0  # How much further it leans per metre slid in [deg/m]
    above_lean: NonNegativeFloat = 8.0  # How much less it leans up there than where the slide begins [deg]
    near: PositiveFloat = 6.0  # A way is also seen so many times as large and cut at 1, for what is decided close by
    # Targets and entries that moved by less leave the places as they are, as solving takes milliseconds [m]
    moved: NonNegativeFloat = 0.004


@checked
@dataclass(frozen=True)
class PolicyConfig:
    """What ``policy.json`` holds besides networks; methods that need more to act add it."""

    mirror: bool  # Whether the networks see scenes through `reproduce.learning.mirror`
    set_point_changes: bool  # Whether they put out changes of set-points, see `reproduce.learning.actions`
    places: PlacesConfig | None  # To where they see the way in joint angles, see `reproduce.learning.way_in`; or None


@checked
@dataclass(frozen=True)
class PriorConfig:
    """What a training is given that is not in the paper; each is off by default, as the preset `paper` has them."""

    mirror: bool = False  # Learners see the astronaut's head on arm A's side, see `reproduce.learning.mirror`
    set_point_changes: bool = False  # Networks put out changes of set-points, see `reproduce.learning.actions`
    # How many times as often as postures on a side, which are learnt first, training draws those face up and down.
    # Rates in `progress.csv` are weighed back to what tests draw, all postures alike.
    lying_weight: PositiveInt = 1
    way_in: bool = False  # Networks see the way to places above, before and under the body, see `learning.way_in`
    joint_step: bool = False  # LLN sees the kinematic step of all joints to its sub-goal, see `hrl_dcs.joint_step`
    milestone_share: NonNegativeFloat = 0.0  # Weight in INR of what comes once an episode and is not in the paper
    demonstrations: bool = False  # Networks imitate the planner's rescues of training scenes before they explore
    # Friction, mass, centre of gravity, solver, delay and gains are drawn anew for each training episode, from the
    # ranges in `lunar_rescue.disturbances`; demonstrations and tests have none of it.
    randomise: bool = False


@checked
@dataclass(frozen=True)
class ImitationConfig:
    """How many rescues a network imitates, how long and how fast, where demonstrations are a prior."""

    scenes: PositiveInt = 800  # Training scenes that the planner demonstrates
    epochs: PositiveInt = 20  # Passes over all demonstrations
    recoveries: NonNegativeInt = 0  # Rounds in which episodes that the student fails become demonstrations, too
    episodes: PositiveInt = 32  # Demonstrations a minibatch, each whole
    transitions: PositiveInt = 512  # Transitions a minibatch, for a network without memory
    learning_rate: PositiveFloat = 1.0e-3  # Learning rate at the beginning; falls on half a cosine
    final_learning_rate: NonNegativeFloat = 1.0e-5  # Learning rate at the end
    vf_coef: NonNegativeFloat = 0.01  # Weight of the critic's loss; returns are of the order of ten
    max_grad_norm: PositiveFloat = 1.0  # Gradient clipping


@checked
@dataclass(frozen=True)
class TrainingConfig:
    """One training, as far as all methods share it."""

    steps: NonNegativeInt  # Environment steps of all environments together, as the paper counts them
    n_envs: PositiveInt = 16  # Parallel agents; paper, section 4.1
    checkpoint_every: PositiveInt = 25  # Updates between checkpoints; environments begin anew there, as after a resume
    reward: RewardWeights = field(default_factory=RewardWeights)  # Weights of the environment's reward, which is EXR
    obstacle_reward: Literal["aapf", "contact"] = "aapf"  # `"aapf"` or, in the ablation, `"contact"`
    scenes: Literal["all", "easy"] = "all"  # `"all"`, or `"easy"`: one posture, no rocks, the lightest astronaut
    priors: PriorConfig = field(default_factory=PriorConfig)  # What it is given that is not in the paper
    places: PlacesConfig = field(default_factory=PlacesConfig)  # To where networks see the way, if that is a prior

    def __post_init__(self) -> None:
        """Refuse a training of nothing, and randomised episodes of which there are none."""
        if not self.steps and not self.priors.demonstrations:
            raise ValueError("steps: expected at least 1 where there are no demonstrations, got 0")
        if not self.steps and self.priors.randomise:
            raise ValueError(
                "priors.randomise: imitation alone has no episodes to randomise; steps: expected at least 1"
            )

    @property
    def policy(self) -> PolicyConfig:
        """Return what ``policy.json`` holds of the trained policy besides its networks."""
        return PolicyConfig(self.priors.mirror, self.priors.set_point_changes, self.seen_places)

    @property
    def seen_places(self) -> PlacesConfig | None:
        """Return the places to which networks see the way, or None."""
        return self.places if self.priors.way_in else None


@checked
@dataclass(frozen=True)
class RecurrentConfig(TrainingConfig):
    """A training with recurrent PPO; all that a flat method has."""

    low: LearnerConfig = field(default_factory=LearnerConfig)  # LLN, or the only level of a flat method
    imitation: ImitationConfig = field(default_factory=ImitationConfig)  # How it imitates demonstrations

    @property
    def discount(self) -> float:
        """Return the discount of the demonstrations' returns."""
        return self.low.gamma
