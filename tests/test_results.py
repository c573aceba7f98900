"""Statistics on tables worked by hand, and claims and tables from made-up results folders."""

from __future__ import annotations

import json
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
from reproduce.analysis.claims import ENOUGH_STEPS, compute_claims
from reproduce.analysis.intervals import mean_interval, paired_difference
from reproduce.analysis.runs import reference_runs
from reproduce.analysis.settings import settings_table
from reproduce.analysis.tables import (
    by_attitude,
    by_condition,
    nearest_to_rocks,
    paired_differences,
    readable_differences,
    readable_table1,
    table1,
    write_tables,
)
from reproduce.analysis.trainings import final_return, steps_to_converge
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


def test_paired_difference_by_hand() -> None:
    first = np.repeat([True, False], [60, 40])
    second = np.repeat([True, False, True, False], [40, 25, 5, 30])
    difference, low, high = paired_difference(first, second)  # 20 times better, 5 times worse
    assert difference == pytest.approx(0.15)
    half = 1.959964 * ((20.5 + 5.5 - 15.0**2 / 102) / 102**2) ** 0.5
    assert (low, high) == pytest.approx((15.0 / 102 - half, 15.0 / 102 + half), abs=1e-6)
    difference, low, high = paired_difference(first, first)
    assert difference == 0.0 and low < 0.0 < high
    for bad in ([True], [], np.ones(100)):
        with pytest.raises(ValueError, match="outcomes"):
            paired_difference(first, bad)


def test_paired_differences_are_those_of_the_same_scenes(run_folder: RunFolder, tmp_path: Path) -> None:
    for name, outcomes, first in (("hrl_dcs", "1101", 0), ("fun", "1001", 0), ("sac", "0000", 8)):
        run_folder(tmp_path, name, outcomes=[digit == "1" for digit in outcomes], first_seed=2_020_000_000 + first)
    table = paired_differences(tmp_path)
    assert list(table.index) == ["hrl_dcs - fun seed 0"] and table["difference"].iloc[0] == 0.25
    (row,) = readable_differences(tmp_path).to_dict("records")
    assert row["HRL-DCS minus"] == "FeUdal Networks, seed 0" and row["test"].startswith("+25.0 [")
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
    with pytest.raises(ValueError, match="two values"):
        mean_interval([1.0])


def test_every_setting_says_where_it_comes_from() -> None:
    table = settings_table("laptop")
    assert table["where from"].str.len().min() > 10
    buffer, steps = (table.xs(key).to_dict() for key in (("SAC", "buffer_size"), ("training", "steps")))
    assert (buffer["sac"], buffer["sac_large_buffer"], buffer["fun"]) == (50_000, 1_000_000, "")
    # Those that only imitate take no steps of their own; all others take as many as each other.
    taken = {str(key): value for key, value in steps.items() if key != "where from"}
    assert {value for key, value in taken.items() if not key.endswith("_demos")} == {5_000_000}
    assert {value for key, value in taken.items() if key.endswith("_demos")} == {0}


def _results(make: RunFolder, folder: Path, runs: dict[str, list[tuple[int, int]]], per_test: float = 0.1) -> Path:
    """A results folder: for each method (successes, tests) of each seed."""
    for method, seeds in runs.items():
        for seed, (successes, tests) in enumerate(seeds):
            outcomes = [True] * successes + [False] * (tests - successes)
            make(folder, method, seed, outcomes, summary={"seconds_per_test": per_test})
    return folder


def _curve(folder: Path, method: str, rise: int, final: float) -> None:
    """Give every seed of a method a return that rises from 0 to ``final`` at update ``rise`` of 100."""
    returns = [0.0] * rise + [final] * (100 - rise)
    curve = pd.DataFrame({"env_steps": range(1000, 101_000, 1000), "return_high": returns})
    for run in (folder / "reference" / method).iterdir():
        curve.to_csv(run / "progress.csv", index=False)


def _verdicts(folder: Path) -> dict[str, str]:
    return {claim.id: claim.verdict for claim in compute_claims(folder)}


