"""Align poses with the torso, and place necks, on which joint sets disagree by up to 12 cm.

The 3D error compares such poses (BL section 6). They do not depend on how the person stands towards the
camera, so that estimates from different views may be averaged.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.value_checks import seen_finite
from torchpose.errors import PriorError
from torchpose.math._rotations import motion_of_all, procrustes
from torchpose.skeleton._joint_sets import UPPER_BODY

ALIGN_JOINTS = (3, 4, 2, 5)
"""Head, neck and both shoulders of the 8-joint upper body: what the paper aligns (BL section 6)."""

_ALIGNED = slice(min(ALIGN_JOINTS), max(ALIGN_JOINTS) + 1)  # they lie side by side

TORSO = ((0.0, -0.20, 0.0), (0.0, -0.01, 0.0), (0.16, 0.10, 0.0), (-0.16, 0.10, 0.0))
"""Head, neck, left and right shoulder, metres: x to the person's left, y down, about their middle."""


def in_torso_axes(joints: Float[Tensor, "*batch 8 3"]) -> Float[Tensor, "*batch 8 3"]:
    """Return the eight joints, moved so that head, neck and shoulders lie on `TORSO` as well as they can.

    Args:
        joints: any axes, metres.
    """
    chosen = list(ALIGN_JOINTS)
    torso = joints.new_tensor(TORSO).expand(*joints.shape[:-2], -1, -1)
    motion = procrustes(joints[..., chosen, :], torso)
    return joints @ motion.rotation.mT + motion.translation[..., None, :]


