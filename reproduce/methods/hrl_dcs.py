"""HRL-DCS: both layers trained together on the same steps.

One rollout of LLN's feeds both: LLN learns from every step with INR, SGN from every N steps with the summed EXR.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger

from reproduce.config import LearnerConfig, TrainingConfig
from reproduce.hrl.hierarchy import SUBGOAL_SPACE, SubGoalVecEnv
from reproduce.hrl.networks import RecurrentNetwork
from reproduce.learners.sequence_ppo import SequencePPO
from reproduce.methods.stepping import (
    OnlySpaces,
    episode_summary,
    follow_schedule,
    make_environments,
    start_collecting,
)


def make_learner(env: Any, config: LearnerConfig, seed: int, bounded_mean: bool) -> SequencePPO:
    """One recurrent PPO learner as SB3 knows it."""
    learner = SequencePPO(
        RecurrentNetwork,
        env,
        learning_rate=lambda left: (
            config.final_learning_rate + left * (config.learning_rate - config.final_learning_rate)
        ),
        n_steps=config.n_steps,
        batch_size=config.batch_size,
        n_epochs=config.n_epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.ent_coef,
        vf_coef=config.vf_coef,
        max_grad_norm=config.max_grad_norm,
        sequence_length=config.sequence_length,
        policy_kwargs={
            "hidden_units": config.hidden_units,
            "bounded_mean": bounded_mean,
            "log_std_init": config.log_std_init,
        },
        seed=seed,
        device="cpu",
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


class HierarchicalTraining:
    """Trains SGN and LLN; one ``update`` is one rollout and one training of each."""

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        """Start environments and learners."""
        self.config = config
        self.venv = make_environments(config, seed)
        high_env = OnlySpaces(self.venv.observation_space, SUBGOAL_SPACE, config.n_envs)
        self.sgn = make_learner(high_env, config.high, seed, bounded_mean=True)
        h = config.hierarchy
        self.env = SubGoalVecEnv(self.venv, self.sgn.policy, h.interval, h.beta, h.form, config.high.gamma)  # type: ignore[arg-type]
        self.lln = make_learner(self.env, config.low, seed + 1, bounded_mean=False)
        self.callback = start_collecting(self.lln, config.steps)

    @property
    def learners(self) -> dict[str, SequencePPO]:
        """Both levels by name."""
        return {"sgn": self.sgn, "lln": self.lln}

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.config.low.n_steps * self.config.n_envs

    def restart(self, update: int) -> None:
        """Begin new episodes with empty memories; what a resumed run does too."""
        self.venv.restart(update)
        start_collecting(self.lln, self.config.steps, self.callback)

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn; ``done`` steps were taken before."""
        follow_schedule(self.learners.values(), done / self.config.steps)
        self.env.cuts.clear()
        self.lln.collect_rollouts(self.env, self.callback, self.lln.rollout_buffer, self.config.low.n_steps)
        self.lln.return_cuts = np.array(self.env.cuts)
        self.lln.train()
        high = self.config.high
        rollout = self.env.recorder.rollout(high.gamma, high.gae_lambda, high.sequence_length)
        if rollout is not None and done >= self.config.hierarchy.warmup * self.config.steps:
            self.sgn.external_rollout = rollout
            self.sgn.train()
        row = episode_summary(self.env.episodes)
        self.env.episodes = []
        for name, learner in self.learners.items():
            for key in ("approx_kl", "explained_variance", "std", "value_loss"):
                row[f"{name}_{key}"] = learner.logger.name_to_value.get(f"train/{key}", np.nan)
        return row

    def close(self) -> None:
        """Stop the environments."""
        self.venv.close()
