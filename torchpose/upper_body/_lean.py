"""Follow the lean of a torso to a side, by the slope of the line between its shoulders in the image."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.skeleton._joint_sets import UPPER_BODY

_LEFT, _RIGHT = (UPPER_BODY.index(f"shoulder_{side}") for side in ("left", "right"))
_MEMORY = 0.5  # seconds
_LEVEL = math.radians(15.0)  # shoulders that are raised look like a lean of that much
_SHORT = 0.15  # metres: the slope of a line that is seen shorter says little


def seen_lean(
    moments: Float[Tensor, "B 2"],
    rays: Float[Tensor, "B 8 3"],
    known: Bool[Tensor, "B 8"],
    depth: Float[Tensor, " B"],
    fps: float,
) -> Float[Tensor, "B 2"]:
    """Return the moments of the line between the shoulders after a frame, metres squared.

        m <- (1 - a) m + a (dx^2 - dy^2 + c^2, 2 dx dy)

    They are those of a line, not of a direction, so that bodies seen from behind have the same; c is
    short, and keeps the line level where the shoulders are seen one behind the other.

    Args:
        moments: the moments after the frame before. rays: K^-1 [u, v, 1] of the joints. known: which
            joints are measured. depth: the depth of the body, metres. fps: frames per second.
    """
    apart = (rays[:, _LEFT] - rays[:, _RIGHT]) * depth[:, None]
    dx, dy = apart[:, 0], apart[:, 1]
    seen = torch.stack([dx.square() - dy.square() + _SHORT**2, 2.0 * dx * dy], 1)
    share = torch.where((moments == 0.0).all(1), 1.0, 1 - math.exp(-1 / (_MEMORY * fps)))
    both = (known[:, _LEFT] & known[:, _RIGHT])[:, None]
    return torch.where(both, moments + share[:, None] * (seen - moments), moments)


def lean_angle(moments: Float[Tensor, "B 2"]) -> Float[Tensor, " B"]:
    """Return the angle by which a torso leans, radians; small slopes are taken for a raised shoulder.

        x = atan2(m_2, m_1) / 2,   x^3 / (x^2 + x_0^2)

    Args:
        moments: the moments m of `seen_lean`.
    """
    seen = (moments != 0.0).any(1)
    first = torch.where(seen, moments[:, 0], torch.ones_like(moments[:, 0]))
    angle = torch.atan2(moments[:, 1], first) / 2.0
    return angle**3 / (angle.square() + _LEVEL**2)


def roll(angle: Float[Tensor, " B"]) -> Float[Tensor, "B 3 3"]:
    """Return the rotation by an angle about the camera's optical axis."""
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, torch.ones_like(angle)]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
