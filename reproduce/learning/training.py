"""What the trainings of all methods share: environments, schedules, summaries of episodes."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch import nn

from lunar_rescue.env import OUTCOME
from lunar_rescue.scenes.postures import Posture, postures
from reproduce.learning.actions import environment_actions
from reproduce.learning.config import ImitationConfig, LearnerConfig, RecurrentConfig, TrainingConfig
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.imitation import Example, Imitation
from reproduce.learning.mirrored_envs import Environments, MirroredVecEnv, WayInVecEnv
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.worker_process import RETURN, EnvOptions
from reproduce.learning.workers import ClosedVecEnv, WorkerVecEnv
from reproduce.storage.policies import Spec


def make_environments(config: TrainingConfig, seed: int) -> Environments:
    """Start the environments of a training, as learners see them, with the postures of its curriculum."""
    arguments = {"weights": config.reward, "obstacle_reward": config.obstacle_reward}
    drawn = [name for name, posture in postures().items() for _ in range(_weight(posture, config.priors.lying_weight))]
    postures_drawn = tuple(drawn) if config.priors.lying_weight > 1 else ()
    options = EnvOptions(arguments, postures_drawn, config.scenes == "easy", config.priors.randomise)
    venv = WorkerVecEnv(config.n_envs, seed, options)
    view = MirroredVecEnv(venv) if config.priors.mirror else venv
    return WayInVecEnv(view, config.places) if config.priors.way_in else view


def _weight(posture: Posture, lying_weight: int) -> int:
    """Return how many times as often as a posture on a side one is drawn in training."""
    return 1 if posture.attitude.endswith("side") else lying_weight


#: What SB3's and sb3-contrib's recurrent PPO take of a learner's configuration as it is.
_SAME = "n_steps batch_size n_epochs gamma gae_lambda clip_range ent_coef vf_coef max_grad_norm".split()


def make_learner(
    env: Any,
    config: LearnerConfig,
    seed: int,
    bounded_mean: bool = False,
    kind: type[RecurrentPPO] = SequencePPO,
    network: Any = RecurrentNetwork,
    **more: Any,
) -> Any:
    """Make a recurrent PPO learner as SB3 knows it; ``kind`` is ours, takes ``more``, or is the stock one."""
    sizes = {"hidden_units": config.hidden_units, "log_std_init": config.log_std_init}
    more |= {name: getattr(config, name) for name in _SAME}
    if issubclass(kind, SequencePPO):
        more["sequence_length"] = config.sequence_length
        more["log_std_line"] = (config.log_std_init, config.final_log_std, config.noise_share)
        more["desired_kl"] = (config.desired_kl, config.final_desired_kl)
    more["policy_kwargs"] = sizes | ({"bounded_mean": True} if bounded_mean else {})
    first, last = config.learning_rate, config.final_learning_rate
    learner = kind(network, env, lambda left: last + left * (first - last), seed=seed, device="cpu", **more)
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


def start_collecting(learner: Any, steps: int, callback: BaseCallback | None = None) -> BaseCallback:
    """Reset the learner's environments and memory, as ``learn`` does before it collects."""
    learner._last_obs = None
    _, made = learner._setup_learn(steps, callback, reset_num_timesteps=callback is None)
    if hasattr(learner, "_last_lstm_states"):
        for pair in learner._last_lstm_states:
            for state in pair:
                state.zero_()
    return callback or made


def imitate(
    level: str, network: RecurrentNetwork, examples: Sequence[Example], config: ImitationConfig, seed: int
) -> Iterator[dict[str, Any]]:
    """Let the network of a level imitate; yield a row with level, epoch and losses after each epoch."""
    imitation = Imitation(network, examples, config, seed)
    for epoch in range(config.epochs):
        yield {"level": level, "epoch": epoch + 1, **imitation.epoch()}


def episode_summary(episodes: list[dict[str, Any]], lying_weight: int = 1) -> dict[str, Any]:
    """Return means over the episodes of an update, as if all postures were drawn alike; NaN where none ended."""
    known = postures()
    shares = [1.0 / _weight(known[e["posture"]], lying_weight) if "posture" in e else 1.0 for e in episodes]

    def mean(key: str) -> float:
        values = [float(e.get(key, "nan")) for e in episodes]
        return float(np.average(values, weights=shares)) if episodes else float("nan")

    keys = {"success": "is_success", "both_arms_under": "both_arms_under", "return_high": "exr"}
    keys |= {"return_low": "inr", "episode_steps": "steps"}
    return {"episodes": len(episodes), **{name: mean(key) for name, key in keys.items()}}


