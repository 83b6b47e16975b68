"""Find by how much the only camera is tilted and rolled, from how people stand in front of it.

Trunk and legs of somebody who stands are vertical on average, up to a little lean ahead. Their direction, in
the axes of the camera, tells its roll as it is. The network that lifts turns bodies by d(e) that are seen
from the elevation e (`lifted_lean`), so a pitch p is expected to show the line of sight at e(p) + d(e(p))
against the body. The likelihood of what is seen, with a prior over p in which half of the cameras are about
level and one over e, is added up over a grid of p.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.camera._tilt import angles_of_up, up_of_angles
from torchpose.whole_body._body_track import BodyTrack
from torchpose.whole_body._keypoints.lifted_lean import lean_of_network

_SHOULDERS, _HIPS, _KNEES, _ANKLES = (
    [BODY_15.joint(f"{side}_{name}") for side in ("left", "right")]
    for name in ("shoulder", "hip", "knee", "ankle")
)
_STRAIGHT, _IN_LINE = math.cos(math.radians(35.0)), math.cos(math.radians(30.0))  # knees and hips
# People have to stand for so many seconds, and in this share of the frames in which they are seen.
_LEAST_TIME, _LEAST_SHARE = 0.5, 0.3
_LEAN = 0.05  # ahead of those who stand, radians
_STD, _ROLL_STD = math.radians(2.8), math.radians(2.2)  # of directions, by persons
# Standard deviations of priors, radians: of pitches of cameras that are about level and of others, half of
# each; of rolls; mean and deviation of the elevation of lines of sight.
_LEVEL, _OTHERS, _ROLLS = math.radians(3.0), math.radians(15.0), math.radians(10.0)
_SIGHT = (math.radians(-2.0), math.radians(14.0))
# Of the pitch on top of the posterior: persons differ from the mean d(e).
_UNSURE = math.radians(4.0)
_GRID, _STEP = math.radians(45.0), math.radians(0.5)


class CameraTilt(NamedTuple):
    """Holds angles of a camera, radians, and their standard deviations.

    Attributes:
        pitch: by which it looks up. roll: by which it is rolled clockwise, seen from behind.
        pitch_std, roll_std: of both.
    """

    pitch: float
    roll: float
    pitch_std: float
    roll_std: float


def find_camera_tilt(tracks: Sequence[BodyTrack], rig: CameraRig) -> CameraTilt | None:
    """Find pitch and roll of the only camera.

    Args:
        tracks: of all persons, if any, by keypoints of this camera alone without `up`.
        rig: of this camera, as it was given to the tracker.

    Returns:
        The angles, None if nobody stands for half a second.
    """
    if not tracks:
        return None
    joints = torch.cat([_in_camera(track, rig) for track in tracks])
    fps = tracks[0].fps or 30.0
    stands, up = _standing(joints)
    if len(joints) == 0 or stands.sum() < max(_LEAST_TIME * fps, _LEAST_SHARE * len(joints)):
        return None
    body_up = normalize(up[stands].median(0).values, dim=0)
    pelvis = joints[stands][:, _HIPS].mean(1)
    sight = normalize(normalize(pelvis, dim=-1).median(0).values, dim=0)
    _, seen_roll = angles_of_up(body_up)
    kept = _ROLLS**2 / (_ROLLS**2 + _ROLL_STD**2)
    pitch, pitch_std = _pitch(sight, body_up, seen_roll)
    return CameraTilt(pitch, kept * seen_roll, pitch_std, math.sqrt(kept) * _ROLL_STD)


def _in_camera(track: BodyTrack, rig: CameraRig) -> Float[Tensor, "T 15 3"]:
    """Return joints in axes of the camera, of frames in which it sees trunk and legs."""
    seen = track.details["inlier"][:, 0] > 0.5
    there = torch.stack([seen[:, pair].any(1) for pair in (_SHOULDERS, _HIPS, _KNEES)]).all(0)
    R, t = (value[0].to(track.joints3d) for value in (rig.rotation, rig.translation))
    return track.joints3d[there] @ R.mT + t


def _standing(joints: Float[Tensor, "T 15 3"]) -> tuple[Bool[Tensor, " T"], Float[Tensor, "T 3"]]:
    """Return in which frames somebody stands, and the direction that is up by trunk and legs."""
    thighs = normalize(joints[:, _HIPS] - joints[:, _KNEES], dim=-1)
    shanks = normalize(joints[:, _KNEES] - joints[:, _ANKLES], dim=-1)
    trunk = normalize((joints[:, _SHOULDERS] - joints[:, _HIPS]).mean(1), dim=-1)
    legs = normalize((joints[:, _HIPS] - joints[:, _ANKLES]).mean(1), dim=-1)
    straight = (thighs * shanks).sum(-1).amax(1) > _STRAIGHT
    stands = straight & ((trunk * legs).sum(-1) > _IN_LINE)
    up = normalize(trunk + legs, dim=-1)
    left = joints[:, _SHOULDERS[0]] - joints[:, _SHOULDERS[1]]
    ahead = normalize(torch.linalg.cross(left, up), dim=-1)
    return stands, normalize(up - _LEAN * ahead, dim=-1)


def _pitch(sight: Tensor, body_up: Tensor, roll: float) -> tuple[float, float]:
    """Return mean and standard deviation of the pitch.

    Args:
        sight: the direction to the body [3]. body_up: that which is up by bodies [3]. roll: of the camera.
    """
    p = torch.arange(-_GRID, _GRID + _STEP, _STEP, dtype=sight.dtype)
    up = torch.tensor([up_of_angles(float(angle), roll) for angle in p]).to(sight)
    e = (up @ sight).asin()
    seen = (body_up @ sight).asin()
    fit = ((seen - e - lean_of_network(e)) / _STD).square()
    fit = fit + ((e - _SIGHT[0]) / _SIGHT[1]).square()
    kinds = [-(p / std).square() / 2 - math.log(std) for std in (_LEVEL, _OTHERS)]
    weight = torch.softmax(torch.logaddexp(*kinds) - fit / 2, 0)
    mean = (weight * p).sum()
    variance = (weight * (p - mean).square()).sum() + _UNSURE**2
    return float(mean), float(variance.sqrt())
