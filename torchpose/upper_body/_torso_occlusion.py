"""Weigh joints of arms that are measured although the person's own torso would hide them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_WIDE, _DEEP = 0.45, 0.25  # half the width and depth of a torso, in widths of the shoulders
_TOP, _BOTTOM = 0.15, 1.5  # its ends below the shoulders, in widths of the shoulders
_SOFT, _SOFT_TOP, _SOFT_BOTTOM = 0.15, 0.05, 0.1  # softness of its surface (half depths), its ends
_FACING = 0.2  # sine of the turn about which a front becomes a back
_NARROWEST = 1e-3  # metres: measured shoulders may lie on one ray
_HIDDEN = 0.1  # how often joints in a torso, or behind it, are measured, relative to those in view


def log_in_view(
    ends: Float[Tensor, "*batch N 3"],
    shoulder: Float[Tensor, "*batch 3"],
    middle: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch N"]:
    """Return the log of how often joints at these places are measured, relative to those in view.

    The torso is an elliptic cylinder below the shoulders. With the place x of a joint and the direction c
    of the camera relative to its axis, in its half-axes, the joint's ray meets the surface at s, if it does:

        along = x . c,   s^2 = 1 - (x x c)^2,   log (1 - (1 - h) P(hidden)),   h = 0.1

    A joint is hidden if it is inside, |along| < s. From the front it is hidden behind the torso too,
    along < s. From behind it is not taken to be: arms are in front of the torso most of the time, and
    detectors guess them through it.

    Args:
        ends: places of elbows or hands, upright axes of the torso, from the camera, metres.
        shoulder, middle: of the same arm, and the middle of both, in the same axes.
    """
    width = 2.0 * torch.linalg.vector_norm(shoulder - middle, dim=-1)[..., None]
    width = width.clamp_min(_NARROWEST)
    x, down, z = ((ends - middle[..., None, :]) / width[..., None]).unbind(-1)
    x, z = x / _WIDE, z / _DEEP
    to_camera = -middle[..., None, 0] / _WIDE, -middle[..., None, 2] / _DEEP
    far = torch.hypot(*to_camera)
    side, front = (value / far for value in to_camera)
    along, beside = x * side + z * front, (x * front - z * side).square()
    surface = (1.0 - beside).clamp_min(1e-12).sqrt()
    inside = torch.sigmoid((surface - along.abs()) / _SOFT)
    behind = torch.sigmoid((surface - along) / _SOFT)
    hidden = inside.lerp(behind, torch.sigmoid(front / -_FACING))
    at_height = torch.sigmoid((down - _TOP) / _SOFT_TOP) * torch.sigmoid(
        (_BOTTOM - down) / _SOFT_BOTTOM
    )
    return torch.log1p((_HIDDEN - 1) * hidden * at_height * (beside < 1.0))
