"""Statistics on tables worked by hand, and claims and tables from made-up results folders."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lunar_rescue.scenes.splits import SPLITS, TRAIN, split_of
from reproduce.analysis import reward_forms as arithmetic
from reproduce.analysis.runs import reference_runs
from reproduce.analysis.settings import settings_table
from reproduce.analysis.tables import (
    by_attitude,
    by_condition,
    levels_table,
    methods_table,
    nearest_to_rocks,
    paired_differences,
    readable_differences,
    readable_table1,
    table1,
    write_tables,
)
from reproduce.experiments.rows import wilson
from reproduce.learning.worker_process import train_seed
from reproduce.report.notebook import fill_in, mark_mathematics
from reproduce.report.pages import PAGES, rewritten
from reproduce.storage.errors import UserError
from reproduce.storage.paths import ROOT

RunFolder = Callable[..., Path]


def test_wilson_gives_the_papers_intervals() -> None:
    assert wilson(986, 1000) == pytest.approx((0.9766, 0.9916), abs=1e-4)
    low, high = wilson(5, 10)  # by hand: centre 0.5, half width z sqrt(0.025 + z^2 / 400) / (1 + z^2 / 10)
    assert (low, high) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="successes"):
        wilson(3, 2)


def test_paired_differences_are_those_of_the_same_scenes(run_folder: RunFolder, tmp_path: Path) -> None:
    for name, outcomes, first in (("hrl_dcs", "1101", 0), ("fun", "1001", 0), ("sac", "0000", 8)):
        run_folder(tmp_path, name, outcomes=[digit == "1" for digit in outcomes], first_seed=2_020_000_000 + first)
    table = paired_differences(tmp_path)
    assert list(table.index) == ["hrl_dcs - fun"] and table["difference"].iloc[0] == 0.25
    assert list(table["interval of"]) == ["one training each"]
    (row,) = readable_differences(tmp_path).to_dict("records")
    assert row["HRL-DCS minus"] == "FeUdal Networks, one training each" and row["test"].startswith("+25.0 [")
    assert row["held out"] == "-"


def test_attitudes_are_sums_over_their_postures(run_folder: RunFolder, tmp_path: Path) -> None:
    told = {  # tests and successes
        ("left_side_stride", "turn_over"): (4, 4),
        ("right_side_arms_bent", "turn_over"): (6, 1),
        ("prone_crawl", "turn_over"): (5, 3),
        ("prone_crawl", "lift"): (5, 0),
    }
    outcomes = [index < rescued for tests, rescued in told.values() for index in range(tests)]
    pairs = [pair for pair, (tests, _) in told.items() for _ in range(tests)]
    run_folder(tmp_path, "sac", outcomes=outcomes, posture=[p for p, _ in pairs], task=[t for _, t in pairs])
    row = by_attitude(results=tmp_path).loc["sac seed 0"].to_dict()
    assert row == {"lift prone": "0.0 % of 5", "turn over prone": "60.0 % of 5", "turn over side": "50.0 % of 10"}
    assert by_attitude("heldout", tmp_path).empty


def test_how_near_rocks_were_is_compared_where_there_are_rocks(run_folder: RunFolder, tmp_path: Path) -> None:
    assert nearest_to_rocks(tmp_path).empty
    told = {"hrl_dcs": [0.5, None, 0.25, 0.3], "hrl_dcs_no_aapf": [0.4, None, 0.25, 0.1]}
    for name, marks in told.items():
        run_folder(tmp_path, name, outcomes=[True] * 4, nearest_mark=marks)
    table = nearest_to_rocks(tmp_path)
    assert list(table["scenes with rocks"]) == [3, 3, 3]
    assert list(table["mean"]) == pytest.approx([0.35, 0.25, 0.1])
    low, high = table[["low", "high"]].loc["hrl_dcs - hrl_dcs_no_aapf"]
    half = 4.302653 * 0.1 / 3**0.5  # Student's quantile of two degrees of freedom; 0.1, 0 and 0.2 deviate by 0.1
    assert (low, high) == pytest.approx((0.1 - half, 0.1 + half), abs=1e-6)


def test_every_setting_says_where_it_comes_from() -> None:
    table = settings_table("laptop")
    assert table["where from"].str.len().min() > 10
    buffer, steps = (table.xs(key).to_dict() for key in (("SAC", "buffer_size"), ("training", "steps")))
    assert (buffer["sac"], buffer["sac_large_buffer"], buffer["fun"]) == (50_000, 1_000_000, "")
    # Those that only imitate take no steps of their own; all others take as many as each other.
    taken = {str(key): value for key, value in steps.items() if key != "where from"}
    assert {value for key, value in taken.items() if not key.endswith("_demos")} == {3_000_000}
    assert {key: value for key, value in taken.items() if key.endswith("_demos")} == {
        "hrl_dcs_demos": 0,
        "ppo_lstm_demos": 0,
        "sac_demos": 600_000,
    }


def test_table1_has_the_contract_s_columns(run_folder: RunFolder, tmp_path: Path) -> None:
    run_folder(tmp_path, "hrl_dcs", outcomes=[True] * 50 + [False] * 50)
    table = table1(tmp_path)
    assert list(table.columns) == [
        "method", "seed", "env_steps", "minutes", "tests", "successes", "success_rate", "wilson_low", "wilson_high",
        "paper_success_rate",
    ]  # fmt: skip
    assert table.iloc[0]["minutes"] == 2.0 and table.iloc[0]["paper_success_rate"] == 0.986


def test_table1_for_people_has_all_trainings_and_held_out_scenes(run_folder: RunFolder, tmp_path: Path) -> None:
    for seed, rescued in enumerate((50, 60)):
        run_folder(tmp_path, "hrl_dcs", seed, [True] * rescued + [False] * (100 - rescued))
    run_folder(tmp_path, "hrl_dcs", 1, [True] * 25 + [False] * 75, name="heldout")
    table = readable_table1(tmp_path).set_index("method")
    row = table.loc["HRL-DCS"]
    assert row["held out"] == "25.0 % [17.5, 34.3]"  # Wilson's, of one training
    assert row["ours, success [95 % interval]"].startswith("55.0 % [")
    assert row["each training"] == "50.0, 60.0" and row["tests"] == "100"
    assert "no run in results/ yet" in set(table["ours, success [95 % interval]"])


def test_methods_and_levels_are_told_of_all_trainings(run_folder: RunFolder, tmp_path: Path) -> None:
    for seed, rescued in enumerate((50, 60)):
        folder = run_folder(tmp_path, "sac", seed, [True] * rescued + [False] * (100 - rescued))
        success = [0.0] * 30 + [0.85] * 70 if seed else [0.0] * 100
        curve = pd.DataFrame({"env_steps": range(10, 1010, 10), "success": success, "return_high": 0.0})
        curve.assign(seconds=6.0 * np.arange(1, 101)).to_csv(folder / "progress.csv", index=False)
    (row,) = methods_table(tmp_path).to_dict("records")
    assert (row["trainings"], row["tests"], row["least"], row["best"]) == (2, 100, 0.5, 0.6)
    assert row["success_rate"] == pytest.approx(0.55) and row["low"] < 0.5 and row["high"] > 0.6
    levels: Any = levels_table(tmp_path).set_index("level")
    assert list(levels["reached"]) == [1, 1, 0, 0]
    # Twelve of twenty updates at 0.85 are 0.51: 42 updates of 10 steps and 6 s. The other one counts 1000.
    assert levels.loc[0.5, ["steps", "minutes"]].tolist() == ["-, 420", "-, 4.2"]
    assert list(levels["restricted_mean"]) == [710.0, 745.0, 1000.0, 1000.0]


def test_strange_reference_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "reference" / "hrl_dcs" / "seedling").mkdir(parents=True)
    with pytest.raises(UserError, match="seedling"):
        reference_runs(tmp_path)


def test_dwelling_against_finishing_by_hand() -> None:
    # gamma 0.5, 3 steps: 1 + 0.5 + 0.25; finishing in step 2: 1 + 0.5 + 0.5 (1 - 0.9 * 2 / 3)
    assert arithmetic.dwelling("literal", 1.0, 0.5, 3) == pytest.approx(1.75)
    assert arithmetic.finishing("literal", 1.0, 0.5, 3, 2) == pytest.approx(1.5 + 0.5 * 0.4)
    assert arithmetic.dwelling("signed", 1.0, 0.5, 3) == 0.0
    assert arithmetic.finishing("signed", 1.0, 0.5, 3, 2, factor=2.0) == pytest.approx(0.5 * 2.0 * 0.4)
    beta = arithmetic.largest_honest_beta(0.99, 120, 40)
    same = [f("literal", beta, 0.99, 120, *a) for f, a in ((arithmetic.dwelling, ()), (arithmetic.finishing, (40,)))]
    assert same[0] == pytest.approx(same[1])


def test_splits_do_not_meet() -> None:
    ranges = sorted(SPLITS.values(), key=lambda seeds: seeds.start)
    assert all(a.stop <= b.start for a, b in pairwise(ranges))
    assert all(split_of(seeds.start) == split_of(seeds.stop - 1) == name for name, seeds in SPLITS.items())
    drawn = {train_seed(0, env, 0, episode) for env in range(16) for episode in range(50)}
    assert len(drawn) == 800 and all(seed in TRAIN for seed in drawn)
    assert train_seed(0, 1, 2, 3) == train_seed(0, 1, 2, 3) != train_seed(1, 1, 2, 3)


@pytest.mark.parametrize("page", list(PAGES))
def test_pages_hold_what_code_and_results_say(page: str) -> None:
    """Else run ``python -m reproduce.report.pages``."""
    assert (ROOT / page).read_text(encoding="utf-8") == rewritten(page)


def test_mathematics_becomes_mathml_outside_code() -> None:
    pieces: dict[str, str] = {}
    marked = mark_mathematics("cost $a^2$ and `$HOME` and $$\\sum_i x_i$$", pieces, "01")
    assert "<math" not in marked and "$a" not in marked and "`$HOME`" in marked
    made = fill_in(marked, pieces)
    assert made.count("<math") == 2 and "@@" not in made
    assert mark_mathematics("5 $ and 6 $", {}, "01") == "5 $ and 6 $"


def test_conditions_of_scenes_by_hand(run_folder: RunFolder, tmp_path: Path) -> None:
    changes = {"mass": [160.0, 220.9, 250.0, 343.0], "terrain": ["rough", "rough", "rough", "smooth"]}
    marks = [0.5, None, 0.5, 0.5]
    run_folder(tmp_path, "sac", outcomes=[True, True, True, False], nearest_mark=marks, **changes)
    (run,) = reference_runs(tmp_path)
    rows = run.rows()
    assert rows is not None
    table: Any = by_condition(rows)
    assert table.loc[("ground", "rough"), ["tests", "success"]].tolist() == [3, 1.0]
    assert table.loc[("mass", "160 to 221 kg"), ["tests", "success"]].tolist() == [2, 1.0]
    assert list(table.loc["mass"].index) == ["160 to 221 kg", "221 to 282 kg", "282 to 343 kg"]
    assert table.loc[("rocks", "2"), ["low", "high"]].tolist() == list(wilson(2, 3))
    written = {path.name: pd.read_csv(path) for path in write_tables(tmp_path)}
    assert len(written["conditions.csv"]) == len(table)
    assert written["failures.csv"].to_dict("records") == [
        {"method": "sac", "seed": 0, "evaluation": "evaluation", "failure": "timeout", "tests": 1}
    ]


def test_no_file_of_the_project_holds_a_path_of_a_machine() -> None:
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files"], capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    written = {".json", ".csv", ".md", ".toml", ".yml", ".ipynb", ".lock", ".cff"}
    for path in (ROOT / name for name in listed.stdout.split()):
        if path.is_file() and path.suffix in written:
            text = path.read_text(encoding="utf-8")
            assert f"{ROOT}/" not in text and "/home/" not in text, path
