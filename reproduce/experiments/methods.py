"""One registry of methods: a name, how it trains, how it acts. Commands, notebooks and tests loop over it.

What trains and acts needs PyTorch, which takes seconds to import, so it is imported when a method is first used.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from reproduce.experiments.presets import CHOSEN, TRIALS, Changes, check_preset, configuration
from reproduce.storage.errors import UserError
from reproduce.storage.paths import CHECKPOINT, REFERENCE, RESULTS

if TYPE_CHECKING:
    from reproduce.learning.config import TrainingConfig
    from reproduce.learning.policy import Policy
    from reproduce.learning.training import Training


class Parts(NamedTuple):
    """What a method is made of, once it is imported."""

    act: Callable[[Any], Policy]  # makes the policy from a run folder (trained methods) or a seed
    train: Callable[[Any, int], Training] | None = None  # from configuration and seed; None where nothing is learnt
    kind: type[TrainingConfig] | None = None  # class of its configuration


@cache
def _two_layers() -> Parts:
    from reproduce.hrl_dcs.config import HierarchicalConfig
    from reproduce.hrl_dcs.policy import load_hierarchical_policy
    from reproduce.hrl_dcs.training import HierarchicalTraining

    return Parts(load_hierarchical_policy, HierarchicalTraining, HierarchicalConfig)


@cache
def _flat() -> Parts:
    from reproduce.baselines.recurrent_ppo import FlatTraining, load_flat_policy
    from reproduce.learning.config import RecurrentConfig

    return Parts(load_flat_policy, FlatTraining, RecurrentConfig)


@cache
def _feudal() -> Parts:
    from reproduce.baselines.feudal.network import FeudalConfig
    from reproduce.baselines.feudal.training import FunTraining, load_feudal_policy

    return Parts(load_feudal_policy, FunTraining, FeudalConfig)


@cache
def _sac() -> Parts:
    from reproduce.baselines.sac import SacTraining, SacTrainingConfig, load_sac_policy

    return Parts(load_sac_policy, SacTraining, SacTrainingConfig)


@cache
def _sac_demos() -> Parts:
    from reproduce.baselines.sac_demos import SacDemosConfig, SacDemosTraining, load_sac_demos_policy

    return Parts(load_sac_demos_policy, SacDemosTraining, SacDemosConfig)


@cache
def _scripted() -> Parts:
    from reproduce.baselines.scripted import ScriptedPolicy

    return Parts(lambda _: ScriptedPolicy())


@cache
def _planner() -> Parts:
    from reproduce.baselines.planner.planner import PlannerPolicy

    return Parts(lambda _: PlannerPolicy())


@cache
def _random() -> Parts:
    from reproduce.baselines.scripted import RandomPolicy

    return Parts(RandomPolicy)


@dataclass(frozen=True)
class Method:
    """One method: how it is trained and how it acts."""

    name: str  # as on the command line
    title: str  # as in tables
    about: str  # one sentence
    parts: Callable[[], Parts]  # imports what it trains and acts with
    learns: bool = True  # whether it has to be trained
    changes: Changes = field(default_factory=dict)  # what it changes of every preset, see ``presets.changed``
    paper_success: float | None = None  # success rate in the paper's Table 1

    @property
    def act(self) -> Callable[[Any], Policy]:
        """Return what makes its policy, from a run folder or, where nothing is learnt, a seed."""
        return self.parts().act

    @property
    def train(self) -> Callable[[Any, int], Training] | None:
        """Return what makes its training from configuration and seed; None where nothing is learnt."""
        return self.parts().train if self.learns else None

    @property
    def kind(self) -> type[TrainingConfig]:
        """Return the class of its configuration."""
        from reproduce.learning.config import TrainingConfig

        return self.parts().kind or TrainingConfig

    def check_learns(self) -> None:
        """Refuse a method that cannot be trained."""
        if not self.learns:
            raise UserError(f"method: {self.name!r} does not learn; evaluate it as it is")

    def config(self, preset: str) -> Any:
        """Return this method's configuration, a ``kind``, in a preset."""
        check_preset(preset)
        return configuration(self.kind, preset, self.changes)


