"""Cut performances of one action out of recordings, and synchronise them by splines and key frames.

A key frame is a posture of the mean performance at an extremum of the distance from the mean posture.
The frames of a performance that are most like the key frames, in their order, define its timing. Between
two key frames every performance has the same number of postures (aSpace, section 2).
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape, check_tensors
from torchpose.errors import InputError
from torchpose.priors._actions.action_file import Synchronised

LEAST_FRAMES = 8
"""A performance has at least as many, and more than there are key frames."""

_SMOOTH = 0.12  # seconds, standard deviation of the smoothing
_AWAY, _BACK = 0.75, 0.6  # of the way from one end of the motion to the other
_ENDS = (0.1, 0.9)  # quantiles that stand for the two ends


def synchronise(
    performances: Sequence[Float[Tensor, "_ R"]],
    n_postures: int | None = None,
    prominence: float = 0.15,
) -> Synchronised:
    """Synchronise performances of one action.

    1. Each is resampled to K postures by a natural cubic spline; their mean is the mean performance.
    2. Key frames are the extrema of the mean performance's distance to the mean posture.
    3. Each performance has a frame for each key frame, the most similar ones in order in time.
    4. Time between two key frames is linear; the splines are resampled there.

    Args:
        performances: [T_p, R] each, in any columns; distances are Euclidean.
        n_postures: K; by default the median length.
        prominence: of an extremum, as a share of the range of the distance, see `find_key_frames`.

    Raises:
        InputError: no performance, one that is too short, NaN. ShapeError: other columns.
    """
    parts = checked_performances(performances)
    if n_postures is None:
        n_postures = int(torch.tensor([len(p) for p in parts]).median())
    if n_postures < LEAST_FRAMES:
        raise InputError(f"n_postures must be at least {LEAST_FRAMES}, got {n_postures}")
    steps = torch.linspace(0, 1, n_postures, dtype=torch.float64, device=parts[0].device)
    before = torch.stack([natural_spline(p, steps * (len(p) - 1)) for p in parts])
    mean = before.mean(0)
    keys = find_key_frames((mean - torch.cat(parts).mean(0)).norm(dim=-1), prominence)
    for number, part in enumerate(parts):
        if len(part) < len(keys):
            raise InputError(
                f"performance {number} has {len(part)} frames; with {len(keys)} key frames each needs "
                f"at least {len(keys)}; leave it out, or raise `prominence` for fewer key frames"
            )
    times = torch.stack([_times(match_key_frames(p, mean[list(keys)]), keys) for p in parts])
    times = times.to(mean)
    after = torch.stack([natural_spline(p, t) for p, t in zip(parts, times, strict=True)])
    return Synchronised(before, after, keys, times)


def checked_performances(performances: Sequence[Float[Tensor, "_ R"]]) -> list[Tensor]:
    """Return performances in double precision, if they can be synchronised.

    Raises:
        InputError: none at all, one that is too short, NaN. ShapeError: other columns than the first.
    """
    if not len(performances):
        raise InputError("expected performances of an action, got none")
    for number, part in enumerate(performances):
        check_tensors(**{f"performance {number}": part})
    columns = performances[0].shape[-1] if performances[0].ndim else 0
    for number, part in enumerate(performances):
        check_shape(f"performance {number}", part, ["T", columns])
        if len(part) < LEAST_FRAMES:
            raise InputError(
                f"performance {number} has {len(part)} frames, and key frames need at least "
                f"{LEAST_FRAMES}; leave it out, or record at a higher frame rate"
            )
        check_finite(f"performance {number}", part, hint="cut out the frames with gaps")
    return [part.detach().double() for part in performances]


def natural_spline(
    values: Float[Tensor, "T R"], times: Float[Tensor, " S"]
) -> Float[Tensor, "S R"]:
    """Interpolate values at the times 0, 1, ..., T - 1 by a natural cubic spline.

    Its second derivatives m solve m_(t-1) + 4 m_t + m_(t+1) = 6 (y_(t-1) - 2 y_t + y_(t+1)) with
    m_0 = m_(T-1) = 0.

    Args:
        values: y, [T, R], T at least 2. times: [S], within 0 to T - 1.

    >>> natural_spline(torch.arange(4.0)[:, None] ** 2, torch.tensor([1.0, 1.5]))
    tensor([[1.0000],
            [2.2000]])
    """
    check_shape("values", values, ["T", None])
    if len(values) < 2:
        raise InputError(f"a spline needs at least two frames, got {len(values)}")
    bend = torch.nn.functional.pad(_second_derivatives(values), (0, 0, 1, 1))
    at = times.long().clamp(0, len(values) - 2)
    b = (times - at)[:, None]
    a = 1 - b
    cubic = (a**3 - a) * bend[at] + (b**3 - b) * bend[at + 1]
    return a * values[at] + b * values[at + 1] + cubic / 6


def find_key_frames(distance: Float[Tensor, " K"], prominence: float = 0.15) -> tuple[int, ...]:
    """Find the first and last frame, and between them the prominent extrema of a curve.

    Maxima and minima alternate; two neighbours that differ by less than a share of the curve's range
    are removed, the smallest difference first.

    Args:
        distance: [K]. prominence: the share, between 0 and 1.

    >>> find_key_frames(torch.tensor([0.0, 2.0, 9.0, 8.9, 9.1, 3.0, 1.0, 4.0]))
    (0, 4, 6, 7)
    """
    check_shape("distance", distance, ["K"])
    if not 0 <= prominence <= 1:
        raise InputError(f"prominence must lie between 0 and 1, got {prominence:g}")
    slope = distance.diff().sign()
    moving = torch.nonzero(slope).flatten()  # where it rests, it turns when it moves on
    turns = moving[1:][slope[moving].diff() != 0]
    keys = [0, *turns.tolist(), len(distance) - 1]
    least = prominence * float(distance.max() - distance.min())
    heights = distance.tolist()
    while len(keys) > 2:
        apart = [abs(heights[b] - heights[a]) for a, b in pairwise(keys)]
        i = min(range(len(apart)), key=apart.__getitem__)
        if apart[i] >= least:
            break
        if i == 0:  # the first and the last frame stay
            del keys[1]
        elif i == len(apart) - 1:
            del keys[-2]
        else:
            del keys[i : i + 2]
    return tuple(keys)


def match_key_frames(
    performance: Float[Tensor, "T R"], key_postures: Float[Tensor, "n R"]
) -> list[int]:
    """Find the frames of a performance that are most like the key postures, in their order.

        argmin sum_i |phi_(t_i) - g_i|^2   over   0 = t_1 < t_2 < ... < t_n = T - 1

    by dynamic programming.

    Args:
        performance: [T, R]. key_postures: [n, R], 2 <= n <= T.

    Raises:
        InputError: fewer frames than key postures.
    """
    frames, count = len(performance), len(key_postures)
    if not 2 <= count <= frames:
        raise InputError(
            f"expected from 2 to {frames} key postures for {frames} frames, got {count}"
        )
    cost = torch.cdist(key_postures, performance).square()
    total = torch.full_like(cost[0], torch.inf)
    total[0] = cost[0, 0]
    came = []
    for row in cost[1:]:
        best, where = total[:-1].cummin(0)
        came.append(where)
        total = torch.cat([total.new_full((1,), torch.inf), row[1:] + best])
    found = [frames - 1]
    for where in reversed(came):
        found.append(int(where[found[-1] - 1]))
    return found[::-1]


def _second_derivatives(values: Tensor) -> Tensor:
    """Solve the tridiagonal system for second derivatives [T - 2, R]; the loop is over frames."""
    right = 6 * values.diff(n=2, dim=0)
    factor, rows = 0.0, []
    last = torch.zeros_like(values[0])
    factors = []
    for row in right:
        factor = 1 / (4 - factor)
        last = (row - last) * factor
        factors.append(factor)
        rows.append(last)
    found = torch.zeros_like(values[0])
    solved = []
    for factor, row in zip(reversed(factors), reversed(rows), strict=True):
        found = row - factor * found
        solved.append(found)
    return torch.stack(solved[::-1]) if solved else right


def _times(matched: Sequence[int], keys: Sequence[int]) -> Tensor:
    """Return the frames [K] of a performance for each posture, linear between key frames."""
    place, frames = torch.tensor(keys).double(), torch.tensor(matched).double()
    k = torch.arange(keys[-1] + 1, dtype=torch.float64)
    after = torch.searchsorted(place, k).clamp_min(1)
    share = (k - place[after - 1]) / (place[after] - place[after - 1])
    return frames[after - 1] + share * (frames[after] - frames[after - 1])


# --- repetitions of an action in a recording ------------------------------------------------------


def split_repetitions(
    postures: Float[Tensor, "T Q"], fps: float, axis: Float[Tensor, " Q"] | None = None
) -> list[slice]:
    """Find the frames of every repetition, from one return to the start of the motion to the next.

    The motion is s, the recording along an axis, smoothed, with its two ends (the 10 and 90 %
    quantiles) at 0 and 1. It is away once s passes 0.75 and back once it falls below 0.6. A performance
    begins and ends at the minimum of s between two times away. The first one begins, and the last one
    ends, symmetrically about its middle, so that preparations are left out.

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
        InputError: no frames, not finite, an axis of length zero, or a frame rate that is not positive.
            ShapeError: an axis of other columns.

    >>> angle = torch.arange(300) * (2 * math.pi / 100)
    >>> split_repetitions(1 - angle.cos()[:, None], 30.0)
    [slice(4, 101, None), slice(100, 201, None), slice(200, 300, None)]
    """
    check_tensors(postures=postures, axis=axis)
    check_shape("postures", postures, ["T", None])
    if axis is not None:
        check_shape("axis", axis, [postures.shape[1]])
        if not 0 < float(axis.norm()) < math.inf:
            raise InputError("axis must be a direction, got zero or what is not finite")
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
    """Return the first principal axis of recordings, pointing away from where they start.

    Args:
        recordings: [T_r, Q] each, of one action, finite.

    Returns:
        Unit vector [Q].

    Raises:
        InputError: no recording, one without frames, or not finite. ShapeError: other columns.
    """
    recordings = list(recordings)
    for number, recording in enumerate(recordings):
        check_tensors(**{f"recording {number}": recording})
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
    """Return the smoothed motion along the axis [T], 0 at one end and 1 at the other."""
    reach = max(1, round(3 * _SMOOTH * fps))
    offset = torch.arange(-reach, reach + 1).to(s) / (_SMOOTH * fps)
    kernel = torch.softmax(-0.5 * offset.square(), 0)
    padded = torch.cat([s[:1].expand(reach), s, s[-1:].expand(reach)])
    s = torch.nn.functional.conv1d(padded[None, None], kernel[None, None])[0, 0]
    low, high = torch.quantile(s, s.new_tensor(_ENDS))
    return (s - low) / (high - low).clamp_min(1e-9)


def _hysteresis(s: Tensor) -> Tensor:
    """Return whether s is away [T]: from where it passes 0.75 until it falls below 0.6."""
    mark = (s > _AWAY).long() - (s < _BACK).long()
    frames = torch.arange(len(s), device=s.device)
    latest = torch.where(mark != 0, frames, torch.zeros_like(frames)).cummax(0).values
    return mark[latest] > 0
