"""Configuration: frozen dataclasses, a sentence under each field, and presets as values (no code)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field, replace
from typing import Any

from lunar_rescue.rewards import ApproachForm, RewardWeights
from reproduce.baselines.feudal.config import FunConfig
from reproduce.hrl_dcs.subgoals import MEANINGS
from reproduce.learning.checks import whole_numbers


@dataclass(frozen=True)
class LearnerConfig:
    """One recurrent PPO learner."""

    n_steps: int = 128
    """Environment steps a rollout and environment. ML-Agents' default buffer is 640; shorter updates more often."""
    batch_size: int = 512
    """Transitions a minibatch; ML-Agents' default is 1024."""
    n_epochs: int = 4
    """Passes over a rollout; ML-Agents' default is 3."""
    learning_rate: float = 3.0e-4
    """Falls linearly to ``final_learning_rate``; ML-Agents' default start."""
    final_learning_rate: float = 3.0e-5
    """Learning rate at the last step; ML-Agents falls to 1e-10."""
    gamma: float = 0.99
    """Discount; paper, section 4.1."""
    gae_lambda: float = 0.95
    """Lambda of the advantage estimate; ML-Agents' default. LLN's is 0.7: its returns end after N steps anyway. That of
    flat methods by their tuning trials (``reproduce.experiments.trials``)."""
    clip_range: float = 0.2
    """epsilon, acceptable difference of old and new policy; paper, section 4.1."""
    ent_coef: float = 1.0e-4
    """Entropy weight; paper beta = 1e-3 on a mean over action dimensions, about beta / n_actions on SB3's sum."""
    vf_coef: float = 0.5
    """Weight of the value loss; SB3's default."""
    max_grad_norm: float = 0.5
    """Gradient clipping; SB3's default, ML-Agents has none."""
    hidden_units: int = 128
    """Units of each layer and of the LSTM; paper, section 4.1 ("128 hidden layers")."""
    sequence_length: int = 32
    """Steps through time in a gradient; ML-Agents' default is 64."""
    log_std_init: float = -1.1
    """Logarithm of the initial standard deviation; the equal of ML-Agents' clamp(x, -3, 3) / 3."""
    final_log_std: float = 0.0
    """The standard deviation's logarithm stays under a line from ``log_std_init`` to this; not under it if above."""
    noise_share: float = 0.6
    """Share of the steps at which that line has come down."""
    desired_kl: float = 0.0
    """Where positive, the learning rate follows the approximate KL of the last update, within the schedule's bounds."""
    final_desired_kl: float = 0.0
    """``desired_kl`` at the last step, on a line between; not used where ``desired_kl`` is 0."""


