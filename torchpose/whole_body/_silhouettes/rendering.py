"""Render silhouettes of many bodies in many cameras, or only count them against observed ones.

Both rest on intervals of rows (`torchpose.whole_body._silhouettes.outlines`): exact, and without a
loop over particles, cameras or limbs. Counting never forms an image.
"""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.checks import check_finite, check_tensors
from torchpose.body._limbs import Limbs
from torchpose.camera._rig import Cameras, as_rig
from torchpose.errors import InputError, ShapeError
from torchpose.whole_body._silhouettes.limb_batches import (
    checked_limbs,
    count_intervals,
    flatten_limbs,
    in_chunks,
    intervals_of,
    which_silhouette,
)
from torchpose.whole_body._silhouettes.outlines import NEAR, check_limb_shape
from torchpose.whole_body._silhouettes.row_intervals import RowIntervals, Strip

_PIXELS = 2**22  # rendered in one chunk


@runtime_checkable
class HasLimbs(Protocol):
    """Declares what rendering needs of a body with limbs, such as `Body`."""

    def limbs(self, state: Tensor) -> Limbs:
        """Return limbs [..., L] of states [..., D]."""
        ...


class SilhouetteCounts(NamedTuple):
    """Holds the numbers of pixels for each hypothesis and camera.

    Attributes:
        model: [..., C], |S(x)|, pixels that the body covers.
        overlap: [..., C], |S(x) and S|, covered pixels that are in the silhouette.
        image: [..., C], |S|, pixels of the silhouette.
    """

    model: Int[Tensor, "*batch C"]
    overlap: Int[Tensor, "*batch C"]
    image: Int[Tensor, "*batch C"]


class PreparedSilhouettes(NamedTuple):
    """Silhouettes as running sums, for frames that are compared with more than once.

    Attributes:
        before: [*B, C H W + 1], how many silhouette pixels come before each place.
        area: [*B, C], pixels of each silhouette.
        shape: (C, H, W).
    """

    before: Int[Tensor, "*batch P"]
    area: Int[Tensor, "*batch C"]
    shape: tuple[int, int, int]

    def leading(self, batch: tuple[int, ...], of: str) -> tuple[int, ...]:
        """Return the leading dimensions, the first ones of a batch or none.

        Args:
            batch: of what is compared. of: its name in messages.

        Raises:
            ShapeError: they do not fit.
        """
        leading = tuple(self.area.shape[:-1])
        if batch[: len(leading)] != leading:
            raise ShapeError(
                f"silhouettes must have the leading dimensions of the {of}, {list(batch)} or the first "
                f"of them, got {list(leading)} before [C, H, W]"
            )
        return leading


def prepare_silhouettes(silhouettes: Tensor | PreparedSilhouettes) -> PreparedSilhouettes:
    """Return running sums of silhouettes along their rows.

    Args:
        silhouettes: [*B, C, H, W], True (or not zero) on the person; what is prepared stays as it is.

    Raises:
        ShapeError: fewer than three dimensions, or an image without pixels. InputError: no tensor, or NaN.
    """
    if isinstance(silhouettes, PreparedSilhouettes):
        return silhouettes
    check_tensors(silhouettes=silhouettes)
    if silhouettes.ndim < 3 or 0 in silhouettes.shape[-3:]:
        raise ShapeError(
            f"silhouettes must have shape [..., C, H, W], got {list(silhouettes.shape)}"
        )
    cameras, height, width = silhouettes.shape[-3:]
    mask = silhouettes
    if silhouettes.dtype != torch.bool:
        check_finite("silhouettes", silhouettes)
        mask = silhouettes != 0
    before = pad(mask.flatten(-3).cumsum(-1, dtype=torch.int32), (1, 0))
    ends = before[..., :: height * width]
    return PreparedSilhouettes(before, ends.diff(dim=-1).long(), (cameras, height, width))


