"""``reproduce batch``: starts Snakemake on the plan, shows how far it is, and says what failed."""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pandas as pd
from tqdm.auto import tqdm

from reproduce.experiments.workflow.plan import TARGETS, Job, Plan, cores
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.files import write_atomically, write_json
from reproduce.storage.provenance import record_origin

HERE = Path(__file__).parent
PROFILES = ("local", "slurm")
LOCK = ".batch.lock"
LOOK_EVERY = 1.0  # s
TAIL = 3  # lines of a failed job's log that are shown
_PR_SET_PDEATHSIG = 1

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
    """Do what of a plan is not done yet.

    Args:
        plan: What to do.
        out: Folder of the batch, laid out as results/ is.
        profile: ``local``, ``slurm`` or a folder with a Snakemake profile.
        slots: Jobs at once.
        until: One of ``TARGETS``.
        dry_run: Only say what is left.
        echo: Takes lines for people.

    Raises:
        UserError: When the folder cannot be written or belongs to another batch under way.
        RunFailedError: With the list of what failed.
    """
    settings = _profile(profile)
    if slots < 1:
        raise UserError(f"--slots: expected at least 1, got {slots}")
    if until not in TARGETS:
        raise UserError(f"--until: expected one of {', '.join(TARGETS)}; got {until!r}")
    out, jobs = out.resolve(), plan.jobs(until)
    if dry_run:
        _tell_what_is_left(jobs, out, slots, echo)
        return
    with _only_one(out) as lock:
        _write_plan(plan, out)
        command = _command(settings, out, slots, plan.threads, until)
        begun = time.time()
        code = _follow(command, lock, jobs, out, slots, echo)
    failed = [job for job in jobs if not (out / job.output).is_file()]
    if code or failed:
        raise RunFailedError(_what_failed(failed, code, out, begun))
    _write_timings(jobs, out)


def _profile(profile: str) -> Path:
    settings = HERE / "profiles" / profile if profile in PROFILES else Path(profile)
    if not (settings / "config.yaml").is_file():
        raise UserError(
            f"--profile: expected one of {', '.join(PROFILES)} or a folder with config.yaml; got {profile!r}"
        )
    return settings.resolve()


@contextmanager
def _only_one(out: Path) -> Iterator[IO[str]]:
    """Hold the folder's lock; the kernel lets it go when the last process that holds it ends, however it does."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = (out / LOCK).open("a+", encoding="utf-8")
    except OSError as error:
        raise UserError(f"{out}: the batch cannot write there: {error.strerror}") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            who = lock.read().strip() or "another process"
            raise UserError(
                f"{out}: another batch is under way there ({who}); wait for it or choose another --out"
            ) from None
        try:
            lock.truncate(0)
            lock.write(f"process {os.getpid()}")
            lock.flush()
        except OSError as error:
            raise UserError(f"{out}: the batch cannot write there: {error.strerror}") from None
        yield lock


def _write_plan(plan: Plan, out: Path) -> None:
    try:
        write_json(out / "batch.json", plan.as_data())
        (out / "logs").mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: the batch cannot write there: {error.strerror}") from None


def _command(settings: Path, out: Path, slots: int, threads: int, until: str) -> list[str]:
    limits = ["--cores", str(slots * threads), "--jobs", str(slots)]
    return [
        *(sys.executable, "-m", "snakemake", f"until_{until}"),
        *("--snakefile", str(HERE / "Snakefile"), "--directory", str(out), "--profile", str(settings), *limits),
    ]


def _die_with_parent() -> None:
    """Have this process told to end when its parent dies, by whatever: no Snakemake without its batch."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _follow(command: list[str], lock: IO[str], jobs: list[Job], out: Path, slots: int, echo: Echo) -> int:
    """Start Snakemake, show what gets done; return its exit code."""
    done = {job for job in jobs if (out / job.output).is_file()}
    echo(f"{out}: {len(done)} of {len(jobs)} steps are there")
    with (out / "logs" / "snakemake.log").open("a", encoding="utf-8") as log:
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            # Snakemake holds the lock too, so that nobody else starts while it winds up after a kill of the batch.
            pass_fds=(lock.fileno(),),
            preexec_fn=_die_with_parent,
        )
        with tqdm(total=len(jobs), initial=len(done), unit="step", desc="batch", disable=None) as bar:
            while True:
                code = process.poll()
                now = {job for job in jobs if (out / job.output).is_file()}
                if code is None:  # Snakemake notes the seconds a little after the file is there
                    now = {job for job in now if job in done or (out / job.timing).is_file()}
                for job in jobs:
                    if job in now - done:
                        bar.write(f"done: {job.name}{_took(job, out)}", file=sys.stdout)
                bar.update(len(now) - len(done))
                done = now
                bar.set_postfix_str(f"about {_readable(remaining(jobs, done, out, slots))} left", refresh=False)
                if code is not None:
                    return code
                try:
                    time.sleep(LOOK_EVERY)
                except KeyboardInterrupt:
                    process.send_signal(signal.SIGTERM)
                    process.wait()
                    raise


