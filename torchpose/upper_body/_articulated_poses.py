"""Read estimates of articulated bodies, some frames at a time, as the `Estimates` of the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import index_tensor
from torchpose.filters._outputs import FilterOutput, first_not_finite
from torchpose.math._gaussian import safe_cholesky, symmetrise
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._arm_chain import ArmState, mirrored
from torchpose.upper_body._articulated_frame import HANDS, LIMBS, SHOULDERS
from torchpose.upper_body._estimator import Bones, Estimates, SeenPoses
from torchpose.upper_body._measured_joints import MeasuredJoints

_NECK = UPPER_BODY.index("neck")
_STD = 0.03  # metres: of every joint in space
_NOISE = 0.02  # metres: of that, the noise of keypoints
# Factors on the covariances of arms that are seen whole, and of those of which the hand is seen alone, at
# full confidence: as four sets needed that were in no fit (at the median 0.45 to 0.51 and 0.31 to 0.74).
# Other covariances hold as they are, with detectors' errors too.
_WHOLE, _HAND_ALONE = 0.55, 0.75
_ROUNDS = 3  # in which bones of given lengths are fitted to elbow and hand


class SeenBody(NamedTuple):
    """A body in one frame but for its arms, in tilted axes: of a camera that is rolled by its lean.

    Attributes:
        joints: shoulders, neck and head, metres, [B, 8, 3]; the others are 0.
        shoulders: whether these are measured, [B, 2]. limbs: whether elbow and hand of both arms are,
            [B, 2, 2]. whole: whether both of any arm are.
        moved: as of `RayFrame`.
        exact: whether every keypoint has full confidence, [B].
        std: the standard deviation of a pixel over the focal length, 0 where no joint is measured, [B, 8].
        lengths: the lengths of the bones, metres, [B, 4]. bones: the same as they are reported, with
            their covariances.
        scale: the standard deviation of the log of their common scale, [B].
        others: the covariances of `LIMBS` over the hypotheses of the root (`covs_of_roots`), [B, 4, 3, 3].
        far: the variance of the log of the depth, [B].
        axes: the rotation from tilted to upright axes that turn with the shoulders, [B, 3, 3].
        tilt: the roll of the tilted axes, [B, 3, 3].
    """

    joints: Tensor
    shoulders: Tensor
    limbs: Tensor
    whole: bool
    moved: Tensor | None
    exact: Tensor
    std: Tensor
    lengths: Tensor
    bones: Bones
    scale: Tensor
    others: Tensor
    far: Tensor
    axes: Tensor
    tilt: Tensor


class FramePose(NamedTuple):
    """Estimate of one frame, or of T of them.

    Attributes:
        joints: camera axes, metres, [B, 8, 3]. covs: [B, 8, 3, 3].
        means, mean_covs: the posterior means of the joints, of which bones may be shorter, and the
            covariances about these.
        rotation: from the axes of the body to those of the camera, [B, 3, 3].
        log_evidence: the log-evidence of both arms, [B, 2].
        log_weights: the log-weights of their hypotheses, [B, 2, N].
        bones, bone_covs: the lengths of bones, [B, 4], and their covariances, [B, 4, 4].
    """

    joints: Tensor
    covs: Tensor
    means: Tensor
    mean_covs: Tensor
    rotation: Tensor
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
    body: SeenBody, belief: ArmState, log_focal: Float[Tensor, ""], calibrated: bool = True
) -> FramePose:
    """Return the estimate of a frame, in camera axes: the pose of least expected squared error.

    Where elbow and hand are measured, it is that among the poses whose bones keep their lengths. Where not,
    it is the posterior mean, whose joints are nearer to the shoulder.

    Args:
        body: the body but for its arms. belief: the posterior of the arms.
        log_focal: the log of the focal length, pixels. calibrated: whether the covariances of measured arms
            are scaled as recordings of other persons needed.
    """
    axes, rows = body.axes, index_tensor(LIMBS, body.axes.device)
    shoulders = body.joints[:, SHOULDERS]
    ends = bones_of(belief.directions, axes[:, None, None], body.lengths).cumsum(-2)
    weight = belief.weight[..., None]
    means = (weight.mT @ ends.flatten(-2)).unflatten(-1, (2, 3))
    off = (ends - means).transpose(2, 3)
    spread = (weight[:, :, None] * off).mT @ off
    means = means[:, :, 0]
    arms = means
    if body.whole:
        both = body.limbs.all(-1)[..., None, None]
        arms = torch.where(both, _with_lengths(means, body.lengths), means)
    joints = body.joints.index_copy(1, rows, (shoulders[:, :, None] + arms).flatten(1, 2))
    trust = _trust(body.shoulders, body.limbs, body.exact).to(joints)
    trust = trust if calibrated else torch.ones_like(trust)
    trust = trust.repeat_interleave(2, 1)[..., None, None]
    spread = spread.flatten(1, 2)
    if body.moved is not None:
        eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
        spread = spread + body.moved.flatten(1)[..., None, None] * eye
    covs, of_limbs = _covs(body, joints, spread, trust)
    mean_covs = covs.index_copy(1, rows, of_limbs)
    posterior = joints, mean_covs
    if body.whole:
        moved = (means - arms).flatten(1, 2)
        square = moved[..., :, None] * moved[..., None, :]
        covs = mean_covs.index_add(1, rows, trust * square)
        posterior = joints.index_add(1, rows, moved), mean_covs
    area = 2.0 * (shoulders[..., 2].mean(1).log() - log_focal)
    evidence = belief.log_evidence + body.limbs.sum(-1) * area[:, None]
    evidence = torch.where(body.limbs.any(-1), evidence, 0.0)
    log_weights = belief.weight.clamp_min(1e-30).log()
    seen = _tilted(body.tilt, *posterior)
    pose = _tilted(body.tilt, joints, covs) if body.whole else seen
    return FramePose(
        *pose, *seen, body.tilt @ axes.mT, evidence, log_weights, body.bones.metres, body.bones.covs
    )


def enlarged(pose: FramePose, factor: float) -> FramePose:
    """Return the estimate of the same image of a body so many times as large and as far away.

    Args:
        pose: the estimate, whose bones are of the larger body already. factor: the factor on its size.
    """
    joints, covs, means, mean_covs = pose[:4]
    square = factor**2
    return FramePose(factor * joints, square * covs, factor * means, square * mean_covs, *pose[4:])


def _tilted(
    tilt: Float[Tensor, "B 3 3"], joints: Float[Tensor, "B 8 3"], covs: Float[Tensor, "B 8 3 3"]
) -> tuple[Float[Tensor, "B 8 3"], Float[Tensor, "B 8 3 3"]]:
    """Return joints and their covariances in the axes of a camera that is not rolled."""
    back = tilt.mT
    return joints @ back, tilt[:, None] @ covs @ back[:, None]


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
    both = elbow + hand
    upper = _along(elbow, upper_arm)
    lower = _along(hand - upper, forearm)
    for _ in range(_ROUNDS):
        upper = _along(both - lower, upper_arm)
        lower = _along(hand - upper, forearm)
    return torch.stack([upper, upper + lower], -2)


def _along(vectors: Float[Tensor, "*batch 3"], length: Float[Tensor, "*#batch 1"]) -> Tensor:
    """Return vectors of the same directions and of these lengths."""
    own = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors * (length / own.clamp_min(1e-12))


def _trust(
    shoulders: Bool[Tensor, "B 2"], limbs: Bool[Tensor, "B 2 2"], exact: Bool[Tensor, " B"]
) -> Float[Tensor, "B 2"]:
    """Return the factors on the covariances of both arms, by which of their joints are measured."""
    elbow, hand = limbs.unbind(-1)
    trust = torch.where(hand & ~elbow, _HAND_ALONE, 1.0)
    trust = trust.masked_fill(shoulders & elbow & hand, _WHOLE)
    return trust.masked_fill(~exact[:, None], 1.0)


def _covs(
    body: SeenBody,
    joints: Float[Tensor, "B 8 3"],
    spread: Float[Tensor, "B 4 3 3"],
    trust: Float[Tensor, "B 4 1 1"],
) -> tuple[Float[Tensor, "B 8 3 3"], Float[Tensor, "B 4 3 3"]]:
    """Return the covariances of joints by stiffness, noise and common scale, and all those of `LIMBS`.

    Limbs have the spread of the posterior too, in which every hypothesis is on the rays of the keypoints.
    No keypoint tells the common scale, so its share has no factor.

    Args:
        body: the body but for its arms. joints: all of its joints. spread: that of the limbs.
        trust: the factors on the covariances of the limbs (`_trust`).
    """
    apart = joints - joints[:, _NECK, None]
    outer = apart[..., :, None] * apart[..., None, :]
    noise = ((body.std * joints[..., 2]).square() - _NOISE**2).clamp_min(0.0)
    noise[:, _NECK] = 0.0  # which may be put beside other joints, with a wide R
    eye = torch.eye(3, dtype=joints.dtype, device=joints.device)
    still = (_STD**2 + noise)[..., None, None] * eye
    of_scale = body.scale.square()[:, None, None, None] * outer
    rows = index_tensor(LIMBS, joints.device)
    limbs = still.index_select(1, rows) + spread + body.others
    # seen hands are as far from shoulders that are not as the body is away
    inferred = body.far[:, None] * ~body.shoulders
    hands = limbs.view(-1, 2, 2, 3, 3)[:, :, 1, :2, :2]
    hands.addcmul_(inferred[..., None, None], outer[:, HANDS, :2, :2])
    return still + of_scale, torch.addcmul(of_scale.index_select(1, rows), trust, limbs)


def estimates_of(
    poses: Sequence[FramePose],
    batch_size: int,
    matrix: Float[Tensor, "3 3"],
    names: tuple[str, ...],
    measured: MeasuredJoints,
) -> Estimates:
    """Return the estimates of both arms and the poses they were made from.

    Args:
        poses: the poses of some frames of all B sequences at a time, [B T', ...]. batch_size: B.
        matrix: K of the prior's camera. names: the names of the bone lengths.
        measured: the measurements of these frames.
    """
    stacked = FramePose(*(_of_sequences(values, batch_size) for values in zip(*poses, strict=True)))
    neck = stacked.joints[:, :, _NECK]
    seen = stacked.means @ matrix.mT
    uv, uv_covs = _with_keypoints(
        seen[..., :2] / seen[..., 2:],
        _pixel_covs(stacked.means, stacked.mean_covs, matrix),
        measured,
    )
    joints = stacked.joints.flatten(2)
    failed_at = first_not_finite(joints)
    left, right = (
        FilterOutput(joints, log_weights, log_evidence, None, failed_at)
        for log_weights, log_evidence in zip(
            stacked.log_weights.unbind(2), stacked.log_evidence.unbind(2), strict=True
        )
    )
    found = SeenPoses(
        stacked.joints, stacked.covs, stacked.rotation[:, :, None], torch.ones_like(neck[..., :1]),
        neck, uv, uv_covs,
    )  # fmt: skip
    bones = Bones(names, stacked.bones, stacked.bone_covs)
    return Estimates(left, right, None, found, bones)


def _of_sequences(values: Sequence[Tensor], batch_size: int) -> Tensor:
    """Return values of some frames of all sequences at a time, [B T', ...], as those of all frames."""
    parts = [value.unflatten(0, (batch_size, -1)) for value in values]
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def _with_keypoints(
    uv: Float[Tensor, "B T 8 2"], covs: Float[Tensor, "B T 8 2 2"], measured: MeasuredJoints
) -> tuple[Float[Tensor, "B T 8 2"], Float[Tensor, "B T 8 2 2"]]:
    """Return pixels and covariances of joints, updated once more by the keypoints of those that are measured.

    Bones whose lengths are unsure may not reach a keypoint. A joint in space keeps them, its pixel does not:

        u' = u + K (z - u),   S' = K R,   K = S (S + R)^-1

    Args:
        uv, covs: u and S, of bones that keep their lengths. measured: z and R.
    """
    factor = safe_cholesky(covs + measured.cov)
    gain = torch.cholesky_solve(covs, factor).mT
    moved = (gain @ (measured.uv - uv)[..., None])[..., 0]
    known = measured.mask[..., None]
    nearer = symmetrise(gain @ measured.cov)
    return torch.where(known, uv + moved, uv), torch.where(known[..., None], nearer, covs)


def _pixel_covs(
    joints: Float[Tensor, "*batch 3"],
    covs: Float[Tensor, "*batch 3 3"],
    matrix: Float[Tensor, "3 3"],
) -> Float[Tensor, "*batch 2 2"]:
    """Return the covariances of the joints' pixels, to first order."""
    depth = joints[..., 2:].clamp_min(0.1)
    slope = matrix[:2, :2]
    away = -(joints[..., :2] / depth) @ slope.mT
    slopes = torch.cat([slope.expand(*away.shape, 2), away[..., None]], -1) / depth[..., None]
    return slopes @ covs @ slopes.mT
