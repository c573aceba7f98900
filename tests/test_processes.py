"""Processes are ended by real signals: what ends with them, which code they leave, and what they say."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

import pytest
from sessions import alive, nobody_left, wait_for  # type: ignore[import-not-found]  # pytest puts this folder on the path

from reproduce.storage.errors import RunFailedError
from reproduce.storage.processes import end_with, map_in_processes

Answer = TypeVar("Answer")

#: Starts two workers that sleep for ten minutes each, and ends as a command does.
COMMAND = """
import os, sys, time
from pathlib import Path
from reproduce.storage.processes import map_in_processes, stop_signals

def job(folder):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(600)

if __name__ == "__main__":
    with stop_signals() as stop:
        try:
            map_in_processes(job, [sys.argv[1]] * 8, workers=2)
        except KeyboardInterrupt:
            sys.exit(stop.code)
"""

#: Presses Ctrl-C on itself when its pool has made the thread that looks after the workers and not yet started it.
STARTING = """
import os, signal, sys
from concurrent.futures import process
from reproduce.storage.processes import map_in_processes, stop_signals

class Late(process._ExecutorManagerThread):
    def start(self):
        os.kill(os.getpid(), signal.SIGINT)
        super().start()

process._ExecutorManagerThread = Late
if __name__ == "__main__":
    with stop_signals() as stop:
        try:
            map_in_processes(abs, range(900), workers=2)
        except KeyboardInterrupt:
            sys.exit(stop.code)
"""


def start(folder: Path) -> subprocess.Popen[str]:
    """Start the command and wait until both workers are at work."""
    (folder / "seen").mkdir()
    (folder / "command.py").write_text(COMMAND)
    arguments = [sys.executable, str(folder / "command.py"), str(folder / "seen")]
    process = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    wait_for(lambda: len(list((folder / "seen").iterdir())) == 2)
    return process


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("whole_group", [False, True])
def test_a_signal_ends_a_command_and_its_workers_without_a_word(number: int, whole_group: bool, tmp_path: Path) -> None:
    process = start(tmp_path)
    (os.killpg if whole_group else os.kill)(process.pid, number)
    said, _ = process.communicate(timeout=20)
    assert (process.returncode, said) == (128 + number, "")
    assert nobody_left(process.pid)


@pytest.mark.process
def test_no_worker_outlives_a_command_that_is_killed(tmp_path: Path) -> None:
    process = start(tmp_path)
    assert len(alive(process.pid)) >= 4  # the command, the fork server, two workers
    process.kill()
    process.wait()
    assert nobody_left(process.pid)


@pytest.mark.process
def test_a_process_without_python_ends_with_its_parent_too(tmp_path: Path) -> None:
    code = (
        "import os, subprocess, time; from functools import partial; from reproduce.storage.processes import end_with\n"
        "subprocess.Popen(['sleep', '600'], preexec_fn=partial(end_with, os.getpid())); print('go', flush=True)\n"
        "time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None and process.stdout.readline() == "go\n"
    assert len(alive(process.pid)) == 2
    process.kill()
    process.wait()
    assert nobody_left(process.pid)


@pytest.mark.process
def test_a_process_whose_parent_has_gone_before_it_began_ends_at_once() -> None:
    somebody_else = os.getppid()
    process = subprocess.Popen(["sleep", "600"], preexec_fn=partial(end_with, somebody_else))
    assert process.wait(timeout=20) == -signal.SIGKILL


@pytest.mark.process
def test_answers_come_in_order_and_a_worker_that_dies_is_named() -> None:
    assert map_in_processes(abs, [-3, 2, -1], workers=2) == [3, 2, 1]
    with pytest.raises(RunFailedError, match="worker process was killed or crashed"):
        map_in_processes(os._exit, [7, 7, 7], workers=2)
    with pytest.raises(ValueError, match="negative"):
        map_in_processes(time.sleep, [0.0, -1.0, 600.0], workers=2)


@pytest.mark.process
def test_an_interruption_in_the_progress_bar_leaves_no_worker() -> None:
    """While somebody still held the error, workers went on, and the command's end waited for all their jobs."""

    def interrupt(answers: Iterable[Answer]) -> Iterator[Answer]:
        for answer in answers:
            yield answer
            raise KeyboardInterrupt

    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt) as held:
        map_in_processes(time.sleep, [0.0, 600.0, 600.0, 600.0], workers=2, watch=interrupt)
    assert wait_for(lambda: set(multiprocessing.active_children()) <= before, 10) and held


@pytest.mark.process
def test_ctrl_c_while_a_pool_starts_waits_until_it_stands(tmp_path: Path) -> None:
    """It left a thread that was never started and workers with semaphores that were gone, which both complained."""
    (tmp_path / "command.py").write_text(STARTING)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "command.py")],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    said, _ = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, "")
    assert nobody_left(process.pid)


@pytest.mark.process
def test_modules_are_imported_once_for_all_workers(tmp_path: Path) -> None:
    (tmp_path / "slow_to_import.py").write_text("import os\nWHO = os.getpid()\ndef who(x): return WHO, os.getpid()\n")
    code = (
        "from slow_to_import import who; from reproduce.storage.processes import map_in_processes\n"
        "if __name__ == '__main__': print(*[n for pair in map_in_processes(who, 'ab', workers=2) for n in pair])"
    )
    (tmp_path / "command.py").write_text(code)
    surroundings = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    told = subprocess.check_output([sys.executable, str(tmp_path / "command.py")], env=surroundings, text=True)
    first, one, second, two = map(int, told.split())
    assert first == second and first not in (one, two)


@pytest.mark.process
def test_workers_of_environments_import_nothing_that_learns() -> None:
    code = "import sys, reproduce.learning.worker_process; print({'torch', 'stable_baselines3'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


@pytest.mark.process
def test_a_signal_that_python_drops_in_a_callback_comes_again() -> None:
    """Imports end in such a callback, so that a signal could be lost while a command started."""
    code = (
        "import os, signal, sys, time, weakref; from reproduce.storage.processes import stop_signals\n"
        "class Thing: pass\n"
        "with stop_signals() as stop:\n"
        "    try:\n"
        "        thing = Thing(); seen = weakref.ref(thing, lambda _: os.kill(os.getpid(), 15)); del thing\n"
        "        time.sleep(20)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(stop.code)\n"
    )
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (143, "") and time.monotonic() - begun < 15
