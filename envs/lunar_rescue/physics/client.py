"""A connection to PyBullet, for the simulation and for the stage that pictures are taken of."""

from pathlib import Path
from typing import Any, NoReturn

from lunar_rescue.physics.quiet import decimal_points, no_greeting

with no_greeting():
    import pybullet as pb
    from pybullet_utils.bullet_client import BulletClient

DATA = Path(__file__).parent.parent / "data"
ROBOT_FILE = DATA / "robot.urdf"
MOUND_FILE = DATA / "mound.obj"  # a unit cap, ``1 - rho^2`` in rings of ten corners


class NotCopied:
    """Refuse to be copied or pickled: a copy would hold the original's world, step it and close it."""

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raise TypeError, which says what to do instead."""
        raise TypeError(
            f"{type(self).__name__}: holds a simulated world, which cannot be copied or pickled; "
            "make another one, and reset it to the same scene"
        )


class Client(NotCopied):
    """One PyBullet client of one's own; a world that nothing else sees."""

    def __init__(self, mode: int = pb.DIRECT) -> None:
        """Connect in PyBullet's ``mode``; only a window needs another than the default."""
        with no_greeting():
            self._client: Any = BulletClient(mode)

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._client is not None:
            with no_greeting():
                self._client.disconnect()
            self._client = None

    def _load_urdf(self, path: Path, flags: int = 0) -> int:
        """Load a robot file with a base that stays where it is put."""
        with no_greeting(), decimal_points():
            return int(self._client.loadURDF(str(path), useFixedBase=True, flags=flags))
