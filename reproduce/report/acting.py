"""Act a rescue out while somebody looks on: what films, 3D replays and the live view share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.learning.policy import Actions, Observations, Policy
from reproduce.storage.errors import UserError

FRAMES_PER_SECOND = 10  # real time: an action is held for 0.1 s
LAST_SECONDS = 1.5  # a film stays on its last picture so long


class WatchedPolicy:
    """Wrap a policy and report its sub-goals before each action is executed."""

    def __init__(self, policy: Any, see: Callable[[NDArray[Any] | None], None]) -> None:
        """Wrap a policy; ``see`` is given its sub-goals in the base frame (2, 3) [m], or None where it has none."""
        self._policy, self._see = policy, see

    def __getattr__(self, name: str) -> Any:
        """Be the other policy in all else: ``prepare``, if it wants to know the scene, and ``overlay``."""
        return getattr(self._policy, name)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Choose actions as the other policy does, then report; see ``Policy.act``."""
        actions: Actions = self._policy.act(observations, starts)
        subgoals = self._policy.overlay().get("sub-goal")
        self._see(None if subgoals is None else subgoals[0])
        return actions


def load_policy_and_scene(where: str | Path, seed: int, posture: str | None, task: str | None) -> tuple[Policy, Scene]:
    """Load a run folder's policy, or that of a method that does not learn, and draw the scene that is to be shown."""
    if seed < 0:
        raise UserError(f"seed: expected at least 0, got {seed}")
    _, policy = find_policy(where)
    return policy, sample_scene(seed, posture=posture, task=task)


def act_out(
    env: LunarRescueEnv, policy: Policy, scene: Scene, see: Callable[[NDArray[Any] | None, str], None]
) -> dict[str, Any]:
    """Act one rescue out while somebody looks on; return how it ended, as from ``run_episode``.

    ``see`` is called before each step with the sub-goals (2, 3) [m] or None and ""; at the end, None and the ending.
    """
    row = run_episode(env, WatchedPolicy(policy, lambda subgoals: see(subgoals, "")), scene)
    see(None, ending(row))
    return row


def ending(row: dict[str, Any]) -> str:
    """Say in words how a rescue ended."""
    return "rescued" if row["success"] else f"failed by {str(row['failure']).replace('_', ' ')}"
