"""The wrapper that ``gymnasium.make`` puts around the environment, so that both count to one step limit."""

from typing import Any

import gymnasium

from lunar_rescue.env import LunarRescueEnv


class StepLimit(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Tell the environment the limit that ``gymnasium.make`` was given, so that there is only one.

    Gymnasium's ``TimeLimit`` truncates from outside and tells nobody; the environment's own limit, to which time bonus
    and ``phase`` count, follows it.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Hand the limit of an environment's spec on to the environment itself."""
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        if env.spec is None or env.spec.max_episode_steps is None:
            return
        limit, own = env.spec.max_episode_steps, env.spec.kwargs.get("max_steps", env.spec.max_episode_steps)
        if own != limit:
            raise ValueError(f"max_steps: expected max_episode_steps={own!r} in gymnasium.make, which has {limit!r}")
        inner = env.unwrapped
        if isinstance(inner, LunarRescueEnv):
            inner.set_max_steps(limit)
