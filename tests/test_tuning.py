"""Tuning trials: equal in number, gone on with, judged on validation scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from reproduce.experiments import tuning
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import CHOSEN, PRESETS, TRIALS, changed
from reproduce.experiments.tuning import tune, tuning_table
from reproduce.storage.errors import UserError


def test_every_baseline_gets_as_many_trials_and_has_chosen_one() -> None:
    assert len({len(trials) for trials in TRIALS.values()}) == 1
    for method, trials in TRIALS.items():
        for preset in PRESETS:
            untuned = replace(METHODS[method], changes={}).config(preset)
            assert preset != "laptop" or len({changed(untuned, trial) for trial in trials.values()}) == len(trials)
            assert METHODS[method].config(preset) == changed(untuned, trials[CHOSEN[method]])


def test_a_trial_of_a_setting_that_is_not_there_is_refused() -> None:
    config = METHODS["ppo_lstm"].config("laptop")
    for where in ("low.gama", "lwo.gamma", "sac.gamma", "step", "low", ""):
        with pytest.raises(ValueError, match=f"section and a field, got {where!r}" if where != "low" else "low"):
            changed(config, {where: 1.0})


@pytest.mark.process
def test_trials_are_made_once_and_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first: dict[str, Any] = {"one": {}}
    second = {"two": {"low.n_epochs": 1}}
    monkeypatch.setattr(tuning, "TRIALS", {"ppo_lstm": first})
    monkeypatch.setattr(tuning, "CHOSEN", {"ppo_lstm": "two"})
    options: dict[str, Any] = {"steps": 1, "tests": 2, "quiet": True, "results": tmp_path}
    told: list[str] = []
    made = tune("ppo_lstm", tell=told.append, **options)
    path = tmp_path / "trials" / "tuning" / "ppo_lstm.csv"
    assert len(told) == 1 and 0.0 <= made["score"].iloc[0] <= 1.0
    assert json.loads((path.parent / "origins.json").read_text())[path.name]["commit"]
    before = path.read_bytes()

    monkeypatch.setattr(tuning, "TRIALS", {"ppo_lstm": {**first, **second}})
    measured: list[str] = []

    def measure(method: str, trial: str, *rest: Any) -> dict[str, Any]:
        measured.append(trial)
        return {key: made[key].iloc[0] for key in ("score", "both_arms_under", "success_rate", "seconds")}

    monkeypatch.setattr(tuning, "_measure", measure)
    more = tune("ppo_lstm", tell=told.append, **options)
    assert measured == ["two"] and list(more["trial"]) == ["one", "two"]
    assert before.splitlines()[1] in path.read_bytes()
    table = tuning_table(tmp_path)
    assert list(table["chosen"]) == ["", "x"]
    tune("ppo_lstm", tell=told.append, **{**options, "tests": 3})
    assert measured == ["two", "one", "two"] and set(pd.read_csv(path)["tests"]) == {3}


def test_bad_numbers_and_methods_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="hrl_dcs"):
        tune("hrl_dcs", results=tmp_path)
    wrong: list[dict[str, Any]] = [{"steps": 0}, {"tests": -1}]
    for options in wrong:
        with pytest.raises(UserError, match="at least 1"):
            tune("sac", results=tmp_path, **options)
    assert not list(tmp_path.iterdir())
    assert tuning_table(tmp_path).empty
