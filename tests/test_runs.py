"""Evidence is read back as it was written, and refused in one line where it is another's or does not agree."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from reproduce.analysis.runs import reference_runs
from reproduce.analysis.tables import write_tables
from reproduce.storage.errors import UserError

RunFolder = Callable[..., Path]


def _edit(path: Path, changes: dict[str, Any]) -> None:
    """Change keys of a JSON file; None takes a key out."""
    data = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))


def _refused(results: Path, *words: str) -> None:
    with pytest.raises(UserError) as error:
        write_tables(results)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


@pytest.fixture
def run(run_folder: RunFolder, tmp_path: Path) -> Path:
    return run_folder(tmp_path, "sac", outcomes=[True, False, True])


def test_a_run_is_read_with_its_evaluations(run: Path, run_folder: RunFolder, tmp_path: Path) -> None:
    run_folder(tmp_path, "sac", outcomes=[False], name="heldout")
    (found,) = reference_runs(tmp_path)
    rows, held = found.rows(), found.summary("heldout")
    assert rows is not None and held is not None and found.evaluation is not None
    assert (found.label, found.env_steps, found.minutes) == ("sac seed 0", 5_000_000, 2.0)
    assert found.evaluation["successes"] == 2 and rows["success"].tolist() == [True, False, True]
    assert held["split"] == "heldout" and found.rows("both_layers") is None and found.curve() is None


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"method": "fun"}, "method: expected sac, got 'fun'"),
        ({"ablation": "untrained_lln"}, "ablation: expected none, got 'untrained_lln'"),
        ({"scenes": "easy"}, "scenes: expected none, got 'easy'"),
        ({"split": "heldout"}, "split: expected test, got 'heldout'"),
        ({"origin": {"command": "", "environment_version": "0.9"}}, "environment_version: expected 2.0, got '0.9'"),
        ({"origin": {}}, "origin: command: Field required"),
        ({"successes": 3}, "successes: expected 2, as evaluation.csv has it, got 3"),
        ({"success_rate": float("nan")}, "success_rate"),
        ({"seconds_per_test": float("nan")}, "seconds_per_test"),
        ({"wilson_low": None}, "wilson_low"),
        ({"by_task": {}}, "by_task"),
        ({"tests": "3"}, "tests"),
        ({"method": None}, "method: Field required"),
    ],
)
def test_summaries_that_say_something_else_are_refused(
    changes: dict[str, Any], word: str, run: Path, tmp_path: Path
) -> None:
    _edit(run / "evaluation.json", changes)
    _refused(tmp_path, "sac/seed0/evaluation.json", word)


def test_an_evaluation_under_another_name_is_refused(run: Path, run_folder: RunFolder, tmp_path: Path) -> None:
    for ending in ("json", "csv"):
        shutil.copy(run / f"evaluation.{ending}", run / f"heldout.{ending}")
    _refused(tmp_path, "heldout.json", "split: expected heldout, got 'test'")
    (run / "heldout.csv").unlink()
    _refused(tmp_path, "heldout.csv", "missing")


@pytest.mark.parametrize("content", ["[]", "3", "{", ""])
@pytest.mark.parametrize("name", ["evaluation.json", "run.json"])
def test_what_is_no_description_is_refused(name: str, content: str, run: Path, tmp_path: Path) -> None:
    (run / name).write_text(content)
    _refused(tmp_path, f"sac/seed0/{name}")


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"seed": 3}, "seed: expected 0, got 3"),
        ({"method": "fun"}, "method"),
        ({"environment_version": "1.0"}, "environment_version: expected 2.0, got '1.0'"),
        ({"steps": -1}, "steps"),
        ({"steps": True}, "steps"),
        ({"seconds": float("inf")}, "seconds"),
        ({"seconds": None}, "seconds: Field required"),
    ],
)
def test_descriptions_that_say_something_else_are_refused(
    changes: dict[str, Any], word: str, run: Path, tmp_path: Path
) -> None:
    _edit(run / "run.json", changes)
    _refused(tmp_path, "sac/seed0/run.json", word)


def test_a_copied_run_is_refused(run: Path, tmp_path: Path) -> None:
    copy = run.with_name("seed1")
    shutil.copytree(run, copy)
    _refused(tmp_path, "seed1/run.json", "seed: expected 1, got 0")
    _edit(copy / "run.json", {"seed": 1})
    _refused(tmp_path, "seed1/policy.safetensors", "seed0/policy.safetensors")
    (copy / "policy.safetensors").write_text("others")
    write_tables(tmp_path)


def test_folders_of_no_run_are_refused(tmp_path: Path) -> None:
    (tmp_path / "reference" / "nonsense" / "seed0").mkdir(parents=True)
    _refused(tmp_path, "nonsense", "expected")


@pytest.mark.parametrize("content", ["", "env_steps\n1\n", "env_steps,return_high\n", "env_steps,return_high\n1,nan\n"])
def test_curves_that_are_none_are_refused(content: str, run: Path, tmp_path: Path) -> None:
    (run / "progress.csv").write_text(content)
    (found,) = reference_runs(tmp_path)
    with pytest.raises(UserError, match=r"progress\.csv: learning curve"):
        found.curve()
