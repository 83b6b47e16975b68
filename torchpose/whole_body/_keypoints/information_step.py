"""Correct Gaussians by the information that keypoints have about points of a body."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math._gaussian import symmetrise

_JITTER = 1e-9  # share of a joint's information that every axis gets, so that it has a factor
_LEAST_INFORMATION = 1e-9  # per square metre, of joints that no camera measures


class InformationStep(NamedTuple):
    """Holds a step of an iteration.

    step: d [..., N]. pulled: y' [..., K]. chol: Cholesky factor C of 1 + L^T G L [..., K, K].
    factors: L [..., J, 3, 3], with L L^T = W.
    """

    step: Tensor
    pulled: Tensor
    chol: Tensor
    factors: Tensor

    def explained(self, moments: Float[Tensor, "*batch K M"]) -> Float[Tensor, "*batch K M"]:
        """Return C^-1 L^T M for covariances M of the points with something; its square is what becomes known.

        By U of M = H P the covariance after the step is P - U^T U.
        """
        return torch.linalg.solve_triangular(
            self.chol, _by_blocks(self.factors, moments), upper=False
        )

    def explained_points(self, G: Float[Tensor, "*batch K K"]) -> Float[Tensor, "*batch J 3 3"]:
        """Return how much smaller the covariance of each point becomes, of covariances G = H P H^T."""
        U = self.explained(G).unflatten(-1, (-1, 3)).movedim(-3, -1)
        return U @ U.mT


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
    chol = torch.linalg.cholesky(plus_one(_by_blocks(L, _by_blocks(L, G).mT)))
    moved = (H @ d[..., None]).unflatten(-2, (-1, 3))
    y = (b[..., None] + W @ moved).flatten(-3, -2)
    solved = torch.cholesky_solve(_by_blocks(L, G @ y), chol)
    pulled = y - (L @ solved.unflatten(-2, (-1, 3))).flatten(-3, -2)
    return InformationStep((HP.mT @ pulled).squeeze(-1), pulled.squeeze(-1), chol, L)


def _by_blocks(
    L: Float[Tensor, "*batch J 3 3"], rows: Float[Tensor, "*batch K M"]
) -> Float[Tensor, "*batch K M"]:
    """Return L^T M with a block for the three rows of each point."""
    return (L.mT @ rows.unflatten(-2, (-1, 3))).flatten(-3, -2)


def plus_one(matrix: Tensor) -> Tensor:
    """Return the symmetric part of a matrix plus the unit matrix."""
    return symmetrise(matrix) + unit(matrix.shape[-1], matrix)


def unit(size: int, like: Tensor) -> Tensor:
    """Return a unit matrix of the dtype and on the device of a tensor."""
    return torch.eye(size, dtype=like.dtype, device=like.device)


def _factors(W: Float[Tensor, "*batch J 3 3"]) -> Tensor:
    """Return Cholesky factors of information that may be singular."""
    least = _JITTER * W.diagonal(dim1=-2, dim2=-1).sum(-1) + _LEAST_INFORMATION
    return torch.linalg.cholesky(W + least[..., None, None] * unit(3, W))
