"""lunar_rescue: the rescue of a fallen astronaut by a two-armed lunar robot, as a Gymnasium environment."""

import importlib.metadata
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from lunar_rescue.env import ENVIRONMENT_VERSION, LunarRescueEnv
from lunar_rescue.rewards import RewardWeights
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.sampling import sample_scene
from lunar_rescue.scenes.scene import TASKS, Scene
from lunar_rescue.tasks import MAX_STEPS

__version__ = importlib.metadata.version("lunar-rescue")
ENV_ID, MUJOCO_ENV_ID = "LunarRescue-v0", "LunarRescueMujoco-v0"
#: Names for ``gymnasium.make``, and the arguments of the environment that hold in each.
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    ENV_ID: {},
    MUJOCO_ENV_ID: {"simulator": "mujoco"},
    "LunarRescueLift-v0": {"scenes": {"task": "lift"}},
    "LunarRescueTurnOver-v0": {"scenes": {"task": "turn_over"}},
    "LunarRescueEasy-v0": {"scenes": {"easy": True}},
}
for _name, _arguments in ENVIRONMENTS.items():
    gymnasium.register(
        id=_name,
        entry_point="lunar_rescue.env:LunarRescueEnv",
        max_episode_steps=MAX_STEPS,
        additional_wrappers=(WrapperSpec("StepLimit", "lunar_rescue.step_limit:StepLimit", {}),),
        kwargs=_arguments,
    )

__all__ = [
    "ENVIRONMENTS",
    "ENVIRONMENT_VERSION",
    "ENV_ID",
    "MUJOCO_ENV_ID",
    "TASKS",
    "LunarRescueEnv",
    "RewardWeights",
    "Rock",
    "Scene",
    "postures",
    "sample_scene",
]
