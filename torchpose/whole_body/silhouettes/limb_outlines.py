"""Limbs as cameras see them: the convex hull of two discs, described so that rows are cheap.

Each end of a limb projects to a disc: the centre by the camera matrix, the radius f r / z with f the
geometric mean of both focal lengths. (A ball off the optical axis is really a slightly elongated
ellipse; silhouette trackers pass over it.) Their hull is bounded by arcs of the discs and by the two
outer tangents.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.limbs import Limbs
from torchpose.camera.rig import CameraRig

__all__ = ["LEVEL", "NEAR", "Outlines", "ProjectedLimbs", "outline", "project_limbs"]

NEAR = 0.1
"""Metres in front of a camera; nearer parts of a limb are cut off."""

LEVEL = 1e-9
"""An edge with less rise than this times its run lies within one row."""


class ProjectedLimbs(NamedTuple):
    """Both ends of every limb in every camera, in pixels; index 0 is the start, 1 the end.

    Attributes:
        x, y: [2, C, N, L], centres. radius: [2, C, N, L].
        visible: [C, N, L], False for a limb wholly nearer than `near`, behind the camera, or NaN.
    """

    x: Float[Tensor, "2 C N L"]
    y: Float[Tensor, "2 C N L"]
    radius: Float[Tensor, "2 C N L"]
    visible: Bool[Tensor, "C N L"]


class Outlines(NamedTuple):
    """What a row needs of each limb, M = C N L limbs in this order.

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
    """Return the discs of both ends in every camera; what is nearer than `near` is cut off.

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
    exists = apart > 0
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
    discs = [ax, ay, ra * ra, bx, by, rb * rb]
    first = torch.minimum(ay - ra, by - rb).ceil().clamp_(0, height)
    last = torch.maximum(ay + ra, by + rb).floor().clamp_(-1, height - 1)
    right, left = torch.maximum(ax + ra, bx + rb), torch.minimum(ax - ra, bx - rb)
    seen = limbs.visible & (right >= 0) & (left <= width - 1)
    rows = (last - first + 1).clamp_min_(0).where(seen, 0.0)
    return Outlines(
        torch.stack(discs).view(2, 3, -1),
        torch.stack(edges).view(2, 4, -1),
        first.reshape(-1),
        rows.reshape(-1).long(),
    )


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
