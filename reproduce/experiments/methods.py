"""One registry of methods: a name, how it trains, how it acts. Commands, notebooks and tests loop over it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from reproduce.baselines.feudal.network import FeudalConfig
from reproduce.baselines.feudal.training import FunTraining, load_feudal_policy
from reproduce.baselines.planner.planner import PlannerPolicy
from reproduce.baselines.recurrent_ppo import FlatTraining, load_flat_policy
from reproduce.baselines.sac import SacTraining, SacTrainingConfig, load_sac_policy
from reproduce.baselines.scripted import RandomPolicy, ScriptedPolicy
from reproduce.experiments.presets import CHOSEN, TRIALS, Changes, configuration
from reproduce.hrl_dcs.config import HierarchicalConfig
from reproduce.hrl_dcs.policy import load_hierarchical_policy
from reproduce.hrl_dcs.training import HierarchicalTraining
from reproduce.learning.config import RecurrentConfig, TrainingConfig
from reproduce.learning.policy import Policy
from reproduce.learning.training import Training
from reproduce.storage.errors import UserError
from reproduce.storage.policies import read_policy_json


@dataclass(frozen=True)
class Method:
    """One method: how it is trained and how it acts."""

    name: str  # as on the command line
    title: str  # as in tables
    about: str  # one sentence
    act: Callable[[Any], Policy]  # makes the policy from a run folder (trained methods) or a seed
    train: Callable[[Any, int], Training] | None = None  # from configuration and seed; None where nothing is learnt
    kind: type[TrainingConfig] = TrainingConfig  # class of its configuration
    changes: Changes = field(default_factory=dict)  # what it changes of every preset, see ``presets.changed``
    paper_success: float | None = None  # success rate in the paper's Table 1

    def config(self, preset: str) -> Any:
        """Return this method's configuration, a ``kind``, in a preset."""
        return configuration(self.kind, preset, self.changes)


_CHOSEN = {method: TRIALS[method][trial] for method, trial in CHOSEN.items()}
_TWO_LAYERS = partial(Method, act=load_hierarchical_policy, train=HierarchicalTraining, kind=HierarchicalConfig)
#: Of methods that begin from demonstrations, which end with imitation as long as nothing after it helps.
_IMITATION: Changes = {"priors.demonstrations": True, "steps": 0}
_SAC = partial(Method, act=load_sac_policy, train=SacTraining, kind=SacTrainingConfig)
METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        _TWO_LAYERS("hrl_dcs", "HRL-DCS", "the paper's method: SGN and LLN, AAPF reward", paper_success=0.986),
        _TWO_LAYERS(
            "hrl_dcs_no_aapf",
            "HRL-DCS w/o AAPF",
            "the ablation: contact reward in place of the AAPF term, nothing else changed",
            changes={"obstacle_reward": "contact"},
            paper_success=0.873,
        ),
        _TWO_LAYERS(
            "hrl_dcs_demos",
            "HRL-DCS, demonstrations",
            "both layers imitate the planner's rescues by hindsight; not in the paper",
            changes=_IMITATION,
        ),
        Method(
            "fun",
            "FeUdal Networks",
            "Manager and Worker with goals in a learnt space, for continuous actions",
            load_feudal_policy,
            FunTraining,
            FeudalConfig,
            _CHOSEN["fun"],
            paper_success=0.918,
        ),
        _SAC(
            "sac",
            "SAC",
            "flat SAC on the environment's reward, with the paper's toolkit's replay buffer",
            changes=_CHOSEN["sac"],
        ),
        _SAC(
            "sac_large_buffer",
            "SAC, large buffer",
            "the same with SB3's usual replay buffer of a million transitions; not in the paper",
            changes={**_CHOSEN["sac"], "sac.buffer_size": 1_000_000},
        ),
        Method(
            "ppo_lstm",
            "Recurrent PPO",
            "one recurrent network on the environment's reward; not in the paper",
            load_flat_policy,
            FlatTraining,
            RecurrentConfig,
            _CHOSEN["ppo_lstm"],
        ),
        Method(
            "ppo_lstm_demos",
            "Recurrent PPO, demonstrations",
            "one recurrent network imitates the planner's rescues; not in the paper",
            load_flat_policy,
            FlatTraining,
            RecurrentConfig,
            _IMITATION,
        ),
        Method(
            "scripted", "Script with IK", "inverse kinematics and way-points, no learning", lambda _: ScriptedPolicy()
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
    """Return the method and the policy of a run folder."""
    name, learning = read_policy_json(folder)["method"], [m for m, method in METHODS.items() if method.train]
    if name not in learning:
        raise UserError(f"{folder / 'policy.json'}: method: expected one of {', '.join(learning)}; got {name!r:.60}")
    return METHODS[name], METHODS[name].act(folder)
