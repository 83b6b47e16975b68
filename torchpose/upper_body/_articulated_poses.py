"""Read estimates of articulated bodies, frame by frame, as the `Estimates` of the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.camera._projection import project
from torchpose.filters._outputs import FilterOutput
from torchpose.math._rotations import euler_to_matrix
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator import Estimates, ReadOut

__all__ = ["FramePose", "estimates_of"]

_NECK = UPPER_BODY.index("neck")


class FramePose(NamedTuple):
    """Estimate of one frame, or of T of them.

    Attributes:
        joints: camera axes, [B, 8, 3]. covs: [B, 8, 3, 3]. turn, lean: of the shoulders, [B].
        log_evidence: of both arms, [B, 2]. log_weights: of their hypotheses, [B, 2, N].
    """

    joints: Tensor
    covs: Tensor
    turn: Tensor
    lean: Tensor
    log_evidence: Tensor
    log_weights: Tensor


def estimates_of(
    poses: Sequence[FramePose],
    matrix: Float[Tensor, "3 3"],
    lengths: Int[Tensor, " B"] | None = None,
) -> Estimates:
    """Return the estimates of both arms and the poses; past the lengths the last ones again.

    Args:
        poses: of each frame. matrix: K of their pixels.
        lengths: frames of each sequence, None for all.
    """
    stacked = FramePose(*(torch.stack(values, 1) for values in zip(*poses, strict=True)))
    if lengths is not None:
        stacked = _repeated(stacked, lengths.to(stacked.joints.device))
    neck = stacked.joints[:, :, _NECK]
    level = torch.zeros_like(stacked.turn)
    angles = torch.stack([stacked.lean, level, stacked.turn], -1)
    back = euler_to_matrix(angles).mT  # the same in either order
    joints = (stacked.joints - neck[:, :, None]) @ back.mT
    covs = back[:, :, None] @ stacked.covs @ back.mT[:, :, None]
    uv = project(joints, matrix, back.mT, neck)[..., :2]
    uv_covs = _pixel_covs(stacked.joints, stacked.covs, matrix)
    never = torch.full((len(neck),), -1, dtype=torch.long, device=neck.device)
    left, right = (
        FilterOutput(
            joints.flatten(2), stacked.log_weights[:, :, arm], stacked.log_evidence[:, :, arm], None,
            never,
        )
        for arm in (0, 1)
    )  # fmt: skip
    return Estimates(left, right, None, ReadOut(joints, covs, angles, neck, uv, uv_covs))


def _repeated(poses: FramePose, lengths: Int[Tensor, " B"]) -> FramePose:
    """Return the poses with the last one of each sequence past its length, without evidence there."""
    frames = torch.arange(poses.joints.shape[1], device=lengths.device)
    last = frames.minimum(lengths[:, None] - 1)
    rows = torch.arange(len(last), device=last.device)[:, None]
    poses = FramePose(*(values[rows, last] for values in poses))
    past = (frames >= lengths[:, None])[..., None]
    return poses._replace(log_evidence=poses.log_evidence.masked_fill(past, 0.0))


def _pixel_covs(
    joints: Float[Tensor, "*batch 3"],
    covs: Float[Tensor, "*batch 3 3"],
    matrix: Float[Tensor, "3 3"],
) -> Float[Tensor, "*batch 2 2"]:
    """Return the covariances of the joints' pixels, to first order."""
    depth = joints[..., 2:].clamp_min(0.1)
    eye = torch.eye(2).to(joints).expand(*joints.shape[:-1], 2, 2)
    slopes = torch.cat([eye, -(joints[..., :2] / depth)[..., None]], -1) / depth[..., None]
    slopes = matrix[:2, :2] @ slopes
    return slopes @ covs @ slopes.mT
