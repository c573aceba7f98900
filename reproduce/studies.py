"""Commands that measure, compare, demonstrate and tune; ``reproduce.__main__`` adds all others."""

from pathlib import Path
from typing import Annotated

import typer

from reproduce import console

app = typer.Typer(
    cls=console.Commands,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Reproduce dual-arm rescue by hierarchical reinforcement learning (Ren, Han, Wang 2022).",
)

perceive = typer.Typer(cls=console.Commands, rich_markup_mode=None, help="The embedding from pictures to states (P10).")
app.add_typer(perceive, name="perceive")


@app.callback()
def options(version: console.Version = False) -> None:
    """Take what goes before any command."""


@app.command()
def bench(
    part: Annotated[console.Part, typer.Option(help="which figures")] = "all",
    json: console.JsonFile = None,
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
    tests: console.Tests = 500,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
    variants: Annotated[int, typer.Option(min=1, help="most lifts or turns tried out for a scene")] = 40,
    json: console.JsonFile = None,
) -> None:
    """Measure which scenes can be solved at all, by a planner that knows everything; writes results/solvability/."""
    from reproduce.experiments.pool import first_scene
    from reproduce.experiments.solvability import measure_solvability, print_solvability

    seed = first_scene(split, first_seed, typer.echo)
    print_solvability(measure_solvability(tests, seed, variants=variants, json=json), typer.echo)


@app.command()
def demonstrate(
    scenes: Annotated[int, typer.Option(min=1, help="training scenes")],
    out: Annotated[
        Path,
        typer.Option(
            parser=console.as_file, metavar="FILE", help="file to write; one with fewer scenes is gone on with"
        ),
    ],
) -> None:
    """Let the planner rescue training scenes, plain and under noise, as demonstrations."""
    from reproduce.experiments.demonstrate import demonstrate as make

    make(scenes, out, tell=typer.echo)


@app.command()
def convergence(
    actors: Annotated[list[str], typer.Argument(help="run folders, methods that do not learn, and plans")],
    tests: console.Tests = 400,
    out: Annotated[Path | None, console.folder("folder to write; results/convergence without it")] = None,
) -> None:
    """Compare solver settings on validation scenes: success, overlaps, force balance and what a step costs."""
    from reproduce.experiments.convergence import FOLDER, measure_convergence
    from reproduce.experiments.pool import first_scene

    measure_convergence(actors, tests, first_scene(None, None, typer.echo), folder=out or FOLDER)


@app.command()
def agreement(
    tests: console.Tests = 100,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
    out: Annotated[Path | None, console.folder("folder to write; results/agreement without it")] = None,
) -> None:
    """Replay the planner's plans in PyBullet and MuJoCo, and hold both against closed solutions."""
    from reproduce.experiments.agreement import FOLDER, measure_agreement
    from reproduce.experiments.pool import first_scene

    measure_agreement(tests, first_scene(split, first_seed, typer.echo), folder=out or FOLDER, tell=typer.echo)


@app.command()
def rules(
    repeats: Annotated[int, typer.Option(min=1, help="simulated experiments of each case")] = 4000,
    out: Annotated[
        Path | None, typer.Option(parser=console.as_file, metavar="FILE", help="results/rules.csv without it")
    ] = None,
) -> None:
    """Measure how often the claims' rules are wrong, on simulated trainings whose truth is known."""
    from reproduce.analysis.rule_errors import measure_rules

    measure_rules(repeats, out, tell=typer.echo)


@app.command()
def stress(
    run: console.Policy,
    tests: console.Tests = 200,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
    kinds: Annotated[
        list[str] | None, typer.Option(help="a kind of disturbance, several times for several; none: simulators alone")
    ] = None,
    out: Annotated[
        Path | None, console.folder("folder to write; results/stress, or results/transfer for simulators alone")
    ] = None,
    json: console.JsonFile = None,
) -> None:
    """Measure success against noise, delay, errors and in the other simulator; writes METHOD.csv and METHOD.json."""
    from reproduce.experiments.methods import check_actor

    check_actor(run)
    from reproduce.experiments import stress as study
    from reproduce.experiments.pool import first_scene

    tried = study.known_kinds(kinds)
    place = out or (study.FOLDER if tried else study.TRANSFER)
    study.stress(
        run, tests, first_scene(split, first_seed, typer.echo), kinds=tried, folder=place, json=json, tell=typer.echo
    )


