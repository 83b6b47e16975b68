"""Hold the feet of a tracked body: heels and toes with their covariances, and angles of the ankles."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._feet import FEET
from torchpose.math._gaussian import mean_std

DETAILS_OF_FEET = (
    "feet",
    "feet_covariance",
    "feet_inlier",
    "foot_rotation",
    "foot_rotation_covariance",
)
"""Names of the details of a track that hold feet."""
FIELDS_OF_FEET = {
    "feet": "n T 6 3", "feet_covariance": "n T 6 3 3", "foot_rotation": "n T 2 3 3",
    "foot_rotation_covariance": "n T 2 3 3",
}  # fmt: skip
"""Kinds and sizes of those that are of poses, and not of cameras."""
ANKLE_ANGLES = ("flexion", "inversion", "rotation")
"""Names of the angles of an ankle."""


@dataclass(frozen=True)
class BodyFeet:
    """Holds both feet of one person in T frames; `BodyTrack.feet`.

    Attributes:
        points3d: [T, 6, 3], heel, big toe and small toe of the left and of the right foot (`names`), metres,
            world axes. covariance3d: [T, 6, 3, 3], metres squared.
        inlier: [T, C, 6], probability that a camera's keypoint was the point's.
        rotation: [T, 2, 3, 3], from the axes of the left and the right foot to those of their shanks; the
            unit matrix where a foot is at a right angle to its shank and points ahead.
        rotation_covariance: [T, 2, 3, 3], of rotation vectors in the axes of the feet, radians squared.
    """

    points3d: Tensor
    covariance3d: Tensor
    inlier: Tensor
    rotation: Tensor
    rotation_covariance: Tensor

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the points."""
        return FEET

    @property
    def angles(self) -> Float[Tensor, "T 2 3"]:
        """Return flexion, inversion and rotation of the left and the right ankle, radians.

        The foot is turned by them one after the other from the neutral position, as in the joint coordinate
        system of the ankle (Wu et al. 2002): dorsiflexion, which lifts the toes, about the axis across the
        shank; inversion, which turns the sole inwards; rotation inwards about the axis along the shank. The
        shank's own twist is not measured, so that the last is as good as the pelvis tells where ahead is.

        Reference:
            Wu et al., J. Biomechanics 35 (2002), doi:10.1016/S0021-9290(01)00222-6.
        """
        R = self.rotation
        outwards = R.new_tensor([1.0, -1.0])  # x points away from the left foot's other side
        flexion = torch.atan2(-R[..., 2, 1], R[..., 1, 1])
        inversion = R[..., 0, 1].clamp(-1, 1).asin() * outwards
        rotation = torch.atan2(R[..., 0, 2], R[..., 0, 0])
        return torch.stack([flexion, inversion, -rotation * outwards], -1)

    def points_std(self) -> Float[Tensor, "T 6"]:
        """Return the standard deviation of every point, metres: of an axis, by the mean variance."""
        return mean_std(self.covariance3d)


class TrackedPoints(NamedTuple):
    """Holds joints, then heels and toes if any: names, places [T, K, 3], covariances [T, K, 3, 3]."""

    names: tuple[str, ...]
    points3d: Tensor
    covariance3d: Tensor


def feet_of(details: Mapping[str, Tensor]) -> BodyFeet | None:
    """Return the feet that details of a track hold; None if they hold none."""
    if not set(DETAILS_OF_FEET) <= set(details):
        return None
    return BodyFeet(*(details[name] for name in DETAILS_OF_FEET))