def count_pixels(
    body: HasLimbs | Limbs,
    state: Tensor | None,
    cameras: Cameras,
    silhouettes: Tensor | PreparedSilhouettes,
    *,
    chunk: int | None = None,
    near: float = NEAR,
    limb_shape: str = "cylinders",
) -> SilhouetteCounts:
    """Count pixels of the projected body, of the silhouette, and of both, per particle and camera.

    Pixel (i, j) belongs to the body if (x, y) = (j, i) lies in the projection of one of its limbs,
    the convex hull of two discs or a rectangle. A limb is cut off where it comes nearer than `near`; a
    body wholly behind a camera is an empty model there.

    Args:
        body: with `limbs(state)`, or `Limbs` [*B, ..., L] themselves, whose radii may differ from
            particle to particle ([*B, ..., L, 2]).
        state: [*B, ..., D]; None if `body` is `Limbs`.
        cameras: C of them, with images of the silhouettes' size.
        silhouettes: [*B, C, H, W], True on the person, or `prepare_silhouettes` of them. Without
            leading dimensions they are shared by all states.
        chunk: particles at a time; chosen by the size of the images if None (some 10 MB).
        near: metres.
        limb_shape: "cylinders", tapered and with round ends, or "rectangles" (AS, section 3.2).

    Returns:
        `SilhouetteCounts`, each [*B, ..., C].

    Raises:
        CameraError: the silhouettes are of another number of cameras, or of another size.
        ShapeError: their leading dimensions do not fit those of the states.
        InputError: `chunk` or `near` is not positive, or another `limb_shape`.
    """
    check_limb_shape(limb_shape)
    rig, limbs = as_rig(cameras), _limbs_of(body, state, near)
    silhouettes = prepare_silhouettes(silhouettes)
    rig.check_images("silhouettes", silhouettes.shape)
    batch = tuple(limbs.start.shape[:-2])
    shared = silhouettes.leading(batch, "states")
    flat = flatten_limbs(limbs)
    n, strip = len(flat.start), Strip(*silhouettes.shape)
    before = silhouettes.before.to(flat.start.device)
    which = which_silhouette(n, math.prod(shared), before)
    counts = torch.zeros(2, n, strip.cameras, dtype=torch.int64, device=flat.start.device)

    def count(items: slice) -> None:
        intervals = intervals_of(flat, items, rig, strip, near, limb_shape)
        offset = None if which is None else which[items]
        counts[:, items] = count_intervals(intervals, before.view(-1), offset, strip)

    in_chunks(count, flat, strip, chunk)
    model, overlap = counts.view(2, *batch, strip.cameras)
    area = silhouettes.area.to(model.device)
    area = area.view(*shared, *[1] * (len(batch) - len(shared)), -1).expand_as(model)
    return SilhouetteCounts(model, overlap, area)


def render(
    body: HasLimbs,
    state: Tensor,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    near: float = NEAR,
    limb_shape: str = "cylinders",
) -> Bool[Tensor, "*batch C H W"]:
    """Render silhouettes of bodies in every camera, exactly the pixels that `count_pixels` counts.

    Args:
        body: with `limbs(state)`.
        state: [..., D].
        cameras: C of them, with images of this size.
        height, width: pixels.
        near: metres; nearer parts of a limb are cut off. limb_shape: as `count_pixels`.

    Returns:
        [..., C, H, W], True on the body.

    Raises:
        CameraError: the cameras have images of another size.
        InputError: a side or `near` is not positive, or another `limb_shape`.
    """
    limbs = _limbs_of(body, state, near)
    return render_limbs(limbs, cameras, height, width, near=near, limb_shape=limb_shape)


def render_limbs(
    limbs: Limbs,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    near: float = NEAR,
    limb_shape: str = "cylinders",
) -> Bool[Tensor, "*batch C H W"]:
    """Render silhouettes of limbs [..., L] in every camera, as `render`.

    >>> from torchpose.camera import PinholeCamera
    >>> ball = torch.tensor([[0.0, 0.0, 2.0]])
    >>> limbs = Limbs(ball, ball, torch.tensor([[0.1, 0.1]]))
    >>> render_limbs(limbs, PinholeCamera(40, 40, 2, 2), 5, 5)[0].int()
    tensor([[0, 0, 1, 0, 0],
            [0, 1, 1, 1, 0],
            [1, 1, 1, 1, 1],
            [0, 1, 1, 1, 0],
            [0, 0, 1, 0, 0]], dtype=torch.int32)
    """
    check_limb_shape(limb_shape)
    rig, limbs = as_rig(cameras), checked_limbs(limbs, near)
    if height < 1 or width < 1:
        raise InputError(f"an image needs positive sides in pixels, got {height} x {width}")
    rig.check_images("silhouettes", (len(rig), height, width))
    flat, strip = flatten_limbs(limbs), Strip(len(rig), int(height), int(width))
    device = flat.start.device
    images = torch.empty(len(flat.start), strip.pixels, dtype=torch.bool, device=device)

    def paint(items: slice) -> None:
        intervals = intervals_of(flat, items, rig, strip, near, limb_shape)
        images[items] = _painted(intervals, strip)

    in_chunks(paint, flat, strip, max(_PIXELS // strip.pixels, 1))
    return images.view(*limbs.start.shape[:-2], *strip)


# --- helpers --------------------------------------------------------------------------------------


def _limbs_of(body: HasLimbs | Limbs, state: Tensor | None, near: float) -> Limbs:
    if isinstance(body, Limbs) != (state is None):
        raise InputError("state must be given with a body, and be None with Limbs")
    limbs = body if isinstance(body, Limbs) else body.limbs(state)  # type: ignore[arg-type]
    return checked_limbs(limbs, near)


def _painted(intervals: RowIntervals, strip: Strip) -> Bool[Tensor, "N P"]:
    """Paint disjoint intervals: +1 where one starts, -1 where it stops, summed up."""
    n, size = len(intervals.per_image), strip.pixels + 1
    filled = intervals.start < intervals.stop
    start, stop = (
        (x >> strip.bits) * size + (x & ((1 << strip.bits) - 1))
        for x in (intervals.start[filled].long(), intervals.stop[filled].long())
    )
    edges = torch.zeros(n * size, dtype=torch.int8, device=start.device)
    edges[start] = 1
    edges[stop] -= 1  # an interval may start where another one stops
    return (edges.view(n, size).cumsum(-1, dtype=torch.int8) > 0)[:, :-1]
