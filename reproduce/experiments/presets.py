"""Presets: values for the fields and sections of every method's configuration, under the same names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from reproduce.baselines.config import SacConfig
from reproduce.hrl_dcs.config import HierarchyConfig
from reproduce.learning.config import LearnerConfig, TrainingConfig
from reproduce.storage.errors import UserError

Config = TypeVar("Config", bound=TrainingConfig)

_LOW = LearnerConfig(
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
)
_HIGH = LearnerConfig(
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
)
#: What the paper's toolkit has where the paper says nothing else.
_TOOLKIT: dict[str, Any] = {"batch_size": 1024, "n_epochs": 3, "final_learning_rate": 1.0e-10, "sequence_length": 64}
_LAPTOP: dict[str, Any] = {
    "steps": 5_000_000,
    "checkpoint_every": 48,
    "lying_weight": 2,
    "low": _LOW,
    "high": _HIGH,
    "hierarchy": HierarchyConfig(sgn_every=8),
}

#: Presets by name: values by field of a configuration; a field that is not there has its own default. ``laptop`` made
#: the reference runs; ``paper`` has the paper's numbers where it gives them.
PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        **_LAPTOP,
        "steps": 8_192,
        "n_envs": 8,
        "low": replace(_LOW, n_steps=64, batch_size=256),
        "sac": SacConfig(n_steps=64),
        "hierarchy": HierarchyConfig(sgn_every=2),
    },
    "laptop": _LAPTOP,
    "paper": {
        **_LAPTOP,
        "steps": 700_000_000,
        "low": replace(_LOW, n_steps=640, **_TOOLKIT),
        "high": replace(_HIGH, **_TOOLKIT),
    },
}


def configuration(kind: type[Config], preset: str, changes: Mapping[str, Any] | None = None) -> Config:
    """Fill a method's configuration class with a preset.

    Args:
        kind: The method's class; what else the preset holds is not for it.
        preset: Name of the preset.
        changes: What differs from it, see ``changed``.

    Raises:
        UserError: Where there is no such preset.
    """
    if preset not in PRESETS:
        raise UserError(f"preset: expected one of {', '.join(PRESETS)}; got {preset!r}")
    own = {field.name for field in fields(kind)}
    config = kind(**{name: value for name, value in PRESETS[preset].items() if name in own})
    return changed(config, changes or {})


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """Return a configuration with some fields changed, named as ``"steps"`` or, in a section, ``"low.gamma"``.

    Raises:
        ValueError: Where the configuration has no such field, or the value makes no sense.
    """
    for where, value in changes.items():
        section, _, name = where.rpartition(".")
        owner: Any = getattr(config, section, None) if section else config
        if not is_dataclass(owner) or name not in {field.name for field in fields(owner)}:
            raise ValueError(f"expected the name of a field, or of a section and a field, got {where!r}")
        edited: Any = replace(owner, **{name: value})  # type: ignore[type-var]
        whole: Any = replace(config, **{section: edited}) if section else edited
        config = whole
    return config
