"""Compute the joints of an upper body from joint angles, with bones of fixed length.

Axes of the body at rest are those of a camera that the person faces: x towards the person's own
left, y down, z away from the camera (to the person's back). An arm has four angles:

- abduction and flexion, the exponential-map coordinates of the upper arm's swing away from
  hanging: (90 deg, 0) points sideways, (0, 90 deg) forward, negative abduction across the chest;
- twist about the upper arm, positive outwards. At 0 the elbow folds forward when the arm hangs,
  and upward when the arm points forward;
- elbow flexion, 0 = straight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.math._rotations import euler_to_matrix, rotvec_to_matrix

ANGLE_LIMITS = {
    "abduction": (-60.0, 165.0),
    "flexion": (-40.0, 165.0),
    "twist": (-95.0, 90.0),
    "elbow": (3.0, 145.0),
}
"""Range of the arm's angles in degrees, in the order of `BodyAngles.arms`."""


@dataclass(frozen=True)
class BodySize:
    """Holds bone lengths in metres; the defaults are those of Kinect v1 recordings of adults.

    Args:
        upper_arm, forearm: shoulder to elbow, elbow to wrist.
        hand: wrist to the hand joint (the middle of the palm).
        half_shoulders: from the midline to a shoulder, arms hanging.
        neck_above_shoulders: Kinect v1's shoulder_center above the middle of the shoulders.
        head: neck to the middle of the head.
        torso: hips to neck; the torso sways about the hips.
    """

    upper_arm: float = 0.28
    forearm: float = 0.24
    hand: float = 0.065
    half_shoulders: float = 0.168
    neck_above_shoulders: float = 0.106
    head: float = 0.186
    torso: float = 0.41

    def __post_init__(self) -> None:
        for field in fields(self):
            length = getattr(self, field.name)
            if not 0 < length < math.inf:
                raise InputError(f"BodySize.{field.name} must be a length in m, got {length}")


class BodyAngles(NamedTuple):
    """Holds a movement as joint angles, radians.

    Attributes:
        position: of the hips relative to their place at rest [T, 3], metres.
        torso: roll, pitch, yaw [T, 3] about the hips: roll leans to the person's left, pitch bends
            forward, yaw turns to the person's right.
        head: the same [T, 3] about the neck, relative to the torso.
        arms: abduction, flexion, twist, elbow [T, 2, 4] of the left and the right arm.
    """

    position: Tensor
    torso: Tensor
    head: Tensor
    arms: Tensor


def angles_to_joints(
    angles: BodyAngles, size: BodySize | None = None
) -> tuple[Float[Tensor, "T 8 3"], Float[Tensor, "T 2 3"]]:
    """Return the joints of a body of the given size in the given posture.

    The collar bones rise with the upper arms, as in people: by 0.24 of what the arm is raised
    beyond 30 degrees.

    Args:
        angles: `BodyAngles`, radians.
        size: bone lengths.

    Returns:
        Joints [T, 8, 3] and wrists [T, 2, 3] in the body frame, metres.
    """
    size = size or BodySize()
    check_shape("angles.arms", angles.arms, [None, 2, 4])
    like = angles.arms
    torso = euler_to_matrix(angles.torso)
    up = like.new_tensor([0.0, -size.torso, 0.0])
    neck = angles.position - up + torso @ up
    head = neck + _turn(torso @ euler_to_matrix(angles.head), [0.0, -size.head, -0.03])
    # Both arms are computed as left arms; the right one is then mirrored.
    abduction, flexion, twist, elbow = angles.arms.unbind(-1)
    zero = torch.zeros_like(abduction)
    raised = torch.hypot(abduction, flexion)
    shoulder = raised_shoulder(raised, size)
    swing = rotvec_to_matrix(torch.stack([-flexion, zero, -abduction], -1))
    outward = rotvec_to_matrix(torch.stack([zero, -twist, zero], -1))
    fold = rotvec_to_matrix(torch.stack([-elbow, zero, zero], -1))
    upper = swing @ outward
    elbow_at = shoulder + _turn(upper, [0.0, size.upper_arm, 0.0])
    fore = _turn(upper @ fold, [0.0, 1.0, 0.0])
    arm = torch.stack(
        [
            elbow_at + (size.forearm + size.hand) * fore,
            elbow_at,
            shoulder,
            elbow_at + size.forearm * fore,
        ],
        -2,
    )  # [T, 2, 4, 3]: hand, elbow, shoulder, wrist
    side = like.new_tensor([[1.0, 1, 1], [-1.0, 1, 1]])
    arm = neck[:, None, None] + (arm * side[:, None]) @ torso[:, None].mT
    left, right = arm.unbind(1)
    middle = torch.stack([head, neck], 1)
    joints = torch.cat([left[:, :3], middle, right[:, :3].flip(1)], 1)
    return joints, arm[:, :, 3]


def raised_shoulder(raised: Tensor, size: BodySize) -> Tensor:
    """Return the left shoulder relative to the neck [..., 3] for an arm raised by an angle, radians."""
    shrug = 0.24 * torch.nn.functional.softplus(raised - math.radians(30), beta=6.0)
    zero = torch.zeros_like(shrug)
    collar = rotvec_to_matrix(torch.stack([zero, zero, -shrug], -1))
    return _turn(collar, [size.half_shoulders, size.neck_above_shoulders, 0.0])


def _turn(rotation: Tensor, vector: Sequence[float]) -> Tensor:
    return rotation @ rotation.new_tensor(vector)
