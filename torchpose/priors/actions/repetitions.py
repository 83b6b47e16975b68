"""Where a recording of somebody who does the same thing again and again falls into performances."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError, check_finite, check_shape

__all__ = ["repetition_axis", "split_repetitions"]

_SMOOTH = 0.12  # seconds, standard deviation of the smoothing
_AWAY, _BACK = 0.75, 0.6  # of the way from one end of the motion to the other
_ENDS = (0.1, 0.9)  # quantiles that stand for the two ends


def split_repetitions(
    postures: Float[Tensor, "T Q"], fps: float, axis: Float[Tensor, " Q"] | None = None
) -> list[slice]:
    """Frames of every repetition, from where the motion is nearest to its start to where it is again.

    The motion is s, the recording along an axis, smoothed, with its two ends (the 10 and 90 %
    quantiles) at 0 and 1. It is away once s passes 0.75 and back once it falls below 0.6. A performance
    begins and ends where s is least between two times away; the first begins, and the last ends, as long
    from its middle as it takes on its other side, so that getting ready is left out.

    Args:
        postures: [T, Q], or any other columns that show the motion, finite.
        fps: frames per second.
        axis: [Q], of the motion, from the end where a performance starts; `repetition_axis` finds one
            for several recordings, which are then cut alike. By default the first principal axis of
            this recording.

    Returns:
        A slice of frames for each repetition, one after the other; all frames as one if the motion
        is away once only.

    Raises:
        InputError: no frames, not finite, or a frame rate that is not positive.

    >>> angle = torch.arange(300) * (2 * math.pi / 100)
    >>> split_repetitions(1 - angle.cos()[:, None], 30.0)
    [slice(4, 101, None), slice(100, 201, None), slice(200, 300, None)]
    """
    check_shape("postures", postures, ["T", None])
    if not 0 < fps < math.inf or len(postures) == 0:
        raise InputError(
            f"expected frames at a positive rate, got {len(postures)} frames at {fps:g} per second"
        )
    check_finite("postures", postures)
    axis = repetition_axis([postures]) if axis is None else axis.to(postures)
    s = _motion((postures @ axis).double(), fps)
    away = _hysteresis(s)
    change = away.long().diff(prepend=away.new_zeros(1).long(), append=away.new_zeros(1).long())
    starts, stops = (torch.nonzero(change == sign).flatten().tolist() for sign in (1, -1))
    if len(starts) < 2:
        return [slice(0, len(s))]
    gaps = zip(stops[:-1], starts[1:], strict=True)
    cuts = [stop + int(s[stop:start].argmin()) for stop, start in gaps]
    first = starts[0] + stops[0] - 1 - cuts[0]  # mirrored at the middle of the time away
    last = starts[-1] + stops[-1] - 1 - cuts[-1]
    cuts = [max(first, 0), *cuts, min(last, len(s) - 1)]
    return [slice(a, b + 1) for a, b in pairwise(cuts)]


def repetition_axis(recordings: Sequence[Float[Tensor, "_ Q"]]) -> Float[Tensor, " Q"]:
    """The first principal axis of recordings, pointing away from where they start.

    Args:
        recordings: [T_r, Q] each, of one action, finite.

    Raises:
        InputError: no recording, one without frames, or not finite. ShapeError: other columns.
    """
    if not recordings or not all(map(len, recordings)):
        raise InputError("an axis needs recordings with at least one frame each, got one of none")
    for number, recording in enumerate(recordings):
        check_shape(f"recording {number}", recording, ["T", recordings[0].shape[-1]])
        check_finite(f"recording {number}", recording)
    postures = torch.cat([r.double() for r in recordings])
    middle = postures.mean(0)
    axis = torch.linalg.eigh((postures - middle).mT @ (postures - middle))[1][:, -1]
    starts = torch.stack([r[0].double() for r in recordings]) - middle
    axis = axis if float((starts @ axis).mean()) < 0 else -axis
    return axis.to(recordings[0])


def _motion(s: Tensor, fps: float) -> Tensor:
    """The motion along the axis [T], smoothed; 0 at one end, 1 at the other."""
    reach = max(1, round(3 * _SMOOTH * fps))
    offset = torch.arange(-reach, reach + 1).to(s) / (_SMOOTH * fps)
    kernel = torch.softmax(-0.5 * offset.square(), 0)
    padded = torch.cat([s[:1].expand(reach), s, s[-1:].expand(reach)])
    s = torch.nn.functional.conv1d(padded[None, None], kernel[None, None])[0, 0]
    low, high = torch.quantile(s, s.new_tensor(_ENDS))
    return (s - low) / (high - low).clamp_min(1e-9)


def _hysteresis(s: Tensor) -> Tensor:
    """Whether s is away [T]: from where it passes 0.75 until it falls below 0.6."""
    mark = (s > _AWAY).long() - (s < _BACK).long()
    frames = torch.arange(len(s), device=s.device)
    told = torch.where(mark != 0, frames, torch.zeros_like(frames)).cummax(0).values
    return mark[told] > 0
