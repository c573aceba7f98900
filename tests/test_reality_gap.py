"""What stress tests say: what is lost and gained by hand, sentences that are computed, files that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from matplotlib.figure import Figure

from lunar_rescue.scenes.splits import VALIDATION
from reproduce.analysis import figures
from reproduce.analysis import reality_gap as gap
from reproduce.experiments.rows import as_table, write_rows
from reproduce.storage.errors import UserError

POSTURES = {0: ("lift", "supine_straight", "supine"), 1: ("turn_over", "prone_crawl", "prone")}


def row(kind: str, severity: str, seed: int, success: bool, method: str = "scripted") -> dict[str, Any]:
    task, posture, attitude = POSTURES[seed % 2]
    simulator = "mujoco" if kind == "simulator" else "pybullet"
    lies = {"seed": seed, "task": task, "posture": posture, "attitude": attitude, "simulator": simulator}
    failure = None if success else "timeout"
    return {"method": method, "kind": kind, "severity": severity, **lies, "success": success, "failure": failure}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Rows of two methods: of four rescues of the script, delay keeps one and torque four, MuJoCo two and gains one."""
    rows = [row("none", "none", seed, seed < 4) for seed in range(5)]
    rows += [row("delay", "middle", seed, seed == 0) for seed in range(5)]
    rows += [row("torque", "middle", seed, seed < 4) for seed in range(5)]
    rows += [row("simulator", "none", seed, seed in (0, 1, 4)) for seed in range(5)]
    (tmp_path / "stress").mkdir()
    pd.DataFrame(rows).to_csv(tmp_path / "stress" / "scripted.csv", index=False)
    others = [row("none", "none", seed, False, "random") for seed in range(5)]
    pd.DataFrame(others).to_csv(tmp_path / "stress" / "random.csv", index=False)
    return tmp_path


def test_sentences_are_computed(results: Path, tmp_path: Path) -> None:
    rows = gap.stress_rows(results)
    script, random = gap.in_words(rows)
    assert script == (
        "Script with IK: 80.0 % of 5 scenes undisturbed; of these rescues, at the middle severity, least are kept "
        "under actions that come late, 2 steps (25 %), most under weak motors, 20 % (100 %); in mujoco 60.0 %, 2 lost "
        "and 1 gained."
    )
    assert random == "Random actions: 0.0 % of 5 scenes undisturbed."
    assert "reproduce stress" in gap.in_words(gap.stress_rows(tmp_path / "nothing"))[0]


def test_tables_by_hand(results: Path) -> None:
    rows = gap.stress_rows(results)
    shown: Any = gap.readable_stress(rows)
    assert shown.columns.tolist() == ["Script with IK", "Random actions"]
    assert shown["Script with IK"].to_dict() == {
        "nothing": "80.0 %",
        "actions that come late, 2 steps": "20.0 %, 25 % kept",
        "weak motors, 20 %": "80.0 %, 100 % kept",
        "nothing, in mujoco": "60.0 %, 50 % kept",
    }
    assert shown["Random actions"].tolist() == ["0.0 %", "", "", ""]
    first, second = gap.simulators(rows[rows["method"] == "scripted"]) or (None, None)
    assert first is not None and second is not None
    table: Any = gap.transfer_table(first, second).set_index(["by", "group"])
    names = ["tests", "first", "second", "lost", "gained"]
    assert table.loc[("all", ""), names].tolist() == [5, 4, 3, 2, 1]
    assert table.loc[("task", "lift"), names].tolist() == [3, 2, 2, 1, 1]
    assert table.loc[("posture", "turn over prone crawl"), names].tolist() == [2, 2, 1, 1, 0]
    assert table.loc[("all", ""), "difference"] == pytest.approx(-0.2)
    # Agresti and Min by hand: p = 1.5 / 7, q = 2.5 / 7, (p + q - (p - q)^2) / 7 = 0.0787.
    assert table.loc[("all", ""), "low"] == pytest.approx(-1 / 7 - 1.96 * 0.28046, abs=2e-3)
    assert gap.simulators(rows[rows["method"] == "random"]) is None
    transfers: Any = gap.transfers(rows)
    assert transfers.loc[("Script with IK", "lift"), "lost"] == 1 and "random" not in str(transfers).lower()
    assert gap.transfers(rows[rows["method"] == "random"]).empty
    with pytest.raises(UserError, match="the same scenes"):
        gap.transfer_table(first, second.iloc[::-1])


