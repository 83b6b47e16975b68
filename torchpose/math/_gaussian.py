"""Compute with batches of Gaussians: densities, conditionals, Kalman prediction and update.

Pure functions on tensors. Covariances are never inverted: everything goes through Cholesky factors,
and what comes back is symmetric by construction.
"""

import math
from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.checks import check_shape, check_tensors
from torchpose._core.value_checks import values_visible
from torchpose.errors import CovarianceError, InputError, ShapeError

LOG_2PI = math.log(2 * math.pi)
_JITTER = (1e-14, 1e-12, 1e-10, 1e-8, 1e-6)
_LEAST_VARIANCE = 1e-18  # of a matrix of zeros, such as the covariance of a single particle
_LANES = 8  # products of small matrices take half the time where this divides their columns


def symmetrise(matrix: Float[Tensor, "... D D"]) -> Float[Tensor, "... D D"]:
    """Return (A + A^T) / 2."""
    return (matrix + matrix.mT) * 0.5


def mean_std(cov: Float[Tensor, "... D D"]) -> Float[Tensor, "..."]:
    """Return the standard deviation along an axis, by the mean of the variances."""
    return cov.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(0).sqrt()


def safe_cholesky(matrix: Float[Tensor, "... D D"]) -> Float[Tensor, "... D D"]:
    """Return the Cholesky factor of each matrix, mended where rounding made it indefinite.

    Args, Raises: as `mended_cholesky`.

    Returns:
        Lower triangular L [..., D, D] with L L^T = matrix.
    """
    return mended_cholesky(matrix)[0]


def definite_cholesky(name: str, matrix: Float[Tensor, "... D D"]) -> Float[Tensor, "... D D"]:
    """Return the factors of `safe_cholesky`, or raise where covariances that were right are none any more.

    Args:
        name: of the covariances, for the message. matrix: [..., D, D], symmetric.

    Raises:
        CovarianceError: a matrix that is indefinite by more than rounding, as after a step of an optimiser.
    """
    factor = safe_cholesky(matrix)
    lost = factor.diagonal(dim1=-2, dim2=-1).isnan().any(-1)
    if values_visible() and bool(lost.any()):
        raise CovarianceError(
            f"{name} must be positive definite, got one that is not at index {lost.nonzero()[0].tolist()}; "
            "what is learnt stays a covariance as L L^T of a parameter L"
        )
    return factor


def safe_eigh(
    matrix: Float[Tensor, "*batch D D"],
) -> tuple[Float[Tensor, "*batch D"], Float[Tensor, "*batch D D"]]:
    """Return eigenvalues and eigenvectors; NaN for a matrix that is not finite, which eigh would refuse.

    Args:
        matrix: [..., D, D], symmetric; only the lower triangle is read.
    """
    finite = torch.isfinite(matrix).all(-1, keepdim=True).all(-2, keepdim=True)
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    values, vectors = torch.linalg.eigh(torch.where(finite, matrix, eye))
    return torch.where(finite[..., 0], values, math.nan), torch.where(finite, vectors, math.nan)


