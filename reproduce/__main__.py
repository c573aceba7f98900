"""The command line: ``reproduce`` or ``python -m reproduce``."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from reproduce.storage.errors import RunFailedError, StoppedError, UserError
from reproduce.storage.files import check_writable
from reproduce.storage.processes import Stop, stop_signals

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


app = typer.Typer(
    cls=Commands,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Reproduce dual-arm rescue by hierarchical reinforcement learning (Ren, Han, Wang 2022).",
)

AS_NEEDED = "begin, go on, or do nothing where this training has ended; another configuration's files are set aside"


def _path(text: str) -> Path:
    """Read a path; an empty one, as of a variable that is not set, would be taken for the current folder."""
    if not text.strip():
        raise typer.BadParameter("expected a path, got an empty one")
    return Path(text)


def _file(text: str) -> Path:
    """Read the path of a file to write, and refuse it before the work begins where it cannot be written."""
    check_writable(path := _path(text))
    return path


def _folder(words: str) -> Any:
    return typer.Option(parser=_path, metavar="DIR", help=words)


Preset = Annotated[str, typer.Option(help="smoke (CI), laptop (reference runs) or paper (the paper's numbers)")]
Policy = Annotated[str, typer.Argument(metavar="DIR", help="run folder, or scripted or random")]
Tests = Annotated[int, typer.Option(min=1, help="number of scenes")]
FirstSeed = Annotated[int, typer.Option(min=0, help="first scene; test scenes begin at 0, held-out ones at 2000000")]
SceneSeed = Annotated[int, typer.Option(min=0, help="seed of the (first) scene")]
Posture = Annotated[str | None, typer.Option(help="draw scenes with this posture")]
Task = Annotated[str | None, typer.Option(help="draw scenes with this task")]
Replays = Annotated[bool, typer.Option(help="with 3D replays in it")]
JsonFile = Annotated[Path | None, typer.Option("--json", parser=_file, metavar="FILE", help="also write a file")]


@app.command()
def train(
    method: Annotated[str, typer.Argument(help="a method that learns, such as hrl_dcs")],
    out: Annotated[Path, _folder("folder to write")],
    preset: Preset = "laptop",
    seed: Annotated[int, typer.Option(min=0, help="seed of networks, scenes and minibatches")] = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="environment steps instead of the preset's")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the folder's checkpoint")] = False,
    easy: Annotated[bool, typer.Option("--easy", help="easy scenes: one posture, no rocks, light astronaut")] = False,
    tensorboard: Annotated[Path | None, _folder("for TensorBoard's logs, too")] = None,
    as_needed: Annotated[bool, typer.Option("--as-needed", help=AS_NEEDED)] = False,
) -> None:
    """Train a method and write a run folder."""
    if as_needed and (resume or tensorboard):
        raise UserError("--as-needed: goes on by itself and keeps no other log; leave --resume, --tensorboard out")
    from reproduce.experiments.methods import get_method
    from reproduce.experiments.train import train as run
    from reproduce.experiments.train import train_as_needed

    chosen = get_method(method)
    config = chosen.config(preset)
    config = replace(config, steps=steps or config.steps, scenes="easy" if easy else config.scenes)
    if as_needed:
        train_as_needed(chosen, config, seed, out, preset)
    else:
        run(chosen, config, seed, out, preset, resume=resume, tensorboard=tensorboard)
    typer.echo(f"{out}: trained {method} for {config.steps} steps")


@app.command()
def evaluate(
    run: Policy,
    tests: Tests = 1000,
    first_seed: FirstSeed = 0,
    ablation: Annotated[str | None, typer.Option(help="fixed_target, anchors_alone or untrained_lln")] = None,
    easy: Annotated[bool, typer.Option("--easy", help="easy scenes, as in train")] = False,
    json: JsonFile = None,
) -> None:
    """Test a policy: success with its interval, by task, posture and failure."""
    from reproduce.experiments.evaluate import evaluate as test

    _print_evaluation(test(run, tests, first_seed, ablation=ablation, easy=easy, json=json))


@app.command("evaluate-reference")
def evaluate_reference(
    tests: Tests = 1000,
    few: Annotated[int, typer.Option(min=1, help="scenes of a two-layer policy's ablations")] = 200,
) -> None:
    """Make every evaluation of every reference run, then Table 1, the tables and the claims."""
    from reproduce.analysis.claims import compute_claims, write_claims
    from reproduce.analysis.tables import write_table1, write_tables
    from reproduce.experiments.evaluations import evaluate_run
    from reproduce.storage.paths import REFERENCE, RESULTS

    for folder in sorted((RESULTS / REFERENCE).glob("*/seed*")):
        evaluate_run(folder, tests, few, tell=typer.echo)
    for path in (write_table1(), *write_tables(), write_claims(compute_claims())):
        typer.echo(f"{path}: written")


def _print_evaluation(result: dict[str, Any]) -> None:
    rate, low, high = (100 * result[k] for k in ("success_rate", "wilson_low", "wilson_high"))
    typer.echo(
        f"{result['method']}: {result['successes']} of {result['tests']} rescued, {rate:.1f} % [{low:.1f}, {high:.1f}]"
    )
    typer.echo(f"both arms under: {100 * result['both_arms_under']:.1f} %, {result['seconds_per_test']:.3f} s a test")
    for group in ("task", "posture"):
        for name, counts in result[f"by_{group}"].items():
            typer.echo(f"  {group} {name}: {counts['successes']} of {counts['tests']}")
    for word, count in result["failures"].items():
        typer.echo(f"  failed by {word}: {count}")


@app.command()
def replay(
    run: Policy,
    out: Annotated[Path, typer.Option(parser=_file, metavar="FILE", help=".mp4, .gif, .png (a strip) or .html (3D)")],
    seed: SceneSeed = 0,
    posture: Posture = None,
    task: Task = None,
    overlay: Annotated[bool, typer.Option(help="draw targets, sub-goals, mark points and distances")] = True,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of a picture in pixels, multiples of 16")] = "480x352",
) -> None:
    """Show one rescue as a film, a strip of pictures or in three dimensions."""
    from reproduce.report.replay import parse_size
    from reproduce.report.replay import replay as show

    row = show(run, seed, out, posture=posture, task=task, overlay=overlay, size=parse_size(size))
    ended = "rescued" if row["success"] else f"failed by {row['failure']}"
    typer.echo(f"{out}: scene {seed}, {row['task']} {row['posture']}: {ended} after {row['steps']} steps")


@app.command()
def export(
    method: Annotated[str, typer.Argument(help="a method with a trained reference run, such as hrl_dcs")],
    out: Annotated[Path, _folder("folder to write")],
    seed: Annotated[int | None, typer.Option(min=0, help="training seed; the first one without it")] = None,
) -> None:
    """Write a reference policy with its model card to a folder that can be uploaded to a model hub."""
    from reproduce.report.cards import export as write

    typer.echo(f"{write(method, out, seed)}: written; `reproduce evaluate {out}` takes it")


@app.command()
def watch(
    run: Policy,
    seed: SceneSeed = 0,
    rescues: Annotated[int, typer.Option(min=0, help="how many to show; 0 goes on until Ctrl-C")] = 0,
    posture: Posture = None,
    task: Task = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="of the page; 0 takes a free one")] = 8080,
) -> None:
    """Watch rescues in the browser, in real time; needs no display where it runs."""
    from reproduce.report.watch import watch as show

    show(run, seed, rescues, posture=posture, task=task, port=port, tell=typer.echo)


@app.command()
def notebooks(
    preset: Preset = "smoke",
    only: Annotated[str | None, typer.Option(help="number or name of one notebook, such as 02")] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option("--parameter", "-p", help="NAME=VALUE for the notebooks that know NAME"),
    ] = None,
    report: Annotated[bool, typer.Option(help="build the report afterwards")] = True,
    replays: Replays = True,
) -> None:
    """Run the notebooks with papermill, in order, and build the report."""
    from reproduce.report.notebooks import run_notebooks

    folder = run_notebooks(preset, only=only, assignments=parameter or [])
    typer.echo(f"{folder}: notebooks written")
    if report:
        _build_report(replays)


@app.command("report")
def build(replays: Replays = True) -> None:
    """Build the report from the notebooks that were run."""
    _build_report(replays)


def _build_report(replays: bool) -> None:
    from reproduce.report import build_report
    from reproduce.storage.paths import RESULTS

    typer.echo(f"{build_report(RESULTS / 'notebooks', RESULTS, replays)}: report written")


@app.command()
def batch(
    preset: Preset = "smoke",
    methods: Annotated[str, typer.Option(help="names between commas, or all")] = "all",
    seeds: Annotated[str, typer.Option(help="of the methods that learn, such as 0-4 or 0,2,7")] = "0",
    out: Annotated[Path | None, _folder("results/batch/PRESET without it")] = None,
    profile: Annotated[str, typer.Option(help="local, slurm, or a folder with a Snakemake profile")] = "local",
    slots: Annotated[int | None, typer.Option(min=1, help="jobs at once; one for two cores without it")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="cores of a job; cores by slots without it")] = None,
    until: Annotated[str, typer.Option(help="report, tables (without notebooks) or policies (only train)")] = "report",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only list what is left")] = False,
) -> None:
    """Reproduce everything as a workflow: train, evaluate, tables, claims, notebooks, report; goes on where it was."""
    from reproduce.experiments.methods import METHODS
    from reproduce.experiments.workflow.batch import default_slots, run_batch
    from reproduce.experiments.workflow.plan import Plan, cores, parse_seeds
    from reproduce.storage.paths import RESULTS

    slots = slots or default_slots()
    threads = threads or max(1, cores() // slots)
    names = list(METHODS) if methods == "all" else [name.strip() for name in methods.split(",")]
    folder = RESULTS / "batch" / preset if out is None else out
    run_batch(Plan.make(preset, names, parse_seeds(seeds), threads), folder, profile, slots, until, dry_run, typer.echo)
    if not dry_run:
        target = {"report": "report/index.html", "tables": "tables", "policies": "reference"}[until]
        typer.echo(f"{folder / target}: done")


@app.command()
def claims(json: JsonFile = None) -> None:
    """Compute the claims' verdicts, and Table 1, from results/."""
    from reproduce.analysis.claims import compute_claims, print_claims, write_claims

    table = compute_claims()
    print_claims(table)
    write_claims(table, json)


