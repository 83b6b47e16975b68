"""Rigid alignment of corresponding points without scale (orthogonal Procrustes analysis)."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.arguments import as_pair

__all__ = ["RigidMotion", "procrustes"]


class RigidMotion(NamedTuple):
    """x -> R x + t. rotation [*batch, 3, 3] (det +1), translation [*batch, 3], metres."""

    rotation: Tensor
    translation: Tensor


def procrustes(
    source: Float[Tensor, "*batch N 3"],
    target: Float[Tensor, "*batch N 3"],
    mask: Bool[Tensor, "*batch N"] | None = None,
) -> RigidMotion:
    """Return the rigid motion without scale or reflection that brings each source closest to its target.

    min over R in SO(3), t of sum_n |R s_n + t - x_n|^2; with the centred cross-covariance
    U S V^T = sum_n x_n s_n^T, R = U diag(1, 1, det(U V^T)) V^T and t = mean x - R mean s.

    Args:
        source, target: [*batch, N, 3], metres; a point with a NaN in either is left out.
        mask: [*batch, N], True = use the point.

    Returns:
        `RigidMotion`; NaN for an element with fewer than three points. With points on one line the
        turn about that line is not determined, and one of the best is returned.

    Reference: Schoenemann (1966), DOI 10.1007/BF02289451; Kabsch (1976) for the sign.

    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> procrustes(square, square + 1).translation
    tensor([1., 1., 1.])
    """
    source, target = as_pair(source, target, mask, ["...", None, 3], ("source", "target"))
    use = torch.isfinite(source).all(-1) & torch.isfinite(target).all(-1)
    if mask is not None:
        use = use & mask
    weight = use[..., None].to(source.dtype)
    count = weight.sum(-2, keepdim=True)
    s = torch.where(use[..., None], source, torch.zeros_like(source))
    x = torch.where(use[..., None], target, torch.zeros_like(target))
    s_mean = s.sum(-2, keepdim=True) / count.clamp_min(1)
    x_mean = x.sum(-2, keepdim=True) / count.clamp_min(1)
    u, _, vh = torch.linalg.svd(((x - x_mean) * weight).mT @ ((s - s_mean) * weight))
    sign = torch.linalg.det(u @ vh)
    last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
    rotation = (u * last[..., None, :]) @ vh
    translation = (x_mean - s_mean @ rotation.mT).squeeze(-2)
    few = (count < 3).reshape(count.shape[:-2])
    return RigidMotion(
        rotation.masked_fill(few[..., None, None], math.nan),
        translation.masked_fill(few[..., None], math.nan),
    )
