"""Hold arms that are hidden where they were last seen, as keypoints that are less sure."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import index_tensor
from torchpose._core.rows import in_frames, last_known, where_rows
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._measured_joints import MeasuredJoints

_LONGEST = 1.0 + 1e-6  # seconds; those of frames, added up, may be more by rounding
_NOISE = 9.0  # factor on R
# Metres per second along every axis, of shoulders, elbows and hands that are hidden, and seconds after which
# the standard deviation of how far they have moved grows no more.
_SPEEDS, _TIME = (0.25, 0.55, 1.0), 0.7
_BESIDE = 0.5  # factor on the speed of hands whose elbow is measured
_NEVER = 1e6  # seconds
_NECK = UPPER_BODY.index("neck")
_ARMS = tuple(
    UPPER_BODY.index(f"{joint}_{side}")
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "hand")
)


class LastSeen(NamedTuple):
    """Shoulder, elbow and hand of both arms when they were last measured.

    Attributes:
        places: pixels, [B, 2, 3, 2]. starts: those of neck, shoulder and elbow in the same frames, NaN where
            they were not measured.
        cov: R, [B, 2, 3, 2, 2]. time: seconds since then, [B, 2, 3]; a million of what never was.
    """

    places: Tensor
    starts: Tensor
    cov: Tensor
    time: Tensor

    @classmethod
    def never(cls, measured: MeasuredJoints) -> Self:
        """Return that of arms of which nothing was measured before."""
        nothing = measured.uv.new_zeros(len(measured.uv), 2, 3, 2, 2)
        places, times = nothing[..., 0], nothing[..., 0, 0]
        return cls(places, places * torch.nan, nothing, times + _NEVER)


class Held(NamedTuple):
    """Measurements with arms that are held.

    Attributes:
        measured: the measurements.
        moved: the variance along every axis, metres squared, of how far elbows of hidden arms and hidden
            hands have moved since they were seen, [B, T, 2, 2]; None where all hands are measured.
        last: where arms were last seen, for the next frame.
    """

    measured: MeasuredJoints
    moved: Tensor | None
    last: LastSeen


def hold_hidden(measured: MeasuredJoints, last: LastSeen | None, rate: float) -> Held:
    """Return measurements in which hidden arms are held for up to a second.

    An arm is hidden where neither elbow nor hand is measured. Its elbow, its hand, and its shoulder if that
    is missing too, are put at

        z = z_0 + p - p_0

    z_0 is the place at which the joint was last measured. p_0 and p are the places, then and now, of the
    joint from which its bone starts: the neck of a shoulder, the shoulder of an elbow, the elbow of a hand.
    Where one of them is not known, z = z_0. R is 9 times that of the frame in which the joint was measured.
    As people move on, the standard deviation along every axis grows with the seconds t since then, for
    longer than a second too:

        s = v t / (1 + (t / T)^2)

    A hand that is rather outside of the image is not held. Nor is one whose elbow is measured, which tells of
    it too; its s is half of this.

    Args:
        measured: T more frames. last: where arms were last seen; None before the first frame.
        rate: frames per second.
    """
    known, places = _of_arms(measured.mask), _of_arms(measured.uv)
    now = LastSeen(
        places,
        _starts(measured),
        _of_arms(measured.cov_of_frames),
        torch.zeros_like(places[..., 0]),
    )
    before = LastSeen.never(measured) if last is None else last
    seen = _last_seen(now, known, before, rate)
    last = LastSeen(*(values[:, -1] for values in seen))
    gone = ~known[..., 1:]
    if not bool(gone[..., 1].any()):
        return Held(measured, None, last)
    hidden = gone.all(-1, keepdim=True)
    held = ~known & hidden & (seen.time <= _LONGEST)
    if measured.absence is not None:
        held[..., 2] &= measured.absence.log_inside >= 0
    variance = _variance(seen.time)
    filled = _filled(measured, held, seen._replace(places=_places(now, seen, held)), variance)
    share = torch.where(hidden, 1.0, variance.new_tensor([0.0, _BESIDE**2]))
    return Held(filled, variance[..., 1:] * share * gone, last)


def _of_arms(values: Tensor) -> Tensor:
    """Return values of all joints, [B, T, 8, ...], as those of both arms, [B, T, 2, 3, ...]."""
    return values.index_select(2, index_tensor(_ARMS, values.device)).unflatten(2, (2, 3))


def _starts(measured: MeasuredJoints) -> Float[Tensor, "B T 2 3 2"]:
    """Return the places of neck, shoulders and elbows, NaN where they are not measured."""
    places = torch.where(measured.mask[..., None], measured.uv, torch.nan)
    neck = places[:, :, None, None, _NECK].expand(-1, -1, 2, 1, -1)
    return torch.cat([neck, _of_arms(places)[..., :-1, :]], -2)


def _last_seen(
    now: LastSeen, known: Bool[Tensor, "B T 2 3"], before: LastSeen, rate: float
) -> LastSeen:
    """Return where arms were last seen in each of T frames, [B, T, 2, 3, ...].

    Args:
        now: what is measured in each frame. known: whether it is. before: where arms were last seen before
            the first frame. rate: frames per second.
    """
    if known.shape[1] == 1:
        older = before._replace(time=before.time + 1 / rate)
        return where_rows(known, now, LastSeen(*(values[:, None] for values in older)))
    found = last_known(known)
    kept = LastSeen(*(in_frames(found, *pair) for pair in zip(before, now, strict=True)))
    frames = torch.arange(1, known.shape[1] + 1, device=known.device)[:, None, None]
    return kept._replace(time=kept.time + (frames - found).to(kept.time) / rate)


def _places(
    now: LastSeen, seen: LastSeen, held: Bool[Tensor, "B T 2 3"]
) -> Float[Tensor, "B T 2 3 2"]:
    """Return the places of shoulders, elbows and hands, moved along with the joints before them."""
    found: list[Tensor] = []
    for joint in range(3):
        start = now.starts[..., joint, :]
        if found:
            start = torch.where(held[..., joint - 1, None], found[-1], start)
        place = seen.places[..., joint, :]
        moved = place + (start - seen.starts[..., joint, :])
        found.append(torch.where(moved.isfinite(), moved, place))
    return torch.stack(found, -2)


def _variance(time: Float[Tensor, "B T 2 3"]) -> Float[Tensor, "B T 2 3"]:
    """Return the variance along every axis of how far joints have moved in a time, metres squared."""
    far = time / (1 + (time / _TIME).square())
    return (far * far.new_tensor(_SPEEDS)).square()


def _filled(
    measured: MeasuredJoints,
    held: Bool[Tensor, "B T 2 3"],
    seen: LastSeen,
    variance: Float[Tensor, "B T 2 3"],
) -> MeasuredJoints:
    """Return measurements with the joints that are held, which do not count as seen."""
    rows = index_tensor(_ARMS, held.device)

    def put(whole: Tensor, own: Tensor) -> Tensor:
        chosen = held.view(*held.shape, *[1] * (own.ndim - held.ndim))
        return whole.index_copy(2, rows, torch.where(chosen, own, _of_arms(whole)).flatten(2, 3))

    bridged = measured.bridged
    return measured._replace(
        uv=put(measured.uv, seen.places),
        mask=put(measured.mask, held),
        cov=put(measured.cov_of_frames, _NOISE * seen.cov),
        bridged=put(
            torch.zeros_like(measured.uv[..., 0]) if bridged is None else bridged, variance
        ),
    )
