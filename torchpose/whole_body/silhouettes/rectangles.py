"""Limbs as rectangles: what cylinders project to, simplified (AS, section 3.2).

The rectangle of a limb lies along the line through the middles of both discs, is as wide as they are on
average, and reaches far enough beyond the middles to cover as much as the limb with its round ends:

    half width r = (r_a + r_b) / 2,   half length = |b - a| / 2 + pi r / 4.

A limb that points at the camera keeps the area of its disc. Rectangles have four edges and no arcs, so
rows take no square roots.
"""

import math

import torch
from torch import Tensor

from torchpose.errors import InputError
from torchpose.whole_body.silhouettes.limb_outlines import LEVEL, Outlines, ProjectedLimbs, outline

__all__ = ["LIMB_SHAPES", "check_limb_shape", "outline_rectangles"]

_CAP = math.pi / 4  # of the half width: what a half disc adds to the length
_POINT = 1e-9  # pixels: an axis shorter than this has no direction


def outline_rectangles(limbs: ProjectedLimbs, height: int, width: int) -> Outlines:
    """Return the edges and rows of the rectangles of projected limbs.

    Args:
        limbs: both ends in every camera.
        height, width: of the images, pixels.

    Returns:
        `Outlines` with four edges and no discs.
    """
    (ax, bx), (ay, by) = limbs.x, limbs.y
    dx, dy = bx - ax, by - ay
    length = torch.hypot(dx, dy)
    upright = length <= _POINT  # seen end on: upright, as most limbs are
    inverse = length.masked_fill(upright, 1.0).reciprocal()
    ux, uy = (dx * inverse).masked_fill(upright, 0.0), (dy * inverse).masked_fill(upright, 1.0)
    half_width = limbs.radius.mean(0)
    half_length = length / 2 + _CAP * half_width
    along = half_length * ux, half_length * uy
    across = -half_width * uy, half_width * ux
    middle = (ax + bx) / 2, (ay + by) / 2
    edges = [
        *_edge(middle, across, along, 1), *_edge(middle, across, along, -1),
        *_edge(middle, along, across, 1), *_edge(middle, along, across, -1),
    ]  # fmt: skip
    reach_x, reach_y = (a.abs() + b.abs() for a, b in zip(along, across, strict=True))
    first = (middle[1] - reach_y).ceil().clamp_(0, height)
    last = (middle[1] + reach_y).floor().clamp_(-1, height - 1)
    seen = limbs.visible & (middle[0] + reach_x >= 0) & (middle[0] - reach_x <= width - 1)
    rows = (last - first + 1).clamp_min_(0).where(seen, 0.0)
    table = torch.stack(edges).view(4, 4, -1)
    return Outlines(
        table.new_empty(0, 3, table.shape[-1]), table, first.reshape(-1), rows.reshape(-1).long()
    )


Vector = tuple[Tensor, Tensor]


def _edge(middle: Vector, offset: Vector, half: Vector, side: int) -> list[Tensor]:
    """Return middle y, half height, middle x and dx/dy of the edge from `half` behind to `half` ahead.

    An edge within one row is left out: its ends are ends of its neighbours.
    """
    run, rise = half
    level = rise.abs() <= LEVEL * run.abs()
    return [
        middle[1] + side * offset[1],
        rise.abs().masked_fill(level, -1.0),
        middle[0] + side * offset[0],
        run / rise.masked_fill(level, math.inf),
    ]


LIMB_SHAPES = {"cylinders": outline, "rectangles": outline_rectangles}
"""Outlines of projected limbs by name: tapered with round ends, or rectangles."""


def check_limb_shape(limb_shape: str) -> None:
    """Raise `InputError` unless there are outlines of this name."""
    if limb_shape not in LIMB_SHAPES:
        raise InputError(f"limb_shape must be one of {', '.join(LIMB_SHAPES)}, got {limb_shape!r}")
