"""The embedding's loss, and how pictures are moved so that one stands for many."""

import math
from dataclasses import replace

import numpy as np
import torch as th
from torch import nn

from lunar_rescue.observation import GROUND_POINTS, SLICES
from lunar_rescue.scenes.rocks import MAX_ROCKS
from reproduce.perception.frames import Frames
from reproduce.perception.network import MIDDLE, SPEED, SPIN, SPREAD, SQUARE, Seen

TURN, MOVE = math.radians(8.0), 0.06  # rad and m, what they show is turned and moved by up to this
DOUBTS = (-7.0, 3.0)  # least and greatest logarithm of the ground's variance


def loss_of(seen: Seen, frames: Frames, *, still: bool = False) -> dict[str, th.Tensor]:
    """Return the terms of the loss, by name; the ground counts in pictures that begin an episode.

    So does motion where pictures are ``still``, with no motion from one to the next that could be told.

    Points, motion and ground are Gaussian with the variance that the network says; each term is weighted by the root of
    that variance, held fixed, so that what is hard to see is learnt, too (Seitzer et al., 2022, beta = 0.5).
    """
    truth, start = th.from_numpy(frames.truth), th.from_numpy(frames.start)
    body = truth[:, SLICES["P_P"]]
    points = th.cat([body[:, None, :3], body[:, 15:].view(len(body), -1, 3)], dim=1)
    motion = body[:, 9:15].view(-1, 2, 3) - seen.motion
    error, told = motion / motion.new_tensor([SPEED, SPIN])[:, None], start if still else th.ones_like(start)
    terms = {
        "points": _gaussian((points - seen.points) / SPREAD, seen.spread[..., None]),
        "motion": _gaussian(error[told], seen.doubt[told, :, None]),
        "posture": nn.functional.cross_entropy(seen.posture, th.from_numpy(frames.posture), ignore_index=-1),
    }
    if start.any():
        ground = truth[start][:, SLICES["P_T"]][:, 3:] - seen.ground[start, : 2 * GROUND_POINTS]
        terms["ground"] = _gaussian(ground, seen.ground[start, 2 * GROUND_POINTS :].clamp(*DOUBTS))
    return terms | _rock_loss(seen.rocks, truth, th.from_numpy(frames.rocks[: len(seen.rocks)]))


def _gaussian(error: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """Return the mean of the negative log-likelihood of errors, for logarithms of variances."""
    likelihood = 0.5 * (error**2 * th.exp(-variance) + variance)
    return (likelihood * th.exp(0.5 * variance).detach()).mean()


def _rock_loss(seen: th.Tensor, truth: th.Tensor, shown: th.Tensor) -> dict[str, th.Tensor]:
    """Return the losses of finding rocks and of where they are, for what pixels show (n, HEIGHT, WIDTH)."""
    pixels = nn.functional.pixel_unshuffle(shown[:, None].float(), SQUARE)  # of each square along the second axis
    share = (pixels > 0).float().mean(dim=1)
    found = nn.functional.binary_cross_entropy_with_logits(seen[:, 0], share, reduction="sum")
    index, row, column = th.nonzero(share, as_tuple=True)
    rock = pixels.amax(dim=1)[index, row, column].long() - 1
    places = truth[:, SLICES["P_E"]].view(-1, MAX_ROCKS, 5)[index, rock, :4]
    away = nn.functional.smooth_l1_loss(seen[index, 1:, row, column], places, reduction="sum", beta=0.02)
    return {"found": found / share.sum().clamp(1.0), "places": 10.0 * away / max(len(index), 1)}


def total(terms: dict[str, th.Tensor]) -> th.Tensor:
    """Return the sum of the loss's terms."""
    return th.stack(list(terms.values())).sum()


def turned(pictures: th.Tensor, frames: Frames, length: int, rng: np.random.Generator) -> Frames:
    """Move everything that pictures (n, 6, h, w) show a little about the robot, in place; return frames that say so.

    Each episode of ``length`` pictures is turned about the base's vertical and moved along the ground by amounts of its
    own: one picture stands for many places of the base.
    """
    episodes = len(frames) // length
    angles, moves = rng.uniform(-TURN, TURN, episodes), rng.uniform(-MOVE, MOVE, (episodes, 1, 2))
    c, s = np.tile(np.cos(angles), length), np.tile(np.sin(angles), length)
    turns, moves = np.array([[c, s], [-s, c]]).transpose(2, 0, 1), np.tile(moves, (length, 1, 1))  # rows times turns
    middle = np.array(MIDDLE[:2])
    shift = th.from_numpy((middle @ turns + moves[:, 0] - middle).astype(np.float32))
    flat = pictures[:, :2].flatten(2).transpose(1, 2) @ th.from_numpy(turns.astype(np.float32))
    pictures[:, :2] = flat.transpose(1, 2).reshape(pictures[:, :2].shape) + shift[:, :, None, None]
    truth = frames.truth.copy()
    body, rocks = truth[:, SLICES["P_P"]].reshape(len(truth), -1, 3), truth[:, SLICES["P_E"]].reshape(-1, MAX_ROCKS, 5)
    body[..., :2], rocks[..., :2] = body[..., :2] @ turns, rocks[..., :2] @ turns
    body[:, [0, *range(5, body.shape[1])], :2] += moves
    rocks[..., :2] += moves * rocks[..., 4:]
    truth[:, SLICES["P_P"]], truth[:, SLICES["P_E"]] = body.reshape(len(truth), -1), rocks.reshape(len(truth), -1)
    return replace(frames, truth=truth)
