"""Feet of a clip by all methods: tracked, with a fixed foot, and triangulated."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.keypoint_bodies import peers
from benchmarks.keypoint_bodies.clips import pair_of
from benchmarks.keypoint_bodies.scoring import Estimate, from_the_start
from torchpose import BodyTracker
from torchpose.body import BODY_15
from torchpose.body._feet import ANKLES, FEET, foot_shape
from torchpose.camera import CameraRig
from torchpose.whole_body import BodyTrack

__all__ = ["CAUSAL", "FIXED", "METHODS", "PEERS", "FootEstimate", "estimates_of"]

FIXED = "fixed-foot"
_OURS = ("kalman", "kalman-smoothed", "kalman-legs-alone")
PEERS: dict[str, Callable[[CameraRig, Tensor, Tensor, float], Estimate]] = {
    "pose2sim": peers.pose2sim,
    "pixels-filter": peers.pixels_filter,
    "standing-still": peers.standing_still,
}
"""Methods that take every point by itself, in two cameras or more."""
METHODS = (*_OURS, FIXED, *PEERS)
CAUSAL = ("kalman", "kalman-legs-alone", FIXED, "pixels-filter", "standing-still")
_N_JOINTS = len(BODY_15.names)
_KNEES = [BODY_15.parents[ankle] for ankle in ANKLES]
_HIPS = pair_of("hip")


class FootEstimate(NamedTuple):
    """What a method says of feet.

    Attributes:
        points: [T, 6, 3], of `FEET`, metres, NaN where it has none. covariance: [T, 6, 3, 3], or None.
        joints: [T, 15, 3], of the body they belong to, or None.
    """

    points: Tensor
    covariance: Tensor | None = None
    joints: Tensor | None = None


def estimates_of(
    rig: CameraRig,
    keypoints: Float[Tensor, "T C 21 2"],
    confidence: Float[Tensor, "T C 21"],
    fps: float,
) -> dict[str, FootEstimate]:
    """Return the feet by all methods that take so many cameras.

    `kalman-legs-alone` gets the keypoints of the fifteen joints alone. `fixed-foot` stands on the ankles of
    `kalman`: at a right angle to the shank, pointing ahead as the pelvis does, of the same average size.

    Args:
        rig: cameras. keypoints: undistorted pixels of the fifteen joints and of `FEET`, NaN where missing.
        confidence: 0 where missing. fps: frames per second.
    """

    tracker, names = BodyTracker(rig, method="kalman", fps=fps), (*BODY_15.names, *FEET)
    blind = confidence.clone()
    blind[..., _N_JOINTS:] = 0
    both = torch.stack([confidence, blind])
    seen, alone = tracker(
        keypoints=keypoints.expand(2, *keypoints.shape), confidence=both, names=names
    )
    smoothed = tracker(keypoints=keypoints, confidence=confidence, names=names, smoothing="full")
    found = {
        "kalman": _tracked(seen),
        "kalman-smoothed": _tracked(smoothed),
        "kalman-legs-alone": _tracked(alone),
        FIXED: _fixed(seen),
    }
    if len(rig) > 1:
        own = keypoints[:, :, _N_JOINTS:], confidence[:, :, _N_JOINTS:]
        for name, method in PEERS.items():
            found[name] = FootEstimate(method(rig, *own, fps).joints)
    return found


def _tracked(track: BodyTrack) -> FootEstimate:
    assert track.feet is not None  # there are names of feet
    values = (track.feet.points3d, track.feet.covariance3d, track.joints3d)
    return FootEstimate(*(from_the_start(value, track.first_frame) for value in values))


def _fixed(track: BodyTrack) -> FootEstimate:
    """Return feet at a right angle to the shank."""
    joints = from_the_start(track.joints3d, track.first_frame)
    ankles, shanks = joints[:, ANKLES], joints[:, _KNEES] - joints[:, ANKLES]
    up = normalize(shanks, dim=-1)
    spine = joints[:, BODY_15.joint("neck")] - joints[:, BODY_15.joint("pelvis")]
    ahead = torch.linalg.cross(joints[:, _HIPS[0]] - joints[:, _HIPS[1]], spine)[:, None]
    ahead = normalize(ahead - (ahead * up).sum(-1, keepdim=True) * up, dim=-1)
    axes = torch.stack([torch.linalg.cross(up, ahead), up, ahead], -1)
    away = shanks.norm(dim=-1)[..., None, None] * (axes @ foot_shape().mT).mT
    return FootEstimate((ankles[:, :, None] + away).flatten(1, 2), None, joints)
