"""Statistics on tables worked by hand, and claims and tables from made-up results folders."""

from __future__ import annotations

import json
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from lunar_rescue.scenes.splits import SPLITS, TRAIN, split_of
from reproduce.analysis import reward_forms as arithmetic
from reproduce.analysis.claims import ENOUGH_STEPS, compute_claims, final_return, steps_to_converge
from reproduce.analysis.intervals import count_by, mean_interval, paired_difference, summarise, wilson
from reproduce.analysis.runs import reference_runs
from reproduce.analysis.settings import settings_table
from reproduce.analysis.tables import (
    by_attitude,
    nearest_to_rocks,
    paired_differences,
    readable_differences,
    readable_table1,
    table1,
)
from reproduce.experiments.evaluate import mass_class
from reproduce.learning.workers import train_seed
from reproduce.report.notebook import fill_in, mark_mathematics
from reproduce.report.pages import PAGES, rewritten
from reproduce.storage.errors import UserError
from reproduce.storage.paths import ROOT


def test_wilson_gives_the_papers_intervals() -> None:
    assert wilson(986, 1000) == pytest.approx((0.9766, 0.9916), abs=1e-4)
    low, high = wilson(5, 10)  # by hand: centre 0.5, half width z sqrt(0.025 + z^2 / 400) / (1 + z^2 / 10)
    assert (low, high) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="successes"):
        wilson(3, 2)


def _episode(success: bool, task: str, posture: str, failure: str | None, under: bool = True) -> dict[str, Any]:
    return {"is_success": success, "both_arms_under": under, "failure": failure, "task": task, "posture": posture}


def test_summary_by_hand() -> None:
    episodes = [
        _episode(True, "lift", "a", None),
        _episode(False, "lift", "b", "timeout", under=False),
        _episode(True, "turn_over", "b", None),
        _episode(False, "turn_over", "b", "timeout"),
    ]
    found = summarise(episodes)
    assert (found["tests"], found["successes"], found["success_rate"], found["both_arms_under"]) == (4, 2, 0.5, 0.75)
    assert found["by_posture"] == {"a": {"tests": 1, "successes": 1}, "b": {"tests": 3, "successes": 1}}
    assert found["by_posture_and_task"]["b turn_over"] == {"tests": 2, "successes": 1}
    assert found["failures"] == {"timeout": 2} and found["outcomes"] == "1010"
    assert count_by(episodes, "task")["lift"] == {"tests": 2, "successes": 1}


def test_paired_difference_by_hand() -> None:
    first, second = "1" * 60 + "0" * 40, "1" * 40 + "0" * 25 + "1" * 5 + "0" * 30
    difference, low, high = paired_difference(first, second)  # 20 times better, 5 times worse
    assert difference == pytest.approx(0.15)
    half = 1.959964 * ((20.5 + 5.5 - 15.0**2 / 102) / 102**2) ** 0.5
    assert (low, high) == pytest.approx((15.0 / 102 - half, 15.0 / 102 + half), abs=1e-6)
    difference, low, high = paired_difference(first, first)
    assert difference == 0.0 and low < 0.0 < high
    for bad in ("1", "", first[:-1] + "2"):
        with pytest.raises(ValueError, match="outcomes"):
            paired_difference(first, bad)


def test_paired_differences_are_those_of_the_same_scenes(tmp_path: Path) -> None:
    for name, outcomes, first in (("hrl_dcs", "1101", 0), ("fun", "1001", 0), ("sac", "0000", 8)):
        run = tmp_path / "reference" / name / "seed0"
        run.mkdir(parents=True)
        told = {"tests": 4, "first_seed": first, "outcomes": outcomes}
        (run / "evaluation.json").write_text(json.dumps(told))
    table = paired_differences(tmp_path)
    assert list(table.index) == ["hrl_dcs - fun seed 0"] and table["difference"].iloc[0] == 0.25
    (row,) = readable_differences(tmp_path).to_dict("records")
    assert row["HRL-DCS minus"] == "FeUdal Networks, seed 0" and row["test"].startswith("+25.0 [")
    assert row["held out"] == "-"


def test_attitudes_are_sums_over_their_postures(tmp_path: Path) -> None:
    told = {
        "left_side_stride turn_over": {"tests": 4, "successes": 4},
        "right_side_curled turn_over": {"tests": 6, "successes": 1},
        "prone_crawl turn_over": {"tests": 5, "successes": 3},
        "prone_crawl lift": {"tests": 5, "successes": 0},
    }
    run = tmp_path / "reference" / "sac" / "seed0"
    run.mkdir(parents=True)
    (run / "evaluation.json").write_text(json.dumps({"by_posture_and_task": told}))
    row = by_attitude(results=tmp_path).loc["sac seed 0"].to_dict()
    assert row == {"lift prone": "0.0 % of 5", "turn over prone": "60.0 % of 5", "turn over side": "50.0 % of 10"}
    assert by_attitude("heldout", tmp_path).empty


