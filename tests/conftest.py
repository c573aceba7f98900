from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from lunar_rescue import ENVIRONMENT_VERSION, LunarRescueEnv
from lunar_rescue.scenes.postures import all_postures, postures
from reproduce.experiments.evaluations import EVALUATIONS
from reproduce.experiments.methods import METHODS
from reproduce.experiments.rows import as_table, summarise, write_rows
from reproduce.storage.files import write_json
from reproduce.storage.processes import start_fork_server
from reproduce.storage.records import to_dict

# Two workers of two threads each take turns on two cores, and wait for each other longer than they compute.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A shell starts what runs in the background deaf to Ctrl-C, and processes that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # under nohup
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let tests that start processes, which take longest, come first in every worker's share of the tests.

    ``--dist worksteal`` begins by giving each worker as many tests as any other, in their order; others may take what
    is last in a share, but a long test that is under way stays where it is.
    """
    count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    long: dict[Any, list[pytest.Item]] = {item.fspath: [] for item in items if item.get_closest_marker("process")}
    rest = iter([item for item in items if not item.get_closest_marker("process")])
    for item in items:
        if item.get_closest_marker("process"):
            long[item.fspath].append(item)
    modules = sorted(long.values(), key=lambda tests: ("workflow" not in str(tests[0].fspath), len(tests)))
    shares = [list(itertools.chain(*modules[index::count])) for index in range(count)]
    sizes = [(index + 1) * len(items) // count - index * len(items) // count for index in range(count)]
    for share, size in zip(shares, sizes, strict=True):
        share += itertools.islice(rest, max(0, size - len(share)))
    items[:] = [*itertools.chain(*shares), *rest]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let one fork server import, once for all tests, what their workers need; it starts with the first such test."""
    if item.get_closest_marker("process"):
        start_fork_server("reproduce.experiments.evaluate", "reproduce.hrl_dcs.policy", "reproduce.baselines.scripted")


@pytest.fixture(scope="module")
def env() -> Iterator[LunarRescueEnv]:
    made = LunarRescueEnv()
    yield made
    made.close()


RunFolder = Callable[..., Path]


def scene_rows(outcomes: Sequence[bool], first_seed: int = 0, **columns: Any) -> pd.DataFrame:
    """Return rows of an evaluation: outcomes by scene, postures in turn, and columns that are something else."""
    rows = pd.DataFrame({"seed": range(first_seed, first_seed + len(outcomes)), "success": list(outcomes)})
    rows["posture"] = list(itertools.islice(itertools.cycle(postures()), len(rows)))
    rows = rows.assign(task="turn_over", mass=200.5, terrain="rough", both_arms_under=True, steps=40, nearest_mark=None)
    peaks = {"peak_force": 600.5, "peak_speed": 0.5, "peak_acceleration": 4.5, "gentle": True}
    rows = rows.assign(**{"return": 1.5, **peaks, **columns})
    rows["attitude"] = [all_postures()[name].attitude for name in rows["posture"]]
    rows["rocks"] = 2 * rows["nearest_mark"].notna()
    rows["failure"] = [None if success else "timeout" for success in rows["success"]]
    return as_table(rows)


@pytest.fixture(scope="session")
def run_folder() -> RunFolder:
    """Make a reference run in a results folder, or add an evaluation to it.

    Called with results folder, method, training seed and outcomes by scene; ``name`` is that of the evaluation,
    ``origin`` and ``summary`` change what ``run.json`` and the summary say, other names are columns of the rows.
    """

    def make(
        results: Path, method: str, seed: int = 0, outcomes: Sequence[bool] | None = None, *, name: str = "evaluation",
        origin: dict[str, Any] | None = None, summary: dict[str, Any] | None = None, **columns: Any,
    ) -> Path:  # fmt: skip
        folder = results / "reference" / method / f"seed{seed}"
        told = {"command": "reproduce", "environment_version": ENVIRONMENT_VERSION}
        if METHODS[method].train is not None and not (folder / "run.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / "config.json", to_dict(METHODS[method].config("smoke")))
            (folder / "policy.safetensors").write_text(f"weights of {method} {seed}")
            training = {**told, "method": method, "seed": seed, "steps": 5_000_000, "seconds": 120.0}
            write_json(folder / "run.json", training | (origin or {}))
        if outcomes is not None:
            rows = scene_rows(outcomes, **{"first_seed": EVALUATIONS[name].first_seed, **columns})
            write_rows(folder / f"{name}.csv", rows)
            tested = {"method": method, **summarise(rows), "seconds": 1.0, "seconds_per_test": 0.1, "origin": told}
            write_json(folder / f"{name}.json", tested | (summary or {}))
        return folder

    return make
