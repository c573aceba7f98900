"""The command line, called in this process: a new one takes seconds to import what is imported here already."""

from __future__ import annotations

import contextlib
import io
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from reproduce.__main__ import main


def without_progress(text: str) -> list[str]:
    """Lines of what a command wrote to standard error, but for empty ones and progress bars."""
    return [line for line in re.split(r"[\r\n]", text) if line.strip() and not re.search(r"\d/\S+ \[", line)]


@dataclass(frozen=True)
class Answer:
    """What a command left: its exit code and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The only line on standard error, progress bars aside."""
        (line,) = without_progress(self.err)
        return line


def call(*arguments: str, cwd: Path | None = None) -> Answer:
    """Call ``reproduce`` with arguments, in a folder, as a shell would."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["reproduce", *arguments]),
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return Answer(code, out.getvalue(), err.getvalue())
