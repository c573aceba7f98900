"""Variants of the printed method: what they change, that they go on, and what is read from them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from reproduce.analysis.variants import draw_variants, readable_variants, tell_variants, variants_table
from reproduce.experiments import variants
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import VARIANTS
from reproduce.experiments.variants import variant_config, variant_folder, vary
from reproduce.storage.errors import UserError
from reproduce.storage.records import flat, to_dict

RunFolder = Callable[..., Path]


def test_each_variant_changes_what_it_says_and_nothing_else() -> None:
    base = dict(flat(to_dict(METHODS["hrl_dcs"].config("laptop"))))
    for group, names in VARIANTS.items():
        for name, changes in names.items():
            if "method" in changes:
                continue
            made = dict(flat(to_dict(variant_config(group, name, 1000))))
            different = {key: value for key, value in made.items() if value != base[key]}
            assert different == {**changes, "steps": 1000}, name  # so a change that changes nothing is told, too


def test_the_ladder_begins_without_priors_and_adds_one_a_rung() -> None:
    rungs = list(VARIANTS["ladder"].values())
    assert rungs[0] == {"priors.mirror": False, "priors.set_point_changes": False} and rungs[2] == {}
    trained = [variant_config("ladder", name, 1).priors for name in list(VARIANTS["ladder"])[:-1]]
    assert [sum((p.mirror, p.set_point_changes, p.joint_step, p.way_in)) for p in trained] == [0, 1, 2, 3, 4]
    last = METHODS[rungs[-1]["method"]].config("laptop").priors
    assert last.demonstrations and last.mirror and last.set_point_changes and last.joint_step and last.way_in


def test_what_was_trained_and_tested_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def train(method: Any, config: Any, seed: int, folder: Path, preset: str, quiet: bool) -> None:
        made.append(f"{method.name} {config.steps} {config.hierarchy.interval} {seed} {preset} {folder.name}")

    def evaluate(folder: Path, tests: int, first_seed: int, quiet: bool, json: Path) -> dict[str, int]:
        made.append(f"{folder.name} {tests} {first_seed}")
        json.parent.mkdir(parents=True, exist_ok=True)
        json.write_text(f'{{"tests": {tests}, "successes": 2}}')
        return {"tests": tests, "successes": 2}

    monkeypatch.setattr(variants, "train_as_needed", train)
    monkeypatch.setattr(variants, "evaluate", evaluate)
    told: list[str] = []
    for _ in range(2):
        vary("fills", ["N = 3"], 500, 8, told.append, results=tmp_path)
    assert made == ["hrl_dcs 500 3 0 laptop n_3", "n_3 8 2000000000", "hrl_dcs 500 3 0 laptop n_3"]
    assert told == ["fills, N = 3: 2 of 8 validation scenes rescued"] * 2
    made.clear()
    vary("ladder", ["+ demonstrations"], 500, 8, told.append, results=tmp_path)
    assert made == ["seed0 8 2000000000"] and (tmp_path / "reference/hrl_dcs_demos/seed0/validation.json").is_file()


@pytest.mark.parametrize(
    ("group", "only", "message"), [("lader", [], "group: .*ladder"), ("fills", ["N = 4"], "N = 3")]
)
def test_a_variant_that_is_not_there_is_named(group: str, only: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        vary(group, only)


def test_rungs_are_held_against_the_one_below_and_fills_against_the_base(run_folder: RunFolder, tmp_path: Path) -> None:
    outcomes = {
        ("ladder", "as printed"): "0000",
        ("ladder", "+ mirrored view"): "1000",
        ("ladder", "+ joint step"): "1110",
        ("fills", "N = 3"): "1100",
        ("fills", "N = 10"): "0000",
    }
    for number, ((group, name), digits) in enumerate(outcomes.items()):
        made = run_folder(tmp_path, "hrl_dcs", number, [digit == "1" for digit in digits], name="validation")
        target = variant_folder(group, name, tmp_path)
        target.parent.mkdir(parents=True, exist_ok=True)
        made.rename(target)
    ladder = variants_table("ladder", tmp_path)
    assert list(ladder.index) == ["as printed", "+ mirrored view", "+ joint step"]
    assert list(ladder["success"]) == [0.0, 0.25, 0.75] and list(ladder["difference"][1:]) == [0.25, 0.5]
    assert pd.isna(ladder["difference"].iloc[0]) and readable_variants(ladder)["difference, points"].iloc[0] == "-"
    fills = variants_table("fills", tmp_path)
    assert list(fills.index) == ["+ mirrored view", "N = 3", "N = 10"]
    assert list(fills["difference"][1:]) == [0.25, -0.25]
    assert "Not told apart: N = 3, N = 10." in tell_variants("fills", fills)
    assert draw_variants(fills) is not None and draw_variants(fills[:0]) is None
    assert tell_variants("fills", fills[:1]).endswith("reproduce vary fills.")
    sure = ladder.assign(less=0.1, more=0.9)
    assert "+ mirrored view +25.0 [+10.0, +90.0]; + joint step" in tell_variants("ladder", sure)
    assert json.loads((variant_folder("fills", "N = 3", tmp_path) / "run.json").read_text())["steps"] == 5_000_000
