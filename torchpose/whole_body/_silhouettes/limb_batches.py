"""Project limbs of many bodies into many cameras, chunk by chunk, for rendering and counting."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.body._limbs import Limbs, check_limbs
from torchpose.camera._rig import CameraRig
from torchpose.errors import InputError
from torchpose.whole_body._silhouettes.outlines import LIMB_SHAPES, project_limbs
from torchpose.whole_body._silhouettes.row_intervals import RowIntervals, Strip, limb_intervals

# Intervals in one chunk: with fewer the overhead of calls shows, with more only the memory grows.
_INTERVALS, _INTERVALS_GPU = 2**17, 2**22
_KEPT = 2**25 - 2**16  # bytes; glibc adapts to freed blocks of at most 32 MB
_POOL = Lock()
_COVERED_ROWS = 0.15  # of an image's height, by a limb on average; a guess that sizes chunks


def checked_limbs(limbs: Limbs, near: float) -> Limbs:
    """Return limbs without gradients; raise unless they fit together and `near` is a distance."""
    if not 0 < near < math.inf:
        raise InputError(f"near must be a positive number of metres, got {near}")
    check_limbs(limbs)
    return Limbs(*(part.detach() for part in limbs))


def flatten_limbs(limbs: Limbs) -> Limbs:
    """Return limbs [N, L] with radii [L, 2] or [N, L, 2]."""
    start, end, radii = limbs
    shape = math.prod(start.shape[:-2]), start.shape[-2]
    if radii.ndim > 2:
        radii = radii.expand(*start.shape[:-1], 2).reshape(*shape, 2)
    return Limbs(start.reshape(*shape, 3), end.reshape(*shape, 3), radii)


def which_silhouette(n_items: int, n_silhouettes: int, before: Tensor) -> Tensor | None:
    """Return the start of each item's running sums [N]; None if all share one silhouette."""
    if n_silhouettes <= 1:
        return None
    begin = torch.arange(n_silhouettes, device=before.device) * before.shape[-1]
    return begin.repeat_interleave(n_items // n_silhouettes)


def intervals_of(
    limbs: Limbs, items: slice, rig: CameraRig, strip: Strip, near: float, limb_shape: str
) -> RowIntervals:
    """Return the disjoint intervals that some of the items [N, L] cover in every camera."""
    radii = limbs.radii if limbs.radii.ndim == 2 else limbs.radii[items]
    some = Limbs(limbs.start[items], limbs.end[items], radii)
    outlines = LIMB_SHAPES[limb_shape](project_limbs(some, rig, near), strip.height, strip.width)
    return limb_intervals(outlines, len(some.start), strip)


def count_intervals(
    intervals: RowIntervals, before: Tensor, begin: Tensor | None, strip: Strip
) -> Int[Tensor, "2 N C"]:
    """Count covered pixels, and those of them in the silhouette, of each item and camera."""
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


def in_chunks(work: Callable[[slice], None], limbs: Limbs, strip: Strip, chunk: int | None) -> None:
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
