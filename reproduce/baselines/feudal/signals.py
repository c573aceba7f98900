"""What Manager and Worker learn from beside rewards, as pure functions of a rollout: intrinsic reward and directions.

Time comes first, then environments: (t, n, ...). No cosine crosses the end of an episode.
"""

from __future__ import annotations

import torch as th
from torch.nn import functional


def intrinsic_rewards(
    states: th.Tensor, following: th.Tensor, goals: th.Tensor, clock: th.Tensor, horizon: int
) -> th.Tensor:
    """Return Eq. 8: r^I = 1/c sum_{i=1..c} cos(s_t - s_{t-i}, g_{t-i}), of the steps that led to s_t.

    Terms that would reach back before the episode are left out of the sum, which is divided by c all the same.

    Args:
        states: s of the c - 1 steps before the rollout and of its t steps, (c - 1 + t, n, d).
        following: The state that each step of the rollout led to, an episode's last one included, (t, n, d).
        goals: The goals that were sent to Worker at ``states``, (c - 1 + t, n, d).
        clock: Steps since the episode began, (t, n).
        horizon: c.

    Returns:
        (t, n), in [-1, 1].
    """
    steps = len(following)
    total = th.zeros(clock.shape)
    for back in range(horizon):  # i - 1: how many steps before this one the goal was set
        first = horizon - 1 - back
        moved = following - states[first : first + steps]
        cosine = functional.cosine_similarity(moved, goals[first : first + steps], dim=-1)
        total += th.where(clock >= back, cosine, 0.0)
    return total / horizon


def directions(states: th.Tensor, following: th.Tensor, ends: th.Tensor, horizon: int) -> tuple[th.Tensor, th.Tensor]:
    """Return Eq. 7's s_{t+c} - s_t, as data: no gradient flows through it, which would let Manager move s itself.

    An episode that ends within c steps gives the way to its last state. Where the rollout ends within c steps the rest
    of the way is not known yet, and Manager does not learn from the step.

    Args:
        states: s_t, (t, n, d).
        following: The state that each step led to, an episode's last one included, (t, n, d).
        ends: Whether the episode ended with the step, (t, n).
        horizon: c.

    Returns:
        The differences (t, n, d), and which of them are known (t, n).
    """
    steps, count = ends.shape
    now = th.arange(steps)[:, None]
    first_end = th.where(ends, now, steps).flip(0).cummin(0).values.flip(0)  # at or after each step; none is `steps`
    until = th.minimum(now + horizon - 1, first_end)
    known = until < steps
    reached = following[until.clamp(max=steps - 1), th.arange(count)]
    return (reached - states).detach(), known
