"""``reproduce onnx``: the networks of a trained policy as ONNX, for programs without PyTorch.

A network is exported as one step: observations and memory in, outputs and memory out, for any number of environments at
once. An episode begins with a memory of zeros. What lies between networks and environment (the mirrored view, changes
of set-points, sub-goals) is in ``policy.json``, which is written beside them, and in their metadata.
"""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch as th
from torch import nn
from torch.distributions import Distribution

from reproduce.baselines.feudal.network import FunNetwork, Memory
from reproduce.baselines.feudal.training import FunPolicy
from reproduce.baselines.recurrent_ppo import LEVEL as FLAT
from reproduce.baselines.recurrent_ppo import FlatPolicy
from reproduce.baselines.sac import LEVEL as ACTOR
from reproduce.baselines.sac import SacPolicy
from reproduce.experiments.methods import load_policy
from reproduce.hrl_dcs.policy import HierarchicalPolicy
from reproduce.learning.networks import RecurrentNetwork
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, write_atomically, write_json
from reproduce.storage.policies import read_policy_json

TRACED = 2  # environments in the example that is traced; files take any number


class RecurrentStep(nn.Module):
    """One step of a ``RecurrentNetwork`` by its mean, with hidden and cell state (1, n, h)."""

    memory = ("hidden", "cell")
    batch_axis = 1

    def __init__(self, network: RecurrentNetwork) -> None:
        super().__init__()
        self.network = network

    def first_memory(self, count: int) -> tuple[th.Tensor, ...]:
        """Return the memory of ``count`` environments that begin an episode."""
        empty = th.zeros(1, count, self.network.lstm_actor.hidden_size)
        return empty, empty.clone()

    def forward(self, observation: th.Tensor, hidden: th.Tensor, cell: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return outputs (n, a), cut to [-1, 1], and the memory after observations (n, d)."""
        network: Any = self.network
        features = network.pi_features_extractor(observation)
        output, (hidden, cell) = network.lstm_actor(features[None], (hidden, cell))
        mean = network.action_net(network.mlp_extractor.forward_actor(output[0]))
        return mean.clamp(-1.0, 1.0), hidden, cell


class FeudalStep(nn.Module):
    """One step of Manager and Worker by Worker's mean, with the memory that ``feudal.network.Memory`` holds."""

    memory = Memory._fields
    batch_axis = 0

    def __init__(self, network: FunNetwork) -> None:
        super().__init__()
        self.network = network

    def first_memory(self, count: int) -> tuple[th.Tensor, ...]:
        """Return the memory of ``count`` environments that begin an episode."""
        return tuple(self.network.empty_memory(count))

    def forward(self, observation: th.Tensor, *memory: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return actions (n, a), not cut, and the memory after observations (n, d)."""
        after = Memory(*memory).copy()  # stepping changes it in place
        return self.network.step(observation, after, deterministic=True).actions, *after


class FeedForwardStep(nn.Module):
    """One step of SAC's actor by its mean; there is no memory."""

    memory = ()
    batch_axis = 0

    def __init__(self, actor: nn.Module) -> None:
        super().__init__()
        self.network = actor

    def first_memory(self, count: int) -> tuple[th.Tensor, ...]:
        """Return nothing."""
        return ()

    def forward(self, observation: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return actions (n, a) in (-1, 1) for observations (n, d)."""
        return (self.network(observation, deterministic=True),)


Step = RecurrentStep | FeudalStep | FeedForwardStep


def policy_steps(policy: Any) -> dict[str, Step]:
    """Return a step of each network of a loaded policy, by the level's name in ``policy.json``."""
    match policy:
        case HierarchicalPolicy():
            return {level: RecurrentStep(net) for level, net in zip(("sgn", "lln"), policy.networks, strict=True)}
        case FlatPolicy():
            return {FLAT: RecurrentStep(policy.network)}
        case FunPolicy():
            return {"fun": FeudalStep(policy.network)}
        case SacPolicy():
            return {ACTOR: FeedForwardStep(policy.network)}
    raise UserError(f"onnx: expected a policy with networks, got a {type(policy).__name__}")


def export_onnx(run: Path, out: Path) -> list[Path]:
    """Write each network of a run folder's policy to ``LEVEL.onnx`` in a folder, ``policy.json`` beside them.

    Returns the paths of the networks. A policy that does not load, or a folder that cannot be written, is a
    ``UserError``; without the extra ``onnx`` the import that fails names what is missing.
    """
    import onnxscript  # noqa: F401 (PyTorch's exporter wants it, and would say so in more words)

    described = read_policy_json(run)
    method, policy = load_policy(run)
    check_writable(out / "policy.json")
    written = []
    for level, step in policy_steps(policy).items():
        program = _program(step.eval(), int(described["networks"][level]["observations"]))
        notes = {"method": method.name, "level": level, "environment_version": described["environment_version"]}
        program.model.metadata_props.update(notes, policy=json.dumps(described))
        written.append(out / f"{level}.onnx")
        write_atomically(written[-1], program.save)
    write_json(out / "policy.json", described)
    return written


def _program(step: Step, size: int) -> Any:
    """Trace a step for observations (n, size) and any n."""
    memory = step.first_memory(TRACED)
    count = th.export.Dim("n")
    axes = ({0: count}, *({step.batch_axis: count} for _ in memory))
    with _quietly():
        return th.onnx.export(
            step,
            (th.zeros(TRACED, size), *memory),
            input_names=["observation", *step.memory],
            output_names=["action", *(f"next_{name}" for name in step.memory)],
            dynamic_shapes=_shapes(step, axes),
            dynamo=True,
            verbose=False,
        )


def _shapes(step: Step, axes: tuple[Any, ...]) -> Any:
    """Return the axes of a step's arguments as PyTorch wants them: those of ``*memory`` together."""
    return (axes[0], tuple(axes[1:])) if isinstance(step, FeudalStep) else axes


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep the exporter's notes off the terminal, and distributions from checks that a trace cannot hold."""
    log = logging.getLogger("torch.onnx")
    level, checks = log.level, Distribution._validate_args
    log.setLevel(logging.ERROR)
    Distribution.set_default_validate_args(False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
        Distribution.set_default_validate_args(checks)
