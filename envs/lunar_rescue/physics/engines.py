"""The simulators by their names; one interface, see ``simulation``."""

from importlib.util import find_spec

from gymnasium.error import DependencyNotInstalled

from lunar_rescue.physics.bullet import BulletSimulation
from lunar_rescue.physics.simulation import Simulation
from lunar_rescue.physics.solver import MUJOCO_SETTINGS, SETTINGS, SolverSettings

#: Each simulator and what it works with unless told otherwise; the first one is what scenes and rules were made with.
SIMULATORS: dict[str, SolverSettings] = {"pybullet": SETTINGS, "mujoco": MUJOCO_SETTINGS}
DEFAULT = "pybullet"


def check_simulator(name: str) -> None:
    """Refuse a simulator that does not exist or is not installed.

    Raises:
        ValueError: On an unknown name.
        DependencyNotInstalled: Where the package that it needs is missing.
    """
    if name not in SIMULATORS:
        raise ValueError(f"simulator: expected one of {', '.join(SIMULATORS)}; got {name!r}")
    if find_spec(name) is None:
        raise DependencyNotInstalled(f"simulator {name!r}: needs a package that is not installed: pip install {name}")


def make_simulation(name: str, settings: SolverSettings | None = None) -> Simulation:
    """Make an empty world with ground in a simulator; without ``settings`` it works as finely as it should."""
    check_simulator(name)
    settings = SIMULATORS[name] if settings is None else settings
    if name == "pybullet":
        return BulletSimulation(settings)
    from lunar_rescue.physics.mujoco_engine import MujocoSimulation  # only where the optional package is there

    return MujocoSimulation(settings)
