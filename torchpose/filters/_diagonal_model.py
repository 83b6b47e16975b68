"""Find coordinates in which the transitions of a mixture are diagonal.

With Q = V V^T and Sigma = V L V^T, both diagonalised at once for each component, and Q inflated by s,

F = Sigma (s Q + Sigma)^-1 = V L (L + s)^-1 V^-1,   N = F s Q = V s L (L + s)^-1 V^T   (paper)
                                        or   N = Sigma - F Sigma F^T = V (L - f L f) V^T   (stationary)

so that a prediction in the coordinates of V is an elementwise product, (f f^T) o P + N with f the
diagonal of F. V comes from Cholesky factors and singular values, V = C_Q U with C_Q^-1 C_Sigma = U L^1/2 W^T,
which keeps the small ones. The transition "ou" is diagonal as it is, or in the principal directions.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.module_state import derived
from torchpose.filters._measurements import as_covariance
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._transition import inflation
from torchpose.math._gaussian import mended_cholesky, safe_cholesky, spare_columns, symmetrise


class DiagonalModel(NamedTuple):
    """Holds the model of every component in coordinates of its own, x = mu + V y.

    Attributes:
        basis: V [K, D, D]. rows: H V [K, Z, D]. start: covariance before the first prediction, [K, D, D].
        size: L [K, D], variances of the prior where it is diagonal; None for "ou" in all directions.
    """

    basis: Tensor
    rows: Tensor
    start: Tensor
    size: Tensor | None


class DiagonalMoves(NamedTuple):
    """Holds a prediction of [P, y; y^T, 0] as the elementwise product with `factor`, plus `noise`.

    Both are [K, E, E], filled up by zeros from D + 1 to E; `factor` is [f f^T, f; f^T, 0].
    """

    factor: Tensor
    noise: Tensor


def diagonal_model(model: MixtureKalmanFilter) -> DiagonalModel | None:
    """Return the coordinates of a filter, kept while it stays as it is; None if a prior is not definite."""
    return derived(model, "diagonal model", model.sources, lambda: _make_model(model))


def diagonal_moves(model: MixtureKalmanFilter, diagonal: DiagonalModel, time: int) -> DiagonalMoves:
    """Return the prediction into a frame, with the inflated Q of the burn-in."""
    if time < model.burn_in:
        inflated = inflation(time, model.burn_in, model.burn_in_scale)
        return _make_moves(model, diagonal, inflated)
    return derived(
        model, "diagonal moves", model.sources, lambda: _make_moves(model, diagonal, 1.0)
    )


def _make_model(model: MixtureKalmanFilter) -> DiagonalModel | None:
    covariances, start = model.covariances.to(torch.float64), model.start_cov
    if model.transition_kind == "ou":
        if model.subspace is None:
            eye = torch.eye(model.dim, dtype=start.dtype, device=start.device)
            basis = eye.expand_as(covariances)
            return DiagonalModel(basis, basis[:, model.observed], start, None)
        size, basis = torch.linalg.eigh(covariances)
        rotated = symmetrise(basis.mT @ start @ basis)
        return DiagonalModel(basis, basis[:, model.observed], rotated, size)
    factor, jitter = mended_cholesky(covariances)
    if jitter is not None:
        return None
    wide = safe_cholesky(as_covariance("process_cov", model.process_cov, model.dim))
    turn, root, _ = torch.linalg.svd(torch.linalg.solve_triangular(wide, factor, upper=False))
    size, basis = root.square(), wide @ turn
    if model.initial_cov is None:
        white = torch.diag_embed(size)
    else:
        half = torch.linalg.solve_triangular(wide, start, upper=False)
        white = torch.linalg.solve_triangular(wide, half.mT, upper=False)
        white = symmetrise(turn.mT @ white @ turn)
    return DiagonalModel(basis, basis[:, model.observed], white, size)


def _make_moves(
    model: MixtureKalmanFilter, diagonal: DiagonalModel, inflated: float
) -> DiagonalMoves:
    rate, noise = _rate_and_noise(model, diagonal.size, inflated)
    dim = model.dim
    joint = pad(rate, (0, 1), value=1.0)
    factor = joint[:, :, None] * joint[:, None, :]
    factor[:, dim, dim] = 0
    spare = spare_columns(dim)
    return DiagonalMoves(
        pad(factor, (0, spare - 1, 0, spare - 1)).contiguous(),
        pad(noise, (0, spare, 0, spare)).contiguous(),
    )


def _rate_and_noise(
    model: MixtureKalmanFilter, size: Tensor | None, inflated: float
) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D D"]]:
    """Return f and N in the coordinates of V."""
    if model.transition_kind != "ou":
        assert size is not None
        rate = size / (size + inflated)
        paper = model.transition_kind == "paper"
        variance = inflated * rate if paper else size - rate * size * rate
        return rate, torch.diag_embed(variance)
    assert model.gamma is not None
    rate = model.gamma.to(torch.float64).expand(len(model.means))[:, None]
    if size is None:
        covariances = model.covariances.to(torch.float64)
        return rate.expand(-1, model.dim), (1 - rate.square())[..., None] * covariances
    assert model.subspace is not None
    moved = torch.arange(model.dim, device=size.device) >= model.dim - model.subspace
    rate = rate * moved
    return rate, torch.diag_embed(size - rate * size * rate)