@dataclass(frozen=True)
class HierarchyConfig:
    """What only the two-layer method has."""

    interval: int = 5
    """N, steps between sub-goals (0.5 s); the paper leaves it open."""
    beta: float = 2.0
    """Weight of INR's approach term, towards the sub-goal."""
    form: ApproachForm = "signed"
    """Form of INR's approach term."""
    subgoals: str = "together"
    """What SGN's six numbers mean: ``"each"`` moves each arm's sub-goal, ``"together"`` both at once and then apart."""
    pose_share: float = 0.0
    """Weight of the environment's approach term in INR during process 2; with 1 fewer arms got under (training log)."""
    milestone_share: float = 0.1
    """Weight in INR of what comes once an episode. In full these terms are most of the variance of LLN's returns, which
    end after N steps, and hide how well it follows its sub-goals (training log)."""
    sgn_every: int = 2
    """LLN's updates to one of SGN's: SGN decides once in N steps, and noise outweighs what few decisions teach."""
    warmup: float = 0.0
    """Share of the steps in which LLN alone learns, on sub-goals that the untrained SGN draws."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if self.subgoals not in MEANINGS:
            raise ValueError(f"subgoals: expected one of {MEANINGS}, got {self.subgoals!r}")
        whole_numbers(self, "sgn_every")
        if self.pose_share < 0.0:
            raise ValueError(f"pose_share: expected a number >= 0, got {self.pose_share!r}")


@dataclass(frozen=True)
class SacConfig:
    """What only SAC has; SB3's defaults where nothing is said."""

    buffer_size: int = 50_000
    """Transitions in the replay buffer; ML-Agents' default, which the paper's comparison has. SB3's is 1,000,000."""
    batch_size: int = 256
    """Transitions in a gradient step."""
    train_every: int = 2
    """Steps of all environments between learning: what fits into the hour that every method has."""
    gradient_steps: int = 1
    """Each time; SB3's default."""
    learning_starts: int = 10_000
    """Environment steps before the first gradient step."""
    learning_rate: float = 3.0e-4
    """Of actor, critics and entropy weight."""
    tau: float = 0.005
    """Share of the critics that goes into the target critics after each gradient step."""
    hidden_units: int = 128
    """Units of each of the two layers of actor and critics; paper, section 4.1. SB3's 256 take twice the time."""
    gamma: float = 0.99
    """Discount; paper, section 4.1."""
    first_ent_coef: float = 1.0
    """Entropy weight at the beginning; it is learnt (SB3's "auto", which begins with 1)."""
    n_steps: int = 128
    """Steps of each environment between rows of ``progress.csv``, at which observations are standardised anew."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        whole_numbers(self, "buffer_size", "batch_size", "train_every", "gradient_steps")
        whole_numbers(self, "hidden_units", "n_steps")
        if not 0.0 < self.first_ent_coef < math.inf:
            raise ValueError(f"first_ent_coef: expected a finite number above 0, got {self.first_ent_coef!r}")


@dataclass(frozen=True)
class TrainingConfig:
    """One training, complete."""

    steps: int
    """Environment steps of all environments together, as the paper counts them."""
    n_envs: int = 16
    """Parallel agents; paper, section 4.1."""
    checkpoint_every: int = 25
    """Updates between checkpoints; environments begin anew there, so that a resumed run repeats bit for bit."""
    low: LearnerConfig = field(default_factory=LearnerConfig)
    """LLN, or the only level of a flat method."""
    high: LearnerConfig = field(default_factory=LearnerConfig)
    """SGN; its rollout is what it decided during LLN's."""
    hierarchy: HierarchyConfig = field(default_factory=HierarchyConfig)
    """What only the two-layer method has."""
    fun: FunConfig = field(default_factory=FunConfig)
    """What only FeUdal Networks have."""
    sac: SacConfig = field(default_factory=SacConfig)
    """What only SAC has."""
    reward: RewardWeights = field(default_factory=RewardWeights)
    """Weights of the environment's reward, which is EXR."""
    obstacle_reward: str = "aapf"
    """``"aapf"`` or, in the ablation, ``"contact"``."""
    scenes: str = "all"
    """``"all"``, or ``"easy"``: one posture, no rocks, the lightest astronaut."""
    lying_weight: int = 1
    """Training draws postures face up and face down so many times as often as those on a side, which are learnt first:
    a curriculum over postures. Rates in ``progress.csv`` are weighed back to what tests draw, all postures alike."""
    mirrored: bool = True
    """Whether learners see scenes so that the astronaut's head is on arm A's side, see ``learning.mirror``."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if self.scenes not in ("all", "easy"):
            raise ValueError(f"scenes: expected 'all' or 'easy', got {self.scenes!r}")
        whole_numbers(self, "steps", "n_envs", "checkpoint_every", "lying_weight")


def to_dict(config: TrainingConfig) -> dict[str, Any]:
    """The configuration as plain data."""
    return dataclasses.asdict(config)


def from_dict(raw: Any) -> TrainingConfig:
    """Read a configuration back; ``ValueError`` names an unknown or missing field or a wrong type."""
    return _build(TrainingConfig, raw, "config")


_NESTED: dict[str, type] = {
    "low": LearnerConfig,
    "high": LearnerConfig,
    "hierarchy": HierarchyConfig,
    "fun": FunConfig,
    "sac": SacConfig,
    "reward": RewardWeights,
}


def _build(cls: type, raw: Any, where: str) -> Any:
    if not isinstance(raw, dict):
        raise ValueError(f"{where}: expected an object, got {type(raw).__name__}")
    known = {f.name: str(f.type) for f in dataclasses.fields(cls)}
    unknown, missing = sorted(set(raw) - set(known)), sorted(set(known) - set(raw))
    if unknown or missing:
        raise ValueError(f"{where}: unknown {unknown}, missing {missing}")
    values = {}
    for name, value in raw.items():
        if name in _NESTED:
            values[name] = _build(_NESTED[name], value, f"{where}.{name}")
        else:
            values[name] = _plain(value, known[name], f"{where}.{name}")
    return cls(**values)


def _plain(value: Any, kind: str, where: str) -> Any:
    if kind == "bool" and isinstance(value, bool):
        return value
    wanted = {"bool": (), "int": (int,), "float": (int, float), "str": (str,), "ApproachForm": (str,)}[kind]
    finite = not isinstance(value, float) or math.isfinite(value)
    if isinstance(value, bool) or not isinstance(value, wanted) or not finite:
        raise ValueError(f"{where}: expected {kind}, got {value!r}")
    return value


_LAPTOP = TrainingConfig(
    steps=5_000_000,
    checkpoint_every=48,
    low=LearnerConfig(
        n_steps=128,
        batch_size=1024,
        learning_rate=1.0e-3,
        final_learning_rate=2.0e-5,
        desired_kl=0.03,
        final_desired_kl=0.008,
        gae_lambda=0.7,
        log_std_init=-1.2,
        final_log_std=-2.3,
        noise_share=0.15,
    ),
    high=LearnerConfig(
        batch_size=256,
        sequence_length=16,
        learning_rate=1.0e-3,
        final_learning_rate=2.0e-5,
        desired_kl=0.03,
        final_desired_kl=0.006,
        gae_lambda=0.9,
        ent_coef=2.0e-4,
        log_std_init=-1.3,
        final_log_std=-2.3,
        noise_share=0.6,
    ),
    hierarchy=HierarchyConfig(sgn_every=8),
    lying_weight=2,
)

#: Presets by name. ``laptop`` made the reference runs; ``paper`` has the paper's numbers where it gives them.
PRESETS: dict[str, TrainingConfig] = {
    "smoke": replace(
        _LAPTOP,
        steps=8_192,
        n_envs=8,
        low=replace(_LAPTOP.low, n_steps=64, batch_size=256),
        sac=replace(_LAPTOP.sac, n_steps=64),
        hierarchy=replace(_LAPTOP.hierarchy, sgn_every=2),
    ),
    "laptop": _LAPTOP,
    "paper": replace(
        _LAPTOP,
        steps=700_000_000,
        low=replace(
            _LAPTOP.low, n_steps=640, batch_size=1024, n_epochs=3, final_learning_rate=1.0e-10, sequence_length=64
        ),
        high=replace(_LAPTOP.high, batch_size=1024, n_epochs=3, final_learning_rate=1.0e-10, sequence_length=64),
    ),
}
