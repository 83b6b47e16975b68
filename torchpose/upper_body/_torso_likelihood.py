"""Tell how likely the joints of a torso are seen so, given its depth, size and turn."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchpose._core.module_state import outside_inference

NECK_HEIGHT = 0.105
"""Metres of Kinect's neck above the middle of the shoulders."""

STIFF_SHOULDER = 0.03
"""Standard deviation of a shoulder about its place in a stiff torso, metres."""
# Of both shoulders, neck and head, x and y.
_STIFF = ((STIFF_SHOULDER, 0.035), (STIFF_SHOULDER, 0.035), (0.03, 0.035), (0.05, 0.035))
# Shoulders of raised arms move in, by a share of half the width that differs from one to the next, and up.
# As in UTD-MHAD (s1 to s6): from 0.165 m to 0.140.
_INWARD, _INWARD_STD, _UPWARD_STD = 0.15, 0.2, 0.03
_HANGING, _RAISED = -0.7, 0.2  # sines of the elevation from which, and to which, they do
REACH = (0.27, 0.48)
"""Metres from a shoulder to the elbow and to the hand; the elevation does not have to be exact."""

NOT_RAISED = -1e3
"""The rise of an arm that is not seen."""

_FREEDOM = 4.0  # of the heavy tails of detectors' points


class TorsoLengths(NamedTuple):
    """Lengths of a torso, metres.

    Attributes:
        width: the distance between the shoulders, [B].
        spine: neck and head relative to the middle of the shoulders, camera axes, upright above it,
            [B, 2, 3].
        stiffness: the variance of shoulders, neck and head about their places in x and y, metres squared,
            arms hanging, [B, 4, 2].
    """

    width: Tensor
    spine: Tensor
    stiffness: Tensor

    @classmethod
    def of(
        cls,
        width: Float[Tensor, " B"],
        height: Float[Tensor, " B"],
        width_std: Float[Tensor, " B"],
        height_std: Float[Tensor, " B"],
        neck: float = NECK_HEIGHT,
    ) -> Self:
        """Return the lengths of a torso.

        Args:
            width: the distance between the shoulders. height: the height of the head above the neck.
            width_std, height_std: their standard deviations.
            neck: the height of the neck above the middle of the shoulders.
        """
        up = torch.stack([torch.full_like(height, -neck), -neck - height], 1)
        level, zero = torch.zeros_like(up), torch.zeros_like(height)
        across = width_std / 2.0
        spread = torch.stack([across, zero, across, zero, zero, zero, zero, height_std], -1)
        stiffness = spread.square().unflatten(-1, (4, 2)) + _stiff(height.dtype, height.device)
        return cls(width, torch.stack([level, up, level], -1), stiffness)


class Root(NamedTuple):
    """Hypotheses about the torso, [B, M] each.

    Attributes:
        depth: of the middle of the shoulders, metres. turn: psi, radians. size: of the torso, as a factor
            on `TorsoLengths`. log_weight: the log-weight of each hypothesis.
        cell: its index in the flat grid of depths and turns.
        axes: the rotations from camera to upright axes that turn with the shoulders, [B, M, 3, 3].
    """

    depth: Tensor
    turn: Tensor
    size: Tensor
    log_weight: Tensor
    cell: Tensor
    axes: Tensor


