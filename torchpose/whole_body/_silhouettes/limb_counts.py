"""Count silhouette pixels under parts of the body, those that the opposing part may explain by half."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.body._limbs import Limbs
from torchpose.camera._rig import Cameras, as_rig
from torchpose.errors import ShapeError
from torchpose.whole_body._silhouettes.limb_batches import (
    checked_limbs,
    count_intervals,
    flatten_limbs,
    in_chunks,
    intervals_of,
    which_silhouette,
)
from torchpose.whole_body._silhouettes.outlines import NEAR
from torchpose.whole_body._silhouettes.rendering import PreparedSilhouettes, prepare_silhouettes
from torchpose.whole_body._silhouettes.row_intervals import RowIntervals, Strip


class PartCounts(NamedTuple):
    """Holds the weighted pixels of each position of a part in each camera.

    Attributes:
        weight: [..., S, C], float64, silhouette pixels under the part, 1/2 where the opposing part may
            be (DX 4). area: [..., S, C], all pixels under the part within the image.
    """

    weight: Float[Tensor, "*batch S C"]
    area: Int[Tensor, "*batch S C"]


def count_parts(
    parts: Limbs,
    opposing: Limbs | None,
    cameras: Cameras,
    silhouettes: Tensor | PreparedSilhouettes,
    *,
    chunk: int | None = None,
) -> PartCounts:
    """Return each position's weight: the sum of a silhouette that is 1/2 under the opposing part.

    sum_{l in L} B_opp(l) = |L and fg| - 1/2 |L and fg and U|   (DX 4)

    with L the pixels of one position, the union of the part's K limbs, fg the silhouette, and U the
    union of the positions at which the opposing part (of the other arm or leg) is expected. No image
    is formed: with F(x) the silhouette pixels of U before a place x, an interval [a, b) of L shares
    F(b) - F(a) with it.

    Args:
        parts: S positions of a part of K limbs, each position counted apart: [*batch, S, K, 3], radii
            [K, 2] or [*batch, S, K, 2]. The leading dimensions may hold hypotheses and parts.
        opposing: O positions of the opposing part's K' limbs, [*batch, O, K', 3]; None if there is
            none.
        cameras: C of them, with images of the silhouettes' size.
        silhouettes: as for `count_pixels`; their leading dimensions are the first of the batch.
        chunk: batch items at a time; chosen by the size of the images if None (some 10 MB).

    Returns:
        `PartCounts`, each [*batch, S, C].

    Raises:
        ShapeError: the leading dimensions differ; others as `count_pixels`.

    Reference: Daubney & Xie, section 5 and equation (4).
    """
    rig, parts = as_rig(cameras), _positions("parts", parts)
    silhouettes = prepare_silhouettes(silhouettes)
    rig.check_images("silhouettes", silhouettes.shape)
    batch, n_positions = tuple(parts.start.shape[:-3]), parts.start.shape[-3]
    n, strip = math.prod(batch), Strip(*silhouettes.shape)
    which = which_silhouette(n, math.prod(silhouettes.leading(batch, "parts")), silhouettes.before)
    before = silhouettes.before.to(parts.start.device)
    mine = flatten_limbs(parts)
    theirs = None if opposing is None else _union(opposing, batch)
    counts = torch.zeros(3, n, n_positions, strip.cameras, device=parts.start.device)
    counts = counts.to(torch.int64)

    def count(items: slice) -> None:
        begin = None if which is None else which[items]
        each = None if begin is None else begin.repeat_interleave(n_positions)
        some = slice(items.start * n_positions, items.stop * n_positions)
        rows = intervals_of(mine, some, rig, strip, NEAR, "cylinders")
        counts[:2, items] = count_intervals(rows, before.view(-1), each, strip).unflatten(
            1, (-1, n_positions)
        )
        if theirs is not None:
            other = intervals_of(theirs, items, rig, strip, NEAR, "cylinders")
            union = _Union.of(other, before, begin, strip)
            shared = _shared_pixels(rows, union, n_positions, strip)
            counts[2, items] = shared.unflatten(0, (-1, n_positions))

    per_item = (n, n_positions * parts.start.shape[-2], 3)
    sizes = Limbs(parts.start.reshape(per_item), parts.end.reshape(per_item), parts.radii)
    in_chunks(count, sizes, strip, chunk)
    area, inside, shared = counts.view(3, *batch, n_positions, strip.cameras)
    return PartCounts(inside.double() - shared.double() / 2, area)


# --- helpers --------------------------------------------------------------------------------------


class _Union(NamedTuple):
    """Holds the pixels that opposing parts may cover: disjoint intervals in rising order, the first empty.

    Attributes:
        start, stop: [R], packed item and place. before: [R], silhouette pixels of the union before
            each start. silhouette: [R], those of all pixels. running: the silhouettes' running sums.
    """

    start: Tensor
    stop: Tensor
    before: Tensor
    silhouette: Tensor
    running: Tensor
    begin: Tensor | None
    strip: Strip

    @classmethod
    def of(
        cls, rows: RowIntervals, running: Tensor, begin: Tensor | None, strip: Strip
    ) -> "_Union":
        filled = rows.start < rows.stop
        start, stop = (pad(x[filled].long(), (1, 0)) for x in (rows.start, rows.stop))
        running = running.view(-1)
        first, last = (_look_up(x, running, begin, strip) for x in (start, stop))
        before = pad((last - first).cumsum(0)[:-1], (1, 0))
        return cls(start, stop, before, first, running, begin, strip)

    def silhouette_before(self, places: Int[Tensor, " Q"]) -> Int[Tensor, " Q"]:
        """Return F: silhouette pixels of the union before packed places."""
        last = torch.searchsorted(self.start, places, right=True) - 1
        end = torch.minimum(places, self.stop.index_select(0, last))
        within = _look_up(end, self.running, self.begin, self.strip)
        base = self.before - self.silhouette
        return within + base.index_select(0, last)


def _look_up(packed: Tensor, running: Tensor, begin: Tensor | None, strip: Strip) -> Tensor:
    """Return the silhouette pixels before packed places."""
    place = packed & ((1 << strip.bits) - 1)
    if begin is not None:
        place = place + begin.index_select(0, packed >> strip.bits)
    return running.index_select(0, place)


def _shared_pixels(
    rows: RowIntervals, union: _Union, n_positions: int, strip: Strip
) -> Int[Tensor, "N C"]:
    """Return |L and fg and U| of every position and camera."""
    filled = torch.nonzero(rows.start < rows.stop).squeeze(-1)
    # items of the union by those of the rows: a table, since to divide takes longer
    items = torch.arange(len(rows.per_image), device=filled.device)
    owner = items.div(n_positions, rounding_mode="floor") << strip.bits
    ends = torch.stack([rows.start, rows.stop]).index_select(1, filled).long()
    place = ends & ((1 << strip.bits) - 1)
    places = owner.index_select(0, (ends >> strip.bits).view(-1)).view_as(ends) | place
    first, last = union.silhouette_before(places.view(-1)).view_as(ends)
    pixels = torch.zeros_like(rows.start, dtype=torch.int64).index_copy_(0, filled, last - first)
    ends = pad(rows.per_image.flatten().cumsum(0), (1, 0))
    total = pad(pixels.cumsum(0), (1, 0)).index_select(0, ends)
    return total.diff().view(rows.per_image.shape)


def _positions(name: str, parts: Limbs) -> Limbs:
    """Return limbs [*batch, S, K] of which each position is one item."""
    if parts.start.ndim < 4:
        raise ShapeError(f"{name} must have shape [..., S, K, 3], got {list(parts.start.shape)}")
    return checked_limbs(parts, NEAR)


def _union(opposing: Limbs, batch: tuple[int, ...]) -> Limbs:
    """Return all positions of the opposing part as limbs of one item."""
    opposing = _positions("opposing parts", opposing)
    if tuple(opposing.start.shape[:-3]) != batch:
        raise ShapeError(
            f"the opposing part must have the leading dimensions {list(batch)} of the part, got "
            f"{list(opposing.start.shape[:-3])}"
        )
    radii = opposing.radii.expand(*opposing.start.shape[:-1], 2)
    flat = (x.flatten(-3, -2).flatten(0, -3) for x in (opposing.start, opposing.end, radii))
    return Limbs(*flat)
