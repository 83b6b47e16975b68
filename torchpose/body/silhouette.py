"""Silhouettes of many bodies in many cameras: rendered, or only counted against observed ones.

Both rest on intervals of rows (`torchpose.body.row_intervals`): exact, and without a loop over
particles, cameras or limbs. Counting never forms an image.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.body.limb_outlines import NEAR, outline, project_limbs
from torchpose.body.limbs import Limbs, check_limbs
from torchpose.body.row_intervals import RowIntervals, Strip, limb_intervals
from torchpose.camera_rig import CameraRig, Cameras, as_rig
from torchpose.errors import InputError, ShapeError

__all__ = [
    "HasLimbs",
    "PreparedSilhouettes",
    "SilhouetteCounts",
    "count_pixels",
    "prepare_silhouettes",
    "render",
    "render_limbs",
]

# Intervals in one chunk: with fewer the overhead of calls shows, with more only the memory grows.
_INTERVALS, _INTERVALS_GPU = 2**17, 2**22
_KEPT = 2**25 - 2**16  # bytes; glibc adapts to freed blocks of at most 32 MB
_PIXELS = 2**22  # rendered in one chunk
_POOL = Lock()
_COVERED_ROWS = 0.15  # of an image's height, by a limb on average; a guess that sizes chunks


@runtime_checkable
class HasLimbs(Protocol):
    """Anything that knows where its limbs are, such as `Body`."""

    def limbs(self, state: Tensor) -> Limbs:
        """Limbs [..., L] of states [..., D]."""
        ...


class SilhouetteCounts(NamedTuple):
    """Numbers of pixels for each hypothesis and camera.

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


def prepare_silhouettes(silhouettes: Tensor) -> PreparedSilhouettes:
    """Running sums of silhouettes along their rows.

    Args:
        silhouettes: [*B, C, H, W], True (or not zero) on the person.

    Raises:
        ShapeError: fewer than three dimensions, or an image without pixels.
    """
    if silhouettes.ndim < 3 or 0 in silhouettes.shape[-3:]:
        raise ShapeError(
            f"silhouettes must have shape [..., C, H, W], got {list(silhouettes.shape)}"
        )
    cameras, height, width = silhouettes.shape[-3:]
    mask = silhouettes if silhouettes.dtype == torch.bool else silhouettes != 0
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
) -> SilhouetteCounts:
    """Pixels of the projected body, of the silhouette, and of both, for every particle and camera.

    Pixel (i, j) belongs to the body if (x, y) = (j, i) lies in the projection of one of its limbs,
    the convex hull of two discs. A limb is cut off where it comes nearer than `near`; a body wholly
    behind a camera is an empty model there.

    Args:
        body: with `limbs(state)`, or `Limbs` [*B, ..., L] themselves, whose radii may differ from
            particle to particle ([*B, ..., L, 2]).
        state: [*B, ..., D]; None if `body` is `Limbs`.
        cameras: C of them, with images of the silhouettes' size.
        silhouettes: [*B, C, H, W], True on the person, or `prepare_silhouettes` of them. Without
            leading dimensions they are shared by all states.
        chunk: particles at a time; chosen by the size of the images if None (some 10 MB).
        near: metres.

    Returns:
        `SilhouetteCounts`, each [*B, ..., C].

    Raises:
        CameraError: the silhouettes are of another number of cameras, or of another size.
        ShapeError: their leading dimensions do not fit those of the states.
        InputError: `chunk` or `near` is not positive.
    """
    rig, limbs = as_rig(cameras), _limbs_of(body, state, near)
    if not isinstance(silhouettes, PreparedSilhouettes):
        silhouettes = prepare_silhouettes(silhouettes)
    rig.check_images("silhouettes", silhouettes.shape)
    batch = tuple(limbs.start.shape[:-2])
    shared = tuple(silhouettes.area.shape[:-1])
    if batch[: len(shared)] != shared:
        raise ShapeError(
            f"silhouettes must have the leading dimensions of the states, [{list(batch)}] or the "
            f"first of them, got {list(shared)} before [C, H, W]"
        )
    flat = _flattened(limbs)
    n, strip = len(flat.start), Strip(*silhouettes.shape)
    before = silhouettes.before.to(flat.start.device)
    which = _which_silhouette(n, math.prod(shared), before)
    counts = torch.zeros(2, n, strip.cameras, dtype=torch.int64, device=flat.start.device)

    def count(items: slice) -> None:
        intervals = _intervals(flat, items, rig, strip, near)
        offset = None if which is None else which[items]
        counts[:, items] = _sums(intervals, before.view(-1), offset, strip)

    _in_chunks(count, flat, strip, chunk)
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
) -> Bool[Tensor, "*batch C H W"]:
    """Silhouettes of bodies in every camera, exactly the pixels that `count_pixels` counts.

    Args:
        body: with `limbs(state)`.
        state: [..., D].
        cameras: C of them, with images of this size.
        height, width: pixels.
        near: metres; nearer parts of a limb are cut off.

    Returns:
        [..., C, H, W], True on the body.

    Raises:
        CameraError: the cameras have images of another size.
        InputError: a side or `near` is not positive.
    """
    return render_limbs(_limbs_of(body, state, near), cameras, height, width, near=near)