def upright_axes(turn: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation from camera axes to upright axes that turn with the shoulders.

    x points to the person's left along the level part of the line between the shoulders, y down.

    Args:
        turn: of the shoulders about the vertical, radians: (cos, 0, -sin) points to the left one.
    """
    cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
    rows = [cos, zero, -sin, zero, torch.ones_like(turn), zero, sin, zero, cos]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def onto_torso(
    pose: Float[Tensor, "*batch 8 3"],
    covs: Float[Tensor, "*batch 8 3 3"],
    joints: Float[Tensor, "*batch 8 3"],
) -> tuple[Float[Tensor, "*batch 8 3"], Float[Tensor, "*batch 8 3 3"]]:
    """Return a pose with covariances, moved to where the head, neck and shoulders of another one are.

    Args:
        pose, covs: in the axes of the torso. joints: of which only head, neck and shoulders count.
    """
    source, target = pose[..., _ALIGNED, :], joints[..., _ALIGNED, :]
    align = motion_of_all if seen_finite(source) and seen_finite(target) else procrustes
    motion = align(source, target)
    moved = pose @ motion.rotation.mT + motion.translation[..., None, :]
    turn = motion.rotation[..., None, :, :]
    return moved, turn @ covs @ turn.mT


_LEFT, _HEAD, _NECK, _RIGHT = (
    UPPER_BODY.index(name) for name in ("shoulder_left", "head", "neck", "shoulder_right")
)
LEAST_FRAMES = 10


class NeckOffset(NamedTuple):
    """Places the neck above the middle of the shoulders, in units of the height h of the head above it.

    neck = middle + h (up e_up + forward e_forward), e_up pointing from the middle of the shoulders
    to the head, e_forward to the front, square to e_up and to the line of the shoulders. There is
    no part along that line, since bodies are symmetric.

    Attributes:
        up, forward: the two shares of h.
        residual: root mean square distance from the necks it was learnt from, metres.
        frames: how many those were.
    """

    up: float
    forward: float
    residual: float
    frames: int


class NeckFraction(NamedTuple):
    """Places the neck in an image, on the line from the middle of the shoulders to the head.

    neck = middle + fraction (head - middle) + N(0, spread^2)

    Attributes:
        fraction: of the way. spread: metres, in either direction of the image.
        frames: from how many poses.
    """

    fraction: float
    spread: float
    frames: int


KINECT_NECK = NeckFraction(0.369, 0.0151, 43314)
"""Kinect's neck (v1 shoulder_center), from persons s1 to s6 of UTD-MHAD by `learn_neck_fraction`."""


def learn_neck_fraction(joints: Float[Tensor, "N 8 3"]) -> NeckFraction:
    """Return the least-squares place of the neck in the image, from poses that have one.

    Seen from afar the image is the plane of x and y, up to scale:
        fraction = sum (neck - middle) . (head - middle) / sum |head - middle|^2.

    Args:
        joints: poses in the order of `UPPER_BODY`, camera axes, metres; NaN where a joint is missing.

    Raises:
        PriorError: fewer than ten poses with head, neck and both shoulders.
    """
    check_shape("joints", joints, (None, 8, 3))
    left, head, neck, right = joints[:, [_LEFT, _HEAD, _NECK, _RIGHT], :2].double().unbind(1)
    middle = (left + right) / 2
    height, offset = head - middle, neck - middle
    usable = torch.isfinite(torch.cat([height, offset], 1)).all(1)
    height, offset = height[usable], offset[usable]
    if len(height) < LEAST_FRAMES:
        raise PriorError(
            "the neck's place needs recordings with head, neck and both shoulders, got "
            f"{len(height)} such frames; add a recording with a neck"
        )
    fraction = (offset * height).sum() / height.square().sum()
    spread = (offset - fraction * height).square().mean().sqrt()
    return NeckFraction(float(fraction), float(spread), len(height))


def learn_neck_offset(joints: Float[Tensor, "N 8 3"]) -> NeckOffset:
    """Return the least-squares offset of the neck from poses that have one.

    Args:
        joints: poses in the order of `UPPER_BODY`, metres; NaN where a joint is missing.

    Raises:
        PriorError: fewer than ten poses with head, neck and both shoulders.
    """
    check_shape("joints", joints, (None, 8, 3))
    needed = joints[:, [_LEFT, _HEAD, _NECK, _RIGHT]]
    joints = joints[torch.isfinite(needed).flatten(1).all(1)].double()
    middle, up, forward = _axes(joints)
    usable = torch.isfinite(forward).all(-1)
    joints, middle, up, forward = (t[usable] for t in (joints, middle, up, forward))
    if len(joints) < LEAST_FRAMES:
        raise PriorError(
            "a neck offset needs recordings with head, neck and both shoulders, got "
            f"{len(joints)} such frames; add a recording with a neck, or fit on one kind of neck"
        )
    offset = joints[:, _NECK] - middle
    # the axes are orthogonal and of one length h, so the two coefficients separate
    norm = up.square().sum()
    a, b = (offset * up).sum() / norm, (offset * forward).sum() / norm
    residual = (offset - a * up - b * forward).square().sum(-1).mean().sqrt()
    return NeckOffset(float(a), float(b), float(residual), len(joints))


def place_neck(
    joints: Float[Tensor, "*batch 8 3"], offset: NeckOffset
) -> Float[Tensor, "*batch 8 3"]:
    """Return the poses with the neck put where `offset` says; NaN where head or a shoulder is missing.

    Args:
        joints: poses in the order of `UPPER_BODY`, metres.
        offset: the offset from `learn_neck_offset`.
    """
    check_shape("joints", joints, ("...", 8, 3))
    middle, up, forward = _axes(joints)
    placed = joints.clone()
    placed[..., _NECK, :] = middle + offset.up * up + offset.forward * forward
    return placed


def _axes(joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the middle of the shoulders, and upward and forward axis of the length of the head's height."""
    left, right = joints[..., _LEFT, :], joints[..., _RIGHT, :]
    middle = (left + right) / 2
    up = joints[..., _HEAD, :] - middle
    height = torch.linalg.vector_norm(up, dim=-1, keepdim=True)
    # camera axes: x to the person's left, y down, z away, so left x up = (1,0,0) x (0,-1,0) = -z
    forward = torch.linalg.cross(left - right, up, dim=-1)
    forward = forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True)
    return middle, up, forward * height
