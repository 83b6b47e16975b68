"""Follow how far away a torso is, how large, and how far its shoulders are turned, on a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchpose.skeleton._joint_sets import UPPER_BODY

__all__ = [
    "NECK_HEIGHT",
    "Moments",
    "Root",
    "RootGrid",
    "Torso",
    "TorsoLengths",
    "half_widths",
    "heavy_tail",
    "inward_shares",
    "middle_of_shoulders",
    "see_torso",
    "shoulder_offsets",
    "spine_places",
    "torso_places",
    "with_axes",
]

_TORSO = tuple(UPPER_BODY.index(n) for n in ("shoulder_left", "shoulder_right", "neck", "head"))
NECK_HEIGHT = 0.105
"""Metres of Kinect's neck above the middle of the shoulders."""

# Metres, as the Kinect recordings have it, and of its log: others sit at webcams, or stand in halls.
_DEPTH, _DEPTH_STD = 2.6, 0.6
_NEAREST, _FARTHEST, _DEPTH_STEP = 0.4, 9.0, 0.04  # metres, and the step of log depth
_SIZES, _CELLS = 11, 2  # of torsos, and steps of log depth from one to the next
_TURN_STEP, _TURN_STD = 15.0, 20.0  # degrees
_BROAD_TURN = 0.2  # share of the turns that are all alike likely
_SPEED, _TURN_SPEED = 0.08, 60.0  # share of the depth, and degrees, after one second
_MOST_SAID = 0.1  # nats that are believed of depths at which nothing was weighed
_LOST = 1e-6  # share of a frame's belief that starts anew
# Standard deviation of each torso joint about its place in a stiff torso, metres: x and y.
_STIFF = ((0.03, 0.035), (0.03, 0.035), (0.03, 0.035), (0.05, 0.035))
# Shoulders of raised arms move in, by a share of half the width that differs from one to the next, and up.
# As in UTD-MHAD (s1 to s6): from 0.165 m to 0.140.
_INWARD, _INWARD_STD, _UPWARD_STD = 0.15, 0.2, 0.03
_HANGING, _RAISED = -0.7, 0.2  # sines of the elevation from which, and to which, they do
# Metres to the elbow and to the hand; the elevation does not have to be exact.
_REACH = (0.27, 0.48)
_NOT_RAISED = -1e3  # where no arm is seen

_ARMS = tuple(
    tuple(UPPER_BODY.index(f"{joint}_{side}") for joint in ("shoulder", "elbow", "hand"))
    for side in ("left", "right")
)
_FREEDOM = 4.0  # of the heavy tails of detectors' points


class TorsoLengths(NamedTuple):
    """Lengths of a torso, metres.

    Attributes:
        width: between the shoulders, [B]. height: of the head above the neck, [B].
        width_std, height_std: their deviations, [B].
        neck: height of the neck above the middle of the shoulders.
    """

    width: Tensor
    height: Tensor
    width_std: Tensor
    height_std: Tensor
    neck: float = NECK_HEIGHT


class Root(NamedTuple):
    """Hypotheses about the torso, [B, M] each.

    Attributes:
        depth: metres. turn: psi. size: of the torso, over what `TorsoLengths` say. log_weight: of each.
        cell: place in the flat grid of depths and turns.
    """

    depth: Tensor
    turn: Tensor
    size: Tensor
    log_weight: Tensor
    cell: Tensor


class Moments(NamedTuple):
    """What is believed about a torso, [B] each.

    Attributes:
        depth: metres. size: over what `TorsoLengths` say. of_depth, of_size: variances of their logs.
    """

    depth: Tensor
    size: Tensor
    of_depth: Tensor
    of_size: Tensor


class Torso(NamedTuple):
    """Measured torso joints, as rays.

    Attributes:
        rays: K^-1 [u, v, 1] of both shoulders, neck and head, [B, 4, 3]. known: [B, 4].
        std: of a pixel over the focal length, [B, 4].
        rise: sine of each arm's elevation above its shoulder over the depth, 1 / m, [B, 2].
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    rise: Tensor

    def raised(self, depth: Float[Tensor, "B *grid"]) -> Float[Tensor, "B *grid 2"]:
        """Return how far each arm is raised, from 0 (hanging) to 1."""
        rise = with_axes(self.rise, depth.ndim - 1)
        return ((rise * depth[..., None] - _HANGING) / (_RAISED - _HANGING)).clamp(0.0, 1.0)


def see_torso(
    rays: Float[Tensor, "B 8 3"], known: Bool[Tensor, "B 8"], std: Float[Tensor, "B 8"]
) -> Torso:
    """Return the torso's part of all joints of `UPPER_BODY`."""
    chosen = list(_TORSO)
    rise = torch.stack([_rise(rays, known, *arm) for arm in _ARMS], 1)
    return Torso(rays[:, chosen], known[:, chosen], std[:, chosen], rise)


