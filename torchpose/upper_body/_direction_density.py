"""Compute the density of a prior over the directions of upper arms and forearms."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.priors._arms import ArmPrior
from torchpose.priors._gaussian_mixture import LOG_2PI

_NOTHING = -45.0  # nats relative to the broad part of the prior
_LEAST = 1e-30  # of a product of weights
_LOG_2 = math.log(2)
_ROWS = 1280  # pairs of directions at a time: so that intermediate results stay in the cache


class DirectionDensity:
    """Log-density of an `ArmPrior`; what does not depend on the directions is computed once.

    That of each component is a quadratic polynomial of the six coordinates, so one product gives all. The
    directions of the forearms that are tried with an upper arm are sums of a few axes, of which the
    polynomials are computed in place of those of all directions (`of_arms`). Densities are powers of two,
    which PyTorch computes in half the time of others.

    Attributes:
        log_ratio: a bound of the log of the ratio of the largest density to the least.
        together: C_jk = A_jk / (pi_j pi_k) of `ArmPrior.together`, the broad part last.
    """

    def __init__(self, prior: ArmPrior, device: torch.device | None = None) -> None:
        parts = (*prior.directions.parameters_tuple(), prior.log_mass)
        weights, means, covariances, log_mass = (part.to(device).double() for part in parts)
        dim = means.shape[-1]
        factor = torch.linalg.cholesky(covariances)
        precision = torch.cholesky_inverse(factor)
        pulled = (precision @ means[..., None])[..., 0]
        logs = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = weights.log() - 0.5 * dim * LOG_2PI - logs - log_mass
        constant = constant - 0.5 * (means * pulled).sum(-1)
        constant = constant + math.log1p(-prior.broad)
        first, second = torch.triu_indices(dim, dim, device=device)
        twice = torch.where(first == second, 0.5, 1.0)  # either order of two coordinates counts
        squares = -twice * precision[:, first, second]
        # the terms: products of two coordinates, of one with 1, and 1
        alone = torch.arange(dim + 1, device=device)
        self._first = torch.cat([first, alone])
        self._second = torch.cat([second, torch.full_like(alone, dim)])
        log_broad = math.log(prior.broad) - 2 * math.log(4 * math.pi)
        self._broad, self._nothing = math.exp(log_broad), (log_broad + _NOTHING) / _LOG_2
        slopes = torch.cat([squares, pulled, constant[:, None]], 1)
        self._slopes = pad(slopes, (0, 0, 0, 1))
        self._slopes[-1, -1] = log_broad
        self._slopes /= _LOG_2
        by_bone = _by_bone(-0.5 * precision, pulled, constant)
        self._forms = {count: _form(*by_bone, count) for count in (2, 3)}
        peaks = (constant + 0.5 * (means * pulled).sum(-1)).exp()
        self.log_ratio = math.log1p(float(peaks.sum()) / self._broad)
        self._ones = torch.ones_like(weights)  # a product adds up components faster than a sum
        apart = (weights[:, None] * weights).clamp_min(_LEAST)
        tied = prior.together.to(device).double() / apart
        self.together = pad(tied, (0, 1, 0, 1), value=1.0)  # the broad part is tied to nothing

    def __call__(self, directions: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
        """Return log p(d_u, d_f)."""
        rows = directions.flatten(0, -2).split(2 * _ROWS)
        parts = [self._densities(part).sum(0) for part in rows]
        return torch.cat(parts).log().to(directions.dtype).view(directions.shape[:-1])

    def shares(self, directions: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch K"]:
        """Return the posterior of each component, the broad one last."""
        densities = self._densities(directions.flatten(0, -2))
        shares = (densities / densities.sum(0)).to(directions.dtype)
        return shares.mT.reshape(*directions.shape[:-1], -1)

    def of_arms(
        self,
        upper: Float[Tensor, "*batch U 3"],
        axes: Float[Tensor, "*#batch #U A 3"],
        turns: Float[Tensor, "G A"],
    ) -> Float[Tensor, "*batch U G"]:
        """Return log p(d_u, d_f) of each upper arm with G forearms d_f = sum_a t_a e_a.

        A component's polynomial of d_u and d_f is one of (1, t) too, whose coefficients are products of d_u
        and the axes:

            log p_k = sum_(i >= j) c_ijk t_i t_j,   t_0 = 1

        Args:
            upper: d_u. axes: e. turns: t.
        """
        n_axes, n_uppers = axes.shape[-2], upper.shape[:-1]
        first, second, slopes = self._forms[n_axes]
        bones = torch.cat(
            [
                pad(upper, (0, 1), value=1.0)[..., None, :],
                pad(axes, (0, 1)).expand(*n_uppers, n_axes, 4),
            ],
            -2,
        )
        bones = bones.reshape(-1, n_axes + 1, 4).double().permute(1, 2, 0).contiguous()
        turns = pad(turns.double(), (1, 0), value=1.0)
        products = turns[:, first] * turns[:, second]
        count = max(1, _ROWS // len(turns))
        ones, others = (bones.index_select(0, rows).split(count, 2) for rows in (first, second))
        pairs = zip(ones, others, strict=True)
        known = torch.cat([self._known(*pair, slopes, products).mT for pair in pairs])
        return (known + self._broad).log().to(upper.dtype).view(*n_uppers, -1)

    def _known(
        self,
        one: Float[Tensor, "P 4 N"],
        other: Float[Tensor, "P 4 N"],
        slopes: Float[Tensor, "P 16 K"],
        products: Float[Tensor, "G P"],
    ) -> Float[Tensor, "G N"]:
        """Return the density of the mixture at N upper arms with G forearms, without its broad part."""
        of_pairs = torch.bmm((one[:, :, None] * other[:, None]).flatten(1, 2).mT, slopes)
        densities = self._powers(products @ of_pairs.flatten(1))
        return densities.view(len(products), -1, slopes.shape[-1]) @ self._ones

    def _densities(self, directions: Float[Tensor, "N 6"]) -> Float[Tensor, "K N"]:
        """Return the densities of the components, the broad one last.

        The terms of their logarithms cancel, some of a thousand to a few: they are float64.
        """
        columns = pad(directions.double(), (0, 1), value=1.0).mT.contiguous()
        terms = columns.index_select(0, self._first) * columns.index_select(0, self._second)
        return self._powers(self._slopes @ terms)

    def _powers(self, logs: Tensor) -> Tensor:
        """Return two to the power of numbers, in place."""
        # what is far below the broad part adds nothing, and is slow where its power is denormal
        return logs.clamp_min_(self._nothing).exp2_()


def _by_bone(
    square: Float[Tensor, "K 6 6"], linear: Float[Tensor, "K 6"], constant: Float[Tensor, " K"]
) -> tuple[Float[Tensor, "16 K"], Float[Tensor, "16 K"], Float[Tensor, "16 K"]]:
    """Return the coefficients of quadratic polynomials of the directions u and f of both bones.

    They are those of the products of (u, 1) with itself, of (f, 0) with (u, 1), and of (f, 0) with itself,
    of logarithms to base two.
    """
    upper = pad(square[:, :3, :3], (0, 1, 0, 1))
    upper[:, :3, 3], upper[:, 3, 3] = linear[:, :3], constant
    across = pad(torch.cat([2 * square[:, 3:, :3], linear[:, 3:, None]], -1), (0, 0, 0, 1))
    lower = pad(square[:, 3:, 3:], (0, 1, 0, 1))
    upper, across, lower = (part.flatten(1).mT / _LOG_2 for part in (upper, across, lower))
    return upper, across, lower


def _form(
    upper: Float[Tensor, "16 K"],
    across: Float[Tensor, "16 K"],
    lower: Float[Tensor, "16 K"],
    n_axes: int,
) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, "P 16 K"]]:
    """Return the pairs (i, j) of (u, 1) and the axes of f, and the coefficients of their products."""
    first, second = torch.tril_indices(n_axes + 1, n_axes + 1, device=upper.device)
    slopes = []
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        of_axes = lower if i == j else 2.0 * lower  # either order of two axes counts
        slopes.append(upper if i == 0 else across if j == 0 else of_axes)
    return first, second, torch.stack(slopes)
