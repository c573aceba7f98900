"""One registry of methods: a name, how it trains, how it acts. Commands, notebooks and tests loop over it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from torch import nn

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.feudal.policy import FunPolicy, load_network
from reproduce.baselines.feudal.training import FunTraining
from reproduce.baselines.planner.policy import PlannerPolicy
from reproduce.baselines.random import RandomPolicy
from reproduce.baselines.recurrent_ppo import FlatTraining
from reproduce.baselines.sac import SacPolicy, SacSpec, SacTraining
from reproduce.baselines.scripted import ScriptedPolicy
from reproduce.experiments.trials import tuned
from reproduce.hrl_dcs.policy import FlatPolicy, HierarchicalPolicy
from reproduce.hrl_dcs.subgoals import LLN_SIZE, MEANINGS, SUBGOAL_SIZE
from reproduce.hrl_dcs.training import HierarchicalTraining
from reproduce.learning.config import PRESETS, TrainingConfig
from reproduce.learning.policy import Policy
from reproduce.storage.checkpoint import Learner
from reproduce.storage.errors import UserError
from reproduce.storage.policies import Spec, load_networks, read_policy_json, save_policy


class Training(Protocol):
    """A training under way."""

    config: TrainingConfig

    @property
    def learners(self) -> Mapping[str, Learner]:
        """Learners by level."""
        ...

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        ...

    def restart(self, update: int) -> None:
        """Begin new episodes, as after a checkpoint."""
        ...

    def update(self, done: int) -> dict[str, Any]:
        """Collect and learn once; return a row of ``progress.csv``."""
        ...

    def networks(self) -> Mapping[str, tuple[Spec, nn.Module]]:
        """What acts, by level: how to build it, and it."""
        ...

    def policy_metadata(self) -> dict[str, Any]:
        """What else is needed to act, plain data."""
        ...

    def close(self) -> None:
        """Stop the environments."""
        ...


@dataclass(frozen=True)
class Method:
    """One method.

    Attributes:
        name: As on the command line.
        title: As in tables.
        about: One sentence.
        train: Makes a training from configuration and seed; None for a method that does not learn.
        act: Makes the policy from a run folder (trained methods) or a seed.
        sizes: For each level the sizes of observation and action.
        adapt: Changes a preset's configuration to this method's.
        parts: Parts of the configuration that it reads, besides what all have.
        paper_success: Success rate in the paper's Table 1, or None.
    """

    name: str
    title: str
    about: str
    act: Callable[[Any], Policy]
    train: Callable[[TrainingConfig, int], Training] | None = None
    sizes: dict[str, tuple[int, int]] | None = None
    adapt: Callable[[TrainingConfig], TrainingConfig] = lambda config: config
    parts: tuple[str, ...] = ("low", "reward")
    paper_success: float | None = None

    def config(self, preset: str) -> TrainingConfig:
        """This method's configuration in a preset."""
        if preset not in PRESETS:
            raise UserError(f"preset: expected one of {', '.join(PRESETS)}; got {preset!r}")
        return self.adapt(PRESETS[preset])


_TWO_LEVELS = {"sgn": (SIZE, SUBGOAL_SIZE), "lln": (LLN_SIZE, JOINTS)}
_ONE_LEVEL = {"policy": (SIZE, JOINTS)}
_ACTOR = {"actor": (SIZE, JOINTS)}
_LARGE_BUFFER = 1_000_000  # transitions, SB3's default


def _act_hierarchical(folder: Path) -> Policy:
    interval = read_policy_json(folder).get("interval")
    if isinstance(interval, bool) or not isinstance(interval, int) or interval < 1:
        raise UserError(f"{folder / 'policy.json'}: interval: expected an integer >= 1, got {interval!r}")
    subgoals = read_policy_json(folder).get("subgoals")
    if subgoals not in MEANINGS:
        raise UserError(f"{folder / 'policy.json'}: subgoals: expected one of {MEANINGS}, got {subgoals!r}")
    networks = load_networks(folder, _TWO_LEVELS)
    return HierarchicalPolicy(networks["sgn"], networks["lln"], interval, subgoals, _mirrored(folder))


