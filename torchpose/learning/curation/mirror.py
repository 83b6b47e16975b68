"""Mirrored copies of recordings."""

from dataclasses import replace

import torch

from torchpose.io.recordings import Recording
from torchpose.skeleton.joint_sets import canonical_names

__all__ = ["mirrored"]

_FLIP = (-1.0, 1.0, 1.0)


def mirrored(recording: Recording) -> Recording:
    """The recording in a mirror at x = 0: left joints become right ones.

    It is of the same person, so that splits keep both together. Joints whose counterpart is not in
    the joint set become missing.
    """
    names = canonical_names(recording.names)
    other = [names.index(n) if n in names else -1 for n in map(_counterpart, names)]
    absent = torch.tensor(other) < 0
    order = torch.tensor(other).clamp_min(0)
    joints = recording.joints[:, order] * recording.joints.new_tensor(_FLIP)
    joints = torch.where(absent[:, None], torch.nan, joints)
    weights = recording.weights
    if weights is not None:
        weights = torch.where(absent, 0.0, weights[:, order])
    notes = (*recording.notes, "mirrored")
    return replace(recording, joints=joints, weights=weights, notes=notes)


def _counterpart(name: str) -> str:
    if name.endswith("_left"):
        return name.removesuffix("left") + "right"
    if name.endswith("_right"):
        return name.removesuffix("right") + "left"
    return name
