"""Eliminate joints from the normal equations of cameras that see them."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.whole_body._keypoints.information_step import unit

JOINT_STD = 5.0
"""Metres, of joints about where they are; tells where no two cameras do."""


def eliminated(
    A: Float[Tensor, "*batch K 3"], E: Float[Tensor, "*batch 3 N"], b: Float[Tensor, "*batch 3 1"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return factors L of the information about joints, and Y = L^-1 E and y = L^-1 b.

    The equations of N errors of cameras lose Y^T Y and Y^T y.

    Args:
        A: derivatives of K residuals by their joint. E: A^T B, with B those by the errors. b: A^T r.
    """
    L = torch.linalg.cholesky(A.mT @ A + unit(3, A) / JOINT_STD**2)
    solved = torch.linalg.solve_triangular(L, torch.cat([E, b], -1), upper=False)
    return L, solved[..., :-1], solved[..., -1:]
