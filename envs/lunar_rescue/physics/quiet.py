"""Keeps PyBullet's greetings, printed from C, out of notebooks and pipes."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def no_greeting() -> Iterator[None]:
    """Send what C code prints to nowhere meanwhile."""
    with ExitStack() as stack:
        for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
            stream.flush()
            stack.enter_context(_to_nowhere(descriptor))
        yield


@contextmanager
def _to_nowhere(descriptor: int) -> Iterator[None]:
    """Redirect one file descriptor; does nothing where it is closed."""
    try:
        kept = os.dup(descriptor)
    except OSError:
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, descriptor)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C buffers its output when it goes to a pipe
        os.dup2(kept, descriptor)
        os.close(kept)
        os.close(nowhere)
