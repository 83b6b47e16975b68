"""Estimate how large a person is whom one camera sees, and say what the camera does not tell of it.

A body that is larger and farther away by the same factor looks the same. So the filter of one camera keeps
the size that is expected, and the log l of the factor to the real size has a belief of its own: N(0, s^2)
with the deviation s over persons, however many frames there are. Where the camera is known to be h above the
floor, with the upward direction u and the place c of the camera, the lowest ankle p of a frame tells

    h - a = e^l u^T (c - p) + b + e,

with the usual height a of an ankle, and b, N(0, s_b^2), by which this person, the floor and the given height
differ from that all the time. Errors e of frames that follow each other are about the same, so a frame counts
for its share of a second. A foot may be lifted, and then tells nothing.
"""

import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.math._gaussian import symmetrise

# Chosen on the fitted persons of `benchmarks.keypoint_bodies`.
_ANKLE = 0.09  # metres above the floor
_LASTING = 0.03  # metres, standard deviation of b
_STD, _SHARE = 0.03, 0.03  # metres, and of the distance below the camera: standard deviation of e
_TIME = 1.0  # seconds for which e is about the same
_LIFTED, _HIGHEST = 0.1, 0.6  # share of frames in which both feet are lifted; metres, up to where
_NEVER = 1e-3  # per metre, density of a foot anywhere else, below the floor too


class SizeBelief(NamedTuple):
    """Holds Gaussians over the log of a person's size against that of the filter, and of b.

    Attributes:
        mean: [..., 2]. cov: [..., 2, 2].
    """

    mean: Tensor
    cov: Tensor

    @property
    def log(self) -> Float[Tensor, "*batch"]:
        """Return the log of the size."""
        return self.mean[..., 0]

    @property
    def variance(self) -> Float[Tensor, "*batch"]:
        """Return the variance of the log of the size."""
        return self.cov[..., 0, 0]

    @classmethod
    def usual(cls, std: float, like: Float[Tensor, " B"]) -> Self:
        """Return what is expected of B persons."""
        cov = like.new_tensor([std**2, _LASTING**2]).diag()
        return cls(like.new_zeros(len(like), 2), cov.expand(len(like), 2, 2))


class Floor(NamedTuple):
    """Holds the upward direction [3], the place of the camera [3] and metres from the floor up to it."""

    up: Tensor
    centre: Tensor
    height: float

    def lower_ankle(
        self, ankles: Float[Tensor, "*batch 2 3"]
    ) -> tuple[Float[Tensor, "*batch"], Int[Tensor, "*batch"]]:
        """Return how far below the camera the lower ankle is, metres, and which it is."""
        below, lower = ((self.centre - ankles) @ self.up).max(-1)
        return below, lower

    def above(self, ankles: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch"]:
        """Return by how much the lower ankle is above where one is that stands on the floor, metres."""
        return self.height - _ANKLE - self.lower_ankle(ankles)[0]


def told_by_floor(
    size: SizeBelief,
    floor: Floor,
    ankles: Float[Tensor, "B 2 3"],
    trust: Float[Tensor, "B 2"],
    fps: float,
) -> SizeBelief:
    """Return what is believed of sizes after a frame.

    Args:
        size: before it. floor: of the room. ankles: of bodies of the filter's size, metres.
        trust: probability that an ankle was seen. fps: frames per second.
    """
    below, lower = floor.lower_ankle(ankles)
    seen = trust.gather(-1, lower[:, None]).squeeze(-1)
    grown = below * size.log.exp()
    H = torch.stack([grown, torch.ones_like(grown)], -1)
    off = floor.height - _ANKLE - grown - size.mean[..., 1]
    HP = (size.cov @ H[..., None]).squeeze(-1)
    noise = _STD**2 + (_SHARE * grown).square()
    told = (H * HP).sum(-1)
    weight = seen * _on_the_floor(off, told + noise) / max(1.0, _TIME * fps)
    gain = HP * (weight / (noise + weight * told))[..., None]
    cov = size.cov - gain[..., None] * HP[..., None, :]
    return SizeBelief(size.mean + gain * off[..., None], symmetrise(cov))


def _on_the_floor(off: Float[Tensor, " B"], variance: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the probability that the lower foot stands, by how far its ankle is above one that does."""
    standing = (1 - _LIFTED) * torch.exp(-0.5 * off.square() / variance)
    standing = standing / (2 * math.pi * variance).sqrt()
    lifted = torch.full_like(off, _NEVER).masked_fill((off > 0) & (off < _HIGHEST), 1 / _HIGHEST)
    return standing / (standing + _LIFTED * lifted)


def resized(
    point: BodyPoint, log_size: Float[Tensor, "*batch"], centre: Float[Tensor, "3"]
) -> BodyPoint:
    """Return bodies that are larger by a factor, and as much farther from a place."""
    factor = log_size.exp()[..., None]
    root, turns = point.velocity.split([3, point.velocity.shape[-1] - 3], -1)
    return point._replace(
        position=centre + factor * (point.position - centre),
        velocity=torch.cat([factor * root, turns], -1),
        scales=point.scales + log_size[..., None],
        shifts=factor[..., None] * point.shifts,
    )


def tangent_of_size(
    articulation: Articulation, point: BodyPoint, centre: Float[Tensor, "3"]
) -> Float[Tensor, "*batch N"]:
    """Return the derivative of `resized` by the log of the size, in the tangent space of its point."""
    at = articulation.columns
    along = point.velocity.new_zeros(*point.velocity.shape[:-1], articulation.dim)
    along[..., at["position"]] = point.position - centre
    along[..., at["velocity"]][..., :3] = point.velocity[..., :3]
    along[..., at["scales"]] = 1
    along[..., at["shifts"]] = point.shifts.flatten(-2)
    return along


def units_of_size(
    articulation: Articulation, log_size: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch N"]:
    """Return the factors by which `resized` stretches small steps in the tangent space."""
    at = articulation.columns
    lengths = torch.zeros(articulation.dim, dtype=torch.bool, device=log_size.device)
    lengths[at["position"]] = lengths[at["shifts"]] = True
    lengths[at["velocity"]][:3] = True
    return torch.where(lengths, log_size.exp()[..., None], 1.0)


def outer(vectors: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
    """Return the products of the entries of vectors."""
    return vectors[..., None] * vectors[..., None, :]
