"""Checkpoints: one safetensors file, written atomically, with weights, optimisers, random states and counters.

Environments begin anew at a checkpoint, also in a run that is not interrupted, so a resumed run repeats it bit for bit.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from safetensors import safe_open
from safetensors.torch import save_file

from reproduce.errors import UserError
from reproduce.files import write_atomically
from reproduce.learners.sequence_ppo import SequencePPO
from reproduce.run_folder import read_tensors

NAME = "checkpoint.safetensors"
VERSION = 2


@dataclass(frozen=True)
class Progress:
    """Counters of a training.

    Attributes:
        update: Updates done.
        steps: Environment steps done.
        seconds: Seconds spent training, over all sessions.
    """

    update: int
    steps: int
    seconds: float


def save_checkpoint(folder: Path, learners: dict[str, SequencePPO], progress: Progress, config: dict[str, Any]) -> None:
    """Write the checkpoint of a training."""
    tensors: dict[str, th.Tensor] = {"torch_rng": th.get_rng_state()}
    meta: dict[str, Any] = {
        "version": VERSION,
        "progress": progress.__dict__,
        "config": config,
        "numpy_rng": {},
        "rate_factor": {level: learner.rate_factor for level, learner in learners.items()},
    }
    for level, learner in learners.items():
        for name, tensor in learner.policy.state_dict().items():
            tensors[f"{level}.policy.{name}"] = tensor.detach().contiguous().clone()
        for index, state in learner.policy.optimizer.state_dict()["state"].items():
            for name, value in state.items():
                tensors[f"{level}.optimizer.{index}.{name}"] = th.as_tensor(value).detach().contiguous().clone()
        meta["numpy_rng"][level] = learner.batch_rng.bit_generator.state
    metadata = {"meta": json.dumps(meta)}
    write_atomically(folder / NAME, lambda path: save_file(tensors, path, metadata=metadata))


def load_checkpoint(folder: Path, learners: dict[str, SequencePPO], config: dict[str, Any]) -> Progress:
    """Restore learners and random states.

    Raises:
        UserError: When there is no checkpoint, it is damaged, or it belongs to another configuration.
    """
    path = folder / NAME
    tensors = read_tensors(path)
    meta = _read_meta(path)
    if meta["config"] != config:
        names = sorted(k for k in {*meta["config"], *config} if meta["config"].get(k) != config.get(k))
        raise UserError(f"{path}: was made with another configuration ({', '.join(names)} differ)")
    try:
        for level, learner in learners.items():
            _restore(learner, level, tensors)
            learner.batch_rng.bit_generator.state = meta["numpy_rng"][level]
            learner.rate_factor = float(meta["rate_factor"][level])
        th.set_rng_state(tensors["torch_rng"])
        return Progress(**meta["progress"])
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise UserError(f"{path}: does not fit this training: {error}") from None


def _read_meta(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get("meta", "")
    try:
        meta = json.loads(text)
        assert meta["version"] == VERSION and isinstance(meta["config"], dict)
    except (json.JSONDecodeError, KeyError, TypeError, AssertionError):
        raise UserError(f"{path}: not a checkpoint of version {VERSION}") from None
    return meta


def _restore(learner: SequencePPO, level: str, tensors: dict[str, th.Tensor]) -> None:
    prefix = f"{level}.policy."
    learner.policy.load_state_dict({n[len(prefix) :]: t for n, t in tensors.items() if n.startswith(prefix)})
    state: dict[int, dict[str, th.Tensor]] = {}
    prefix = f"{level}.optimizer."
    for name, tensor in tensors.items():
        if name.startswith(prefix):
            index, key = name[len(prefix) :].split(".")
            state.setdefault(int(index), {})[key] = tensor
    optimizer = learner.policy.optimizer
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def delete_checkpoint(folder: Path) -> None:
    """Remove the checkpoint of a finished training."""
    (folder / NAME).unlink(missing_ok=True)


def has_checkpoint(folder: Path) -> bool:
    """Whether a training can go on from here."""
    return (folder / NAME).is_file()


__all__ = ["NAME", "Progress", "delete_checkpoint", "has_checkpoint", "load_checkpoint", "save_checkpoint"]
