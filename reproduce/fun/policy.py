"""Acting with a trained FuN policy, and its part of a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from reproduce.actions import to_environment
from reproduce.errors import UserError
from reproduce.fun.network import FunNetwork, FunSpec, Memory
from reproduce.mirror import Mirror
from reproduce.policy import Actions, Observations
from reproduce.run_folder import MOST_UNITS, fill, read_policy_json, read_tensors

LEVEL = "fun"  # name of the one learner, in checkpoints and run folders
MOST_STEPS = 1000  # of a goal's horizon; bounds what a foreign policy.json can make us allocate


class FunPolicy:
    """Manager and Worker, both acting every step, with no random goals."""

    def __init__(self, network: FunNetwork, mirrored: bool = True, deterministic: bool = True) -> None:
        """Keep the network.

        Args:
            network: Trained.
            mirrored: Whether it sees scenes through ``reproduce.mirror``.
            deterministic: Whether Worker acts by its mean.
        """
        self.network, self.mirrored, self._deterministic = network, mirrored, deterministic
        self._memory: Memory | None = None

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        if self._memory is None or len(self._memory.clock) != len(observations):
            self._memory, self._mirror = self.network.empty_memory(len(observations)), Mirror(len(observations))
        self._memory.forget(th.from_numpy(np.asarray(starts, bool)))
        if self.mirrored:
            self._mirror.begin(observations, starts)
        seen = self._mirror.observations(observations)
        outputs = self.network.step(th.from_numpy(seen), self._memory, self._deterministic).actions.numpy()
        return self._mirror.actions(to_environment(seen, outputs))

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Nothing to draw: goals are directions in a space that only Manager knows."""
        return {}


def load_network(folder: Path, sizes: tuple[int, int]) -> FunNetwork:
    """Build and fill the network of a run folder.

    Args:
        folder: The run folder.
        sizes: Of observation and action, as the method has them.

    Raises:
        UserError: On a missing or damaged file, a wrong name or a wrong shape.
    """
    path, networks = folder / "policy.json", read_policy_json(folder)["networks"]
    if set(networks) != {LEVEL}:
        raise UserError(f"{path}: networks: expected ['{LEVEL}'], got {sorted(networks)}")
    spec = _spec(networks[LEVEL], f"{path}: networks.{LEVEL}")
    if (spec.observations, spec.actions) != sizes:
        found = (spec.observations, spec.actions)
        raise UserError(f"{path}: networks.{LEVEL}: expected observations and actions {sizes}, got {found}")
    network = spec.build()
    tensors = read_tensors(folder / "policy.safetensors")
    unknown = sorted(set(tensors) - {f"{LEVEL}.{name}" for name in network.state_dict()})
    if unknown:
        raise UserError(f"{folder / 'policy.safetensors'}: unknown tensor {unknown[0]!r}")
    own: Any = network  # any module can be filled
    fill(own, {name[len(LEVEL) + 1 :]: tensor for name, tensor in tensors.items()}, folder, LEVEL)
    network.set_training_mode(False)
    return network


def _spec(raw: Any, where: str) -> FunSpec:
    names = list(FunSpec.__dataclass_fields__)
    if not isinstance(raw, dict) or set(raw) != set(names):
        raise UserError(f"{where}: expected {', '.join(names)}, got {raw!r}")
    for name in names:
        value, most = raw[name], MOST_STEPS if name == "horizon" else MOST_UNITS
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise UserError(f"{where}.{name}: expected an integer from 1 to {most}, got {value!r}")
    return FunSpec(**raw)
