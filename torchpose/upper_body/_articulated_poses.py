"""Read estimates of articulated bodies, frame by frame, as the `Estimates` of the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera._projection import project
from torchpose.filters._outputs import FilterOutput
from torchpose.math._rotations import euler_to_matrix
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._arm_chain import ArmChain, ArmState
from torchpose.upper_body._estimator import Bones, Estimates, ReadOut
from torchpose.upper_body._lean import rolled

__all__ = [
    "ELBOWS",
    "HANDS",
    "SHOULDERS",
    "SIDES",
    "FramePose",
    "SeenBody",
    "bones_of",
    "estimates_of",
    "pose_of",
]

_NECK = UPPER_BODY.index("neck")
SHOULDERS, ELBOWS, HANDS = (
    [UPPER_BODY.index(f"{joint}_{side}") for side in ("left", "right")]
    for joint in ("shoulder", "elbow", "hand")
)
SIDES = ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.0))
"""Signs of the axes by which right arms are mirrored."""
_STD = 0.03  # metres: of every joint in space
# Factors on the covariances of arms that are seen whole, and of those of which the hand is seen alone, at
# full confidence: as four sets needed that were in no fit (at the median 0.45 to 0.51 and 0.31 to 0.74).
# Other covariances hold as they are, with detectors' errors too.
_WHOLE, _HAND_ALONE = 0.55, 0.75


class SeenBody(NamedTuple):
    """A body in one frame but for its arms, in tilted axes: of a camera that is rolled by its lean.

    Attributes:
        joints: shoulders, neck and head, metres, [B, 8, 3]; the others are 0.
        known: which of the eight joints are measured, [B, 8].
        exact: whether every keypoint has full confidence, [B].
        lengths: the lengths of the bones, metres, [B, 4]. bones: the same as they are reported, with
            their covariances.
        scale: the standard deviation of the log of their common scale, [B].
        others: the covariances of both elbows, then both hands, over the hypotheses of the root
            (`covs_of_roots`), [B, 4, 3, 3].
        far: the variance of the log of the depth, [B].
        turn, lean: the turn of the shoulders and the roll of the tilted axes, radians, [B].
    """

    joints: Tensor
    known: Tensor
    exact: Tensor
    lengths: Tensor
    bones: Bones
    scale: Tensor
    others: Tensor
    far: Tensor
    turn: Tensor
    lean: Tensor


class FramePose(NamedTuple):
    """Estimate of one frame, or of T of them.

    Attributes:
        joints: camera axes, metres, [B, 8, 3]. covs: [B, 8, 3, 3].
        turn, lean: of the shoulders, radians, [B].
        log_evidence: the log-evidence of both arms, [B, 2].
        log_weights: the log-weights of their hypotheses, [B, 2, N].
        bones, bone_covs: the lengths of bones, [B, 4], and their covariances, [B, 4, 4].
    """

    joints: Tensor
    covs: Tensor
    turn: Tensor
    lean: Tensor
    log_evidence: Tensor
    log_weights: Tensor
    bones: Tensor
    bone_covs: Tensor


def bones_of(
    directions: Float[Tensor, "B 2 N 6"],
    axes: Float[Tensor, "B 1 M 3 3"],
    lengths: Float[Tensor, "B 4"],
) -> Float[Tensor, "B 2 N 2 3"]:
    """Return upper arms and forearms in camera axes, metres.

    Args:
        directions: the directions of left and mirrored right arms, upright axes.
        axes: the rotation from camera to upright axes. lengths: the lengths of the bones, metres.
    """
    flip = directions.new_tensor(SIDES)[:, None, None]
    return directions.unflatten(-1, (2, 3)) * flip @ axes * lengths[:, None, None, :2, None]


def pose_of(
    body: SeenBody, belief: ArmState, matrix: Float[Tensor, "3 3"], calibrated: bool = True
) -> FramePose:
    """Return the estimate of a frame, in camera axes: bones point along their posterior mean direction.

    They keep their lengths where elbow and hand are measured. Where not, the mean is not normalised, so that
    the joints are nearer to the shoulder: this is the estimate of least mean squared error.

    Args:
        body: the body but for its arms. belief: the posterior of the arms. matrix: K of the prior's camera.
        calibrated: whether the covariances of measured arms are scaled as recordings of other persons
            needed.
    """
    axes = upright_axes(body.turn)[:, None, None]
    known = body.known[:, [ELBOWS, HANDS]]
    mean = ArmChain.mean_directions(belief, known.all(1)).flatten(2)[:, :, None]
    joints = body.joints.clone()
    arms = joints[:, SHOULDERS, None] + bones_of(mean, axes, body.lengths)[:, :, 0].cumsum(-2)
    joints[:, ELBOWS], joints[:, HANDS] = arms.unbind(2)
    covs = _covs(body, belief, joints)
    if calibrated:
        trust = _trust(body.known, body.exact).to(covs)[..., None, None]
        covs[:, ELBOWS], covs[:, HANDS] = trust * covs[:, ELBOWS], trust * covs[:, HANDS]
    area = 2 * body.joints[:, SHOULDERS, 2].mean(1).log() - matrix.diagonal()[:2].log().sum()
    evidence = belief.log_evidence + known.sum(1).to(area) * area[:, None]
    evidence = torch.where(known.any(1), evidence, 0.0)
    covs = rolled(rolled(covs, body.lean).mT, body.lean)
    weight = belief.weight.clamp_min(1e-30).log()
    return FramePose(
        rolled(joints, body.lean), covs, body.turn, body.lean, evidence, weight,
        body.bones.metres, body.bones.covs,
    )  # fmt: skip


def _trust(known: Bool[Tensor, "B 8"], exact: Bool[Tensor, " B"]) -> Float[Tensor, "B 2"]:
    """Return the factors on the covariances of both arms, by which of their joints are measured."""
    shoulder, elbow, hand = (known[:, rows] for rows in (SHOULDERS, ELBOWS, HANDS))
    one = torch.ones(elbow.shape, device=known.device)
    trust = torch.where(hand & ~elbow, _HAND_ALONE, one)
    trust = torch.where(shoulder & elbow & hand, _WHOLE, trust)
    return torch.where(exact[:, None], trust, one)


def _covs(body: SeenBody, belief: ArmState, joints: Tensor) -> Float[Tensor, "B 8 3 3"]:
    """Return the covariances of the joints: posterior spread, stiffness of the torso, and common scale."""
    covs = torch.eye(3).to(joints).mul(_STD**2).expand(*joints.shape, 3).clone()
    axes = upright_axes(body.turn)[:, None, None]
    ends = bones_of(belief.directions, axes, body.lengths).cumsum(-2)
    for limb, rows in enumerate((ELBOWS, HANDS)):
        off = ends[..., limb, :] - (joints[:, rows] - joints[:, SHOULDERS])[:, :, None]
        covs[:, rows] += (belief.weight[..., None] * off).mT @ off
        covs[:, rows] += body.others[:, 2 * limb : 2 * limb + 2]
    apart = joints - joints[:, _NECK, None]
    scale = body.scale.square()[:, None, None, None]
    covs = covs + scale * apart[..., :, None] * apart[..., None, :]
    inferred = ~body.known[:, SHOULDERS]  # seen hands are as far from them as the body is away
    across = apart[:, HANDS] * apart.new_tensor([1.0, 1.0, 0.0]) * inferred[..., None]
    covs[:, HANDS] += body.far[:, None, None, None] * across[..., :, None] * across[..., None, :]
    return covs


def estimates_of(
    poses: Sequence[FramePose],
    matrix: Float[Tensor, "3 3"],
    names: tuple[str, ...],
) -> Estimates:
    """Return the estimates of both arms and the poses they were made from.

    Args:
        poses: the pose of each frame. matrix: K of the prior's camera. names: the names of the bone
            lengths.
    """
    stacked = FramePose(*(torch.stack(values, 1) for values in zip(*poses, strict=True)))
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
    reading = ReadOut(joints, covs, angles, neck, uv, uv_covs)
    bones = Bones(names, stacked.bones, stacked.bone_covs)
    return Estimates(left, right, None, reading, bones)


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
