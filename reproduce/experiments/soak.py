"""A long run of random actions over all scenes: nothing raises, every number stays finite, memory stands still.

Memory is judged by the resident set of each process, read from ``/proc/self/statm`` at ``SAMPLES`` evenly spaced
steps. The figure is the median of the samples in the last tenth of the run over the median of those between 50 and 60 %
of it; it may exceed 1 by less than ``LARGEST_GROWTH``. Runs of fewer than ``SETTLED`` steps a process report the figure
and are not judged by it, as caches still fill. Which combinations of posture, task and ground were met is judged once
there were ``EPISODES_A_KIND`` episodes for each.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from multiprocessing.connection import Connection, wait
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.observation import BOUND, SIZE, as_dict
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.scene import task_distribution
from lunar_rescue.scenes.terrain import KINDS
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.files import write_json
from reproduce.storage.paths import COMMITTED
from reproduce.storage.provenance import provenance

STEPS = 1_000_000
FIRST_SEED = 3_000_000  # of the scenes; the training split, where nothing is tested
SAMPLES, KEPT = 200, 40  # samples of memory a process: taken, and kept in the file
LARGEST_GROWTH = 0.01
SETTLED = 50_000  # steps a process, from which on memory is judged
EPISODES_A_KIND = 8
LONGEST_HOLD = 40  # steps for which an action may be held
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Record:
    """What one process has seen so far."""

    steps: int = 0
    episodes: int = 0
    seconds: float = 0.0
    largest_speed: float = 0.0  # m/s, of the body; a simulation that blows up shows here first
    ends: Counter[str] = field(default_factory=Counter)
    scenes: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    samples: list[tuple[int, int, int]] = field(default_factory=list)  # steps, episodes, bytes
    fault: str = ""


def resident_bytes() -> int:
    """Resident set of this process."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE


# -- judging -----------------------------------------------------------------------------------------------------------
def observation_fault(vector: Any) -> str:
    """What is wrong with a flat observation; empty if nothing is."""
    if not isinstance(vector, np.ndarray) or vector.shape != (SIZE,) or vector.dtype != np.float32:
        found = f"{type(vector).__name__} {getattr(vector, 'shape', '')} {getattr(vector, 'dtype', '')}"
        return f"observation: expected float32 ({SIZE},), got {' '.join(found.split())}"
    if not np.isfinite(vector).all():
        return f"observation: not finite at {np.flatnonzero(~np.isfinite(vector)).tolist()[:5]}"
    if np.abs(vector).max() > BOUND:
        return f"observation: beyond {BOUND:g} at {np.flatnonzero(np.abs(vector) > BOUND).tolist()[:5]}"
    return ""


def step_fault(env: LunarRescueEnv, vector: Any, reward: float) -> str:
    """What is wrong after a step: reward, observation, the state of body or robot; empty if nothing is."""
    if not math.isfinite(reward):
        return f"reward: {reward!r}"
    for name, state in (("body", env.episode.body), ("robot", env.episode.robot)):
        for part in fields(state):
            if not np.isfinite(getattr(state, part.name)).all():
                return f"{name} {part.name}: not finite"
    return observation_fault(vector)


