"""The low level's view of the environments, in which the high level lives (Fig. 1).

LLN sees an ordinary vectorised environment whose observation holds the sub-goal and whose reward is INR, Eq. 2 towards
the sub-goal. Inside, SGN is asked for a new sub-goal at t = 0, N, 2N, ... of every episode, batched over the
environments that need one. An episode of LLN's is the N steps to a sub-goal (section 2.2, point 1), so its returns are
cut there; its memory lives on. SGN's transitions, with EXR summed over the N steps, are recorded for its own learner.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lunar_rescue.tasks import SMALLEST_ERROR
from reproduce.hrl_dcs.config import HierarchicalConfig
from reproduce.hrl_dcs.goals import Goals
from reproduce.hrl_dcs.policy import HighLevel
from reproduce.learning.networks import RecurrentNetwork, flat_spaces
from reproduce.learning.sequences import Floats, Rollout, advantages_and_returns, sequence_bounds
from reproduce.learning.training import EpisodeLog


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


class RecordedHighLevel(HighLevel):
    """SGN as it is trained: it draws its outputs, and every decision is recorded."""

    def begin(self) -> None:
        """Forget what was recorded, as all episodes begin anew."""
        # One list an environment; the last decision of each is still under way.
        self.decisions: list[list[Decision]] = [[] for _ in self.subgoals]

    def command(self, observations: Floats, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> Floats:
        """Draw outputs (m, goals.outputs) for environments ``rows`` (m,) and record them."""
        outputs, log_probs, values, hidden = self.memory.draw(observations, rows)
        for slot, index in enumerate(rows):
            numbers = float(log_probs[slot]), float(values[slot])
            decision = Decision(observations[slot], outputs[slot], *numbers, hidden[slot], bool(starts[slot]))
            self.decisions[index].append(decision)
        return outputs

    def rollout(self, gamma: float, lam: float, length: int) -> Rollout | None:
        """Hand out all finished decisions as a rollout and keep those under way; None if there are none."""
        finished: list[Decision] = []
        estimates: list[tuple[Floats, Floats]] = []
        bounds: list[tuple[int, int]] = []
        for index, decisions in enumerate(self.decisions):
            done = decisions if decisions and decisions[-1].done else decisions[:-1]
            if done:
                rewards, values = np.array([(d.reward, d.value) for d in done], np.float32).T
                ends, starts = np.array([d.done for d in done]), np.array([d.start for d in done])
                # Where the last one ended its episode, the value after it does not count.
                estimates.append(advantages_and_returns(rewards, values, decisions[-1].value, ends, gamma, lam))
                bounds += sequence_bounds(starts, len(finished), length)
                finished += done
                self.decisions[index] = decisions[len(done) :]
        if not finished:
            return None
        advantages, returns = map(np.concatenate, zip(*estimates, strict=True))
        names = {"observations": "observation", "actions": "output", "log_probs": "log_prob", "values": "value"}
        columns = {name: np.array([getattr(d, one) for d in finished], np.float32) for name, one in names.items()}
        hidden = np.array([d.hidden for d in finished], np.float32)
        whole = {**columns, "advantages": advantages, "returns": returns, "hidden": hidden}
        return Rollout(**whole, bounds=np.array(bounds, np.int64))


class SubGoalVecEnv(EpisodeLog):
    """LLN's environment, with SGN as its part ``high``; see the module."""

    def __init__(self, venv: VecEnv, sgn: RecurrentNetwork, goals: Goals, config: HierarchicalConfig) -> None:
        """Wrap environments with flat observations; ``goals`` also make their actions of LLN's outputs."""
        seen, acts = flat_spaces(goals.view_size, goals.actions)
        super().__init__(venv, observation_space=seen, action_space=acts)
        self._sgn, self._goals, self._config = sgn, goals, config
        count = venv.num_envs
        self.high = RecordedHighLevel(sgn, goals, config.hierarchy.interval, count)
        self._best = np.zeros((count, goals.distance_count), np.float32)
        self.cuts: list[NDArray[np.bool_]] = []  # of each step of a rollout, where N steps ended with it (n,)

    def reset(self) -> Floats:
        """Begin new episodes and ask for the first sub-goals."""
        observations = np.asarray(super().reset(), np.float32)
        self.high.begin()
        self._decide(observations, np.ones(self.num_envs, bool))
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
        self.cuts.append(self._decide(observations, np.asarray(dones, bool)))
        return self._view(observations), inr, dones, infos

    def _decide(self, observations: Floats, starts: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Let SGN go on by a step; return where it set a new sub-goal, (n,)."""
        renewed = np.zeros(self.num_envs, bool)
        renewed[self.high.advance(observations, starts)] = True
        self._best[renewed] = self._distances(observations)[renewed]
        return renewed

    def _view(self, observations: Floats) -> Floats:
        self._last = observations
        return self.high.view(observations)

    def _distances(self, observations: Floats) -> Floats:
        return self._goals.distances(observations, self.high.subgoals) + np.float32(SMALLEST_ERROR)

    def _internal_reward(self, observations: Floats) -> Floats:
        """Return INR, Eq. 2 (n,): the approach to the sub-goal, and the other terms from the environment."""
        distance = self._distances(observations)
        h = self._config.hierarchy
        gain = np.exp(self._best - distance) - (1.0 if h.form == "signed" else 0.0)
        self._best = distance  # D_m of the last step, as in the environment's own reward
        inr: Floats = h.beta * gain.mean(axis=1) + self._goals.shared_reward(self.venv, observations)
        return inr.astype(np.float32)

    def _credit(
        self, exr: NDArray[Any], inr: Floats, dones: NDArray[Any], infos: list[dict[str, Any]], ended: Floats
    ) -> None:
        self.add_up(exr, inr, dones, infos)
        for index in range(self.num_envs):
            decision = self.high.decisions[index][-1]
            decision.reward += float(exr[index])
            if dones[index]:
                decision.done = True
                if infos[index].get("TimeLimit.truncated", False):
                    # At the step limit the value of what would have come stands in, as SB3 does for the low level.
                    states = (th.zeros(1, 1, 1), th.zeros(1, 1, 1))  # the critic has no memory
                    with th.no_grad():
                        value = self._sgn.predict_values(th.from_numpy(ended[[index]]), states, th.zeros(1))
                    decision.reward += self._config.high.gamma * float(value)
                infos[index]["terminal_observation"] = self._goals.view(
                    ended[index : index + 1], self.high.subgoals[index : index + 1], np.zeros(1, np.float32)
                )[0]
