"""What kinds of ground cost: why the relief is made of mounds.

The same scenes and actions on the same heights, built in several ways. Only this experiment builds heightfields and
meshes, so they are not part of the environment's simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count, islice
from time import perf_counter
from typing import Any

import numpy as np
import pybullet as pb
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.physics.robot import CONTROL_SUBSTEPS, JOINTS
from lunar_rescue.scenes.terrain import SMOOTH
from reproduce.experiments.soak import FIRST_SEED

Array = NDArray[np.float64]

SCENES, STEPS, HOLD = 40, 60, 12
HALF = 1.8  # m, half side of the heights


def heights(scene: Scene, cell: float) -> tuple[Array, Array]:
    """Grid line (n,) [m] about the astronaut and the ground's height over it (n, n) [m]."""
    line = np.arange(-HALF, HALF + cell / 2, cell)
    x, y = np.meshgrid(scene.astronaut_x + line, scene.astronaut_y + line, indexing="ij")
    return line, scene.terrain.height(x, y)


def add_heightfield(client: int, scene: Scene, cell: float) -> int:
    """A heightfield in place of the plane."""
    line, grid = heights(scene, cell)
    shape = pb.createCollisionShape(
        pb.GEOM_HEIGHTFIELD,
        meshScale=[cell, cell, 1.0],
        heightfieldData=grid.T.ravel().tolist(),
        numHeightfieldRows=len(line),
        numHeightfieldColumns=len(line),
        physicsClientId=client,
    )
    # Bullet centres a heightfield on the middle of its heights.
    middle = (scene.astronaut_x, scene.astronaut_y, 0.5 * float(grid.max() + grid.min()))
    return int(pb.createMultiBody(0, shape, -1, middle, physicsClientId=client))


def add_mesh(client: int, scene: Scene, cell: float) -> int:
    """A mesh of triangles in place of the plane."""
    line, grid = heights(scene, cell)
    n = len(line)
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x, y, grid], axis=-1).reshape(-1, 3)
    shape = pb.createCollisionShape(
        pb.GEOM_MESH,
        vertices=vertices.tolist(),
        indices=faces.ravel().tolist(),
        flags=pb.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    place = (scene.astronaut_x, scene.astronaut_y, 0.0)
    return int(pb.createMultiBody(0, shape, -1, place, physicsClientId=client))


Build = Callable[[int, Scene], int]
#: Name to what takes the plane's place, or None.
GROUNDS: dict[str, Build | None] = {
    "plane": None,
    "mounds": None,
    "heightfield_20cm": lambda client, scene: add_heightfield(client, scene, 0.2),
    "heightfield_10cm": lambda client, scene: add_heightfield(client, scene, 0.1),
    "mesh_20cm": lambda client, scene: add_mesh(client, scene, 0.2),
}


def act_on(env: LunarRescueEnv, scene: Scene, name: str) -> float:
    """Seconds of a step's physics on one ground."""
    build, simulation = GROUNDS[name], env.simulation
    client = simulation.client
    mounds = name == "mounds"
    bare = scene if mounds else replace(scene, terrain=SMOOTH)
    env.reset_flat(options={"scene": bare})
    simulation.set_up_vector(scene.terrain.up())
    skin = None if build is None else build(client, scene)
    if skin is not None:
        pb.resetBasePositionAndOrientation(simulation.ground, (0, 0, -5), (0, 0, 0, 1), physicsClientId=client)
    rng, spent = np.random.default_rng(scene.seed), 0.0
    try:
        for step in range(STEPS):
            if step % HOLD == 0:
                action = rng.uniform(-1, 1, JOINTS)
            env.robot.drive(action, env.robot.state().angles)
            begun = perf_counter()
            simulation.advance(CONTROL_SUBSTEPS)
            spent += perf_counter() - begun
    finally:
        if skin is not None:
            pb.removeBody(skin, physicsClientId=client)
            pb.resetBasePositionAndOrientation(simulation.ground, (0, 0, 0), (0, 0, 0, 1), physicsClientId=client)
    return spent / STEPS


def measure_grounds() -> dict[str, Any]:
    """Time of a step's physics over that on a plane, medians over scenes."""
    env = LunarRescueEnv()
    seconds: dict[str, list[float]] = {name: [] for name in GROUNDS}
    seeds = (seed for seed in count(FIRST_SEED) if sample_scene(seed).terrain.rough)
    try:
        for scene in map(sample_scene, islice(seeds, SCENES)):
            for name in GROUNDS:
                seconds[name].append(act_on(env, scene, name))
    finally:
        env.close()
    plane = np.array(seconds["plane"])
    ratios = {name: float(np.median(np.array(spent) / plane)) for name, spent in seconds.items() if name != "plane"}
    return {**{f"{name}_over_plane": round(ratio, 2) for name, ratio in ratios.items()}, "ground_scenes": SCENES}
