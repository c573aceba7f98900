"""``reproduce batch``: one Snakemake a folder, which ends with its batch, and the list of what failed."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import IO

import pandas as pd

from reproduce.experiments.workflow.plan import TARGETS, Job, Plan
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.files import locked, write_json
from reproduce.storage.processes import end_with
from reproduce.storage.provenance import write_table

HERE = Path(__file__).parent
PROFILES = ("local", "slurm")
#: Snakemake's own lock outlives a kill and wants ``--unlock``. Steps hold locks of other names in the same folder.
LOCK = ".batch.lock"
TAIL = 3  # lines of a failed step's log that are shown

Echo = Callable[[str], None]


def run_batch(
    plan: Plan,
    out: Path,
    profile: str = "local",
    slots: int = 1,
    until: str = "report",
    dry_run: bool = False,
    echo: Echo = print,
) -> None:
    """Do what of a plan is not done yet; a ``RunFailedError`` lists what failed.

    ``out`` is laid out as results/ is; ``profile`` is ``local``, ``slurm`` or a folder with a Snakemake profile;
    ``slots`` are steps at once; ``until`` is one of ``TARGETS``; ``dry_run`` only says what is left; ``echo`` takes
    lines for people.
    """
    out, options = out.resolve(), _options(plan, profile, slots, until)
    if dry_run:
        _tell_what_is_left(plan, out, options, echo)
        return
    with locked(out, "the batch", name=LOCK) as lock:
        write_json(out / "batch.json", asdict(plan))
        start = time.time()
        code = _run(_command(out, out / "batch.json", options), out, lock, echo)
        jobs = plan.jobs(until)
        failures = [job for job in jobs if not (out / job.output).is_file()]
        if code or failures:
            raise RunFailedError(_what_failed(failures, code, out, start))
        _write_timings(jobs, out)


def _options(plan: Plan, profile: str, slots: int, until: str) -> list[str]:
    """Return Snakemake's target and options, or refuse what makes no sense."""
    settings = HERE / "profiles" / profile if profile in PROFILES else Path(profile)
    if not (settings / "config.yaml").is_file():
        names = ", ".join(PROFILES)
        raise UserError(f"--profile: expected one of {names} or a folder with config.yaml; got {profile!r}")
    if slots < 1:
        raise UserError(f"--slots: expected at least 1, got {slots}")
    if until not in TARGETS:
        raise UserError(f"--until: expected one of {', '.join(TARGETS)}; got {until!r}")
    limits = ["--cores", str(slots * plan.threads), "--jobs", str(slots)]
    return [f"until_{until}", "--profile", str(settings.resolve()), *limits]


def _command(folder: Path, plan: Path, options: list[str]) -> list[str]:
    where = ["--snakefile", str(HERE / "Snakefile"), "--directory", str(folder)]
    return [sys.executable, "-m", "snakemake", *options, *where, "--config", f"plan={plan}"]


def _run(command: list[str], out: Path, lock: IO[str], echo: Echo) -> int:
    """Run Snakemake, keep what it prints, pass on how far it is; return its exit code."""
    path = out / "logs" / "snakemake.log"
    path.parent.mkdir(exist_ok=True)
    with path.open("a", encoding="utf-8") as log:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            errors="replace",
            # Snakemake holds the lock too, so that nobody else starts before it is gone.
            pass_fds=(lock.fileno(),),
            preexec_fn=partial(end_with, os.getpid(), signal.SIGKILL),
        )
        with process:
            try:
                for line in process.stdout or ():
                    log.write(line)
                    log.flush()
                    if " steps (" in line:
                        echo(line.strip())
                return process.wait()
            finally:
                process.kill()  # its steps are told, as in Snakefile


def _tell_what_is_left(plan: Plan, out: Path, options: list[str], echo: Echo) -> None:
    """Tell which files Snakemake would make, and why; leave no trace where no batch is yet."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "batch.json"
        write_json(path, asdict(plan))
        command = [*_command(out if out.is_dir() else Path(scratch), path, options), "--dry-run"]
        result = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RunFailedError(f"batch: Snakemake ended with code {result.returncode}: {result.stderr.strip()[-400:]}")
    steps = 0
    for line in map(str.strip, (result.stdout + result.stderr).splitlines()):
        kind, _, rest = line.partition(": ")
        if kind == "output":
            steps += 1
            for name in rest.split(", "):
                echo(name)
        elif line.startswith(("reason: Missing", "reason: Input", "reason: Params", "reason: Set")):
            echo(f"  {line}")
    echo(f"{steps} steps left")


def _write_timings(jobs: list[Job], out: Path) -> None:
    """Write ``timings.csv``: seconds of each step, as Snakemake measured them."""
    files = {job.label: out / f"timings/{job.label}.tsv" for job in jobs}
    seconds = {label: pd.read_csv(file, sep="\t")["s"].iloc[-1] for label, file in files.items() if file.is_file()}
    rows = [(job.rule, job.name, job.output, seconds.get(job.label)) for job in jobs]
    write_table(out / "timings.csv", pd.DataFrame(rows, columns=["rule", "step", "output", "seconds"]))


def _what_failed(failures: list[Job], code: int, out: Path, start: float) -> str:
    """Return the steps that ran and failed, each with the end of its log, and how many wait for them."""
    logs = {job.name: out / f"logs/{job.label}.log" for job in failures}
    faults = [f"{name}: {end} ({log})" for name, log in logs.items() if (end := _end_of_log(log, start))]
    waiting = len(failures) - len(faults)
    if not faults:
        log = out / "logs" / "snakemake.log"
        faults = [f"Snakemake ended with code {code}: {_end_of_log(log, start)} ({log})"]
    rest = f"; {waiting} steps wait for that" if waiting else ""
    return f"batch failed: {'; '.join(faults)}{rest}; the same command goes on from there"


def _end_of_log(path: Path, since: float) -> str:
    """Return the last lines of a log that was written to since then, or nothing."""
    try:
        if path.stat().st_mtime < since:
            return ""
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    return " / ".join(lines[-TAIL:])
