"""What each layer adds: a trained two-layer policy with one of its layers put out of action."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from reproduce.hrl_dcs.policy import HierarchicalPolicy
from reproduce.hrl_dcs.subgoals import ENDS_SIZE, SUBGOAL_SIZE, targets
from reproduce.learning.policy import Observations, Policy
from reproduce.storage.errors import UserError


class FixedTarget(HierarchicalPolicy):
    """SGN replaced by a fixed sub-goal: the target areas themselves."""

    def command(self, observations: Observations, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """The target areas P_G, plates level."""
        return np.pad(targets(observations)[rows], ((0, 0), (0, SUBGOAL_SIZE - ENDS_SIZE)))


class AnchorsAlone(HierarchicalPolicy):
    """SGN silent: sub-goals stay on what they are measured from, the next point of the way in."""

    def command(self, observations: Observations, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """The anchors."""
        return self._anchors.subgoals(np.zeros_like(self._subgoals))[rows]


def _as(kind: type[HierarchicalPolicy]) -> Callable[[HierarchicalPolicy], HierarchicalPolicy]:
    return lambda policy: kind(*policy.networks, policy.interval, policy.meaning, policy.mirrored)


def _untrained_lln(policy: HierarchicalPolicy) -> HierarchicalPolicy:
    """LLN with layers as before any training; how it scales its observations stays."""
    sgn, lln = policy.networks
    fresh = copy.deepcopy(lln)
    th.manual_seed(0)
    for module in fresh.modules():
        if isinstance(module, nn.Linear | nn.LSTM):
            module.reset_parameters()
    return HierarchicalPolicy(sgn, fresh, policy.interval, policy.meaning, policy.mirrored)


ABLATIONS: dict[str, Callable[[HierarchicalPolicy], HierarchicalPolicy]] = {
    "fixed_target": _as(FixedTarget),
    "anchors_alone": _as(AnchorsAlone),
    "untrained_lln": _untrained_lln,
}


def ablated(policy: Policy, ablation: str, method: str) -> HierarchicalPolicy:
    """A policy with one layer put out of action.

    Raises:
        UserError: On an unknown ablation, or a policy that has no two layers.
    """
    if ablation not in ABLATIONS:
        raise UserError(f"--ablation: expected one of {', '.join(ABLATIONS)}; got {ablation!r}")
    if not isinstance(policy, HierarchicalPolicy):
        raise UserError(f"--ablation: {method} has no two layers")
    return ABLATIONS[ablation](policy)
