"""Outline limbs in images, hulls of two discs or rectangles, and list the intervals of rows in them.

Each end of a limb projects to a disc: the centre by the camera matrix, the radius f r / z with f the
geometric mean of both focal lengths. (A ball off the optical axis is really a slightly elongated
ellipse; this is neglected.) Their hull is bounded by arcs of the discs and by the two
outer tangents.

A convex limb covers one interval of each row. The intervals of all limbs, only for rows that a limb
covers, form a flat list; sorted by place, with a running maximum of what is covered so far, they
become disjoint. The cost depends on limbs times rows, hardly on the width.

Place in a strip: an item's C images lie row after row, so pixel (row i, column j) of camera c is at
(c H + i) W + j. Item and place are packed into one number, so that sorting is fast.

The rectangle of a limb lies along the line through the middles of both discs, is as wide as they are on
average, and reaches far enough beyond the middles to cover as much as the limb with its round ends:

    half width r = (r_a + r_b) / 2,   half length = |b - a| / 2 + pi r / 4.

A limb that points at the camera keeps the area of its disc. Rectangles have four edges and no arcs, so
rows take no square roots."""

import math
from typing import NamedTuple

import numpy as np
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


_ROWS = 8  # rows computed at once from one look at the outline
_FAR = 1e12  # factor that pushes what a row misses out of every image


class Strip(NamedTuple):
    """Describes the layout of packed places: `item << bits | place`.

    Attributes:
        cameras, height, width: of an item's images.
    """

    cameras: int
    height: int
    width: int

    @property
    def pixels(self) -> int:
        """Return the number of pixels of an item."""
        return self.cameras * self.height * self.width

    @property
    def bits(self) -> int:
        """Return the bits of a place; its end may be one past the last pixel."""
        return self.pixels.bit_length()

    @property
    def length_bits(self) -> int:
        """Return the bits of an interval's length."""
        return self.width.bit_length()


class RowIntervals(NamedTuple):
    """Holds disjoint intervals in rising order.

    Attributes:
        start, stop: [R], packed item and place, `stop` exclusive; many are empty (start == stop).
        per_image: [N, C], how many intervals, empty ones among them, each image has.
    """

    start: Int[Tensor, " R"]
    stop: Int[Tensor, " R"]
    per_image: Int[Tensor, "N C"]


def limb_intervals(outlines: Outlines, n_items: int, strip: Strip) -> RowIntervals:
    """Return the union of every item's limbs in every camera as disjoint intervals.

    Pixel (i, j) is covered if (x, y) = (j, i) lies in a limb's hull.

    Args:
        outlines: of C * n_items * L limbs, in this order.
        n_items: particles.
        strip: size of the images.
    """
    rows = min(_ROWS, strip.height)
    blocks = (outlines.n_rows + (rows - 1)).div_(rows, rounding_mode="floor")
    limb = torch.repeat_interleave(blocks)
    start, length, first_row = _block_rows(outlines, blocks, limb, rows, strip)
    n_limbs = len(blocks) // max(n_items * strip.cameras, 1)
    image = limb.div(max(n_limbs, 1), rounding_mode="floor")
    key = _keys(start, length, first_row, image, n_items, strip)
    places, stops = _sorted_intervals(key, strip.length_bits)
    starts = torch.minimum(torch.maximum(places, _covered_before(stops)), stops)
    per_image = blocks.view(strip.cameras, n_items, n_limbs).sum(-1).T * rows
    return RowIntervals(starts, stops, per_image)


def _block_rows(
    outlines: Outlines, blocks: Tensor, limb: Tensor, rows: int, strip: Strip
) -> tuple[Tensor, Tensor, Tensor]:
    """Return first column and length [rows, n] of blocks of rows, and the first row [n] of each.

    Blocks at the lower border are moved up into the image: that a row then comes twice does not
    change the union.
    """
    before = blocks.cumsum(0) - blocks
    within = torch.arange(len(limb), device=limb.device) - before.index_select(0, limb)
    first_row = outlines.first_row.index_select(0, limb).add_(within, alpha=rows)
    first_row.clamp_max_(strip.height - rows)
    y = first_row + torch.arange(rows, device=limb.device).to(first_row).unsqueeze(-1)
    left, right = _row_ends(outlines, limb, y)
    start = left.ceil_().clamp_(0, strip.width)
    stop = right.floor_().add_(1).clamp_(0, strip.width)
    return start, stop.sub_(start).clamp_min_(0), first_row


