"""The low level's view of the environments, in which the high level lives (Fig. 1).

LLN sees an ordinary vectorised environment whose observation holds the sub-goal and whose reward is INR, Eq. 2 towards
the sub-goal. Inside, SGN is asked for a new sub-goal at t = 0, N, 2N, ... of every episode, batched over the
environments that need one. An episode of LLN's is the N steps to a sub-goal (section 2.2, point 1), so its returns are
cut there; its memory lives on. SGN's transitions, with EXR summed over the N steps, are recorded for its own learner.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue.env import OUTCOME
from lunar_rescue.rewards import ApproachForm
from lunar_rescue.tasks import SMALLEST_ERROR
from reproduce.hrl_dcs.goals import Goals
from reproduce.learning.networks import RecurrentNetwork
from reproduce.learning.sequences import Floats, Rollout, advantages_and_returns, sequence_bounds
from reproduce.learning.workers import RETURN


@dataclass
class Decision:
    """One sub-goal set by SGN, until it is replaced."""

    observation: Floats
    output: Floats
    log_prob: float
    value: float
    hidden: Floats
    start: bool
    reward: float = 0.0
    done: bool = False


@dataclass
class Recorder:
    """SGN's transitions, one list an environment; the last decision of each list is still under way."""

    decisions: list[list[Decision]] = field(default_factory=list)

    def rollout(self, gamma: float, lam: float, length: int) -> Rollout | None:
        """Hand out all finished decisions as a rollout and keep those under way; None if there are none."""
        parts: list[dict[str, Any]] = []
        bounds: list[tuple[int, int]] = []
        total = 0
        for index, made in enumerate(self.decisions):
            done = made if made and made[-1].done else made[:-1]
            if not done:
                continue
            self.decisions[index] = made[len(done) :]
            last_value = made[-1].value if len(done) < len(made) else 0.0
            starts = np.array([d.start for d in done])
            values = np.array([d.value for d in done], np.float32)
            rewards = np.array([d.reward for d in done], np.float32)
            ends = np.array([d.done for d in done])
            advantages, returns = advantages_and_returns(rewards, values, last_value, ends, gamma, lam)
            parts.append({"made": done, "values": values, "advantages": advantages, "returns": returns})
            bounds += sequence_bounds(starts, total, length)
            total += len(done)
        if not parts:
            return None
        made = [d for part in parts for d in part["made"]]
        return Rollout(
            observations=np.array([d.observation for d in made], np.float32),
            actions=np.array([d.output for d in made], np.float32),
            log_probs=np.array([d.log_prob for d in made], np.float32),
            values=np.concatenate([part["values"] for part in parts]),
            advantages=np.concatenate([part["advantages"] for part in parts]),
            returns=np.concatenate([part["returns"] for part in parts]),
            hidden=np.array([d.hidden for d in made], np.float32),
            bounds=np.array(bounds, np.int64),
        )