def test_how_near_rocks_were_is_compared_where_there_are_rocks(tmp_path: Path) -> None:
    assert nearest_to_rocks(tmp_path).empty
    told = {"hrl_dcs": [0.5, None, 0.25, 0.3], "hrl_dcs_no_aapf": [0.4, None, 0.25, 0.1]}
    for name, marks in told.items():
        run = tmp_path / "reference" / name / "seed0"
        run.mkdir(parents=True)
        (run / "evaluation.json").write_text(json.dumps({"tests": 4, "first_seed": 0, "nearest_mark": marks}))
    table = nearest_to_rocks(tmp_path)
    assert list(table["scenes with rocks"]) == [3, 3, 3]
    assert list(table["mean"]) == pytest.approx([0.35, 0.25, 0.1])
    low, high = table[["low", "high"]].loc["hrl_dcs - hrl_dcs_no_aapf"]
    half = 4.302653 * 0.1 / 3**0.5  # Student's quantile of two degrees of freedom; 0.1, 0 and 0.2 deviate by 0.1
    assert (low, high) == pytest.approx((0.1 - half, 0.1 + half), abs=1e-6)
    with pytest.raises(ValueError, match="two values"):
        mean_interval([1.0])
    marked = [{**_episode(True, "lift", "a", None), "nearest_mark": mark} for mark in (0.12345, None)]
    assert summarise(marked)["nearest_mark"] == [0.123, None]


def test_every_setting_says_where_it_comes_from() -> None:
    table = settings_table("laptop")
    assert table["where from"].str.len().min() > 10
    buffer, steps = (table.xs(key).to_dict() for key in (("SAC", "buffer_size"), ("training", "steps")))
    assert (buffer["sac"], buffer["sac_large_buffer"], buffer["fun"]) == (50_000, 1_000_000, "")
    assert len({value for key, value in steps.items() if key != "where from"}) == 1