def mended_cholesky(
    matrix: Float[Tensor, "... D D"],
) -> tuple[Float[Tensor, "... D D"], Float[Tensor, "..."] | None]:
    """Return the Cholesky factor of each matrix, and the jitter that it took.

    A matrix A that rounding has pushed off the positive definite cone is whitened by its own
    variances, S = diag(A), and gets the smallest jitter j of 1e-14, 1e-12, ... 1e-6 that makes it
    factorise:

    L L^T = A + j S,   from the factor of S^-1/2 A S^-1/2 + j I.

    So every variance grows by the same share j, whether it is in pixels, metres or radians. A
    variance that is rounding beside the largest one, zero or below has no scale of its own; it takes
    the mean of the diagonal for S, at least 1e-18. A matrix that no such jitter mends gets a factor
    of NaN, so that its batch element is lost and no other.

    Args:
        matrix: [..., D, D], symmetric; only the lower triangle is read.

    Returns:
        Lower triangular L [..., D, D], and j [...]: 0 for matrices that factorise as they are, and
        for those that are lost. None if all are seen to factorise as they are, which is the rule.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    if values_visible() and not bool(info.any()):
        return factor, None
    with torch.no_grad():
        scale = _own_scale(matrix)
        both = scale[..., :, None] * scale[..., None, :]
        jitter = _least_jitter(matrix / both, info)
    # One factorisation for all, of what factorises: no gradient passes through one that failed.
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    mended, lost = (jitter > 0)[..., None, None], torch.isnan(jitter)[..., None, None]
    whitened = torch.where(mended, matrix / both + jitter[..., None, None] * eye, matrix)
    factor = torch.linalg.cholesky_ex(torch.where(lost, eye, whitened)).L
    factor = torch.where(mended, scale[..., None] * factor, factor)
    return torch.where(lost, torch.full_like(factor, math.nan), factor), jitter.nan_to_num(0.0)


def _own_scale(matrix: Float[Tensor, "... D D"]) -> Float[Tensor, "... D"]:
    """Return the standard deviation of each dimension, that of the mean where it is rounding."""
    variance = matrix.diagonal(dim1=-2, dim2=-1)
    size = variance.abs()
    rounding = torch.finfo(matrix.dtype).eps * size.amax(-1, keepdim=True)
    mean = size.mean(-1, keepdim=True).clamp_min(_LEAST_VARIANCE)
    return torch.where(variance > rounding, variance, mean).sqrt()


def _least_jitter(
    whitened: Float[Tensor, "... D D"], info: Int[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Return the least jitter that makes each matrix factorise: 0 where it does, NaN where none."""
    eye = torch.eye(whitened.shape[-1], dtype=whitened.dtype, device=whitened.device)
    jitter = torch.where(info == 0, 0.0, torch.full_like(whitened[..., 0, 0], math.nan))
    for candidate in _JITTER:
        retried = torch.linalg.cholesky_ex(whitened + candidate * eye).info
        jitter = torch.where(torch.isnan(jitter) & (retried == 0), candidate, jitter)
    return jitter


def least_exponent(dtype: torch.dtype) -> float:
    """Return the least exponent worth computing beside a largest one of zero.

    Exponentials that underflow are about ten times as slow as others.
    """
    return -500.0 if dtype == torch.float64 else -80.0


def log_prob(
    x: Float[Tensor, "... D"],
    mean: Float[Tensor, "... D"],
    cholesky: Float[Tensor, "... D D"],
) -> Float[Tensor, "..."]:
    """Return the log density of N(mean, L L^T).

    log N(x) = -1/2 ||L^-1 (x - mu)||^2 - sum log diag L - D/2 log 2 pi   (BL 52)

    Args:
        x, mean: [..., D]. cholesky: lower factor [..., D, D]. Batch dimensions broadcast.
    """
    residual = torch.linalg.solve_triangular(cholesky, (x - mean)[..., None], upper=False)[..., 0]
    log_det = cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (residual.square().sum(-1) + x.shape[-1] * LOG_2PI) - log_det


def product(
    mean_a: Float[Tensor, "... D"],
    cov_a: Float[Tensor, "... D D"],
    mean_b: Float[Tensor, "... D"],
    cov_b: Float[Tensor, "... D D"],
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "... D D"], Float[Tensor, "..."]]:
    """Return the product of two Gaussian densities over the same variable.

    N(x|a, A) N(x|b, B) = c N(x|m, C),  C = (A^-1 + B^-1)^-1,  c = N(a|b, A + B)   (BL 9-12)

    C is formed without an inverse: with S = A + B and G = A S^-1, C = G B G^T + (I - G) A (I - G)^T,
    which is symmetric and positive semidefinite term by term.

    Returns:
        m [..., D], C [..., D, D], log c [...].
    """
    factor = safe_cholesky(symmetrise(cov_a + cov_b))
    gain = torch.cholesky_solve(cov_a, factor).mT
    rest = torch.eye(gain.shape[-1], dtype=gain.dtype, device=gain.device) - gain
    mean = mean_a + (gain @ (mean_b - mean_a)[..., None])[..., 0]
    cov = symmetrise(gain @ cov_b @ gain.mT + rest @ cov_a @ rest.mT)
    return mean, cov, log_prob(mean_a, mean_b, factor)


