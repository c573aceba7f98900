"""What a reader meets has its limits: words, lines of a cell, a sentence after each figure; and sentences are right."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import nbformat
import pandas as pd
import pytest

from reproduce.analysis import comparison, problem, sentences
from reproduce.analysis import comparison_figures as drawings
from reproduce.analysis.claims import Claim, compute_claims
from reproduce.analysis.runs import reference_runs
from reproduce.analysis.settings import differing, settings_table
from reproduce.analysis.tables import paired_differences
from reproduce.report.notebook import FOLDED
from reproduce.report.site import first_page
from reproduce.storage.paths import NOTEBOOKS, ROOT

CELL_LINES, CELL_WORDS, NOTEBOOK_WORDS = 6, 130, 750
FIRST_PAGE_WORDS, README_WORDS = 450, 1_150
TOUR = ("01", "02", "03", "04", "05", "06", "07", "08", "09", "10")
PATHS = [path for path in sorted(NOTEBOOKS.glob("*.ipynb")) if path.name[:2] in TOUR]
_FIGURE = re.compile(r"\b(figures|drawings)\.\w+\(")


@pytest.mark.parametrize("path", PATHS, ids=lambda path: str(path.stem))
def test_cells_are_short_and_the_text_is_not_long(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    code = [cell.source for cell in cells if cell.cell_type == "code"][2:]  # after parameters and imports
    assert max(len(source.splitlines()) for source in code) <= CELL_LINES
    words = [len(cell.source.split()) for cell in cells if cell.cell_type == "markdown"]
    assert max(words) <= CELL_WORDS and sum(words) <= NOTEBOOK_WORDS
    assert "doi.org/10.3390/aerospace9060315" in cells[0].source, "the paper is linked where it is first named"


@pytest.mark.parametrize("path", PATHS, ids=lambda path: str(path.stem))
def test_a_figure_is_followed_by_what_it_shows(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    for cell, after in zip(cells, [*cells[1:], None], strict=True):
        if cell.cell_type == "code" and any(_FIGURE.search(line) for line in cell.source.splitlines()[-1:]):
            told = after is not None and (after.cell_type == "markdown" or after.source.startswith("print("))
            assert told or cell.source.splitlines()[-1].startswith("print("), cell.source


def test_long_tables_fold() -> None:
    sources = {cell.source: cell.metadata.get("tags", []) for path in PATHS for cell in nbformat.read(path, 4).cells}
    for source in ("differing(settings)", "trials.round(3)", "layers.parameter_table(config.policy, units)"):
        assert FOLDED in sources[source]


def test_the_first_page_and_the_readme_are_short(tmp_path: Path, run_folder: Callable[..., Path]) -> None:
    run_folder(tmp_path, "hrl_dcs", outcomes=[True, True, False, True])
    page = first_page(reference_runs(tmp_path), tmp_path, {}, "06_claims.md")
    shown = re.sub(r"</summary>.*?</details>|alt=\"[^\"]*\"|^ +\|.*?$", " ", page, flags=re.DOTALL | re.MULTILINE)
    assert len(re.sub(r"<[^>]+>", " ", shown).split()) <= FIRST_PAGE_WORDS
    told = (
        "**HRL-DCS rescues 75.0 % [30.1, 95.4] of the test scenes here, after one training of 5 million steps, where "
        "the paper reports 98.6 % after up to 700 million."
    )
    assert told in page
    assert page.index("Does the paper hold?") < page.index("<img") < page.index("The claims") < page.index("## Run it")
    assert page.count("(06_claims.md)") == 8
    readme = (ROOT / "README.md").read_text(encoding="utf-8")  # rows of tables come with evidence and are not prose
    assert len(re.sub(r"^\|.*$", " ", readme, flags=re.MULTILINE).split()) <= README_WORDS


def test_sentences_say_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert sentences.table_or_missing(pd.DataFrame(columns=["run"]), "Nothing yet.") is None
    assert capsys.readouterr().out == "Nothing yet.\n"
    assert sentences.table_or_missing(pd.DataFrame({"run": [1]})) is not None and not capsys.readouterr().out
    for told in (sentences.tell_success(tmp_path), sentences.tell_weakest({}), sentences.tell_curves([])):
        assert told == "No reference run of this version of the environment has it yet."
    assert "nothing can be compared in pairs" in sentences.tell_differences(tmp_path)
    assert "has been trained and tested yet" in sentences.answer(compute_claims(tmp_path), tmp_path)[-1]
    assert sentences.tell_missing("fun", results=tmp_path).endswith("of: FeUdal Networks.")
    assert drawings.differences(tmp_path) is None and drawings.failures([]) is None and drawings.learning([]) is None
    assert [text.get_text() for text in drawings.against_paper(tmp_path).axes[0].texts] == ["no run here yet"] * 3


def test_sentences_have_the_figures(tmp_path: Path, run_folder: Callable[..., Path]) -> None:
    run_folder(tmp_path, "hrl_dcs", outcomes=[True] * 30 + [False] * 10)
    run_folder(tmp_path, "fun", outcomes=[False] * 40)
    runs = reference_runs(tmp_path)
    told = "HRL-DCS: 75.0 % [59.8, 85.8] of 40 tests of 1 training, the paper 98.6 %."
    assert told in sentences.tell_success(tmp_path)
    alone = (
        "HRL-DCS rescues 75.0 % [59.8, 85.8] of the test scenes here, after one training of 5 million steps, where "
        "the paper reports 98.6 % after up to 700 million"
    )
    assert sentences.answer([], tmp_path)[0] == f"{alone}."
    run_folder(tmp_path, "ppo_lstm", outcomes=[True] * 36 + [False] * 4)
    found = "; the best that was trained here (Recurrent PPO) rescues 90.0 % [76.9, 96.0]."
    assert sentences.answer([], tmp_path)[0] == alone + found
    shutil.rmtree(tmp_path / "reference" / "ppo_lstm")
    assert "ahead of 1 of 1 runs and behind 0" in sentences.tell_differences(tmp_path)
    assert "fun seed 0 fails most often by timeout, in 100 % of its tests." in sentences.tell_failures(runs)
    weakest = sentences.tell_weakest({"HRL-DCS": comparison.pooled_rows(results=tmp_path)["HRL-DCS"]})
    assert weakest.startswith("HRL-DCS: 50 % at the least (turn over, ") and weakest.endswith(", 100 % at the most.")
    table = comparison.success_table("hrl_dcs", results=tmp_path)
    assert table.loc["hrl_dcs seed 0", "success"] == "75.0 % [59.8, 85.8]"
    assert comparison.lengths(tmp_path).loc["HRL-DCS, seed 0", "of the paper's at most"] == "0.71 %"
    drawn = drawings.failures(runs)
    assert drawn is not None
    assert [label.get_text() for label in drawn.axes[0].get_yticklabels()] == ["FeUdal Networks", "HRL-DCS"]
    difference = drawings.differences(tmp_path)
    assert difference is not None and difference.axes[0].get_yticklabels()[0].get_text() == "FeUdal Networks, test"


def test_pairs_are_there_with_and_without_runs(tmp_path: Path, run_folder: Callable[..., Path]) -> None:
    assert comparison.split_pairs(paired_differences, results=tmp_path).empty
    for method, outcomes in (("hrl_dcs", [True] * 4), ("hrl_dcs_no_aapf", [False] * 4), ("fun", [False] * 4)):
        run_folder(tmp_path, method, outcomes=outcomes)
    table = comparison.split_pairs(paired_differences, "hrl_dcs_no_aapf", results=tmp_path)
    assert list(table.index) == [("test", "hrl_dcs - hrl_dcs_no_aapf")] and table["difference"].iloc[0] == 1.0
    assert len(comparison.split_pairs(paired_differences, results=tmp_path)) == 2


def test_a_claim_is_told_with_both_figures() -> None:
    claim = Claim("C5", "It succeeds", "98.6 %", measured=0.5, low=0.25, high=0.75)
    assert sentences.figures_of(claim) == "Paper: 98.6 %; here: 50 % [25, 75]."
    faster, fast = Claim("C2", "It is faster", "59 h", measured=0.5), Claim("C6", "It is fast", "1 s", 0.5, 0.5, 0.75)
    assert sentences.figures_of(faster) == "Paper: 59 h; here: 0.5 of its steps."
    assert sentences.figures_of(fast) == "Paper: 1 s; here: 0.5 s [0.5, 0.75]."
    assert sentences.figures_of(Claim("C8", "It works", "text")).endswith("here: not measured.")


def test_trials_and_settings_are_told() -> None:
    trials = pd.DataFrame({"trial": ["a_b", "a_b", "c"], "both_arms_under": [0.0, 0.5, 0.75]})
    assert sentences.tell_trials(trials).startswith("Of 2 trials, c ended highest: both arms under in 75 %")
    index = pd.MultiIndex.from_tuples([("SAC", "x"), ("SAC", "y"), ("FuN", "x")], names=["method", "trial"])
    table = pd.DataFrame({"score": [0.25, 0.75, 0.5]}, index)
    assert sentences.tell_tuning(table) == "SAC: 2 trials, best 0.75; FuN: 1 trials, best 0.50."
    table = settings_table("laptop")
    assert 0 < len(differing(table)) < 20 < len(table)
    named = comparison.priors_table()
    assert named.loc["HRL-DCS, demonstrations", "begins"] == "imitates the planner"
    assert named.loc["Recurrent PPO", "begins"] == "from nothing"
    paper = comparison.priors_table("paper")["priors that the paper does not have"]
    assert "mirror" not in paper["HRL-DCS"]


def test_the_problem_is_told_in_tables() -> None:
    ends = problem.ending_table()["value"]
    assert ends["tilted by at most [deg]"] == 30.0 and ends["steps at most"] == 120
    failed = problem.posture_table({"a_b": {"tests": 4, "successes": 1}, "c": {"tests": 4, "successes": 4}}, most=1)
    assert list(failed.index) == ["a b"] and failed.loc["a b", "failed"] == 3
    splits = problem.split_table()
    assert splits["postures"].astype(int)["train"] == 20 and splits["postures"].astype(int)["heldout"] < 20
    episode, info = problem.random_episode(0)
    terms = episode.drop(columns="reward").sum(axis=1)
    assert terms.tolist() == pytest.approx(episode["reward"].tolist()) and ("failure" in info)
