"""`reproduce stress`: summaries worked by hand, and a small study that repeats and disturbs no undisturbed test."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from untrained import untrained_policy  # type: ignore[import-not-found]

from lunar_rescue import sample_scene
from lunar_rescue.disturbances import KINDS, NOTHING, disturbance
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.scenes.splits import VALIDATION
from reproduce.baselines.planner.planner import Plan, PlannerPolicy, RescuePlanner
from reproduce.experiments import stress as module
from reproduce.experiments.evaluate import find_policy, put_into, rescue_scenes, run_episode
from reproduce.experiments.stress import COLUMNS, Condition, conditions, known_kinds, stress, summarise_stress
from reproduce.storage.errors import UserError

SEED = VALIDATION.start


def row(kind: str, severity: str, seed: int, failure: str | None, simulator: str = "pybullet") -> dict[str, Any]:
    shape = {"kind": kind, "severity": severity, "simulator": simulator, "seed": seed}
    return {**shape, "success": failure is None, "failure": failure}


def test_a_summary_by_hand() -> None:
    rows = [row("none", "none", seed, "timeout" if seed == 4 else None) for seed in range(5)]
    rows += [row("delay", "middle", seed, None if seed in (3, 4) else "timeout") for seed in range(5)]
    rows += [row("simulator", "none", seed, "out_of_reach" if seed > 2 else None, "mujoco") for seed in range(5)]
    plain, delay, other = summarise_stress(pd.DataFrame(rows))
    assert (plain["tests"], plain["successes"], plain["kept"], plain["level"]) == (5, 4, 1.0, None)
    assert (delay["successes"], delay["lost"], delay["gained"], delay["kept"]) == (2, 3, 1, 0.25)
    assert (delay["level"], delay["unit"], delay["failures"]) == (2.0, "steps", {"timeout": 3})
    # Wilson's interval of 2 in 5, from a table.
    assert (delay["wilson_low"], delay["wilson_high"]) == (
        pytest.approx(0.1176, abs=1e-4),
        pytest.approx(0.7693, abs=1e-4),
    )
    assert (other["kind"], other["simulator"], other["lost"], other["failures"]) == (
        "simulator",
        "mujoco",
        1,
        {"out_of_reach": 2},
    )
    never = summarise_stress(pd.DataFrame([row("none", "none", 0, "timeout"), row("delay", "low", 0, None)]))
    assert [line["kept"] for line in never] == [None, None]


def test_kinds_are_chosen_by_name() -> None:
    assert known_kinds(None) == tuple(KINDS) and known_kinds(["none"]) == ()
    assert known_kinds(["torque", "delay"]) == tuple(name for name in KINDS if name in ("delay", "torque"))
    refused = call("stress", "scripted", "--kinds", "dely")
    assert refused.code == 2 and "--kinds: expected none, or some of" in refused.complaint


def test_each_kind_is_tried_at_three_severities_and_once_without(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    tried = conditions()
    assert tried[0] == ("none", "none", "pybullet") and tried[-1] == ("simulator", "none", "mujoco")
    assert len(tried) == 32 and Counter(c.severity for c in tried) == {"none": 2, "low": 10, "middle": 10, "high": 10}
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert conditions() == tried[:-1], "without MuJoCo the rest is tried"


@pytest.mark.process
def test_a_small_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = SEED + 2  # a rescue among two early ends: half the steps of the three scenes before
    summary = stress("scripted", 3, first, folder=tmp_path / "a", kinds=("delay", "torque"), tell=lambda _: None)
    rows = pd.read_csv(tmp_path / "a" / "scripted.csv")
    assert list(rows.columns[: len(COLUMNS)]) == COLUMNS and set(rows["method"]) == {"scripted"}
    assert rows.groupby(["kind", "severity"]).size().eq(3).all()
    plain = rows[rows["kind"] == "none"]
    expected = rescue_scenes("scripted", 3, first, quiet=True)
    for name in ("seed", "success", "steps", "posture", "task", "attitude"):
        assert plain[name].tolist() == [line[name] for line in expected], name
    late = rows[rows["kind"] == "delay"]["steps"].tolist()
    assert late != 3 * plain["steps"].tolist()
    monkeypatch.setattr(module, "CHUNK", 17)  # two scenes of eight conditions, then one
    stress("scripted", 3, first, folder=tmp_path / "b", kinds=("delay", "torque"), tell=lambda _: None, quiet=True)
    assert (tmp_path / "a" / "scripted.csv").read_bytes() == (tmp_path / "b" / "scripted.csv").read_bytes()
    written = json.loads((tmp_path / "a" / "scripted.json").read_text())
    assert (written["method"], written["split"], written["tests"]) == ("scripted", "validation", 3)
    assert written["conditions"] == summary["conditions"] and "commit" in written["origin"]
    assert "scripted.csv" in json.loads((tmp_path / "a" / "origins.json").read_text())


@pytest.mark.process
def test_the_planner_plans_a_scene_once_and_follows_the_plan_without_looking(monkeypatch: pytest.MonkeyPatch) -> None:
    planned: list[int] = []
    policy = PlannerPolicy(RescuePlanner(variants=1, approaches=1))
    plan = policy._planner.plan

    def count(scene: Any) -> Plan:
        planned.append(scene.seed)
        return plan(scene)

    monkeypatch.setattr(policy._planner, "plan", count)
    for seed in (SEED, SEED, SEED + 1):
        policy.prepare(sample_scene(seed))
    assert planned == [SEED, SEED + 1] and policy._step == 0
    policy.plan_in("pybullet")
    assert policy._scene is None, "in another simulator a plan is another"


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    for arguments, words in (
        (("nobody",), "nobody: no such run folder"),
        (("scripted", "--tests", "0"), "tests"),
        (("scripted", "--split", "trial"), "--split: expected one of"),
    ):
        refused = call("stress", *arguments, "--out", str(tmp_path / "none"))
        assert refused.code == 2 and words in refused.complaint
    with pytest.raises(UserError, match="tests: expected at least 1"):
        stress("scripted", 0, SEED, folder=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    assert Condition("delay", "low", "pybullet") in conditions()


@pytest.mark.process
@pytest.mark.parametrize("name", ["hrl_dcs", "fun", "sac", "ppo_lstm"])
def test_every_kind_of_policy_acts_under_disturbance_and_in_the_other_simulator(name: str, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    method, policy = find_policy(untrained_policy(name, tmp_path / "run"))
    assert method.name == name
    scene = sample_scene(SEED + 1)
    what = disturbance(scene, "position", "high")
    rows: dict[str, list[dict[str, Any]]] = {"pybullet": [], "mujoco": []}
    for simulator, found in rows.items():
        put_into(simulator, policy).close()
        with closing(DisturbedEnv(simulator=simulator, max_steps=12)) as env:
            for given in (NOTHING, what, what):
                found.append(run_episode(env, policy, scene, disturbance=given))
    for found in rows.values():
        assert found[1] == found[2], "the same scene, kind and severity"
        assert found[0]["return"] != found[1]["return"], "what is seen is acted upon"
    assert rows["pybullet"][0]["return"] != rows["mujoco"][0]["return"]
