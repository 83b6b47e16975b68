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
from torchpose.filters._side_by_side import SideBySide
from torchpose.filters._weights import between, mixed
from torchpose.math._gaussian import LOG_2PI, mended_cholesky, point_blocks, spare_columns
from torchpose.math._geometric_median import with_medians

Tracks = MixtureKalmanFilter | SideBySide
"""Mixtures of one filter, or of A filters side by side, of which tensors have a leading axis more."""


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
        centre: H mu [*A, K, Z]. block: C = H Sigma H^T [*A, K, Z, Z].
        padded: A with columns of zeros behind it, which makes products faster.
        means, covs: mu [*A, K, D] and Sigma [*A, K, D, D], or [*A, K, P, 3, 3] of points.
    """

    centre: Tensor
    padded: Tensor
    block: Tensor
    means: Tensor
    covs: Tensor

    @property
    def rows(self) -> Tensor:
        """Return A = H Sigma, [*A, K, Z, D]."""
        return self.padded[..., : self.means.shape[-1]]


class OwnFrames(NamedTuple):
    """Holds the components given N frames each.

    Attributes:
        factor: L [*A, N, K, Z, Z]; a missing measurement has the row and column of the identity.
        white: v [*A, N, K, Z], 0 where missing. log_likelihood: [*A, N, K]. log_context: that of the first
            measurements alone [*A, N, K], or None.
        jitter: of the S [*A, N, K], or None; see `mended_cholesky`. mask: [*A, N, Z], True where measured.
    """

    factor: Tensor
    white: Tensor
    log_likelihood: Tensor
    jitter: Tensor | None
    mask: Tensor
    log_context: Tensor | None = None


def condition_own(
    model: Tracks,
    parts: MeasuredParts,
    z: Float[Tensor, "*A N Z"],
    mask: Bool[Tensor, "*A N Z"],
    noise: Float[Tensor, "*A N Z Z"],
    n_context: int = 0,
) -> OwnFrames:
    """Return the innovations and likelihoods of all components for frames with an R of their own.

    Args:
        parts: from `measured_parts`. z: 0 where missing. mask: True where measured. noise: R.
        n_context: the number of the first measurements whose likelihood is wanted too; 0 is none.
    """
    noise, both = _own_noise(noise, mask)
    noise, both, block = noise[..., None, :, :], both[..., None, :, :], parts.block
    factor, jitter = mended_cholesky(torch.addcmul(noise, block[..., None, :, :, :], both))
    scale = factor.diagonal(dim1=-2, dim2=-1)
    norms = -0.5 * LOG_2PI * mask[..., None, :].to(scale) - scale.log()
    factor = factor.to(model.dtype)
    centre = parts.centre.to(model.dtype)[..., None, :, :]
    residual = (z[..., None, :] - centre) * mask[..., None, :]
    white = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
    squares = white.square()
    log_likelihood = _log_density(norms, squares)
    log_context = None
    if n_context:
        log_context = _log_density(norms[..., :n_context], squares[..., :n_context])
    return OwnFrames(factor, white, log_likelihood, jitter, mask, log_context)


def _log_density(
    norms: Float[Tensor, "*batch K Z"], squares: Float[Tensor, "*batch K Z"]
) -> Float[Tensor, "*batch K"]:
    """Return the log-density of whitened innovations, of which the squares and normalisers are given."""
    return norms.sum(-1).to(squares).sub(squares.sum(-1), alpha=0.5)


def log_normaliser(
    factor: Float[Tensor, "*batch Z Z"], mask: Bool[Tensor, "*#batch Z"], count: int | None
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
    model: Tracks,
    parts: MeasuredParts,
    frames: OwnFrames,
    log_weights: Float[Tensor, "*A N K"],
    medians: Int[Tensor, "P 3"],
    return_cov: bool,
    of_points: bool,
) -> tuple[Float[Tensor, "*A N D"], Tensor | None]:
    """Return the estimates of the mixture (BL 48) and, on request, their second moments about these.

    Args:
        parts: from `measured_parts`. frames: from `condition_own`. log_weights: normalised.
        medians: the dimensions of points that are estimated by their geometric median.
        of_points: whether the moments of each three consecutive dimensions are wanted alone.
    """
    weights = log_weights.exp()
    rows, centres = parts.rows.to(model.dtype), parts.means.to(model.dtype)
    solved = torch.linalg.solve_triangular(frames.factor.mT, frames.white[..., None], upper=True)
    solved = solved[..., 0]
    gained = (weights[..., None] * solved).flatten(-2)
    mean = weights @ centres + gained @ rows.flatten(-3, -2)
    if not (return_cov or len(medians)):
        return mean, None
    # A_j^T S_j^-1 (z - H mu_j) is the move of every mean
    moves = (solved.transpose(-3, -2) @ rows).transpose(-3, -2)
    means = centres[..., None, :, :] + moves
    columns = medians.flatten()
    if of_points:
        given = rows, frames.factor, frames.mask, weights, columns
        explained, of_each = _explained_of_points(*given)
    else:
        padded = parts.padded.to(model.dtype)
        explained, of_each = _explained(padded, frames.factor, frames.mask, weights, columns)
    if len(medians):
        prior = variances_of(parts.covs, of_points)[..., None, :, columns].to(rows)
        variances = (prior - of_each).unflatten(-1, medians.shape)
        mean = with_medians(mean, weights, means[..., medians], variances, medians)
    if not return_cov:
        return mean, None
    prior, moved = mixed(weights, parts.covs), between(weights, means, mean)
    if of_points:
        return mean, prior + (point_blocks(moved) - explained)
    dim = rows.shape[-1]
    return mean, prior + (moved - explained[..., :dim, :dim])


def variances_of(covs: Tensor, of_points: bool) -> Tensor:
    """Return the variances [..., D] of covariances, or of those of points."""
    variances = covs.diagonal(dim1=-2, dim2=-1)
    return variances.flatten(-2) if of_points else variances


def measured_parts(
    model: Tracks, wanted: tuple[int, ...] | None = None, of_points: bool = False
) -> MeasuredParts:
    """Return what no R changes, kept while the mixture stays as it is.

    Args:
        wanted: the state dimensions that are estimated; None is all.
        of_points: whether the covariances of each three of them are wanted alone.
    """

    def make() -> MeasuredParts:
        means, covs = model.means, model.covariances
        rows = covs.index_select(-2, model.observed)
        block = rows.index_select(-1, model.observed)
        if wanted is not None:
            columns = torch.tensor(wanted, device=means.device)
            rows, means = rows.index_select(-1, columns), means[..., columns]
            covs = covs[..., columns[:, None], columns]
        covs = point_blocks(covs).contiguous() if of_points else covs
        padded = pad(rows, (0, spare_columns(rows.shape[-1])))
        return MeasuredParts(model.means[..., model.observed], padded, block, means, covs)

    sources = (model.means, model.covariances)
    return derived(model, ("measured parts", wanted, of_points), sources, make)


def _explained(
    rows: Float[Tensor, "*A K Z D"],
    factor: Float[Tensor, "*A N K Z Z"],
    mask: Bool[Tensor, "*A N Z"],
    weights: Float[Tensor, "*A N K"],
    columns: Int[Tensor, " C"],
) -> tuple[Float[Tensor, "*A N D D"], Float[Tensor, "*A N K C"]]:
    """Return sum_j w_j W_j^T W_j, which the measurements take off the covariances, and off variances of each.

    Args:
        rows: A of `MeasuredParts`. factor: L. mask: True where measured. weights: w.
        columns: the dimensions whose variances are wanted, the diagonal of W_j^T W_j.
    """
    if not values_visible() or wants_gradient(factor, rows, weights):
        seen = rows[..., None, :, :, :] * mask[..., None, :, None]
        white = torch.linalg.solve_triangular(factor, seen, upper=False)
        of_each = white[..., columns].square().sum(-2)
        scaled = (white * weights.sqrt()[..., None, None]).flatten(-3, -2)
        return scaled.mT @ scaled, of_each
    if rows.ndim > 3:
        each = zip(rows, factor, mask, weights, strict=True)
        explained, of_each = zip(*(_explained(*own, columns) for own in each), strict=True)
        return torch.stack(explained), torch.stack(of_each)
    # One frame at a time stays in the cache, in memory that is used again.
    white, dim = torch.empty_like(rows), rows.shape[-1]
    flat, found = white.flatten(0, 1), []
    total = rows.new_empty(len(factor), dim, dim)
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    for own, seen, share, out in zip(factor, mask, weights.sqrt(), total, strict=True):
        inverse = torch.linalg.solve_triangular(own, seen * eye, upper=False)
        torch.bmm(inverse, rows, out=white)
        found.append(white[..., columns].square().sum(-2))
        white.mul_(share[:, None, None])
        torch.mm(flat.T, flat, out=out)
    return total, torch.stack(found)


def _explained_of_points(
    rows: Float[Tensor, "*A K Z D"],
    factor: Float[Tensor, "*A N K Z Z"],
    mask: Bool[Tensor, "*A N Z"],
    weights: Float[Tensor, "*A N K"],
    columns: Int[Tensor, " C"],
) -> tuple[Float[Tensor, "*A N P 3 3"], Float[Tensor, "*A N K C"]]:
    """Return what `_explained` does, of the first alone the blocks of each three consecutive dimensions."""
    if not values_visible() or wants_gradient(factor, rows, weights):
        return _points_of_frame(rows[..., None, :, :, :], factor, mask, weights, columns)
    # One frame at a time stays in the cache.
    n_frames, frames = weights.shape[-2], weights.shape[:-1]
    own = (part for part in rows.reshape(-1, *rows.shape[-3:]) for _ in range(n_frames))
    each = zip(own, factor.flatten(0, -4), mask.flatten(0, -2), weights.flatten(0, -2), strict=True)
    found = zip(*(_points_of_frame(*frame, columns) for frame in each), strict=True)
    blocks, of_each = (torch.stack(parts).unflatten(0, frames) for parts in found)
    return blocks, of_each


def _points_of_frame(
    rows: Float[Tensor, "*#batch K Z D"],
    factor: Float[Tensor, "*batch K Z Z"],
    mask: Bool[Tensor, "*batch Z"],
    weights: Float[Tensor, "*batch K"],
    columns: Int[Tensor, " C"],
) -> tuple[Float[Tensor, "*batch P 3 3"], Float[Tensor, "*batch K C"]]:
    """Return both results of `_explained_of_points`, of any number of frames."""
    seen = (rows * mask[..., None, :, None]).mT
    points = torch.linalg.solve_triangular(factor.mT, seen, upper=True, left=False)
    points = points.unflatten(-2, (-1, 3))  # W^T, [*batch, K, P, 3, Z]
    squares = points.square().sum(-1)
    crossed = (points * points.roll(-1, -2)).sum(-1)  # x y, y z, z x
    products = torch.cat([squares, crossed], -1).flatten(-2)
    total = (weights[..., None, :] @ products)[..., 0, :].unflatten(-1, (-1, 6))
    blocks = total[..., [0, 3, 5, 3, 1, 4, 5, 4, 2]].unflatten(-1, (3, 3))
    return blocks, squares.flatten(-2)[..., columns]
