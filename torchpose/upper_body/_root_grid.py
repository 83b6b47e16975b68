"""Follow how far away a torso is, and how far its shoulders are turned, on a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.skeleton._joint_sets import UPPER_BODY

__all__ = [
    "SHRUG",
    "Root",
    "RootGrid",
    "Torso",
    "TorsoLengths",
    "middle_of_shoulders",
    "see_torso",
    "shoulder_offsets",
    "torso_places",
]

_TORSO = tuple(UPPER_BODY.index(n) for n in ("shoulder_left", "shoulder_right", "neck", "head"))
_NECK_HEIGHT = 0.105  # metres above the middle of the shoulders (Kinect's neck)
_DEPTH, _DEPTH_STD = 2.6, 0.4  # metres, and of its log: as the Kinect recordings have it
_NEAREST, _FARTHEST, _DEPTH_STEP = 0.4, 9.0, 0.04  # metres, and the step of log depth
_TURN_STEP, _TURN_STD = 15.0, 20.0  # degrees
_BROAD_TURN = 0.2  # share of the turns that are all alike likely
_SPEED, _TURN_SPEED = 0.08, 60.0  # share of the depth, and degrees, after one second
_LOST = 1e-4  # share of a frame's belief that starts anew
# Standard deviation of each torso joint about its place in a stiff torso, metres: x and y.
_STIFF = ((0.03, 0.035), (0.03, 0.035), (0.03, 0.035), (0.05, 0.035))
_RAISED = 0.5  # sine of the angle from which on an arm is raised altogether
SHRUG = 0.07
"""Metres by which the shoulder of a raised arm moves in and up."""

_ARMS = tuple(
    tuple(UPPER_BODY.index(f"{joint}_{side}") for joint in ("shoulder", "elbow", "hand"))
    for side in ("left", "right")
)
_FREEDOM = 4.0  # of the heavy tails of torso joints


class TorsoLengths(NamedTuple):
    """Width between the shoulders, height of the head above the neck, and their deviations, [B], metres."""

    width: Tensor
    height: Tensor
    width_std: Tensor
    height_std: Tensor


class Root(NamedTuple):
    """Hypotheses about the torso: depth, turn psi, log-weight and place in the flat grid, [B, M] each."""

    depth: Tensor
    turn: Tensor
    log_weight: Tensor
    cell: Tensor


class Torso(NamedTuple):
    """Measured torso joints, as rays.

    Attributes:
        rays: K^-1 [u, v, 1] of both shoulders, neck and head, [B, 4, 3]. known: [B, 4].
        std: of a pixel over the focal length, [B, 4].
        raised: from 0 to 1, how far the arm at each shoulder is raised above it, [B, 2].
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    raised: Tensor


def see_torso(
    rays: Float[Tensor, "B 8 3"], known: Bool[Tensor, "B 8"], std: Float[Tensor, "B 8"]
) -> Torso:
    """Return the torso's part of all joints of `UPPER_BODY`."""
    chosen = list(_TORSO)
    raised = torch.stack([_raised(rays, known, *arm) for arm in _ARMS], 1)
    return Torso(rays[:, chosen], known[:, chosen], std[:, chosen], raised)


def _raised(
    rays: Tensor, known: Tensor, shoulder: int, elbow: int, hand: int
) -> Float[Tensor, " B"]:
    """Return how far an elbow, or else a hand, is seen above its shoulder, from 0 to 1."""
    end = torch.where(known[:, elbow, None], rays[:, elbow], rays[:, hand])
    apart = rays[:, shoulder] - end
    rise = apart[:, 1] / torch.linalg.vector_norm(apart, dim=-1).clamp_min(1e-9)
    there = known[:, shoulder] & (known[:, elbow] | known[:, hand])
    return torch.where(there, (rise / _RAISED).clamp(0.0, 1.0), 0.0)


