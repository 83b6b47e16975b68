"""Place shoulders, neck and head of an articulated body, on their rays where they are measured."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import KINECT_NECK
from torchpose.upper_body._articulated_frame import UprightFrame
from torchpose.upper_body._face_points import head_in_face
from torchpose.upper_body._torso_likelihood import (
    Root,
    TorsoLengths,
    half_widths,
    shoulder_offsets,
)

_BESIDE = UPPER_BODY.index("shoulder_left")  # rows of limbs before, and after, those of the torso


def shoulder_places(
    frame: UprightFrame, root: Root, middle: Float[Tensor, "B M 3"], width: Float[Tensor, " B"]
) -> Float[Tensor, "B 2 M 3"]:
    """Return both shoulders given each hypothesis of the root, camera axes.

    Args:
        frame: the measurements. root: the hypotheses. middle: the middle of the shoulders given each.
        width: the distance between the shoulders, metres.
    """
    half = half_widths(width, frame.torso.raised(root.depth)) * root.size[..., None]
    offsets = shoulder_offsets(root.turn, half)
    inferred = (middle[..., None, :] + offsets).transpose(1, 2)
    if not frame.torso.sided:
        return inferred
    ray = frame.torso.rays[:, :2, None]
    on_ray = ray / ray[..., 2:] * inferred[..., 2:]
    return torch.where(frame.torso.known[:, :2, None, None], on_ray, inferred)


def torso_joints(
    frame: UprightFrame,
    root: Root,
    middle: Float[Tensor, "B 1 3"],
    shoulders: Float[Tensor, "B 2 3"],
    lengths: TorsoLengths,
    angles: Float[Tensor, " P"],
    neck_between: bool,
) -> Float[Tensor, "B 8 3"]:
    """Return shoulders, neck and head given one hypothesis of the root, camera axes; the others are 0.

    Args:
        frame: the measurements. root: the hypothesis. middle: the middle of the shoulders.
        shoulders: their places. lengths: the lengths of the torso.
        angles: the turns of heads that are tried (`head_in_face`).
        neck_between: whether the neck was measured as the middle of the shoulders, so that it is put
            between that and the head.
    """
    neck, head = _spine(frame, root, middle, lengths, angles)
    if neck_between:
        neck = shoulders.mean(1).lerp(head, KINECT_NECK.fraction)
    left, right = shoulders.unbind(1)
    return pad(torch.stack([left, head, neck, right], 1), (0, 0, _BESIDE, _BESIDE))


def _spine(
    frame: UprightFrame, root: Root, middle: Tensor, lengths: TorsoLengths, angles: Tensor
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
    """Return neck and head: on their rays where they are measured, the head else by its face."""
    upright = middle + lengths.spine * root.size[..., None]
    ray, known = frame.torso.rays[:, 2:], frame.torso.known[:, 2:, None]
    on_ray = ray / ray[..., 2:] * upright[..., 2:]
    neck, head = torch.where(known, on_ray, upright).unbind(1)
    if frame.face is not None:
        std, depth, turn = frame.given.std.amin(1), upright[:, 1, 2], root.turn[:, 0]
        of_face, visible = head_in_face(frame.face, std, depth, turn, angles)
        head = torch.where(visible[:, None] & ~known[:, 1], of_face, head)
    return neck, head
