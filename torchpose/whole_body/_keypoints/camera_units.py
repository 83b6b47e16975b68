"""Refuse cameras whose translations are not in metres: whom they see is then no person by size.

Bones are measured in the images, by the distance at which cameras agree the person to be. Triangulated joints
themselves are too far apart where cameras stand close together.
"""

import math

from torch import Tensor

from torchpose.body._skeleton import BODY_15
from torchpose.errors import CameraError
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, see

_FRAMES = 50  # of a sequence, at most, that are looked at
_LEAST_BONES = 20  # in all images, that tell a factor
_AGREED = 0.5  # share of the joints that two cameras see, on which they have to agree
_SHORTEST, _LONGEST = 0.15, 2.0  # of bones, by those that are expected; infants have 0.3


def check_units(filter: BodyKalmanFilter, frames: KeypointFrame) -> None:
    """Raise `CameraError` where people are many times as large as a person, or as small.

    Args:
        filter: of the cameras, and of the person whose bones are expected. frames: keypoints [B, T, C, J].
    """
    stride = max(1, frames.pixels.shape[1] // _FRAMES)
    some = frames.map(lambda value: value[:, ::stride].flatten(0, 1))
    logs = log_factors(filter.maps, some, filter.motion)
    if len(logs) < _LEAST_BONES:
        return
    factor = math.exp(float(logs.median()))
    if not _SHORTEST < factor < _LONGEST:
        raise CameraError(
            "cameras must be given in metres, but with these cameras the bones of the person come out about "
            f"{factor:.2g} times as long as anybody's; divide translations in millimetres by 1000, those in "
            "centimetres by 100, and those in an unknown unit by about that factor. If they are in metres, "
            "check the direction of rotation and translation: they must lead from world to camera axes"
        )


def log_factors(maps: RigMaps, frame: KeypointFrame, motion: BodyMotion) -> Tensor:
    """Return the logs of lengths of bones in images by those that are expected; none if cameras disagree.

    Args:
        maps: the cameras. frame: keypoints [B, C, J]. motion: of the person who is expected.
    """
    joints, there = triangulate(maps, frame), frame.there
    agreed = joints.isfinite().all(-1)
    if int(agreed.sum()) < _AGREED * int((there.sum(1) >= 2).sum()):
        return joints.new_zeros(0)
    seen = see(maps, joints.nanmedian(1, keepdim=True).values)
    per_metre = (seen.by_joint.square().sum((-2, -1)) / 2).sqrt()
    parents = list(BODY_15.parents[1:])
    bones = (frame.pixels[:, :, 1:] - frame.pixels[:, :, parents]).norm(dim=-1) / per_metre
    body = motion.articulation
    expected = body.offsets.norm(dim=-1) * motion.scale_mean[body.group].exp()
    known = there[:, :, 1:] & there[:, :, parents] & seen.in_front & (bones > 0)
    return (bones / expected[1:].to(bones)).log()[known & agreed.any(1)[:, None, None]]
