"""Put keypoints into gaps, between what is measured before and after them, before poses are found."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.filters._lengths import inside_lengths
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._articulated_frame import ELBOWS, HANDS, SHOULDERS
from torchpose.upper_body._face_points import FacePoints
from torchpose.upper_body._lifted_arms import BodyPoints
from torchpose.upper_body._measured_joints import MeasuredJoints, MiddlePoint

_LONGEST = 2.0  # seconds between the measurements before and after a gap
_NOISE = 9.0  # factor on R of keypoints in gaps
_SURE = 0.5  # confidence of these, of the face and for the network that lifts bones
# Metres per second^1.5 along every axis: how far hands and elbows are from the line of their arm, others
# from the straight line.
_HAND_MOVES, _ELBOW_MOVES, _OTHERS_MOVE = 1.2, 0.7, 0.25


class _Gaps(NamedTuple):
    """Gaps of keypoints, [B, T, J].

    Attributes:
        inside: whether a keypoint is missing between two that are measured.
        before, after: the frames of these; any frame elsewhere.
        share: w, how far on the way from one to the other it is, 0 elsewhere.
        time: t_1 t_2 / (t_1 + t_2)^0.5 of the seconds from one and to the other, 0 elsewhere.
    """

    inside: Tensor
    before: Tensor
    after: Tensor
    share: Tensor
    time: Tensor

    def of(self, joints: slice) -> _Gaps:
        """Return the gaps of some of the keypoints."""
        return _Gaps(*(values[..., joints] for values in self))


def bridged_over_gaps(
    measured: MeasuredJoints, lengths: Int[Tensor, " B"] | None, rate: float
) -> MeasuredJoints:
    """Return the measurements with keypoints in gaps of up to two seconds.

    Between the measurements z_1, t_1 before a frame, and z_2, t_2 after it, a missing keypoint is put at

        z = p + (1 - w) (z_1 - p_1) + w (z_2 - p_2),   w = t_1 / (t_1 + t_2),

    where p is the joint from which its bone starts: the shoulder of an elbow, the elbow of a hand; where p
    is missing as well, and for other joints, p = 0. Its R is 9 times that of both, so that it counts less
    than what is measured. As movements bend, it is off by more, with the variance

        s^2 t_1^2 t_2^2 / (t_1 + t_2)

    along every axis in space (that of the integral of a random walk between two places), which `bridged`
    holds for the covariances of joints. Hands that are rather outside of the image stay missing.

    Args:
        measured: the measurements of whole sequences. lengths: the number of frames of each, [B]; None is
            all. rate: frames per second.
    """
    inside = torch.ones_like(measured.mask[..., :1])
    if lengths is not None:
        inside = inside_lengths(lengths.to(inside.device), inside.shape[1])[..., None]
    gaps = _find_gaps(measured.mask & inside, rate)
    if measured.absence is not None:
        gaps.inside[..., HANDS] &= measured.absence.log_inside >= 0
    if not bool(gaps.inside.any()):
        return measured
    middle, body, face = measured.middle, measured.body, measured.face
    return measured._replace(
        uv=_bridged_places(measured, gaps),
        mask=measured.mask | gaps.inside,
        cov=_filled(measured.cov_of_frames, gaps, _NOISE),
        middle=None if middle is None else _bridged_middle(middle, inside[..., 0], rate),
        body=None if body is None else _bridged_points(body, inside, rate),
        face=None if face is None else _bridged_points(face, inside, rate),
        bridged=(_moves(measured.uv) * gaps.time).square() * gaps.inside,
    )


def _find_gaps(there: Bool[Tensor, "B T J"], rate: float) -> _Gaps:
    """Return the gaps between keypoints that are there."""
    n_frames = there.shape[1]
    frames = torch.arange(n_frames, device=there.device)[:, None]
    before = frames.where(there, -1).cummax(1).values
    after = frames.where(there, n_frames).flip(1).cummin(1).values.flip(1)
    inside = ~there & (before >= 0) & (after < n_frames)
    inside &= after - before <= round(_LONGEST * rate)
    since, until = (
        (x.double() / rate).masked_fill(~inside, 0.0) for x in (frames - before, after - frames)
    )
    between = (since + until).masked_fill(~inside, 1.0)
    last = n_frames - 1
    return _Gaps(
        inside, before.clamp_min(0), after.clamp_max(last), since / between,
        since * until / between.sqrt(),
    )  # fmt: skip


def _on_the_way(values: Float[Tensor, "B T J *rest"], gaps: _Gaps) -> Float[Tensor, "B T J *rest"]:
    """Return values on the straight line between those before and after each gap."""
    shape = *gaps.inside.shape, *[1] * (values.ndim - 3)
    first, second = (
        values.gather(1, frames.view(shape).expand_as(values))
        for frames in (gaps.before, gaps.after)
    )
    return first.lerp(second, gaps.share.to(values).view(shape))


def _filled(
    values: Float[Tensor, "B T J *rest"], gaps: _Gaps, factor: float = 1.0
) -> Float[Tensor, "B T J *rest"]:
    """Return values with those in gaps on the way between both ends, times a factor."""
    inside = gaps.inside.view(*gaps.inside.shape, *[1] * (values.ndim - 3))
    return torch.where(inside, factor * _on_the_way(values, gaps), values)


def _bridged_places(measured: MeasuredJoints, gaps: _Gaps) -> Float[Tensor, "B T 8 2"]:
    """Return the keypoints, with those in gaps relative to the joint from which their bone starts."""
    places, known = _filled(measured.uv, gaps), measured.mask | gaps.inside
    for near, far in ((SHOULDERS, ELBOWS), (ELBOWS, HANDS)):
        start = places[..., near, :].where(known[..., near, None], torch.nan)
        ends = start + _on_the_way(places[..., far, :] - start, gaps.of(far))
        there = gaps.inside[..., far, None] & ends.isfinite()
        places[..., far, :] = torch.where(there, ends, places[..., far, :])
    return places


def _bridged_middle(middle: MiddlePoint, inside: Bool[Tensor, "B T"], rate: float) -> MiddlePoint:
    """Return the middle of the shoulders, in gaps too."""
    gaps = _find_gaps((middle.mask & inside)[..., None], rate)
    cov = middle.cov.expand(*middle.mask.shape, 2, 2)[:, :, None]
    return MiddlePoint(
        _filled(middle.uv[:, :, None], gaps)[:, :, 0],
        middle.mask | gaps.inside[..., 0],
        _filled(cov, gaps, _NOISE)[:, :, 0],
    )


_Points = TypeVar("_Points", BodyPoints, FacePoints)


def _bridged_points(points: _Points, inside: Bool[Tensor, "B T 1"], rate: float) -> _Points:
    """Return the keypoints of the whole body, or of the face, in gaps too."""
    gaps = _find_gaps((points.confidence > 0) & inside, rate)
    confidence = points.confidence.masked_fill(gaps.inside, _SURE)
    return points._replace(places=_filled(points.places, gaps), confidence=confidence)


def _moves(like: Tensor) -> Float[Tensor, " 8"]:
    """Return s of each joint."""
    moves = like.new_full((len(UPPER_BODY),), _OTHERS_MOVE)
    moves[HANDS], moves[ELBOWS] = _HAND_MOVES, _ELBOW_MOVES
    return moves
