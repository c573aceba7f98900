"""Verdicts: rules on numbers with a known answer, and claims from made-up results folders."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reproduce.analysis.claims import Claim, combined, compute_claims, print_claims, write_claims
from reproduce.analysis.stressed import read_stress
from reproduce.analysis.trainings import final_return, steps_to
from reproduce.analysis.verdicts import is_below, is_figure, is_larger, is_more, is_smaller_share, keeps_all, serves_all
from reproduce.storage.errors import UserError
from reproduce.storage.paths import ROOT

RunFolder = Callable[..., Path]


def outcomes(*successes: int, tests: int = 1000) -> np.ndarray:
    """Return trainings with so many successes, failures in scenes of their own."""
    return np.stack([np.roll(np.arange(tests) < n, 7 * i) for i, n in enumerate(successes)])


# -- rules on numbers --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("successes", "verdict"),
    [
        ((981, 983, 985, 987, 989), "agrees"),
        ((994, 995, 996, 995, 994), "agrees"),  # above the figure, within 3 points of it
        ((900, 902, 898, 901, 899), "differs"),
        ((600, 700, 900, 950, 990), "differs"),  # an interval without the figure, however wide
        ((850, 930, 985, 990, 995), "undecided"),  # one that has the figure is no agreement
        ((985, 985), "undecided"),  # two trainings
        ((986,), "undecided"),  # as good as can be, but one training
    ],
)
def test_a_figure_is_held_against_the_whole_interval(successes: tuple[int, ...], verdict: str) -> None:
    assert is_figure(outcomes(*successes), 0.986).verdict == verdict


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        ((900, 905, 910), (800, 805, 810), "agrees"),
        ((800, 805, 810), (900, 905, 910), "differs"),
        ((900, 901, 902, 900, 901), (900, 901, 902, 901, 900), "differs"),  # the same within 3 points
        ((800, 850, 900, 950, 990), (790, 840, 890, 940, 980), "undecided"),
        ((900, 905), (500, 505), "undecided"),
    ],
)
def test_one_of_two_succeeds_more(first: tuple[int, ...], second: tuple[int, ...], verdict: str) -> None:
    assert is_more(outcomes(*first), outcomes(*second)).verdict == verdict


def test_other_rules_on_both_sides() -> None:
    assert [is_below(outcomes(n, n + 2, n + 4)).verdict for n in (10, 45, 100)] == ["agrees", "undecided", "differs"]
    slow, fast, between = [9.0, 10.0, 11.0], [4.0, 5.0, 6.0], [8.0, 9.0, 10.0]
    assert [is_larger(slow, x).verdict for x in (fast, between)] == ["agrees", "undecided"]
    assert is_larger(fast, slow).verdict == "differs" and is_larger([1.0, 1.0], [0.0, 0.0]).verdict == "undecided"
    assert [is_smaller_share(x, slow).verdict for x in (fast, between)] == ["agrees", "undecided"]
    assert is_smaller_share(slow, fast).verdict == "differs"


def test_all_groups_are_served_or_one_is_not() -> None:
    good, bad, spread = outcomes(49, 50, 49, tests=50), outcomes(20, 22, 24, tests=50), outcomes(30, 45, 50, tests=50)
    assert serves_all({"a": good, "b": good})[1].verdict == "agrees"
    weakest, judged = serves_all({"a": good, "b": bad})
    assert (weakest, judged.verdict, judged.value) == ("b", "differs", pytest.approx(0.44))
    assert serves_all({"a": good, "b": spread})[1].verdict == "undecided"
    assert judged.high - judged.low < serves_all({name: bad for name in "abcdefgh"})[1].high - judged.low


def test_success_is_kept_in_all_conditions_or_lost_in_one() -> None:
    before = np.arange(200) < 180
    kept, lost = np.arange(200) < 179, np.arange(200) < 120
    assert keeps_all(before, {"delay": kept, "mujoco": kept})[1].verdict == "agrees"
    worst, judged = keeps_all(before, {"delay": kept, "mujoco": lost})
    assert (worst, judged.verdict, judged.value) == ("mujoco", "differs", pytest.approx(120 / 180))
    assert keeps_all(before, {"delay": np.arange(200) < 164})[1].verdict == "undecided"


def test_the_worst_word_is_the_claim_s() -> None:
    assert combined(["agrees", "agrees"]) == "agrees" and combined(["not comparable"]) == "not comparable"
    assert combined(["agrees", "undecided"]) == "undecided" and combined(["undecided", "differs"]) == "differs"


# -- claims from folders -----------------------------------------------------------------------------------------------
def results(make: RunFolder, folder: Path, runs: dict[str, list[int]]) -> Path:
    """Make a results folder: successes in 1000 tests of each training of each method."""
    for method, trainings in runs.items():
        for seed, row in enumerate(outcomes(*trainings)):
            make(folder, method, seed, row)
    return folder


def five(successes: int, spread: int = 2) -> list[int]:
    """Return the successes of five trainings."""
    return [successes + spread * k for k in (-2, -1, 0, 1, 2)]


def curves(folder: Path, method: str, rises: list[int], final: float, level: float = 1.0) -> None:
    """Give the trainings of a method a return and a success that jump at an update each, of 100 of 1000 steps."""
    for seed, rise in enumerate(rises):
        jump = np.arange(100) >= rise
        curve = pd.DataFrame({"env_steps": range(1000, 101_000, 1000), "return_high": final * jump})
        path = folder / "reference" / method / f"seed{seed}" / "progress.csv"
        curve.assign(success=level * jump).to_csv(path, index=False)


def judged(folder: Path) -> dict[str, Claim]:
    return {claim.id: claim for claim in compute_claims(folder)}


def test_without_results_nothing_is_decided(tmp_path: Path) -> None:
    claims = judged(tmp_path)
    assert {claim.verdict for claim in claims.values()} == {"undecided"} and len(claims) == 8
    assert claims["C3"].evidence == "no evaluated run of hrl_dcs and fun in results/reference"
    assert claims["C3"].scale == "no training"


def test_five_trainings_give_verdicts(run_folder: RunFolder, tmp_path: Path) -> None:
    runs = {"hrl_dcs": five(985), "hrl_dcs_no_aapf": five(870), "fun": five(994)}
    folder = results(run_folder, tmp_path, runs)
    assert judged(folder)["C4"].verdict == "undecided"  # no curves
    curves(folder, "hrl_dcs", [28, 29, 30, 31, 32], 9.0)
    curves(folder, "hrl_dcs_no_aapf", [48, 49, 50, 51, 52], 8.0)
    found = judged(folder)
    words = {name: found[name].verdict for name in found}
    assert words == {
        **{"C1": "undecided", "C2": "undecided", "C3": "differs", "C4": "agrees"},
        **{"C5": "agrees", "C6": "not comparable", "C7": "agrees", "C8": "undecided"},
    }
    five_each = "hrl_dcs 5 trainings of 5,000,000 steps (0.71 % of 700 M), 1000 scenes"
    assert found["C5"].scale == five_each and found["C4"].scale.startswith(f"{five_each}; hrl_dcs_no_aapf 5 ")
    assert (found["C5"].seeds, found["C5"].tests, found["C5"].env_steps) == (5, 5000, 5_000_000)
    assert found["C6"].measured == pytest.approx(0.1)
    assert "(98.1, 98.3, 98.5, 98.7, 98.9)" in found["C5"].evidence  # all trainings, not the best
    assert "C6 not comparable: " in told_by(print_claims, list(found.values()))


def told_by(tell: Callable[[list[Claim]], None], claims: list[Claim]) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as text:
        tell(claims)
    return text.getvalue()


def test_claims_are_written_with_their_columns_and_origin(tmp_path: Path) -> None:
    path = write_claims(compute_claims(tmp_path), tmp_path / "claims.json")
    columns = "id statement paper measured low high seeds tests env_steps scale verdict evidence"
    assert list(json.loads(path.read_text())[0]) == columns.split()
    assert "claims.json" in json.loads((tmp_path / "origins.json").read_text())


def test_one_training_each_decides_nothing(run_folder: RunFolder, tmp_path: Path) -> None:
    """All 15 scenes that differ speak for the first, which is one of trainings that were not made."""
    folder = results(run_folder, tmp_path, {"hrl_dcs": [930], "fun": [915]})
    found = judged(folder)["C3"]
    assert found.verdict == "undecided" and "difference of one training each +1.5 [+0." in found.evidence
    run_folder(folder, "fun", outcomes=[True] * 915 + [False] * 85, first_seed=2_020_000_005)
    assert "not on the same scenes (undecided)" in judged(folder)["C3"].evidence


def test_trainings_of_other_scenes_are_refused(run_folder: RunFolder, tmp_path: Path) -> None:
    for seed, tests in enumerate((100, 50)):
        run_folder(tmp_path, "hrl_dcs", seed, [True] * tests)
    with pytest.raises(UserError, match="evaluation: expected the same scenes for all trainings, got 100, 50 tests"):
        compute_claims(tmp_path)


def test_postures_are_judged_over_all_trainings(run_folder: RunFolder, tmp_path: Path) -> None:
    for seed in range(5):
        rescued = np.ones(1000, dtype=bool)
        rescued[7 + 20 * seed : 800 : 20] = False  # most scenes of the eighth posture
        run_folder(tmp_path, "hrl_dcs", seed, rescued)
    found = judged(tmp_path)["C7"]
    assert found.verdict == "differs" and found.measured == pytest.approx((10 + 11 + 12 + 13 + 14) / 250)
    assert found.low is not None and found.measured is not None and found.low < 0.2 < found.measured


def test_steps_to_a_level_by_hand() -> None:
    curve = pd.DataFrame({"env_steps": range(10, 1010, 10), "success": [0.0] * 50 + [0.95] * 50, "return_high": 1.0})
    # 11 of 20 updates at 0.95 are 0.5225, 17 are 0.8075, 19 are 0.9025.
    assert [steps_to(curve, level) for level in (0.5, 0.8, 0.9, 0.986)] == [610, 670, 690, np.inf]
    curve.loc[55, "success"] = np.nan  # no episode ended: the mean is of 20 others
    assert steps_to(curve, 0.5) == 620 and final_return(curve) == 1.0


def test_c2_is_a_ratio_of_restricted_means(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = results(run_folder, tmp_path, {"hrl_dcs": five(985)[:3], "fun": five(900)[:3]})
    assert judged(folder)["C2"].verdict == "undecided"
    curves(folder, "hrl_dcs", [20, 21, 22], 9.0)
    curves(folder, "fun", [60, 61, 200], 9.0)  # one never
    found = judged(folder)["C2"]
    # 10, 16 and 18 updates of 20 after the jump; the third of fun counts the 100,000 steps that all took.
    ours, theirs = 21 + 44 / 3, (60.5 * 2 + 2 * 44 / 3 + 100) / 3
    assert found.measured == pytest.approx(ours / theirs) and found.verdict == "agrees"
    assert "probability of improvement 1.00" in found.evidence and "(2 of 3)" in found.evidence
    curves(folder, "fun", [200, 200, 200], 9.0)
    curves(folder, "hrl_dcs", [200, 200, 200], 9.0)
    found = judged(folder)["C2"]
    assert found.verdict == "undecided" and found.measured is None and "no level reached" in found.evidence


@pytest.mark.process
@pytest.mark.parametrize(
    ("rise", "final", "successes", "verdict"),
    [
        (20, 4.0, 10, "agrees"),
        (20, 4.0, 100, "differs"),  # a tenth is solved
        (70, 4.0, 10, "differs"),  # slower
        (20, 5.0, 10, "differs"),  # more than half the return
        (20, 4.0, 45, "undecided"),
    ],
)
def test_sac_is_to_be_fast_low_and_unsuccessful(
    rise: int, final: float, successes: int, verdict: str, run_folder: RunFolder, tmp_path: Path
) -> None:
    folder = results(run_folder, tmp_path, {"hrl_dcs": five(985)[:3], "sac": five(successes)[:3]})
    curves(folder, "hrl_dcs", [39, 40, 41], 9.0)
    curves(folder, "sac", [rise, rise + 1, rise + 2], final)
    assert judged(folder)["C1"].verdict == verdict


def test_the_documented_commands_give_the_claimed_number(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = results(run_folder, tmp_path / "results", {"hrl_dcs": five(985)})
    write_claims(compute_claims(folder), folder / "claims.json")
    page = (ROOT / "docs" / "statistics.md").read_text(encoding="utf-8").splitlines()
    by_hand, claimed = (next(line for line in page if line.startswith(word)) for word in ("awk ", "python -c"))
    for command in (by_hand, claimed.replace("python", sys.executable, 1)):
        done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert float(done.stdout) == pytest.approx(0.985)


# -- C8 ----------------------------------------------------------------------------------------------------------------
def stress(folder: Path, kept: dict[tuple[str, str, str], int], tests: int = 200) -> Path:
    """Write rows of disturbed tests: successes by kind, severity and simulator."""
    rows = [
        dict(method="hrl_dcs", kind=kind, severity=severity, seed=seed, success=seed < count, simulator=simulator)
        for (kind, severity, simulator), count in kept.items()
        for seed in range(tests)
    ]
    path = folder / "stress" / "hrl_dcs.csv"
    path.parent.mkdir(exist_ok=True)
    pd.DataFrame(rows).assign(task="lift", failure="").to_csv(path, index=False)
    return path


PLAIN = {("none", "none", "pybullet"): 180, ("delay", "high", "pybullet"): 10}


def test_c8_asks_for_the_other_engine_and_middle_severity(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = results(run_folder, tmp_path, {"hrl_dcs": five(985)})
    stress(folder, {**PLAIN, ("delay", "middle", "pybullet"): 178})
    assert judged(folder)["C8"].verdict == "undecided"  # nothing of the other engine
    stress(folder, {**PLAIN, ("delay", "middle", "pybullet"): 178, ("none", "none", "mujoco"): 179})
    found = judged(folder)["C8"]
    assert found.verdict == "agrees" and found.measured == pytest.approx(178 / 180)
    assert "kept least under delay" in found.evidence and "mujoco 99 %" in found.evidence
    stress(folder, {**PLAIN, ("delay", "middle", "pybullet"): 100, ("simulator", "middle", "mujoco"): 179})
    found = judged(folder)["C8"]
    assert found.verdict == "differs" and found.measured == pytest.approx(100 / 180)


def test_disturbed_rows_that_are_not_sound_are_named(tmp_path: Path) -> None:
    assert read_stress(tmp_path / "stress" / "hrl_dcs.csv") is None
    path = stress(tmp_path, PLAIN, tests=3)
    sound = path.read_text()
    for old, new, words in (
        ("pybullet", "gazebo", "line 2, simulator"),
        ("True", "maybe", "line 2, success"),
        ("hrl_dcs", "fun", "method: expected hrl_dcs, got fun"),
        ("seed", "scene", "line 2, seed"),
    ):
        path.write_text(sound.replace(old, new, 1 if old != "seed" else -1))
        with pytest.raises(UserError, match=words):
            read_stress(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="not readable"):
        read_stress(path)


def test_conditions_of_other_scenes_are_refused(run_folder: RunFolder, tmp_path: Path) -> None:
    folder = results(run_folder, tmp_path, {"hrl_dcs": five(985)})
    path = stress(folder, {**PLAIN, ("delay", "middle", "pybullet"): 178, ("none", "none", "mujoco"): 179})
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(UserError, match="mujoco: expected the 200 scenes"):
        compute_claims(folder)