_CHOSEN = {method: TRIALS[method][trial] for method, trial in CHOSEN.items()}
_TWO_LAYERS = partial(Method, parts=_two_layers)
_DEMONSTRATIONS: Changes = {"priors.demonstrations": True, "priors.way_in": True}
#: Of recurrent methods that begin from demonstrations: they end with imitation, as nothing after it helped them.
_IMITATION: Changes = {**_DEMONSTRATIONS, "steps": 0}
_SAC = partial(Method, parts=_sac)
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
            "both layers imitate the planner's rescues by hindsight, LLN sees the joint step; not in the paper",
            changes={**_IMITATION, "priors.joint_step": True, "goals.seen": "place"},
        ),
        Method(
            "fun",
            "FeUdal Networks",
            "Manager and Worker with goals in a learnt space, for continuous actions",
            _feudal,
            changes=_CHOSEN["fun"],
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
            _flat,
            changes=_CHOSEN["ppo_lstm"],
        ),
        Method(
            "ppo_lstm_demos",
            "Recurrent PPO, demonstrations",
            "one recurrent network imitates the planner's rescues; not in the paper",
            _flat,
            changes=_IMITATION,
        ),
        Method(
            "sac_demos",
            "Off-policy, demonstrations",
            "flat TD3 with the planner's rescues in its buffer, after imitating them; not in the paper",
            _sac_demos,
            changes={**_DEMONSTRATIONS, "imitation.epochs": 25, "off_policy.hidden_units": 512, "steps": 600_000},
        ),
        Method("scripted", "Script with IK", "inverse kinematics and way-points, no learning", _scripted, learns=False),
        Method(
            "planner",
            "Planner, knows all",
            "knows the scene and tries plans out in a copy of the simulator before it acts, no learning",
            _planner,
            learns=False,
        ),
        Method("random", "Random actions", "uniform actions, the floor of every comparison", _random, learns=False),
    )
}


def get_method(name: str) -> Method:
    """Look a method up; ``UserError`` lists the known ones."""
    if name not in METHODS:
        raise UserError(f"method: expected one of {', '.join(METHODS)}; got {name!r}")
    return METHODS[name]


def check_run_folder(folder: Path, resume: bool = False) -> None:
    """Refuse, by the names of its files alone, a folder in which no training can begin, or go on with ``resume``."""
    config, checkpoint = ((folder / name).is_file() for name in ("config.json", CHECKPOINT))
    if (folder / "run.json").exists():
        advice = "nothing is left to resume" if resume else "choose another --out"
        raise UserError(f"{folder}: holds a finished run; {advice}")
    if not resume and checkpoint:
        raise UserError(f"{folder}: holds an unfinished run; go on with --resume, or choose another --out")
    if resume and not config and not checkpoint:
        raise UserError(f"{folder}: no checkpoint to resume from")


def check_actor(where: str | Path) -> None:
    """Refuse what is neither a folder nor a method that does not learn, before anything large is imported.

    Raises:
        UserError: The message names what there is and the nearest of it.
    """
    name, fixed = str(where), [method.name for method in METHODS.values() if not method.learns]
    if Path(where).exists() or name in fixed:
        return
    runs = sorted(str(path.parent) for path in (RESULTS / REFERENCE).glob("*/seed*/policy.json"))
    near = difflib.get_close_matches(name, [*fixed, *runs, *METHODS], n=1)
    guess = f"; did you mean {near[0]}?" if near else ""
    raise UserError(
        f"{name}: no such run folder; expected one, such as {', '.join(runs) or 'one that train has written'}, "
        f"or a method that does not learn, {', '.join(fixed)}{guess}"
    )


def load_policy(folder: Path) -> tuple[Method, Policy]:
    """Return the method and the policy of a run folder."""
    from reproduce.storage.policies import read_policy_json

    name, learning = read_policy_json(folder)["method"], [m for m, method in METHODS.items() if method.learns]
    if name not in learning:
        raise UserError(f"{folder / 'policy.json'}: method: expected one of {', '.join(learning)}; got {name!r:.60}")
    return METHODS[name], METHODS[name].act(folder)