def memory_growth(samples: Sequence[int]) -> float:
    """Median of the last tenth of evenly spaced samples over the median of those from 50 to 60 %, minus 1."""
    count = len(samples)
    if count < 10:
        return 0.0
    return median(samples[count * 9 // 10 :]) / median(samples[count // 2 : count * 6 // 10]) - 1.0


def judge(records: Sequence[Record]) -> list[str]:
    """What failed, one line each; empty if nothing did."""
    faults = [f"process {i}: {r.fault}" for i, r in enumerate(records) if r.fault]
    for index, record in enumerate(records):
        growth = memory_growth([sample[2] for sample in record.samples])
        if record.steps >= SETTLED and not growth < LARGEST_GROWTH:
            faults.append(
                f"process {index}: memory grew by {100 * growth:.2f} % over the last half, "
                f"{_bytes_an_episode(record):.0f} bytes an episode; allowed {100 * LARGEST_GROWTH:g} %"
            )
    seen = {kind for record in records for kind in record.scenes}
    wanted = {(posture, task, terrain) for posture, task in task_distribution() for terrain in KINDS}
    if sum(r.episodes for r in records) >= EPISODES_A_KIND * len(wanted) and wanted - seen:
        missing = ", ".join(" ".join(kind) for kind in sorted(wanted - seen)[:3])
        faults.append(f"{len(wanted - seen)} of {len(wanted)} kinds of scene were never met: {missing}")
    return faults


def _bytes_an_episode(record: Record) -> float:
    """Growth of memory over the last half of a process's run."""
    half = record.samples[len(record.samples) // 2 :]
    episodes = half[-1][1] - half[0][1] if half else 0
    return (half[-1][2] - half[0][2]) / episodes if episodes else 0.0


# -- running -----------------------------------------------------------------------------------------------------------
def random_actions(rng: np.random.Generator) -> Iterator[NDArray[np.float64]]:
    """Actions held for up to ``LONGEST_HOLD`` steps, so that the arms get somewhere; one stretch in four is noise."""
    while True:
        stretch, noise = int(rng.integers(1, LONGEST_HOLD + 1)), rng.random() < 0.25
        action = rng.uniform(-1, 1, JOINTS)
        for _ in range(stretch):
            yield action
            if noise:
                action = rng.uniform(-1, 1, JOINTS)


def scenes_of(index: int, processes: int) -> Iterator[Scene]:
    """Scenes of one process: all postures and tasks in turn, every seed in one process only."""
    pairs = task_distribution()
    ahead = index * len(pairs) // processes  # so that a short run's processes do not all meet the same
    for turn in itertools.count():
        posture, task = pairs[(turn + ahead) % len(pairs)]
        yield sample_scene(FIRST_SEED + index + turn * processes, posture=posture, task=task)


def run_share(env: LunarRescueEnv, steps: int, index: int, processes: int, report: Callable[[Record], None]) -> Record:
    """Step one environment; report ``SAMPLES`` times, and stop at the first fault."""
    record, begun = Record(), time.perf_counter()
    scene: Scene | None = None
    try:
        actions = random_actions(np.random.default_rng([FIRST_SEED, index]))
        scenes = scenes_of(index, processes)
        done, sampled = True, 0
        while record.steps < steps and not record.fault:
            if done:
                scene = next(scenes)
                _begin(env, scene, record)
            vector, reward, terminated, truncated, info = env.step_flat(next(actions))
            record.steps, done = record.steps + 1, terminated or truncated
            record.fault = record.fault or step_fault(env, vector, reward)
            record.largest_speed = max(record.largest_speed, math.hypot(*env.episode.body.velocity))
            if done:
                record.episodes += 1
                record.ends[info["failure"] or "success"] += 1
            if record.steps * SAMPLES // steps > sampled:
                sampled = record.steps * SAMPLES // steps
                record.samples.append((record.steps, record.episodes, resident_bytes()))
                record.seconds = time.perf_counter() - begun
                report(record)
    except (BrokenPipeError, EOFError):  # the parent is gone: nobody is left to tell
        raise
    except Exception as error:  # that nothing raises is what is checked
        where = traceback.extract_tb(error.__traceback__)[-1]
        record.fault = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    record.seconds = time.perf_counter() - begun
    if record.fault:
        drawn = f"scene {scene.seed} ({scene.posture} {scene.task} {scene.terrain.kind})" if scene else "no scene"
        record.fault = f"step {record.steps}, {drawn}: {record.fault}"
    return record


def _begin(env: LunarRescueEnv, scene: Scene, record: Record) -> None:
    vector, _ = env.reset_flat(options={"scene": scene})
    record.scenes[scene.posture, scene.task, scene.terrain.kind] += 1
    record.fault = step_fault(env, vector, 0.0)
    if not record.fault and not env.observation_space.contains(as_dict(vector)):
        record.fault = "observation: outside observation_space"


def _work(pipe: Connection, steps: int, index: int, processes: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business; it ends this process
    try:
        pipe.send((run_share(LunarRescueEnv(), steps, index, processes, lambda r: pipe.send((r, False))), True))
    except (BrokenPipeError, EOFError):
        pass


def soak(steps: int = STEPS, processes: int | None = None, quiet: bool = False) -> list[Record]:
    """Run and return what each process saw; ends early at the first fault.

    Raises:
        UserError: On a number of steps that is none.
    """
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise UserError(f"steps: expected at least 1, got {steps}")
    processes = min(steps, processes or len(os.sched_getaffinity(0)))
    context = multiprocessing.get_context("forkserver")
    records, running, workers = [Record() for _ in range(processes)], {}, []
    try:
        for index in range(processes):
            ours, theirs = context.Pipe(duplex=False)
            share = steps * (index + 1) // processes - steps * index // processes
            workers.append(context.Process(target=_work, args=(theirs, share, index, processes), daemon=True))
            workers[-1].start()
            theirs.close()
            running[ours] = index
        with tqdm(total=steps, unit="step", unit_scale=True, disable=quiet, desc="soak") as bar:
            while running and not any(record.fault for record in records):
                ready = wait(list(running))
                for pipe, index in [(pipe, index) for pipe, index in running.items() if pipe in ready]:
                    before = records[index].steps
                    if _receive(pipe, records, index):
                        del running[pipe]
                    bar.update(records[index].steps - before)
    finally:
        for worker in workers:
            worker.terminate()  # does nothing to one that has ended
            worker.join()
    return records


def _receive(pipe: Any, records: list[Record], index: int) -> bool:
    """Take a message of a process; return whether it was its last."""
    try:
        records[index], last = pipe.recv()
    except (EOFError, ConnectionResetError):
        records[index].fault, last = f"died after step {records[index].steps}", True
    return bool(last)


# -- telling -----------------------------------------------------------------------------------------------------------
def summary(records: Sequence[Record], faults: Sequence[str]) -> dict[str, Any]:
    """What ``soak.json`` holds."""
    ends: Counter[str] = sum((r.ends for r in records), Counter())
    scenes: Counter[tuple[str, str, str]] = sum((r.scenes for r in records), Counter())
    kinds = list(zip(*scenes, strict=True)) or [(), (), ()]
    return {
        "passed": not faults,
        "faults": list(faults),
        "steps": sum(r.steps for r in records),
        "episodes": sum(r.episodes for r in records),
        "steps_per_s": round(sum(r.steps / r.seconds for r in records if r.seconds), 1),
        "ends": dict(sorted(ends.items())),
        "postures": len(set(kinds[0])),
        "tasks": sorted(set(kinds[1])),
        "terrains": sorted(set(kinds[2])),
        "kinds_of_scene": len(scenes),
        "largest_body_speed": round(max(r.largest_speed for r in records), 3),
        "memory_judged": all(r.steps >= SETTLED for r in records),
        "largest_memory_growth": round(max(memory_growth([s[2] for s in r.samples]) for r in records), 5),
        "processes": [_process(r) for r in records],
        "origin": provenance(),
    }


def _process(record: Record) -> dict[str, Any]:
    raw = asdict(record)
    return {
        **{key: raw[key] for key in ("steps", "episodes")},
        "seconds": round(record.seconds, 2),
        "memory_growth": round(memory_growth([s[2] for s in record.samples]), 5),
        "memory_bytes_per_episode": round(_bytes_an_episode(record), 1),
        "samples": [
            {"steps": steps, "episodes": episodes, "rss_bytes": resident}
            for steps, episodes, resident in record.samples[SAMPLES // KEPT - 1 :: SAMPLES // KEPT]
        ],
    }


def run_soak(steps: int, path: Path | None, quiet: bool = False) -> dict[str, Any]:
    """The command: run, judge, write the file and return what it holds.

    Without a path, a run of at least ``STEPS`` steps goes to ``results/soak.json`` and a shorter one to no file.

    Raises:
        UserError: On a number of steps that is none.
        RunFailedError: If a check failed; the file is written before.
    """
    records = soak(steps, quiet=quiet)
    faults = judge(records)
    result = summary(records, faults)
    path = path or (COMMITTED / "soak.json" if steps >= STEPS else None)
    if path:
        write_json(path, result)
    if faults:
        raise RunFailedError(f"soak: {'; '.join(faults)}")
    return result