class SubGoalVecEnv(VecEnvWrapper):
    """LLN's environment; see the module."""

    def __init__(
        self,
        venv: VecEnv,
        sgn: RecurrentNetwork,
        goals: Goals,
        interval: int,
        beta: float,
        form: ApproachForm,
        sgn_gamma: float,
        deterministic: bool = False,
    ) -> None:
        """Wrap environments.

        Args:
            venv: The environments, whose observations are flat.
            sgn: The high level's network.
            goals: What a sub-goal is in these environments, and how LLN's outputs become their actions.
            interval: N, steps between sub-goals.
            beta: Weight of INR's approach term.
            form: Form of INR's approach term.
            sgn_gamma: SGN's discount, for values at the step limit.
            deterministic: Whether SGN commands its mean.
        """
        view = spaces.Box(-np.inf, np.inf, (goals.view_size,), np.float32)
        acts = spaces.Box(-1.0, 1.0, (goals.actions,), np.float32)
        super().__init__(venv, observation_space=view, action_space=acts)
        self._sgn, self._goals, self._interval, self._beta, self._form = sgn, goals, interval, beta, form
        self._gamma, self._deterministic = sgn_gamma, deterministic
        count = venv.num_envs
        self.recorder = Recorder([[] for _ in range(count)])
        self.subgoals = np.zeros((count, goals.size), np.float32)
        self._left = np.zeros(count, np.int64)
        self._best = np.zeros((count, goals.distance_count), np.float32)
        hidden = sgn.lstm_actor.hidden_size
        self._hidden = np.zeros((count, 2, hidden), np.float32)
        self.episodes: list[dict[str, Any]] = []
        #: For each step since the rollout began, where LLN's episode of N steps ended with it (n,).
        self.cuts: list[NDArray[np.bool_]] = []
        self._last = np.zeros((count, venv.observation_space.shape[0]), np.float32)  # type: ignore[index]
        self._returns = np.zeros((count, 3))  # EXR, INR, steps of the episode under way

    def reset(self) -> Floats:
        """Begin new episodes and ask for the first sub-goals."""
        observations = np.asarray(self.venv.reset(), np.float32)
        self.recorder = Recorder([[] for _ in range(self.num_envs)])
        self._returns[:] = 0.0
        everything = np.ones(self.num_envs, bool)
        self._goals.update(observations, everything)
        self._decide(observations, everything, everything)
        return self._view(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send LLN's outputs on as the environments' actions."""
        self.venv.step_async(self._goals.actions_of(self._last, actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Step, reward LLN with INR, credit SGN with EXR, and renew sub-goals where N steps are over."""
        seen, exr, dones, infos = self.venv.step_wait()
        observations = np.asarray(seen, np.float32)
        ended = observations.copy()  # what the step led to; an ended episode's last observation is in its info
        for index in np.flatnonzero(dones):
            ended[index] = infos[index]["terminal_observation"]
        inr = self._internal_reward(ended)
        self._credit(exr, inr, dones, infos, ended)
        self._left -= 1
        starts = np.asarray(dones, bool)
        self._goals.update(observations, starts)
        over = starts | (self._left <= 0)
        self.cuts.append(over)
        self._decide(observations, over, starts)
        return self._view(observations), inr, dones, infos

    def _view(self, observations: Floats) -> Floats:
        self._last = observations
        return self._goals.view(observations, self.subgoals, (self._left / self._interval).astype(np.float32))

    def _distances(self, observations: Floats) -> Floats:
        return self._goals.distances(observations, self.subgoals) + np.float32(SMALLEST_ERROR)

    def _internal_reward(self, observations: Floats) -> Floats:
        """INR, Eq. 2: approach to the sub-goal for all environments at once, the other terms from the environment."""
        distance = self._distances(observations)
        gain = np.exp(self._best - distance) - (1.0 if self._form == "signed" else 0.0)
        self._best = distance  # D_m of the last step, as in the environment's own reward
        inr: Floats = self._beta * gain.mean(axis=1) + self._goals.shared_reward(self.venv, observations)
        return inr.astype(np.float32)

    def _credit(
        self, exr: NDArray[Any], inr: Floats, dones: NDArray[Any], infos: list[dict[str, Any]], ended: Floats
    ) -> None:
        self._returns += np.column_stack([exr, inr, np.ones(self.num_envs)])
        for index in range(self.num_envs):
            decision = self.recorder.decisions[index][-1]
            decision.reward += float(exr[index])
            if dones[index]:
                decision.done = True
                if infos[index].get("TimeLimit.truncated", False):
                    # At the step limit the value of what would have come stands in, as SB3 does for the low level.
                    decision.reward += self._gamma * self._value(ended[index])
                infos[index]["terminal_observation"] = self._goals.view(
                    ended[index : index + 1], self.subgoals[index : index + 1], np.zeros(1, np.float32)
                )[0]
                totals = dict(zip(("exr", "inr", "steps"), self._returns[index], strict=True))
                totals["exr"] = infos[index].get(RETURN, totals["exr"])
                self.episodes.append({**{k: infos[index][k] for k in OUTCOME if k in infos[index]}, **totals})
                self._returns[index] = 0.0

    def _value(self, observation: Floats) -> float:
        with th.no_grad():
            states = (th.zeros(1, 1, 1), th.zeros(1, 1, 1))  # the critic has no memory
            value = self._sgn.predict_values(th.from_numpy(observation[None]), states, th.zeros(1))
        return float(value)

    def _decide(self, observations: Floats, which: NDArray[np.bool_], starts: NDArray[np.bool_]) -> None:
        """Ask SGN for new sub-goals of the environments in ``which``."""
        rows = np.flatnonzero(which)
        if len(rows) == 0:
            return
        self._hidden[starts] = 0.0
        chosen, before = observations[rows], self._hidden[rows]
        state = th.from_numpy(before).unsqueeze(0)
        pair = (state[:, :, 0].contiguous(), state[:, :, 1].contiguous())
        with th.no_grad():
            output, values, log_probs, after = self._sgn(
                th.from_numpy(chosen),
                RNNStates(pair, pair),
                th.zeros(len(rows)),
                deterministic=self._deterministic,
            )
        self._hidden[rows] = th.stack([after.pi[0][0], after.pi[1][0]], dim=1).numpy()
        outputs = output.numpy()
        for slot, index in enumerate(rows):
            self.recorder.decisions[index].append(
                Decision(
                    chosen[slot],
                    outputs[slot],
                    float(log_probs[slot]),
                    float(values[slot]),
                    before[slot],
                    bool(starts[index]),
                )
            )
        everywhere = np.zeros((self.num_envs, self._goals.outputs), np.float32)
        everywhere[rows] = outputs
        self.subgoals[rows] = self._goals.subgoals(everywhere)[rows]
        self._left[rows] = self._interval
        self._best[rows] = self._distances(observations)[rows]
