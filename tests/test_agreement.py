"""The agreement of the simulators: summaries worked by hand, and a small study."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from scipy.spatial.transform import Rotation

from lunar_rescue.physics import engines
from reproduce.experiments.agreement import (
    AFTER,
    ENGINES,
    REFERENCE,
    Moment,
    _compare,
    by_posture,
    measure_agreement,
    summarise_agreement,
)
from reproduce.storage.errors import UserError


def moment(step: int, *, moved: float = 0.0, turned: float = 0.0, bent: float = 0.0, pressed: bool = False) -> Moment:
    angles, centre = np.full(11, 0.1 * step), np.array([0.0, 0.0, 0.3])
    angles[3] += bent
    rotation = Rotation.from_euler("x", turned, degrees=True).as_matrix()
    return Moment(angles, centre + [moved, 0.0, 0.0], rotation, pressed)


def test_paths_are_compared_from_the_first_contact_of_the_reference() -> None:
    reference = [moment(i, pressed=i >= 2) for i in range(8)]
    other = [
        moment(0, bent=0.03), moment(1, bent=0.05), moment(2), moment(3, pressed=True), moment(4, moved=0.01, turned=3),
        moment(5, moved=0.021), moment(6, moved=0.5, turned=40.0, bent=0.2),
    ]  # fmt: skip
    row = _compare(other, reference)
    assert row["contact"] == 3 and row["joints_before"] == pytest.approx(0.05)
    assert row["parted_after"] == 3  # 21 mm in step 5, three after the first contact in step 2
    assert (row["position_0"], row["position_2"]) == (0.0, pytest.approx(0.01))
    assert np.degrees(row["angle_2"]) == pytest.approx(3.0) and "position_5" not in row
    assert row["position_end"] == pytest.approx(0.5) and np.degrees(row["angle_end"]) == pytest.approx(40.0)
    assert _compare(reference, reference)["parted_after"] is None


def row(engine: str, seed: int, success: bool, task: str = "lift", **columns: Any) -> dict[str, Any]:
    return {
        **{"seed": seed, "task": task, "posture": "supine_straight", "engine": engine, "is_success": success},
        **{"both_arms_under": True, "contact": 20, "joints_before": 0.0, "parted_after": None, "waist_error": None},
        **{"deepest": 0.002, "step_us": 1500},
        **columns,
    }


def test_a_summary_by_hand() -> None:
    far = {"joints_before": np.radians(2.0), "position_5": 0.030, "angle_5": np.radians(4.0), "joints_5": 0.0}
    near = {"position_5": 0.010, "angle_5": 0.0, "joints_5": 0.0}
    rows = pd.DataFrame(
        [
            row(REFERENCE, 1, True, waist_error=-0.002),
            row(REFERENCE, 2, True, "turn_over"),
            row(REFERENCE, 3, False),
            row("MuJoCo", 1, True, contact=21, parted_after=7, waist_error=0.001, **far),
            row("MuJoCo", 2, False, "turn_over", contact=18, parted_after=9, **near),
            row("MuJoCo", 3, True),
        ]
    )
    first, second = summarise_agreement(rows).values()
    assert (first["plans"], first["successes"], first["waist_torque_error_median"]) == (2, 2, pytest.approx(0.002))
    assert (second["plans"], second["successes"], second["share"]) == (2, 1, 0.5)  # the third plan fails in PyBullet
    assert (second["lifts"], second["turns"]) == ([1, 1], [0, 1])
    assert (second["contact_in_the_same_step"], second["contact_off_by_more_than_a_step"]) == (0.0, 0.5)
    assert second["joints_before_contact_median_deg"] == pytest.approx(1.0)
    assert (second["parted"], second["parted_after_steps_median"]) == (2, 8.0)
    assert (second["deepest_overlap_median_mm"], second["step_ms_median"]) == (pytest.approx(2.0), pytest.approx(1.5))
    (table,) = by_posture(rows).to_dict("records")
    assert (table["engine"], table["steps_after_contact"], table["scenes"]) == ("MuJoCo", 5, 2)
    assert (table["position_median_mm"], table["position_most_mm"]) == (pytest.approx(20.0), pytest.approx(30.0))
    assert table["angle_median_deg"] == pytest.approx(2.0)


@pytest.mark.process
def test_plans_are_replayed_in_each_engine(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    answer = call("agreement", "--tests", "2", "--split", "train", "--out", str(tmp_path))
    assert answer.code == 0 and "MuJoCo" in answer.out
    rows = pd.read_csv(tmp_path / "scenes.csv")
    assert rows["engine"].tolist() == 2 * list(ENGINES) and rows["planned"].all()
    again = rows[rows["engine"] == REFERENCE]
    assert again["is_success"].all() and (again["position_end"] == 0.0).all() and again["parted_after"].isna().all()
    others = rows[rows["engine"] != REFERENCE]
    assert (others["joints_before"] < np.radians(5.0)).all()  # the arms follow alike
    assert (others["position_0"] < 0.02).all()
    assert set(pd.read_csv(tmp_path / "by_posture.csv")["steps_after_contact"]) <= set(AFTER)
    assert len(pd.read_csv(tmp_path / "closed_solutions.csv")) == 4 * len(ENGINES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["engines"][REFERENCE]["share"] == 1.0 and "mujoco" in summary["origin"]["packages"]
    assert {"scenes.csv", "by_posture.csv"} <= set(json.loads((tmp_path / "origins.json").read_text()))


@pytest.mark.process
def test_policies_are_tested_in_the_simulator_that_is_named(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    results = {}
    for name in ("pybullet", "mujoco"):
        arguments = ("--tests", "4", "--split", "train", "--simulator", name, "--json", str(tmp_path / f"{name}.json"))
        assert call("evaluate", "scripted", *arguments).code == 0
        results[name] = json.loads((tmp_path / f"{name}.json").read_text())
    assert results["mujoco"]["simulator"] == "mujoco" and "simulator" not in results["pybullet"]
    returns = [results[name]["mean_return"] for name in results]
    assert returns[0] != returns[1] and returns[0] == pytest.approx(returns[1], abs=5.0)
    shown = call("replay", "scripted", "--simulator", "mujoco", "--size", "128x128", "--out", str(tmp_path / "a.png"))
    assert shown.code == 0 and (tmp_path / "a.png").stat().st_size > 1000


def test_what_is_not_there_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = call("evaluate", "scripted", "--tests", "1", "--simulator", "bullet")
    assert refused.code == 2 and refused.complaint.endswith("expected one of pybullet, mujoco; got 'bullet'")
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    refused = call("evaluate", "scripted", "--tests", "1", "--simulator", "mujoco")
    assert refused.code == 2 and "pip install mujoco" in refused.complaint
    with pytest.raises(UserError, match="pip install"):
        measure_agreement(1, 0, folder=tmp_path / "none")
    assert not (tmp_path / "none").exists()