def marginal(
    mean: Float[Tensor, "... D"], cov: Float[Tensor, "... D D"], indices: Int[Tensor, " A"]
) -> tuple[Float[Tensor, "... A"], Float[Tensor, "... A A"]]:
    """Return the mean and covariance of a subset of the dimensions."""
    return mean[..., indices], cov[..., indices[:, None], indices]


def condition(
    mean: Float[Tensor, "... D"],
    cov: Float[Tensor, "... D D"],
    indices: Int[Tensor, " A"],
    values: Float[Tensor, "... A"],
) -> tuple[Float[Tensor, "... U"], Float[Tensor, "... U U"], Float[Tensor, "..."]]:
    """Condition a Gaussian on known values of some of its dimensions.

    mu_u|a = mu_u + S_ua S_aa^-1 (a - mu_a),   S_u|a = S_uu - S_ua S_aa^-1 S_au

    Returns:
        Mean [..., U] and covariance [..., U, U] of the other dimensions, in their old order, and
        log N(values | mu_a, S_aa) [...].
    """
    dim = mean.shape[-1]
    rest = torch.tensor([i for i in range(dim) if i not in set(indices.tolist())])
    rest = rest.to(indices.device).long()
    factor = safe_cholesky(cov[..., indices[:, None], indices])
    white = torch.linalg.solve_triangular(factor, cov[..., indices[:, None], rest], upper=False)
    residual = (values - mean[..., indices])[..., None]
    residual = torch.linalg.solve_triangular(factor, residual, upper=False)
    new_mean = mean[..., rest] + (white.mT @ residual)[..., 0]
    new_cov = cov[..., rest[:, None], rest] - white.mT @ white
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    squared = residual.square().sum((-2, -1))
    return new_mean, new_cov, -0.5 * (squared + indices.numel() * LOG_2PI) - log_det


class Gain(NamedTuple):
    """Holds the part of a Kalman update that does not depend on the measured values.

    Attributes:
        factor: lower Cholesky factor L of the innovation covariance (BL 39), [..., Z, Z]; a missing
            measurement has the row and column of the identity.
        white: W = L^-1 H P [..., Z, D], so that K = W^T L^-1 and P - K S K^T = P - W^T W.
        log_norm: -sum log diag L - n/2 log 2 pi, n the number of measured dimensions, [...].
        jitter: what the innovation covariances took to factorise, [...]; None if they all did as
            they were. See `mended_cholesky`.
    """

    factor: Tensor
    white: Tensor
    log_norm: Tensor
    jitter: Tensor | None = None

    def to(self, dtype: torch.dtype) -> "Gain":
        """Return the same gain in another precision."""
        factor, white, log_norm = (part.to(dtype) for part in self[:3])
        return Gain(factor, white, log_norm, self.jitter)

    def of(self, rows: Int[Tensor, "..."]) -> "Gain":
        """Return the gains of some rows of the first dimension."""
        jitter = None if self.jitter is None else self.jitter[rows]
        return Gain(self.factor[rows], self.white[rows], self.log_norm[rows], jitter)