def _act_flat(folder: Path) -> Policy:
    return FlatPolicy(load_networks(folder, _ONE_LEVEL)["policy"], _mirrored(folder))


def _act_feudal(folder: Path) -> Policy:
    return FunPolicy(load_network(folder, (SIZE, JOINTS)), _mirrored(folder))


def _act_sac(folder: Path) -> Policy:
    return SacPolicy(load_networks(folder, _ACTOR, SacSpec)["actor"], _mirrored(folder))


def _with_large_buffer(config: TrainingConfig) -> TrainingConfig:
    return replace(config, sac=replace(config.sac, buffer_size=_LARGE_BUFFER))


def _mirrored(folder: Path) -> bool:
    mirrored = read_policy_json(folder).get("mirrored")
    if not isinstance(mirrored, bool):
        raise UserError(f"{folder / 'policy.json'}: mirrored: expected true or false, got {mirrored!r}")
    return mirrored


METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method(
            "hrl_dcs",
            "HRL-DCS",
            "the paper's method: SGN and LLN, AAPF reward",
            _act_hierarchical,
            HierarchicalTraining,
            _TWO_LEVELS,
            parts=("low", "high", "hierarchy", "reward"),
            paper_success=0.986,
        ),
        Method(
            "hrl_dcs_no_aapf",
            "HRL-DCS w/o AAPF",
            "the ablation: contact reward in place of the AAPF term, nothing else changed",
            _act_hierarchical,
            HierarchicalTraining,
            _TWO_LEVELS,
            parts=("low", "high", "hierarchy", "reward"),
            adapt=lambda config: replace(config, obstacle_reward="contact"),
            paper_success=0.873,
        ),
        Method(
            "fun",
            "FeUdal Networks",
            "Manager and Worker with goals in a learnt space, for continuous actions",
            _act_feudal,
            FunTraining,
            {"fun": (SIZE, JOINTS)},
            parts=("low", "fun", "reward"),
            adapt=partial(tuned, "fun"),
            paper_success=0.918,
        ),
        Method(
            "sac",
            "SAC",
            "flat SAC on the environment's reward, with the paper's toolkit's replay buffer",
            _act_sac,
            SacTraining,
            _ACTOR,
            parts=("sac", "reward"),
            adapt=partial(tuned, "sac"),
        ),
        Method(
            "sac_large_buffer",
            "SAC, large buffer",
            "the same with SB3's usual replay buffer of a million transitions; not in the paper",
            _act_sac,
            SacTraining,
            _ACTOR,
            parts=("sac", "reward"),
            adapt=lambda config: _with_large_buffer(tuned("sac", config)),
        ),
        Method(
            "ppo_lstm",
            "Recurrent PPO",
            "one recurrent network on the environment's reward; not in the paper",
            _act_flat,
            FlatTraining,
            _ONE_LEVEL,
            adapt=partial(tuned, "ppo_lstm"),
        ),
        Method(
            "scripted",
            "Script with IK",
            "inverse kinematics and way-points, no learning",
            lambda _: ScriptedPolicy(),
        ),
        Method(
            "planner",
            "Planner, knows all",
            "knows the scene and tries plans out in a copy of the simulator before it acts, no learning",
            lambda _: PlannerPolicy(),
        ),
        Method("random", "Random actions", "uniform actions, the floor of every comparison", RandomPolicy),
    )
}


def get_method(name: str) -> Method:
    """Look a method up; ``UserError`` lists the known ones."""
    if name not in METHODS:
        raise UserError(f"method: expected one of {', '.join(METHODS)}; got {name!r}")
    return METHODS[name]


def load_policy(folder: Path) -> tuple[Method, Policy]:
    """The method and policy of a run folder."""
    name = read_policy_json(folder)["method"]
    if name not in METHODS:
        raise UserError(f"{folder / 'policy.json'}: method: expected one of {', '.join(METHODS)}; got {name!r}")
    return METHODS[name], METHODS[name].act(folder)


def export_policy(folder: Path, method: Method, training: Training) -> None:
    """Write what is needed to act."""
    extra = {"mirrored": training.config.mirrored, **training.policy_metadata()}
    save_policy(folder, method.name, training.networks(), extra)