def _row_ends(outlines: Outlines, limb: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return leftmost and rightmost x [rows, n] of hulls in rows y [rows, n]; left > right if none.

    A hull's boundary in a row is that of a disc or of an edge, whichever is outermost. Those that
    the row misses are pushed far inwards; to select by a mask takes three times as long.
    """
    left, right = torch.full_like(y, _FAR), torch.full_like(y, -_FAR)
    # Two arrays for all that is in between: fresh ones would cost more than the arithmetic.
    offset, x = torch.empty_like(y), torch.empty_like(y)
    for x_middle, middle, squared_radius in _of_limbs(outlines.discs, limb):
        torch.sub(y, middle, out=offset)
        inside = torch.addcmul(squared_radius, offset, offset, value=-1, out=x)
        outside = torch.clamp(inside, max=0, out=offset)
        half = _sqrt_(inside.clamp_(min=0)).add_(outside, alpha=_FAR)
        torch.minimum(left, torch.sub(x_middle, half, out=offset), out=left)
        torch.maximum(right, half.add_(x_middle), out=right)
    for middle, half_height, x_middle, slope in _of_limbs(outlines.edges, limb):
        torch.sub(y, middle, out=offset)
        torch.addcmul(x_middle, offset, slope, out=x)
        outside = torch.sub(half_height, offset.abs_(), out=offset).clamp_(max=0).mul_(_FAR)
        torch.minimum(left, x.sub_(outside), out=left)
        torch.maximum(right, x.add_(outside, alpha=2), out=right)
    return left, right


def _of_limbs(table: Tensor, limb: Tensor) -> Tensor:
    """Return columns `limb` of a table [n, k, M]; gather takes a sixth of index_select's time."""
    return table.gather(2, limb.expand(*table.shape[:2], -1))


def _sqrt_(x: Tensor) -> Tensor:
    """Take the square root in place; on the CPU NumPy's takes a third of the time."""
    if not _by_numpy(x):
        return x.sqrt_()
    np.sqrt(x.numpy(), out=x.numpy())
    return x


def _keys(
    start: Tensor, length: Tensor, first_row: Tensor, image: Tensor, n_items: int, strip: Strip
) -> Tensor:
    """Pack item, place and length of every interval in one number each, [rows * n].

    `image` [n] is the camera times the number of items plus the item.
    """
    bits = strip.bits + strip.length_bits + (n_items - 1).bit_length()
    kind = {"dtype": torch.int32 if bits < 32 else torch.int64, "device": image.device}
    camera = torch.arange(strip.cameras, **kind) * (strip.height * strip.width)
    images = camera.unsqueeze(-1) + (torch.arange(n_items, **kind) << strip.bits)
    block = images.reshape(-1).index_select(0, image)
    block.add_(first_row.to(block.dtype), alpha=strip.width)
    row = torch.arange(len(start), **kind) * strip.width
    key = (block + row.unsqueeze(-1)).add_(start.to(block.dtype))
    return key.bitwise_left_shift_(strip.length_bits).bitwise_or_(length.to(key.dtype)).view(-1)


def _sorted_intervals(key: Tensor, length_bits: int) -> tuple[Tensor, Tensor]:
    """Return start and stop of intervals in rising order of their start."""
    if _by_numpy(key):
        key.numpy().sort()  # in place, by SIMD instructions that torch.sort does not use
    else:
        key = key.sort().values
    start = key >> length_bits
    return start, start + (key & ((1 << length_bits) - 1))


def _covered_before(stops: Tensor) -> Tensor:
    """Return the largest stop before each interval; 0 before the first."""
    if _by_numpy(stops):
        covered = np.zeros(len(stops) + 1, stops.numpy().dtype)
        np.maximum.accumulate(stops.numpy(), out=covered[1:])
        return torch.from_numpy(covered[:-1])
    return torch.nn.functional.pad(stops.cummax(0).values, (1, 0))[:-1]


def _by_numpy(x: Tensor) -> bool:
    """Tell whether NumPy works in the memory of a tensor."""
    return x.device.type == "cpu"


_CAP = math.pi / 4  # of the half width: what a half disc adds to the length
_POINT = 1e-9  # pixels: an axis shorter than this has no direction


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