def _rise(rays: Tensor, known: Tensor, shoulder: int, elbow: int, hand: int) -> Float[Tensor, " B"]:
    """Return by how much an elbow, or else a hand, is seen above its shoulder, over its reach."""
    end = torch.where(known[:, elbow], rays[:, elbow, 1], rays[:, hand, 1])
    reach = torch.where(known[:, elbow], end.new_tensor(_REACH[0]), end.new_tensor(_REACH[1]))
    there = known[:, shoulder] & (known[:, elbow] | known[:, hand])
    return torch.where(there, (rays[:, shoulder, 1] - end) / reach, _NOT_RAISED)


def half_widths(
    width: Float[Tensor, " B"], raised: Float[Tensor, "B *grid 2"]
) -> Float[Tensor, "B *grid 2"]:
    """Return how far left and right shoulder are from the middle, metres: less where an arm is raised."""
    return with_axes(width, raised.ndim - 1) / 2 * (1 - _INWARD * raised)


def inward_shares(torso: Torso, depth: Float[Tensor, " B"]) -> tuple[Tensor, Tensor]:
    """Return the share by which raised arms narrow the shoulders, and its standard deviation, [B]."""
    raised = torso.raised(depth)
    return _INWARD * raised.mean(-1), _INWARD_STD / 2 * torch.linalg.vector_norm(raised, dim=-1)


def shoulder_offsets(turn: Float[Tensor, "*batch"], half: Float[Tensor, "*batch 2"]) -> Tensor:
    """Return left and right shoulder relative to the middle of both, camera axes, [..., 2, 3].

        h_left (cos psi, 0, -sin psi),   -h_right (cos psi, 0, -sin psi)

    Args:
        turn: psi. half: h of both, metres.
    """
    level = torch.stack([turn.cos(), torch.zeros_like(turn), -turn.sin()], -1)
    signed = half * half.new_tensor([1.0, -1.0])
    return signed[..., None] * level[..., None, :]


