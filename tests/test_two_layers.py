"""What notebook 3 shows of a rescue is what the layers did, and the pictures are of the same rescue."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from untrained import untrained_policy  # type: ignore[import-not-found]

from lunar_rescue import LunarRescueEnv, sample_scene
from reproduce.analysis import two_layer_figures as figures
from reproduce.analysis.two_layers import (
    Trace,
    best_two_layer_run,
    follow,
    layer_table,
    parameter_table,
    tell_decisions,
    tell_effect,
    tell_rewards,
)
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.experiments.methods import METHODS
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_json
from reproduce.storage.records import to_dict

SEED = 2_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with an untrained policy of two layers."""
    folder = untrained_policy("hrl_dcs", tmp_path_factory.mktemp("two") / "hrl_dcs")
    write_json(folder / "config.json", {"training": to_dict(METHODS["hrl_dcs"].config("smoke"))})
    return folder


@pytest.fixture(scope="module")
def trace(run: Path) -> Trace:
    return follow(run, SEED, tries=1)


def test_a_followed_rescue_is_the_one_that_is_evaluated(run: Path, trace: Trace) -> None:
    row = run_episode(LunarRescueEnv(), find_policy(run)[1], sample_scene(SEED))
    assert len(trace.steps) == row["steps"]
    assert trace.ending == f"failed by {row['failure']}".replace("_", " ")
    assert trace.steps["EXR"].sum() == pytest.approx(row["return"], abs=1e-4)


def test_inr_is_paid_for_coming_nearer_to_the_subgoal(trace: Trace) -> None:
    step = trace.steps.iloc[7]
    ways = [step[f"before {arm}"] - step[f"after {arm}"] for arm in "AB"]
    expected = 2.0 * (math.exp(ways[0]) + math.exp(ways[1]) - 2.0) / 2.0
    assert step["approach to the sub-goal"] == pytest.approx(expected, rel=1e-3, abs=1e-7)
    terms = ["approach to the sub-goal", "obstacle avoidance", "joint motion", "time bonus"]
    np.testing.assert_allclose(trace.steps["INR"], trace.steps[terms].sum(axis=1))


def test_a_decision_holds_for_five_steps_and_leads_at_most_thirty_centimetres(trace: Trace) -> None:
    table = trace.decisions()
    assert list(table.index[:3]) == [0, 5, 10]
    np.testing.assert_array_equal(trace.subgoals[5], trace.subgoals[9])
    assert np.abs(trace.subgoals[5] - trace.subgoals[4]).max() > 0
    for step in (0, 5, 10):
        length = np.linalg.norm(0.3 * trace.commands[step], axis=1)
        np.testing.assert_allclose(table.loc[step, ["A before [m]", "B before [m]"]], length, atol=1e-6)
    assert table["EXR"].sum() == pytest.approx(trace.steps["EXR"].sum())
    assert trace.commanded([0, 5]).shape == (2, 12)


def test_the_subgoal_alone_makes_the_difference(trace: Trace) -> None:
    effect = trace.effect_of_the_subgoal()
    assert len(effect) == 11 and (effect["of it by the sub-goal"] > 0).all()
    expected = np.abs(trace.outputs[:, 0, 10] - trace.outputs[:, 1, 10]).mean()
    assert effect.loc["waist", "of it by the sub-goal"] == pytest.approx(expected)


def test_tables_and_sentences_have_the_figures(trace: Trace) -> None:
    config = METHODS["hrl_dcs"].config("paper")
    table = layer_table(config.policy, config.low.hidden_units)
    assert list(table["hidden state"]) == [128, 128] and list(table["puts out"]) == [6, 11]
    numbers = parameter_table(config.policy, config.low.hidden_units)["numbers"].groupby(level=0).sum()
    assert dict(numbers) == dict(table["parameters"])
    assert tell_decisions(trace).startswith(f"{len(trace.decided)} decisions in {len(trace.steps)} steps")
    assert f"{trace.steps['EXR'].sum():+.2f} in EXR" in tell_rewards(trace)
    assert "of at most 1" in tell_effect(trace)


@pytest.mark.process
def test_pictures_are_of_the_decisions_and_the_end(trace: Trace) -> None:
    drawn = figures.decisions(trace, count=2, size=(160, 112))
    titles = [axis.get_title() for axis in drawn.axes if axis.get_title()]
    last = trace.decided[-1]
    assert titles == [
        "step 0: SGN sets sub-goals", f"step {last}: SGN sets sub-goals", f"step {len(trace.steps)}: {trace.ending}"
    ]  # fmt: skip
    words = {text.get_text() for text in figures.loop().axes[0].texts}
    assert {"SGN", "LLN", "environment"} <= words
    assert len(figures.reward_steps(trace).axes) == 3 and len(figures.effect_of_the_subgoal(trace).axes) == 1


def test_the_best_run_of_two_layers_is_shown(run_folder: Callable[..., Path], tmp_path: Path) -> None:
    assert best_two_layer_run(tmp_path) is None
    run_folder(tmp_path, "ppo_lstm", outcomes=[True, True])
    run_folder(tmp_path, "hrl_dcs", outcomes=[False, True])
    run_folder(tmp_path, "hrl_dcs_demos", outcomes=[True, True])
    best = best_two_layer_run(tmp_path)
    assert best is not None and best.method == "hrl_dcs_demos"


def test_a_folder_without_a_configuration_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"config\.json"):
        follow(untrained_policy("hrl_dcs", tmp_path / "run"), SEED)
