"""Bones of the mean person for everybody."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchpose.errors import InputError
from torchpose.io.recordings import Recording
from torchpose.learning.curation.bones import person_bones
from torchpose.learning.curation.upper import with_upper_joints
from torchpose.skeleton.upper_body import scale_bones

__all__ = ["harmonise_bones"]


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
