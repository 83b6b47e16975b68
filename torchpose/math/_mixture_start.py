"""Choose the start of a mixture fit: k-means++ centres, moved by a few steps of Lloyd's algorithm."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape, check_weights
from torchpose.math._mixture_steps import MixtureParameters

STARTS = ("k-means++", "random")
CHUNK = 8192


def floor_variances(
    x: Float[Tensor, "N D"], relative: float, sample_weight: Float[Tensor, " N"] | None = None
) -> Float[Tensor, " D"]:
    """Return the covariance floor of a fit: a share of the variance of the data in every dimension.

    Args:
        x: points.
        relative: the share.
        sample_weight: w_n of the points.

    Returns:
        Variances, in squared units of x; where the data do not vary, the share of one squared unit.
    """
    mean, variance = _moments(x, _shares(x, sample_weight))
    constant = variance <= (1e-10 * mean).square()
    return relative * torch.where(constant, torch.ones_like(variance), variance)


def start_mixture(
    x: Float[Tensor, "N D"],
    n_components: int,
    generator: torch.Generator,
    floor: Float[Tensor, " D"],
    sample_weight: Float[Tensor, " N"] | None = None,
    init: str = "k-means++",
) -> MixtureParameters:
    """Return a mixture to start EM from.

    Every component gets the covariance of the points around their centres, pooled over all
    components, so that a centre with few points does no harm.

    Args:
        x: points, float64.
        n_components: K, at most N.
        generator: source of randomness.
        floor: variances added to the diagonal.
        sample_weight: w_n of the points.
        init: "k-means++", or "random" for centres at points drawn at random.

    Returns:
        Weights, means and covariances.
    """
    shares = _shares(x, sample_weight)
    mean, variance = _moments(x, shares)
    scale = torch.where(variance > 0, variance, torch.ones_like(variance)).sqrt()
    standard = (x - mean) / scale
    if init == "random":
        centres = standard[_draw(shares, n_components, generator)]
        labels = _nearest(standard, centres)
    else:
        centres, labels = k_means(standard, n_components, generator, shares)
    counts = torch.zeros_like(centres[:, 0]).index_add_(0, labels, shares)
    # one part in ten is shared out evenly, so that a centre without points has a weight too
    weights = 0.9 * counts + 0.1 / n_components
    within = torch.zeros_like(mean[:, None] * mean)
    for points, nearest, share in zip(
        standard.split(CHUNK), labels.split(CHUNK), shares.split(CHUNK), strict=True
    ):
        residual = points - centres[nearest]
        within += (residual * share.unsqueeze(-1)).T @ residual
    covariance = within * torch.outer(scale, scale) + torch.diag(floor)
    covariances = covariance.expand(n_components, -1, -1).clone()
    return MixtureParameters(weights, centres * scale + mean, covariances)


def k_means(
    x: Float[Tensor, "N D"],
    n_clusters: int,
    generator: torch.Generator,
    shares: Float[Tensor, " N"],
    steps: int = 10,
) -> tuple[Float[Tensor, "K D"], Int[Tensor, " N"]]:
    """Return k-means++ centres after some steps of Lloyd's algorithm, and the nearest one of every point.

    Args:
        x: points.
        n_clusters: K.
        generator: source of randomness.
        shares: weight of every point, summing to one.
        steps: of Lloyd's algorithm; a centre that loses all its points stays where it is.

    Reference:
        Arthur & Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007.
    """
    centres = _plus_plus(x, n_clusters, generator, shares)
    labels = _nearest(x, centres)
    for _ in range(steps):
        counts = torch.zeros_like(centres[:, 0]).index_add_(0, labels, shares)
        sums = torch.zeros_like(centres).index_add_(0, labels, x * shares.unsqueeze(-1))
        occupied = counts > 0.0
        centres = torch.where(
            occupied.unsqueeze(-1), sums / counts.where(occupied, 1.0).unsqueeze(-1), centres
        )
        moved = _nearest(x, centres)
        if torch.equal(moved, labels):
            break
        labels = moved
    return centres, labels


def _plus_plus(
    x: Tensor, n_clusters: int, generator: torch.Generator, shares: Tensor
) -> Float[Tensor, "K D"]:
    """Return the centres at points, each the best of a few drawn in proportion to the squared distance."""
    tries = 2 + int(math.log(n_clusters))
    chosen = [int(_draw(shares, 1, generator))]
    distance = (x - x[chosen[0]]).square().sum(-1)
    while len(chosen) < n_clusters:
        mass = distance * shares
        if not bool(mass.sum() > 0):  # fewer distinct points than clusters
            mass = shares
        candidates = _draw(mass, tries, generator)
        to_candidates = [(x - x[i]).square().sum(-1) for i in candidates.tolist()]
        nearest = torch.minimum(torch.stack(to_candidates), distance)
        best = int((nearest @ shares).argmin())
        chosen.append(int(candidates[best]))
        distance = nearest[best]
    return x[chosen]


def _nearest(x: Tensor, centres: Tensor) -> Int[Tensor, " N"]:
    """Return the index of the nearest centre of every point."""
    offset = 0.5 * centres.square().sum(-1, keepdim=True)
    nearest = [(offset - centres @ chunk.T).argmin(0) for chunk in x.split(CHUNK)]
    return torch.cat(nearest)


def _draw(mass: Tensor, n: int, generator: torch.Generator) -> Int[Tensor, " n"]:
    """Draw indices in proportion to `mass` (torch.multinomial stops at 2^24 entries)."""
    edges = mass.cumsum(0)
    uniform = torch.rand(n, generator=generator, dtype=mass.dtype, device=mass.device)
    return torch.searchsorted(edges, uniform * edges[-1], right=True).clamp_max(len(mass) - 1)


def _shares(x: Tensor, sample_weight: Tensor | None) -> Float[Tensor, " N"]:
    if sample_weight is None:
        return torch.full_like(x[:, 0], 1 / len(x))
    check_shape("sample_weight", sample_weight, (len(x),))
    check_finite("sample_weight", sample_weight)
    check_weights("sample_weight", sample_weight[sample_weight != 0])
    return sample_weight.to(x) / sample_weight.sum()


def _moments(x: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    mean = shares @ x
    return mean, shares @ (x - mean).square()
