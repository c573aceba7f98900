"""sb3-contrib's RecurrentPPO, its algorithm unchanged, fed whole sequences.

The stock learner loops over time in Python whenever an episode starts inside a padded sequence. Here sequences are cut
at episode starts, so one fused LSTM call serves a minibatch.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from stable_baselines3.common.utils import explained_variance
from torch.nn import functional

from reproduce.learning.networks import observe_all
from reproduce.learning.sequences import (
    TARGETS,
    Minibatch,
    Rollout,
    advantages_and_returns,
    as_tensor,
    env_major,
    minibatches,
    sequence_bounds,
)
from reproduce.storage.checkpoint import module_tensors, optimizer_tensors, restore_module, restore_optimizer
from reproduce.storage.errors import RunFailedError

RATE_STEP = 1.2  # factor by which the learning rate changes after an update, where it follows the KL
LEAST_FACTOR = 1.0 / 30.0


class SequencePPO(RecurrentPPO):
    """RecurrentPPO over flat observations, for a ``RecurrentNetwork``: an LSTM in the actor, none in the critic."""

    def __init__(
        self,
        *args: Any,
        sequence_length: int = 32,
        log_std_line: tuple[float, float, float] | None = None,
        desired_kl: tuple[float, float] = (0.0, 0.0),
        **kwargs: Any,
    ) -> None:
        """Make a learner as RecurrentPPO does; ``batch_size`` counts transitions.

        The gradient flows back through time over at most ``sequence_length`` steps. The logarithm of the actions'
        standard deviation stays under ``log_std_line``: its beginning, its end, and the share of the training at which
        it has come down. ``desired_kl`` is an update's KL at the beginning and at the end, on a line between: where
        positive, ``rate_factor`` falls when an update's KL is over twice this and rises when it is under half.
        """
        if sequence_length < 1:
            raise ValueError(f"sequence_length: expected at least 1, got {sequence_length!r}")
        self.sequence_length = sequence_length
        self.log_std_line, self.desired_kl = log_std_line, desired_kl
        self.rate_factor = 1.0  # what the schedule's learning rate is multiplied by, in [1 / 30, 1]
        self.external_rollout: Rollout | None = None  # to train on, collected elsewhere: SGN's come from LLN's view
        # After which steps returns are cut although episode and memory go on, (n_steps, n_envs).
        self.return_cuts: NDArray[np.bool_] | None = None
        self.where = type(self).__name__  # name of the learner and number of the update, for errors
        super().__init__(*args, **kwargs)
        self.batch_rng = np.random.default_rng(self.seed)

    def state_tensors(self) -> dict[str, th.Tensor]:
        """Return weights and moments of the optimiser; see ``checkpoint.Learner``."""
        return {**module_tensors("policy", self.policy), **optimizer_tensors("optimizer", self.policy.optimizer)}

    def state_numbers(self) -> dict[str, Any]:
        """Return the state of the minibatches' generator and the rate factor; see ``checkpoint.Learner``."""
        return {"batch_rng": self.batch_rng.bit_generator.state, "rate_factor": self.rate_factor}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what the two methods above returned; see ``checkpoint.Learner``."""
        restore_module("policy", self.policy, tensors)
        restore_optimizer("optimizer", self.policy.optimizer, tensors)
        self.batch_rng.bit_generator.state = numbers["batch_rng"]
        self.rate_factor = float(numbers["rate_factor"])

    def rollout(self) -> Rollout:
        """Return the transitions to train on, environments end to end."""
        if self.external_rollout is not None:
            return self.external_rollout
        buffer = self.rollout_buffer
        assert isinstance(buffer, RecurrentRolloutBuffer)
        steps, envs = buffer.buffer_size, buffer.n_envs
        starts = buffer.episode_starts.astype(bool)
        bounds = [b for i in range(envs) for b in sequence_bounds(starts[:, i], i * steps, self.sequence_length)]
        hidden = np.stack([buffer.hidden_states_pi[:, 0], buffer.cell_states_pi[:, 0]], axis=2)  # (t, n, 2, h)
        # An episode begins with an empty memory, whatever the state before it was.
        hidden = np.where(starts[:, :, None, None], np.float32(0.0), hidden)
        if self.return_cuts is not None:
            self._cut_returns(buffer, self.return_cuts)
        columns = {name: getattr(buffer, name) for name in ("observations", *TARGETS)} | {"hidden": hidden}
        whole = {name: env_major(as_tensor(array)).numpy() for name, array in columns.items()}
        return Rollout(**whole, bounds=np.array(bounds, dtype=np.int64))

    def _cut_returns(self, buffer: RecurrentRolloutBuffer, cuts: NDArray[np.bool_]) -> None:
        """Estimate advantages and returns anew, with nothing flowing back over a cut."""
        rewards, ends = buffer.rewards.astype(np.float64), cuts.copy()
        # What follows the rollout is in SB3's last advantage, r + gamma V' - V.
        rewards[-1] = np.where(cuts[-1], rewards[-1], buffer.advantages[-1] + buffer.values[-1])
        ends[-1] = True
        buffer.advantages, buffer.returns = advantages_and_returns(
            rewards, buffer.values, np.zeros(buffer.n_envs), ends, self.gamma, self.gae_lambda
        )

    def train(self) -> None:
        """Take ``n_epochs`` passes over the rollout; a ``RunFailedError`` stops at a loss that is not finite."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        for group in self.policy.optimizer.param_groups:
            group["lr"] *= self.rate_factor
        rollout = self.rollout()
        targets = {name: th.from_numpy(getattr(rollout, name)) for name in TARGETS}
        logs: list[dict[str, float]] = []
        for _ in range(self.n_epochs):
            for batch in minibatches(rollout, self.batch_size or len(rollout), self.batch_rng):
                loss, log = self.losses(batch, {name: tensor[batch.rows] for name, tensor in targets.items()})
                check_losses(self.where, log)
                logs.append(log)
                self.policy.optimizer.zero_grad()
                loss.backward()
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1
        self._limit_noise()
        # Only now, so that the rollout's log probabilities stayed what they were while it was learnt from.
        observe_all(self.policy, rollout.observations)
        self._record(rollout, logs)
        if self.desired_kl[0] > 0.0:
            self._follow_kl(float(np.mean([log["approx_kl"] for log in logs])))

    @th.no_grad()
    def _limit_noise(self) -> None:
        """Lower the standard deviations of exploration to their line; those below it stay."""
        if self.log_std_line is not None:
            first, last, share = self.log_std_line
            progress = min(1.0, (1.0 - self._current_progress_remaining) / share)
            if last < first:
                self.policy.log_std.clamp_(max=first + progress * (last - first))

    def _follow_kl(self, kl: float) -> None:
        """Adapt the learning rate: a fixed one makes steps that are too large once exploration is small."""
        first, last = self.desired_kl
        desired = last + self._current_progress_remaining * (first - last)
        if kl > 2.0 * desired:
            self.rate_factor = max(self.rate_factor / RATE_STEP, LEAST_FACTOR)
        elif kl < 0.5 * desired:
            self.rate_factor = min(self.rate_factor * RATE_STEP, 1.0)

    def losses(self, batch: Minibatch, data: dict[str, th.Tensor]) -> tuple[th.Tensor, dict[str, float]]:
        """Return PPO's loss of one minibatch, and its parts by name for logging."""
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        values, log_prob, entropy = self.evaluate_sequences(batch, data["actions"])
        advantages = data["advantages"]
        if self.normalize_advantage and len(advantages) > 1:  # one alone has no deviation
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        ratio = th.exp(log_prob - data["log_probs"])
        policy_loss = -th.min(advantages * ratio, advantages * th.clamp(ratio, 1 - clip, 1 + clip)).mean()
        value_loss = functional.mse_loss(data["returns"], values)
        entropy_loss = -th.mean(entropy) if entropy is not None else th.mean(log_prob)
        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
        with th.no_grad():
            log_ratio = log_prob - data["log_probs"]
            log = {
                "policy_gradient_loss": policy_loss,
                "value_loss": value_loss,
                "entropy_loss": entropy_loss,
                "loss": loss,
                "approx_kl": th.mean((th.exp(log_ratio) - 1) - log_ratio),
                "clip_fraction": th.mean((th.abs(ratio - 1) > clip).float()),
            }
        return loss, {name: value.item() for name, value in log.items()}

    def evaluate_sequences(self, batch: Minibatch, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, log probabilities and entropies (m,) of a minibatch's real transitions, by one LSTM call."""
        policy: Any = self.policy  # sb3-contrib types its parts too loosely to follow
        pi_features, vf_features = policy.extract_features(batch.observations.flatten(0, 1))
        length, count = batch.mask.shape
        memory, _ = policy.lstm_actor(pi_features.view(length, count, -1), batch.hidden)
        memory = memory[batch.mask]
        latent_vf = policy.critic(vf_features.view(length, count, -1)[batch.mask])
        distribution = policy._get_action_dist_from_latent(policy.mlp_extractor.forward_actor(memory))
        values = policy.value_net(policy.mlp_extractor.forward_critic(latent_vf)).flatten()
        return values, distribution.log_prob(actions), distribution.entropy()

    def _record(self, rollout: Rollout, logs: list[dict[str, float]]) -> None:
        for name in logs[0]:
            self.logger.record(f"train/{name}", float(np.mean([log[name] for log in logs])))
        self.logger.record("train/explained_variance", float(explained_variance(rollout.values, rollout.returns)))
        self.logger.record("train/std", float(th.exp(self.policy.log_std.detach()).mean()))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


def check_losses(where: str, log: Mapping[str, float]) -> None:
    """Stop a training with a ``RunFailedError`` at the first loss that is not finite, before it spoils the weights.

    ``where`` names learner and update for the message; in the update's log, names of losses end in ``loss``.
    """
    for name, value in log.items():
        if name.endswith("loss") and not math.isfinite(value):
            raise RunFailedError(f"{where}: {name}: expected a finite number, got {value}; the training stops here")
