"""Follow both layers through one rescue: what SGN puts out, what becomes of it, and what INR and EXR pay for it."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, rewards, sample_scene
from lunar_rescue.physics.robot import JOINT_NAMES
from lunar_rescue.rewards import TERMS
from lunar_rescue.tasks import SMALLEST_ERROR
from reproduce.analysis.runs import Run, reference_runs
from reproduce.hrl_dcs.config import HierarchicalConfig, HierarchicalPolicyConfig
from reproduce.hrl_dcs.policy import HierarchicalPolicy, load_hierarchical_policy, network_sizes
from reproduce.hrl_dcs.subgoals import MILESTONES, SHARED_TERMS, arm_ends
from reproduce.learning.networks import NetworkSpec
from reproduce.learning.policy import Actions, Observations, begin_episode
from reproduce.storage.files import read_json
from reproduce.storage.paths import RESULTS
from reproduce.storage.records import from_dict

TRIES = 10  # scenes among which a rescue is looked for
APPROACH = "approach to the sub-goal"  # INR's own first term
_NAMES = [term.name for term in TERMS]
_SHARED, _MILESTONES = ([_NAMES[index] for index in which] for which in (SHARED_TERMS, MILESTONES))


class ObservedPolicy(HierarchicalPolicy):
    """A policy of two layers that also says what LLN would put out without a sub-goal."""

    with_goal: Actions  # LLN's outputs (n, JOINTS) in [-1, 1]
    without_goal: Actions  # the same where its sub-goal is the place at which the arm ends already are

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return LLN's outputs (n, JOINTS), see ``HierarchicalPolicy``, and note both kinds."""
        memory = self.low.copy()
        memory.forget(starts)
        self.with_goal = super().outputs(observations, starts)
        rows = np.arange(len(observations))
        idle = self.high.goals.view(observations, arm_ends(observations), np.zeros(len(rows), np.float32))
        self.without_goal = memory.act(idle, rows)
        return self.with_goal


@dataclass(frozen=True)
class Trace:
    """One rescue, step by step, as both layers lived it."""

    scene: Scene
    ending: str  # "rescued", or what it failed by
    interval: int  # N, steps between sub-goals
    reach: float  # furthest that a sub-goal leads along an axis [m]
    steps: pd.DataFrame  # a row a step: EXR, INR with its terms, and how far each arm end is from its sub-goal [m]
    commands: NDArray[np.float32]  # SGN's outputs at each step, (steps, 2, 3) in [-1, 1]
    subgoals: NDArray[np.float32]  # in the base frame, (steps, 2, 3) [m]
    actions: NDArray[np.float32]  # of the environment, (steps, JOINTS)
    outputs: NDArray[np.float32]  # LLN's with its sub-goal and without, (steps, 2, JOINTS)

    @property
    def decided(self) -> list[int]:
        """Return the steps at which SGN set a sub-goal."""
        return list(range(0, len(self.steps), self.interval))

    def decisions(self) -> pd.DataFrame:
        """Return a row a sub-goal: both ways to it [m] when it was set and when it ended, and the EXR in between."""
        rows = []
        for begin in self.decided:
            part = self.steps.iloc[begin : begin + self.interval]
            first, last = part.iloc[0], part.iloc[-1]
            ways = {f"{arm} {when} [m]": row[f"{key} {arm}"] for arm in "AB" for when, row, key in (
                ("before", first, "before"), ("after", last, "after"))}  # fmt: skip
            rows.append({"step": begin, **ways, "EXR": part["EXR"].sum(), "INR": part["INR"].sum()})
        return pd.DataFrame(rows).set_index("step")

    def commanded(self, steps: list[int]) -> pd.DataFrame:
        """Return what SGN put out at these steps, six numbers each, and the sub-goals that it means [m]."""
        keys = [f"{arm} {axis}" for arm in "AB" for axis in "xyz"]
        parts = {"SGN's output": self.commands, "sub-goal [m]": self.subgoals}
        tables = {title: pd.DataFrame(p[steps].reshape(-1, 6), steps, keys) for title, p in parts.items()}
        return pd.concat(tables, axis=1).rename_axis("step")

    def effect_of_the_subgoal(self) -> pd.DataFrame:
        """Return, by joint, how large LLN's outputs are and how far the sub-goal alone moves them, means in [0, 2]."""
        with_goal, without = self.outputs[:, 0], self.outputs[:, 1]
        means = {"LLN's output": np.abs(with_goal), "of it by the sub-goal": np.abs(with_goal - without)}
        names = [name.replace("_", " ") for name in JOINT_NAMES]
        return pd.DataFrame({title: values.mean(axis=0) for title, values in means.items()}, names)


def tell_decisions(trace: Trace) -> str:
    """Say how far away sub-goals were when they were set and when they ended."""
    table = trace.decisions()
    before, after = (100 * table[[f"A {when} [m]", f"B {when} [m]"]].to_numpy().mean() for when in ("before", "after"))
    return (
        f"{len(table)} decisions in {len(trace.steps)} steps; an arm end is {before:.1f} cm on average from its "
        f"sub-goal when it is set and {after:.1f} cm when it is replaced, {trace.interval} steps on. "
        f"The end: {trace.ending}."
    )


def tell_rewards(trace: Trace) -> str:
    """Say what either layer was paid for the rescue."""
    sums = trace.steps.sum()
    return (
        f"Over the rescue LLN is paid {sums['INR']:+.2f} in INR, {sums[APPROACH]:+.2f} of it for coming nearer to its "
        f"sub-goals; SGN is paid {sums['EXR']:+.2f} in EXR."
    )


