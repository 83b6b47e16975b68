"""Ways to treat cameras that may be wrong, each from what is said of them to joints, delays and poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torchpose
from benchmarks.keypoint_bodies.scoring import from_the_start
from benchmarks.keypoint_cameras.disturbed import Disturbed, in_step, with_poses
from benchmarks.keypoint_cameras.peers import bundle_adjusted, correlated_delays
from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.metrics import align, joint_errors


class Found(NamedTuple):
    """Joints [T, 15, 3], delays [C] in frames, and the cameras."""

    joints: Tensor
    delays: Tensor
    rig: CameraRig


class Errors(NamedTuple):
    """Measures of a clip.

    Attributes:
        room: mean distance of joints, mm. moved: that after one rigid motion of the whole clip.
        delay: mean error of delays against the first camera, frames. angle: of rotations relative to it,
            degrees.
    """

    room: float
    moved: float
    delay: float
    angle: float


def track(rig: CameraRig, keypoints: Tensor, confidence: Tensor, fps: float, **more: Any) -> Any:
    """Track the body, smoothed."""
    tracker = torchpose.BodyTracker(rig, "kalman", fps=fps)
    return tracker(
        keypoints=keypoints, confidence=confidence, names=BODY_15.names, smoothing="full", **more
    )


def true_cameras(clip: Disturbed, what: str) -> Found:
    """Track with the cameras as they are."""
    return _tracked(clip, clip.delays, clip.rig)


def doing_nothing(clip: Disturbed, what: str) -> Found:
    """Track with the cameras as they are said to be."""
    return _tracked(clip, torch.zeros_like(clip.delays), clip.said)


def refined(clip: Disturbed, what: str) -> Found:
    """Track with `refine`."""
    poses = track(clip.said, clip.keypoints, clip.confidence, clip.fps, refine=what)
    rotation = rotvec_to_matrix(poses.details["camera_rotation"][0])
    rig = with_poses(clip.said, rotation, poses.details["camera_translation"][0])
    joints = from_the_start(poses.joints3d, poses.first_frame)
    return Found(joints, poses.details["camera_delays"][0], rig)


def peers(clip: Disturbed, what: str) -> Found:
    """Find delays by correlation and poses by bundle adjustment, and track with these."""
    delays, rig = torch.zeros_like(clip.delays), clip.said
    if what != "extrinsics":
        delays = torch.tensor(correlated_delays(clip.keypoints, clip.confidence, clip.fps))
    if what != "delays":
        moved = in_step(clip.keypoints, delays), in_step(clip.confidence, delays)
        poses = bundle_adjusted(rig, *moved)
        rig = with_poses(rig, *(torch.from_numpy(value) for value in poses))
    return _tracked(clip, delays, rig)


WAYS: dict[str, Callable[[Disturbed, str], Found]] = {
    "true cameras": true_cameras,
    "doing nothing": doing_nothing,
    "refined": refined,
    "correlation, bundle": peers,
}


def measure(found: Found, clip: Disturbed) -> Errors:
    """Return the measures of what was found."""
    truth = clip.joints
    flat = found.joints.reshape(1, -1, 3), truth.reshape(1, -1, 3)
    moved = align(*flat, joints=None).points
    turns = [rig.rotation @ rig.rotation[0].T for rig in (found.rig, clip.rig)]
    trace = (turns[0] * turns[1]).sum((-2, -1))[1:]
    angle = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos())
    return Errors(
        1000 * float(joint_errors(found.joints, truth).nanmean()),
        1000 * float(joint_errors(moved, flat[1]).nanmean()),
        float((found.delays - clip.delays)[1:].double().abs().mean()),
        float(angle.mean()),
    )


def _tracked(clip: Disturbed, delays: Tensor, rig: CameraRig) -> Found:
    moved = in_step(clip.keypoints, delays), in_step(clip.confidence, delays)
    poses = track(rig, *moved, clip.fps)
    return Found(from_the_start(poses.joints3d, poses.first_frame), delays, rig)
