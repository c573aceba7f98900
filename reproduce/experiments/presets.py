"""Presets and tuning trials, which are data, and the configurations that they make of a method's class."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from reproduce.storage.errors import UserError
from reproduce.storage.records import flat

if TYPE_CHECKING:
    from reproduce.learning.config import TrainingConfig

Config = TypeVar("Config", bound="TrainingConfig")
Changes = Mapping[str, Any]


def _read(name: str) -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))


_PRESETS, _TRIALS = _read("presets.toml"), _read("trials.toml")
#: Presets by name: values by field, such as ``"steps"`` or ``"low.gamma"``, of the configurations of all methods.
PRESETS: dict[str, dict[str, Any]] = {
    name: dict(flat(_PRESETS["laptop"])) | dict(flat(values)) for name, values in _PRESETS.items()
}
#: Name of the trial that each method is configured by, the best.
CHOSEN: dict[str, str] = _TRIALS.pop("chosen")
#: What the tuning trials of each method change of a preset, by the trial's name; see ``changed``.
TRIALS: dict[str, dict[str, dict[str, Any]]] = _TRIALS
#: What the variants of ``hrl_dcs`` change of the preset ``laptop``, by group and the variant's name.
VARIANTS: dict[str, dict[str, dict[str, Any]]] = _read("variants.toml")


def check_preset(preset: str) -> None:
    """Refuse a preset that is not there."""
    if preset not in PRESETS:
        raise UserError(f"preset: expected one of {', '.join(PRESETS)}; got {preset!r}")


def check_tunable(method: str) -> None:
    """Refuse a method that has no tuning trials."""
    if method not in TRIALS:
        raise UserError(f"method: expected one with tuning trials, {', '.join(TRIALS)}; got {method!r}")


def check_variants(group: str, names: Sequence[str] = ()) -> None:
    """Refuse a group of variants, or a name in it, that is not there."""
    if group not in VARIANTS:
        raise UserError(f"group: expected one of {', '.join(VARIANTS)}; got {group!r}")
    if unknown := set(names) - set(VARIANTS[group]):
        raise UserError(f"--only: expected one of {', '.join(VARIANTS[group])}; got {min(unknown)!r}")


def configuration(kind: type[Config], preset: str, changes: Changes) -> Config:
    """Fill a method's configuration class with what is for it in a preset, and with ``changes``, see ``changed``."""
    check_preset(preset)
    own = {field.name for field in fields(kind)}
    values = {name: value for name, value in PRESETS[preset].items() if name.split(".")[0] in own}
    return changed(changed(kind(steps=1), values), changes)


def changed(config: Config, changes: Changes) -> Config:
    """Return a configuration with some fields changed, named as ``"steps"`` or, in a section, ``"low.gamma"``.

    A field that is not there, or a value that makes no sense, is a ``ValueError``.
    """
    for where, value in changes.items():
        section, _, name = where.rpartition(".")
        owner: Any = getattr(config, section, None) if section else config
        if not is_dataclass(owner) or name not in {field.name for field in fields(owner)}:
            raise ValueError(f"expected the name of a field, or of a section and a field, got {where!r}")
        part: Any = replace(owner, **{name: value})  # type: ignore[type-var]
        whole: Any = replace(config, **{section: part}) if section else part
        config = whole
    return config
