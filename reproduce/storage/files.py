"""Write files so that a kill at any moment leaves the old one or the new one, and let one process write at a time."""

import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from reproduce.storage.errors import UserError

LARGEST_JSON = 20_000_000  # bytes; nothing of ours comes near
LOCK = ".lock"
#: A shell's redirections, which are regular files at times, but hold what else the command prints.
_STREAMS = ("/dev/stdout", "/dev/stderr", "/dev/fd", "/proc")


def check_writable(path: Path) -> None:
    """Refuse with a ``UserError`` a path that could not be written, before the work that would be written there.

    Nothing is created: the nearest folder that exists is tried with a file without a name.
    """
    try:
        if path.is_dir():
            raise UserError(f"{path}: expected a file to write, got a folder")
        if is_stream(path):
            if not os.access(path, os.W_OK):
                raise UserError(f"{path}: cannot be written: permission denied")
            return
        tempfile.TemporaryFile(dir=next(filter(os.path.lexists, path.resolve().parents))).close()
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write`` with a temporary name, then put that file in place of ``path`` in one step.

    Links are followed. What is no regular file (a device, a pipe, a shell's redirection) is written to and stays what
    it is. The file gets the mode that the umask gives. Where it cannot be written the old one stays: ``UserError``.
    """
    try:
        if path.is_dir():
            raise UserError(f"{path}: expected a file to write, got a folder")
        if is_stream(path):
            _write_stream(path, write)
        else:
            _replace(path.resolve(), write)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error


def is_stream(path: Path) -> bool:
    """Return whether a path is no regular file, or a shell's redirection, so that nothing can lie beside it."""
    is_redirection = any(path.absolute().is_relative_to(stream) for stream in _STREAMS)
    return path.exists() and (is_redirection or not path.is_file())


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")  # film writers go by the ending
    try:
        temporary.touch()
        mode = temporary.stat().st_mode & 0o777
        write(temporary)
        temporary.chmod(mode)  # safetensors, for one, replaces the file by another that only its owner can read
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_stream(path: Path, write: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / f"stream{path.suffix}"
        write(temporary)
        with temporary.open("rb") as source, path.open("ab") as stream:
            shutil.copyfileobj(source, stream)


@contextmanager
def locked(folder: Path, what: str, *, name: str = LOCK, wait: bool = False) -> Iterator[IO[str]]:
    """Hold a folder's lock, the file ``name``, while the block runs; the kernel releases it however the process ends.

    The folder is made where it is missing. Yields the open file: a child that inherits its descriptor holds the lock
    too. Raises a ``UserError``, which says ``what`` is locked, when another process holds it, unless told to ``wait``.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _acquire(folder / name, wait)
    except BlockingIOError:
        owner = ""
        with suppress(OSError):  # it may be gone by now
            owner = f" ({(folder / name).read_text(encoding='utf-8', errors='replace').strip() or 'unknown'})"
        raise UserError(f"{folder}: {what} is in use by another process{owner}; wait for it or name another") from None
    except OSError as error:
        raise UserError(f"{folder}: {what} cannot be written there: {error.strerror or error}") from None
    with lock:
        try:
            yield lock
        finally:
            (folder / name).unlink(missing_ok=True)


def _acquire(path: Path, wait: bool) -> IO[str]:
    """Open and lock a file, again where another process has removed it in between."""
    while True:
        with ExitStack() as stack:
            lock = stack.enter_context(path.open("a", encoding="utf-8"))
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if _is_same_file(lock, path):
                lock.truncate(0)
                lock.write(f"process {os.getpid()}")
                lock.flush()
                stack.pop_all()
                return lock


def _is_same_file(file: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically; NaN is refused, as JSON has none."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, as UTF-8."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_json(path: Path, what: str) -> Any:
    """Read JSON; ``UserError`` names the file, ``what`` it holds and the fault: missing, too large or deep, no JSON."""
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise UserError(f"{path}: {what}: larger than {LARGEST_JSON} bytes")
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: {what} is missing") from None
    except (OSError, ValueError, RecursionError) as error:  # ValueError: not UTF-8, not JSON, a number too long
        raise UserError(f"{path}: {what} is not readable as JSON: {error}") from None
