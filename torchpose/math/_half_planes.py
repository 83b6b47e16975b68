"""Condition points of the image on lying outside of a region, which half-planes bound softly."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import log_ndtr, ndtr

_LOG_2PI = math.log(2 * math.pi)


class OutsideMoments(NamedTuple):
    """Moments of points after an observation that they are probably outside of a region.

    Attributes:
        log_mass: log E[L(y)], [...]. mean: [..., 2]. cov: [..., 2, 2].
    """

    log_mass: Tensor
    mean: Tensor
    cov: Tensor


def log_outside(
    distance: Float[Tensor, "*batch P"], log_inside: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Return log L(y) of points that are probably outside of a region.

    L(y) = 1 - (1 - rho) prod_i Phi(-d_i(y))

    Args:
        distance: d_i, how far beyond each border the point is, in deviations of that border.
        log_inside: log rho, the log of how likely the observation is in the region, relative to outside; at
            most 0.
    """
    # the logarithm of Phi takes ten times as long, and its exponential was needed
    return torch.log1p(torch.expm1(log_inside) * ndtr(-distance).prod(-1))


def outside_moments(
    mean: Float[Tensor, "*#batch 2"],
    cov: Float[Tensor, "*#batch 2 2"],
    planes: Float[Tensor, "*#batch P 3"],
    log_inside: Float[Tensor, "*#batch"],
) -> OutsideMoments:
    """Return mass and moments of N(y; mean, cov) L(y), with L of `log_outside` and d_i(y) = a_i y + b_i.

    The points beyond the first border, those beyond the second but not the first, and so on, and those in
    the region are merged. Each border cuts a Gaussian with the moments of what the ones before have left,
    so the result is exact for one border.

    Args:
        mean, cov: the Gaussians. planes: (a_i, b_i) of P borders. log_inside: log rho.

    Reference:
        C. Rasmussen & C. Williams, "Gaussian Processes for Machine Learning" (2006), section 3.9, for the
        moments of a Gaussian times Phi.
    """
    log_mass = torch.zeros_like(mean[..., 0])
    parts, left = [], OutsideMoments(log_mass, mean, cov)
    for plane in planes.unbind(-2):
        slope, distance = plane[..., :2], (plane[..., :2] * left.mean).sum(-1) + plane[..., 2]
        along = (left.cov @ slope[..., None])[..., 0]
        spread = (1 + (slope * along).sum(-1)).sqrt()
        parts.append(_cut(left, along, spread, distance / spread, 1.0))
        left = _cut(left, along, spread, -distance / spread, -1.0)
    parts.append(left._replace(log_mass=left.log_mass + log_inside))
    return _merged(parts)


def _cut(
    before: OutsideMoments, along: Tensor, spread: Tensor, z: Tensor, sign: float
) -> OutsideMoments:
    """Return the moments of a Gaussian times Phi(+-d).

    Args:
        before: the Gaussian. along: C a. spread: sqrt(1 + a C a). z: +-d of the mean over the spread.
        sign: 1 or -1.
    """
    log_mass = log_ndtr(z)
    ratio = torch.exp(-0.5 * (z.square() + _LOG_2PI) - log_mass)
    step = along / spread[..., None]
    shrink = (ratio * (z + ratio)).clamp(0.0, 1.0)[..., None, None]
    return OutsideMoments(
        before.log_mass + log_mass,
        before.mean + sign * ratio[..., None] * step,
        before.cov - shrink * step[..., :, None] * step[..., None, :],
    )


def _merged(parts: list[OutsideMoments]) -> OutsideMoments:
    """Return the moments of a mixture of these parts, whose masses need not sum to one."""
    logs, means, covs = (torch.stack(values) for values in zip(*parts, strict=True))
    log_mass = torch.logsumexp(logs, 0)
    share = (logs - log_mass).exp()[..., None]
    mean = (share * means).sum(0)
    apart = means - mean
    spread = covs + apart[..., :, None] * apart[..., None, :]
    return OutsideMoments(log_mass, mean, (share[..., None] * spread).sum(0))
