"""Estimate points of a mixture by the least expected distance, instead of squared distance."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

_STEPS = 5
_LEAST = 1e-18  # of a squared distance, where a mean has no spread and is hit


def geometric_median(
    weights: Float[Tensor, "N M"],
    means: Float[Tensor, "N M P 3"],
    spread: Float[Tensor, "*batch M P"],
    start: Float[Tensor, "N P 3"],
) -> Float[Tensor, "N P 3"]:
    """Return the points x of least sum_j w_j sqrt(|x - m_j|^2 + tr C_j), by Weiszfeld's iteration.

    The root is the expected distance from x to N(m_j, C_j), from above (Jensen). Where the mixture
    has two answers, an arm before or behind, this is near the likelier one and not between them.
    Five steps are made, and gradients are theirs.

    Args:
        weights: w. means: m. spread: tr C, with or without a batch. start: x to begin with.

    Reference:
        E. Weiszfeld, "Sur le point pour lequel la somme des distances de n points donnés est
        minimum" (1937).
    """
    offsets = (means - start[:, None]).transpose(1, 2).contiguous()  # cancels less, and in order
    constant = (offsets.square().sum(-1) + spread.mT).flatten(0, 1)[..., None]
    shares = weights[:, None].expand(offsets.shape[:3]).flatten(0, 1)[..., None]
    offsets = offsets.flatten(0, 1)  # products of batches of one dimension need no broadcasting
    along, x = offsets.mT, offsets.new_zeros(len(offsets), 3, 1)
    for _ in range(_STEPS):
        squared = torch.baddbmm(constant, offsets, x, alpha=-2) + torch.bmm(x.mT, x)
        pull = shares * squared.clamp_min(_LEAST).rsqrt()
        x = torch.bmm(along, pull) / pull.sum(1, keepdim=True)
    return start + x.reshape(start.shape)


def median_columns(points: Int[Tensor, " P"]) -> Int[Tensor, " 3*P"]:
    """Return the three dimensions of each point, given the first of them."""
    return (points[:, None] + torch.arange(3, device=points.device)).flatten()


def median_estimate(
    log_weights: Float[Tensor, "N M"],
    means: Float[Tensor, "N M D"],
    covs: Float[Tensor, "*batch M D D"],
    mean: Float[Tensor, "N D"],
    total: Float[Tensor, "N D D"] | None,
    points: Int[Tensor, " P"],
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N D D"] | None]:
    """Return an estimate whose points are geometric medians, and its second moment about them.

    Args:
        log_weights, means, covs: of the mixture. mean, total: its mean and covariance.
        points: first of the three dimensions of each point.
    """
    columns = median_columns(points)
    spread = covs.diagonal(dim1=-2, dim2=-1)[..., columns].unflatten(-1, (-1, 3)).sum(-1)
    found = geometric_median(
        log_weights.exp(),
        means[..., columns].unflatten(-1, (-1, 3)),
        spread.to(means.dtype),
        mean[:, columns].unflatten(-1, (-1, 3)),
    ).flatten(-2)
    off = torch.zeros_like(mean).index_copy(-1, columns, mean[:, columns] - found)
    if total is not None:
        total = total + off[:, :, None] * off[:, None]
    return mean - off, total