@app.command()
def table1() -> None:
    """Write results/table1.csv from the reference runs."""
    from reproduce.analysis.tables import write_table1

    typer.echo(f"{write_table1()}: written")


@app.command()
def tables() -> None:
    """Write results/tables/: successes by method, posture, task and failure, which hold no times."""
    from reproduce.analysis.tables import write_tables

    for path in write_tables():
        typer.echo(f"{path}: written")


@app.command()
def bench(
    part: Annotated[str, typer.Option(help="env, training, tests or all")] = "all",
    json: JsonFile = None,
) -> None:
    """Measure speed, each figure against a peer in the same run."""
    from reproduce.bench.speed import measure
    from reproduce.storage.files import write_json

    result = measure(part)
    for name, value in result.items():
        typer.echo(f"{name}: {value}")
    if json:
        write_json(json, result)


@app.command()
def solvable(
    tests: Tests = 500,
    first_seed: FirstSeed = 0,
    variants: Annotated[int, typer.Option(min=1, help="most lifts or turns tried out for a scene")] = 40,
    json: JsonFile = None,
) -> None:
    """Measure which scenes can be solved at all, by a planner that knows everything; writes results/solvability/."""
    from reproduce.experiments.solvability import measure_solvability, print_solvability

    print_solvability(measure_solvability(tests, first_seed, variants=variants, json=json), typer.echo)


