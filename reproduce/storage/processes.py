"""Processes that end together: workers with whoever started them, and a command, in good order, by a signal.

Ctrl-C and a terminal that closes reach a whole group of processes at once. Workers leave such signals to the command,
which stops them, says one line and ends with code 128 plus the signal's number.
"""

import ctypes
import math
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker, util
from types import FrameType
from typing import Any, TypeVar

from reproduce.storage.errors import RunFailedError

#: Signals by which people, terminals, schedulers and ``timeout`` ask a command to end.
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SAME_REQUEST = 1.0  # s
AGAIN = 0.05  # s
_TO_A_GROUP = (signal.SIGINT, signal.SIGHUP)  # what a terminal sends to workers as well
_LIBC = ctypes.CDLL(None, use_errno=True)  # loaded here, as little may happen between fork and exec
_PR_SET_PDEATHSIG = 1
_LONGEST_FOLDER = 70  # characters; a socket's whole path may have 107

Item = TypeVar("Item")
Result = TypeVar("Result")


def die_with_parent() -> None:
    """Kill this worker as soon as the process that started it has ended, however it did; a worker calls this first.

    A worker of ``multiprocessing`` is a child of the fork server, so the kernel's own notice of a parent's death would
    be of the wrong process. What a worker has of its starter is the end of a pipe that closes with it, which a thread
    watches. In a process that ``multiprocessing`` did not start, this does nothing.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    for number in _TO_A_GROUP:
        signal.signal(number, signal.SIG_IGN)

    def watch() -> None:
        parent.join()  # returns at once where the parent has gone already
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def end_with(parent: int, by: int = signal.SIGKILL) -> None:
    """Have the kernel send this process a signal when its parent ends: ``preexec_fn=partial(end_with, os.getpid())``.

    The parent may have ended before it could be watched. A signal that can be caught leaves time to stop others.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, int(by), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), by)


def start_fork_server(*modules: str) -> None:
    """Start the server that workers are forked from, deaf to Ctrl-C and hang-ups; so are workers from their start.

    It imports ``modules`` once for all workers, in its own time. A server that runs already stays as it is.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _TO_A_GROUP)
    own_folder = tempfile.gettempdir()
    if len(own_folder) > _LONGEST_FOLDER:  # TMPDIR is too long for sockets, whose folder is made once and remembered
        tempfile.tempdir = "/tmp"
        util.get_temp_dir()
        tempfile.tempdir = own_folder
    try:
        resource_tracker.ensure_running()  # ends with SIGINT unblocked
        signal.pthread_sigmask(signal.SIG_BLOCK, _TO_A_GROUP)
        forkserver.set_forkserver_preload(list(modules))
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # what came meanwhile comes now


def map_in_processes(
    job: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | None = None,
    prepare: Callable[..., object] | None = None,
    arguments: tuple[Any, ...] = (),
    watch: Callable[[Sequence[Future[Result]]], Iterable[Future[Result]]] = iter,
) -> list[Result]:
    """Return ``job(item)`` for each item, in order, from worker processes that no interruption leaves behind.

    There is one worker a core unless ``workers`` says how many; each first calls ``prepare(*arguments)``. What crosses
    over can be pickled. Modules of ``job`` and ``prepare`` are imported once for all workers; for others call
    ``start_fork_server`` before. ``watch``, such as a progress bar, passes the answers to come on one by one.

    Raises:
        RunFailedError: A worker was killed or crashed.
    """
    # Not a generator: one that is interrupted outside of itself, in a progress bar, is closed some time later, and
    # before it is, the interpreter's end waits for every job that is left.
    context, running = multiprocessing.get_context("forkserver"), set(multiprocessing.active_children())
    with ExitStack() as stack:
        try:
            with signals_held():  # an interruption would leave workers, threads and locks of the pool half made
                start_fork_server(*_modules(job, prepare))
                count = workers or len(os.sched_getaffinity(0))
                pool = stack.enter_context(ProcessPoolExecutor(count, context, _begin, (prepare, arguments)))
                answers = [pool.submit(job, item) for item in items]
            watched = watch(answers)
            # A bar left open stands on the line on which an interruption is told, and is drawn again after it.
            stack.callback(getattr(watched, "close", lambda: None))
            return [answer.result() for answer in watched]
        except BaseException as error:
            # Jobs are not cancelled but lose their workers: in Python 3.11 a pool that breaks with cancelled jobs in
            # it ends in an InvalidStateError of its own.
            for process in set(multiprocessing.active_children()) - running:
                process.kill()
            if isinstance(error, BrokenProcessPool):
                raise RunFailedError("a worker process was killed or crashed") from None
            raise


def _modules(*functions: Callable[..., object] | None) -> list[str]:
    """Return the names of the modules in which functions are defined, partial ones too."""
    whole = [getattr(function, "func", function) for function in functions]
    return [function.__module__ for function in whole if function is not None and function.__module__]


def _begin(prepare: Callable[..., object] | None, arguments: tuple[Any, ...]) -> None:
    die_with_parent()
    if prepare is not None:
        prepare(*arguments)


@contextmanager
def signals_held() -> Iterator[None]:
    """Let signals of ``STOPPING`` that Python handles wait for the end of a block that must not be left half done.

    Handlers are exchanged, as blocking signals in one thread lets another one take them, and handlers run in the main
    thread all the same. In other threads, which are not interrupted, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {number: handler for number in STOPPING if callable(handler := signal.getsignal(number))}
    try:
        for number in handlers:
            signal.signal(number, lambda number, frame: came.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for late in came:
            signal.raise_signal(late)


@dataclass
class Stop:
    """Which signal asked this process to end."""

    number: int = 0  # the signal's, or 0 while none came
    time: float = -math.inf  # when the last one came, by ``time.monotonic`` [s]

    @property
    def code(self) -> int:
        """Exit code by the shell's convention, such as 130 for Ctrl-C."""
        return 128 + (self.number or signal.SIGINT)


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Turn signals of ``STOPPING`` into a KeyboardInterrupt, so that files are closed and workers stopped.

    What comes again within ``SAME_REQUEST`` is the same request: ``timeout`` and closing terminals signal a process and
    then its group. What is ignored already, as SIGHUP under ``nohup`` is, stays ignored. An interruption that Python
    drops, as it does with whatever is raised in a callback of its import system, comes again.
    """
    stop = Stop()

    def handle(number: int, frame: FrameType | None) -> None:
        before, stop.time = stop.time, time.monotonic()
        stop.number = stop.number or number
        if stop.time - before > SAME_REQUEST:
            raise KeyboardInterrupt

    def again(dropped: "sys.UnraisableHookArgs") -> None:
        if stop.number and issubclass(dropped.exc_type, KeyboardInterrupt):
            stop.time = -math.inf
            threading.Timer(AGAIN, os.kill, (os.getpid(), stop.number)).start()  # not yet, as this is the callback
        else:
            tell(dropped)

    handlers = {number: signal.getsignal(number) for number in STOPPING}
    handlers = {number: handler for number, handler in handlers.items() if handler is not signal.SIG_IGN}
    for number in handlers:
        signal.signal(number, handle)
    tell, sys.unraisablehook = sys.unraisablehook, again
    try:
        yield stop
    finally:
        sys.unraisablehook = tell
        for number, handler in handlers.items():
            signal.signal(number, handler)
