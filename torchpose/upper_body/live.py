"""Tracking live streams: the state between two frames, and some frames more."""

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera.virtual_camera import memory_frames
from torchpose.errors import DegenerateFilterWarning, InputError, check_floating, check_shape
from torchpose.filters.base import Generators, RecursiveFilter
from torchpose.filters.mkf import MixtureKalmanFilter
from torchpose.filters.outputs import FilterOutput, collect
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.upper_body.arms import (
    ARMS,
    generators_of_arms,
    in_double,
    joints_of_arm,
    require_cov,
)
from torchpose.upper_body.fusion import MotionState
from torchpose.upper_body.measurements import MeasuredJoints, Picked, arm_measurements, pick_joints
from torchpose.upper_body.windows import SeenInView, pose_of_window, window_inputs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torchpose.upper_body.pose_track import PoseTrack
    from torchpose.upper_body.tracker import UpperBodyTracker

__all__ = ["LivePose", "StreamState", "begin", "track_frame", "track_frames"]


class Stream(NamedTuple):
    """What stays the same from frame to frame.

    Attributes:
        n_keypoints: J. picked: where the eight joints are among them, and what was assumed.
        joints: those that each arm's filter measures, left and right. generators: of each arm.
    """

    n_keypoints: int
    picked: Picked
    joints: dict[str, tuple[str, ...]]
    generators: dict[str, Generators]


class StreamState(NamedTuple):
    """What `UpperBodyTracker.step` needs to know of the frames before.

    Attributes:
        recent: the eight joints of the last N frames in the prior's pixels, the latest last, with
            R of each frame [B, N, 8, 2, 2]; N is 0 where no window is used.
        filters: for each arm the states of its filters.
        motion: state of the motion stage; None before the first frame, and where there is no stage.
        unseen: number of frames since any joint was measured, [B].
        stream: what does not change.
    """

    recent: MeasuredJoints
    filters: dict[str, tuple[Any, ...]]
    motion: MotionState | None
    unseen: Tensor
    stream: Stream


