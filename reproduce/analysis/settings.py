"""Every setting of every method that learns, and where it comes from, in one table; read from the configuration."""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import fields
from typing import Any

import pandas as pd

from reproduce.experiments.methods import METHODS
from reproduce.learning.config import PRESETS, TrainingConfig

#: What parts of a configuration are called in tables.
TITLES = {
    "low": "learner (of two layers: LLN)",
    "high": "SGN's learner",
    "hierarchy": "two layers",
    "fun": "Manager and Worker",
    "sac": "SAC",
    "reward": "reward",
}


def notes(kind: type) -> dict[str, str]:
    """The sentences under the fields of a configuration class, by field."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def settings_table(preset: str) -> pd.DataFrame:
    """A row a setting, a column a method; empty where a method does not have it.

    Args:
        preset: Name of a preset.
    """
    learning = {name: method.config(preset) for name, method in METHODS.items() if method.train is not None}
    rows: list[dict[str, Any]] = []
    about = notes(TrainingConfig)
    for field in fields(TrainingConfig):
        if field.name not in TITLES:
            values = {name: getattr(config, field.name) for name, config in learning.items()}
            rows.append({"of": "training", "setting": field.name, **values, "where from": about[field.name]})
    for part, title in TITLES.items():
        kind = type(getattr(PRESETS[preset], part))
        about = notes(kind)
        for field in fields(kind):
            values = {
                name: getattr(getattr(config, part), field.name) if part in METHODS[name].parts else ""
                for name, config in learning.items()
            }
            rows.append({"of": title, "setting": field.name, **values, "where from": about[field.name]})
    return pd.DataFrame(rows).set_index(["of", "setting"])
