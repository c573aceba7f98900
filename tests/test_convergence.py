"""The study of solver settings: its summary by hand, and a small study of two settings."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from lunar_rescue.physics.solver import SETTINGS, SolverSettings
from reproduce.experiments.convergence import GRID, label, measure_convergence, summarise_convergence
from reproduce.storage.errors import UserError


def _row(
    setting: str, seed: int, task: str, success: bool, deep: int, deepest: float, balance: float | None
) -> dict[str, object]:
    return {
        "actor": "scripted", "setting": setting, "seed": seed, "task": task, "success": success, "contact_steps": 10,
        "deep_steps": deep, "deepest": deepest, "balance": balance, "step_us": 800.0,
    }  # fmt: skip


def test_a_summary_by_hand() -> None:
    coarse, finest = label(GRID[0]), label(GRID[-1])
    rows = pd.DataFrame(
        [
            _row(coarse, 1, "lift", True, 1, 0.012, -0.02),
            _row(coarse, 2, "lift", False, 0, 0.004, None),
            _row(coarse, 3, "turn_over", True, 0, 0.002, None),
            _row(finest, 1, "lift", True, 0, 0.001, 0.0),
            _row(finest, 2, "lift", True, 0, 0.001, 0.0),
            _row(finest, 3, "turn_over", False, 0, 0.001, None),
        ]
    )
    first, last = summarise_convergence(rows).to_dict("records")
    assert (first["setting"], first["scenes"], first["success"]) == (coarse, 3, pytest.approx(2 / 3))
    assert (first["lifts"], first["turns"], first["lost"], first["gained"]) == (0.5, 1.0, 1, 1)
    assert first["deep_share"] == pytest.approx(1 / 30) and first["deepest_median_mm"] == pytest.approx(4.0)
    assert first["balance_error_median"] == pytest.approx(0.02)
    assert (last["lost"], last["gained"], last["deep_share"]) == (0, 0, 0.0)


def test_settings_are_named_by_their_paces() -> None:
    assert label(SETTINGS) == "20 ms x 10, 10 ms x 50" and SETTINGS in GRID
    assert label(SolverSettings(0.0025, 200, 0.0025, 200)) == label(GRID[-1]) == "2.5 ms x 200"


@pytest.mark.process
def test_actors_meet_the_same_scenes_under_each_setting(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such run folder"):
        measure_convergence(["scriptet"], 1, 5, folder=tmp_path)
    grid, told = (SETTINGS, GRID[1]), list[str]()
    measure_convergence(["scripted", "plans"], 2, 5, grid=grid, folder=tmp_path, tell=told.append, quiet=True)
    rows = pd.read_csv(tmp_path / "scenes.csv")
    assert len(rows) == 2 * 2 * 2 and "plans" in told[0]
    assert rows.groupby(["actor", "setting"])["seed"].apply(list).map(lambda seeds: seeds == [5, 6]).all()
    assert set(rows["actor"]) == {"scripted", "plans"} and (rows["steps"] > 0).all()
    assert pd.read_csv(tmp_path / "summary.csv")["scenes"].tolist() == [2, 2, 2, 2]
