"""What each layer adds: a trained two-layer policy with one of its layers put out of action."""

import copy
from collections.abc import Callable

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from reproduce.hrl_dcs.config import ABLATIONS, check_ablation
from reproduce.hrl_dcs.policy import HierarchicalPolicy
from reproduce.hrl_dcs.subgoals import Floats, RescueGoals, targets
from reproduce.learning.policy import Policy
from reproduce.storage.errors import UserError


class FixedTarget(RescueGoals):
    """SGN replaced by a fixed sub-goal: the target areas themselves."""

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Note where the target areas are."""
        self._fixed = targets(observations)

    def subgoals(self, outputs: Floats) -> Floats:
        """Return the target areas P_G, (n, 6) [m], whatever SGN puts out."""
        return self._fixed


def _fixed_target(policy: HierarchicalPolicy) -> HierarchicalPolicy:
    return HierarchicalPolicy(*policy.networks, policy.layers, FixedTarget)


def _untrained_lln(policy: HierarchicalPolicy) -> HierarchicalPolicy:
    """Put layers as before any training into LLN; how it scales its observations stays."""
    sgn, lln = policy.networks
    fresh = copy.deepcopy(lln)
    th.manual_seed(0)
    for module in fresh.modules():
        if isinstance(module, nn.Linear | nn.LSTM):
            module.reset_parameters()
    return HierarchicalPolicy(sgn, fresh, policy.layers)


_ABLATED: dict[str, Callable[[HierarchicalPolicy], HierarchicalPolicy]] = dict(
    zip(ABLATIONS, (_fixed_target, _untrained_lln), strict=True)
)


def ablated(policy: Policy, ablation: str, method: str) -> HierarchicalPolicy:
    """Return a policy with one layer put out of action; ``UserError`` on an unknown ablation or no two layers."""
    check_ablation(ablation)
    if not isinstance(policy, HierarchicalPolicy):
        raise UserError(f"--ablation: {method} has no two layers")
    return _ABLATED[ablation](policy)