def test_more_scenes_in_both_simulators_come_before_those_of_the_stress_tests(results: Path) -> None:
    (results / "transfer").mkdir()
    more = [row("none", "none", seed, True) for seed in range(9)]
    more += [row("simulator", "none", seed, seed > 2) for seed in range(9)]
    pd.DataFrame(more).to_csv(results / "transfer" / "scripted.csv", index=False)
    rows = gap.simulator_rows(results)
    assert rows.groupby("method").size().to_dict() == {"scripted": 18, "random": 5}
    told: Any = gap.transfers(rows)
    assert told.loc[("Script with IK", ""), ["tests", "first", "second"]].tolist() == [9, 9, 6]
    shown: Any = gap.readable_transfers(rows)["Script with IK"]
    assert shown[["in PyBullet", "in MuJoCo"]].tolist() == ["100.0 %", "66.7 %"]
    assert shown["difference, all"].startswith("-33.3 [") and shown["difference, lift"].startswith("-40.0 [")
    assert gap.readable_transfers(rows[:0]).empty


def test_severities_are_told_with_units() -> None:
    table: Any = gap.severities()
    assert table.loc["centre of gravity", ["unit", "low", "middle", "high"]].tolist() == ["cm", 2.0, 5.0, 10.0]
    assert len(table) == 10 and table["meaning"].str.len().min() > 20


def test_the_figure_has_a_panel_a_kind_and_a_line_a_method(results: Path) -> None:
    figure = figures.success_by_severity(gap.by_severity(gap.stress_rows(results)))
    assert isinstance(figure, Figure)
    panels = {axis.get_title(): axis for axis in figure.axes}
    assert len(panels) == 10
    drawn: list[Any] = panels["actions that come late"].containers
    lines = [bars.lines[0].get_xydata().tolist() for bars in drawn]
    assert lines == [[[0.0, 80.0], [2.0, 20.0]], [[0.0, 0.0]]]
    figures.plt.close(figure)


def test_files_that_are_not_stress_tests_are_named(results: Path) -> None:
    path = results / "stress" / "scripted.csv"
    for text, words in (
        ("method,kind\nscripted,delay\n", "expected a column severity"),
        (path.read_text().replace("scripted", "planner"), "method: expected scripted alone, got planner"),
        ("", "not readable"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=words) as error:
            gap.stress_rows(results)
        assert str(path) in str(error.value)


def test_two_evaluations_are_compared_by_command(tmp_path: Path) -> None:
    common = {"mass": 200.0, "rocks": 0, "terrain": "smooth", "both_arms_under": True, "steps": 50, "return": 1.0}
    peaks = {"nearest_mark": None, "peak_force": 1.0, "peak_speed": 0.1, "peak_acceleration": 0.1, "gentle": True}
    for name, saved in (("a", (0, 1)), ("b", (1, 2)), ("c", (0, 1))):
        start = VALIDATION.start + (name == "c")
        rows = [{**row("none", "none", start + i, i in saved), **common, **peaks} for i in range(4)]
        write_rows(tmp_path / f"{name}.csv", as_table(rows))
    files = [str(tmp_path / f"{name}.csv") for name in "abc"]
    answer = call("transfer", files[0], files[1], "--out", str(tmp_path / "table.csv"))
    assert answer.code == 0
    table: Any = pd.read_csv(tmp_path / "table.csv")
    assert table.loc[0, ["tests", "first", "second", "lost", "gained"]].tolist() == [4, 2, 2, 1, 1]
    refused = call("transfer", files[0], files[2])
    assert refused.code == 2 and "the same scenes" in refused.complaint
    missing = call("transfer", files[0], str(tmp_path / "none.csv"))
    assert missing.code == 2 and "none.csv" in missing.complaint


def test_plans_are_the_planners_alone() -> None:
    refused = call("evaluate", "scripted", "--tests", "1", "--plans-of", "pybullet")
    assert refused.code == 2 and "only the planner makes plans" in refused.complaint
    refused = call("evaluate", "planner", "--tests", "1", "--plans-of", "bullet")
    assert refused.code == 2 and "got 'bullet'" in refused.complaint


@pytest.mark.process
def test_plans_of_one_simulator_are_done_in_the_other(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "plans.json"
    arguments = ("--tests", "2", "--simulator", "mujoco", "--plans-of", "pybullet", "--json", str(path))
    assert call("evaluate", "planner", *arguments).code == 0
    assert '"simulator": "mujoco"' in path.read_text() and '"plans_of": "pybullet"' in path.read_text()