def tell_effect(trace: Trace) -> str:
    """Say how much of LLN's outputs is owed to its sub-goal."""
    size, moved = trace.effect_of_the_subgoal().mean()
    return f"With no way to go, LLN's outputs differ by {moved:.2g} on average; their size is {size:.2g}, of at most 1."


def layer_table(config: HierarchicalPolicyConfig, units: int) -> pd.DataFrame:
    """Return a row a layer: how often it acts, what it sees, remembers and puts out, and its parameters."""
    rows = {}
    for level, (sees, acts) in network_sizes(config).items():
        network = NetworkSpec(sees, acts, hidden_units=units, bounded_mean=level == "sgn").build()
        rows[level.upper()] = {
            "acts": f"every {config.interval} steps" if level == "sgn" else "every step",
            "sees": sees,
            "hidden state": network.lstm_actor.hidden_size,
            "cell state": network.lstm_actor.hidden_size,
            "puts out": acts,
            "parameters": sum(p.numel() for p in network.parameters()),
        }
    return pd.DataFrame(rows).T


def parameter_table(config: HierarchicalPolicyConfig, units: int) -> pd.DataFrame:
    """Return every parameter of both networks with its shape."""
    rows = [
        {"layer": level.upper(), "parameter": name, "shape": "x".join(map(str, p.shape)), "numbers": p.numel()}
        for level, sizes in network_sizes(config).items()
        for name, p in NetworkSpec(*sizes, hidden_units=units, bounded_mean=level == "sgn").build().named_parameters()
    ]
    return pd.DataFrame(rows).set_index(["layer", "parameter"])


def best_two_layer_run(results: Path = RESULTS) -> Run | None:
    """Return the reference run of two layers that rescues most often on test scenes, or None where there is none."""
    return best_two_layers(reference_runs(results))


def best_two_layers(runs: list[Run]) -> Run | None:
    """Return the trained run of two layers that rescues most often on test scenes, or None where there is none."""
    two_layers = [run for run in runs if run.origin and run.method.startswith("hrl_dcs")]
    return max(two_layers, key=lambda run: run.evaluation["success_rate"] if run.evaluation else -1.0, default=None)


def follow(folder: Path, first_seed: int, tries: int = TRIES) -> Trace:
    """Return a two-layer policy's first rescue among ``tries`` scenes, or the first scene where it rescues nobody.

    ``folder`` is its run folder. A folder without a sound policy or configuration is a ``UserError``.
    """
    path = folder / "config.json"
    config = from_dict(HierarchicalConfig, read_json(path, "configuration").get("training"), f"{path}: training: ")
    trained = load_hierarchical_policy(folder)
    policy = ObservedPolicy(*trained.networks, trained.layers)
    with closing(LunarRescueEnv(weights=config.reward)) as env:
        first = trace = _act_out(env, policy, config, sample_scene(first_seed))
        for seed in range(first_seed + 1, first_seed + tries):
            if trace.ending == "rescued":
                break
            trace = _act_out(env, policy, config, sample_scene(seed))
    return trace if trace.ending == "rescued" else first


def _act_out(env: LunarRescueEnv, policy: ObservedPolicy, config: HierarchicalConfig, scene: Scene) -> Trace:
    """Act one rescue out and note everything."""
    observation, start, done = begin_episode(env, policy, scene), np.array([True]), False
    rows: list[dict[str, float]] = []
    seen: dict[str, list[NDArray[Any]]] = {key: [] for key in ("commands", "subgoals", "actions", "outputs")}
    while not done:
        action = policy.act(observation[None], start)[0]
        subgoal = policy.overlay()["sub-goal"][0]
        before = _ways(observation, subgoal)
        observation, exr, terminated, truncated, info = env.step_flat(action)
        rows.append(_step(config, before, _ways(observation, subgoal), exr, info["reward_terms"]))
        outputs = np.stack([policy.with_goal[0], policy.without_goal[0]])
        for key, value in zip(seen, (policy.commands()[0], subgoal, action, outputs), strict=True):
            seen[key].append(value)
        start, done = np.array([False]), terminated or truncated
    ending = "rescued" if info["is_success"] else f"failed by {info['failure']}".replace("_", " ")
    noted = {key: np.stack(values) for key, values in seen.items()}
    return Trace(scene, ending, config.hierarchy.interval, config.goals.reach, pd.DataFrame(rows), **noted)


def _ways(observation: Observations, subgoal: NDArray[Any]) -> NDArray[np.float64]:
    """Return how far both arm ends are from their sub-goals, (2,) [m]."""
    way = arm_ends(observation[None]).reshape(2, 3).astype(np.float64) - subgoal
    return np.linalg.norm(way, axis=1)


def _step(
    config: HierarchicalConfig, before: NDArray[Any], after: NDArray[Any], exr: float, terms: dict[str, float]
) -> dict[str, float]:
    """Return a step's EXR and INR, Eq. 2 towards the sub-goal as ``SubGoalVecEnv`` pays it, and both arms' ways."""
    two = config.hierarchy
    near, far = after + SMALLEST_ERROR, before + SMALLEST_ERROR
    paid = {APPROACH: rewards.approach(far, near, beta=two.beta, form=two.form)}
    paid |= {name.replace("_", " "): terms[name] for name in _SHARED}
    if config.priors.milestone_share:
        paid["share of milestones"] = config.priors.milestone_share * sum(terms[name] for name in _MILESTONES)
    ways = {
        f"{when} {arm}": float(d)
        for when, way in (("before", before), ("after", after))
        for arm, d in zip("AB", way, strict=True)
    }
    return {"EXR": exr, "INR": sum(paid.values()), **paid, **ways}
