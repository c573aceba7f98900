"""Checkpoints: one safetensors file, written atomically, with what every learner must keep, random states and counters.

Environments begin anew at a checkpoint, also in a run that is not interrupted, so a resumed run repeats it bit for bit.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th
from pydantic import NonNegativeFloat, NonNegativeInt
from safetensors import safe_open
from safetensors.torch import save_file

from lunar_rescue.scenes.records import checked
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_atomically
from reproduce.storage.paths import CHECKPOINT
from reproduce.storage.policies import read_tensors
from reproduce.storage.records import differences, from_dict, to_dict

VERSION = 3
LARGEST = 8_000_000_000  # bytes; a large replay buffer is in it


class Learner(Protocol):
    """A learner that can go on from a checkpoint."""

    def state_tensors(self) -> dict[str, th.Tensor]:
        """Return all arrays that learning goes on from, by name."""

    def state_numbers(self) -> dict[str, Any]:
        """Return all else that it goes on from, as plain data."""

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what the two methods above returned."""


@checked
@dataclass(frozen=True)
class Progress:
    """How far a training is, in counters."""

    update: NonNegativeInt  # updates that were made
    steps: NonNegativeInt  # environment steps
    seconds: NonNegativeFloat  # spent training, over all sessions


def save_checkpoint(folder: Path, learners: Mapping[str, Learner], progress: Progress, config: dict[str, Any]) -> None:
    """Write the checkpoint of a training."""
    tensors: dict[str, th.Tensor] = {"torch_rng": th.get_rng_state()}
    kind, keys, *numbers = np.random.get_state()  # noqa: NPY002 (SB3 draws from it)
    tensors["numpy_rng"] = th.from_numpy(np.asarray(keys).astype(np.int64))
    meta: dict[str, Any] = {
        "version": VERSION,
        "progress": to_dict(progress),
        "config": config,
        "numpy_rng": [kind, *numbers],
        "learners": {level: learner.state_numbers() for level, learner in learners.items()},
    }
    for level, learner in learners.items():
        tensors |= {f"{level}.{name}": tensor.detach().contiguous() for name, tensor in learner.state_tensors().items()}
    write_atomically(folder / CHECKPOINT, partial(save_file, tensors, metadata={"meta": json.dumps(meta)}))


def load_checkpoint(folder: Path, learners: Mapping[str, Learner], config: dict[str, Any]) -> Progress:
    """Restore learners and random states; ``UserError`` without a whole checkpoint of this configuration."""
    path = folder / CHECKPOINT
    tensors = read_tensors(path, LARGEST)
    with safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get("meta", "")
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict) or meta.get("version") != VERSION or not isinstance(meta.get("config"), dict):
        raise UserError(f"{path}: not a checkpoint of version {VERSION}")
    if changes := differences(meta["config"], config):
        raise UserError(f"{path}: was made with another configuration: {', '.join(changes[:3])}")
    try:
        progress = from_dict(Progress, meta["progress"], f"{path}: progress.")
        for level, learner in learners.items():
            learner.load_state(_under(level, tensors), meta["learners"][level])
        th.set_rng_state(tensors["torch_rng"])
        kind, *numbers = meta["numpy_rng"]
        np.random.set_state((kind, tensors["numpy_rng"].numpy().astype(np.uint32), *numbers))  # noqa: NPY002
    except (KeyError, TypeError, RuntimeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise UserError(f"{path}: does not fit this training: {' '.join(str(error).split()):.300}") from None
    return progress


def _under(name: str, tensors: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
    """Return the tensors whose names begin with ``name`` and a dot, without both."""
    return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}


def module_tensors(name: str, module: th.nn.Module) -> dict[str, th.Tensor]:
    """Return weights and statistics of a network, under its name."""
    return {f"{name}.{key}": tensor.clone() for key, tensor in module.state_dict().items()}


def optimizer_tensors(name: str, optimizer: th.optim.Optimizer) -> dict[str, th.Tensor]:
    """Return what an optimiser remembers of each parameter, under its name."""
    return {
        f"{name}.{index}.{key}": th.as_tensor(value).clone()
        for index, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }


def restore_module(name: str, module: th.nn.Module, tensors: dict[str, th.Tensor]) -> None:
    """Load into a network what ``module_tensors`` returned."""
    module.load_state_dict(_under(name, tensors))


def restore_optimizer(name: str, optimizer: th.optim.Optimizer, tensors: dict[str, th.Tensor]) -> None:
    """Load into an optimiser what ``optimizer_tensors`` returned."""
    state: dict[int, dict[str, th.Tensor]] = {}
    for key, tensor in _under(name, tensors).items():
        index, what = key.split(".")
        state.setdefault(int(index), {})[what] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
