"""Every setting of every method that learns, and where it comes from, in one table; read from the configuration."""

import ast
import inspect
import itertools
import textwrap
from dataclasses import fields, is_dataclass
from typing import Any

import pandas as pd

from reproduce.experiments.methods import METHODS, get_method
from reproduce.experiments.presets import PRESETS
from reproduce.learning.config import TrainingConfig

#: What parts of a configuration are called in tables.
TITLES = {
    "low": "learner (of two layers: LLN)",
    "high": "SGN's learner",
    "hierarchy": "two layers",
    "goals": "sub-goals",
    "priors": "priors",
    "imitation": "imitation",
    "fun": "Manager and Worker",
    "sac": "SAC",
    "reward": "reward",
}


def notes(kind: type) -> dict[str, str]:
    """Return what the source of a configuration class says of each field: above it, beside it, or below as a string."""
    source = textwrap.dedent(inspect.getsource(kind))
    lines, (tree,) = source.splitlines(), ast.parse(source).body
    words = {}
    for field, below in itertools.zip_longest(tree.body, tree.body[1:]):  # type: ignore[attr-defined]
        if not isinstance(field, ast.AnnAssign):
            continue
        above = itertools.takewhile(lambda line: line.startswith("#"), map(str.strip, lines[field.lineno - 2 :: -1]))
        beside = lines[(field.end_lineno or field.lineno) - 1][field.end_col_offset :].partition("#")[2]
        text = str(below.value.value) if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else ""
        parts = [*(line[1:] for line in reversed(list(above))), beside, text]
        words[ast.unparse(field.target)] = " ".join(" ".join(parts).split())
    return words


def settings_table(preset: str) -> pd.DataFrame:
    """A row a setting, a column a method; empty where a method does not have it."""
    settings = {name: _settings(method.config(preset)) for name, method in METHODS.items() if method.learns}
    origins = {row: note for own in settings.values() for row, (_, note) in own.items()}
    order = ["training", *TITLES.values()]
    rows = sorted(origins, key=lambda row: order.index(row[0]))
    columns = {name: [own[row][0] if row in own else "" for row in rows] for name, own in settings.items()}
    index = pd.MultiIndex.from_tuples(rows, names=["of", "setting"])
    return pd.DataFrame({**columns, "where from": [origins[row] for row in rows]}, index)


def differing(table: pd.DataFrame) -> pd.DataFrame:
    """Return the settings that are not the same in every method that has them, without where they come from."""
    methods = table.drop(columns="where from")
    different = [len({str(value) for value in row if value != ""}) > 1 for row in methods.itertuples(index=False)]
    return methods[different]


def preset_table(method: str) -> pd.DataFrame:
    """Return a row a setting in which the presets of a method differ, and a column a preset."""
    settings = {name: _settings(get_method(method).config(name)) for name in PRESETS}
    rows = [row for row in settings["paper"] if len({str(own[row][0]) for own in settings.values()}) > 1]
    index = pd.MultiIndex.from_tuples(rows, names=["of", "setting"])
    return pd.DataFrame({name: [own[row][0] for row in rows] for name, own in settings.items()}, index, dtype=object)


def _settings(config: TrainingConfig) -> dict[tuple[str, str], tuple[Any, str]]:
    """Return value and note of each setting of a configuration, by the title of its part and its name."""
    settings: dict[tuple[str, str], tuple[Any, str]] = {}
    kinds = filter(is_dataclass, reversed(type(config).__mro__))
    about = {name: note for kind in kinds for name, note in notes(kind).items()}
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name not in TITLES:
            settings["training", field.name] = value, about[field.name]
            continue
        own = notes(type(value))
        settings |= {(TITLES[field.name], f.name): (getattr(value, f.name), own[f.name]) for f in fields(value)}
    return settings
