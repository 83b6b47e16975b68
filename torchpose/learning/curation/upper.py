"""The eight joints of a recording, out of it and back into it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.errors import check_shape
from torchpose.io.recordings import Recording
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import upper_body_indices

__all__ = ["label", "measured", "runs", "with_missing", "with_upper_joints"]


def label(recording: Recording) -> str:
    """The file of a recording, for people."""
    return str(recording.path) if recording.path is not None else "a recording without a file"


def measured(joints: Float[Tensor, "... J 3"]) -> Bool[Tensor, "... J"]:
    """Which joints are there."""
    return torch.isfinite(joints).all(-1)


def runs(there: Bool[Tensor, " T"], least: int) -> list[slice]:
    """The stretches of at least so many frames in which something is there."""
    edge = there.new_zeros(1)
    steps = torch.cat([edge, there, edge]).long().diff()
    starts, ends = (torch.nonzero(steps == sign).flatten().tolist() for sign in (1, -1))
    return [slice(a, b) for a, b in zip(starts, ends, strict=True) if b - a >= least]


def with_upper_joints(recording: Recording, joints: Float[Tensor, "T 8 3"]) -> Recording:
    """The recording with other places of its eight joints; joints that it has none of stay out.

    Raises:
        ShapeError: another number of frames or joints.
    """
    check_shape("joints", joints, [len(recording), len(UPPER_BODY), 3])
    rows, columns = _columns(recording)
    changed = recording.joints.clone()
    changed[:, columns] = joints[:, rows].to(changed.dtype)
    return replace(recording, joints=changed, weights=_weights(recording, changed))


def with_missing(recording: Recording, missing: Bool[Tensor, "T 8"]) -> Recording:
    """The recording without some of its eight joints in some frames: NaN, and a weight of zero."""
    check_shape("missing", missing, [len(recording), len(UPPER_BODY)])
    if not bool(missing.any()):
        return recording
    joints = recording.upper_body().joints
    return with_upper_joints(recording, torch.where(missing[..., None], torch.nan, joints))


def _columns(recording: Recording) -> tuple[list[int], list[int]]:
    indices = upper_body_indices(recording.names).indices
    rows = [row for row, column in enumerate(indices) if column >= 0]
    return rows, [indices[row] for row in rows]


def _weights(recording: Recording, joints: Tensor) -> Tensor | None:
    if recording.weights is None:
        return None
    return torch.where(measured(joints), recording.weights, 0.0)
