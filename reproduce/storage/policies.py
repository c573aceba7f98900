"""Policies in run folders: what a training leaves, and how it is read back without ever running code from it.

Weights are safetensors, everything else JSON. Names, types, shapes and sizes are checked before a network is built.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from lunar_rescue import ENVIRONMENT_VERSION
from lunar_rescue.scenes.records import checked
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_atomically, write_json
from reproduce.storage.records import Units, from_dict, to_dict

if TYPE_CHECKING:
    import torch as th

FORMAT = 1
LARGEST_WEIGHTS = 200_000_000  # bytes
Record = TypeVar("Record")


@checked
@dataclass(frozen=True)
class Spec:
    """All that is needed to build a network; subclasses add what else it is."""

    observations: Units  # Size of the flat observation
    actions: Units  # Size of the action
    hidden_units: Units  # Units of each layer and of the LSTM, where it has one

    def build(self) -> Any:
        """Make a network of these sizes, not trained."""
        raise NotImplementedError


def save_policy(folder: Path, method: str, networks: Mapping[str, tuple[Spec, th.nn.Module]], config: Any) -> None:
    """Write ``policy.safetensors`` and ``policy.json`` into a run folder.

    ``networks`` says of each level how to build it, and holds it; ``config`` is all else that decides how it acts.
    """
    from safetensors.torch import save_file

    tensors = {
        f"{level}.{name}": tensor.detach().contiguous().clone()
        for level, (_, network) in networks.items()
        for name, tensor in network.state_dict().items()
    }
    write_atomically(folder / "policy.safetensors", lambda path: save_file(tensors, path))
    specs = {level: to_dict(spec) for level, (spec, _) in networks.items()}
    head = {"format": FORMAT, "environment_version": ENVIRONMENT_VERSION, "method": method}
    write_json(folder / "policy.json", {**head, "networks": specs, **to_dict(config)})


def read_policy_json(folder: Path) -> dict[str, Any]:
    """Read ``policy.json`` and check what all methods have in it."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder")
    path = folder / "policy.json"
    raw = read_json(path, "policy description")
    if not isinstance(raw, dict) or isinstance(raw.get("format"), bool) or raw.get("format") != FORMAT:
        raise UserError(f"{path}: expected an object with format {FORMAT}")
    for name, kind, words in (("method", str, "a string"), ("networks", dict, "an object")):
        if not isinstance(raw.get(name), kind):
            raise UserError(f"{path}: {name}: expected {words}, got {reprlib.repr(raw.get(name))}")
    if (version := raw.get("environment_version", "1.0")) != ENVIRONMENT_VERSION:
        raise UserError(
            f"{path}: environment_version: expected {ENVIRONMENT_VERSION}, got {version!r:.20}; train it anew"
        )
    return raw


def load_policy_config(folder: Path, kind: type[Record]) -> Record:
    """Read what ``policy.json`` holds besides networks; ``UserError`` names a field that is missing or wrong."""
    head = ("format", "environment_version", "method", "networks")
    raw = {k: v for k, v in read_policy_json(folder).items() if k not in head}
    return from_dict(kind, raw, f"{folder / 'policy.json'}: ")


def load_networks(folder: Path, expected: Mapping[str, tuple[int, int]], kind: type[Spec]) -> dict[str, Any]:
    """Build and fill the networks of a run folder, each described by a ``kind``.

    ``expected`` are each level's sizes of observation and action; whatever else the files hold is a ``UserError``.
    """
    raw, path = read_policy_json(folder), folder / "policy.json"
    if set(raw["networks"]) != set(expected):
        raise UserError(f"{path}: networks: expected {sorted(expected)}, got {reprlib.repr(sorted(raw['networks']))}")
    networks = {}
    for level, sizes in expected.items():
        spec = from_dict(kind, raw["networks"][level], f"{path}: networks.{level}.")
        if (own := (spec.observations, spec.actions)) != sizes:
            raise UserError(f"{path}: networks.{level}: expected observations and actions {sizes}, got {own}")
        networks[level] = spec.build()
    weights = folder / "policy.safetensors"
    tensors = read_tensors(weights)
    for level, network in networks.items():
        fill(network, tensors, weights, level)
        network.set_training_mode(False)
    names = (f"{level}.{name}" for level, network in networks.items() for name in network.state_dict())
    if strangers := sorted(set(tensors).difference(names)):
        raise UserError(f"{weights}: unknown tensor {strangers[0]!r}")
    return networks


def read_tensors(path: Path, most: int = LARGEST_WEIGHTS) -> dict[str, th.Tensor]:
    """Read a safetensors file of at most so many bytes; runs no code."""
    from safetensors import SafetensorError, safe_open

    try:
        if path.stat().st_size > most:
            raise UserError(f"{path}: larger than {most} bytes")
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        for name, tensor in tensors.items():
            if not bool(tensor.isfinite().all()):
                raise UserError(f"{path}: {name}: holds values that are not finite")
    except FileNotFoundError:
        raise UserError(f"{path}: weights are missing") from None
    except (OSError, SafetensorError, ValueError, RuntimeError, TypeError, AttributeError, KeyError) as error:
        raise UserError(f"{path}: not a readable safetensors file: {error}") from None
    return tensors


def fill(network: th.nn.Module, tensors: Mapping[str, th.Tensor], path: Path, level: str) -> None:
    """Copy the tensors of a level into its network; names, shapes and types must be right."""
    state = network.state_dict()
    for name, target in state.items():
        tensor = tensors.get(f"{level}.{name}")
        if tensor is None:
            raise UserError(f"{path}: {level}.{name} is missing")
        if tensor.shape != target.shape or tensor.dtype != target.dtype:
            expected, actual = (f"{tuple(t.shape)} {t.dtype}" for t in (target, tensor))
            raise UserError(f"{path}: {level}.{name}: expected {expected}, got {actual}")
    network.load_state_dict({name: tensors[f"{level}.{name}"] for name in state})
