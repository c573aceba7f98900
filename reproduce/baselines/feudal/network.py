"""Percept, Manager and Worker as one SB3 policy: step by step for acting, whole sequences at once for learning."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.distributions import Normal
from torch.nn import functional

from lunar_rescue.scenes.records import checked
from reproduce.baselines.feudal.levels import Manager, Worker
from reproduce.learning.config import RecurrentConfig, Share
from reproduce.learning.networks import NoOptimizer, StateEncoder, flat_box, flat_spaces
from reproduce.storage.policies import Spec
from reproduce.storage.records import Units

#: c and r; the bound is what a policy file may make us allocate.
Horizon = Annotated[int, Field(ge=1, le=1000)]


@checked
@dataclass(frozen=True)
class FunConfig:
    """Sizes and weights of Manager and Worker."""

    horizon: Horizon = 10  # c, steps that a goal looks ahead and goals are pooled over, and r, the LSTM's groups
    goal_size: Units = 256  # d, size of Manager's state s and of a goal, and so the units of the dilated LSTM; FuN's
    embedding_size: Units = 16  # k, size of a goal as Worker sees it; FuN's
    # alpha, weight of the intrinsic reward in Worker's. It is paid at each step, so a large one pays for not
    # finishing (with 0.5 none did): about a tenth of it (`fun_intrinsic` in `progress.csv` is the mean before the
    # weight) must stay under what the time bonus loses in a step.
    intrinsic_weight: NonNegativeFloat = 0.05
    random_goals: Share = 0.05  # epsilon, share of steps with a random goal instead of Manager's; FuN says only "small"
    manager_gamma: Share = 0.99  # Manager's discount, Worker's is `LearnerConfig.gamma`; both: paper, section 4.1
    manager_gae_lambda: Share = 0.95  # Lambda of Manager's advantages; not in FuN, which has n-step returns; as for SGN
    concentration: NonNegativeFloat = 1.0  # kappa of von Mises-Fisher; 1 makes the first gradient that of Eq. 7


@checked
@dataclass(frozen=True)
class FeudalConfig(RecurrentConfig):
    """A training of Manager and Worker."""

    fun: FunConfig = field(default_factory=FunConfig)  # What only FeUdal Networks have


class Memory(NamedTuple):
    """What is carried from step to step, for n environments; stepping changes it in place."""

    clock: th.Tensor  # steps since the episode began, (n,)
    manager: th.Tensor  # hidden and cell state of each group of the dilated LSTM, (n, 2, r, d)
    worker: th.Tensor  # hidden and cell state of Worker's LSTM, (n, 2, h)
    goals: th.Tensor  # the last c goals sent to Worker, (n, c, d); the goal of step t is at t mod c

    def forget(self, starts: th.Tensor) -> None:
        """Empty the memory of environments (n,) that begin an episode."""
        if bool(starts.any()):
            for part in self:
                part[starts] = 0

    def copy(self, rows: Any = slice(None)) -> Memory:
        """Return the memory of some environments, in tensors of its own."""
        return Memory(*(part[rows].clone() for part in self))


@dataclass(frozen=True)
class Step:
    """What both levels put out in one step of n environments."""

    actions: th.Tensor  # Worker's, as drawn, (n, a)
    log_probs: th.Tensor  # logarithm of the actions' probability density, (n,)
    goals: th.Tensor  # goals sent to Worker, random ones among them, (n, d)
    own_goals: th.Tensor  # goals that Manager set, (n, d)
    pooled: th.Tensor  # sum of the last c goals, (n, d)
    worker_values: th.Tensor  # V^D, (n,)
    manager_values: th.Tensor  # V^M, (n,)


@checked
@dataclass(frozen=True)
class FunSpec(Spec):
    """Sizes, which are all that is needed to build the network."""

    goal_size: Units  # d, size of a goal
    embedding_size: Units  # k, size of a goal as Worker sees it
    horizon: Horizon  # c and r, see `FunConfig`

    def build(self) -> FunNetwork:
        """Make a network of these sizes, not trained."""
        sizes = asdict(self)
        seen, acts = flat_spaces(sizes.pop("observations"), sizes.pop("actions"))
        return FunNetwork(seen, acts, lambda _: 0.0, optimizer_class=NoOptimizer, **sizes)


class FunNetwork(BasePolicy):
    """Percept, Manager and Worker as one SB3 policy."""

    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self,
        seen: spaces.Box,
        acts: spaces.Box,
        lr_schedule: Schedule,
        log_std_init: float = 0.0,
        optimizer_class: Any = th.optim.Adam,
        **sizes: int,
    ) -> None:
        """Build it for observations (o,) and actions (a,); ``sizes`` are those that ``FunSpec`` has besides."""
        boxes = flat_box("observation_space", seen), flat_box("action_space", acts)
        super().__init__(*boxes, optimizer_class=optimizer_class)
        self.spec = spec = FunSpec(seen.shape[0], acts.shape[0], **sizes)
        self.percept = StateEncoder(seen, spec.hidden_units)
        self.percept.apply(lambda module: self.init_weights(module, gain=float(np.sqrt(2.0))))
        self.manager = Manager(seen, spec.hidden_units, spec.goal_size, spec.horizon)
        self.worker = Worker(seen, spec.actions, spec.hidden_units, spec.goal_size, spec.embedding_size, spec.horizon)
        self.log_std = nn.Parameter(th.full((spec.actions,), log_std_init))
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    # -- one step ------------------------------------------------------------------------------------------------------
    def empty_memory(self, count: int) -> Memory:
        """Return the memory of ``count`` environments that begin an episode."""
        c, d = self.spec.horizon, self.spec.goal_size
        clock, worker = th.zeros(count, dtype=th.int64), th.zeros(count, 2, self.spec.hidden_units)
        return Memory(clock, th.zeros(count, 2, c, d), worker, th.zeros(count, c, d))

    @th.no_grad()
    def step(
        self, observations: th.Tensor, memory: Memory, deterministic: bool = False, random_goals: float = 0.0
    ) -> Step:
        """Act once on observations (n, o), by the mean if ``deterministic``; ``random_goals`` is epsilon.

        The memory is changed in place; forget episodes that ended first.
        """
        z = self.percept(observations)
        raw = self.manager.core.step(self.manager.space(z), memory.manager, memory.clock)
        own = functional.normalize(raw, dim=-1)
        goals = own
        if random_goals > 0.0:  # a goal's norm stays 1
            random = functional.normalize(th.randn_like(own), dim=-1)
            goals = th.where(th.rand(len(own), 1) < random_goals, random, own)
        memory.goals[th.arange(goals.shape[0]), memory.clock % self.spec.horizon] = goals
        pooled = memory.goals.sum(1)
        before = memory.worker
        output, after = self.worker.core(z[None], (before[None, :, 0].contiguous(), before[None, :, 1].contiguous()))
        before[:, 0], before[:, 1] = after[0][0], after[1][0]
        memory.clock.add_(1)
        mean = self.worker.mean(output[0], pooled)
        distribution = self.distribution(mean)
        actions = mean if deterministic else distribution.sample()
        return Step(
            actions=actions,
            log_probs=distribution.log_prob(actions).sum(-1),
            goals=goals,
            own_goals=own,
            pooled=pooled,
            worker_values=self.worker.value(observations, output[0], pooled),
            manager_values=self.manager.value(observations, raw),
        )

    def distribution(self, mean: th.Tensor) -> Normal:
        """Return the distribution of actions around their mean (n, a), each dimension by itself."""
        return Normal(mean, self.log_std.exp().expand_as(mean))

    def states(self, observations: th.Tensor) -> th.Tensor:
        """Map observations (..., o) to Manager's states s (..., d), which have no memory."""
        states: th.Tensor = self.manager.space(self.percept(observations))
        return states

    # -- whole sequences -----------------------------------------------------------------------------------------------
    def set_goals(
        self, observations: th.Tensor, state: th.Tensor, clock: th.Tensor, mask: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return Manager's goals (m, d) and values (m,) at the m real steps, by ``mask``, of sequences (l, n, o).

        Before each, the dilated LSTM is in ``state`` (n, 2, r, d), ``clock`` (n,) steps after the episode's beginning.
        """
        raw = self.manager.core(self.states(observations), state, clock)[mask]
        return functional.normalize(raw, dim=-1), self.manager.value(observations[mask], raw)

    def act_towards(
        self, observations: th.Tensor, state: tuple[th.Tensor, th.Tensor], mask: th.Tensor, pooled: th.Tensor
    ) -> tuple[Normal, th.Tensor]:
        """Return Worker's distribution of actions and values (m,) at the m real steps, by ``mask``, of sequences.

        Worker's LSTM begins in ``state``, each (1, n, h); ``pooled`` (m, d) sums the last c goals at the real steps.
        """
        memory = self.worker.core(self.percept(observations), state)[0][mask]
        mean = self.worker.mean(memory, pooled)
        return self.distribution(mean), self.worker.value(observations[mask], memory, pooled)

    # -- as SB3 asks ---------------------------------------------------------------------------------------------------
    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """Return actions and the memory after them; see SB3. Without ``state`` every call begins an episode."""
        self.set_training_mode(False)
        seen, several = self.obs_to_tensor(observation)
        assert isinstance(seen, th.Tensor)
        observations = seen.float()
        memory = self.empty_memory(len(observations))
        if state is not None:
            memory = Memory(*(th.tensor(part) for part in state))
        if episode_start is not None:
            memory.forget(th.as_tensor(np.asarray(episode_start, bool)))
        drawn = self.step(observations, memory, deterministic).actions.numpy()
        actions = np.clip(drawn, self.action_space.low, self.action_space.high)
        return actions if several else actions[0], tuple(part.numpy() for part in memory)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Return the first actions (n, a) of episodes."""
        assert isinstance(observation, th.Tensor)
        return self.step(observation.float(), self.empty_memory(len(observation)), deterministic).actions
