"""Tell every setting of every method that learns and where it comes from, read from the configuration."""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import fields

import pandas as pd

from reproduce.experiments.methods import METHODS
from reproduce.learning.config import PRESETS

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
    """Return the sentences under the fields of a configuration class, by field."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def settings_table(preset: str) -> pd.DataFrame:
    """Return a row a setting, a column a method; empty where a method does not have it.

    Args:
        preset: Name of a preset.
    """
    learning = {name: method.config(preset) for name, method in METHODS.items() if method.train is not None}
    whole, rows = PRESETS[preset], []
    for part, title in {"": "training", **TITLES}.items():
        kind = type(getattr(whole, part) if part else whole)
        about = notes(kind)
        for name in (field.name for field in fields(kind) if field.name not in TITLES):
            values = {
                method: getattr(getattr(config, part) if part else config, name)
                if not part or part in METHODS[method].parts
                else ""
                for method, config in learning.items()
            }
            rows.append({"of": title, "setting": name, **values, "where from": about[name]})
    return pd.DataFrame(rows).set_index(["of", "setting"])
