"""What a result says of its origin is of this checkout, and no entry is lost between two writers."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
from pathlib import Path

import pytest

from reproduce.storage.files import read_json
from reproduce.storage.provenance import commit, record_origin


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder and return what it prints."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    names = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false", "-c", "core.hooksPath="]
    command = ["git", "-C", str(folder), *names, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "check out"
    (folder / "results").mkdir(parents=True)
    for name in ("code.py", "README.md", "results/table.csv"):
        (folder / name).write_text("a\n")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "first")
    return folder


def test_changes_count_where_they_are_not_results_or_pages(checkout: Path) -> None:
    head = git(checkout, "rev-parse", "HEAD")
    for name, expected in [("results/table.csv", head), ("README.md", head), ("code.py", f"{head}+changes")]:
        (checkout / name).write_text("changed\n")
        assert commit(checkout) == expected


def test_another_repository_s_commit_is_never_recorded(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = checkout / "lib" / "site-packages"  # as a package that is installed inside another project
    inside.mkdir(parents=True)
    assert commit(inside) == "unknown"
    other = checkout.parent / "other"
    other.mkdir()
    git(other, "init", "-q")
    git(other, "commit", "-qm", "other", "--allow-empty")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(other))
    monkeypatch.setenv("GIT_INDEX_FILE", str(other / ".git" / "index"))
    assert commit(checkout) == git(checkout, "rev-parse", "HEAD")


def test_the_index_is_not_locked(checkout: Path) -> None:
    index = checkout / ".git" / "index"
    os.utime(checkout / "code.py", (1, 1))  # git would refresh its index of this
    before = index.stat().st_mtime_ns, index.stat().st_ino
    assert commit(checkout) == git(checkout, "rev-parse", "HEAD")
    assert (index.stat().st_mtime_ns, index.stat().st_ino) == before


def _record(folder: Path, first: int) -> None:
    for number in range(first, first + 10):
        record_origin(folder / f"{number}.csv")


@pytest.mark.process
def test_two_writers_of_origins_lose_none(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_record, args=(tmp_path, first)) for first in (0, 10)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    origins = read_json(tmp_path / "origins.json", "register")
    assert sorted(origins) == sorted(f"{number}.csv" for number in range(20))
    assert all({"command", "commit", "packages", "date"} <= set(origin) for origin in origins.values())
    assert [path.name for path in tmp_path.iterdir()] == ["origins.json"]
