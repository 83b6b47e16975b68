"""Cameras placed around a recorded walk, for rendered videos and silhouettes."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose.body.skeleton import BODY_15
from torchpose.camera.pinhole import PinholeCamera
from torchpose.io.mocap import MocapClip

__all__ = ["AZIMUTHS", "cameras_around"]

_PELVIS = BODY_15.joint("pelvis")

AZIMUTHS = (30.0, 150.0, 270.0)
"""Where the cameras stand, degrees from the direction of the walk, to the walker's left."""


def cameras_around(
    clip: MocapClip,
    azimuths: Sequence[float] = AZIMUTHS,
    distance: float = 3.8,
    height: float = 1.5,
    focal: float = 450.0,
) -> list[PinholeCamera]:
    """Return the cameras of 640 x 480 pixels around the middle of the way, which they look at.

    They stand at `azimuths` from the direction of the walk, none of them in its line, so that the
    person stays in view for four metres of it.

    Args:
        clip: whose way it is. azimuths: degrees, one camera each. distance: from the middle, metres.
        height: above the lowest joint, metres. focal: length, pixels.
    """
    up = clip.up.double()
    forward, left = _way(clip)
    points = clip.joints[:, _PELVIS]
    low, high = points.amin(0), points.amax(0)
    floor = float((clip.joints @ up).nan_to_num(math.inf).min())
    middle = (low + high) / 2
    middle = middle - (middle @ up) * up
    target = middle + (floor + 0.95) * up
    cameras = []
    for i, azimuth in enumerate(azimuths, start=1):
        angle = math.radians(azimuth)
        place = middle + distance * (math.cos(angle) * forward + math.sin(angle) * left)
        place = place + (floor + height) * up
        cameras.append(_looking(place, target, up, focal, f"cam_{i:02d}"))
    return cameras


def _way(clip: MocapClip) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the horizontal direction of the walk, or of the chest where nobody walks, and its left."""
    up = clip.up.double()
    pelvis = clip.joints[:, _PELVIS].double()
    way = pelvis[-1] - pelvis[0]
    way = way - (way @ up) * up
    if float(way.norm()) < 0.5:
        sides = (BODY_15.joint("left_shoulder"), BODY_15.joint("right_shoulder"))
        across = (clip.joints[:, sides[0]] - clip.joints[:, sides[1]]).double().nanmean(0)
        way = torch.linalg.cross(across, up)
    forward = normalize(way, dim=-1)
    return forward, torch.linalg.cross(up, forward)


def _looking(
    place: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"], focal: float,
    name: str,
) -> PinholeCamera:  # fmt: skip
    """Return a camera at `place` with `target` in the middle of the image, upright."""
    import cv2

    z = normalize(target - place, dim=-1)
    x = normalize(torch.linalg.cross(z, up), dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    return PinholeCamera(
        focal, focal, 319.5, 239.5, 640, 480, name,
        rotation=cv2.Rodrigues(R.numpy())[0].ravel().tolist(), translation=(-R @ place).tolist(),
    )  # fmt: skip