class Torso(NamedTuple):
    """Measured torso joints, as rays.

    Attributes:
        rays: K^-1 [u, v, 1] of both shoulders, neck and head, [B, 4, 3].
        known: whether each is measured, [B, 4].
        std: the standard deviation of a pixel over the focal length, [B, 4].
        rise: the sine of each arm's elevation above its shoulder over the depth, 1 / m, [B, 2].
        sided: whether any shoulder may be measured.
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    rise: Tensor
    sided: bool = True

    def raised(self, depth: Float[Tensor, "B *grid"]) -> Float[Tensor, "B *grid 2"]:
        """Return the elevation of each arm on a scale from 0 (hanging) to 1 (raised)."""
        rise = with_axes(self.rise, depth.ndim - 1)
        return ((rise * depth[..., None] - _HANGING) / (_RAISED - _HANGING)).clamp(0.0, 1.0)


def half_widths(
    width: Float[Tensor, " B"], raised: Float[Tensor, "B *grid 2"]
) -> Float[Tensor, "B *grid 2"]:
    """Return the distances of both shoulders from their middle, metres: less where an arm is raised."""
    return with_axes(width, raised.ndim - 1) / 2.0 * (1.0 - _INWARD * raised)


def inward_shares(torso: Torso, depth: Float[Tensor, " B"]) -> tuple[Tensor, Tensor]:
    """Return the share by which raised arms narrow the shoulders, and its standard deviation, [B]."""
    raised = torso.raised(depth)
    return _INWARD * raised.mean(-1), _INWARD_STD / 2 * torch.linalg.vector_norm(raised, dim=-1)


def shoulder_offsets(turn: Float[Tensor, "*batch"], half: Float[Tensor, "*batch 2"]) -> Tensor:
    """Return left and right shoulder relative to the middle of both, camera axes, [..., 2, 3].

        h_left (cos psi, 0, -sin psi),   -h_right (cos psi, 0, -sin psi)

    Args:
        turn: psi, radians. half: h of both shoulders, metres (`half_widths`).
    """
    cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
    level = torch.stack([cos, zero, -sin, -cos, zero, sin], -1).unflatten(-1, (2, 3))
    return half[..., None] * level


def torso_places(
    turn: Float[Tensor, "B *grid"], half: Float[Tensor, "B *grid 2"], lengths: TorsoLengths
) -> Float[Tensor, "B *grid 4 3"]:
    """Return both shoulders, neck and head relative to the middle of the shoulders, camera axes.

    Args:
        turn: psi, radians. half: the distances of the shoulders from their middle (`half_widths`).
        lengths: the lengths of the torso.
    """
    shoulders = shoulder_offsets(turn, half)
    spine = with_axes(lengths.spine, turn.ndim - 1).expand_as(shoulders)
    return torch.cat([shoulders, spine], -2)


def middle_of_shoulders(torso: Torso, root: Root, lengths: TorsoLengths) -> Float[Tensor, "B M 3"]:
    """Return the middle of the shoulders given depth, turn and size; on the optical axis if unknown."""
    depth = root.depth / root.size  # what is larger is as if nearer
    mean = _middles(torso, depth, root.turn, lengths).mean
    return torch.cat([mean, depth[..., None]], -1) * root.size[..., None]


def torso_log_likelihood(
    torso: Torso, depth: Tensor, turn: Tensor, lengths: TorsoLengths
) -> Float[Tensor, "B *grid"]:
    """Return the log-likelihood of the torso's joints, whose middle may be anywhere in the image."""
    count = with_axes(torso.known.sum(-1).to(depth), depth.ndim - 1)
    value, precision, mean = _middles(torso, depth, turn, lengths)
    off = (precision * (value - mean[..., None, :]).square()).sum(-2)
    logs = torch.where(precision > 0.0, precision, 1.0).log().sum(-2)
    mass = torch.where(count[..., None] > 0.0, precision.sum(-2), 1.0)
    both = heavy_tail(off) + 0.5 * (logs - mass.log())
    return both.sum(-1) + 2.0 * (count - 1.0).clamp_min(0) * depth.log()


class _Middle(NamedTuple):
    """Estimates of x and y of the middle of the shoulders, one by each torso joint.

    Attributes:
        value: the estimate by each of J joints, metres, [..., J, 2].
        precision: of each, 0 where it is not measured, [..., J, 2].
        mean: the mean of all, weighted by their precisions, [..., 2].
    """

    value: Tensor
    precision: Tensor
    mean: Tensor


def _middles(torso: Torso, depth: Tensor, turn: Tensor, lengths: TorsoLengths) -> _Middle:
    """Return x and y of the middle of the shoulders, given depth and turn [B, ...].

    Without shoulders it is told by neck and head alone, for which the turn does not matter.
    """
    rays, known, std = (with_axes(x, depth.ndim - 1) for x in torso[:3])
    stiff = with_axes(lengths.stiffness, depth.ndim - 1)
    if torso.sided:
        raised = torso.raised(depth)
        place = torso_places(turn, half_widths(lengths.width, raised), lengths)
        away = depth[..., None] + place[..., 2]
        stiff = torch.cat(
            [
                stiff[..., :2, :] + _loose(lengths, raised),
                stiff[..., 2:, :].expand(*raised.shape, 2),
            ],
            -2,
        )
    else:
        rays, known, std, stiff = rays[..., 2:, :], known[..., 2:], std[..., 2:], stiff[..., 2:, :]
        place, away = with_axes(lengths.spine, depth.ndim - 1), depth[..., None]
    value = rays[..., :2] * away[..., None] - place[..., :2]
    precision = known[..., None].to(depth) / (stiff + (std * away).square()[..., None])
    mean = (precision * value).sum(-2) / precision.sum(-2).clamp_min(1e-12)
    return _Middle(value, precision, mean)


@cache
def _stiff(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "4 2"]:
    with outside_inference():
        return torch.tensor(_STIFF, dtype=dtype, device=device).square()


def _loose(
    lengths: TorsoLengths, raised: Float[Tensor, "B *grid 2"]
) -> Float[Tensor, "B *grid 2 2"]:
    """Return the variance in x and y that shoulders have for raised arms, metres squared."""
    across = lengths.width * (_INWARD_STD / 2)
    moved = torch.stack([across, torch.full_like(across, _UPWARD_STD)], -1)
    return (raised[..., None] * with_axes(moved, raised.ndim - 1)).square()


def with_axes(values: Shaped[Tensor, "B *rest"], count: int) -> Tensor:
    """Return values with `count` axes of one element inserted after that of the batch."""
    return values.view(values.shape[0], *[1] * count, *values.shape[1:])


def heavy_tail(squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the log-density of a Student distribution, up to a constant, by the squared distance."""
    return -0.5 * (_FREEDOM + 1) * torch.log1p(squared / _FREEDOM)
