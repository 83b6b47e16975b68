"""Condition the mixture on frames that have measurement noise or gaps of their own.

Another R changes only the small covariance of the measured dimensions. What does not depend on it is
made once for a mixture, with H the rows of the identity for what is measured:

A_j = H Sigma_j,  C_j = H Sigma_j H^T,  S_j = C_j + R = L_j L_j^T,  v_j = L_j^-1 (z - H mu_j).

Likelihoods need S_j alone, means m_j = mu_j + A_j^T S_j^-1 (z - H mu_j), and their weighted mean is one
product with all A_j. Posterior covariances Sigma_j - W_j^T W_j, W_j = L_j^-1 A_j, are not formed: a
weighted sum of them is sum_j w_j Sigma_j less one product of the W_j, and a median needs traces.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.module_state import derived
from torchpose._core.value_checks import values_visible
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._recompute import wants_gradient
from torchpose.math._gaussian import LOG_2PI, mended_cholesky, spare_columns
from torchpose.math._geometric_median import with_medians


class FrameNoise(NamedTuple):
    """Holds the noise of frames with gaps, S = R' + b C, of any number of frames [..., Z, Z].

    Attributes:
        noise: R', R with the rows and columns of the identity where something is missing.
        both: b, 1 where both dimensions are measured; None where nothing is missing in any frame.
        mask: 1 where measured, [..., Z]. log_norm: -1/2 log 2 pi for each measured dimension, [..., 1].
    """

    noise: Tensor
    both: Tensor | None
    mask: Tensor
    log_norm: Tensor


def frame_noise(cov: Float[Tensor, "*#frames Z Z"], mask: Bool[Tensor, "*frames Z"]) -> FrameNoise:
    """Return the noise of frames in float64.

    Args:
        cov: R of every frame, or one for all. mask: True where measured.
    """
    noise, both = _own_noise(cov.to(torch.float64), mask)
    count = mask.sum(-1, keepdim=True).to(noise)
    complete = bool(mask.all())
    return FrameNoise(noise, None if complete else both, mask.to(noise), -0.5 * LOG_2PI * count)


class MeasuredParts(NamedTuple):
    """Holds what no R changes, with means, covariances and A of the dimensions that are wanted.

    Attributes:
        centre: H mu [K, Z]. rows: A = H Sigma [K, Z, D]. block: C = H Sigma H^T [K, Z, Z].
        means, covs: mu [K, D] and Sigma [K, D, D].
    """

    centre: Tensor
    rows: Tensor
    block: Tensor
    means: Tensor
    covs: Tensor


class OwnFrames(NamedTuple):
    """Holds the components given N frames each.

    Attributes:
        factor: L [N, K, Z, Z]; a missing measurement has the row and column of the identity.
        white: v [N, K, Z], 0 where missing. log_likelihood: [N, K]. log_context: that of the first
            measurements alone [N, K], or None.
        jitter: of the S [N, K], or None; see `mended_cholesky`. mask: [N, Z], True where measured.
    """

    factor: Tensor
    white: Tensor
    log_likelihood: Tensor
    jitter: Tensor | None
    mask: Tensor
    log_context: Tensor | None = None


def condition_own(
    model: MixtureKalmanFilter,
    parts: MeasuredParts,
    z: Float[Tensor, "N Z"],
    mask: Bool[Tensor, "N Z"],
    noise: Float[Tensor, "N Z Z"],
    n_context: int = 0,
) -> OwnFrames:
    """Return the innovations and likelihoods of all components for frames with an R of their own.

    Args:
        parts: from `measured_parts`. z: 0 where missing. mask: True where measured. noise: R.
        n_context: the number of the first measurements whose likelihood is wanted too; 0 is none.
    """
    noise, both = _own_noise(noise, mask)
    factor, jitter = mended_cholesky(torch.addcmul(noise[:, None], parts.block, both[:, None]))
    scale = factor.diagonal(dim1=-2, dim2=-1)
    norms = -0.5 * LOG_2PI * mask[:, None].to(scale) - scale.log()
    factor = factor.to(model.dtype)
    residual = (z[:, None] - parts.centre.to(model.dtype)) * mask[:, None]
    white = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
    squares = white.square()
    log_likelihood = _log_density(norms, squares)
    log_context = None
    if n_context:
        log_context = _log_density(norms[..., :n_context], squares[..., :n_context])
    return OwnFrames(factor, white, log_likelihood, jitter, mask, log_context)


def _log_density(
    norms: Float[Tensor, "N K Z"], squares: Float[Tensor, "N K Z"]
) -> Float[Tensor, "N K"]:
    """Return the log-density of whitened innovations, of which the squares and normalisers are given."""
    return norms.sum(-1).to(squares).sub(squares.sum(-1), alpha=0.5)


def log_normaliser(
    factor: Float[Tensor, "*batch Z Z"], mask: Bool[Tensor, "*#batch Z"], count: int | None = None
) -> Float[Tensor, "*batch"]:
    """Return -1/2 log det(2 pi S) of the first measured dimensions, of S = L L^T.

    Args:
        factor: L, with the rows of the identity where nothing is measured. mask: True where measured.
        count: the number of the first dimensions; None is all.
    """
    scale = factor.diagonal(dim1=-2, dim2=-1)[..., :count]
    return -0.5 * LOG_2PI * mask[..., :count].sum(-1).to(scale) - scale.log().sum(-1)


def _own_noise(
    noise: Float[Tensor, "... Z Z"], mask: Bool[Tensor, "... Z"]
) -> tuple[Float[Tensor, "... Z Z"], Float[Tensor, "... Z Z"]]:
    """Return R' and b of S = R' + b C: b is 1 where both are measured; R' is the identity elsewhere."""
    both = mask[..., :, None] & mask[..., None, :]
    eye = torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device)
    return torch.where(both, noise, eye), both.to(noise)


