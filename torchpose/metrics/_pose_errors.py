"""Measure the errors of poses: Procrustes, joint errors, PCP, jitter.

Pure functions on tensors, on any device; those on covariances are in `torchpose.metrics._calibration`.
Missing values are NaN or masked: errors leave them out of the mean and report the count; PCP counts
a missing estimate as wrong. (BL) is Burke & Lasenby, "Single camera pose estimation using
Bayesian filtering and Kinect motion priors". The same as `torchmetrics.Metric` classes:
`torchpose.metrics._torchmetrics_adapters`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.value_pairs import as_pair, as_values
from torchpose.errors import InputError
from torchpose.math._rotations import RigidMotion, procrustes
from torchpose.skeleton._torso import ALIGN_JOINTS

__all__ = [
    "ALIGN_JOINTS",
    "ARM_LIMBS",
    "PCP",
    "Alignment",
    "ErrorSummary",
    "align",
    "jitter",
    "joint_errors",
    "joint_errors_2d",
    "joint_errors_3d",
    "limb_hits",
    "pcp",
    "procrustes",
    "share_below",
    "summarise_errors",
]


ARM_LIMBS = ((2, 1), (1, 0), (5, 6), (6, 7))
"""Left upper arm, left forearm, right upper arm, right forearm of the 8-joint upper body."""

PCP_THRESHOLDS = tuple(round(0.05 * i, 2) for i in range(1, 21))


# --- alignment ------------------------------------------------------------------------------------


class Alignment(NamedTuple):
    """Holds points after a rigid motion, their covariances if given, and the motion itself."""

    points: Tensor
    covariance: Tensor | None
    motion: RigidMotion


def align(
    estimate: Float[Tensor, "*batch J 3"],
    truth: Float[Tensor, "*batch J 3"],
    joints: Sequence[int] | None = ALIGN_JOINTS,
    covariance: Float[Tensor, "*batch J 3 3"] | None = None,
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Alignment:
    """Move each estimated pose onto the true one by the Procrustes motion of some of its joints.

    x' = R x + t,  C' = R C R^T for every joint; R and t from `joints` alone, frame by frame.

    Args:
        estimate, truth: [*batch, J, 3], metres.
        joints: indices the motion is computed from; None = all.
        covariance: [*batch, J, 3, 3] of the estimate, m^2.
        mask: [*batch, J], True = the joint may be used.

    Returns:
        `Alignment`; NaN for a frame in which fewer than three of `joints` are there.

    Raises:
        InputError: fewer than three different indices, or one that no joint has. ShapeError: other sizes.

    Reference: Burke & Lasenby, section 6 ("aligning the head, neck and shoulders using fixed scale
    Procrustes analysis").
    """
    estimate, truth = as_pair(estimate, truth, mask, ["...", None, 3])
    chosen = list(range(estimate.shape[-2])) if joints is None else list(joints)
    if len(set(chosen)) < 3 or not all(0 <= j < estimate.shape[-2] for j in chosen):
        raise InputError(
            f"joints must be three or more different indices below {estimate.shape[-2]}, got {chosen}"
        )
    part = None if mask is None else mask[..., chosen]
    motion = procrustes(estimate[..., chosen, :], truth[..., chosen, :], part)
    missing = estimate.isnan().any(-1) | motion.translation.isnan().any(-1, keepdim=True)
    turn, place = (part.nan_to_num() for part in motion)
    points = _where_there(estimate, missing) @ turn.mT + place[..., None, :]
    points = points.masked_fill(missing[..., None], math.nan)
    if covariance is not None:
        check_shape("covariance", covariance, [*estimate.shape, 3])
        covariance = as_values("covariance", covariance, ["...", None, None]).to(points)
        turn = motion.rotation[..., None, :, :]
        covariance = turn @ covariance @ turn.mT
    return Alignment(points, covariance, motion)


# --- joint errors ---------------------------------------------------------------------------------


class ErrorSummary(NamedTuple):
    """Holds the means of joint errors over everything but the joints.

    Attributes:
        mean: over all joints and frames pooled [].
        per_joint: mean [J]; std: standard deviation [J].
        median: [J], of an even number of errors the mean of both in the middle.
        counts: errors behind each of them [J], infinite ones too; what was missing is not among them.
    """

    mean: Tensor
    per_joint: Tensor
    std: Tensor
    median: Tensor
    counts: Tensor


def joint_errors(
    estimate: Float[Tensor, "*batch J D"],
    truth: Float[Tensor, "*batch J D"],
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Float[Tensor, "*batch J"]:
    """Return the Euclidean distance of every estimated joint from the true one.

    Args:
        estimate, truth: [*batch, J, D], D = 2 (pixels) or 3 (metres).
        mask: [*batch, J], True = count this joint.

    Returns:
        [*batch, J] in the input's unit; NaN where masked or where either side is NaN, to be
        averaged with `summarise_errors`, which leaves those out and counts the others.
    """
    estimate, truth = as_pair(estimate, truth, mask, ["...", None, None])
    apart = estimate - truth
    missing = apart.isnan().any(-1)
    return _lengths(apart, missing if mask is None else missing | ~mask)


def _lengths(
    vectors: Float[Tensor, "*batch D"], missing: Bool[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Return the lengths of vectors, NaN where they are missing."""
    lengths = torch.linalg.vector_norm(_where_there(vectors, missing), dim=-1)
    return lengths.masked_fill(missing, math.nan)


def _where_there(
    points: Float[Tensor, "*batch D"], missing: Bool[Tensor, "*batch"]
) -> Float[Tensor, "*batch D"]:
    """Return the points with zeros where they are missing, whose NaN would reach the gradients of others."""
    return points.masked_fill(missing[..., None], 0.0)


def joint_errors_2d(
    estimate: Float[Tensor, "*batch J 2"],
    truth: Float[Tensor, "*batch J 2"],
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> Float[Tensor, "*batch J"]:
    """Return the distance of every estimated joint from the true one in the image (BL Figure 3).

    Args:
        estimate, truth: [*batch, J, 2], pixels.
        mask: [*batch, J], True = count this joint.

    Returns:
        [*batch, J], pixels; NaN where masked or where either side is NaN.

    Raises:
        ShapeError: other sizes.
    """
    check_shape("estimate", estimate, ["...", None, 2])
    return joint_errors(estimate, truth, mask)


def joint_errors_3d(
    estimate: Float[Tensor, "*batch J 3"],
    truth: Float[Tensor, "*batch J 3"],
    mask: Bool[Tensor, "*batch J"] | None = None,
    joints: Sequence[int] | None = ALIGN_JOINTS,
    procrustes: bool = True,
) -> Float[Tensor, "*batch J"]:
    """Return the distance in metres after fixed-scale Procrustes (BL Figure 10), see `joint_errors`.

    Args:
        estimate, truth: [*batch, J, 3], metres.
        mask: [*batch, J], True = count the joint, and use it to align.
        joints: indices of the joints to align on; None = all joints.
        procrustes: False = no alignment at all.

    Returns:
        [*batch, J], metres; NaN where masked, where either side is NaN, and in frames without a motion.

    Raises:
        ShapeError: other sizes. InputError: as `align`.
    """
    check_shape("estimate", estimate, ["...", None, 3])
    if procrustes:
        estimate = align(estimate, truth, joints, mask=mask).points
    return joint_errors(estimate, truth, mask)


def summarise_errors(errors: Float[Tensor, "*batch J"]) -> ErrorSummary:
    """Return mean, deviation and median of joint errors, pooled and per joint; NaN are left out.

    Args:
        errors: [*batch, J], from `joint_errors`, in any unit.

    Returns:
        `ErrorSummary` in the same unit; NaN where nothing is left.

    Raises:
        ShapeError: fewer than one dimension. InputError: whole or complex numbers.
    """
    errors = as_values("errors", errors, ["...", None])
    flat = errors.reshape(-1, errors.shape[-1])
    flat = flat if len(flat) else flat.new_full((1, errors.shape[-1]), math.nan)
    count = (~flat.isnan()).sum(0)
    mean = flat.nanmean(0)
    std = (flat - mean).square().nanmean(0).sqrt()
    return ErrorSummary(flat.nanmean(), mean, std, _median(flat, count), count)


def _median(flat: Float[Tensor, "T J"], count: Int[Tensor, " J"]) -> Float[Tensor, " J"]:
    """Return the median of every column; of an even count the mean of both in the middle."""
    ordered = flat.sort(0).values  # NaN come last
    middle = torch.stack([(count - 1).clamp_min(0) // 2, count // 2])
    return ordered.gather(0, middle).mean(0)


def share_below(
    errors: Float[Tensor, "*batch J"], bound: float = 0.2
) -> tuple[Float[Tensor, " J"], Int[Tensor, " J"]]:
    """Return the share of errors below a bound, per joint, and how many there were (NaN left out).

    The paper says that "for much of the time, the error in hand position remains below 20 cm"
    (BL section 6); this is that share.

    >>> share_below(torch.tensor([[0.1], [0.3], [math.nan]]), 0.2)
    (tensor([0.5000]), tensor([2]))
    """
    errors = as_values("errors", errors, ["...", None])
    flat = errors.reshape(-1, errors.shape[-1])
    count = (~flat.isnan()).sum(0)
    return (flat < bound).sum(0) / count.to(errors.dtype), count


# --- percentage of correct parts ------------------------------------------------------------------


class PCP(NamedTuple):
    """Holds the percentage of correct parts as a curve.

    Attributes:
        thresholds: fraction of the true limb's length [P].
        overall: share of correct limbs, all limbs and frames pooled [P].
        per_limb: [L, P].
        counts: limbs with a known truth [L].
    """

    thresholds: Tensor
    overall: Tensor
    per_limb: Tensor
    counts: Tensor


def limb_hits(
    estimate: Float[Tensor, "*batch J D"],
    truth: Float[Tensor, "*batch J D"],
    thresholds: Float[Tensor, " P"],
    limbs: Sequence[tuple[int, int]] = ARM_LIMBS,
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> tuple[Bool[Tensor, "*batch L P"], Bool[Tensor, "*batch L"]]:
    """Return which limbs are correct at which threshold, and which have a known truth; see `pcp`."""
    estimate, truth = as_pair(estimate, truth, mask, ["...", None, None])
    thresholds = as_values("thresholds", thresholds, ["P"])
    ends = torch.as_tensor(limbs, device=estimate.device)
    pairs = ends.numel() > 0 and ends.shape[1:] == (2,) and not ends.is_floating_point()
    if not pairs or not bool(((ends >= 0) & (ends < estimate.shape[-2])).all()):
        raise InputError(
            f"limbs must be pairs of joints below {estimate.shape[-2]}, got {ends.tolist()!s:.120}"
        )
    a, b = ends.unbind(-1)
    length = torch.linalg.vector_norm(truth[..., a, :] - truth[..., b, :], dim=-1)
    errors = torch.linalg.vector_norm(estimate - truth, dim=-1)
    worst = torch.maximum(errors[..., a], errors[..., b])
    known = torch.isfinite(length)
    if mask is not None:
        known = known & mask[..., a] & mask[..., b]
    hits = worst[..., None] <= thresholds.to(length) * length[..., None]
    return hits & known[..., None], known


def pcp(
    estimate: Float[Tensor, "*batch J D"],
    truth: Float[Tensor, "*batch J D"],
    thresholds: Sequence[float] | Float[Tensor, " P"] = PCP_THRESHOLDS,
    limbs: Sequence[tuple[int, int]] = ARM_LIMBS,
    mask: Bool[Tensor, "*batch J"] | None = None,
) -> PCP:
    """Return the percentage of correct parts (PCP) over a range of thresholds.

    A limb is correct when BOTH its end points lie within threshold x true limb length of the true
    end points (Yang & Ramanan's definition; the common figure is the one at 0.5). The limbs are
    upper arm and forearm of both sides.

    Args:
        estimate, truth: [*batch, J, D], pixels (as in the paper) or metres.
        thresholds: [P], fractions of the limb's true length.
        limbs: L pairs of joint indices.
        mask: [*batch, J], True = the truth of this joint counts.

    Returns:
        `PCP`. A limb with an unknown (NaN or masked) true end is left out; an estimate that is NaN
        is wrong. In 2D the length is the projected one, so a limb that points at the camera is
        hard to get right.

    Reference: Yang & Ramanan (2011), DOI 10.1109/CVPR.2011.5995741; Burke & Lasenby, Figure 4.

    >>> true = torch.tensor([[0.0, 0.0], [10.0, 0.0]])
    >>> pcp(true + torch.tensor([0.0, 3.0]), true, [0.2, 0.5], [(0, 1)]).overall
    tensor([0., 1.])
    """
    estimate, truth = as_pair(estimate, truth, mask, ["...", None, None])
    levels = torch.as_tensor(thresholds, dtype=truth.dtype, device=truth.device)
    hits, known = limb_hits(estimate, truth, levels, limbs, mask)
    hits, known = hits.reshape(-1, *hits.shape[-2:]), known.reshape(-1, known.shape[-1])
    correct, count = hits.sum(0).to(truth.dtype), known.sum(0)
    return PCP(levels, correct.sum(0) / count.sum(), correct / count[:, None], count)


# --- smoothness -----------------------------------------------------------------------------------


def jitter(points: Float[Tensor, "*batch T J D"], fps: float) -> Float[Tensor, "*batch J"]:
    """Return the mean magnitude of the acceleration of each joint, by second differences.

    |x_{t+1} - 2 x_t + x_{t-1}| fps^2, averaged over time. Compare it with the truth's own.

    Args:
        points: [*batch, T, J, D], metres or pixels. fps: frames per second.

    Returns:
        [*batch, J], m/s^2 or px/s^2; triples of frames with a NaN are left out.

    Raises:
        InputError: fewer than three frames, or fps not positive.

    >>> time = torch.arange(5.0)[:, None, None] / 10
    >>> round(float(jitter(3 * time**2, fps=10.0)), 3)
    6.0
    """
    points = as_values("points", points, ["...", None, None, None])
    if points.shape[-3] < 3 or not fps > 0:
        raise InputError(
            f"jitter needs three frames or more and fps > 0, got {points.shape[-3]} frames "
            f"and fps {fps}"
        )
    left, middle, right = points[..., :-2, :, :], points[..., 1:-1, :, :], points[..., 2:, :, :]
    acceleration = (right - 2 * middle + left) * fps**2
    return _lengths(acceleration, acceleration.isnan().any(-1)).nanmean(-2)