def test_without_results_nothing_is_claimed(tmp_path: Path) -> None:
    assert set(_verdicts(tmp_path).values()) == {"inconclusive"}
    assert table1(tmp_path).empty
    assert "no run in results/ yet" in set(readable_table1(tmp_path)["ours, success [95 % interval]"])


def _five(successes: int, spread: int = 2) -> list[tuple[int, int]]:
    """Five trainings of 1000 tests each."""
    return [(successes + spread * k, 1000) for k in (-2, -1, 0, 1, 2)]


def test_enough_seeds_and_tests_give_a_verdict(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": _five(985), "hrl_dcs_no_aapf": _five(870), "fun": _five(994)})
    assert _verdicts(folder)["C4"] == "inconclusive"  # no curves
    _curve(folder, "hrl_dcs", 30, 9.0)
    _curve(folder, "hrl_dcs_no_aapf", 50, 8.0)
    found = _verdicts(folder)
    assert found["C4"] == "verified"
    assert found["C3"] == "contradicted"
    assert found["C5"] == "verified"
    assert found["C6"] == "verified"
    assert found["C7"] == "verified"
    assert found["C8"] == "inconclusive"


def test_overlapping_intervals_are_inconclusive(run_folder: RunFolder, tmp_path: Path) -> None:
    found = _verdicts(
        _results(run_folder, tmp_path, {m: _five(n) for m, n in (("hrl_dcs", 900), ("hrl_dcs_no_aapf", 898))})
    )
    assert found["C4"] == "inconclusive"
    assert found["C5"] == "contradicted"


def test_trainings_that_differ_among_themselves_leave_it_open(run_folder: RunFolder, tmp_path: Path) -> None:
    """5000 tests each tell 900 from 870, but not where trainings of one method differ by 100."""
    found = _verdicts(_results(run_folder, tmp_path / "apart", {"hrl_dcs": _five(900), "fun": _five(870)}))
    assert (found["C3"], found["C5"]) == ("verified", "contradicted")
    found = _verdicts(_results(run_folder, tmp_path / "spread", {"hrl_dcs": _five(900, 50), "fun": _five(870)}))
    assert (found["C3"], found["C5"]) == ("inconclusive", "verified")  # 98.6 % is within what five such trainings say


def test_one_training_each_is_judged_by_pairs(run_folder: RunFolder, tmp_path: Path) -> None:
    """930 and 915 of 1000 have intervals that overlap, but all of the 15 scenes that differ speak for the first."""
    folder = _results(run_folder, tmp_path, {"hrl_dcs": [(930, 1000)], "fun": [(915, 1000)]})
    evidence = next(claim.evidence for claim in compute_claims(folder) if claim.id == "C3")
    assert "paired difference [+0." in evidence and "by the rule alone verified" in evidence
    run_folder(folder, "fun", outcomes=[True] * 915 + [False] * 85, first_seed=2_020_000_005)
    evidence = next(claim.evidence for claim in compute_claims(folder) if claim.id == "C3")
    assert "not on the same scenes (open)" in evidence


def test_few_seeds_are_reduced_scale_and_say_so(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": [(196, 200)], "hrl_dcs_no_aapf": [(100, 200)]}, per_test=0.9)
    _curve(folder, "hrl_dcs", 30, 9.0)
    _curve(folder, "hrl_dcs_no_aapf", 50, 8.0)
    claims = {claim.id: claim for claim in compute_claims(folder)}
    assert claims["C4"].verdict == "reduced scale" and "by the rule alone verified" in claims["C4"].evidence
    assert claims["C6"].verdict == "reduced scale"
    assert (claims["C5"].seeds, claims["C5"].tests, claims["C5"].env_steps) == (1, 200, ENOUGH_STEPS)


def test_short_trainings_are_reduced_scale(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": _five(985)})
    assert _verdicts(folder)["C5"] == "verified"
    short = folder / "reference" / "hrl_dcs" / "seed3" / "run.json"
    short.write_text(json.dumps(json.loads(short.read_text()) | {"steps": ENOUGH_STEPS - 1}))
    assert _verdicts(folder)["C5"] == "reduced scale"


def test_postures_are_judged_over_all_trainings(run_folder: RunFolder, tmp_path: Path) -> None:
    for seed in range(5):
        outcomes = np.ones(1000, dtype=bool)
        if seed == 4:
            outcomes[7 : 15 * 20 : 20] = False  # the eighth posture: 35 of 50
        run_folder(tmp_path, "hrl_dcs", seed, outcomes)
    judged = next(claim for claim in compute_claims(tmp_path) if claim.id == "C7")
    assert judged.verdict == "verified" and judged.measured == pytest.approx(235 / 250)
    assert (judged.low, judged.high) == pytest.approx(wilson(235, 250))


def test_convergence_by_hand() -> None:
    curve = pd.DataFrame({"env_steps": range(10, 1010, 10), "return_high": [0.0] * 50 + [1.0] * 50})
    # The mean over 20 updates reaches 0.9 with the eighteenth update of the upper half.
    assert (steps_to_converge(curve), final_return(curve)) == (680, 1.0)


@pytest.mark.parametrize("returns", [[1.0] * 100, [1.0] * 50 + [0.0] * 50, [0.3, -0.3] * 49 + [0.4, -0.3]])
def test_what_does_not_rise_has_not_converged(returns: list[float]) -> None:
    curve = pd.DataFrame({"env_steps": range(10, 1010, 10), "return_high": returns})
    assert steps_to_converge(curve) is None


def test_c2_is_a_ratio_of_steps(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": _five(985), "fun": _five(900)})
    _curve(folder, "hrl_dcs", 22, 9.0)
    _curve(folder, "fun", 62, 9.0)
    judged = next(claim for claim in compute_claims(folder) if claim.id == "C2")
    assert judged.verdict == "verified" and judged.measured == pytest.approx(40 / 80) and judged.low is None
    _curve(folder, "fun", 0, 9.0)
    judged = next(claim for claim in compute_claims(folder) if claim.id == "C2")
    assert judged.verdict == "inconclusive" and judged.measured is None and "fun none" in judged.evidence


@pytest.mark.parametrize(
    ("rise", "final", "successes", "verdict"),
    [
        (20, 4.0, 10, "verified"),
        (0, 4.0, 10, "inconclusive"),  # never rises
        (60, 4.0, 10, "contradicted"),  # slower
        (20, 5.0, 10, "contradicted"),  # more than half the return
        (20, 4.0, 100, "contradicted"),  # a tenth is solved
        (40, 4.0, 10, "inconclusive"),  # as fast
        (20, 4.4, 10, "inconclusive"),  # hardly less than half
        (20, 4.0, 45, "inconclusive"),
    ],
)
def test_sac_is_to_be_fast_low_and_unsuccessful(
    rise: int, final: float, successes: int, verdict: str, run_folder: RunFolder, tmp_path: Path
) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": _five(985), "sac": _five(successes)})
    _curve(folder, "hrl_dcs", 40, 9.0)
    _curve(folder, "sac", rise, final)
    assert _verdicts(folder)["C1"] == verdict


def test_table1_has_the_contract_s_columns(run_folder: RunFolder, tmp_path: Path) -> None:
    table = table1(_results(run_folder, tmp_path, {"hrl_dcs": [(50, 100)]}))
    assert list(table.columns) == [
        "method", "seed", "env_steps", "minutes", "tests", "successes", "success_rate", "wilson_low", "wilson_high",
        "paper_success_rate",
    ]  # fmt: skip
    assert table.iloc[0]["minutes"] == 2.0 and table.iloc[0]["paper_success_rate"] == 0.986


def test_table1_for_people_has_held_out_scenes_beside_it(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = _results(run_folder, tmp_path, {"hrl_dcs": [(50, 100), (60, 100)]})
    run_folder(folder, "hrl_dcs", 1, [True] * 25 + [False] * 75, name="heldout")
    row = readable_table1(folder).set_index("method").loc["HRL-DCS"]
    assert row["held out"] == "-, 25.0 % [17.5 %, 34.3 %]"
    assert row["ours, success [95 % interval]"].startswith("50.0 % [40.4 %")


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