def shoulder_offsets(turn: Float[Tensor, "*batch"], width: Float[Tensor, "*batch"]) -> Tensor:
    """Return the left shoulder relative to the middle of both, camera axes; the right one is opposite.

        W / 2 (cos psi, 0, -sin psi)

    Args:
        turn: psi. width: W, metres.
    """
    half = width / 2
    return torch.stack([half * turn.cos(), torch.zeros_like(half), -half * turn.sin()], -1)


class RootGrid:
    """Point-mass filter over log depth and the turn of the shoulders about the vertical.

    The middle of the shoulders may be anywhere in the image. Given depth and turn, every measured
    joint of the torso says where it is, up to how stiff torsos are; what they disagree about is the
    evidence, with heavy tails (Student, 4 degrees of freedom).

    Args:
        fps: frames per second. like: tells dtype and device.
    """

    def __init__(self, fps: float, like: Tensor) -> None:
        n_depths = 1 + math.ceil(math.log(_FARTHEST / _NEAREST) / _DEPTH_STEP)
        steps = torch.arange(n_depths, dtype=like.dtype, device=like.device)
        self.depth = _NEAREST * (_DEPTH_STEP * steps).exp()
        n_turns = round(360.0 / _TURN_STEP)
        degrees = _TURN_STEP * (torch.arange(n_turns, dtype=like.dtype) - n_turns // 2)
        self.turn = torch.deg2rad(degrees).to(like.device)
        usual = torch.softmax(-0.5 * (degrees / _TURN_STD).square(), 0).to(like.device)
        near = torch.softmax(
            -0.5 * ((self.depth.log() - math.log(_DEPTH)) / _DEPTH_STD).square(), 0
        )
        self.prior = ((1 - _BROAD_TURN) * usual + _BROAD_TURN / n_turns) * near[:, None]
        self._spread = (
            _share_that_moves(_SPEED / math.sqrt(fps), _DEPTH_STEP),
            _share_that_moves(_TURN_SPEED / math.sqrt(fps), _TURN_STEP),
        )

    def init(self, batch_size: int) -> Float[Tensor, "B Z P"]:
        """Return what is believed before the first frame."""
        return self.prior.expand(batch_size, len(self.depth), -1)

    def predict(self, belief: Float[Tensor, "B Z P"]) -> Float[Tensor, "B Z P"]:
        """Return what is believed of the next frame: a random walk, and a little that starts anew."""
        along, round_ = self._spread
        moved = _diffused(belief, along)
        moved = moved + round_ * (moved.roll(1, 2) + moved.roll(-1, 2) - 2 * moved)
        return (1 - _LOST) * moved + _LOST * self.prior

    def evidence(self, torso: Torso, lengths: TorsoLengths) -> Float[Tensor, "B Z P"]:
        """Return the log-likelihood of the torso's joints for every depth and turn."""
        shape = (len(torso.rays), len(self.depth), len(self.turn))
        depth = self.depth[:, None].expand(shape)
        return _log_likelihood(torso, depth, self.turn.expand(shape), lengths)

    def best(self, log_belief: Float[Tensor, "B Z P"], count: int) -> Root:
        """Return the likeliest hypotheses."""
        values, index = log_belief.flatten(1).topk(count, 1)
        n_turns = len(self.turn)
        return Root(self.depth[index // n_turns], self.turn[index % n_turns], values, index)

    def belief(self, root: Root) -> Float[Tensor, "B Z P"]:
        """Return the hypotheses as a belief over the whole grid."""
        weight = torch.softmax(root.log_weight, 1)
        flat = weight.new_zeros(len(weight), len(self.depth) * len(self.turn))
        return flat.scatter(1, root.cell, weight).unflatten(1, (len(self.depth), len(self.turn)))


class _Middle(NamedTuple):
    """Where the middle of the shoulders is by one axis of the image, from each torso joint.

    Attributes:
        value: by each joint, [..., 4]. precision: of each, 0 where it is not known. mean: of all, [...].
    """

    value: Tensor
    precision: Tensor
    mean: Tensor


def _middles(torso: Torso, depth: Tensor, turn: Tensor, lengths: TorsoLengths) -> list[_Middle]:
    """Return the middle of the shoulders by x and y, given depth and turn [B, ...]."""
    lead = (slice(None),) + (None,) * (depth.ndim - 1)
    place, known = torso_places(turn, lengths), torso.known[lead].to(depth)
    rays, std = torso.rays[lead], torso.std[lead]
    away = depth[..., None] + place[..., 2]
    stiff = _stiffness(lengths, torso.raised)[lead]
    found = []
    for axis in (0, 1):
        value = rays[..., axis] * away - place[..., axis]
        precision = known / (stiff[..., axis] + (std * away).square())
        mean = (precision * value).sum(-1) / precision.sum(-1).clamp_min(1e-12)
        found.append(_Middle(value, precision, mean))
    return found


def _log_likelihood(
    torso: Torso, depth: Tensor, turn: Tensor, lengths: TorsoLengths
) -> Float[Tensor, "B *grid"]:
    """Return the log-likelihood of the torso's joints wherever its middle is."""
    count = torso.known.sum(-1).to(depth)[(...,) + (None,) * (depth.ndim - 1)]
    total = torch.zeros_like(depth)
    for value, precision, mean in _middles(torso, depth, turn, lengths):
        off = (precision * (value - mean[..., None]).square()).sum(-1)
        logs = torch.where(precision > 0, precision, 1.0).log().sum(-1)
        heavy = -0.5 * (_FREEDOM + 1) * torch.log1p(off / _FREEDOM)
        mass = torch.where(count > 0, precision.sum(-1), 1.0)
        total = total + heavy + 0.5 * (logs - mass.log())
    return total + 2 * (count - 1).clamp_min(0) * depth.log()


def _stiffness(lengths: TorsoLengths, raised: Float[Tensor, "B 2"]) -> Float[Tensor, "B 4 2"]:
    """Return the variance of each torso joint about its place, metres squared."""
    stiff = lengths.width.new_tensor(_STIFF).square().expand(len(lengths.width), 4, 2).clone()
    stiff[:, :2, 0] += (lengths.width_std / 2).square()[:, None]
    stiff[:, :2] += (raised * SHRUG).square()[..., None]
    stiff[:, 3, 1] += lengths.height_std.square()
    return stiff


def torso_places(
    turn: Float[Tensor, "B *grid"], lengths: TorsoLengths
) -> Float[Tensor, "B *grid 4 3"]:
    """Return both shoulders, neck and head relative to the middle of the shoulders, camera axes."""
    lead = (slice(None),) + (None,) * (turn.ndim - 1)
    width, height = (value[lead].expand_as(turn) for value in lengths[:2])
    left = shoulder_offsets(turn, width)
    neck = torch.zeros_like(left)
    neck[..., 1] = -_NECK_HEIGHT
    head = neck.clone()
    head[..., 1] = head[..., 1] - height
    return torch.stack([left, -left, neck, head], -2)


def middle_of_shoulders(
    torso: Torso, depth: Float[Tensor, "B M"], turn: Float[Tensor, "B M"], lengths: TorsoLengths
) -> Float[Tensor, "B M 3"]:
    """Return where the middle of the shoulders is, given depth and turn; on the axis if nothing is known."""
    u, v = _middles(torso, depth, turn, lengths)
    return torch.stack([u.mean, v.mean, depth], -1)


def _share_that_moves(std: float, step: float) -> float:
    """Return the share of each cell that goes to either neighbour, for a walk of this deviation."""
    return min(0.5 * (std / step) ** 2, 1 / 3)


def _diffused(belief: Float[Tensor, "B Z P"], share: float) -> Float[Tensor, "B Z P"]:
    """Return the belief after a share of each depth went to either neighbour; the ends keep theirs."""
    flow = share * belief.diff(dim=1)
    moved = belief.clone()
    moved[:, :-1] += flow
    moved[:, 1:] -= flow
    return moved