def kalman_predict(
    mean: Float[Tensor, "... D"],
    cov: Float[Tensor, "... D D"],
    transition: Float[Tensor, "... D D"],
    offset: Float[Tensor, "... D"],
    noise: Float[Tensor, "... D D"],
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "... D D"]]:
    """Predict a Gaussian by x' = F x + b + N(0, N) (BL 34, 37).

    The covariance F P F^T + N is symmetric if N is.

    Args:
        mean: [..., D]. cov: [..., D, D]. transition: F [..., D, D]. offset: b [..., D].
        noise: N [..., D, D]. Batch dimensions broadcast.

    Returns:
        Mean [..., D] and covariance [..., D, D] of the prediction.

    Raises:
        ShapeError: sizes that do not fit together. InputError: no tensors.
    """
    check_tensors(mean=mean, cov=cov, transition=transition, offset=offset, noise=noise)
    check_shape("mean", mean, ["...", "D"])
    square = (mean.shape[-1],) * 2
    _check_sizes(
        mean=(mean, square[:1]), cov=(cov, square), transition=(transition, square),
        offset=(offset, square[:1]), noise=(noise, square),
    )  # fmt: skip
    return predict_moments(mean, cov, transition, offset, noise)


def _check_sizes(**values: tuple[Tensor, tuple[int, ...]]) -> None:
    """Raise `ShapeError` unless tensors end in the given sizes, and their batch dimensions broadcast."""
    batches = {}
    for name, (tensor, sizes) in values.items():
        check_shape(name, tensor, ["...", *sizes])
        batches[name] = tuple(tensor.shape[: tensor.ndim - len(sizes)])
    for sizes in zip_longest(*(batch[::-1] for batch in batches.values()), fillvalue=1):
        several = [size for size in sizes if size != 1]
        if any(size != several[0] for size in several):
            said = ", ".join(f"{list(batch)} of {name}" for name, batch in batches.items())
            raise ShapeError(f"batch dimensions must broadcast, got {said}")


def predict_moments(
    mean: Float[Tensor, "... D"],
    cov: Float[Tensor, "... D D"],
    transition: Float[Tensor, "... D D"],
    offset: Float[Tensor, "... D"],
    noise: Float[Tensor, "... D D"],
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "... D D"]]:
    """Return the result of `kalman_predict`, unchecked."""
    dim = cov.shape[-1]
    right = _multiply(cov, pad(transition, (0, 0, 0, spare_columns(dim))).mT)
    if right.shape[:-2] == mean.shape[:-1]:  # one product, F [P F^T, x]
        both = _multiply(transition, _with_column(right, dim, mean))
        moved = both[..., dim]
    else:
        both = _multiply(transition, right)
        moved = (transition @ mean[..., None])[..., 0]
    spread = both[..., :dim]
    return moved + offset, torch.add(noise, spread + spread.mT, alpha=0.5)


def kalman_gain(
    cov: Float[Tensor, "... D D"],
    measurement_cov: Float[Tensor, "... Z Z"],
    observed: Int[Tensor, " Z"],
    mask: Bool[Tensor, "... Z"] | None = None,
    wanted: Sequence[int] | None = None,
) -> tuple[Gain, Float[Tensor, "... C C"]]:
    """Return the gain and the updated covariance of a measurement of some state dimensions (BL 39-41).

    A missing dimension is taken out exactly: its row of H is zero and its row and column of the
    innovation covariance are those of the identity, so it adds nothing to state or likelihood.

    Args:
        cov: predicted covariance [..., D, D].
        measurement_cov: R [..., Z, Z].
        observed: the Z state dimensions that are measured.
        mask: [..., Z], True where measured; None means all.
        wanted: the state dimensions whose gain and covariance are wanted; None means all.

    Returns:
        The `Gain` and the covariance after the update [..., C, C], of the C wanted dimensions.
    """
    cross, factor, count, jitter = _innovation(cov, measurement_cov, observed, mask)
    if wanted is not None:
        rows = torch.tensor(wanted, device=cov.device)
        cross, cov = cross.index_select(-1, rows), cov[..., rows[:, None], rows]
    white = torch.linalg.solve_triangular(factor, cross, upper=False)
    return Gain(factor, white, _log_norm(factor, count), jitter), cov - white.mT @ white


