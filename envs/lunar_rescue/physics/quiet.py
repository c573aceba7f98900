"""What PyBullet's C code needs of the process: its greetings kept out of notebooks and pipes, numbers with a point.

File descriptors and locale belong to the whole process, so threads take turns, and both are changed for as short as can
be.
"""

import ctypes
import locale
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

_LOCK = threading.RLock()


@contextmanager
def no_greeting() -> Iterator[None]:
    """Send what C code prints to nowhere meanwhile; streams that are closed or missing are left alone."""
    with _LOCK, ExitStack() as stack:
        for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
            with suppress(AttributeError, ValueError, OSError):  # None, closed, or a pipe that nobody reads
                stream.flush()
            with suppress(OSError):  # closed
                stack.enter_context(_to_nowhere(descriptor))
        yield


@contextmanager
def _to_nowhere(descriptor: int) -> Iterator[None]:
    """Redirect one file descriptor; ``OSError`` where it is closed."""
    original, nowhere = os.dup(descriptor), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, descriptor)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C buffers its output when it goes to a pipe
        os.dup2(original, descriptor)
        os.close(original)
        os.close(nowhere)


@contextmanager
def decimal_points() -> Iterator[None]:
    """Let C code read numbers of files with a decimal point meanwhile, whatever locale the process has.

    With a decimal comma Bullet reads -1.745 as -1 and says nothing.
    """
    with _LOCK:
        original = locale.setlocale(locale.LC_NUMERIC)
        locale.setlocale(locale.LC_NUMERIC, "C")
        try:
            yield
        finally:
            locale.setlocale(locale.LC_NUMERIC, original)
