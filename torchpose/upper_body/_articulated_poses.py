"""Read estimates of articulated bodies, some frames at a time, as the `Estimates` of the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchpose._core.module_state import outside_inference
from torchpose.filters._outputs import FilterOutput, first_not_finite
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._arm_chain import ArmState, mirrored
from torchpose.upper_body._articulated_frame import ELBOWS, HANDS, SHOULDERS
from torchpose.upper_body._estimator import Bones, Estimates, ReadOut

_NECK = UPPER_BODY.index("neck")
_STD = 0.03  # metres: of every joint in space
# Factors on the covariances of arms that are seen whole, and of those of which the hand is seen alone, at
# full confidence: as four sets needed that were in no fit (at the median 0.45 to 0.51 and 0.31 to 0.74).
# Other covariances hold as they are, with detectors' errors too.
_WHOLE, _HAND_ALONE = 0.55, 0.75
_ROUNDS = 3  # in which bones of given lengths are fitted to elbow and hand


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
        turn: the turn of the shoulders, radians, [B]. tilt: the roll of the tilted axes, [B, 3, 3].
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
    tilt: Tensor


class FramePose(NamedTuple):
    """Estimate of one frame, or of T of them.

    Attributes:
        joints: camera axes, metres, [B, 8, 3]. covs: [B, 8, 3, 3].
        means, mean_covs: the posterior means of the joints, of which bones may be shorter, and the
            covariances about these.
        turn: of the shoulders, radians, [B]. tilt: of the torso about the optical axis, [B, 3, 3].
        log_evidence: the log-evidence of both arms, [B, 2].
        log_weights: the log-weights of their hypotheses, [B, 2, N].
        bones, bone_covs: the lengths of bones, [B, 4], and their covariances, [B, 4, 4].
    """

    joints: Tensor
    covs: Tensor
    means: Tensor
    mean_covs: Tensor
    turn: Tensor
    tilt: Tensor
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
    bones = mirrored(directions.unflatten(-1, (2, 3))) @ axes
    return bones * lengths[:, None, None, :2, None]


def pose_of(
    body: SeenBody, belief: ArmState, matrix: Float[Tensor, "3 3"], calibrated: bool = True
) -> FramePose:
    """Return the estimate of a frame, in camera axes: the pose of least expected squared error.

    Where elbow and hand are measured, it is that among the poses whose bones keep their lengths. Where not,
    it is the posterior mean, whose joints are nearer to the shoulder.

    Args:
        body: the body but for its arms. belief: the posterior of the arms. matrix: K of the prior's camera.
        calibrated: whether the covariances of measured arms are scaled as recordings of other persons
            needed.
    """
    axes = upright_axes(body.turn)[:, None, None]
    known = body.known[:, [ELBOWS, HANDS]]
    mean = belief.weight[:, :, None] @ belief.directions
    shoulders = body.joints[:, SHOULDERS]
    means = bones_of(mean, axes, body.lengths).cumsum(-2)[:, :, 0]
    both = known.all(1)[..., None, None]
    arms = torch.where(both, _with_lengths(means, body.lengths), means)
    ends = bones_of(belief.directions, axes, body.lengths).cumsum(-2)
    off = (ends - means[:, :, None]).transpose(2, 3)
    spread = (belief.weight[:, :, None, :, None] * off).mT @ off
    limbs = (shoulders[:, :, None] + arms).transpose(1, 2).flatten(1, 2)
    moved = (means - arms).transpose(1, 2).flatten(1, 2)
    joints = body.joints.index_copy(1, _limb_rows(limbs.device), limbs)
    trust = torch.ones_like(joints[..., 0])
    if calibrated:
        of_limbs = _trust(body.known, body.exact).to(trust).repeat(1, 2)
        trust = trust.index_copy(1, _limb_rows(limbs.device), of_limbs)
    trust = trust[..., None, None]
    mean_covs = trust * _covs(body, joints, spread.transpose(1, 2).flatten(1, 2))
    apart = torch.zeros_like(joints).index_copy(1, _limb_rows(limbs.device), moved)
    covs = mean_covs + trust * apart[..., :, None] * apart[..., None, :]
    area = 2 * shoulders[..., 2].mean(1).log() - matrix.diagonal()[:2].log().sum()
    evidence = belief.log_evidence + known.sum(1).to(area) * area[:, None]
    evidence = torch.where(known.any(1), evidence, 0.0)
    tilt = body.tilt[:, None]
    weight = belief.weight.clamp_min(1e-30).log()
    return FramePose(
        joints @ body.tilt.mT, tilt @ covs @ tilt.mT, (joints + apart) @ body.tilt.mT,
        tilt @ mean_covs @ tilt.mT, body.turn, body.tilt, evidence, weight, body.bones.metres,
        body.bones.covs,
    )  # fmt: skip


def _with_lengths(
    means: Float[Tensor, "B 2 2 3"], lengths: Float[Tensor, "B 4"]
) -> Float[Tensor, "B 2 2 3"]:
    """Return the elbows and hands nearest to given ones, by squared distances, of bones of given lengths.

    Either bone is best in turn: u = L_u (m_e + m_h - f) / |m_e + m_h - f|, f = L_f (m_h - u) / |m_h - u|.

    Args:
        means: m_e and m_h, elbows and hands from the shoulders, metres. lengths: of the bones, metres.
    """
    elbow, hand = means.unbind(-2)
    upper_arm, forearm = lengths[:, None, :2, None].unbind(-2)
    upper = upper_arm * normalize(elbow, dim=-1)
    lower = forearm * normalize(hand - upper, dim=-1)
    for _ in range(_ROUNDS):
        upper = upper_arm * normalize(elbow + hand - lower, dim=-1)
        lower = forearm * normalize(hand - upper, dim=-1)
    return torch.stack([upper, upper + lower], -2)


@cache
def _limb_rows(device: torch.device) -> Int[Tensor, "4"]:
    """Return the rows of both elbows and both hands."""
    with outside_inference():
        return torch.tensor([*ELBOWS, *HANDS], device=device)


def _trust(known: Bool[Tensor, "B 8"], exact: Bool[Tensor, " B"]) -> Float[Tensor, "B 2"]:
    """Return the factors on the covariances of both arms, by which of their joints are measured."""
    shoulder, elbow, hand = (known[:, rows] for rows in (SHOULDERS, ELBOWS, HANDS))
    one = torch.ones(elbow.shape, device=known.device)
    trust = torch.where(hand & ~elbow, _HAND_ALONE, one)
    trust = torch.where(shoulder & elbow & hand, _WHOLE, trust)
    return torch.where(exact[:, None], trust, one)


def _covs(
    body: SeenBody, joints: Float[Tensor, "B 8 3"], spread: Float[Tensor, "B 4 3 3"]
) -> Float[Tensor, "B 8 3 3"]:
    """Return the covariances of the joints: posterior spread, stiffness of the torso, and common scale.

    Args:
        body: the body but for its arms. joints: all of its joints. spread: that of both elbows, then both
            hands, over the posterior.
    """
    apart = joints - joints[:, _NECK, None]
    outer = apart[..., :, None] * apart[..., None, :]
    still = _STD**2 * torch.eye(3, dtype=joints.dtype, device=joints.device)
    covs = still + body.scale.square()[:, None, None, None] * outer
    # seen hands are as far from shoulders that are not as the body is away
    inferred = body.far[:, None] * ~body.known[:, SHOULDERS]
    flat = torch.nn.functional.pad(outer[:, HANDS, :2, :2], (0, 1, 0, 1))
    limbs = spread + body.others
    limbs = torch.cat([limbs[:, :2], limbs[:, 2:] + inferred[..., None, None] * flat], 1)
    return covs.index_add(1, _limb_rows(joints.device), limbs)


def estimates_of(
    poses: Sequence[FramePose],
    batch_size: int,
    matrix: Float[Tensor, "3 3"],
    names: tuple[str, ...],
) -> Estimates:
    """Return the estimates of both arms and the poses they were made from.

    Args:
        poses: the poses of some frames of all B sequences at a time, [B T', ...]. batch_size: B.
        matrix: K of the prior's camera. names: the names of the bone lengths.
    """
    stacked = FramePose(*(
        torch.cat([value.unflatten(0, (batch_size, -1)) for value in values], 1)
        for values in zip(*poses, strict=True)
    ))  # fmt: skip
    neck = stacked.joints[:, :, _NECK]
    lean = torch.atan2(stacked.tilt[..., 1, 0], stacked.tilt[..., 0, 0])
    angles = torch.stack([lean, torch.zeros_like(lean), stacked.turn], -1)
    back = upright_axes(stacked.turn) @ stacked.tilt.mT
    joints = (stacked.joints - neck[:, :, None]) @ back.mT
    covs = back[:, :, None] @ stacked.covs @ back.mT[:, :, None]
    # measured joints are seen where they are measured, though bones that are unsure keep their lengths
    seen = stacked.means @ matrix.mT
    uv = seen[..., :2] / seen[..., 2:]
    uv_covs = _pixel_covs(stacked.means, stacked.mean_covs, matrix)
    failed_at = first_not_finite(joints.flatten(2))
    left, right = (
        FilterOutput(
            joints.flatten(2), stacked.log_weights[:, :, arm], stacked.log_evidence[:, :, arm], None,
            failed_at,
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
