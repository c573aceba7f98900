"""Pictures of a scene: camera, light and the posture gallery (PyBullet's software renderer, no display needed)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lunar_rescue.scene import Scene
    from lunar_rescue.simulation import Simulation

Picture = NDArray[np.uint8]

SIZE = (480, 352)  # px, multiples of 16 as films want them
DISTANCE = 3.0  # m, camera from the point between robot and astronaut
PITCH = -28.0  # deg
TURN = 52.0  # deg, camera beside the line from robot to astronaut
GALLERY_TURN = 150.0  # deg, camera beyond the astronaut


def picture(simulation: Simulation, scene: Scene, size: tuple[int, int] = SIZE, turn: float = TURN) -> Picture:
    """Take a picture (height, width, 3) from beside the robot, looking at robot and astronaut."""
    middle = [(scene.base_x + scene.astronaut_x) / 2, (scene.base_y + scene.astronaut_y) / 2, 0.30]
    yaw = float(np.degrees(scene.base_yaw)) - 90.0 + turn
    return simulation.camera(middle, DISTANCE, yaw, PITCH, size)
