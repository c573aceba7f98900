"""The command line: ``reproduce`` or ``python -m reproduce``."""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from reproduce import console, studies
from reproduce.storage.errors import UserError

app = studies.app  # with the commands that measure and tune, to which these are added


@app.command()
def train(
    method: Annotated[
        str, typer.Argument(help="a method that learns, such as hrl_dcs", autocompletion=console.trainable)
    ],
    out: Annotated[Path, console.folder("folder to write")],
    preset: console.Preset = "laptop",
    seed: Annotated[int, typer.Option(min=0, help="seed of networks, scenes and minibatches")] = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="environment steps instead of the preset's")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the folder's checkpoint")] = False,
    easy: Annotated[bool, typer.Option("--easy", help="easy scenes: one posture, no rocks, light astronaut")] = False,
    randomise: Annotated[
        bool, typer.Option("--randomise", help="draw physics, delay and gains anew each episode")
    ] = False,
    tensorboard: Annotated[Path | None, console.folder("for TensorBoard's logs, too")] = None,
    as_needed: Annotated[bool, typer.Option("--as-needed", help=console.AS_NEEDED)] = False,
) -> None:
    """Train a method and write a run folder."""
    if as_needed and (resume or tensorboard):
        raise UserError("--as-needed: goes on by itself and keeps no other log; leave --resume, --tensorboard out")
    from reproduce.experiments.methods import check_run_folder, get_method
    from reproduce.experiments.presets import check_preset

    entry = get_method(method)
    entry.check_learns()
    check_preset(preset)
    if not as_needed:
        check_run_folder(out, resume)
    from reproduce.experiments import train as training  # PyTorch takes seconds, which a mistake need not wait for

    config = entry.config(preset)
    priors = replace(config.priors, randomise=True) if randomise else config.priors
    config = replace(config, steps=steps or config.steps, scenes="easy" if easy else config.scenes, priors=priors)
    if as_needed:
        training.train_as_needed(entry, config, seed, out, preset)
    else:
        training.train(entry, config, seed, out, preset, resume=resume, tensorboard=tensorboard)
    typer.echo(f"{out}: trained {method} for {config.steps} steps")


@app.command()
def evaluate(
    run: console.Policy,
    tests: console.Tests = 1000,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
    ablation: Annotated[str | None, typer.Option(help="fixed_target or untrained_lln")] = None,
    easy: Annotated[bool, typer.Option("--easy", help="easy scenes, as in train")] = False,
    simulator: console.Simulator = "pybullet",
    plans_of: Annotated[str | None, typer.Option(help="planner: simulator in which plans are tried out")] = None,
    observation: console.Observation = "state",
    json: console.JsonFile = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="also both arms under, by task and by posture")] = False,
) -> None:
    """Test a policy: success with its interval and the causes of failure; the rest with --verbose or in the file."""
    from reproduce.experiments.methods import check_actor

    check_actor(run)
    if observation not in (known := ("state", "image")):
        raise UserError(f"--observation: expected {' or '.join(known)}, got {observation!r}")
    from reproduce.experiments.pool import first_scene
    from reproduce.hrl_dcs.config import check_ablation

    if ablation is not None:
        check_ablation(ablation)
    seed = first_scene(split, first_seed, typer.echo)
    from reproduce.experiments.evaluate import evaluate as test

    tell = partial(_print_evaluation, verbose=verbose)
    places: dict[str, Any] = {"simulator": simulator, "plans_of": plans_of, "observation": observation}
    test(run, tests, seed, ablation=ablation, easy=easy, json=json, tell=tell, **places)


