"""Features of points, in which the log of every term of a Gaussian mixture is linear."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["CyclicFeatures", "cyclic_order"]


class CyclicFeatures:
    """phi(x) = [1, x_i, x_i x_(i + s mod D)] of chunk after chunk of points.

    Over all i, with s from 0 to D / 2, every pair of dimensions comes once (for even D and s = D / 2
    half of the i do). The points are stored one and a half times in a row, so that x_(i + s mod D) is
    a view of them and a single product makes nearly all features. The result of a call is
    overwritten by the next.

    Args:
        x: some points [N, D], for dtype, device and D.
        width: most points of a chunk.
    """

    def __init__(self, x: Float[Tensor, "N D"], width: int) -> None:
        self.width, dim = min(width, max(len(x), 1)), x.shape[1]
        half, whole = dim // 2, (dim + 1) // 2
        end = 1 + dim + whole * dim
        self._phi = x.new_ones(1 + dim + dim * (dim + 1) // 2, self.width)
        self._ring = ring = x.new_empty(dim + half, self.width)
        shifted = ring.unfold(0, dim, 1).mT[:whole]  # [s, i] is x_(i + s mod D)
        self._products = [(ring[:dim], shifted, self._phi[1 + dim : end].view(whole, dim, -1))]
        if half == whole:
            self._products.append((ring[:half], ring[half:dim], self._phi[end:]))

    def of(self, points: Float[Tensor, "D n"]) -> Float[Tensor, "F n"]:
        """Return the features of a chunk of points."""
        dim = len(points)
        if points.shape[1] != self.width:
            return CyclicFeatures(points.T, points.shape[1]).of(points)
        self._ring[:dim] = points
        self._ring[dim:] = points[: len(self._ring) - dim]
        self._phi[1 : 1 + dim] = points
        for left, right, out in self._products:
            torch.mul(left, right, out=out)
        return self._phi


def cyclic_order(dim: int, device: torch.device) -> Int[Tensor, " F"]:
    """Return where the features of `CyclicFeatures` are in [1, x_i, x_i x_j (i <= j)], i before j."""
    i = torch.arange(dim, device=device)
    left = i.repeat(dim // 2 + 1)[: dim * (dim + 1) // 2]
    right = (left + torch.arange(len(left), device=device) // dim) % dim
    low, high = torch.minimum(left, right), torch.maximum(left, right)
    place = low * dim - low * (low - 1) // 2 + high - low
    return torch.cat([torch.arange(1 + dim, device=device), 1 + dim + place])
