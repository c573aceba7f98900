"""lunar_rescue: the rescue of a fallen astronaut by a two-armed lunar robot, as a Gymnasium environment."""

import importlib.metadata

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
ENV_ID = "LunarRescue-v0"
gymnasium.register(
    id=ENV_ID,
    entry_point="lunar_rescue.env:LunarRescueEnv",
    max_episode_steps=MAX_STEPS,
    additional_wrappers=(WrapperSpec("StepLimit", "lunar_rescue.env:StepLimit", {}),),
)

__all__ = [
    "ENVIRONMENT_VERSION",
    "ENV_ID",
    "TASKS",
    "LunarRescueEnv",
    "RewardWeights",
    "Rock",
    "Scene",
    "postures",
    "sample_scene",
]
