"""What all commands share: options, whose paths are checked before any work begins, and how a command ends."""

import importlib.metadata
import logging
import os
import re
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import typer.core

from reproduce.storage.errors import RunFailedError, StoppedError, UserError
from reproduce.storage.files import check_writable
from reproduce.storage.processes import Stop, stop_signals

AS_NEEDED = "begin, go on, or do nothing where this training has ended; another configuration's files are set aside"


#: Distributions whose modules have another name.
DISTRIBUTIONS = {"yaml": "pyyaml", "material": "mkdocs-material"}


def as_path(text: str) -> Path:
    """Read a path; an empty one, as of a variable that is not set, would be taken for the current folder."""
    if not text.strip():
        raise typer.BadParameter("expected a path, got an empty one")
    return Path(text)


def as_file(text: str) -> Path:
    """Read the path of a file to write, and refuse it before the work begins where it cannot be written."""
    check_writable(path := as_path(text))
    return path


def folder(words: str) -> Any:
    """Return an option that takes the path of a folder; ``words`` are its help."""
    return typer.Option(parser=as_path, metavar="DIR", help=words)


def trainable() -> list[str]:
    """Return what a shell offers for a method to train."""
    from reproduce.experiments.methods import METHODS

    return [method.name for method in METHODS.values() if method.learns]


def _presets() -> list[str]:
    from reproduce.experiments.presets import PRESETS

    return list(PRESETS)


def _splits() -> list[str]:
    from lunar_rescue.scenes.splits import SPLITS

    return list(SPLITS)


def _postures() -> list[str]:
    from lunar_rescue.scenes.postures import all_postures

    return list(all_postures())


def check_scene(seed: int, posture: str | None, task: str | None) -> None:
    """Refuse a posture or a task that is not there, or not together, before anything larger is imported."""
    from lunar_rescue import sample_scene

    sample_scene(seed, posture=posture, task=task)


def _show_version(wanted: bool) -> None:
    if wanted:
        from reproduce import __version__

        typer.echo(f"lunar-rescue {__version__}")
        raise typer.Exit


Part = Literal["all", "env", "training", "tests"]
Until = Literal["report", "tables", "policies"]
WORDS = "smoke (CI), laptop (reference runs) or paper (the paper's numbers)"
Version = Annotated[
    bool, typer.Option("--version", is_eager=True, callback=_show_version, help="show the version and exit")
]
Preset = Annotated[str, typer.Option(help=WORDS, autocompletion=_presets)]
Policy = Annotated[str, typer.Argument(metavar="DIR", help="run folder, or scripted, planner or random")]
Tests = Annotated[int, typer.Option(min=1, help="number of scenes")]
SPLIT = "validation (unless --first-seed says otherwise), validation-heldout, train, or for final figures test, heldout"
Split = Annotated[str | None, typer.Option(help=SPLIT, autocompletion=_splits)]
FirstSeed = Annotated[int | None, typer.Option(min=0, help="seed of the first scene; the split's first one without it")]
SceneSeed = Annotated[int, typer.Option(min=0, help="seed of the (first) scene")]
Posture = Annotated[
    str | None, typer.Option(help="draw scenes with this posture, such as left_side_stride", autocompletion=_postures)
]
Task = Annotated[
    str | None, typer.Option(help="draw scenes with this task", autocompletion=lambda: ["lift", "turn_over"])
]
Simulator = Annotated[str, typer.Option(help="pybullet or mujoco", autocompletion=lambda: ["pybullet", "mujoco"])]
Observation = Annotated[
    str, typer.Option(help="state, or image: act on what the embedding sees", autocompletion=lambda: ["state", "image"])
]
Weights = Annotated[
    Path | None,
    typer.Option(parser=as_path, metavar="DIR", help="folder of the embedding; results/perception without it"),
]
Replays = Annotated[bool, typer.Option(help="with 3D replays in it")]
JsonFile = Annotated[Path | None, typer.Option("--json", parser=as_file, metavar="FILE", help="also write a file")]


# Typer may bring a Click of its own, so the base of its errors is looked up and not imported.
CommandLineError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


class Commands(typer.core.TyperGroup):
    """All commands; an interrupted one keeps its last words, which Typer would drop."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the arguments name."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise StoppedError(str(error) or "interrupted") from None


def run(app: typer.Typer) -> None:
    """Run a command and exit: a mistake is one line and code 2, an interruption one line and 128 plus the signal."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed; a file that is opened later must not be taken for it
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))
    if sys.version_info[:2] != (3, 11) or not sys.platform.startswith("linux"):
        here = f"Python {sys.version_info[0]}.{sys.version_info[1]} on {sys.platform}"
        sys.exit(_complain(f"needs Python 3.11 on Linux, as PyBullet has no wheels beyond it; this is {here}"))
    warnings.filterwarnings("ignore", category=UserWarning, module="gymnasium")
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    with stop_signals() as stop:
        code = _invoke(app, stop)
    sys.exit(code)


def _invoke(app: typer.Typer, stop: Stop) -> int:
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except (KeyboardInterrupt, StoppedError, typer.Abort) as error:
        return _complain(str(error) or "interrupted", stop.code)
    except BrokenPipeError:  # who read the output has had enough; what is left goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except ModuleNotFoundError as error:
        if (extra := missing_extra(error.name or "")) is None:
            raise
        return _complain(f"this needs {error.name}, which is not installed: pip install 'lunar-rescue[{extra}]'")
    except (CommandLineError, UserError, RunFailedError, ValueError, OSError) as error:
        if stop.number:  # a signal to the whole group may end a worker before it is handled here
            return _complain("interrupted", stop.code)
        message = error.format_message() if isinstance(error, CommandLineError) else str(error)
        return _complain(message, 1 if isinstance(error, RunFailedError | OSError) else 2)
    return code if isinstance(code, int) else 0  # --help has a code, commands have none


def missing_extra(module: str) -> str | None:
    """Return the extra of this distribution that brings a module; None where none does."""
    distribution = re.sub(r"[-_.]+", "-", DISTRIBUTIONS.get(module, module.partition(".")[0])).lower()
    for line in importlib.metadata.requires("lunar-rescue") or []:
        wanted = re.match(r"([\w.-]+).*; extra == ['\"](\w+)['\"]", line)
        if wanted and re.sub(r"[-_.]+", "-", wanted[1]).lower() == distribution:
            return wanted[2]
    return None


def _complain(message: str, code: int = 2) -> int:
    print(f"reproduce: {' '.join(message.split())}", file=sys.stderr)
    return code