def own_moments(
    model: MixtureKalmanFilter,
    parts: MeasuredParts,
    frames: OwnFrames,
    log_weights: Float[Tensor, "N K"],
    medians: Int[Tensor, "P 3"],
    return_cov: bool,
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N D D"] | None]:
    """Return the estimates of the mixture (BL 48) and, on request, their second moments about these.

    Args:
        parts: from `measured_parts`. frames: from `condition_own`. log_weights: normalised.
        medians: the dimensions of points that are estimated by their geometric median.
    """
    weights = log_weights.exp()
    rows, centres = parts.rows.to(model.dtype), parts.means.to(model.dtype)
    solved = torch.linalg.solve_triangular(frames.factor.mT, frames.white[..., None], upper=True)
    solved = solved[..., 0]
    gained = (weights[..., None] * solved).flatten(1)
    mean = weights @ centres + gained @ rows.flatten(0, 1)
    if not (return_cov or len(medians)):
        return mean, None
    # A_j^T S_j^-1 (z - H mu_j) is the move of every mean
    means = centres + torch.bmm(solved.transpose(0, 1), rows).transpose(0, 1)
    if len(medians):
        variances = _variances(parts, rows, frames, medians)
        mean = with_medians(mean, weights, means[..., medians], variances, medians)
    return mean, _covariance(parts, rows, frames, weights, means, mean) if return_cov else None


def measured_parts(
    model: MixtureKalmanFilter, wanted: tuple[int, ...] | None = None
) -> MeasuredParts:
    """Return what no R changes, kept while the mixture stays as it is.

    Args:
        wanted: the state dimensions that are estimated; None is all.
    """

    def make() -> MeasuredParts:
        means, covs = model.means, model.covariances
        rows = covs.index_select(-2, model.observed)
        block = rows.index_select(-1, model.observed)
        if wanted is not None:
            columns = torch.tensor(wanted, device=means.device)
            rows, means = rows.index_select(-1, columns), means[:, columns]
            covs = covs[:, columns[:, None], columns]
        return MeasuredParts(model.means[:, model.observed], rows, block, means, covs)

    return derived(model, ("measured parts", wanted), (model.means, model.covariances), make)


def _covariance(
    parts: MeasuredParts,
    rows: Tensor,
    frames: OwnFrames,
    weights: Tensor,
    means: Float[Tensor, "N K D"],
    mean: Tensor,
) -> Float[Tensor, "N D D"]:
    """Return sum_j w_j (Sigma_j + (m_j - m)(m_j - m)^T) - sum_j w_j W_j^T W_j."""
    apart = (means - mean[:, None]) * weights[..., None].sqrt()
    prior = weights @ parts.covs.to(rows).flatten(1)
    explained = _explained(frames.factor, rows, weights, frames.mask)
    return prior.unflatten(-1, rows.shape[-1:] * 2) + apart.mT @ apart - explained


def _explained(
    factor: Float[Tensor, "N K Z Z"], rows: Float[Tensor, "K Z D"], weights: Tensor, mask: Tensor
) -> Float[Tensor, "N D D"]:
    """Return sum_j w_j W_j^T W_j, what the measurements take off the covariances."""
    shares = weights.sqrt()[..., None, None] * mask[:, None, :, None]
    if not values_visible() or wants_gradient(factor, rows, weights):
        white = torch.linalg.solve_triangular(factor, rows * shares, upper=False).flatten(1, 2)
        return white.mT @ white
    # One frame at a time stays in the cache, in memory that is used again.
    dim = rows.shape[-1]
    rows = pad(rows, (0, spare_columns(dim)))
    white = torch.empty_like(rows).flatten(0, 1)
    explained = rows.new_empty(len(factor), *rows.shape[-1:] * 2)
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    for own, share, total in zip(factor, shares, explained, strict=True):
        inverse = torch.linalg.solve_triangular(own, share.mT * eye, upper=False)
        torch.bmm(inverse, rows, out=white.view_as(rows))
        torch.mm(white.T, white, out=total)
    return explained[:, :dim, :dim]


def _variances(
    parts: MeasuredParts, rows: Tensor, frames: OwnFrames, points: Int[Tensor, "P 3"]
) -> Float[Tensor, "N K P 3"]:
    """Return the variances of all components in the dimensions of some points."""
    columns = points.flatten()
    seen = rows[..., columns] * frames.mask[:, None, :, None]
    white = torch.linalg.solve_triangular(frames.factor, seen, upper=False)
    prior = parts.covs.diagonal(dim1=-2, dim2=-1)[:, columns].to(rows)
    return (prior - white.square().sum(-2)).unflatten(-1, points.shape)
