"""Estimate delays and poses of cameras from the keypoints of a person who moves.

Whole frames of delays are found from pairs of cameras (`coarse_delays`). Then in turn the body is tracked and
smoothed with the cameras as they are known so far, which gives joints and their velocities, and cameras and
joints are adjusted to the keypoints together (`camera_bundle`). At the end the body is tracked with the given
and with the corrected cameras. The corrected ones are kept if they raise the log-evidence of the filter by
more than they cost.

Keypoints that delays explain are explained by delays with wrong poses as well, which move the body in the
room. So where both are estimated, poses stay as given unless they raise the log-evidence, too.

Where tracking has found one camera that is turned and others that are not, all this begins with it turned,
and its corrections are about that. From the calibration as given the turn would be spread over all cameras.
"""

import copy
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.math._rotations import matrix_to_rotvec, rotvec_to_matrix
from torchpose.whole_body._keypoints.camera_bundle import (
    N_ERRORS,
    BundleInputs,
    CameraErrors,
    adjust,
    corrected_pose,
)
from torchpose.whole_body._keypoints.coarse_delays import coarse_delays, shifted
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    Exchange,
    KeypointFrame,
    RigMaps,
    see,
)
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses
from torchpose.whole_body._keypoints.turned_cameras import is_turned

REFINED = ("none", "delays", "extrinsics", "both")
DELAY = N_ERRORS - 1
_LONGEST, _LEAST_LONGEST = 0.3, 10  # seconds, and frames at least, of a delay that is looked for
_DELAY_STD = 0.2  # seconds
_BLOCK = 1.0  # seconds within which errors of a joint's keypoints go together
_FRAMES = 2000  # at most, that are adjusted to
_ROUNDS = 5  # of tracking and adjusting, at most
_BEYOND = 0.5  # factor of the trust in keypoints that stand for others beyond the first or last
_MARGIN = 20.0  # log-evidence of other keypoints in a frame
_LEAST_GAIN = 3.0  # log-evidence from which corrected cameras are kept
_SETTLED = 0.2  # standard deviations by which no error changes any more
_WIDTHS = (50.0, 25.0, 12.0, 6.0, 3.0, 1.5, *[1.0] * 6)

Track = Callable[[CameraRig, KeypointFrame, bool], KeypointPoses]
"""Tracks keypoints [T, C, J] with a rig, smoothed or not."""


class RefinedCameras(NamedTuple):
    """Holds cameras and what they give.

    Attributes:
        errors: of the cameras as they were given; zero where those are kept. rig: without their errors.
        frames: keypoints in time with the first camera. poses: of the body, [1, T, ...].
        gain: log-evidence for the corrected cameras against the given ones. kept: whether those stay.
        what: which errors were asked to be estimated, one of `REFINED`.
    """

    errors: CameraErrors
    rig: CameraRig
    frames: KeypointFrame
    poses: KeypointPoses
    gain: float
    kept: bool
    what: str


def refine_cameras(
    rig: CameraRig,
    frames: KeypointFrame,
    track: Track,
    fps: float,
    what: str,
    exchange: Exchange,
    smoothing: bool,
    turn: Float[Tensor, "C 3 3"] | None,
) -> RefinedCameras:
    """Return cameras without the errors that keypoints tell of.

    The first camera keeps the time. No camera keeps its pose: errors of all are as small as they can be. If
    some are turned and others are not, they are as small as they can be beside these turns, which would
    be spread over all.

    Args:
        rig: the cameras, two or more. frames: keypoints [T, C, J]. track: tracks with a rig.
        fps: frames per second. what: "delays", "extrinsics" or "both". exchange: of sides.
        smoothing: of the poses that are returned. turn: of cameras about their centres, in world axes,
            as tracking has found them.
    """
    if turn is None or what == "delays" or not _some_are_turned(turn):
        found = _refined(rig, frames, track, fps, what, exchange, smoothing)
        return found._replace(what=what)
    known = CameraErrors.none(rig).values
    known[:, :3] = _turns_of(rig, turn)
    found = _refined(_corrected(rig, known), frames, track, fps, what, exchange, smoothing)
    errors = found.errors._replace(values=_one_after_another(known, found.errors.values))
    return found._replace(errors=errors, kept=False, what=what)


