"""What a batch consists of: its steps and the file that each one writes.

The Snakefile, ``reproduce batch`` and the README's table of commands all read this.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import field
from pathlib import Path

from pydantic.dataclasses import dataclass

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.experiments.evaluations import evaluations_of
from reproduce.experiments.methods import METHODS, get_method
from reproduce.learning.config import TrainingConfig
from reproduce.storage.errors import UserError
from reproduce.storage.paths import notebook_files
from reproduce.storage.records import read_record, to_dict

#: What `reproduce tables` and its like write of all evaluations.
TABLES = ("table1.csv", "claims.json", "tables/success.csv")
REPORT = "report/index.html"
#: What a batch can stop at, each with the place to look at then.
TARGETS = {"policies": "reference", "tables": "tables", "report": REPORT}
MOST_SEEDS = 1000


@dataclass(frozen=True)
class Job:
    """One step; its files are relative to the batch's folder."""

    rule: str  # rule of the Snakefile that does it
    name: str  # what people call it, such as "train hrl_dcs seed 0"
    output: Path  # the file that it writes; the step is done when it is there
    label: str  # stem of logs/LABEL.log, which takes what it prints, and of timings/LABEL.tsv with its seconds


@dataclass(frozen=True)
class Plan:
    """Everything that a batch is to do."""

    preset: str  # preset of trainings and notebooks
    methods: tuple[str, ...]  # names of methods in the registry's order
    seeds: tuple[int, ...]  # seeds of each method that learns, in order
    threads: int  # cores of one step
    environment: str  # version of the environment; results of another one are made anew
    configurations: dict[str, str]  # a digest of each method's configuration; likewise
    # names of the notebooks
    notebooks: tuple[str, ...] = field(default_factory=lambda: tuple(path.stem for path in notebook_files()))

    @classmethod
    def make(cls, preset: str, methods: list[str], seeds: list[int], threads: int) -> Plan:
        """Plan the batch of some methods and seeds, in any order; an unknown preset or method is a UserError."""
        selection = {get_method(method).name for method in methods}
        names = [name for name in METHODS if name in selection]
        digests = {name: _digest(METHODS[name].config(preset)) for name in names}
        return cls(preset, tuple(names), tuple(sorted(set(seeds))), threads, ENVIRONMENT_VERSION, digests)

    @classmethod
    def read(cls, path: Path) -> Plan:
        """Read a plan that a batch has written; a UserError where the file is missing or holds none."""
        plan: Plan = read_record(path, "plan of a batch", cls)
        return plan

    def learns(self, method: str) -> bool:
        """Return whether a method has to be trained."""
        return METHODS[method].learns

    def runs(self) -> list[tuple[str, int]]:
        """Return each method with each of its seeds; a method that does not learn has seed 0 alone."""
        return [(m, s) for m in self.methods for s in (self.seeds if self.learns(m) else (0,))]

    def policies(self) -> list[str]:
        """Return the files that say that a training has ended."""
        return [f"{folder(m, s)}/run.json" for m, s in self.runs() if self.learns(m)]

    def evaluations(self) -> list[str]:
        """Return the files of all evaluations."""
        return [f"{folder(m, s)}/{check}.json" for m, s in self.runs() for check in evaluations_of(m)]

    def jobs(self, until: str = "report") -> list[Job]:
        """Return the steps up to one of ``TARGETS``, each after those that it needs."""
        jobs = []
        for method, seed in self.runs():
            name, label, where = f"{method} seed {seed}", f"{method}_seed{seed}", Path(folder(method, seed))
            if self.learns(method):
                jobs.append(Job("train", f"train {name}", where / "run.json", f"train_{label}"))
            if until != "policies":
                for check in evaluations_of(method):
                    file, stem = where / f"{check}.json", f"evaluate_{label}_{check}"
                    jobs.append(Job("evaluate", f"{check} of {name}", file, stem))
        if until != "policies":
            jobs.append(Job("tables", "tables", Path(TABLES[-1]), "tables_all"))
        if until == "report":
            for name in self.notebooks:
                jobs.append(Job("notebook", f"notebook {name}", Path(f"notebooks/{name}.ipynb"), f"notebook_{name}"))
            jobs.append(Job("report", "report", Path(REPORT), "report_all"))
        return jobs


def folder(method: str, seed: int | str) -> str:
    """Return a run's folder, relative to the batch's."""
    return f"reference/{method}/seed{seed}"


def _digest(config: TrainingConfig) -> str:
    return hashlib.sha256(json.dumps(to_dict(config), sort_keys=True).encode()).hexdigest()[:16]


def parse_seeds(text: str) -> list[int]:
    """Return the seeds that a text such as ``0-4`` or ``0,2,7`` names; a UserError says what else was given."""
    seeds: list[int] = []
    for part in text.split(","):
        numbers = re.fullmatch(r"\s*([0-9]{1,9})(?:-([0-9]{1,9}))?\s*", part)
        if numbers is None:
            raise UserError(f"--seeds: expected numbers and ranges such as 0-4 or 0,2,7; got {text!r}")
        low, high = int(numbers[1]), int(numbers[2] or numbers[1])
        if high < low or high - low >= MOST_SEEDS:
            raise UserError(f"--seeds: expected a range upwards of at most {MOST_SEEDS} seeds; got {part.strip()!r}")
        seeds += range(low, high + 1)
    return seeds