def _innovation(
    cov: Tensor, measurement_cov: Tensor, observed: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | int, Tensor | None]:
    """Return H P, the factor of H P H^T + R, the number of measured dimensions, and the factor's jitter."""
    cross = cov.index_select(-2, observed)
    innovation = cross.index_select(-1, observed) + measurement_cov
    if mask is None:
        factor, jitter = mended_cholesky(innovation)
        return cross, factor, observed.numel(), jitter
    both = mask[..., :, None] & mask[..., None, :]
    eye = torch.eye(mask.shape[-1], dtype=cov.dtype, device=cov.device)
    innovation = torch.where(both, innovation, eye)
    factor, jitter = mended_cholesky(innovation)
    return cross * mask[..., None], factor, mask.sum(-1).to(cov.dtype), jitter


def _log_norm(factor: Tensor, count: Tensor | int) -> Tensor:
    return -0.5 * LOG_2PI * count - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def spare_columns(columns: int) -> int:
    """Return the number of columns, at least one, to add so that the width is a multiple of `_LANES`."""
    return _LANES - columns % _LANES


def point_blocks(covs: Float[Tensor, "*batch D D"]) -> Float[Tensor, "*batch P 3 3"]:
    """Return the covariances of each three consecutive dimensions, P = D / 3."""
    blocks = covs.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3))
    return blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)


