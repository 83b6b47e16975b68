"""Measures of estimated bodies against recorded ones."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.keypoint_bodies.clips import Clip
from torchpose.body import BODY_15
from torchpose.metrics import align, coverage, jitter, joint_errors

_PELVIS = BODY_15.joint("pelvis")
_OTHERS = [joint for joint in range(len(BODY_15.names)) if joint != _PELVIS]
_BONES = [(joint, parent) for joint, parent in enumerate(BODY_15.parents) if parent >= 0]


class Estimate(NamedTuple):
    """What a method says.

    Attributes:
        joints: [T, 15, 3], metres, NaN where it has none; of one camera perhaps only relative to the
            pelvis. covariance: [T, 15, 3, 3], of one camera relative to the pelvis, None where it says none.
    """

    joints: Tensor
    covariance: Tensor | None = None


def from_the_start(values: Tensor, first_frame: int) -> Tensor:
    """Return values of all frames, the first one also in those before it."""
    return torch.cat([values[:1].expand(first_frame, *values.shape[1:]), values])


class Score(NamedTuple):
    """Measures of a clip.

    Attributes:
        error: mean distance of joints, mm; of one camera after both pelvises were put together.
        rigid, similar: mean distance after the best motion of each frame, without and with a scale, mm.
        unseen: error of joints that fewer than two cameras see; of one camera, that it does not see.
        exchanged: error of joints whose sides are exchanged in a camera.
        jitter: mean acceleration over that of the truth. inside_50, inside_90: shares of true joints
            in the ellipsoids, %, of one camera without the pelvis. bones: standard deviation of the bones'
            lengths over time, % of their mean. true_bones: that of the truth. without: share of joints
            without a result, %.
    """

    error: float
    rigid: float
    similar: float
    unseen: float
    exchanged: float
    jitter: float
    inside_50: float
    inside_90: float
    bones: float
    true_bones: float
    without: float


def score(estimate: Estimate, clip: Clip) -> Score:
    """Return the measures of an estimate.

    Args:
        estimate: of a method. clip: of as many cameras as the method saw.
    """
    truth, joints = clip.joints, estimate.joints
    if len(clip.rig) == 1:
        joints = joints - joints[:, [_PELVIS]] + truth[:, [_PELVIS]]
    errors = 1000 * joint_errors(joints, truth)
    rigid = align(joints, truth, joints=None).points
    known = truth.isfinite().all(-1)
    unseen = clip.cameras_that_see < min(2, len(clip.rig))
    half, most = torch.nan, torch.nan
    if estimate.covariance is not None:
        given = joints, estimate.covariance, truth
        if len(clip.rig) == 1:
            given = tuple(value[:, _OTHERS] for value in given)
        half, most = (100 * coverage(*given).overall).tolist()
    return Score(
        _mean(errors),
        1000 * _mean(joint_errors(rigid, truth)),
        1000 * _mean(joint_errors(scaled_onto(rigid, truth), truth)),
        _mean(errors, unseen),
        _mean(errors, clip.seen.exchanged.any(1)),
        relative_jitter(joints, truth, clip.fps),
        half,
        most,
        bone_spread(joints),
        bone_spread(truth),
        100 * float(joints.isnan().any(-1)[known].double().mean()),
    )


def scaled_onto(
    points: Float[Tensor, "T J 3"], truth: Float[Tensor, "T J 3"]
) -> Float[Tensor, "T J 3"]:
    """Return points of the best size about their centre, which is put onto that of the truth.

    After the best rotation it is that of the Procrustes motion with scale.
    """
    known = (points.isfinite() & truth.isfinite()).all(-1, keepdim=True)
    middles = [torch.where(known, x, torch.nan).nanmean(1, keepdim=True) for x in (points, truth)]
    apart = [torch.where(known, x - m, 0) for x, m in zip((points, truth), middles, strict=True)]
    size = (apart[0] * apart[1]).sum((1, 2)) / apart[0].square().sum((1, 2))
    return (points - middles[0]) * size[:, None, None] + middles[1]


def relative_jitter(
    joints: Float[Tensor, "T J 3"], truth: Float[Tensor, "T J 3"], fps: float
) -> float:
    """Return the mean acceleration of joints over that of the truth, of joints that both have."""
    found, true = jitter(joints, fps), jitter(truth, fps)
    both = found.isfinite() & true.isfinite()
    return float(found[both].mean() / true[both].mean())


def bone_spread(joints: Float[Tensor, "T 15 3"]) -> float:
    """Return the standard deviation of bone lengths over time, mean over bones, % of their mean."""
    lengths = torch.stack([(joints[:, a] - joints[:, b]).norm(dim=-1) for a, b in _BONES])
    mean = lengths.nanmean(1, keepdim=True)
    spread = (lengths - mean).square().nanmean(1).sqrt()
    return 100 * float((spread / mean[:, 0]).nanmean())


def _mean(values: Float[Tensor, "T J"], chosen: Bool[Tensor, "T J"] | None = None) -> float:
    """Return the mean over those chosen that are known."""
    return float((values if chosen is None else values[chosen]).nanmean())