@app.command("evaluate-reference")
def evaluate_reference(
    tests: console.Tests = 1000,
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


def _print_evaluation(result: dict[str, Any], verbose: bool) -> None:
    rate, low, high = (100 * result[k] for k in ("success_rate", "wilson_low", "wilson_high"))
    typer.echo(
        f"{result['method']}: {result['successes']} of {result['tests']} rescued, {rate:.1f} % [{low:.1f}, {high:.1f}]"
    )
    for word, count in sorted(result["failures"].items(), key=lambda failure: -failure[1]):
        typer.echo(f"  failed by {word.replace('_', ' ')}: {count}")
    if not verbose:
        return
    typer.echo(f"both arms under: {100 * result['both_arms_under']:.1f} %, {result['seconds_per_test']:.3f} s a test")
    for group in ("task", "posture"):
        for name, counts in result[f"by_{group}"].items():
            typer.echo(f"  {group} {name}: {counts['successes']} of {counts['tests']}")


@app.command()
def replay(
    run: console.Policy,
    out: Annotated[
        Path, typer.Option(parser=console.as_file, metavar="FILE", help=".mp4, .gif, .png (a strip) or .html (3D)")
    ],
    seed: console.SceneSeed = 0,
    posture: console.Posture = None,
    task: console.Task = None,
    overlay: Annotated[bool, typer.Option(help="draw targets, sub-goals, mark points and distances")] = True,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of a picture in pixels, multiples of 16")] = "480x352",
    simulator: console.Simulator = "pybullet",
) -> None:
    """Show one rescue as a film, a strip of pictures or in three dimensions."""
    from reproduce.experiments.methods import check_actor
    from reproduce.report.formats import parse_format, parse_size

    parse_format(out)
    pixels = parse_size(size)
    check_actor(run)
    console.check_scene(seed, posture, task)
    from reproduce.report.acting import ending
    from reproduce.report.film import replay as show

    row = show(run, seed, out, posture=posture, task=task, overlay=overlay, size=pixels, simulator=simulator)
    typer.echo(f"{out}: scene {seed}, {row['task']} {row['posture']}: {ending(row)} after {row['steps']} steps")


@app.command()
def export(
    method: Annotated[str, typer.Argument(help="a method with a trained reference run, such as hrl_dcs")],
    out: Annotated[Path, console.folder("folder to write")],
    seed: Annotated[int | None, typer.Option(min=0, help="training seed; the first one without it")] = None,
) -> None:
    """Write a reference policy with its model card to a folder that can be uploaded to a model hub."""
    from reproduce.experiments.methods import get_method

    get_method(method)
    from reproduce.report.cards import export as write

    typer.echo(f"{write(method, out, seed)}: written; `reproduce evaluate {out}` takes it")


@app.command()
def onnx(
    run: Annotated[Path, typer.Argument(parser=console.as_path, metavar="DIR", help="run folder of a trained policy")],
    out: Annotated[Path, console.folder("folder to write")],
) -> None:
    """Write the networks of a trained policy as ONNX, for programs without PyTorch."""
    if not run.is_dir():
        raise UserError(f"{run}: expected a run folder, as `reproduce train` writes it")
    from reproduce.experiments.onnx_export import export_onnx

    for path in export_onnx(run, out):
        typer.echo(f"{path}: written")


@app.command()
def watch(
    run: console.Policy,
    seed: console.SceneSeed = 0,
    rescues: Annotated[int, typer.Option(min=0, help="how many to show; 0 goes on until Ctrl-C")] = 0,
    posture: console.Posture = None,
    task: console.Task = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="of the page; 0 takes a free one")] = 8080,
) -> None:
    """Watch rescues in the browser, in real time; needs no display where it runs."""
    from reproduce.experiments.methods import check_actor

    check_actor(run)
    console.check_scene(seed, posture, task)
    from reproduce.report.watch import watch as show

    show(run, seed, rescues, posture=posture, task=task, port=port, tell=typer.echo)


@app.command()
def notebooks(
    preset: console.Preset = "smoke",
    only: Annotated[str | None, typer.Option(help="number or name of one notebook, such as 02")] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--parameter", "-p", help="NAME=VALUE for the notebooks that know NAME")
    ] = None,
    report: Annotated[bool, typer.Option(help="build the report afterwards")] = True,
    replays: console.Replays = True,
) -> None:
    """Run the notebooks with papermill, in order, and build the report."""
    from reproduce.experiments.presets import check_preset
    from reproduce.storage.paths import choose_notebooks

    check_preset(preset)
    choose_notebooks(only)
    from reproduce.report.notebooks import run_notebooks

    typer.echo(f"{run_notebooks(preset, only=only, assignments=parameter or [])}: notebooks written")
    if report:
        build(replays)


@app.command("report")
def build(replays: console.Replays = True) -> None:
    """Build the report from the notebooks that were run."""
    from reproduce.report.site import build_report
    from reproduce.storage.paths import RESULTS

    typer.echo(f"{build_report(RESULTS / 'notebooks', RESULTS, replays)}: report written")


@app.command()
def batch(
    preset: console.Preset = "smoke",
    methods: Annotated[str, typer.Option(help="names between commas, or all")] = "all",
    seeds: Annotated[str, typer.Option(help="of the methods that learn, such as 0-4 or 0,2,7")] = "0",
    out: Annotated[Path | None, console.folder("results/batch/PRESET without it")] = None,
    profile: Annotated[str, typer.Option(help="local, slurm, or a folder with a Snakemake profile")] = "local",
    slots: Annotated[int | None, typer.Option(min=1, help="jobs at once; one for two cores without it")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="cores of a job; cores by slots without it")] = None,
    until: Annotated[
        console.Until, typer.Option(help="report, tables (without notebooks) or policies (only train)")
    ] = "report",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only list what is left")] = False,
) -> None:
    """Reproduce everything as a workflow: train, evaluate, tables, claims, notebooks, report; goes on where it was."""
    from reproduce.experiments.methods import METHODS, get_method
    from reproduce.experiments.presets import check_preset

    check_preset(preset)
    names = list(METHODS) if methods == "all" else [get_method(name.strip()).name for name in methods.split(",")]
    from reproduce.experiments.workflow.batch import run_batch
    from reproduce.experiments.workflow.plan import TARGETS, Plan, parse_seeds
    from reproduce.storage.paths import RESULTS

    cores = len(os.sched_getaffinity(0))
    slots = slots or max(1, cores // 2)
    threads = threads or max(1, cores // slots)
    out = out or RESULTS / "batch" / preset
    run_batch(Plan.make(preset, names, parse_seeds(seeds), threads), out, profile, slots, until, dry_run, typer.echo)
    if not dry_run:
        typer.echo(f"{out / TARGETS[until]}: done")


@app.command()
def claims(json: console.JsonFile = None) -> None:
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


def main() -> None:
    """Run the command that the arguments name."""
    console.run(app)


if __name__ == "__main__":
    main()
