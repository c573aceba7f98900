"""Keeps PyBullet's greetings, printed from C, out of notebooks and pipes."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_greeting() -> Iterator[None]:
    """Send what C code prints to nowhere meanwhile; does nothing where file descriptor 1 is closed."""
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C buffers its output when it goes to a pipe
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
