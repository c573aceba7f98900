"""Rows of an evaluation: written, read back and refused; the summary of a small table worked by hand."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from reproduce.experiments import evaluations
from reproduce.experiments.evaluate import evaluate, find_policy
from reproduce.experiments.evaluations import EVALUATIONS, evaluate_run, evaluations_of
from reproduce.experiments.pool import first_scene
from reproduce.experiments.rows import as_table, read_rows, rows_path, summarise, wilson, write_rows
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json


def _row(seed: int, **changes: Any) -> dict[str, Any]:
    return {
        "seed": seed, "task": "lift", "posture": "prone_crawl", "attitude": "prone", "mass": 200.5, "rocks": 0,
        "terrain": "rough", "success": True, "failure": None, "both_arms_under": True, "steps": 40, "return": 0.1 + 0.2,
        "nearest_mark": None,
        "peak_force": 600.5, "peak_speed": 0.5, "peak_acceleration": 4.5, "gentle": True, **changes,
    }  # fmt: skip


@pytest.fixture
def rows() -> pd.DataFrame:
    return as_table(
        [
            _row(7),
            _row(8, success=False, failure="timeout", both_arms_under=False, steps=120),
            _row(9, task="turn_over", rocks=2, nearest_mark=0.25, peak_force=806.5, gentle=False),
            _row(10, task="turn_over", success=False, failure="timeout", steps=120, posture="supine_straight",
                 attitude="supine"),
        ]
    )  # fmt: skip


def test_a_summary_by_hand(rows: pd.DataFrame) -> None:
    summary = summarise(rows)
    assert (summary["tests"], summary["successes"], summary["success_rate"]) == (4, 2, 0.5)
    assert (summary["first_seed"], summary["split"], summary["both_arms_under"]) == (7, "train", 0.75)
    assert summary["by_task"] == {"lift": {"tests": 2, "successes": 1}, "turn_over": {"tests": 2, "successes": 1}}
    assert summary["by_posture"]["prone_crawl"] == {"tests": 3, "successes": 2}
    assert summary["gentle"] == 0.25  # scene 7; 9 was rescued roughly, 8 and 10 not at all
    assert summary["failures"] == {"timeout": 2} and summary["mean_steps"] == 80.0
    assert (summary["wilson_low"], summary["wilson_high"]) == wilson(2, 4)
    assert wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)


def test_rows_are_read_back_as_they_were(rows: pd.DataFrame, tmp_path: Path) -> None:
    write_rows(tmp_path / "x.csv", rows)
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x.csv"), rows)
    assert summarise(read_rows(tmp_path / "x.csv")) == summarise(rows)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("mass", "weight", "mass"),
        ("200.5", "nan", "mass"),
        ("200.5", "inf", "mass"),
        ("8,lift", "7,lift", "seed"),
        ("9,turn_over", "9,dance", "line 4, task"),
        ("False,timeout", "False,", "failure"),
        ("2,rough", "0,rough", "nearest_mark"),
        ("crawl,prone", "crawl,supine", "posture"),
        ("True", "perhaps", "success"),
        (",40,", ",0,", "steps"),
        ("600.5", "900.5", "gentle"),
        ("0.5,4.5", "0.5,-4.5", "peak_acceleration"),
    ],
)
def test_rows_that_say_odd_things_are_refused(
    old: str, new: str, word: str, rows: pd.DataFrame, tmp_path: Path
) -> None:
    path = tmp_path / "x.csv"
    write_rows(path, rows)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(UserError, match=word) as error:
        read_rows(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_files_without_rows_are_refused(tmp_path: Path) -> None:
    for content in ("", "[]", "seed,task\n"):
        (tmp_path / "x.csv").write_text(content)
        with pytest.raises(UserError, match=r"x\.csv"):
            read_rows(tmp_path / "x.csv")
    with pytest.raises(UserError, match="missing"):
        read_rows(tmp_path / "y.csv")


@pytest.mark.process
def test_an_evaluation_leaves_rows_beside_its_summary(tmp_path: Path) -> None:
    summary = evaluate("random", 3, quiet=True, json=tmp_path / "a" / "evaluation.json")
    rows = read_rows(tmp_path / "a" / "evaluation.csv")
    assert list(rows["seed"]) == [0, 1, 2]
    written = read_json(tmp_path / "a" / "evaluation.json", "evaluation")
    assert all(written[key] == value == summary[key] for key, value in summarise(rows).items())
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        evaluate("random", 10**6, quiet=True, json=tmp_path / "file" / "evaluation.json")


def test_a_run_gets_the_evaluations_of_its_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def pretend(where: object, tests: int, first_seed: int, *rest: object, json: Path) -> dict[str, int]:
        calls.append((str(where), tests, first_seed, json.name))
        return {"tests": tests, "successes": 0}

    monkeypatch.setattr(evaluations, "evaluate", pretend)
    evaluate_run(tmp_path / "random" / "seed0", 8, 4, tell=lambda words: None)
    assert calls == [("random", 8, 2_020_000_000, "evaluation.json"), ("random", 8, 2_030_000_000, "heldout.json")]
    names = ["evaluation", "heldout", "both_layers", "fixed_target", "untrained_lln"]
    assert evaluations_of("hrl_dcs") == names and [*names, "validation"] == list(EVALUATIONS)


def test_scenes_are_named_by_split_or_by_seed_and_final_ones_are_called_so() -> None:
    words: list[str] = []
    assert first_scene(None, None, words.append) == 2_000_000_000
    assert first_scene("validation-heldout", None, words.append) == 2_010_000_000
    assert first_scene(None, 7, words.append) == 7 and first_scene("train", 7, words.append) == 7
    assert not words
    assert first_scene(None, 2_020_000_004, words.append) == 2_020_000_004
    assert first_scene("heldout", None, words.append) == 2_030_000_000
    assert [word.split(":")[0] for word in words] == ["test", "heldout"] and "final figures" in words[0]
    for split, seed, message in (
        ("tset", None, "--split: expected one of train, validation"),
        ("test", 7, "--first-seed: test has seeds 2020000000 to 2029999999; got 7"),
        (None, 2_040_000_000, "--first-seed: every split has seeds 0 to 2039999999; got 2040000000"),
    ):
        with pytest.raises(UserError, match=message):
            first_scene(split, seed, words.append)


def test_an_unknown_policy_is_answered_with_what_there_is() -> None:
    with pytest.raises(UserError, match=r"no such run folder.*scripted, planner, random; did you mean planner\?"):
        find_policy("planer")


def test_rows_lie_beside_the_summary_where_something_can() -> None:
    assert rows_path(Path("a/evaluation.json")) == Path("a/evaluation.csv")
    assert rows_path(Path("/dev/stdout")) is None and rows_path(Path("/dev/null")) is None
    with pytest.raises(UserError, match=r"x\.csv: expected a name for the summary"):
        rows_path(Path("x.csv"))


@pytest.mark.process
def test_one_command_evaluates_every_reference_run_and_writes_the_tables(tmp_path: Path) -> None:
    (tmp_path / "reference" / "random" / "seed0").mkdir(parents=True)
    environment = {**os.environ, "REPRODUCE_RESULTS": str(tmp_path)}
    command = [sys.executable, "-m", "reproduce", "evaluate-reference", "--tests", "2", "--few", "1"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "reference" / "random" / "seed0").iterdir()} == {
        "evaluation.json", "evaluation.csv", "heldout.json", "heldout.csv",
    }  # fmt: skip
    assert pd.read_csv(tmp_path / "table1.csv")["tests"].tolist() == [2]
    assert list(pd.read_csv(tmp_path / "tables" / "success.csv")["evaluation"]) == ["evaluation", "heldout"]
    assert len(read_json(tmp_path / "claims.json", "claims")) == 8