def remaining(jobs: list[Job], done: set[Job], out: Path, slots: int) -> float:
    """Seconds that the rest may take: as long as jobs of the same kind took here, or a guess."""
    measured: dict[str, list[float]] = {}
    for job in done:
        seconds = _seconds(job, out)
        if seconds is not None:
            measured.setdefault(job.rule, []).append(seconds / job.guess)
    shares = {rule: sum(ratios) / len(ratios) for rule, ratios in measured.items()}
    left = [job.guess * shares.get(job.rule, 1.0) for job in jobs if job not in done]
    return max(sum(left) / slots, max(left, default=0.0))


def _seconds(job: Job, out: Path) -> float | None:
    try:
        return float(pd.read_csv(out / job.timing, sep="\t")["s"].iloc[-1])
    except (OSError, ValueError, KeyError, IndexError):
        return None


def _took(job: Job, out: Path) -> str:
    seconds = _seconds(job, out)
    return "" if seconds is None else f" ({_readable(seconds)})"


def _write_timings(jobs: list[Job], out: Path) -> None:
    """Write ``timings.csv``: seconds of each step, as Snakemake measured them."""
    rows = [{"rule": j.rule, "step": j.name, "output": str(j.output), "seconds": _seconds(j, out)} for j in jobs]
    write_atomically(out / "timings.csv", lambda path: pd.DataFrame(rows).to_csv(path, index=False))
    record_origin(out / "timings.csv")


def _readable(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )


def _tell_what_is_left(jobs: list[Job], out: Path, slots: int, echo: Echo) -> None:
    done = {job for job in jobs if (out / job.output).is_file()}
    for job in jobs:
        if job not in done:
            echo(f"{job.name}: about {_readable(job.guess)}")
    echo(f"{len(jobs) - len(done)} of {len(jobs)} steps left, about {_readable(remaining(jobs, done, out, slots))}")


def _what_failed(failed: list[Job], code: int, out: Path, begun: float) -> str:
    """Jobs that ran and failed, each with the end of its log, and how many wait for them."""
    told = []
    waiting = 0
    for job in failed:
        lines = _log_lines(out / job.log, begun)
        if lines:
            told.append(f"{job.name}: {' / '.join(lines[-TAIL:])} ({out / job.log})")
        else:
            waiting += 1
    if not told:
        lines = _log_lines(out / "logs" / "snakemake.log")
        told.append(f"Snakemake ended with code {code}: {' / '.join(lines[-TAIL:])} ({out / 'logs' / 'snakemake.log'})")
    rest = f"; {waiting} steps wait for that" if waiting else ""
    return f"batch failed: {'; '.join(told)}{rest}; the same command goes on from there"


def _log_lines(path: Path, since: float = 0.0) -> list[str]:
    """Lines of a log that was written to since then."""
    try:
        if path.stat().st_mtime < since:
            return []
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]


def default_slots() -> int:
    """Jobs at once on this machine: one for two cores."""
    return max(1, cores() // 2)