@app.command()
def tune(
    method: Annotated[str, typer.Argument(help="a baseline, such as fun")],
    steps: Annotated[int, typer.Option(min=1, help="environment steps of a trial")] = 300_000,
    tests: Annotated[int, typer.Option(min=1, help="easy validation scenes after each")] = 100,
) -> None:
    """Make a baseline's tuning trials that were not made yet; writes results/trials/tuning/METHOD.csv."""
    from reproduce.experiments.tuning import tune as run

    run(method, steps, tests, tell=typer.echo)


@app.command()
def methods() -> None:
    """List the methods of the registry."""
    from reproduce.experiments.methods import METHODS

    for method in METHODS.values():
        typer.echo(f"{method.name}: {method.about}")


def main() -> None:
    """Run a command: a user's mistake is one line and exit code 2, an interruption one line and 128 plus the signal."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed; a file that is opened later must not be taken for it
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))
    if sys.version_info[:2] != (3, 11) or not sys.platform.startswith("linux"):
        found = f"Python {sys.version_info[0]}.{sys.version_info[1]} on {sys.platform}"
        sys.exit(_complain(f"needs Python 3.11 on Linux, as PyBullet has no wheels beyond it; this is {found}"))
    warnings.filterwarnings("ignore", category=UserWarning, module="gymnasium")
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    with stop_signals() as stop:
        code = _run(stop)
    sys.exit(code)


def _run(stop: Stop) -> int:
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except (KeyboardInterrupt, StoppedError, typer.Abort) as error:
        return _complain(str(error) or "interrupted", stop.code)
    except BrokenPipeError:  # who read the output has had enough; what is left goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (CommandLineError, UserError, RunFailedError, ValueError, OSError) as error:
        if stop.number:  # a signal to the whole group may end a worker before it is handled here
            return _complain("interrupted", stop.code)
        message = error.format_message() if isinstance(error, CommandLineError) else str(error)
        return _complain(message, 1 if isinstance(error, RunFailedError | OSError) else 2)
    return code if isinstance(code, int) else 0  # --help has a code, commands have none


def _complain(message: str, code: int = 2) -> int:
    print(f"reproduce: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
