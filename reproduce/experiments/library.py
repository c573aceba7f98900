"""Trained policies for others' programs: ``reproduce.load_policy`` returns one that acts as SB3's models do."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.observation import SIZE, as_flat
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.learning.policy import Actions

Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]


class LoadedPolicy:
    """A policy of a run folder, or of a method that does not learn, that acts by its means.

    It keeps its own memory of each environment: use one policy for one environment, or for one vector of them.

    Attributes:
        method: Name of the method in the registry, such as ``"hrl_dcs"``.
        policy: The policy itself, for flat observations; see ``reproduce.learning.policy.Policy``.
    """

    def __init__(self, where: str | Path) -> None:
        """Load a run folder's policy, or that of a method that does not learn by its name; see ``load_policy``."""
        method, self.policy = find_policy(where)
        self.method = method.name

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Choose actions as SB3's ``predict`` does, so that SB3's ``evaluate_policy`` takes this policy.

        Args:
            observation: The environment's Dict, or flat (SIZE,); of n environments with a first axis of n.
            state: What the last call returned; None begins an episode everywhere.
            episode_start: Which environments (n,) begin an episode with this observation, besides.
            deterministic: Only True; policies are made to act by their means.

        Returns:
            Actions (11,) or (n, 11) in [-1, 1], and the state to hand to the next call.

        Raises:
            ValueError: On observations of another size, or ``deterministic=False``.
        """
        if not deterministic:
            raise ValueError("deterministic: expected True, as policies act by their means")
        flat = as_flat(observation) if isinstance(observation, dict) else np.asarray(observation, np.float32)
        if flat.ndim not in (1, 2) or flat.shape[-1] != SIZE:
            raise ValueError(f"observation: expected shape ({SIZE},) or (n, {SIZE}), got {flat.shape}")
        rows = np.atleast_2d(flat)
        starts = np.full(len(rows), state is None)
        if episode_start is not None:
            starts |= np.asarray(episode_start, bool)
        actions = self.policy.act(rows, starts)
        return (actions if flat.ndim == 2 else actions[0]), (True,)

    def rescue(self, env: LunarRescueEnv, scene: Scene) -> dict[str, Any]:
        """Act out one rescue in an environment; return its row, as of ``evaluation.csv``: success, failure, steps..."""
        return run_episode(env, self.policy, scene)
