"""Move many particles at once by a random walk under a mixture prior, and weigh them.

All of it is computed in coordinates whitened by the mean and covariance of the whole prior. There the
particles are of order one, so that float32 is enough for a prior whose scales span 1e-6 to 1e4.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.value_checks import values_visible
from torchpose.math._gaussian import LOG_2PI, mended_cholesky, safe_cholesky
from torchpose.math._mixture_steps import MixtureParameters

CHUNK_ELEMENTS = 630 * 512  # residuals per product: 1.3 MB in float32, so that they stay in cache
TILE = 32
NEGLIGIBLE = -80.0  # exp(-80) = 2e-35: no share of a sum, and not yet denormal in float32


class Moves(NamedTuple):
    """Holds one affine map for each component: y' = [y, noise] @ matrix + offset.

    Attributes:
        matrix: [K, 2 D, D]. offset: [K, D].
        jitter: of the covariances of the noise [K], or None; see `mended_cholesky`.
    """

    matrix: Tensor
    offset: Tensor
    jitter: Tensor | None = None


class MixtureWalk:
    """Computes the prior density and the random-walk evidence of a mixture, from one product of residuals.

    In the generalised eigenbasis E_i of (Sigma_i, Q), with E_i E_i^T = Sigma_i and
    E_i diag(l_i) E_i^T = Q, the residuals r = E_i^-1 (x - mu_i) serve both densities:

    log N(x | mu_i, Sigma_i)         = -1/2 sum_d r_d^2             - log det E_i - D/2 log 2 pi
    log N(x | mu_i, Sigma_i + s Q)   = -1/2 sum_d r_d^2 / (1 + s l) - 1/2 sum_d log(1 + s l) - ...

    so that Phi(x) (BL 7) and the evidence sum_i pi_i c_i(x) (BL 10, 13) cost one product, also
    while a burn-in inflates Q by s. Points are whitened, y = L^-1 (x - m), with L L^T the
    covariance of the whole mixture; log densities are those of y.

    Args:
        mixture: weights, means and covariances of the prior Phi.
        process_cov: Q [D, D], float64.
        dtype: the floating-point type of points and densities, torch.float32 or torch.float64.
    """

    mean: Tensor
    scale: Tensor
    rows: Tensor
    ratio: Tensor
    log_norm: Tensor

    def __init__(self, mixture: MixtureParameters, process_cov: Tensor, dtype: torch.dtype) -> None:
        self.n_components, self.dim = mixture.means.shape
        for name, value in _diagonalise(mixture, process_cov, dtype).items():
            setattr(self, name, value)

    def whiten(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Return y = L^-1 (x - m), computed in float64 and returned in the dtype of the walk."""
        centred = (x.double() - self.mean)[..., None]
        white = torch.linalg.solve_triangular(self.scale, centred, upper=False)
        return white[..., 0].to(self.rows.dtype)

    def unwhiten(self, y: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Return x = m + L y, in float64."""
        return self.mean + y.double() @ self.scale.mT

    def log_prior(self, y: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Return log Phi (BL 7) at every whitened point."""
        weights = torch.ones_like(self._shrink(0.0))[:, None]
        chunks = self._terms(y, weights, self.log_norm[None])
        return torch.cat([_log_sum_exp_(terms[0]) for terms in chunks]).view(y.shape[:-1])

    def log_prior_and_evidence(
        self, y: Float[Tensor, "*batch D"], inflation: float = 1.0
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return log Phi (BL 7) and log sum_i pi_i c_i (BL 10, 13) at every point.

        Args:
            y: whitened points. inflation: factor s of Q.
        """
        shrink = self._shrink(inflation)
        weights = torch.stack([torch.ones_like(shrink), shrink], 1)
        constant = torch.stack([self.log_norm, self._log_norm(inflation)])
        chunks = self._terms(y, weights, constant)
        prior, evidence = torch.cat([_log_sum_exp_(terms) for terms in chunks], 1).unbind()
        return prior.view(y.shape[:-1]), evidence.view(y.shape[:-1])

    def choose(
        self, y: Float[Tensor, "*batch D"], u: Float[Tensor, "*batch"], inflation: float = 1.0
    ) -> Int[Tensor, "*batch"]:
        """Draw a component for every point with probability proportional to pi_i c_i(y) (BL 14).

        Args:
            y: whitened points. u: a uniform number for each. inflation: factor s of Q; with 0 the
                probabilities are the responsibilities under the prior itself.
        """
        weights = self._shrink(inflation)[:, None]
        constant = self._log_norm(inflation)[None]
        chosen, start = [], 0
        triangle = torch.ones(self.n_components, self.n_components, dtype=y.dtype, device=y.device)
        triangle, u = triangle.tril(), u.reshape(-1)
        for terms in self._terms(y, weights, constant):
            logits, own = terms[0], u[start : start + terms.shape[-1]]
            # a product with a triangle is a cumulative sum, three times as fast
            edges = triangle @ _exp_(logits.sub_(logits.amax(0)))
            chosen.append((edges <= own * edges[-1]).sum(0))
            start += terms.shape[-1]
        return torch.cat(chosen).clamp_max_(self.n_components - 1).view(y.shape[:-1])

    def moves(
        self,
        transition: Float[Tensor, "K D D"],
        offset: Float[Tensor, "K D"],
        noise: Float[Tensor, "K D D"],
    ) -> Moves:
        """Return the map of every component, x' = F x + b + N(0, N), for whitened points."""
        matrix = torch.linalg.solve_triangular(self.scale, transition @ self.scale, upper=False)
        centred = (transition @ self.mean + offset - self.mean)[..., None]
        shift = torch.linalg.solve_triangular(self.scale, centred, upper=False)[..., 0]
        half = torch.linalg.solve_triangular(self.scale, noise, upper=False)
        whitened = torch.linalg.solve_triangular(self.scale, half.mT, upper=False)
        factor, jitter = mended_cholesky(whitened)
        dtype = self.rows.dtype
        return Moves(torch.cat([matrix.mT, factor.mT], 1).to(dtype), shift.to(dtype), jitter)

    def noise_moves(self, means: Float[Tensor, "K D"], covs: Float[Tensor, "K D D"]) -> Moves:
        """Return the map y = noise @ matrix + offset that draws from N(means, covs), for whitened points."""
        moves = self.moves(torch.zeros_like(covs), means, covs)
        return moves._replace(matrix=moves.matrix[:, self.dim :])

    def log_likelihood(
        self,
        y: Float[Tensor, "B N D"],
        z: Float[Tensor, "B Z"],
        mask: Bool[Tensor, "B Z"],
        measurement_cov: Float[Tensor, "*batch Z Z"],
        observed: Int[Tensor, " Z"],
    ) -> tuple[Float[Tensor, "B N"], Float[Tensor, " B"] | None]:
        """Return log N(z | H x, R) (BL 15) of the measured dimensions, zero where there are none.

        Args:
            y: whitened points. z: measurements. mask: True where measured. measurement_cov: R, one or
                [B, Z, Z]. observed: the rows of H.

        Returns:
            The log-likelihood of every point, and the jitter of each R, as `mended_cholesky`.
        """
        z = z.double()
        eye = torch.eye(z.shape[1], dtype=z.dtype, device=z.device)
        both = mask[:, :, None] & mask[:, None, :]
        factor, jitter = mended_cholesky(torch.where(both, measurement_cov, eye))
        rows = self.scale[observed] * mask[..., None]
        target = torch.where(mask, z - self.mean[observed], 0.0)
        joint = torch.cat([rows, target[..., None]], -1)
        joint = torch.linalg.solve_triangular(factor, joint, upper=False).to(y.dtype)
        residual = torch.baddbmm(joint[:, None, :, -1], y, joint[..., :-1].mT, alpha=-1)
        log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        log_norm = -log_det - 0.5 * LOG_2PI * mask.sum(-1)
        return log_norm[:, None] - 0.5 * residual.square().sum(-1), jitter

    def moments(
        self, y: Float[Tensor, "B N D"], log_weights: Float[Tensor, "B N"], return_cov: bool
    ) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D D"] | None]:
        """Return the mean and, on request, the covariance of weighted whitened points, unwhitened."""
        weights = log_weights.exp()[:, None].to(y.dtype)
        white_mean = weights @ y
        mean = self.unwhiten(white_mean[:, 0])
        if not return_cov:
            return mean, None
        # float32 sums of ten thousand products can come out indefinite
        spread = ((y - white_mean) * weights.mT.sqrt()).double()
        cov = spread.mT @ spread
        return mean, self.scale @ cov @ self.scale.mT

    def _shrink(self, inflation: float) -> Float[Tensor, "K D"]:
        return (1 / (1.0 + inflation * self.ratio)).to(self.rows.dtype)

    def _log_norm(self, inflation: float) -> Float[Tensor, " K"]:
        return self.log_norm - 0.5 * torch.log1p(inflation * self.ratio).sum(-1)

    def _terms(
        self, y: Tensor, weights: Float[Tensor, "K S D"], constant: Float[Tensor, "S K"]
    ) -> Iterator[Float[Tensor, "S K n"]]:
        """Yield log terms of S mixtures, for chunks of points whose residuals stay in cache."""
        points = y.reshape(-1, self.dim)
        # the row of ones carries the offset: cheaper than adding it to every residual
        points = torch.cat([points.T, points.new_ones(1, len(points))])
        constant = constant.to(y.dtype)[..., None]
        n_rows = len(self.rows)
        budget = CHUNK_ELEMENTS if points.device.type == "cpu" else 64 * CHUNK_ELEMENTS
        size = min(max(1, budget // n_rows), points.shape[1])
        # one buffer for all chunks: fresh pages would cost more than the product
        buffer = points.new_empty(n_rows * size) if values_visible() else None
        for chunk in points.split(size, 1):
            if buffer is None:  # vmap writes into nothing that is not in its batch
                residual = self.rows @ chunk
            else:
                residual = buffer[: n_rows * chunk.shape[1]].view(n_rows, -1)
                torch.mm(self.rows, chunk, out=residual)
            squared = residual.mul_(residual).view(self.n_components, self.dim, -1)
            quadratic = torch.bmm(weights, squared).transpose(0, 1)
            yield torch.add(constant, quadratic, alpha=-0.5)


def grouped_affine(
    x: Float[Tensor, "n E"], group: Int[Tensor, " n"], moves: Moves
) -> Float[Tensor, "n D"]:
    """Return x @ matrix[group] + offset[group], without a copy of the matrix for every row.

    Rows are sorted by group into tiles of 32 that hold one group each, so one batched product of at
    most n / 32 + K tiles does the work, however uneven the groups are.

    Args:
        x: rows [n, E]. group: the map of each row, in 0..K-1. moves: matrix [K, E, D], offset [K, D].
    """
    n, n_groups = len(group), len(moves.offset)
    order = group.argsort()
    count = group.new_zeros(n_groups).scatter_add(0, group, group.new_ones(n))
    tiles = (count + TILE - 1) // TILE
    last_tile, last_row = tiles.cumsum(0), count.cumsum(0)
    # from the place of a row in the sorted order to its place in the padded tiles
    padding = (last_tile - tiles) * TILE - (last_row - count)
    rank = torch.arange(n, device=x.device)
    slot = torch.empty_like(order).scatter(0, order, rank + padding[group[order]])
    n_tiles = n // TILE + n_groups
    source = rank.new_zeros(n_tiles * TILE).scatter(0, slot, rank)
    places = torch.arange(n_tiles, device=x.device) + torch.zeros_like(last_tile[:1])
    owner = torch.searchsorted(last_tile, places, right=True)
    owner = owner.clamp_max(n_groups - 1)
    rows = x.index_select(0, source).view(n_tiles, TILE, -1)
    out = torch.baddbmm(
        moves.offset.index_select(0, owner)[:, None], rows, moves.matrix.index_select(0, owner)
    )
    return out.view(n_tiles * TILE, -1).index_select(0, slot)


def _log_sum_exp_(terms: Float[Tensor, "*batch K n"]) -> Float[Tensor, "*batch n"]:
    """Return log sum exp over K, in place; torch.logsumexp takes three times as long."""
    top = terms.amax(-2, keepdim=True).clamp_min_(torch.finfo(terms.dtype).min)
    return _exp_(terms.sub_(top)).sum(-2).log_().add_(top.squeeze(-2))


def _exp_(terms: Tensor) -> Tensor:
    """Return exp, in place, of numbers of which the largest is 0, without denormal results."""
    return terms.clamp_min_(NEGLIGIBLE).exp_()


@torch.no_grad()
def _diagonalise(
    mixture: MixtureParameters, process_cov: Tensor, dtype: torch.dtype
) -> dict[str, Tensor]:
    weights, means, covariances = (p.detach().double() for p in mixture)
    mean = weights @ means
    centred = means - mean
    total = torch.einsum("k,kij->ij", weights, covariances)
    scale = safe_cholesky(total + torch.einsum("k,ki,kj->ij", weights, centred, centred))
    factor = safe_cholesky(covariances)
    dim = means.shape[1]
    eye = torch.eye(dim, dtype=torch.float64, device=means.device)
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    ratio, basis = torch.linalg.eigh(inverse @ process_cov @ inverse.mT)
    rows = basis.mT @ inverse @ scale  # E_i^-1 L, for whitened points
    shift = basis.mT @ (inverse @ centred[..., None])
    log_det = scale.diagonal().log().sum() - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return {
        "mean": mean,
        "scale": scale,
        "rows": torch.cat([rows, -shift], -1).reshape(-1, dim + 1).to(dtype).contiguous(),
        "ratio": ratio.clamp_min(0),
        "log_norm": weights.log() + log_det - 0.5 * dim * LOG_2PI,
    }
