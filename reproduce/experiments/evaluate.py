"""Test a policy on scenes by seed, one scene at a time in as many processes as there are cores.

Every method meets the same scenes, and the result of a scene does not depend on which others are tested beside it.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.physics.engines import DEFAULT
from lunar_rescue.scenes.postures import all_postures
from lunar_rescue.scenes.sampling import easy_scene
from reproduce.experiments.methods import METHODS, Method, check_actor, load_policy
from reproduce.experiments.pool import known_simulator, map_scenes, scene_seeds
from reproduce.experiments.rows import as_table, rows_path, summarise, write_rows
from reproduce.learning.policy import Policy, begin_episode
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, write_json
from reproduce.storage.processes import start_fork_server
from reproduce.storage.provenance import provenance

_STATE: dict[str, Any] = {}
_USUAL = {"simulator": DEFAULT, "observation": "state"}  # goes without saying in a summary


def find_policy(where: str | Path, ablation: str | None = None) -> tuple[Method, Policy]:
    """Load the policy of a run folder, or of a method that does not learn by its name; see ``hrl_dcs.ablation``.

    Raises:
        UserError: Where there is neither; the message names what there is and the nearest of it.
    """
    check_actor(where)
    if Path(where).exists():
        method, policy = load_policy(Path(where))
    else:
        method, policy = METHODS[str(where)], METHODS[str(where)].act(0)
    if ablation is None:
        return method, policy
    from reproduce.hrl_dcs.ablation import ablated

    return method, ablated(policy, ablation, method.name)


def act_out(
    env: LunarRescueEnv, policy: Policy, scene: Scene, **options: Any
) -> Iterator[tuple[NDArray[np.float32], float, dict[str, Any]]]:
    """Act out one rescue; yield action (11,), reward and info of each step. ``options`` are more of the reset."""
    observation = begin_episode(env, policy, scene, **options)
    start, done = np.array([True]), False
    while not done:
        action = policy.act(observation[None], start)[0]
        observation, reward, terminated, truncated, info = env.step_flat(action)
        start, done = np.array([False]), terminated or truncated
        yield action, reward, info


def run_episode(env: LunarRescueEnv, policy: Policy, scene: Scene, **options: Any) -> dict[str, Any]:
    """Act out one rescue and return the scene's row, as ``rows.SceneRow``; ``options`` are more of the reset."""
    _, rewards, infos = zip(*act_out(env, policy, scene, **options), strict=True)
    total, last = sum(rewards, 0.0), infos[-1]
    return {
        "seed": scene.seed,
        "task": last["task"],
        "posture": last["posture"],
        "attitude": all_postures()[scene.posture].attitude,
        "mass": scene.mass,
        "rocks": len(scene.rocks),
        "terrain": "rough" if scene.terrain.rough else "smooth",
        "success": last["is_success"],
        "failure": last["failure"],
        "both_arms_under": last["both_arms_under"],
        "steps": env.episode.steps,
        "return": float(total),
        "nearest_mark": float(env.episode.nearest_mark) if scene.rocks else None,
        **{name: last[name] for name in ("peak_force", "peak_speed", "peak_acceleration", "gentle")},
    }


def put_into(simulator: str, policy: Policy, plans_of: str | None = None, observation: str = "state") -> LunarRescueEnv:
    """Return an environment in a simulator; a policy that tries out what it plans does so there, or in ``plans_of``.

    With ``observation="image"`` its observations are what the embedding of ``results/perception`` makes of pictures.

    Raises:
        UserError: On a simulator that is not there, or plans of a policy that makes none.
    """
    _plan_in(simulator, policy, plans_of)
    if observation == "state":
        return LunarRescueEnv(simulator=simulator)
    from reproduce.perception.estimator import EstimatedEnv

    return EstimatedEnv(simulator=simulator)