def block_diagonal(blocks: Float[Tensor, "*batch N D D"]) -> Float[Tensor, "*batch ND ND"]:
    """Return matrices with these blocks on their diagonals."""
    eye = torch.eye(blocks.shape[-3], dtype=blocks.dtype, device=blocks.device)
    spread = blocks[..., :, :, None, :] * eye[:, None, :, None]
    return spread.flatten(-2).flatten(-3, -2)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return A @ B; matmul itself takes 2 us longer to see that neither has to be broadcast."""
    if a.ndim == b.ndim == 3 and a.shape[0] == b.shape[0]:
        return torch.bmm(a, b)
    return a @ b


def _beside(cross: Tensor, residual: Tensor) -> Tensor:
    """Return [H P, z - H x, 0 ...]."""
    dim = cross.shape[-1]
    if cross.shape[:-2] != residual.shape[:-1]:
        # not torch.broadcast_shapes, whose first call imports a computer algebra system
        batch = torch.broadcast_tensors(cross[..., 0, 0], residual[..., 0])[0].shape
        cross, residual = cross.expand(*batch, -1, -1), residual.expand(*batch, -1)
    return _with_column(pad(cross, (0, spare_columns(dim))), dim, residual)


def _with_column(matrix: Tensor, index: int, column: Tensor) -> Tensor:
    """Put a column into a new matrix that nothing else holds."""
    if not values_visible():  # vmap may have only one of the two in its batch
        return torch.cat([matrix[..., :index], column[..., None], matrix[..., index + 1 :]], -1)
    matrix[..., index] = column
    return matrix


def kalman_correct(
    mean: Float[Tensor, "... D"],
    z: Float[Tensor, "... Z"],
    gain: Gain,
    observed: Int[Tensor, " Z"],
    mask: Bool[Tensor, "... Z"] | None = None,
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "..."]]:
    """Return the updated mean (BL 40) and log N(z | H x, S) given a gain; z off the mask is ignored."""
    residual = z - mean.index_select(-1, observed)
    if mask is not None:
        residual = torch.where(mask, residual, torch.zeros_like(residual))
    residual = torch.linalg.solve_triangular(gain.factor, residual[..., None], upper=False)
    mean = mean + (gain.white.mT @ residual)[..., 0]
    return mean, gain.log_norm - 0.5 * residual.square().sum((-2, -1))


def kalman_update(
    mean: Float[Tensor, "... D"],
    cov: Float[Tensor, "... D D"],
    z: Float[Tensor, "... Z"],
    measurement_cov: Float[Tensor, "... Z Z"],
    observed: Int[Tensor, " Z"],
    mask: Bool[Tensor, "... Z"] | None = None,
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "... D D"], Float[Tensor, "..."]]:
    """Update a Gaussian by a measurement of some of its dimensions (BL 38-41).

    Args:
        mean: [..., D]. cov: [..., D, D]. z: measurements [..., Z], in the units of the state.
        measurement_cov: R [..., Z, Z]. observed: [Z], indices of the measured dimensions (the rows of H).
        mask: [..., Z], True where measured; None is everywhere. Batch dimensions broadcast.

    Returns:
        Mean [..., D], covariance [..., D, D] and log-likelihood log N(z | H x, H P H^T + R) [...] of what
        was measured.

    Raises:
        ShapeError: sizes that do not fit together. InputError: no tensors, no indices, or a mask that is
            not bool.
    """
    check_tensors(
        mean=mean, cov=cov, z=z, measurement_cov=measurement_cov, observed=observed, mask=mask
    )
    check_shape("mean", mean, ["...", "D"])
    check_shape("observed", observed, ["Z"])
    dims, measured = mean.shape[-1:], observed.shape
    given = {} if mask is None else {"mask": (mask, measured)}
    _check_sizes(
        mean=(mean, dims), cov=(cov, dims * 2), z=(z, measured),
        measurement_cov=(measurement_cov, measured * 2), **given,
    )  # fmt: skip
    _check_kinds(observed, mask, dims[0])
    mean, cov, log_likelihood, _ = mended_update(mean, cov, z, measurement_cov, observed, mask)
    return mean, cov, log_likelihood


def _check_kinds(observed: Tensor, mask: Tensor | None, dim: int) -> None:
    """Raise `InputError` unless these are indices of dimensions, and truth values or None."""
    if observed.dtype not in (torch.int64, torch.int32):
        raise InputError(f"observed must hold indices, as torch.int64, got {observed.dtype}")
    if mask is not None and mask.dtype != torch.bool:
        raise InputError(f"mask must be bool, got {mask.dtype}; compare it, as in mask > 0")
    if values_visible() and not all(0 <= index < dim for index in observed.tolist()):
        raise InputError(f"observed must lie in 0..{dim - 1}, got {observed.tolist()}")


def mended_update(
    mean: Float[Tensor, "... D"],
    cov: Float[Tensor, "... D D"],
    z: Float[Tensor, "... Z"],
    measurement_cov: Float[Tensor, "... Z Z"],
    observed: Int[Tensor, " Z"],
    mask: Bool[Tensor, "... Z"] | None = None,
) -> tuple[
    Float[Tensor, "... D"],
    Float[Tensor, "... D D"],
    Float[Tensor, "..."],
    Float[Tensor, "..."] | None,
]:
    """Return the result of `kalman_update`, and the jitter of innovation covariances (`mended_cholesky`)."""
    cross, factor, count, jitter = _innovation(cov, measurement_cov, observed, mask)
    residual = z - mean.index_select(-1, observed)
    if mask is not None:
        residual = torch.where(mask, residual, torch.zeros_like(residual))
    # One solve, W = L^-1 [H P, z - H x], and one product, W^T W, for all three.
    dim = cov.shape[-1]
    white = torch.linalg.solve_triangular(factor, _beside(cross, residual), upper=False)
    change = _multiply(white.mT, white)
    log_likelihood = torch.sub(_log_norm(factor, count), change[..., dim, dim], alpha=0.5)
    mean = mean + change[..., :dim, dim]
    return mean, cov - change[..., :dim, :dim], log_likelihood, jitter


def mixture_moments(
    log_weights: Float[Tensor, "... M"],
    means: Float[Tensor, "... M D"],
    covs: Float[Tensor, "... M D D"],
) -> tuple[Float[Tensor, "... D"], Float[Tensor, "... D D"]]:
    """Return the mean and covariance of a Gaussian mixture: within plus between components (BL 48)."""
    weights = log_weights.softmax(-1)
    mean = (weights[..., None] * means).sum(-2)
    spread = (means - mean[..., None, :]) * weights[..., None].sqrt()
    return mean, (weights[..., None, None] * covs).sum(-3) + spread.mT @ spread
