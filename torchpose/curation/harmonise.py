"""Bones of the mean person for everybody."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.curation.bones import person_bones
from torchpose.curation.upper import BONES, with_upper_joints
from torchpose.errors import InputError, check_shape
from torchpose.io.recordings import Recording
from torchpose.skeleton import UPPER_BODY

__all__ = ["harmonise_bones", "scale_bones"]

_LEVELS = ((0, 1, 4), (2, 5), (3, 6))  # of BONES, from the neck outwards


def scale_bones(
    joints: Float[Tensor, "... 8 3"], factors: Float[Tensor, " 7"]
) -> Float[Tensor, "... 8 3"]:
    """Bones of other lengths in the same directions, rebuilt from the neck outwards.

        x'_neck = x_neck,   x'_b = x'_a + f_ab (x_b - x_a)

    Args:
        joints: of `UPPER_BODY`. factors: f of each of `BONES`.

    Returns:
        Joints; those beyond a missing one are missing, because nothing tells where they would be.
    """
    check_shape("joints", joints, ["...", len(UPPER_BODY), 3])
    check_shape("factors", factors, [len(BONES)])
    built = joints.clone()
    for level in _LEVELS:
        near, far = ([BONES[bone][end] for bone in level] for end in (0, 1))
        bones = joints[..., far, :] - joints[..., near, :]
        built[..., far, :] = built[..., near, :] + factors[list(level), None] * bones
    return built


def harmonise_bones(recordings: Sequence[Recording]) -> list[Recording]:
    """Give everybody the bones of the mean person; directions stay.

    Each of a person's bones is scaled by (mean over persons of median lengths) / (that person's
    median length). Bones that a person lacks stay out of the mean, and keep their length. Joints
    that are none of the eight stay where they are.

    Raises:
        InputError: no recordings.
    """
    if not recordings:
        raise InputError("expected at least one recording, got none")
    usual = person_bones(recordings)
    mean = torch.stack([bones.length for bones in usual.values()]).nanmean(0)
    harmonised = []
    for recording in recordings:
        body = recording.upper_body()
        factors = (mean / usual[recording.person_id, body.neck].length).nan_to_num(1.0)
        joints = scale_bones(body.joints, factors.to(body.joints.dtype))
        note = "bones scaled to the mean person's"
        changed = with_upper_joints(recording, joints)
        harmonised.append(replace(changed, notes=(*recording.notes, note)))
    return harmonised
