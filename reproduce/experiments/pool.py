"""Work on many scenes, one scene a job, in as many processes as there are cores."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from gymnasium.error import DependencyNotInstalled
from tqdm.auto import tqdm

from lunar_rescue.physics.engines import check_simulator
from lunar_rescue.scenes.splits import FINAL, SPLITS, split_of
from reproduce.storage.errors import UserError
from reproduce.storage.processes import map_in_processes

Row = TypeVar("Row")


def scene_seeds(tests: int, first_seed: int) -> range:
    """Return the seeds of so many scenes.

    Raises:
        UserError: On numbers out of range, or where the scenes belong to more than one split.
    """
    if tests < 1:
        raise UserError(f"tests: expected at least 1, got {tests}")
    if first_seed < 0:
        raise UserError(f"first seed: expected at least 0, got {first_seed}")
    first, last = split_of(first_seed), split_of(first_seed + tests - 1)
    if first != last:
        raise UserError(
            f"first seed {first_seed}, tests {tests}: the scenes belong to {first} and {last}; "
            "choose seeds of one split"
        )
    return range(first_seed, first_seed + tests)


def first_scene(split: str | None, first_seed: int | None, tell: Callable[[str], object]) -> int:
    """Return where to begin, the first scene of ``validation`` unless told otherwise, and call final splits so.

    Raises:
        UserError: On a split that does not exist, or a seed that is not in it.
    """
    if split is not None and split not in SPLITS:
        raise UserError(f"--split: expected one of {', '.join(SPLITS)}; got {split!r}")
    seed = SPLITS[split or "validation"].start if first_seed is None else first_seed
    seeds = SPLITS[split] if split else range(SPLITS["heldout"].stop)
    if seed not in seeds:
        raise UserError(
            f"--first-seed: {split or 'every split'} has seeds {seeds.start} to {seeds.stop - 1}; got {seed}"
        )
    if split_of(seed) in FINAL:
        tell(f"{split_of(seed)}: for final figures; whatever is still tried is judged on validation scenes")
    return seed


def known_simulator(name: str) -> str:
    """Return the name of a simulator that can be used here.

    Raises:
        UserError: On one that does not exist, or whose package is not installed.
    """
    try:
        check_simulator(name)
    except (ValueError, DependencyNotInstalled) as error:
        raise UserError(str(error)) from None
    return name


def map_scenes(
    function: Callable[[int], Row],
    seeds: Sequence[int],
    initializer: Callable[..., object] | None = None,
    arguments: tuple[Any, ...] = (),
    *,
    title: str = "scenes",
    workers: int | None = None,
    quiet: bool = False,
) -> list[Row]:
    """Return a function's answers to all seeds, in their order, and show how far it has come meanwhile.

    ``function`` and what ``initializer`` is called with, once in each worker, must pickle; ``workers`` None is one a
    core.

    Raises:
        RunFailedError: When a worker was killed or crashed.
    """
    bar = partial(tqdm, unit="scene", desc=title, disable=quiet)
    return map_in_processes(function, seeds, workers, initializer, arguments, bar)
