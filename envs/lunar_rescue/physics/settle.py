"""Let each posture come to rest on level ground and write the resting pose into the posture file.

Run ``python -m lunar_rescue.physics.settle`` after changing a posture; a test checks that the poses stay put.
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.physics.bullet import BulletSimulation
from lunar_rescue.scenes.postures import FILES, Posture, attitude_rotation, load_postures
from lunar_rescue.scenes.suit import mass_properties, surface_points

SETTLING_TIME = 30.0  # s
TYPICAL_MASS = 250.0  # kg


def settle(posture: Posture) -> tuple[float, tuple[float, ...]]:
    """Drop a posture gently and return resting height [m] and quaternion with the head along +x."""
    simulation = BulletSimulation()
    try:
        body = simulation.add_suit(posture.limbs, TYPICAL_MASS)
        rotation = attitude_rotation(posture.attitude)
        lowest = rotation.apply(surface_points(posture.limbs) - mass_properties(posture.limbs).centre)[:, 2].min()
        simulation.place_suit(body, np.array([0.0, 0.0, 0.01 - lowest]), rotation)
        simulation.advance_by(SETTLING_TIME)
        centre, rotation = simulation.pose(body)
    finally:
        simulation.close()
    head = rotation.apply([0.0, 0.0, 1.0])
    level = Rotation.from_euler("z", -np.arctan2(head[1], head[0])) * rotation
    return float(centre[2]), tuple(float(v) for v in level.as_quat(canonical=True))


def main() -> int:
    """Settle the postures of all files and write them back."""
    for path in FILES.values():
        settle_file(path)
    return 0


def settle_file(path: Path) -> None:
    """Settle every posture of a file and write the file back."""
    document = json.loads(path.read_text(encoding="utf-8"))
    for entry, posture in zip(document["postures"], load_postures(path).values(), strict=True):
        height, quaternion = settle(posture)
        entry["rest"] = {"height": round(height, 6), "quaternion": [round(v, 9) for v in quaternion]}
        front = Rotation.from_quat(quaternion).apply([1.0, 0.0, 0.0])
        print(f"{posture.name:28s} height {height:.3f} m, front {np.round(front, 2)}")
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
