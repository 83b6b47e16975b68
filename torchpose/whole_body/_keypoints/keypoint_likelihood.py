"""Weigh keypoints by how likely they are: of their joint, of the joint on the other side, or of nothing.

A keypoint z of joint j in camera c is, with probability pi, the joint plus Gaussian noise, and else
anywhere in an area a:

    p(z | x) = pi N(z; h_c(p_j(x)), R) + (1 - pi) / a.

The noise has a part in pixels, and one that is relative to the body, whose size in the image goes with the
depth: R = s_c (r + m f^2 / depth^2) I, with a factor s_c of the camera that the filter estimates. In each
camera left and right of the arms, and of the legs, may be exchanged. Whether they are is a two-state chain
over time. All of it is marginalised: the filter gets expected information about joints. A camera cannot see
a joint behind it, so the keypoint of such a joint is an outlier, (1 - pi) / a.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body._skeleton import BodySkeleton, other_side
from torchpose.camera._rig import CameraRig

NOISE_SCALES = (0.3, 20.0)  # least and largest factor of a camera's noise
LEAST_DEPTH = 0.05  # metres in front of a camera; nearer points are not seen by it
LEAST_ODDS = 1e-6  # least probability whose log-odds are kept, and of the opposite
_LEAST = 1e-30  # probability
_LEGS = ("hip", "knee", "ankle")


class RigMaps(NamedTuple):
    """Holds the maps from world axes to the homogeneous pixels of C cameras, M p + m.

    Attributes:
        matrix: K R, [C, 3, 3]. shift: K t, [C, 3]. log_area: [C], of the area of outliers, pixels squared.
        centre: [C, 3], the places of the cameras, metres.
    """

    matrix: Tensor
    shift: Tensor
    log_area: Tensor
    centre: Tensor

    @classmethod
    def of(cls, rig: CameraRig) -> Self:
        """Return the maps of a rig; outliers lie in a quarter of the image, around the person."""
        shift = (rig.matrix @ rig.translation[..., None]).squeeze(-1)
        focal = rig.matrix[:, 0, 0] * rig.matrix[:, 1, 1]
        areas = [
            float(f) if size is None else size[0] * size[1]
            for f, size in zip(focal, rig.sizes, strict=True)
        ]
        log_area = torch.tensor(areas, dtype=shift.dtype).div(4).log().to(shift.device)
        matrix = rig.matrix @ rig.rotation
        return cls(matrix, shift, log_area, -torch.linalg.solve(matrix, shift))


class KeypointFrame(NamedTuple):
    """Holds the keypoints of one frame.

    Attributes:
        pixels: [B, C, J, 2], undistorted; anything finite where there is none.
        variance: [B, C, J], r in pixels squared. relative: [B, C, J], m in metres squared.
        inlier: [B, C, J], prior probability pi; 0 where there is no keypoint.
    """

    pixels: Tensor
    variance: Tensor
    relative: Tensor
    inlier: Tensor

    @property
    def there(self) -> Bool[Tensor, "... C J"]:
        """Return which keypoints there are."""
        return self.inlier > 0.0

    @property
    def shared(self) -> Bool[Tensor, "... C J"]:
        """Return which keypoints there are of joints that two cameras see, or more."""
        return self.there & (self.there.sum(-2, keepdim=True) >= 2)

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return the keypoints with a function applied to every tensor."""
        return type(self)(*(change(value) for value in self))

    def take(self, index: Int[Tensor, " N"]) -> Self:
        """Return the keypoints of some elements of the batch."""
        return self.map(lambda value: value[index])

    def some(self, chosen: Bool[Tensor, " N"], most: int) -> Self:
        """Return at most so many of the chosen elements of the batch, evenly spread."""
        rows = chosen.nonzero().squeeze(-1)
        return self.take(rows[:: max(1, -(-len(rows) // most))])

    def noise(self, by_joint: Float[Tensor, "... C J 2 3"]) -> Float[Tensor, "... C J"]:
        """Return the variance of the noise of every keypoint, r + m |A|^2 / 2, pixels squared.

        Args:
            by_joint: A, the derivative of pixels by the joint; |A|^2 / 2 is about f^2 / depth^2.
        """
        return self.variance + self.relative * (0.5 * (by_joint * by_joint).sum((-2, -1)))


class Seen(NamedTuple):
    """Holds pixels [B, C, J, 2] of joints, their derivative [B, C, J, 2, 3] and whether they are in front."""

    pixels: Tensor
    by_joint: Tensor
    in_front: Tensor


class Exchange(NamedTuple):
    """Describes groups of joints whose sides may be exchanged.

    Attributes:
        mirror: [J], the joint on the other side. groups: [2, J], 1 for joints of the arms, of the legs.
    """

    mirror: Tensor
    groups: Tensor


class Beliefs(NamedTuple):
    """Holds what is believed of cameras: log_odds [B, C, 2] of exchanged sides, and scale s_c [B, C]."""

    log_odds: Tensor
    scale: Tensor


class Weighed(NamedTuple):
    """Holds expected weights of the two readings of every keypoint.

    Attributes:
        own, other: [B, C, J], probability that the keypoint is of its joint and an inlier; that the keypoint
            of the other side is of this joint and an inlier.
        variance, other_variance: [B, C, J], of the noise of both.
        exchanged: [B, C, 2], probability that sides of arms and of legs are exchanged.
        log_joint: [B, C, J], log density of the keypoints that would be of the joint, 0 where there is none.
        log_evidence: [B].
    """

    own: Tensor
    other: Tensor
    variance: Tensor
    other_variance: Tensor
    exchanged: Tensor
    log_joint: Tensor
    log_evidence: Tensor

    @property
    def inlier(self) -> Float[Tensor, "B C J"]:
        """Return the probability that a keypoint of either side is of the joint."""
        return self.own + self.other


def exchange_of(skeleton: BodySkeleton, device: torch.device) -> Exchange:
    """Return the groups of joints whose sides may be exchanged: arms, legs."""
    names = skeleton.names
    mirror = torch.tensor([names.index(other_side(n)) for n in names])
    sided = mirror != torch.arange(len(names))
    legs = torch.tensor([n.endswith(_LEGS) for n in names])
    groups = torch.stack([sided & ~legs, sided & legs]).double()
    return Exchange(mirror.to(device), groups.to(device))


def readings_of(frame: KeypointFrame, exchange: Exchange) -> KeypointFrame:
    """Return both readings of keypoints, [2, B, ...]: as of their own joints, and as of the other side's."""
    mirror = exchange.mirror
    return frame.map(lambda value: torch.stack([value, value.index_select(2, mirror)]))


def with_sides_exchanged(
    frame: KeypointFrame, exchanged: Bool[Tensor, "B C 2"], exchange: Exchange
) -> KeypointFrame:
    """Return keypoints with left and right of some arms and legs exchanged.

    Args:
        frame: the keypoints. exchanged: of which cameras and groups of joints. exchange: the groups.
    """
    groups, mirror = exchange.groups, exchange.mirror
    chosen = exchanged.to(groups) @ groups > 0.0

    def sided(value: Tensor) -> Tensor:
        rows = chosen[..., None] if value.ndim > chosen.ndim else chosen
        return torch.where(rows, value.index_select(2, mirror), value)

    return frame.map(sided)


def see(maps: RigMaps, joints: Float[Tensor, "B J 3"]) -> Seen:
    """Return joints as cameras see them, u = (M p + m)_12 / (M p + m)_3, and how they move there.

    Args:
        maps: the cameras. joints: metres, world axes.
    """
    homogeneous = joints.unsqueeze(-3) @ maps.matrix.mT + maps.shift[:, None]
    depth = homogeneous[..., 2]
    in_front = depth > LEAST_DEPTH
    depth = torch.where(in_front, depth, 1.0)[..., None]
    pixels = homogeneous[..., :2] / depth
    return Seen(pixels, by_point(maps.matrix, pixels, depth), in_front)


def by_point(
    matrix: Float[Tensor, "C 3 3"],
    pixels: Float[Tensor, "*batch C J 2"],
    depth: Float[Tensor, "*batch C J 1"],
) -> Float[Tensor, "*batch C J 2 3"]:
    """Return the derivative of pixels by points p, whose homogeneous pixels are M p + m."""
    rows = matrix[:, None, :2] - pixels[..., None] * matrix[:, None, 2:]
    return rows / depth[..., None]


def weigh(
    readings: KeypointFrame,
    seen: Seen,
    maps: RigMaps,
    beliefs: Beliefs,
    exchange: Exchange,
    joint_cov: Float[Tensor, "B J 3 3"] | None = None,
    *,
    marginal: bool = False,
    decide: bool = True,
    width: float = 1.0,
) -> Weighed:
    """Return the weights of keypoints by joints and their covariance.

    Args:
        readings: [2, B, ...] of `readings_of`. seen: the joints as cameras see them. maps: the cameras.
        beliefs: about the cameras. exchange: the groups of joints whose sides may be exchanged.
        joint_cov: of the joints; None is none. marginal: whether densities are N(r; 0, A P A^T + R), of a
            prediction, and not exp E[log N(r; 0, R)], of an estimate that the same keypoints made.
        decide: whether keypoints tell about exchanged sides; else the prior alone does.
        width: factor of the noise's variance.
    """
    variance = (width * beliefs.scale)[..., None] * readings.noise(seen.by_joint)
    inlier, there = readings.inlier, readings.there
    present = there & seen.in_front
    off = readings.pixels - seen.pixels
    density = _log_density(off, seen.by_joint, joint_cov, variance, marginal)
    log_in = inlier.clamp_min(_LEAST).log() + density
    log_out = torch.log1p(-inlier) - maps.log_area[:, None]
    either = torch.where(seen.in_front, torch.logaddexp(log_in, log_out), log_out)
    own, other = torch.where(present, (log_in - either).exp(), 0.0).unbind()
    log_own, log_other = torch.where(there, either, 0.0).unbind()
    gain = (log_other - log_own) @ exchange.groups.mT
    log_odds = beliefs.log_odds
    exchanged = (log_odds + gain if decide else log_odds).sigmoid()
    swapped = exchanged @ exchange.groups
    logsigmoid = torch.nn.functional.logsigmoid
    mixed = torch.logaddexp(logsigmoid(-log_odds), logsigmoid(log_odds) + gain)
    return Weighed(
        own * (1.0 - swapped),
        other * swapped,
        variance[0],
        variance[1],
        exchanged,
        torch.lerp(log_own, log_other, swapped),
        log_own.sum((-2, -1)) + mixed.sum((-2, -1)),
    )


def _log_density(
    residual: Tensor, by_joint: Tensor, joint_cov: Tensor | None, variance: Tensor, marginal: bool
) -> Tensor:
    """Return log N(r; 0, A P A^T + R), or log N(r; 0, R) expected over A P A^T; R = variance I."""
    if joint_cov is None or not marginal:
        square = (residual * residual).sum(-1)
        if joint_cov is not None:
            square = square + _mean_square(by_joint, joint_cov)
        return -0.5 * square / variance - (2 * math.pi * variance).log()
    spread = by_joint @ joint_cov.unsqueeze(-4) @ by_joint.mT
    a, b, d = spread[..., 0, 0] + variance, spread[..., 0, 1], spread[..., 1, 1] + variance
    det = a * d - b * b
    x, y = residual.unbind(-1)
    square = (d * x * x - 2.0 * b * x * y + a * y * y) / det
    return -0.5 * square - 0.5 * det.log() - math.log(2 * math.pi)


def information(
    readings: KeypointFrame, seen: Seen, weighed: Weighed
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """Return the information W_j = sum w A^T R^-1 A about joints, and the pull b_j = sum w A^T R^-1 r."""
    own, other = weighed.own / weighed.variance, weighed.other / weighed.other_variance
    weighted = seen.by_joint * (own + other)[..., None, None]
    matrix = (weighted.mT @ seen.by_joint).sum(1)
    off = readings.pixels - seen.pixels
    force = own[..., None] * off[0] + other[..., None] * off[1]
    return matrix, (seen.by_joint.mT @ force[..., None]).squeeze(-1).sum(1)


def squared_errors(
    readings: KeypointFrame, seen: Seen, weighed: Weighed, joint_cov: Float[Tensor, "B J 3 3"]
) -> tuple[Float[Tensor, "B C"], Float[Tensor, "B C"]]:
    """Return sums over joints of expected squared errors over the noise's variance, and their count.

    Only keypoints read as of their own joint count, by their weights: E[|r|^2] = |r|^2 + tr A P A^T.
    """
    spread = _mean_square(seen.by_joint, joint_cov)
    off = readings.pixels[0] - seen.pixels
    square = (off * off).sum(-1) + spread
    return (weighed.own * square / weighed.variance).sum(-1), 2.0 * weighed.own.sum(-1)


def _mean_square(
    by_joint: Float[Tensor, "B C J 2 3"], joint_cov: Float[Tensor, "B J 3 3"]
) -> Float[Tensor, "B C J"]:
    """Return tr A P A^T, of pixels by the covariance of their joints."""
    return (by_joint @ joint_cov.unsqueeze(-4) * by_joint).sum((-2, -1))
