"""Vectorised environments that SB3's learners can step but not reach into."""

from __future__ import annotations

from typing import Any, NoReturn

from stable_baselines3.common.vec_env import VecEnv


class ClosedVecEnv(VecEnv):
    """A vectorised environment without access to single environments, which live elsewhere or do not exist."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return ``render_mode``, which SB3 asks for; no other attribute can be read."""
        if attr_name == "render_mode":
            return [None] * self.num_envs
        self._refuse(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> NoReturn:
        """Refuse, as no attribute can be set."""
        self._refuse(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> NoReturn:
        """Refuse, as no method can be called."""
        self._refuse(method_name)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Say of each environment that it is not wrapped."""
        return [False] * self.num_envs

    def _refuse(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__}: single environments are out of reach; {name!r} is not available")
