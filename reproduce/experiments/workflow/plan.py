"""What a batch consists of: its jobs, what each one writes, and how long it may take.

The Snakefile, ``reproduce batch`` and the README's table of commands all read this.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.experiments.evaluations import EVALUATIONS, TESTS
from reproduce.experiments.methods import METHODS, get_method
from reproduce.learning.config import to_dict
from reproduce.report.notebooks import find_notebooks
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json

#: What `reproduce tables` and its like write of all evaluations.
TABLES = ("table1.csv", "claims.json", "tables/success.csv")
REPORT = "report/index.html"
TARGETS = ("policies", "tables", "report")
MOST_SEEDS = 1000

# Guesses of seconds on 2 cores, until a batch has measured its own.
_STARTING = 6.0  # a command and its imports
_STEPS_PER_SECOND = 1200.0
_SECONDS_A_TEST = {"planner": 1.2, "scripted": 0.05}
_NOTEBOOK = 20.0


@dataclass(frozen=True)
class Job:
    """One step.

    Attributes:
        rule: Of the Snakefile.
        name: For people.
        output: Relative to the batch's folder; a job is done when it is there.
        log: Relative to the batch's folder.
        timing: Where its seconds are noted, relative to the batch's folder.
        guess: Seconds that it may take.
    """

    rule: str
    name: str
    output: Path
    log: Path
    timing: Path
    guess: float


@dataclass(frozen=True)
class Plan:
    """Everything a batch is to do.

    Attributes:
        preset: Of trainings and notebooks.
        methods: In the registry's order.
        seeds: Of each method that learns.
        threads: Cores of one job.
        environment: Version; results of another one are made anew.
        configurations: A digest of each method's configuration; likewise.
    """

    preset: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    threads: int
    environment: str
    configurations: dict[str, str]

    @classmethod
    def make(cls, preset: str, methods: list[str], seeds: list[int], threads: int) -> Plan:
        """Evaluation names and numbers.

        Raises:
            UserError: On an unknown preset or method.
        """
        chosen = [name for name in METHODS if name in {get_method(m).name for m in methods}]
        digests = {name: _digest(to_dict(METHODS[name].config(preset))) for name in chosen}
        return cls(preset, tuple(chosen), tuple(sorted(set(seeds))), threads, ENVIRONMENT_VERSION, digests)

    @classmethod
    def of(cls, data: dict[str, Any]) -> Plan:
        """From what ``as_data`` gave."""
        kept: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
        return cls(**kept)

    @classmethod
    def read(cls, path: Path) -> Plan:
        """From a file.

        Raises:
            UserError: When it is missing or not a plan.
        """
        data = read_json(path, "plan of a batch")
        try:
            return cls.of(data)
        except (TypeError, AttributeError):
            raise UserError(f"{path}: plan of a batch: expected {', '.join(cls.__dataclass_fields__)}") from None

    def as_data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    def learns(self, method: str) -> bool:
        """Whether a method has to be trained."""
        return METHODS[method].train is not None

    def runs(self) -> list[tuple[str, int]]:
        """Methods with their seeds; what does not learn has one."""
        return [(m, s) for m in self.methods for s in (self.seeds if self.learns(m) else (0,))]

    def checks(self, method: str) -> list[str]:
        """Which evaluations a method gets."""
        if not self.learns(method):
            return ["evaluation"]
        return list(EVALUATIONS) if method == "hrl_dcs" else ["evaluation", "heldout"]

    def tests(self, check: str) -> int:
        """Scenes of an evaluation."""
        return TESTS[self.preset][EVALUATIONS[check].few]

    def policies(self) -> list[str]:
        """Files that say that a training has ended."""
        return [f"{folder(m, s)}/run.json" for m, s in self.runs() if self.learns(m)]

    def evaluations(self) -> list[str]:
        """Files of all evaluations."""
        return [f"{folder(m, s)}/{check}.json" for m, s in self.runs() for check in self.checks(m)]

    def notebooks(self) -> list[str]:
        """Names."""
        return [notebook.name for notebook in find_notebooks()]

    def jobs(self, until: str = "report") -> list[Job]:
        """The steps up to one of ``TARGETS``, in the order of what needs what."""
        jobs = []
        for method, seed in self.runs():
            name, where = f"{method} seed {seed}", folder(method, seed)
            if self.learns(method):
                seconds = METHODS[method].config(self.preset).steps / _STEPS_PER_SECOND
                jobs.append(_job("train", f"train {name}", f"{where}/run.json", f"{method}_seed{seed}", seconds))
            for check in self.checks(method) if until != "policies" else []:
                seconds = self.tests(check) * _SECONDS_A_TEST.get(method, 0.06)
                label = f"{method}_seed{seed}_{check}"
                jobs.append(_job("evaluate", f"{check} of {name}", f"{where}/{check}.json", label, seconds))
        if until == "policies":
            return jobs
        jobs.append(_job("tables", "tables", TABLES[-1], "all", 0.0))
        if until == "tables":
            return jobs
        for notebook in self.notebooks():
            output = f"notebooks/{notebook}.ipynb"
            jobs.append(_job("notebook", f"notebook {notebook}", output, notebook, _NOTEBOOK))
        jobs.append(_job("report", "report", REPORT, "all", 0.0))
        return jobs


def folder(method: str, seed: int | str) -> str:
    """Run folder, relative to the batch's folder."""
    return f"reference/{method}/seed{seed}"


def _job(rule: str, name: str, output: str, label: str, seconds: float) -> Job:
    log, timing = Path(f"logs/{rule}_{label}.log"), Path(f"timings/{rule}_{label}.tsv")
    return Job(rule, name, Path(output), log, timing, seconds + _STARTING)


def _digest(data: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def parse_seeds(text: str) -> list[int]:
    """Seeds of a text such as ``0-4`` or ``0,2,7``.

    Raises:
        UserError: On anything else.
    """
    seeds: list[int] = []
    for part in text.split(","):
        first, separator, last = part.strip().partition("-")
        numbers = [first, last] if separator else [first]
        if not all(n.isascii() and n.isdigit() and len(n) < 10 for n in numbers):
            raise UserError(f"--seeds: expected numbers and ranges such as 0-4 or 0,2,7; got {text!r}")
        low, high = int(numbers[0]), int(numbers[-1])
        if high < low or high - low >= MOST_SEEDS:
            raise UserError(f"--seeds: expected a range upwards of at most {MOST_SEEDS} seeds; got {part.strip()!r}")
        seeds += range(low, high + 1)
    return seeds


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))
