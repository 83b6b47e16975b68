"""Mixture density for many particles: one float32 product of whitened residuals, kept in cache."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.errors import check_shape
from torchpose.priors.gmm import LOG_2PI, GaussianMixture

__all__ = ["FastMixtureDensity"]

CHUNK = 512  # particles per product: 630 x 512 residuals in float32 are 1.3 MB


class FastMixtureDensity(nn.Module):
    """Log density of a fixed Gaussian mixture in float32, for particle filters.

    Points are whitened with the covariance of the whole mixture in float64 (z = W (x - m)), which
    takes away the scales of the state; then the residuals of all components,
    y_k = L_k^-1 W^-1 z - L_k^-1 (mu_k - m), are one float32 product per chunk of points, and
    log N_k = c_k - |y_k|^2 / 2. On the priors of the paper the log density is within 1e-4 of
    float64. The product of 231 squared features that could replace it saves a quarter of the time
    and is 30 times less exact, since its terms cancel.

    The parameters are copied out of the mixture without their graph: use `GaussianMixture.log_prob`
    for gradients. Nothing is kept between calls.

    Args:
        mixture: the mixture to evaluate, best in float64.

    >>> gmm = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
    >>> round(FastMixtureDensity(gmm).log_prob(torch.zeros(2)).item(), 4)
    -1.8379
    """

    mean: Tensor
    whiten: Tensor
    rows: Tensor
    shift: Tensor
    constant: Tensor

    def __init__(self, mixture: GaussianMixture) -> None:
        super().__init__()
        self.n_components, self.dim = mixture.n_components, mixture.dim
        for name, value in _float32_parameters(mixture).items():
            self.register_buffer(name, value, persistent=False)

    def component_log_prob(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch K"]:
        """Log of each term of the mixture, log pi_k + log N(x; mu_k, Sigma_k), in float32.

        Args:
            x: points [..., D], in the units of the mixture.

        Raises:
            ShapeError: the last dimension is not D.
        """
        out = torch.empty(self.n_components, self._count(x), dtype=self.rows.dtype, device=x.device)
        for start, terms in self._chunks(x):
            out[:, start : start + terms.shape[1]] = terms
        return out.T.reshape(*x.shape[:-1], self.n_components)

    def log_prob(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Log density of the mixture, in float32.

        Args:
            x: points [..., D], in the units of the mixture.

        Raises:
            ShapeError: the last dimension is not D.
        """
        out = torch.empty(self._count(x), dtype=self.rows.dtype, device=x.device)
        for start, terms in self._chunks(x):
            out[start : start + terms.shape[1]] = _log_sum_exp_(terms)
        return out.reshape(x.shape[:-1])

    def forward(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """`log_prob`."""
        return self.log_prob(x)

    def _count(self, x: Tensor) -> int:
        check_shape("x", x, ("...", self.dim))
        return x.numel() // self.dim

    @torch.no_grad()
    def _chunks(self, x: Tensor) -> Iterator[tuple[int, Tensor]]:
        """First index and terms [K, chunk] of every chunk of points."""
        k, mean, whiten = self.n_components, self.mean.double(), self.whiten.double()
        points = x.detach().reshape(-1, self.dim)
        for start in range(0, len(points), CHUNK):
            centred = points[start : start + CHUNK].double() - mean
            white = (whiten @ centred.T).to(self.rows.dtype)
            residual = torch.addmm(self.shift, self.rows, white)
            # dimensions outermost: the sum over them runs along contiguous memory
            squared = residual.square_().view(self.dim, -1).sum(0).view(k, -1)
            yield start, squared.mul_(-0.5).add_(self.constant)


def _log_sum_exp_(terms: Float[Tensor, "K N"]) -> Float[Tensor, " N"]:
    """log sum exp over the first dimension, overwriting the terms.

    Terms below the largest by the factor exp(-80) are held there: they do not count, and an
    exponential that underflows takes ten times as long.
    """
    top = terms.amax(0).clamp_min(torch.finfo(terms.dtype).min)
    return terms.sub_(top).clamp_min_(-80.0).exp_().sum(0).log_().add_(top)


@torch.no_grad()
def _float32_parameters(mixture: GaussianMixture) -> dict[str, Tensor]:
    weights, means, covariances = (p.double() for p in mixture.parameters_tuple())
    double = GaussianMixture(weights, means, covariances)
    k, dim = means.shape
    mean, covariance = double.moments()
    eye = torch.eye(dim, dtype=torch.float64, device=means.device)
    scale = torch.linalg.cholesky(covariance)
    whiten = torch.linalg.solve_triangular(scale, eye, upper=False)
    # rounded before use, so that what is stored in float32 is exactly what the rest is made for
    mean, whiten = mean.float(), whiten.float()
    factor = double.cholesky()
    unwhiten = torch.linalg.solve_triangular(whiten.double(), eye, upper=False)
    matrices = torch.linalg.solve_triangular(factor, unwhiten.expand(k, dim, dim), upper=False)
    offsets = (means - mean.double()).unsqueeze(-1)
    shift = torch.linalg.solve_triangular(factor, offsets, upper=False).squeeze(-1)
    log_norm = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * dim * LOG_2PI
    return {
        "mean": mean,
        "whiten": whiten,
        "rows": matrices.transpose(0, 1).reshape(dim * k, dim).float().contiguous(),
        "shift": -shift.T.reshape(-1, 1).float(),
        "constant": (weights.log() - log_norm).float().unsqueeze(-1),
    }