def _results(folder: Path, runs: dict[str, list[tuple[int, int]]], per_test: float = 0.1) -> Path:
    """A results folder: for each method (successes, tests) of each seed."""
    for method, seeds in runs.items():
        for seed, (successes, tests) in enumerate(seeds):
            run = folder / "reference" / method / f"seed{seed}"
            run.mkdir(parents=True)
            low, high = wilson(successes, tests)
            evaluation = {
                "tests": tests, "successes": successes, "success_rate": successes / tests, "wilson_low": low,
                "first_seed": 0, "outcomes": "1" * successes + "0" * (tests - successes),
                "wilson_high": high, "seconds_per_test": per_test,
                "by_posture": {f"p{i}": {"tests": tests // 20, "successes": -(-successes // 20)} for i in range(20)},
            }  # fmt: skip
            (run / "evaluation.json").write_text(json.dumps(evaluation))
            (run / "run.json").write_text(json.dumps({"steps": ENOUGH_STEPS, "seconds": 120.0}))
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


def test_enough_seeds_and_tests_give_a_verdict(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": _five(985), "hrl_dcs_no_aapf": _five(870), "fun": _five(994)})
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


def test_overlapping_intervals_are_inconclusive(tmp_path: Path) -> None:
    found = _verdicts(_results(tmp_path, {m: _five(n) for m, n in (("hrl_dcs", 900), ("hrl_dcs_no_aapf", 898))}))
    assert found["C4"] == "inconclusive"
    assert found["C5"] == "contradicted"


def test_trainings_that_differ_among_themselves_leave_it_open(tmp_path: Path) -> None:
    """5000 tests each tell 900 from 870, but not where trainings of one method differ by 100."""
    found = _verdicts(_results(tmp_path / "apart", {"hrl_dcs": _five(900), "fun": _five(870)}))
    assert (found["C3"], found["C5"]) == ("verified", "contradicted")
    found = _verdicts(_results(tmp_path / "spread", {"hrl_dcs": _five(900, 50), "fun": _five(870)}))
    assert (found["C3"], found["C5"]) == ("inconclusive", "verified")  # 98.6 % is within what five such trainings say


def test_one_training_each_is_judged_by_pairs(tmp_path: Path) -> None:
    """930 and 915 of 1000 have intervals that overlap, but all of the 15 scenes that differ speak for the first."""
    folder = _results(tmp_path, {"hrl_dcs": [(930, 1000)], "fun": [(915, 1000)]})
    evidence = next(claim.evidence for claim in compute_claims(folder) if claim.id == "C3")
    assert "paired difference [+0." in evidence and "by the rule alone verified" in evidence
    path = folder / "reference" / "fun" / "seed0" / "evaluation.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "first_seed": 5}))
    evidence = next(claim.evidence for claim in compute_claims(folder) if claim.id == "C3")
    assert "not on the same scenes (open)" in evidence


def test_few_seeds_are_reduced_scale_and_say_so(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": [(196, 200)], "hrl_dcs_no_aapf": [(100, 200)]}, per_test=0.9)
    _curve(folder, "hrl_dcs", 30, 9.0)
    _curve(folder, "hrl_dcs_no_aapf", 50, 8.0)
    claims = {claim.id: claim for claim in compute_claims(folder)}
    assert claims["C4"].verdict == "reduced scale" and "by the rule alone verified" in claims["C4"].evidence
    assert claims["C6"].verdict == "reduced scale"
    assert (claims["C5"].seeds, claims["C5"].tests, claims["C5"].env_steps) == (1, 200, ENOUGH_STEPS)


def test_short_trainings_are_reduced_scale(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": _five(985)})
    assert _verdicts(folder)["C5"] == "verified"
    short = folder / "reference" / "hrl_dcs" / "seed3" / "run.json"
    short.write_text(json.dumps({"steps": ENOUGH_STEPS - 1, "seconds": 120.0}))
    assert _verdicts(folder)["C5"] == "reduced scale"


def test_postures_are_judged_over_all_trainings(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": _five(985)})
    for seed, counts in enumerate([(50, 50), (50, 50), (50, 50), (50, 50), (35, 50)]):
        path = folder / "reference" / "hrl_dcs" / f"seed{seed}" / "evaluation.json"
        told = json.loads(path.read_text())
        told["by_posture"] = {f"p{i}": {"tests": 50, "successes": 50} for i in range(20)}
        told["by_posture"]["p7"] = dict(zip(("successes", "tests"), counts, strict=True))
        path.write_text(json.dumps(told))
    judged = next(claim for claim in compute_claims(folder) if claim.id == "C7")
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


def test_c2_is_a_ratio_of_steps(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": _five(985), "fun": _five(900)})
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
    rise: int, final: float, successes: int, verdict: str, tmp_path: Path
) -> None:
    folder = _results(tmp_path, {"hrl_dcs": _five(985), "sac": _five(successes)})
    _curve(folder, "hrl_dcs", 40, 9.0)
    _curve(folder, "sac", rise, final)
    assert _verdicts(folder)["C1"] == verdict


def test_table1_has_the_contract_s_columns(tmp_path: Path) -> None:
    table = table1(_results(tmp_path, {"hrl_dcs": [(50, 100)]}))
    assert list(table.columns) == [
        "method", "seed", "env_steps", "minutes", "tests", "successes", "success_rate", "wilson_low", "wilson_high",
        "paper_success_rate",
    ]  # fmt: skip
    assert table.iloc[0]["minutes"] == 2.0 and table.iloc[0]["paper_success_rate"] == 0.986


def test_table1_for_people_has_held_out_scenes_beside_it(tmp_path: Path) -> None:
    folder = _results(tmp_path, {"hrl_dcs": [(50, 100), (60, 100)]})
    held = {"success_rate": 0.25, "wilson_low": 0.2, "wilson_high": 0.3}
    (folder / "reference" / "hrl_dcs" / "seed1" / "heldout.json").write_text(json.dumps(held))
    row = readable_table1(folder).set_index("method").loc["HRL-DCS"]
    assert row["held out"] == "-, 25.0 % [20.0 %, 30.0 %]"
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


def test_conditions_of_a_scene_are_counted_where_rows_tell_them() -> None:
    row = {"is_success": True, "both_arms_under": True, "failure": None, "task": "lift", "posture": "supine_straight"}
    assert "by_terrain" not in summarise([row])
    told = [{**row, "terrain": "rough", "mass_class": mass_class(mass), "rocks": 2} for mass in (160.0, 250.0, 343.0)]
    summary = summarise([*told, {**told[0], "terrain": "smooth", "is_success": False, "failure": "timeout"}])
    assert summary["by_terrain"]["rough"] == {"tests": 3, "successes": 3}
    assert summary["by_mass_class"]["160 to 221 kg"] == {"tests": 2, "successes": 1}
    assert list(summary["by_mass_class"]) == ["160 to 221 kg", "221 to 282 kg", "282 to 343 kg"]


def test_no_file_of_the_project_holds_a_path_of_a_machine() -> None:
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files"], capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    written = {".json", ".csv", ".md", ".toml", ".yml", ".ipynb", ".lock", ".cff"}
    for path in (ROOT / name for name in listed.stdout.split()):
        if path.is_file() and path.suffix in written:
            text = path.read_text(encoding="utf-8")
            assert f"{ROOT}/" not in text and "/home/" not in text, path
