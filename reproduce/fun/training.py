"""`fun`: Manager and Worker trained together on the environment's own reward, as `ppo_lstm` is."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger

from reproduce.config import LearnerConfig, TrainingConfig
from reproduce.fun.config import FunConfig
from reproduce.fun.learner import FunPPO
from reproduce.fun.network import FunNetwork
from reproduce.fun.policy import LEVEL
from reproduce.methods.ppo_lstm import EpisodeLog
from reproduce.methods.stepping import RecurrentTraining, make_environments


def make_fun_learner(env: Any, config: LearnerConfig, fun: FunConfig, seed: int) -> FunPPO:
    """FuN's learner as SB3 knows it; ``config`` says what it shares with the other learners."""
    learner = FunPPO(
        FunNetwork,
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
        log_std_line=(config.log_std_init, config.final_log_std, config.noise_share),
        desired_kl=config.desired_kl,
        policy_kwargs={"hidden_units": config.hidden_units, "log_std_init": config.log_std_init},
        seed=seed,
        device="cpu",
        fun=fun,
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


class FunTraining(RecurrentTraining):
    """Trains Manager and Worker; ``update`` is one rollout and one training of both."""

    def __init__(self, config: TrainingConfig, seed: int, fun: FunConfig | None = None) -> None:
        """Start environments and learner."""
        venv = make_environments(config, seed)
        env = EpisodeLog(venv)
        self.learner = make_fun_learner(env, config.low, fun or FunConfig(), seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn; ``done`` steps were taken before."""
        self.collect(done)
        self.learner.train()
        row = self.row()
        for key in ("intrinsic", "goal_cosine", "manager_explained_variance"):
            row[f"{LEVEL}_{key}"] = self.learner.logger.name_to_value.get(f"train/{key}", np.nan)
        return row
