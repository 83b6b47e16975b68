"""Correct Gaussians by the information that keypoints have about points of a body."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_JITTER = (
    1e-9  # share of a joint's information that is added along every axis, so that it has a factor
)
_LEAST_INFORMATION = 1e-9  # per square metre, of joints that no camera measures


class InformationStep(NamedTuple):
    """Holds a step of an iteration: d [..., N], y' [..., K], Cholesky factor, U with P' = P - U^T U."""

    step: Tensor
    pulled: Tensor
    chol: Tensor
    U: Tensor


def information_step(
    H: Float[Tensor, "*batch K N"],
    HP: Float[Tensor, "*batch K N"],
    G: Float[Tensor, "*batch K K"],
    W: Float[Tensor, "*batch J 3 3"],
    b: Float[Tensor, "*batch J 3"],
    d: Float[Tensor, "*batch N"],
) -> InformationStep:
    """Return a step of Gauss and Newton from a prediction, by the information about K / 3 points.

    Args:
        H: derivative of the points. HP: by the covariance P of the prediction. G: H P H^T.
        W, b: information about the points, and the pull on them. d: from the prediction to where H is.
    """
    L = _factors(W)
    LHP = (L.mT @ HP.unflatten(-2, (-1, 3))).flatten(-3, -2)
    LGL = ((LHP @ H.mT).unflatten(-1, (-1, 3)).transpose(-3, -2) @ L).transpose(-3, -2)
    chol = torch.linalg.cholesky(plus_one(LGL.flatten(-2)))
    U = torch.linalg.solve_triangular(chol, LHP, upper=False)
    moved = (H @ d[..., None]).unflatten(-2, (-1, 3))
    y = (b[..., None] + W @ moved).flatten(-3, -2)
    Gy = (G @ y).unflatten(-2, (-1, 3))
    solved = torch.cholesky_solve((L.mT @ Gy).flatten(-3, -2), chol)
    pulled = y - (L @ solved.unflatten(-2, (-1, 3))).flatten(-3, -2)
    return InformationStep((HP.mT @ pulled).squeeze(-1), pulled.squeeze(-1), chol, U)


def plus_one(matrix: Tensor) -> Tensor:
    """Return the symmetric part of a matrix plus the unit matrix."""
    return (matrix + matrix.mT) / 2 + unit(matrix.shape[-1], matrix)


def unit(size: int, like: Tensor) -> Tensor:
    """Return a unit matrix of the dtype and on the device of a tensor."""
    return torch.eye(size, dtype=like.dtype, device=like.device)


def _factors(W: Float[Tensor, "*batch J 3 3"]) -> Tensor:
    """Return Cholesky factors of information that may be singular."""
    least = _JITTER * W.diagonal(dim1=-2, dim2=-1).sum(-1) + _LEAST_INFORMATION
    return torch.linalg.cholesky(W + least[..., None, None] * unit(3, W))
