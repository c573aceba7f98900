"""Run folders: what a training leaves, and how it is read back without ever running code from it.

Weights are safetensors, everything else JSON or CSV. Names, shapes and sizes are checked before a network is built.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Protocol, cast

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from reproduce.learning.networks import RecurrentNetwork
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_atomically, write_json

FORMAT = 1
LARGEST_WEIGHTS = 200_000_000  # bytes
MOST_UNITS = 4096  # of a layer; bounds what a foreign policy.json can make us allocate


class Spec(Protocol):
    """All that is needed to build a network: a dataclass of whole numbers from 1 up and of truth values."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def observations(self) -> int:
        """Size of the flat observation."""
        ...

    @property
    def actions(self) -> int:
        """Size of the action."""
        ...

    def build(self) -> Any:
        """Make the network, untrained."""
        ...


@dataclass(frozen=True)
class NetworkSpec:
    """All that is needed to build a network.

    Attributes:
        observations: Size of the flat observation.
        actions: Size of the action.
        hidden_units: Units of each layer and of the LSTM.
        bounded_mean: Whether the mean passes a tanh.
    """

    observations: int
    actions: int
    hidden_units: int
    bounded_mean: bool

    def build(self) -> RecurrentNetwork:
        """Make the network, untrained."""
        box = spaces.Box(-np.inf, np.inf, (self.observations,), np.float32)
        act = spaces.Box(-1.0, 1.0, (self.actions,), np.float32)
        return RecurrentNetwork(box, act, lambda _: 0.0, hidden_units=self.hidden_units, bounded_mean=self.bounded_mean)


def save_policy(
    folder: Path,
    method: str,
    networks: Mapping[str, tuple[Spec, th.nn.Module]],
    extra: dict[str, Any],
) -> None:
    """Write ``policy.safetensors`` and ``policy.json``."""
    tensors = {
        f"{level}.{name}": tensor.detach().contiguous().clone()
        for level, (_, network) in networks.items()
        for name, tensor in network.state_dict().items()
    }
    write_atomically(folder / "policy.safetensors", lambda path: save_file(tensors, path))
    specs = {level: asdict(cast(Any, spec)) for level, (spec, _) in networks.items()}
    write_json(folder / "policy.json", {"format": FORMAT, "method": method, "networks": specs, **extra})


def read_policy_json(folder: Path) -> dict[str, Any]:
    """Read and check ``policy.json``."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder")
    path = folder / "policy.json"
    raw = read_json(path, "policy description")
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise UserError(f"{path}: expected an object with format {FORMAT}")
    if not isinstance(raw.get("method"), str):
        raise UserError(f"{path}: method: expected a string, got {raw.get('method')!r}")
    if not isinstance(raw.get("networks"), dict):
        raise UserError(f"{path}: networks: expected an object, got {raw.get('networks')!r}")
    return raw


def load_networks(folder: Path, expected: dict[str, tuple[int, int]], kind: type[Spec] = NetworkSpec) -> dict[str, Any]:
    """Build and fill the networks of a run folder.

    Args:
        folder: The run folder.
        expected: For each level the sizes of observation and action that the method has.
        kind: What describes each network; its class attribute ``MOST`` may bound some fields more tightly.

    Raises:
        UserError: On a missing or damaged file, a wrong name or a wrong shape.
    """
    raw = read_policy_json(folder)
    path = folder / "policy.json"
    if set(raw["networks"]) != set(expected):
        raise UserError(f"{path}: networks: expected {sorted(expected)}, got {sorted(raw['networks'])}")
    networks = {}
    for level, sizes in expected.items():
        spec = _spec(raw["networks"][level], f"{path}: networks.{level}", kind)
        if (spec.observations, spec.actions) != sizes:
            found = (spec.observations, spec.actions)
            raise UserError(f"{path}: networks.{level}: expected observations and actions {sizes}, got {found}")
        networks[level] = spec.build()
    tensors = read_tensors(folder / "policy.safetensors")
    for level, network in networks.items():
        fill(
            network,
            {n[len(level) + 1 :]: t for n, t in tensors.items() if n.startswith(f"{level}.")},
            folder,
            level,
        )
        network.set_training_mode(False)
    known = {f"{level}.{name}" for level, network in networks.items() for name in network.state_dict()}
    if set(tensors) - known:
        raise UserError(f"{folder / 'policy.safetensors'}: unknown tensor {sorted(set(tensors) - known)[0]!r}")
    return networks


def _spec(raw: Any, where: str, kind: type[Spec]) -> Spec:
    known = fields(cast(Any, kind))
    names = [field.name for field in known]
    if not isinstance(raw, dict) or set(raw) != set(names):
        raise UserError(f"{where}: expected {', '.join(names)}, got {raw!r}")
    for field in known:
        value, most = raw[field.name], getattr(kind, "MOST", {}).get(field.name, MOST_UNITS)
        if field.type == "bool":
            if not isinstance(value, bool):
                raise UserError(f"{where}.{field.name}: expected true or false, got {value!r}")
        elif isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise UserError(f"{where}.{field.name}: expected an integer from 1 to {most}, got {value!r}")
    return kind(**raw)


def read_tensors(path: Path, most: int = LARGEST_WEIGHTS) -> dict[str, th.Tensor]:
    """Read a safetensors file of at most so many bytes; runs no code."""
    try:
        if path.stat().st_size > most:
            raise UserError(f"{path}: larger than {most} bytes")
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}
    except FileNotFoundError:
        raise UserError(f"{path}: weights are missing") from None
    except (OSError, SafetensorError, ValueError) as error:
        raise UserError(f"{path}: not a readable safetensors file: {error}") from None


def fill(network: th.nn.Module, tensors: dict[str, th.Tensor], folder: Path, level: str) -> None:
    """Copy tensors into a network; names, shapes, types and finiteness must be right."""
    path = folder / "policy.safetensors"
    for name, wanted in network.state_dict().items():
        if name not in tensors:
            raise UserError(f"{path}: {level}.{name} is missing")
        tensor = tensors[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise UserError(
                f"{path}: {level}.{name}: expected {tuple(wanted.shape)} {wanted.dtype}, "
                f"got {tuple(tensor.shape)} {tensor.dtype}"
            )
        if not bool(th.isfinite(tensor).all()):
            raise UserError(f"{path}: {level}.{name}: holds values that are not finite")
    network.load_state_dict({name: tensors[name] for name in network.state_dict()})
