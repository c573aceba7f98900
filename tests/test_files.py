"""Files are written whole or not at all, with the umask's mode, and one process writes at a time."""

from __future__ import annotations

import multiprocessing
import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch as th
from safetensors.torch import save_file

from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, locked, read_json, write_atomically, write_json, write_text


@pytest.fixture(params=[0o022, 0o027, 0o077])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_every_file_has_the_mode_of_the_umask(tmp_path: Path, umask: int) -> None:
    text, weights = tmp_path / "policy.json", tmp_path / "policy.safetensors"
    for _ in range(2):  # a new file and one in place of an old one
        write_json(text, {"a": 1})
        write_atomically(weights, lambda path: save_file({"a": th.zeros(2)}, path))
        assert _mode(text) == _mode(weights) == {0o022: 0o644, 0o027: 0o640, 0o077: 0o600}[umask]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.json", "policy.safetensors"]


def test_a_writer_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "old")

    def fail(path: Path) -> None:
        path.write_text("half")
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        write_atomically(tmp_path / "a", fail)
    assert (tmp_path / "a").read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_links_are_followed_and_stay_links(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link, dangling = tmp_path / "link", tmp_path / "dangling"
    (tmp_path / "there" / "old").write_text("old")
    link.symlink_to(tmp_path / "there" / "old")
    dangling.symlink_to("there/new")
    for path in (link, dangling):
        check_writable(path)
        write_text(path, "new")
    assert link.is_symlink() and dangling.is_symlink()
    assert (tmp_path / "there" / "old").read_text() == (tmp_path / "there" / "new").read_text() == "new"


def test_a_pipe_and_a_device_are_written_to_and_stay(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    check_writable(pipe)
    write_text(pipe, "through")
    reader.join()
    assert received == ["through"] and stat.S_ISFIFO(pipe.stat().st_mode)
    write_text(Path("/dev/null"), "away")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    with pytest.raises(UserError, match=r"/dev/full.*No space left"):
        write_text(Path("/dev/full"), "no room")


def test_what_a_shell_redirects_to_a_file_is_added_to_it(tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as stream:
        stream.write("before\n")
        stream.flush()
        write_text(Path(f"/proc/self/fd/{stream.fileno()}"), "result\n")
    assert (tmp_path / "out").read_text() == "before\nresult\n"


@pytest.mark.parametrize(
    "name", ["folder", "file/below", "file/far/below", "/proc/nowhere", "/proc/no/where", "x" * 300]
)
def test_what_cannot_be_written_is_refused_before_and_at_the_writing(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("kept")
    for attempt in (check_writable, lambda path: write_text(path, "x")):
        with pytest.raises(UserError) as error:
            attempt(tmp_path / name)
        assert str(tmp_path / name) in str(error.value) and "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_text() == "kept"


def test_a_check_creates_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "folder" / "file.json")
    assert not list(tmp_path.iterdir())


def test_json_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for content in (b"{", b"\xff\xfe", b"[" * 100_000, b"9" * 5000):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"a\.json: scene is not readable as JSON"):
            read_json(path, "scene")
    with pytest.raises(UserError, match=r"b\.json: scene is missing"):
        read_json(tmp_path / "b.json", "scene")


def test_a_folder_is_locked_once_and_free_again_afterwards(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path / "run", "run folder"):
            match = rf"run: run folder is in use by another process \(process {os.getpid()}\)"
            with pytest.raises(UserError, match=match), locked(tmp_path / "run", "run folder"):
                pass
    assert not list((tmp_path / "run").iterdir())
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/nowhere")):
        with pytest.raises(UserError, match="run folder cannot be written"), locked(folder, "run folder"):
            pass


def _count(folder: Path, times: int) -> None:
    for _ in range(times):
        with locked(folder, "counter", wait=True):
            number = int((folder / "number").read_text())
            (folder / "number").write_text(str(number + 1))


def test_processes_that_wait_for_a_lock_take_turns(tmp_path: Path) -> None:
    (tmp_path / "number").write_text("0")
    processes = [multiprocessing.get_context("fork").Process(target=_count, args=(tmp_path, 100)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert (tmp_path / "number").read_text() == "400"