@perceive.command("train")
def perceive_train(
    actors: Annotated[
        list[str] | None, typer.Argument(help="who acts: run folders, methods that do not learn; all those without it")
    ] = None,
    out: Annotated[Path | None, console.folder("folder to write; results/perception without it")] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of weights, minibatches and scenes")] = 0,
    scenes: Annotated[int | None, typer.Option(min=1, help="scenes whose first picture is looked at")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the folder's checkpoint")] = False,
) -> None:
    """Train the embedding on pictures of training scenes: first ones, and those of rescues."""
    from reproduce.experiments.methods import METHODS, check_actor

    actors = actors or [method.name for method in METHODS.values() if not method.learns]
    for actor in actors:
        check_actor(actor)
    from reproduce.experiments.perceive import train_embedding
    from reproduce.perception.estimator import FOLDER
    from reproduce.perception.training import EmbeddingConfig

    config = EmbeddingConfig(seed=seed) if scenes is None else EmbeddingConfig.looking_at(scenes, seed)
    train_embedding(actors, out or FOLDER, config, resume=resume, tell=typer.echo)
    typer.echo(f"{out or FOLDER}: trained the embedding")


@perceive.command("evaluate")
def perceive_evaluate(
    weights: console.Weights = None,
    actor: Annotated[str, typer.Option(help="who acts on estimates: a run folder, or scripted, random")] = "scripted",
    tests: console.Tests = 1000,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
) -> None:
    """Test the embedding on first pictures and along rescues; writes evaluation.json into its folder."""
    from reproduce.experiments.methods import check_actor

    check_actor(actor)
    from reproduce.experiments.pool import first_scene

    seed = first_scene(split, first_seed, typer.echo)
    from reproduce.experiments.perceive import FOLDER, evaluate_embedding

    evaluate_embedding(tests, seed, folder=weights or FOLDER, where=actor, tell=typer.echo)


@perceive.command("compare")
def perceive_compare(
    run: console.Policy,
    weights: console.Weights = None,
    tests: console.Tests = 1000,
    split: console.Split = None,
    first_seed: console.FirstSeed = None,
    json: console.JsonFile = None,
) -> None:
    """Test a policy on true states, on those with noise of the embedding's size, and on its estimates."""
    from reproduce.experiments.methods import check_actor

    check_actor(run)
    from reproduce.experiments.pool import first_scene

    seed = first_scene(split, first_seed, typer.echo)
    from reproduce.experiments.perceive import FOLDER, compare_states

    compare_states(run, tests, seed, folder=weights or FOLDER, json=json, tell=typer.echo)


@app.command()
def transfer(
    first: Annotated[Path, typer.Argument(parser=console.as_path, metavar="FIRST", help="rows of an evaluation, .csv")],
    second: Annotated[
        Path, typer.Argument(parser=console.as_path, metavar="SECOND", help="and of another, same scenes")
    ],
    out: Annotated[
        Path | None, typer.Option(parser=console.as_file, metavar="FILE", help="also write the table as .csv")
    ] = None,
) -> None:
    """Tell what is lost and gained from one evaluation to another: in all, by task, attitude and posture."""
    from reproduce.analysis.reality_gap import transfer_table
    from reproduce.experiments.rows import read_rows
    from reproduce.storage.provenance import write_table

    table = transfer_table(read_rows(first), read_rows(second))
    typer.echo(table.round(3).to_string(index=False))
    if out:
        typer.echo(f"{write_table(out, table)}: written")


@app.command()
def methods() -> None:
    """List the methods of the registry."""
    from reproduce.experiments.methods import METHODS

    for method in METHODS.values():
        typer.echo(f"{method.name}: {method.about}")


@app.command()
def crate(
    folder: Annotated[
        Path | None, typer.Option(parser=console.as_path, metavar="DIR", help="results/ without it")
    ] = None,
) -> None:
    """Describe the results as an RO-Crate, for archives; writes ro-crate-metadata.json into their folder."""
    from reproduce.report.archive import write_crate
    from reproduce.storage.paths import RESULTS

    typer.echo(f"{write_crate(folder or RESULTS)}: written")


@app.command()
def tune(
    method: Annotated[str, typer.Argument(help="a baseline, such as fun")],
    steps: Annotated[int, typer.Option(min=1, help="environment steps of a trial")] = 300_000,
    tests: Annotated[int, typer.Option(min=1, help="easy validation scenes after each")] = 100,
) -> None:
    """Make a baseline's tuning trials that were not made yet; writes results/trials/tuning/METHOD.csv."""
    from reproduce.experiments.presets import check_tunable

    check_tunable(method)
    from reproduce.experiments.tuning import tune as run

    run(method, steps, tests, tell=typer.echo)


@app.command()
def vary(
    group: Annotated[str, typer.Argument(help="ladder: priors one by one; fills: what the paper leaves open")],
    only: Annotated[list[str] | None, typer.Option(help="a variant's name; several times for several")] = None,
    steps: Annotated[int, typer.Option(min=1, help="environment steps of a training")] = 1_000_000,
    tests: Annotated[int, typer.Option(min=1, help="validation scenes after each")] = 1000,
) -> None:
    """Train and test variants of hrl_dcs that were not yet; writes results/variants/GROUP/."""
    from reproduce.experiments.presets import check_variants

    check_variants(group, only or ())
    from reproduce.experiments.variants import vary as run

    run(group, only or (), steps, tests, tell=typer.echo)
