"""Estimate points of a mixture by the least expected distance, instead of squared distance."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.value_checks import values_visible

_STEPS = 5
_LEAST = 1e-18  # of a spread, where a mean that has none is hit


def geometric_median(
    weights: Float[Tensor, "*batch M"],
    means: Float[Tensor, "*batch M P 3"],
    spread: Float[Tensor, "*#batch M P"],
    start: Float[Tensor, "*batch P 3"],
) -> Float[Tensor, "*batch P 3"]:
    """Return the points x of least sum_j w_j sqrt(|x - m_j|^2 + tr C_j), by Weiszfeld's iteration.

    The root is the expected distance from x to N(m_j, C_j), from above (Jensen). Where the mixture
    has two answers, an arm before or behind, this is near the likelier one and not between them.
    Five steps are made, and gradients are theirs.

    Args:
        weights: w. means: m. spread: tr C. start: x to begin with.

    Reference:
        E. Weiszfeld, "Sur le point pour lequel la somme des distances de n points donnés est
        minimum" (1937).
    """
    # sqrt(|x - m|^2 + tr C) is the distance in one dimension more
    offsets = (means - start[..., None, :, :]).transpose(-3, -2)  # cancels less
    away = spread.mT.clamp_min(_LEAST).sqrt().expand(offsets.shape[:-1])[..., None]
    points = torch.cat([offsets, away], -1).flatten(0, -3)
    flat = pad(offsets, (0, 1)).flatten(0, -3)
    shares = weights[..., None, :].expand(offsets.shape[:-1]).flatten(0, -2)[:, None]
    x = torch.zeros_like(flat[:, :1])
    for _ in range(_STEPS):
        pull = shares / _distances(x, points)
        x = torch.bmm(pull, flat) / pull.sum(-1, keepdim=True)
    return start + x[..., :3].view(start.shape)


def _distances(x: Float[Tensor, "N 1 4"], points: Float[Tensor, "N M 4"]) -> Float[Tensor, "N 1 M"]:
    """Return the distances of points from x."""
    learning = torch.is_grad_enabled() and (x.requires_grad or points.requires_grad)
    if learning or not values_visible():
        # the backward pass of cdist is wrong where torch.func.jacrev batches it, and has no derivative
        return torch.linalg.vector_norm(points - x, dim=-1)[:, None]
    return torch.cdist(x, points, compute_mode="donot_use_mm_for_euclid_dist")


def median_columns(points: Int[Tensor, " P"]) -> Int[Tensor, "P 3"]:
    """Return the three dimensions of each point, given the first of them."""
    return points[:, None] + torch.arange(3, device=points.device)


def with_medians(
    mean: Float[Tensor, "*batch D"],
    weights: Float[Tensor, "*batch M"],
    means: Float[Tensor, "*batch M P 3"],
    variances: Float[Tensor, "*#batch M P 3"],
    columns: Int[Tensor, "P 3"],
) -> Float[Tensor, "*batch D"]:
    """Return the mean of a mixture with geometric medians in place of the means of its points.

    Args:
        mean: of the mixture. weights: of its components. means, variances: of their points.
        columns: the three dimensions of each point (`median_columns`).
    """
    spread = variances.sum(-1).to(means.dtype)
    found = geometric_median(weights, means, spread, mean[..., columns])
    return mean.index_copy(-1, columns.flatten(), found.flatten(-2))