class EpisodeLog(VecEnvWrapper):
    """Turns a network's outputs into Eq. 3's actions and adds up the rewards of each episode."""

    def __init__(self, venv: Any, set_point_changes: bool = False, **spaces: Any) -> None:
        super().__init__(venv, **spaces)
        self._set_point_changes = set_point_changes
        self.episodes: list[dict[str, Any]] = []  # outcome, returns and steps; whoever reads the list empties it
        self._totals = np.zeros((self.num_envs, 3))  # EXR, INR, steps

    def reset(self) -> Any:
        """Begin new episodes in all environments; those under way are not listed."""
        self._totals[:] = 0.0
        self._last: Any = self.venv.reset()
        return self._last

    def step_async(self, actions: Any) -> None:
        """Send the network's outputs (n, 11) on as Eq. 3's actions."""
        self.venv.step_async(environment_actions(self._last, actions, self._set_point_changes))

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the environments and list the episodes that ended."""
        self._last, rewards, dones, infos = self.venv.step_wait()
        self.add_up(rewards, np.full(self.num_envs, np.nan), dones, infos)
        return self._last, rewards, dones, infos

    def add_up(self, exr: Any, inr: Any, dones: Any, infos: list[dict[str, Any]]) -> None:
        """Add a step's rewards (n,), from outside and, where there are two layers, inside; list what ended."""
        self._totals += np.column_stack([exr, inr, np.ones(self.num_envs)])
        for index in np.flatnonzero(dones):
            info, totals = infos[index], dict(zip(("exr", "inr", "steps"), self._totals[index], strict=True))
            outcome = {key: info[key] for key in OUTCOME if key in info}
            self.episodes.append({**outcome, **totals, "exr": info.get(RETURN, totals["exr"])})
        self._totals[np.asarray(dones, bool)] = 0.0


class Training(ABC):
    """A training under way; a subclass makes the learners and says what an update does.

    ``env`` is the view of the environments ``venv`` in which one learner collects and that lists ended ``episodes``;
    ``learners`` holds all learners by level, ``steps_per_update`` the environment steps of an update.
    """

    logged: tuple[str, ...] = ()  # what of each learner's log goes into ``progress.csv``

    def __init__(
        self, config: Any, venv: Environments, env: Any, collector: Any, learners: Mapping[str, Any], n_steps: int
    ) -> None:
        """Keep the parts and begin the first episodes; ``collector`` is the learner that steps ``env``."""
        self.config: TrainingConfig = config
        self.venv, self.env, self.learners = venv, env, learners
        self.steps_per_update = n_steps * config.n_envs
        self._collector = collector
        self.callback = start_collecting(collector, config.steps)

    def restart(self, update: int) -> None:
        """Begin new episodes with empty memories; what a resumed run does too."""
        environments: Any = self.venv.unwrapped
        environments.epoch = update
        start_collecting(self._collector, self.config.steps, self.callback)

    def follow_schedule(self, done: int) -> None:
        """Tell the learners which share of the training is done, and for errors their level and update."""
        for level, learner in self.learners.items():
            learner._current_progress_remaining = max(0.0, 1.0 - done / self.config.steps)
            learner.where = f"{level}, update {done // self.steps_per_update + 1}"

    def row(self) -> dict[str, Any]:
        """Return the row of ``progress.csv`` for what happened since the last one."""
        row = episode_summary(self.env.episodes, self.config.priors.lying_weight)
        self.env.episodes = []
        for name, learner in self.learners.items():
            for key in self.logged:
                row[f"{name}_{key}"] = learner.logger.name_to_value.get(f"train/{key}", np.nan)
        return row

    @abstractmethod
    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn once, after ``done`` steps; return a row of ``progress.csv``."""

    def imitate(self, played: Sequence[PlayedBack], seed: int) -> Iterator[dict[str, Any]]:
        """Imitate demonstrations before the first update; yield a row with level, epoch and losses after each epoch."""
        raise NotImplementedError(f"{type(self).__name__}: imitates no demonstrations")

    @abstractmethod
    def networks(self) -> Mapping[str, tuple[Spec, nn.Module]]:
        """Return what acts, by level: how to build it, and it."""

    def close(self) -> None:
        """Stop the environments and their workers."""
        self.venv.close()


class RecurrentTraining(Training):
    """A training with recurrent PPO, one rollout an update."""

    config: RecurrentConfig
    logged: tuple[str, ...] = ("approx_kl", "explained_variance", "std", "value_loss")

    def __init__(
        self, config: RecurrentConfig, venv: Any, env: Any, collector: Any, learners: Mapping[str, Any]
    ) -> None:
        super().__init__(config, venv, env, collector, learners, config.low.n_steps)

    def collect(self, done: int) -> None:
        """Take one rollout; ``done`` steps were taken before."""
        self.follow_schedule(done)
        learner = self._collector
        learner.collect_rollouts(self.env, self.callback, learner.rollout_buffer, self.config.low.n_steps)

    def update(self, done: int) -> dict[str, Any]:
        """Collect a rollout and learn from it; ``done`` steps were taken before."""
        self.collect(done)
        self._collector.train()
        return self.row()


class OnlySpaces(ClosedVecEnv):
    """Spaces for a learner whose transitions are collected elsewhere; it is never stepped."""

    def _never(self, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError("OnlySpaces: this learner's transitions are collected by SubGoalVecEnv")

    reset = step_async = step_wait = _never

    def close(self) -> None:
        """Close nothing, as nothing was started."""