class RootGrid:
    """Point-mass filter over log depth z, the turn of the shoulders psi and the size s of the torso.

    The middle of the shoulders may be anywhere in the image. Given depth and turn, every measured
    joint of the torso says where it is, up to how stiff torsos are; what they disagree about is the
    evidence, with heavy tails (Student, 4 degrees of freedom). A torso that is s times as large looks like
    one at z / s, and stays as large: so a usual size at every frame is no evidence for it, and what arms
    say about the depth adds up.

    Args:
        fps: frames per second. like: tells dtype and device.
    """

    def __init__(self, fps: float, like: Tensor) -> None:
        n_depths = 1 + math.ceil(math.log(_FARTHEST / _NEAREST) / _DEPTH_STEP)
        beyond = _CELLS * (_SIZES // 2)
        steps = torch.arange(-beyond, n_depths + beyond, dtype=like.dtype, device=like.device)
        self._relative = _NEAREST * (_DEPTH_STEP * steps).exp()
        self.depth = self._relative[beyond:-beyond]
        self.log_size = _CELLS * _DEPTH_STEP * (steps[:_SIZES] - steps[_SIZES // 2])
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

    def init(self, batch_size: int, spread: Float[Tensor, ""]) -> Float[Tensor, "B S Z P"]:
        """Return what is believed before the first frame.

        Args:
            batch_size: B. spread: standard deviation of the log of the size.
        """
        sizes = torch.softmax(-0.5 * (self.log_size / spread.clamp_min(1e-3)).square(), 0)
        belief = sizes[:, None, None] * self.prior
        return belief.expand(batch_size, *belief.shape)

    def predict(self, belief: Float[Tensor, "B S Z P"]) -> Float[Tensor, "B S Z P"]:
        """Return what is believed of the next frame: a random walk, and a little that starts anew."""
        along, round_ = self._spread
        moved = _diffused(belief, along)
        moved = moved + round_ * (moved.roll(1, -1) + moved.roll(-1, -1) - 2 * moved)
        anew = belief.sum((-2, -1), keepdim=True) * self.prior
        return (1 - _LOST) * moved + _LOST * anew

    def evidence(self, torso: Torso, lengths: TorsoLengths) -> Float[Tensor, "B S Z P"]:
        """Return the log-likelihood of the torso's joints for every size, depth and turn."""
        shape = (len(torso.rays), len(self._relative), len(self.turn))
        relative = self._relative[:, None].expand(shape)
        found = _log_likelihood(torso, relative, self.turn.expand(shape), lengths)
        return found.unfold(1, len(self.depth), _CELLS).flip(1).mT

    def best(self, log_belief: Float[Tensor, "B S Z P"], count: int) -> Root:
        """Return the likeliest depths and turns, half of them turned to either side.

        A turn and its mirror image look alike, so that the wrong one may be the likelier for a while.
        """
        n_turns, half = len(self.turn), len(self.turn) // 2
        whole = torch.logsumexp(log_belief, 1)
        sides = []
        for first in (0, half):
            index = whole[:, :, first : first + half].flatten(1).topk(count // 2, 1).indices
            sides.append(index // half * n_turns + index % half + first)
        index = torch.cat(sides, 1)
        values = whole.flatten(1).gather(1, index)
        of_sizes = index[:, None].expand(-1, len(self.log_size), -1)
        share = torch.softmax(log_belief.flatten(2).gather(2, of_sizes), 1)
        size = (share.mT @ self.log_size).exp()
        return Root(self.depth[index // n_turns], self.turn[index % n_turns], size, values, index)

    def belief(
        self,
        log_belief: Float[Tensor, "B S Z P"],
        root: Root,
        said: Float[Tensor, "B M"],
        trend: Bool[Tensor, " B"],
    ) -> Float[Tensor, "B S Z P"]:
        """Return the belief over the grid after hypotheses were weighed.

        Of the others is believed that they would have been as likely as these on average, or, with a trend,
        the more or less likely the farther they are, as these are: hypotheses lie close together.

        Args:
            log_belief: before. root: hypotheses, before. said: log-evidence about them. trend: whether
                there is one.
        """
        share = torch.log_softmax(root.log_weight, 1)
        usual = torch.logsumexp(share + said, 1, keepdim=True)
        more = trend[:, None].to(said) * self._trend(root, share.exp(), said)
        more = more[..., None].expand(-1, -1, len(self.turn))
        more = more.flatten(1).scatter(1, root.cell, said - usual)
        weighed = (log_belief.flatten(2) + more[:, None]).flatten(1)
        return torch.softmax(weighed, 1).view_as(log_belief)

    def _trend(
        self, root: Root, share: Float[Tensor, "B M"], said: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B Z"]:
        """Return what evidence gains with the depth, nats relative to that of the hypotheses' mean."""
        logs = root.depth.log()
        mean = (share * logs).sum(1, keepdim=True)
        off = share * (logs - mean)
        slope = (off * said).sum(1) / ((off * (logs - mean)).sum(1) + _DEPTH_STEP**2)
        along = slope[:, None] * (self.depth.log() - mean)
        return along.clamp(-_MOST_SAID, _MOST_SAID)

    def moments(self, belief: Float[Tensor, "B S Z P"]) -> Moments:
        """Return what is believed about depth and size."""
        depth, of_depth = _mean_and_variance(belief.sum((1, 3)), self.depth.log())
        size, of_size = _mean_and_variance(belief.sum((2, 3)), self.log_size)
        return Moments(depth.exp(), size.exp(), of_depth, of_size)


def _mean_and_variance(
    share: Float[Tensor, "B N"], values: Float[Tensor, " N"]
) -> tuple[Tensor, Tensor]:
    """Return both moments of values, [B] each."""
    mean = share @ values
    return mean, (share @ values.square() - mean.square()).clamp_min(0.0)


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
    rays, known, std = (with_axes(x, depth.ndim - 1) for x in torso[:3])
    raised = torso.raised(depth)
    place = torso_places(turn, half_widths(lengths.width, raised), lengths)
    away = depth[..., None] + place[..., 2]
    stiff = _stiffness(lengths, raised)
    found = []
    for axis in (0, 1):
        value = rays[..., axis] * away - place[..., axis]
        precision = known.to(depth) / (stiff[..., axis] + (std * away).square())
        mean = (precision * value).sum(-1) / precision.sum(-1).clamp_min(1e-12)
        found.append(_Middle(value, precision, mean))
    return found


def _log_likelihood(
    torso: Torso, depth: Tensor, turn: Tensor, lengths: TorsoLengths
) -> Float[Tensor, "B *grid"]:
    """Return the log-likelihood of the torso's joints wherever its middle is."""
    count = with_axes(torso.known.sum(-1).to(depth), depth.ndim - 1)
    total = torch.zeros_like(depth)
    for value, precision, mean in _middles(torso, depth, turn, lengths):
        off = (precision * (value - mean[..., None]).square()).sum(-1)
        logs = torch.where(precision > 0, precision, 1.0).log().sum(-1)
        mass = torch.where(count > 0, precision.sum(-1), 1.0)
        total = total + heavy_tail(off) + 0.5 * (logs - mass.log())
    return total + 2 * (count - 1).clamp_min(0) * depth.log()


def _stiffness(
    lengths: TorsoLengths, raised: Float[Tensor, "B *grid 2"]
) -> Float[Tensor, "B *grid 4 2"]:
    """Return the variance of each torso joint about its place in x and y, metres squared."""
    stiff = raised.new_tensor(_STIFF).square().expand(*raised.shape[:-1], 4, 2).clone()
    sizes = (lengths.width, lengths.width_std, lengths.height_std)
    width, width_std, height_std = (with_axes(x, raised.ndim - 2) for x in sizes)
    stiff[..., :2, 0] += (width_std / 2).square()[..., None]
    stiff[..., :2, 0] += (raised * _INWARD_STD * width[..., None] / 2).square()
    stiff[..., :2, 1] += (raised * _UPWARD_STD).square()
    stiff[..., 3, 1] += height_std.square()
    return stiff


def torso_places(
    turn: Float[Tensor, "B *grid"], half: Float[Tensor, "B *grid 2"], lengths: TorsoLengths
) -> Float[Tensor, "B *grid 4 3"]:
    """Return both shoulders, neck and head relative to the middle of the shoulders, camera axes.

    Args:
        turn: psi. half: of the shoulders (`half_widths`). lengths: of the torso.
    """
    shoulders = shoulder_offsets(turn, half)
    spine = with_axes(spine_places(lengths), turn.ndim - 1).expand_as(shoulders)
    return torch.cat([shoulders, spine], -2)


def spine_places(lengths: TorsoLengths) -> Float[Tensor, "B 2 3"]:
    """Return neck and head relative to the middle of the shoulders, camera axes: upright above it."""
    neck = torch.full_like(lengths.height, -lengths.neck)
    up = torch.stack([neck, neck - lengths.height], 1)
    level = torch.zeros_like(up)
    return torch.stack([level, up, level], -1)


def with_axes(values: Shaped[Tensor, "B *rest"], count: int) -> Tensor:
    """Return values with so many axes of one element after that of the batch."""
    return values[(slice(None),) + (None,) * count]


def heavy_tail(squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the log-density of a Student distribution, up to a constant, by the squared distance."""
    return -0.5 * (_FREEDOM + 1) * torch.log1p(squared / _FREEDOM)


def middle_of_shoulders(torso: Torso, root: Root, lengths: TorsoLengths) -> Float[Tensor, "B M 3"]:
    """Return where the middle of the shoulders is, given depth, turn and size; on the axis if unknown."""
    depth = root.depth / root.size  # what is larger is as if nearer
    u, v = _middles(torso, depth, root.turn, lengths)
    return torch.stack([u.mean, v.mean, depth], -1) * root.size[..., None]


def _share_that_moves(std: float, step: float) -> float:
    """Return the share of each cell that goes to either neighbour, for a walk of this deviation."""
    return min(0.5 * (std / step) ** 2, 1 / 3)


def _diffused(belief: Float[Tensor, "B S Z P"], share: float) -> Float[Tensor, "B S Z P"]:
    """Return the belief after a share of each depth went to either neighbour; the ends keep theirs."""
    flow = share * belief.diff(dim=-2)
    moved = belief.clone()
    moved[..., :-1, :] += flow
    moved[..., 1:, :] -= flow
    return moved
