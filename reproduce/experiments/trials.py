"""The tuning trials that every baseline gets, as data, and what was chosen from them.

HRL-DCS was tuned first, by the trials of ``docs/training_log.md``: since it has its present form (trial 26) by about as
many as each baseline has here, though longer ones and on all scenes. What they found for environment and exploration is
common to all methods: rewards, the mirrored view, the curriculum, standardised observations, learning rates that follow
the KL. The trials here are of what is a baseline's own; the last two or three start from the best before them.
``reproduce tune METHOD`` makes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Trial:
    """One configuration that was tried.

    Attributes:
        name: Name in tables.
        changes: What differs from the preset, as ``reproduce.experiments.presets.changed`` takes it.
    """

    name: str
    changes: Mapping[str, Any]


#: Returns of a whole rescue want the usual lambda; LLN's 0.7 belongs to returns that end with a sub-goal.
_FLAT = {"low.gae_lambda": 0.95}
_SLOWLY = {**_FLAT, "low.noise_share": 0.6}
_SMALL = {**_FLAT, "low.desired_kl": 0.015, "low.final_desired_kl": 0.006}
#: The best of ``sac``'s first five.
_CALM = {"sac.first_ent_coef": 0.01}
_RECURRENT = (
    Trial("lambda 0.95, as usual", _FLAT),
    Trial("lambda 0.7, as LLN's", {}),
    Trial("noise falls more slowly", _SLOWLY),
    Trial("more noise", {**_FLAT, "low.log_std_init": -0.5}),
    Trial("smaller updates", _SMALL),
    Trial("rollouts twice as long", {**_FLAT, "low.n_steps": 256, "low.batch_size": 2048}),
)

TRIALS: dict[str, tuple[Trial, ...]] = {
    "ppo_lstm": (
        *_RECURRENT,
        Trial("sequences twice as long", {**_SLOWLY, "low.sequence_length": 64}),
        Trial("a hundred times the entropy weight", {**_SLOWLY, "low.ent_coef": 1.0e-2}),
    ),
    "fun": (
        *_RECURRENT,
        Trial("four times the intrinsic reward", {**_SMALL, "fun.intrinsic_weight": 0.2}),
        Trial("half the horizon", {**_SMALL, "fun.horizon": 5}),
    ),
    "sac": (
        Trial("as in the paper, else SB3's", {}),
        Trial("a tenth of the entropy weight", {"sac.first_ent_coef": 0.1}),
        Trial("a hundredth of the entropy weight", _CALM),
        Trial("faster learning", {"sac.learning_rate": 1.0e-3}),
        Trial("slower learning", {"sac.learning_rate": 1.0e-4}),
        Trial("larger networks, half as many updates", {**_CALM, "sac.hidden_units": 256, "sac.train_every": 4}),
        Trial("targets follow faster", {**_CALM, "sac.tau": 0.02}),
        Trial("shorter view", {**_CALM, "sac.gamma": 0.97}),
    ),
}

#: Name of the trial that each method is configured by, the best; ``sac`` stands for both buffers.
CHOSEN = {
    "ppo_lstm": "noise falls more slowly",
    "fun": "half the horizon",
    "sac": "a hundredth of the entropy weight",
}


def chosen_changes(method: str) -> Mapping[str, Any]:
    """Return what a method's tuning left changed from every preset."""
    (trial,) = (trial for trial in TRIALS[method] if trial.name == CHOSEN[method])
    return trial.changes