class LivePose(NamedTuple):
    """The poses of one frame of B streams; joints in the order of `UPPER_BODY`.

    Attributes:
        joints2d: [B, 8, 2], pixels of the camera. joints3d: [B, 8, 3], metres, in the tracker's frame.
        covariance2d: [B, 8, 2, 2]. covariance3d: [B, 8, 3, 3].
        observed: [B, 8], True where the joint was measured in this frame.
        log_evidence: of the left and the right arm, [B, 2].
        effective_sample_size: of the particles or tracks of each arm, [B, 2]; see `PoseTrack`.
        unseen: seconds since any joint was measured, [B]; 0 where one is.
        failed: [B], True where the filter degenerated: poses are NaN until the stream is begun anew.
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


def begin(
    tracker: "UpperBodyTracker",
    batch_size: int,
    names: "Sequence[str] | None",
    generator: Generators,
) -> StreamState:
    """The state before the first frame; see `UpperBodyTracker.init`."""
    if tracker.smoothing is not None:
        raise InputError(
            "frame by frame an estimate cannot use later frames: expected smoothing=None, got "
            f"{tracker.smoothing!r}"
        )
    if batch_size < 1:
        raise InputError(f"batch_size must be at least 1, got {batch_size}")
    n_keypoints = len(UPPER_BODY) if names is None else len(names)
    info = tracker.prior.info
    picked = pick_joints(n_keypoints, names, tracker.neck, info.neck, info.hand)
    joints = {side: joints_of_arm(side, [i >= 0 for i in picked.indices]) for side in ARMS}
    sources = dict(zip(ARMS, generators_of_arms(generator), strict=True))
    filters = {
        side: tuple(
            model.init(batch_size, sources[side]) for model in tracker._models(side, joints[side])
        )
        for side in ARMS
    }
    window = tracker._window()
    n_frames = 0 if window is None else 1 + memory_frames(window[1].lags, window[1].fps)
    like = tracker.measurement_cov
    recent = MeasuredJoints(
        like.new_zeros(batch_size, n_frames, 8, 2),
        torch.zeros(batch_size, n_frames, 8, dtype=torch.bool, device=like.device),
        like.expand(batch_size, n_frames, -1, -1, -1),
    )
    unseen = torch.zeros(batch_size, dtype=torch.long, device=like.device)
    return StreamState(recent, filters, None, unseen, Stream(n_keypoints, picked, joints, sources))


def track_frame(
    tracker: "UpperBodyTracker",
    state: StreamState,
    keypoints: Float[Tensor, "B J 2"],
    confidence: Float[Tensor, "B J"] | None,
    mask: Bool[Tensor, "B J"] | None,
    covariance: Float[Tensor, "B J 2 2"] | None,
) -> tuple[StreamState, LivePose]:
    """One frame of every stream; see `UpperBodyTracker.step`."""
    check_shape("keypoints", keypoints, [len(state.unseen), state.stream.n_keypoints, 2])
    confidence, mask, covariance = (
        None if x is None else x[:, None] for x in (confidence, mask, covariance)
    )
    state, track = track_frames(tracker, state, keypoints[:, None], confidence, mask, covariance)
    pose = LivePose(
        track.joints2d[:, 0],
        track.joints3d[:, 0],
        track.covariance2d[:, 0],
        track.covariance3d[:, 0],
        track.observed[:, 0],
        track.log_evidence[:, 0],
        track.effective_sample_size[:, 0],
        state.unseen / (tracker.fps or 30.0),
        track.failed_at >= 0,
    )
    return state, pose


def track_frames(
    tracker: "UpperBodyTracker",
    state: StreamState,
    keypoints: Float[Tensor, "B T J 2"],
    confidence: Float[Tensor, "B T J"] | None,
    mask: Bool[Tensor, "B T J"] | None,
    covariance: Float[Tensor, "B T J 2 2"] | None,
) -> tuple[StreamState, "PoseTrack"]:
    """Some more frames of every stream; see `UpperBodyTracker.advance`."""
    stream, batch = state.stream, len(state.unseen)
    check_floating("keypoints", keypoints)
    check_shape("keypoints", keypoints, [batch, "T", stream.n_keypoints, 2])
    n_frames = keypoints.shape[1]
    if n_frames == 0:
        raise InputError("keypoints must hold at least one frame, got none")
    measured = tracker._in_prior_pixels(
        keypoints.to(tracker.measurement_cov), confidence, mask, stream.picked, covariance
    )
    recent, seen = state.recent, None
    if recent.uv.shape[1]:
        frames = _append(recent, measured)
        seen = tracker._look(frames, None, -n_frames)
        recent = MeasuredJoints(*(x[:, n_frames:] for x in frames))
    if seen is not None:
        seen = seen._replace(measured=seen.measured._replace(cov=measured.cov))
    arms, filters = {}, {}
    for side in ARMS:
        filters[side], arms[side] = _advance_arm(tracker, side, state, measured, seen)
    view = None if seen is None else seen.view
    left, right = arms["left"], arms["right"]
    reading = tracker._read_out(left, right, view)
    stage, motion = tracker._motion_stage(), state.motion
    if stage is not None:
        motion, reading = stage.advance(motion or stage.init(reading), reading)
    track = tracker._poses(reading, left, right, measured.mask, None, tracker.notes)
    unseen = _unseen(state.unseen, measured.mask.any(-1))
    return StreamState(recent, filters, motion, unseen, stream), track


def _append(frames: MeasuredJoints, new: MeasuredJoints) -> MeasuredJoints:
    """The last frames, and the new ones after them."""
    cov = new.cov.expand(*new.uv.shape[:2], *new.cov.shape[-3:])
    pairs = zip(frames, new._replace(cov=cov), strict=True)
    return MeasuredJoints(*(torch.cat([old, latest], 1) for old, latest in pairs))


def _unseen(before: Tensor, seen: Bool[Tensor, "B T"]) -> Tensor:
    """Number of frames since anything was seen, [B]."""
    n_frames = seen.shape[1]
    frames = torch.arange(1, n_frames + 1, device=seen.device)
    last = torch.where(seen, frames, torch.zeros_like(frames)).amax(1)
    return torch.where(last > 0, n_frames - last, before + n_frames)


def _advance_arm(
    tracker: "UpperBodyTracker",
    side: str,
    state: StreamState,
    measured: MeasuredJoints,
    seen: SeenInView | None,
) -> tuple[tuple[Any, ...], FilterOutput]:
    """Next states of an arm's filters, and their estimates."""
    joints, generator = state.stream.joints[side], state.stream.generators[side]
    models, states = tracker._models(side, joints), state.filters[side]
    if seen is None:
        z, mask, cov = arm_measurements(ARMS[side], joints, measured)
        after, out = _advance(models[0], states[0], z, mask, cov, generator)
        return (after,), out
    window = tracker.prior.windows[seen.window]
    both, noise, hands = window_inputs(seen, window, side, joints, tracker.measurement_cov)
    after, out = _advance(models[0], states[0], *both, noise, None)
    after_hands, context = _advance(models[1], states[1], *hands, None, None)
    return (after, after_hands), pose_of_window(out, context, seen, ARMS[side], window.layout)


def _advance(
    model: RecursiveFilter,
    state: Any,
    z: Float[Tensor, "B T Z"],
    mask: Bool[Tensor, "B T Z"],
    cov: Tensor | None,
    generator: Generators,
) -> tuple[Any, FilterOutput]:
    """The frames through a filter, and its estimates."""
    if isinstance(model, MixtureKalmanFilter) and model.is_memoryless:
        out = model(z, mask, cov, return_cov=True)
        state = state._replace(time=state.time + z.shape[1])
    else:
        steps = []
        for t in range(z.shape[1]):
            noise = cov[:, t] if cov is not None and cov.ndim == 4 else cov
            state, step = model.step(state, z[:, t], mask[:, t], noise, generator, return_cov=True)
            steps.append(step)
        lengths = torch.full((len(z),), z.shape[1], device=z.device)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateFilterWarning)  # told by `failed`
            out = collect(steps, lengths)
    return state, in_double(out._replace(cov=require_cov(out)))
