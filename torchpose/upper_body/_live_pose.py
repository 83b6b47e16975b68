"""Hold the state of live streams between two frames, and the poses of one frame."""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchpose._core.stream_settings import StreamSettings
from torchpose.errors import InputError
from torchpose.upper_body._fusion import MotionStageState
from torchpose.upper_body._picked import Picked
from torchpose.upper_body._pose_track import FRAME_FIELDS, PoseTrack
from torchpose.upper_body._screen_tracks import ScreenState


class StreamState(NamedTuple):
    """State of `UpperBodyTracker.step` between two frames.

    Attributes:
        estimator: the state of the method's estimator.
        motion: the state of the motion stage; None before the first frame, and where there is no stage.
        unseen: the number of frames since any joint was measured, [B].
        n_keypoints: J. picked: the places of the eight joints among them, and the assumptions.
        screen: state of the outlier screening; None without any.
        method: the name of the method whose state it is. settings: of the tracker whose state it is, as far
            as the numbers depend on them; None if they are not known.
        notes: what was assumed of the keypoints of the stream, as in `PoseTrack.notes`.
        away: the number of frames since any keypoint was given, [B]. first: the estimator's state before the
            first frame.
    """

    estimator: Any
    motion: MotionStageState | None
    unseen: Int[Tensor, " B"]
    n_keypoints: int
    picked: Picked
    screen: ScreenState | None = None
    method: str | None = None
    settings: StreamSettings | None = None
    notes: tuple[str, ...] = ()
    away: Tensor | None = None
    first: Any = None

    def anew(self) -> "StreamState":
        """Return the state before the first frame of the same streams; random generators go on."""
        return self._replace(estimator=self.first, motion=None, screen=None)


class LivePose(NamedTuple):
    """Holds the poses of one frame of B streams, under the names that `PoseTrack` has for all frames.

    A `PoseTrack` says with `failed_at` in which frame a filter degenerated; `failed` is here, as
    `PoseTrack.failed` is there, whether it has by now.

    Attributes:
        joints2d: [B, 8, 2], pixels of the camera; joints in the order of `UPPER_BODY`.
        joints3d: [B, 8, 3], metres, in the tracker's frame.
        covariance2d: [B, 8, 2, 2], pixels squared. covariance3d: [B, 8, 3, 3], metres squared, relative to
            the body; see `PoseTrack`.
        observed: [B, 8], True where the joint was measured in this frame, by no outlier.
        log_evidence: [B, 2], the increment of the left and of the right arm; see `PoseTrack`.
        effective_sample_size: [B, 2], that of the particles or tracks of each arm; see `PoseTrack`.
        unseen: [B], the time since any joint was measured, seconds; 0 where one is.
        failed: [B], True where the filter degenerated: poses are NaN until the stream begins anew, by `init`.
        inlier_probability: [B, 8], the probability that the keypoint of a joint is no outlier; see
            `PoseTrack`.
        bone_lengths: [B, 4], metres. bone_covariance: [B, 4, 4], metres squared; see `PoseTrack`.
    """

    joints2d: Tensor
    joints3d: Tensor
    covariance2d: Tensor
    covariance3d: Tensor
    observed: Tensor
    log_evidence: Tensor
    effective_sample_size: Tensor
    unseen: Tensor
    failed: Tensor
    inlier_probability: Tensor
    bone_lengths: Tensor
    bone_covariance: Tensor


def check_stream(state: object) -> None:
    """Refuse what is no state of a stream."""
    if not isinstance(state, StreamState):
        raise InputError(
            f"state must be a StreamState, got {type(state).__name__}; begin with init, and pass on what "
            "the step before returned"
        )


def check_stream_method(state: StreamState, method: str) -> None:
    """Refuse the state of another method than that of the tracker."""
    if state.method not in (None, method):
        raise InputError(
            f"state must be one of method {method!r}, as this tracker has it, got one of "
            f"{state.method!r}; begin with init of this tracker"
        )


def live_pose(track: PoseTrack, unseen: Tensor) -> LivePose:
    """Return the poses of a track of one frame.

    Args:
        track: the track of one frame, [B, 1, ...]. unseen: seconds since any joint was measured, [B].
    """
    fields = {name: getattr(track, name)[:, 0] for name in FRAME_FIELDS}
    return LivePose(**fields, unseen=unseen, failed=track.failed)


def unseen_frames(before: Int[Tensor, " B"], seen: Bool[Tensor, "B T"]) -> Int[Tensor, " B"]:
    """Return the number of frames since anything was measured, after T more.

    Args:
        before: that number before them. seen: whether anything was measured in each.
    """
    n_frames = seen.shape[1]
    if n_frames == 1:
        return (before + 1).masked_fill(seen[:, 0], 0)
    return frames_since(before, seen)[:, -1]


def frames_since(before: Int[Tensor, "*batch"], seen: Bool[Tensor, "*batch T"]) -> Tensor:
    """Return the number of frames since anything was measured, after each of T more, [*batch, T].

    Args:
        before: that number before them. seen: whether anything was measured in each.
    """
    frames = torch.arange(seen.shape[-1], device=seen.device)
    return frames - torch.where(seen, frames, -1 - before[..., None]).cummax(-1).values


def returns(before: Int[Tensor, " B"], there: Bool[Tensor, "B T"], longest: float) -> list[int]:
    """Return the frames in which somebody is back after all streams showed nobody for long.

    Args:
        before: frames since anything was there, before these. there: whether anything is, in each.
        longest: number of frames without anything after which it may be somebody else.
    """
    if int(before.min()) + there.shape[1] <= longest:
        return []
    away = torch.cat([before[:, None], frames_since(before, there)[:, :-1]], 1)
    back = (away > longest).all(0) & there.any(0)
    found: list[int] = back.nonzero().flatten().tolist()
    return found


def joined(first: PoseTrack, second: PoseTrack) -> PoseTrack:
    """Return the poses of frames, and of those that follow, of the same streams."""
    fields: dict[str, Any] = {
        name: torch.cat([getattr(first, name), getattr(second, name)], 1) for name in FRAME_FIELDS
    }
    later = torch.where(second.failed_at < 0, -1, second.failed_at + first.joints3d.shape[1])
    failed_at = torch.where(first.failed_at < 0, later, first.failed_at)
    return replace(first, **fields, lengths=first.lengths + second.lengths, failed_at=failed_at)
