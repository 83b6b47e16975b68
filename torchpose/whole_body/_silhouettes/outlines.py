"""Outline limbs in images: hulls of two discs, or rectangles.

Each end of a limb projects to a disc: the centre by the camera matrix, the radius f r / z with f the
geometric mean of both focal lengths. (A ball off the optical axis is really a slightly elongated
ellipse; this is neglected.) Their hull is bounded by arcs of the discs and by the two
outer tangents.

The rectangle of a limb lies along the line through the middles of both discs, is as wide as they are on
average, and reaches far enough beyond the middles to cover as much as the limb with its round ends:

    half width r = (r_a + r_b) / 2,   half length = |b - a| / 2 + pi r / 4.

A limb that points at the camera keeps the area of its disc. Rectangles have four edges and no arcs, so
rows take no square roots.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.body._limbs import Limbs
from torchpose.camera._rig import CameraRig

NEAR = 0.1
"""Metres in front of a camera; nearer parts of a limb are cut off."""

LEVEL = 1e-9
"""An edge with less rise than this times its run lies within one row."""

_CAP = math.pi / 4  # of the half width: what a half disc adds to the length
_POINT = 1e-9  # pixels: an axis shorter than this has no direction


class ProjectedLimbs(NamedTuple):
    """Holds both ends of every limb in every camera, in pixels; index 0 is the start, 1 the end.

    Attributes:
        x, y: [2, C, N, L], centres. radius: [2, C, N, L].
        visible: [C, N, L], False for a limb wholly nearer than `near`, behind the camera, or NaN.
    """

    x: Float[Tensor, "2 C N L"]
    y: Float[Tensor, "2 C N L"]
    radius: Float[Tensor, "2 C N L"]
    visible: Bool[Tensor, "C N L"]


class Outlines(NamedTuple):
    """Holds the row-wise description of each limb's outline, M = C N L limbs in this order.

    Attributes:
        discs: [2, 3, M]: x, y and squared radius of both discs; [0, 3, M] for limbs without round ends.
        edges: [E, 4, M]: middle y, half the height, middle x, and dx/dy of the straight edges: both
            outer tangents between the points where they touch, or the four sides of a rectangle. Half
            the height is -1 where there is none.
        first_row: [M], first row of the image that the limb covers.
        n_rows: [M], how many; 0 for a limb out of sight.
    """

    discs: Float[Tensor, "K 3 M"]
    edges: Float[Tensor, "E 4 M"]
    first_row: Float[Tensor, " M"]
    n_rows: Int[Tensor, " M"]


def project_limbs(limbs: Limbs, rig: CameraRig, near: float = NEAR) -> ProjectedLimbs:
    """Return the discs of both ends in every camera; parts nearer than `near` are cut off.

    Args:
        limbs: start and end [N, L, 3], radii [L, 2] or [N, L, 2], metres, world axes.
        rig: C cameras.
        near: metres along the optical axis, positive.
    """
    ends = torch.stack([limbs.start, limbs.end])
    n, n_limbs = ends.shape[1:3]
    K, R, t = (b.to(ends) for b in (rig.matrix, rig.rotation, rig.translation))
    # Components first, so that the columns below are contiguous.
    product = (K @ R).transpose(0, 1).reshape(-1, 3)
    offset = (K @ t.unsqueeze(-1)).transpose(0, 1).reshape(-1, 1)
    homogeneous = torch.addmm(offset, product, ends.reshape(-1, 3).T)
    homogeneous = homogeneous.view(3, len(rig), 2, n, n_limbs).transpose(1, 2)
    radii = limbs.radii.to(ends).expand(n, n_limbs, 2).movedim(-1, 0).unsqueeze(1)
    depth = homogeneous[2]
    visible = torch.ones_like(depth[0], dtype=torch.bool)
    if not bool((depth >= near).all()):
        homogeneous, radii, visible = _clip(homogeneous, radii, near)
        depth = homogeneous[2]
    inverse = depth.reciprocal()
    focal = (K[:, 0, 0] * K[:, 1, 1]).sqrt()[:, None, None]
    return ProjectedLimbs(
        homogeneous[0] * inverse, homogeneous[1] * inverse, radii * (focal * inverse), visible
    )


def outline(limbs: ProjectedLimbs, height: int, width: int) -> Outlines:
    """Return the discs, tangents and rows of the hull of both discs.

    With d the vector from one centre to the other, the outer tangents have the unit normals n with
    n · d = r_a - r_b, and touch at a + r_a n and b + r_b n; there are none where one disc holds the
    other.
    """
    (ax, bx), (ay, by), (ra, rb) = limbs.x, limbs.y, limbs.radius
    dx, dy, dr = bx - ax, by - ay, ra - rb
    squared = dx * dx + dy * dy
    apart = squared - dr * dr
    exists = apart > 0.0
    inverse = (squared + (~exists)).reciprocal()  # where there are none, any finite number does
    along, across = dr * inverse, apart.clamp_min(0).sqrt() * inverse
    edges = []
    for side in (1, -1):
        nx = dx * along - side * (dy * across)
        ny = dy * along + side * (dx * across)
        rise, run = dy - dr * ny, dx - dr * nx
        level = rise.abs() <= LEVEL * run.abs()
        half = (rise.abs() * 0.5).masked_fill_(level | ~exists, -1.0)
        slope = run / rise.masked_fill(level, math.inf)
        sum_r = ra + rb
        edges += [(ay + by + sum_r * ny) * 0.5, half, (ax + bx + sum_r * nx) * 0.5, slope]
    discs = torch.stack([ax, ay, ra * ra, bx, by, rb * rb]).view(2, 3, -1)
    left, right = torch.minimum(ax - ra, bx - rb), torch.maximum(ax + ra, bx + rb)
    top, bottom = torch.minimum(ay - ra, by - rb), torch.maximum(ay + ra, by + rb)
    rows = _rows(limbs.visible, left, right, top, bottom, height, width)
    return Outlines(discs, torch.stack(edges).view(2, 4, -1), *rows)


def _rows(
    visible: Tensor,
    left: Tensor,
    right: Tensor,
    top: Tensor,
    bottom: Tensor,
    height: int,
    width: int,
) -> tuple[Float[Tensor, " M"], Int[Tensor, " M"]]:
    """Return the first row that limbs cover, and how many, of those that reach into the image."""
    first = top.ceil().clamp_(0, height)
    last = bottom.floor().clamp_(-1, height - 1)
    seen = visible & (right >= 0) & (left <= width - 1)
    rows = (last - first + 1).clamp_min_(0).where(seen, 0.0)
    return first.reshape(-1), rows.reshape(-1).long()


def _clip(homogeneous: Tensor, radii: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Move ends nearer than `near` along the limb to that depth; limbs wholly nearer are unseen."""
    depth = homogeneous[2]
    other = depth.flip(0)
    too_near = depth < near
    visible = ((depth >= near) | (other >= near))[0] & ~(depth.isnan() | other.isnan())[0]
    share = ((near - depth) / (other - depth)).where(too_near & visible, 0.0)
    radii = radii + share * (radii.flip(0) - radii)
    homogeneous = homogeneous + share * (homogeneous.flip(1) - homogeneous)
    # Limbs out of sight get harmless numbers: their rows are not computed.
    return homogeneous.where(visible, 1.0), radii.expand_as(share).where(visible, 0.0), visible


def outline_rectangles(limbs: ProjectedLimbs, height: int, width: int) -> Outlines:
    """Return the edges and rows of the rectangles of projected limbs.

    Args:
        limbs: both ends in every camera.
        height, width: the height and width of the images, pixels.

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
    (x, y), reach = middle, [a.abs() + b.abs() for a, b in zip(along, across, strict=True)]
    left, right, top, bottom = x - reach[0], x + reach[0], y - reach[1], y + reach[1]
    rows = _rows(limbs.visible, left, right, top, bottom, height, width)
    table = torch.stack(edges).view(4, 4, -1)
    return Outlines(table.new_empty(0, 3, table.shape[-1]), table, *rows)


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
    check_choice("limb_shape", limb_shape, LIMB_SHAPES)