def render_limbs(
    limbs: Limbs, cameras: Cameras, height: int, width: int, *, near: float = NEAR
) -> Bool[Tensor, "*batch C H W"]:
    """Silhouettes of limbs [..., L] in every camera, as `render`.

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
    rig, limbs = as_rig(cameras), _limbs_of(limbs, None, near)
    if height < 1 or width < 1:
        raise InputError(f"an image needs positive sides in pixels, got {height} x {width}")
    rig.check_images("silhouettes", (len(rig), height, width))
    flat, strip = _flattened(limbs), Strip(len(rig), int(height), int(width))
    device = flat.start.device
    images = torch.empty(len(flat.start), strip.pixels, dtype=torch.bool, device=device)

    def paint(items: slice) -> None:
        images[items] = _painted(_intervals(flat, items, rig, strip, near), strip)

    _in_chunks(paint, flat, strip, max(_PIXELS // strip.pixels, 1))
    return images.view(*limbs.start.shape[:-2], *strip)


# --- helpers --------------------------------------------------------------------------------------


def _limbs_of(body: HasLimbs | Limbs, state: Tensor | None, near: float) -> Limbs:
    if not 0 < near < math.inf:
        raise InputError(f"near must be a positive number of metres, got {near}")
    if isinstance(body, Limbs) != (state is None):
        raise InputError("state must be given with a body, and be None with Limbs")
    limbs = body if isinstance(body, Limbs) else body.limbs(state)  # type: ignore[arg-type]
    check_limbs(limbs)
    return Limbs(*(part.detach() for part in limbs))


def _flattened(limbs: Limbs) -> Limbs:
    """Limbs [N, L] with radii [L, 2] or [N, L, 2]."""
    start, end, radii = limbs
    shape = math.prod(start.shape[:-2]), start.shape[-2]
    if radii.ndim > 2:
        radii = radii.expand(*start.shape[:-1], 2).reshape(*shape, 2)
    return Limbs(start.reshape(*shape, 3), end.reshape(*shape, 3), radii)


def _which_silhouette(n_items: int, n_silhouettes: int, before: Tensor) -> Tensor | None:
    """Where each item's running sums begin [N]; None if all share one silhouette."""
    if n_silhouettes <= 1:
        return None
    begin = torch.arange(n_silhouettes, device=before.device) * before.shape[-1]
    return begin.repeat_interleave(n_items // n_silhouettes)


def _intervals(
    limbs: Limbs, items: slice, rig: CameraRig, strip: Strip, near: float
) -> RowIntervals:
    radii = limbs.radii if limbs.radii.ndim == 2 else limbs.radii[items]
    some = Limbs(limbs.start[items], limbs.end[items], radii)
    outlines = outline(project_limbs(some, rig, near), strip.height, strip.width)
    return limb_intervals(outlines, len(some.start), strip)


def _sums(
    intervals: RowIntervals, before: Tensor, begin: Tensor | None, strip: Strip
) -> Int[Tensor, "2 N C"]:
    """Covered pixels, and those of them in the silhouette, of each item and camera."""
    place = (1 << strip.bits) - 1
    start, stop = intervals.start & place, intervals.stop & place
    model = stop - start
    if begin is not None:
        shift = begin.index_select(0, intervals.start >> strip.bits)
        start, stop = start + shift, stop + shift
    overlap = before.index_select(0, stop).sub_(before.index_select(0, start))
    ends = intervals.per_image.flatten().cumsum(0)
    sums = torch.stack([x.cumsum(0, dtype=torch.int64) for x in (model, overlap)])
    totals = pad(sums, (1, 0))[:, pad(ends, (1, 0))].diff(dim=-1)
    return totals.view(2, *intervals.per_image.shape)


def _painted(intervals: RowIntervals, strip: Strip) -> Bool[Tensor, "N P"]:
    """Images of disjoint intervals: +1 where one starts, -1 where it stops, summed up."""
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


def _in_chunks(
    work: Callable[[slice], None], limbs: Limbs, strip: Strip, chunk: int | None
) -> None:
    """Call `work` on slices of the items, by as many threads as torch may use."""
    n, n_limbs = limbs.start.shape[:2]
    on_cpu = limbs.start.device.type == "cpu"
    threads = torch.get_num_threads() if on_cpu else 1
    if chunk is None:
        intervals = _INTERVALS if on_cpu else _INTERVALS_GPU
        per_item = strip.cameras * max(n_limbs, 1) * (_COVERED_ROWS * strip.height + 4)
        chunk = max(min(round(intervals / per_item), -(-n // threads)), 1)
    if chunk < 1:
        raise InputError(f"chunk must be 1 or more, got {chunk}")
    slices = [slice(i, min(i + chunk, n)) for i in range(0, n, chunk)]
    _keep_freed_memory()

    def run(items: slice) -> None:
        with torch.inference_mode():  # it holds for one thread only
            work(items)

    threads = min(threads, len(slices))
    if threads < 2 or not _POOL.acquire(blocking=False):  # another thread has the cores already
        for items in slices:
            run(items)
        return
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)  # so that the workers' operations do not ask for more threads
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, slices))
    finally:
        torch.set_num_threads(before)
        _POOL.release()


def _keep_freed_memory() -> None:
    """Have glibc keep the temporaries of a chunk for the next one.

    By default it returns blocks of 128 KB and more to the system, and the pages of every temporary
    are faulted in anew, which can take more time than the arithmetic. Once a block of 32 MB has been
    freed (never touched, so it costs nothing) up to 64 MB are kept. Other allocators do not mind.
    """
    torch.empty(_KEPT, dtype=torch.uint8)