def _plan_in(simulator: str, policy: Policy, plans_of: str | None) -> None:
    """Check the simulators, and tell a policy that plans in which one to try plans out."""
    for name in filter(None, (simulator, plans_of)):
        known_simulator(name)
    if hasattr(policy, "plan_in"):
        policy.plan_in(plans_of or simulator)
    elif plans_of:
        raise UserError("--plans-of: only the planner makes plans; leave it out")


def _prepare(where: str, ablation: str | None, simulator: str, plans_of: str | None, observation: str) -> None:
    method, _STATE["policy"] = find_policy(where, ablation)
    _STATE["env"] = put_into(simulator, _STATE["policy"], plans_of, observation)
    if method.learns or observation == "image":
        import torch as th

        th.set_num_threads(1)


def _test(seed: int, easy: bool) -> dict[str, Any]:
    return run_episode(_STATE["env"], _STATE["policy"], easy_scene(seed) if easy else sample_scene(seed))


def rescue_scenes(
    where: str | Path,
    tests: int,
    first_seed: int = 0,
    workers: int | None = None,
    quiet: bool = False,
    ablation: str | None = None,
    easy: bool = False,
    simulator: str = DEFAULT,
    plans_of: str | None = None,
    observation: str = "state",
) -> list[dict[str, Any]]:
    """Test a policy and return one row a scene, in the order of seeds.

    Raises:
        UserError: On numbers out of range, a run folder that does not load or a simulator that is not there.
    """
    seeds = scene_seeds(tests, first_seed)
    known_simulator(simulator)
    learned = ["reproduce.learning.networks"] if Path(where).is_dir() else []
    start_fork_server(__name__, *learned)  # it imports for the workers while this process does for itself
    # A bad run folder, or a simulator that is not there, fails here, in one line, and not in a worker.
    _plan_in(simulator, find_policy(where, ablation)[1], plans_of)
    if observation == "image":
        from reproduce.perception.estimator import load_embedding

        load_embedding()
    job, arguments = partial(_test, easy=easy), (str(where), ablation, simulator, plans_of, observation)
    return map_scenes(job, seeds, _prepare, arguments, title=Path(where).name, workers=workers, quiet=quiet)


def evaluate(
    where: str | Path,
    tests: int,
    first_seed: int = 0,
    quiet: bool = False,
    ablation: str | None = None,
    easy: bool = False,
    json: Path | None = None,
    tell: Callable[[dict[str, Any]], object] | None = None,
    simulator: str = DEFAULT,
    plans_of: str | None = None,
    observation: str = "state",
) -> dict[str, Any]:
    """Test a policy on ``tests`` scenes and return the summary.

    ``where`` is a run folder or a method that does not learn; for ``ablation`` see ``hrl_dcs.ablation``. The planner
    tries its plans out in ``plans_of``, if given; with ``observation="image"`` policies act on what the embedding sees.
    The summary goes to ``json``, the rows beside it (``rows.rows_path``); ``tell`` is called first, in case that fails.
    """
    table = rows_path(json) if json else None  # None, too, where the summary goes to a device or a pipe
    for path in filter(None, (json, table)):
        check_writable(path)
    places: dict[str, Any] = {"simulator": simulator, "plans_of": plans_of, "observation": observation}
    begun = time.monotonic()
    rows = as_table(rescue_scenes(where, tests, first_seed, quiet=quiet, ablation=ablation, easy=easy, **places))
    seconds = time.monotonic() - begun
    conditions = {"ablation": ablation, "scenes": "easy" if easy else None, **places}
    summary = {
        "method": find_policy(where)[0].name,
        **{name: what for name, what in conditions.items() if what and what != _USUAL.get(name)},
        **summarise(rows),
        **{"seconds": round(seconds, 2), "seconds_per_test": round(seconds / tests, 4), "origin": provenance()},
    }
    if tell:
        tell(summary)
    if table:
        write_rows(table, rows)
    if json:
        write_json(json, summary)
    return summary
