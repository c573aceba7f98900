"""Mirror images of postures, which the environment itself does not have: its postures are distinct under mirroring."""

from __future__ import annotations

import dataclasses
from typing import Any

from lunar_rescue.scenes.postures import Posture, Rest
from lunar_rescue.scenes.suit import Limbs


def mirrored(posture: Posture) -> tuple[str, Limbs]:
    """Return attitude and limbs of a posture's mirror image."""
    swap = {"left": "right", "right": "left"}
    limbs = {f"{swap[(w := k.split('_', 1))[0]]}_{w[1]}": v for k, v in dataclasses.asdict(posture.limbs).items()}
    side, _, rest = posture.attitude.partition("_")
    return (f"{swap[side]}_{rest}" if rest else posture.attitude), Limbs(**limbs)


def image(posture: Posture) -> Posture:
    """Return the mirror image of a posture, at rest as it rests, in the plane of its head and the vertical."""
    attitude, limbs = mirrored(posture)
    x, y, z, w = posture.rest.quaternion
    changes: dict[str, Any] = {"attitude": attitude, "limbs": limbs, "rest": Rest(posture.rest.height, (-x, y, -z, w))}
    return dataclasses.replace(posture, name=f"{posture.name}_image", **changes)
