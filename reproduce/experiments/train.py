"""Trains a method into a run folder: progress bar, progress.csv, checkpoints, provenance."""

from __future__ import annotations

import fcntl
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from stable_baselines3.common.utils import set_random_seed
from tqdm.auto import tqdm

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.experiments.methods import Method, Training, export_policy
from reproduce.learning.config import TrainingConfig, to_dict
from reproduce.storage.checkpoint import Progress, delete_checkpoint, has_checkpoint, load_checkpoint, save_checkpoint
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_atomically, write_json
from reproduce.storage.provenance import provenance

LOCK = ".lock"
THREADS = 1  # for networks of this size one thread is faster than two (measured), and workers need the other core


def train(
    method: Method,
    config: TrainingConfig,
    seed: int,
    folder: Path,
    preset: str,
    resume: bool = False,
    quiet: bool = False,
    tensorboard: Path | None = None,
) -> pd.DataFrame:
    """Train a method and write its run folder; return the rows of ``progress.csv``.

    Args:
        method: What to train.
        config: Its configuration.
        seed: Of networks, scenes and minibatches.
        folder: To write.
        preset: Name that the configuration comes from.
        resume: Go on from the folder's checkpoint.
        quiet: No progress bar.
        tensorboard: Folder for TensorBoard's logs of what ``progress.csv`` holds, if wanted.

    Raises:
        UserError: When the method does not learn, the folder holds a finished run, or there is nothing to resume.
    """
    if method.train is None:
        raise UserError(f"method: {method.name!r} does not learn; evaluate it as it is")
    _check_folder(folder, resume)
    complete = _complete(method, config, seed, preset)
    origin = provenance()  # of the code that trains; the checkout may move on while it does
    th.set_num_threads(THREADS)
    set_random_seed(seed)
    training = method.train(config, seed)
    try:
        progress, rows = Progress(0, 0, 0.0), []
        if resume:
            progress = load_checkpoint(folder, training.learners, complete)
            rows = _read_rows(folder, progress.update)
            training.restart(progress.update)
        write_json(folder / "config.json", complete)
        with _logged(tensorboard, progress.steps) as log:
            rows = _loop(training, complete, folder, progress, rows, quiet, log)
        _finish(training, method, complete, folder, rows, origin)
    finally:
        training.close()
    return pd.DataFrame(rows)


@contextmanager
def _logged(folder: Path | None, steps: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Something that takes rows of ``progress.csv`` and logs them for TensorBoard, or forgets them.

    Args:
        folder: Where the logs go, or None.
        steps: Already done; what was logged beyond them before an interruption is superseded.
    """
    if folder is None:
        yield lambda row: None
        return
    from torch.utils.tensorboard.writer import SummaryWriter  # takes seconds

    def log(row: dict[str, Any]) -> None:
        for name, value in row.items():
            if name not in ("update", "env_steps") and math.isfinite(value):
                part = name.split("_")[0] if "_" in name else "training"
                writer.add_scalar(f"{part}/{name}", value, row["env_steps"])

    with SummaryWriter(str(folder), purge_step=steps or None) as writer:
        yield log


def train_as_needed(
    method: Method, config: TrainingConfig, seed: int, folder: Path, preset: str, quiet: bool = False
) -> None:
    """Train, as a step of a batch that may be started again at any time.

    A folder that holds the same training, finished, is left as it is; an unfinished one is gone on with. What another
    configuration, seed or environment version left there is set aside under another name. A second process waits for
    the first.
    """
    wanted = _complete(method, config, seed, preset)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w", encoding="utf-8") as lock:
        # A training may outlive the batch that started it; the kernel frees the lock when it ends, however it does.
        fcntl.flock(lock, fcntl.LOCK_EX)
        there = folder / "config.json"
        if there.is_file() and read_json(there, "configuration of a run") != wanted:
            _set_aside(folder)
        if (folder / "run.json").is_file():
            return
        train(method, config, seed, folder, preset, resume=has_checkpoint(folder), quiet=quiet)


def _set_aside(folder: Path) -> None:
    """Move what is in a run folder to one beside all runs, so that nothing takes it for this one."""
    superseded = folder.parent.parent.parent / "superseded"
    number = 1
    while (target := superseded / f"{folder.parent.name}-{folder.name}-{number}").exists():
        number += 1
    target.mkdir(parents=True)
    for path in list(folder.iterdir()):
        if path.name != LOCK:
            path.rename(target / path.name)


def _complete(method: Method, config: TrainingConfig, seed: int, preset: str) -> dict[str, Any]:
    """What ``config.json`` holds."""
    return {
        "method": method.name,
        "preset": preset,
        "seed": seed,
        "environment_version": ENVIRONMENT_VERSION,
        "training": to_dict(config),
    }


def _check_folder(folder: Path, resume: bool) -> None:
    if resume:
        if not has_checkpoint(folder):
            raise UserError(f"{folder}: no checkpoint to resume from")
        return
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: expected a folder, found a file")
    if (folder / "run.json").exists():
        raise UserError(f"{folder}: holds a finished run; choose another --out")
    if has_checkpoint(folder):
        raise UserError(f"{folder}: holds an unfinished run; go on with --resume, or choose another --out")


def _loop(
    training: Training,
    complete: dict[str, Any],
    folder: Path,
    progress: Progress,
    rows: list[dict[str, Any]],
    quiet: bool,
    log: Callable[[dict[str, Any]], None],
) -> list[dict[str, Any]]:
    config = training.config
    begun = time.monotonic() - progress.seconds
    steps, update = progress.steps, progress.update
    with tqdm(
        total=config.steps, initial=steps, unit="step", unit_scale=True, disable=quiet, desc=complete["method"]
    ) as bar:
        while steps < config.steps:
            row = training.update(steps)
            steps, update = steps + training.steps_per_update, update + 1
            seconds = time.monotonic() - begun
            rows.append({"update": update, "env_steps": steps, "seconds": round(seconds, 2), **row})
            log(rows[-1])
            bar.update(training.steps_per_update)
            bar.set_postfix(success=f"{row['success']:.2f}", under=f"{row['both_arms_under']:.2f}", refresh=False)
            if update % config.checkpoint_every == 0 and steps < config.steps:
                _write_rows(folder, rows)
                save_checkpoint(folder, training.learners, Progress(update, steps, seconds), complete)
                training.restart(update)
    return rows


def _finish(
    training: Training,
    method: Method,
    complete: dict[str, Any],
    folder: Path,
    rows: list[dict[str, Any]],
    origin: dict[str, Any],
) -> None:
    _write_rows(folder, rows)
    export_policy(folder, method, training)
    # Written last: a folder with run.json is a finished run.
    done = {"steps": int(rows[-1]["env_steps"]), "seconds": float(rows[-1]["seconds"])}
    summary = {"method": method.name, "seed": complete["seed"], "preset": complete["preset"]}
    write_json(folder / "run.json", {**summary, **origin, **done})
    delete_checkpoint(folder)


def _write_rows(folder: Path, rows: list[dict[str, Any]]) -> None:
    table = pd.DataFrame(rows)
    write_atomically(folder / "progress.csv", lambda path: table.to_csv(path, index=False, float_format="%.5g"))


def _read_rows(folder: Path, updates: int) -> list[dict[str, Any]]:
    try:
        table = pd.read_csv(folder / "progress.csv")
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / 'progress.csv'}: not readable: {error}") from None
    rows = table[table["update"] <= updates].to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]
