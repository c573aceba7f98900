"""Trains a method into a run folder: progress bar, progress.csv, checkpoints, provenance.

A training that was interrupted goes on from its last checkpoint, or from its beginning where there was none yet, and
ends as if nothing had happened. An interruption itself writes no checkpoint: environments begin anew at each one, so a
checkpoint that was not planned would change everything after it.
"""

import itertools
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pandas as pd
import torch as th
from stable_baselines3.common.utils import set_random_seed
from tqdm.auto import tqdm

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.experiments.demonstrate import demonstrate
from reproduce.experiments.methods import Method, check_run_folder
from reproduce.experiments.recover import recoveries
from reproduce.learning.config import TrainingConfig
from reproduce.learning.demonstrations import play_back
from reproduce.learning.playback_files import play_back_once
from reproduce.learning.training import Training
from reproduce.learning.worker_process import WorkerError
from reproduce.storage.checkpoint import Progress, load_checkpoint, save_checkpoint
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.files import check_writable, locked, read_json, write_json, write_text
from reproduce.storage.paths import CHECKPOINT, RESULTS
from reproduce.storage.policies import save_policy
from reproduce.storage.provenance import provenance
from reproduce.storage.records import differences, to_dict

WHAT = "run folder"
START = Progress(0, 0, 0.0)
IMITATION_THREADS = 1  # a second thread gains little on networks of this size, and loses much where the core is busy
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

    ``folder`` is the run folder, which no other training may be writing; ``preset`` names where ``config`` comes from;
    ``resume`` goes on from the checkpoint; ``tensorboard`` is a folder for logs of what ``progress.csv`` holds. What
    cannot be begun or resumed there is a ``UserError``, a worker that died or a loss that is not finite a
    ``RunFailedError``; an interruption says in a line from where the training can go on.
    """
    run = _Run(method, config, seed, preset, folder, quiet)
    for place in (folder, tensorboard) if tensorboard else (folder,):
        check_writable(place / "config.json")
    if not folder.is_dir():
        run.check(resume)  # leaves no folder behind where there is nothing to do
    with locked(folder, WHAT):
        run.check(resume)
        return run.train(tensorboard)


def train_as_needed(
    method: Method, config: TrainingConfig, seed: int, folder: Path, preset: str, quiet: bool = False
) -> None:
    """Train, as a step of a batch that may be started again at any time.

    A folder that holds the same training, finished, is left as it is; an unfinished one is gone on with. What another
    configuration, seed or environment version left there is moved to ``superseded/`` in the folder. A second process
    waits for the first, as a training may outlive the batch that started it.
    """
    run = _Run(method, config, seed, preset, folder, quiet)
    with locked(folder, WHAT, wait=True):
        if (folder / "config.json").is_file() and run.changes():
            _set_aside(folder)
        if not (folder / "run.json").is_file():
            run.train()


def _set_aside(folder: Path) -> None:
    """Move the files of a run to a numbered folder inside its own."""
    targets = (folder / "superseded" / str(number) for number in itertools.count(1))
    target = next(target for target in targets if not target.exists())
    target.mkdir(parents=True)
    # The configuration goes last: as long as it is there, a set-aside that was killed is gone on with.
    for path in sorted(folder.iterdir(), key=lambda path: path.name == "config.json"):
        if path.is_file() and not path.name.startswith("."):  # the lock stays
            path.rename(target / path.name)


@dataclass
class _Run:
    """A training, how far it is, how far it was at its last checkpoint, and the folder that it writes."""

    method: Method
    config: TrainingConfig
    seed: int
    preset: str
    folder: Path
    quiet: bool = False
    progress: Progress = START
    saved: Progress = START
    rows: list[dict[str, Any]] = field(default_factory=list)
    start: Callable[[Any, int], Training] = field(init=False)

    def __post_init__(self) -> None:
        """Refuse a method that does not learn."""
        self.method.check_learns()
        self.start = cast("Callable[[Any, int], Training]", self.method.train)

    @property
    def description(self) -> dict[str, Any]:
        """Return what ``config.json`` holds of this training."""
        return {
            "method": self.method.name,
            "preset": self.preset,
            "seed": self.seed,
            "environment_version": ENVIRONMENT_VERSION,
            "training": to_dict(self.config),
        }

    def changes(self) -> list[str]:
        """Compare with the ``config.json`` that lies in the folder; return a text for each field that differs."""
        path = self.folder / "config.json"
        before = read_json(path, "configuration of a run")
        if not isinstance(before, dict) or not isinstance(before.get("training"), dict):
            raise UserError(f"{path}: expected the configuration of a training, as `reproduce train` writes it")
        try:
            return differences(before, self.description)
        except RecursionError:
            raise UserError(f"{path}: expected the configuration of a training, got data nested too deeply") from None

    def check(self, resume: bool) -> None:
        """Refuse what cannot be begun, or gone on with, in the folder as it is."""
        check_run_folder(self.folder, resume)
        if resume and (self.folder / "config.json").is_file() and (changes := self.changes()):
            raise UserError(f"{self.folder}: --resume with another configuration: {', '.join(changes[:3])}")

    def train(self, tensorboard: Path | None = None) -> pd.DataFrame:
        """Begin, or go on from the folder's checkpoint, and train to the end."""
        origin = provenance()  # of the code that trains; the checkout may move on while it does
        th.set_num_threads(THREADS)
        set_random_seed(self.seed)
        try:
            with closing(self.start(self.config, self.seed)) as training:
                self._restore(training)
                write_json(self.folder / "config.json", self.description)
                if self.config.priors.demonstrations and not self.progress.update:
                    self._imitate(training)
                with _tensorboard(tensorboard, self.progress.steps) as writer:
                    self._loop(training, writer)
                self._finish(training, origin)
        except (WorkerError, RunFailedError) as error:
            raise RunFailedError(f"{self.folder}: {error}") from error
        except KeyboardInterrupt:
            done, where = self.progress.update, f"update {self.saved.update}" if self.saved.update else "the beginning"
            words = f"interrupted after update {done}; --resume or --as-needed goes on from {where}"
            raise KeyboardInterrupt(f"{self.folder}: {words}") from None
        return pd.DataFrame(self.rows)

    def _restore(self, training: Training) -> None:
        if not (self.folder / CHECKPOINT).is_file():
            return
        self.progress = self.saved = load_checkpoint(self.folder, training.learners, self.description)
        path = self.folder / "progress.csv"
        try:
            rows: Any = pd.read_csv(path).loc[lambda table: table["update"] <= self.saved.update].to_dict("records")
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path}: not readable: {error}") from None
        self.rows = rows
        training.restart(self.saved.update)

    def _imitate(self, training: Training) -> None:
        """Let the training imitate demonstrations, which are made where they are not there yet; their time counts."""
        config: Any = self.config  # only those that imitate have demonstrations
        path = RESULTS / "scratch" / f"demonstrations_{config.imitation.scenes}.safetensors"
        rescues, made = demonstrate(config.imitation.scenes, path, tell=lambda line: None, quiet=self.quiet, wait=True)
        seen = {"weights": config.reward, "gamma": config.discount, "mirrored": config.priors.mirror}
        seen["places"] = config.seen_places
        rows: list[dict[str, Any]] = []
        about = {"scenes": config.imitation.scenes, "rescues": len(rescues)}
        played, waited = play_back_once(path.parent, rescues, **seen)
        begun = time.monotonic() - waited
        for turn in range(config.imitation.recoveries + 1):
            if turn:
                save_policy(self.folder, self.method.name, training.networks(), config.policy)
                fresh, share = recoveries(self.folder, rescues, quiet=self.quiet)
                played += play_back(fresh, **seen)
                about |= {"recoveries": len(played) - len(rescues), "student_rescues": round(share, 4)}
            th.set_num_threads(IMITATION_THREADS)
            for row in tqdm(training.imitate(played, self.seed + turn), desc="imitation", disable=self.quiet):
                rows.append({"round": turn, **row, "seconds": round(made + time.monotonic() - begun, 2)})
            th.set_num_threads(THREADS)
        write_text(self.folder / "imitation.csv", pd.DataFrame(rows).to_csv(index=False, float_format="%.5g"))
        steps, seconds = sum(len(one.observations) - one.begin for one in played), made + time.monotonic() - begun
        write_json(self.folder / "imitation.json", {**about, "steps": steps, "seconds": made})
        self.progress = self.saved = Progress(0, 0, seconds)

    def _loop(self, training: Training, writer: Any) -> None:
        total, start = self.config.steps, time.monotonic() - self.progress.seconds
        looks: dict[str, Any] = {"unit": "step", "unit_scale": True, "desc": self.method.name}
        with tqdm(total=total, initial=self.progress.steps, disable=self.quiet, **looks) as bar:
            while self.progress.steps < total:
                row = training.update(self.progress.steps)
                update, steps = self.progress.update + 1, self.progress.steps + training.steps_per_update
                seconds = time.monotonic() - start
                self.progress = Progress(update, steps, seconds)
                row = {"seconds": round(seconds, 2), **row}
                self.rows.append({"update": update, "env_steps": steps, **row})
                if writer:
                    _log(writer, row, steps)
                bar.update(training.steps_per_update)
                bar.set_postfix(success=f"{row['success']:.2f}", under=f"{row['both_arms_under']:.2f}", refresh=False)
                if update % self.config.checkpoint_every == 0 and steps < total:
                    self._write_rows()
                    save_checkpoint(self.folder, training.learners, self.progress, self.description)
                    self.saved = self.progress
                    training.restart(update)

    def _finish(self, training: Training, origin: dict[str, Any]) -> None:
        self._write_rows()
        save_policy(self.folder, self.method.name, training.networks(), training.config.policy)
        summary = {"method": self.method.name, "seed": self.seed, "preset": self.preset, **origin}
        totals: dict[str, Any] = {"steps": self.progress.steps, "seconds": round(self.progress.seconds, 2)}
        if self.config.priors.demonstrations:
            totals["demonstrations"] = read_json(self.folder / "imitation.json", "account of the imitation")
        write_json(self.folder / "run.json", {**summary, **totals})  # last: a folder that holds it is a finished run
        (self.folder / CHECKPOINT).unlink(missing_ok=True)

    def _write_rows(self) -> None:
        if self.rows:  # imitation alone leaves none
            write_text(self.folder / "progress.csv", pd.DataFrame(self.rows).to_csv(index=False, float_format="%.5g"))


def _tensorboard(folder: Path | None, steps: int) -> AbstractContextManager[Any]:
    """Open TensorBoard's logs, if wanted; what they hold beyond ``steps``, from before an interruption, is hidden."""
    if folder is None:
        return nullcontext()
    from torch.utils.tensorboard.writer import SummaryWriter  # takes seconds

    return SummaryWriter(str(folder), purge_step=steps or None)


def _log(writer: Any, row: dict[str, Any], steps: int) -> None:
    for name, value in row.items():
        if math.isfinite(value):
            writer.add_scalar(f"{name.split('_')[0] if '_' in name else 'training'}/{name}", value, steps)
