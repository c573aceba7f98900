"""The embedding's network: pictures and the robot's own sensors in, the body, its posture, rocks and ground out.

```
colour, depth -> points in the base frame, colours -> 5 convolutions with group norm -> 192 features --+
features of a cell (4 x 4 px) and of what is around it -> cells to look at -> their points -------------+
own sensors, standardised ------------------------------------------------------------------------------+-> LSTM
all of these and the LSTM -> two fully connected layers -> body, posture, motion, ground
```
Depth and the waist's angle say where in the base frame each pixel lies, and that is what the network sees. For each
point of the body it looks at some cells, takes the mean of where they are, and adds what lies between. Of each square
of 2 x 2 px it says how much of it shows a rock, and which, by where that one's top is.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from lunar_rescue.observation import GROUND_POINTS, SLICES
from lunar_rescue.physics.robot import WAIST_WINDOW
from lunar_rescue.pictures.head import HEIGHT, MOUNT, PITCH, WAIST_HEIGHT, WIDTH, pixel_rays
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.records import checked
from lunar_rescue.scenes.suit import KEYPOINT_NAMES
from lunar_rescue.seeing import UP
from reproduce.storage.policies import Spec

CELL = 4  # px, side of a cell
ROWS, COLUMNS = HEIGHT // CELL, WIDTH // CELL
SQUARE = 2  # px, side of the squares that are told to show a rock or not
POINTS = 1 + len(KEYPOINT_NAMES)  # centre of gravity, then the skeleton
FEATURES = 192
#: What of the flat observation the network sees besides pictures: arms, waist, up vector, task.
OWN = np.r_[SLICES["P_A"], SLICES["P_B"], SLICES["P_W"], UP, SLICES["I"]]
_WAIST = SLICES["P_W"].start
MIDDLE, SPREAD = (1.0, 0.0, 0.2), 0.4  # m, of the points; rough, so that outputs are of size 1
SPEED, SPIN = 0.2, 0.5  # m/s and rad/s, the same of the body's motion
LEAST, MOST = -7.0, 3.0  # of the logarithm of a variance
#: Outputs of the last layer by name, and how many.
PARTS = {
    "points": 3 * POINTS,
    "spread": POINTS,
    "motion": 6,
    "doubt": 2,
    "posture": 20,
    "ground": 2 * GROUND_POINTS + 1,
}
State = tuple[th.Tensor, th.Tensor]


class Seen(NamedTuple):
    """What the network makes of n pictures; variances are logarithms, of what is divided by its scale."""

    points: th.Tensor  # centre of gravity and skeleton in the base frame (n, POINTS, 3) [m]
    spread: th.Tensor  # variance of each point along each axis (n, POINTS) [SPREAD^2]
    motion: th.Tensor  # velocity and spin (n, 2, 3) [m/s, rad/s]
    doubt: th.Tensor  # variance of the two (n, 2)
    posture: th.Tensor  # logarithms of the odds of the 20 postures (n, 20)
    ground: th.Tensor  # heights along the ways in, then their variance (n, 2 GROUND_POINTS + 1) [0.1 m]
    #: Of each square of pictures that begin an episode: log odds of a rock in a pixel, its top (3) and radius [m].
    rocks: th.Tensor  # (n / length, 5, HEIGHT / SQUARE, WIDTH / SQUARE), none where a state was handed in


@checked
@dataclass(frozen=True)
class EmbeddingSpec(Spec):
    """All that is needed to build the network; ``observations`` are its own sensors, ``actions`` the postures."""

    width: int  # Of the pictures [px]
    height: int  # Of the pictures [px]

    def build(self) -> "Embedding":
        """Make a network of these sizes, not trained."""
        return Embedding(self.hidden_units)


def spec() -> EmbeddingSpec:
    """Return the description of the network as it is trained."""
    return EmbeddingSpec(len(OWN), len(postures()), 128, WIDTH, HEIGHT)


def _layer(inputs: int, outputs: int, kernel: int, stride: int, padding: int) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding)
    return nn.Sequential(convolution, nn.GroupNorm(8, outputs), nn.ReLU())


class Embedding(nn.Module):
    """The network; it keeps no state between calls, whoever calls it keeps the LSTM's."""

    middle: th.Tensor
    scale: th.Tensor

    def __init__(self, hidden_units: int = 128) -> None:
        super().__init__()
        self.squares = _layer(6, 16, 3, 2, 1)
        self.cells = nn.Sequential(_layer(16, 32, 3, 2, 1), _layer(32, 32, 3, 1, 1))
        self.whole = nn.Sequential(_layer(32, 64, 3, 2, 1), _layer(64, 96, 3, 2, 1))
        self.features = nn.Sequential(nn.Flatten(), nn.Linear(96 * 5 * 6, FEATURES), nn.ReLU())
        self.around = nn.Conv2d(96, 16, 1)
        self.places = nn.Sequential(nn.Conv2d(48, 48, 3, 1, 1), nn.ReLU(), nn.Conv2d(48, POINTS, 1))
        shown = nn.Conv2d(32, 5, 1)
        self.beside = nn.Sequential(nn.Conv2d(48, 32, 3, 1, 1), nn.ReLU(), nn.Conv2d(32, 24, 1))
        self.rocks = nn.Sequential(nn.Conv2d(40, 32, 3, 1, 1), nn.ReLU(), shown)
        inputs = FEATURES + len(OWN) + 3 * POINTS
        self.lstm = nn.LSTM(inputs, hidden_units)
        last = nn.Linear(FEATURES, sum(PARTS.values()))
        self.head = nn.Sequential(nn.Linear(inputs + hidden_units, FEATURES), nn.ReLU(), last)
        nn.init.constant_(shown.get_parameter("bias")[:1], -4.0)  # hardly any square shows a rock
        self.register_buffer("middle", th.zeros(len(OWN)))
        self.register_buffer("scale", th.ones(len(OWN)))

    def set_training_mode(self, mode: bool) -> None:
        """Go into training or out of it, by the name that SB3's networks have for it."""
        self.train(mode)

    def forward(self, pictures: th.Tensor, own: th.Tensor, length: int, state: State | None) -> tuple[Seen, State]:
        """See n / length episodes of ``length`` pictures each, one after the other in time.

        Args:
            pictures: As ``picture_input`` makes them (n, 6, HEIGHT, WIDTH), all episodes' first ones first.
            own: Own sensors (n, len(OWN)).
            length: Pictures of each episode.
            state: The LSTM's, (1, n / length, h) twice; None where episodes begin.
        """
        fine = self.squares(pictures)
        cells = self.cells(fine)
        coarse = self.whole(cells)
        around = nn.functional.interpolate(self.around(coarse), size=(ROWS, COLUMNS), mode="nearest")
        cells = th.cat([cells, around], dim=1)
        looked_at = self.places(cells).flatten(2).softmax(dim=2) @ _points(pictures, CELL).flatten(2).transpose(1, 2)
        away = ((looked_at - pictures.new_tensor(MIDDLE)) / SPREAD).flatten(1)
        known = ((own - self.middle) / self.scale).clamp(-5.0, 5.0)
        inputs = th.cat([self.features(coarse), known, away], dim=1)
        hidden, after = self.lstm(inputs.view(length, -1, inputs.shape[1]), state)
        joined = self.head(th.cat([inputs, hidden.reshape(len(inputs), -1)], dim=1))
        points, spread, motion, doubt, posture, ground = joined.split(list(PARTS.values()), dim=1)
        moving = motion.view(-1, 2, 3) * motion.new_tensor([SPEED, SPIN])[:, None]
        placed = looked_at + SPREAD * points.view(-1, POINTS, 3)
        spread, doubt = spread.clamp(LEAST, MOST), doubt.clamp(LEAST, MOST)
        first = slice(len(pictures) // length if state is None else 0)  # rocks stay where they are: one look is enough
        rocks = self._rocks(pictures[first], fine[first], cells[first])
        return Seen(placed, spread, moving, doubt, posture, ground, rocks), after

    def _rocks(self, pictures: th.Tensor, fine: th.Tensor, cells: th.Tensor) -> th.Tensor:
        beside = nn.functional.interpolate(self.beside(cells), size=fine.shape[2:], mode="nearest")
        shown = self.rocks(th.cat([fine, beside], dim=1))
        tops = _points(pictures, SQUARE) + 0.1 * shown[:, 1:4]
        return th.cat([shown[:, :1], tops, 0.05 + 0.05 * shown[:, 4:]], dim=1)


def _points(pictures: th.Tensor, side: int) -> th.Tensor:
    """Return mean points of squares of so many pixels in the base frame, (n, 3, HEIGHT / side, WIDTH / side) [m]."""
    return nn.functional.avg_pool2d(pictures[:, :3], side) + pictures.new_tensor(MIDDLE)[:, None, None]


def picture_input(colour: NDArray[np.uint8], depth: NDArray[np.uint16], observations: NDArray[np.float32]) -> th.Tensor:
    """Return what the network sees of pictures: each pixel's point less ``MIDDLE`` [m] and colour, (n, 6, h, w).

    Args:
        colour: Colours (n, HEIGHT, WIDTH, 3).
        depth: Depths (n, HEIGHT, WIDTH) [mm].
        observations: Flat observations (n, SIZE), of which the waist's angle is read.

    Raises:
        ValueError: On pictures of another shape or type.
    """
    expected: tuple[tuple[str, NDArray[Any], tuple[int, ...], Any], ...] = (
        ("colour", colour, (len(observations), HEIGHT, WIDTH, 3), np.uint8),
        ("depth", depth, (len(observations), HEIGHT, WIDTH), np.uint16),
    )
    for name, array, shape, kind in expected:
        if array.shape != shape or array.dtype != kind:
            got = f"{array.dtype} {array.shape}"
            raise ValueError(f"{name}: expected pictures {np.dtype(kind)} {shape}, got {got}")
    away = th.from_numpy(depth.astype(np.float32) / 1000)[..., None]
    axes, places = _camera(th.from_numpy(observations[:, _WAIST] * np.float32(WAIST_WINDOW)))
    points = (th.from_numpy(pixel_rays()) * away).flatten(1, 2) @ axes + (places - places.new_tensor(MIDDLE))[:, None]
    shades = th.from_numpy(colour).flatten(1, 2).float() / 128 - 1.0
    return th.cat([points, shades], dim=2).transpose(1, 2).reshape(-1, 6, HEIGHT, WIDTH)


def moved(pictures: th.Tensor, right: int, down: int) -> th.Tensor:
    """Return pictures (n, c, h, w) moved by some pixels; what comes in from outside is like the edge."""
    margin, (height, width) = max(abs(right), abs(down)), pictures.shape[2:]
    padded = nn.functional.pad(pictures, (margin,) * 4, mode="replicate")
    top, left = margin - down, margin - right
    return padded[:, :, top : top + height, left : left + width]


def _camera(waist: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return axes in rows (n, 3, 3) and places (n, 3) [m] of the camera in the base frame, by waist (n,) [rad]."""
    lean, none = waist + PITCH, th.zeros_like(waist)
    right = th.stack([none, none - 1.0, none], dim=1)
    up = th.stack([lean.sin(), none, lean.cos()], dim=1)
    back = th.stack([-lean.cos(), none, lean.sin()], dim=1)
    c, s = waist.cos(), waist.sin()
    place = th.stack([c * MOUNT[0] + s * MOUNT[2], none, c * MOUNT[2] - s * MOUNT[0] + WAIST_HEIGHT], dim=1)
    return th.stack([right, up, back], dim=1), place
