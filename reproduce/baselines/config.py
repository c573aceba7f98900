"""Configuration of SAC; what it shares with other methods is in ``reproduce.learning.config``."""

from __future__ import annotations

from dataclasses import dataclass, field

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from lunar_rescue.scenes.records import checked
from reproduce.learning.config import Share, TrainingConfig
from reproduce.storage.records import Units


@checked
@dataclass(frozen=True)
class SacConfig:
    """What only SAC has; SB3's defaults where nothing is said."""

    buffer_size: PositiveInt = 50_000
    """Transitions in the replay buffer; ML-Agents' default, which the paper's comparison has. SB3's is 1,000,000."""
    batch_size: PositiveInt = 256
    """Transitions in a gradient step."""
    train_every: PositiveInt = 2
    """Steps of all environments between learning: what fits into the hour that every method has."""
    gradient_steps: PositiveInt = 1
    """Gradient steps each time; SB3's default."""
    learning_starts: NonNegativeInt = 10_000
    """Environment steps before the first gradient step."""
    learning_rate: PositiveFloat = 3.0e-4
    """Learning rate of actor, critics and entropy weight."""
    tau: Share = 0.005
    """Share of the critics that goes into the target critics after each gradient step."""
    hidden_units: Units = 128
    """Units of each of the two layers of actor and critics; paper, section 4.1. SB3's 256 take twice the time."""
    gamma: Share = 0.99
    """Discount; paper, section 4.1."""
    first_ent_coef: PositiveFloat = 1.0
    """Entropy weight at the beginning; it is learnt (SB3's "auto", which begins with 1)."""
    n_steps: PositiveInt = 128
    """Steps of each environment between rows of ``progress.csv``, at which observations are standardised anew."""


@checked
@dataclass(frozen=True)
class SacTrainingConfig(TrainingConfig):
    """A training of SAC, which is flat: one learner."""

    sac: SacConfig = field(default_factory=SacConfig)
    """What only SAC has."""