def _refined(
    rig: CameraRig,
    frames: KeypointFrame,
    track: Track,
    fps: float,
    what: str,
    exchange: Exchange,
    smoothing: bool,
) -> RefinedCameras:
    """Return cameras without errors about those of a rig."""
    before = track(rig, frames, True)
    start = CameraErrors.none(rig)
    if bool(free_errors(len(rig), what)[:, DELAY].any()):
        start.values[:, DELAY] = whole_delays(rig, frames, fps).to(start.values)
    refine = partial(_refined_from, start, before, rig, frames, track, fps, exchange, smoothing)
    found = refine(what)
    if what == "both":
        late = refine("delays")
        if found.gain < late.gain + _LEAST_GAIN:
            return late
    return found


def _refined_from(
    errors: CameraErrors,
    before: KeypointPoses,
    rig: CameraRig,
    frames: KeypointFrame,
    track: Track,
    fps: float,
    exchange: Exchange,
    smoothing: bool,
    what: str,
) -> RefinedCameras:
    """Return cameras without some kinds of errors about those of a rig, with which the body was tracked.

    Args:
        errors: to begin with. before: poses by the cameras as they are. The others are those of `_refined`.
    """
    free = free_errors(len(rig), what)
    poses, adjusted = before, None
    for i in range(_ROUNDS):
        if i > 0 or bool(errors.values.any()):
            known = poses.joints[0] if i > 0 else None
            moved = in_time(rig, frames, errors.values, known)
            poses = track(_corrected(rig, errors.values), moved, True)
        delays, stride = errors.values[:, DELAY], max(1, len(frames.pixels) // _FRAMES)
        given = given_for(frames, poses.joints[0], delays, free, fps, exchange, stride)
        adjusted = adjust(rig, given, errors, _WIDTHS)
        change = (adjusted.errors.values - errors.values).abs()
        errors = adjusted.errors
        if bool((change <= _SETTLED * errors.std).all()):
            break
    assert adjusted is not None
    better = _corrected(rig, errors.values)
    moved = in_time(rig, frames, errors.values, poses.joints[0])
    after = track(better, moved, smoothing)
    gain = _gain(frames, before, after, errors.values[:, DELAY].round()) - adjusted.price
    if gain > _LEAST_GAIN:
        return RefinedCameras(errors, better, moved, after, gain, kept=False, what=what)
    before = before if smoothing else track(rig, frames, False)
    same = CameraErrors(torch.zeros_like(errors.values), errors.cov)
    return RefinedCameras(same, rig, frames, before, gain, kept=True, what=what)


def whole_delays(rig: CameraRig, frames: KeypointFrame, fps: float) -> Int[Tensor, " C"]:
    """Return whole frames by which cameras began too early, against the first one; up to 0.3 s.

    Args:
        rig: the cameras. frames: keypoints [T, C, J]. fps: frames per second.
    """
    longest = max(_LEAST_LONGEST, round(_LONGEST * fps))
    return coarse_delays(rig, frames, min(longest, max(1, len(frames.pixels) // 3)))


def details_of_cameras(found: RefinedCameras, count: int) -> dict[str, Tensor]:
    """Return what was found, the same in each of T frames, as details of a track.

    `camera_delays` [T, C], frames; `camera_rotation` (Rodrigues) and `camera_translation` [T, C, 3] of the
    corrected cameras; `camera_errors_std` [T, C, 7], of rotation (radians) and shift (metres) in camera axes
    and of the delay.
    """
    import cv2

    turns = [cv2.Rodrigues(matrix.numpy(force=True))[0].ravel() for matrix in found.rig.rotation]
    rotation = torch.tensor(np.stack(turns)).to(found.rig.rotation)
    values = {
        "camera_delays": found.errors.values[:, DELAY],
        "camera_rotation": rotation,
        "camera_translation": found.rig.translation,
        "camera_errors_std": found.errors.std,
    }
    return {name: value.expand(count, *value.shape).clone() for name, value in values.items()}


def given_for(
    frames: KeypointFrame,
    joints: Float[Tensor, "T J 3"],
    delays: Float[Tensor, " C"],
    free: Bool[Tensor, "C 7"],
    fps: float,
    exchange: Exchange,
    stride: int,
) -> BundleInputs:
    """Return what cameras are adjusted to: every frame, or each after a stride.

    Args:
        frames: keypoints [T, C, J], not shifted. joints: tracked. delays: frames, as known so far.
        free: which errors are estimated. fps: frames per second. exchange: of sides.
    """
    shifts = delays.round()
    moved, _ = shifted(frames, shifts.long())
    if stride > 1:
        moved = moved.map(lambda value: value[::stride])
    block = max(1, round(_BLOCK * fps / stride))
    return BundleInputs(
        moved, joints[::stride], _velocities(joints)[::stride], shifts, free, _DELAY_STD * fps,
        block, exchange,
    )  # fmt: skip


def _corrected(rig: CameraRig, values: Float[Tensor, "C 7"]) -> CameraRig:
    """Return a rig without errors of its poses."""
    other = copy.copy(rig)
    rotation, translation = corrected_pose(rig, values)
    other._buffers = {
        **dict(rig.named_buffers()), "rotation": rotation, "translation": translation
    }  # fmt: skip
    return other


def _some_are_turned(turn: Float[Tensor, "C 3 3"]) -> bool:
    """Return whether some cameras are turned, and others are not."""
    count = int(is_turned(turn).sum())
    return 0 < count < len(turn)


def _turns_of(rig: CameraRig, turn: Float[Tensor, "C 3 3"]) -> Float[Tensor, "C 3"]:
    """Return the rotations in camera axes that turns of world axes are, of cameras about their centres."""
    rotvec = matrix_to_rotvec(rig.rotation @ turn.mT @ rig.rotation.mT)
    return torch.where(is_turned(turn)[:, None], rotvec, 0.0)


def _one_after_another(
    known: Float[Tensor, "C 7"], further: Float[Tensor, "C 7"]
) -> Float[Tensor, "C 7"]:
    """Return errors of poses that are turned by those that are known, and then have further ones."""
    first, then = rotvec_to_matrix(known[:, :3]), rotvec_to_matrix(further[:, :3])
    turned = known[:, :3].any(-1, keepdim=True)
    both = torch.where(turned, matrix_to_rotvec(then @ first), further[:, :3])
    return torch.cat([both, further[:, 3:]], -1)


def _velocities(joints: Float[Tensor, "T J 3"]) -> Float[Tensor, "T J 3"]:
    """Return velocities, metres a frame."""
    if len(joints) < 2:
        return torch.zeros_like(joints)
    return torch.gradient(joints, dim=0)[0]


def in_time(
    rig: CameraRig,
    frames: KeypointFrame,
    values: Float[Tensor, "C 7"],
    joints: Float[Tensor, "T J 3"] | None,
) -> KeypointFrame:
    """Return keypoints in time with the first camera.

    They are those of the nearest frame that there is, moved by the velocity of their joints for the rest of
    the delay, z + A v (d - round d). None are averaged, which would make their noise look smaller.

    Args:
        rig: as given. frames: keypoints [T, C, J]. values: errors of the cameras.
        joints: whose velocities keypoints have, metres; None leaves the rest of the delay.
    """
    delays = values[:, DELAY]
    moved, shifts = shifted(frames, delays.round().long(), _BEYOND)
    if joints is None:
        return moved
    seen = see(RigMaps.of(_corrected(rig, values)), joints)
    by_frame = (seen.by_joint @ _velocities(joints)[:, None, ..., None]).squeeze(-1)
    rest = delays - shifts
    return moved._replace(pixels=moved.pixels + rest[..., None, None] * by_frame)


def free_errors(count: int, what: str) -> Bool[Tensor, "C 7"]:
    """Return which errors of cameras are estimated."""
    free = torch.zeros(count, N_ERRORS, dtype=torch.bool)
    free[:, :DELAY] = what in ("extrinsics", "both")
    free[1:, DELAY] = what in ("delays", "both")
    return free


def _gain(
    frames: KeypointFrame, before: KeypointPoses, after: KeypointPoses, shifts: Float[Tensor, " C"]
) -> float:
    """Return by how much log-evidence grew for certain, of frames that are far enough from both ends.

    Shifted cameras have a few other keypoints there, so evidence is compared per keypoint, and less a margin.
    """
    edge = int(shifts.abs().max())
    rows = slice(edge, len(frames.pixels) - edge)
    kinds = frames, shifted(frames, shifts.long())[0]
    numbers = [(kind.inlier[rows] > 0).sum().clamp_min(1) for kind in kinds]
    evidence = [poses.log_evidence[0, rows].sum() for poses in (before, after)]
    grown = numbers[0] * (evidence[1] / numbers[1] - evidence[0] / numbers[0])
    return float(grown) - _MARGIN * edge
