"""List the intervals of rows that limbs cover in images.

A convex limb covers one interval of each row. The intervals of all limbs, only for rows that a limb
covers, form a flat list; sorted by place, with a running maximum of what is covered so far, they
become disjoint. The cost depends on limbs times rows, hardly on the width.

Place in a strip: an item's C images lie row after row, so pixel (row i, column j) of camera c is at
(c H + i) W + j. Item and place are packed into one number, so that sorting is fast.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchpose.whole_body._silhouettes.outlines import Outlines

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
