"""Wrap the metrics as `torchmetrics.Metric`, which add up over batches and ranks.

Needs torchmetrics; nothing else in torchpose imports this module. Every state is a sum, so that
processes reduce it by adding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchpose.errors import MissingDependencyError, ShapeError
from torchpose.metrics._calibration import coverage
from torchpose.metrics._pose_errors import (
    ALIGN_JOINTS,
    ARM_LIMBS,
    PCP_THRESHOLDS,
    align,
    joint_errors,
    pcp,
)

try:
    from torchmetrics import Metric
except ImportError as error:
    raise MissingDependencyError(
        "torchpose.metrics._torchmetrics_adapters needs the package torchmetrics, which is not installed; "
        "run `pip install torchmetrics`, or use the functions in torchpose.metrics, which do not"
    ) from error


class MeanPerJointError(Metric):
    """Computes the mean distance of estimated from true joints, see `torchpose.metrics.joint_errors`.

    Args:
        n_joints: J.
        procrustes: align each frame first (3D only): rigid, fixed scale, no reflection.
        joints: indices of the joints to align on; None = all joints.
        per_joint: `compute` returns [J] instead of the mean over everything.

    Errors that are NaN are left out.

    >>> metric = MeanPerJointError(n_joints=1)
    >>> metric.update(torch.tensor([[[3.0, 4.0]]]), torch.zeros(1, 1, 2))
    >>> metric.compute()
    tensor(5., dtype=torch.float64)
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(
        self,
        n_joints: int = 8,
        procrustes: bool = False,
        joints: Sequence[int] | None = ALIGN_JOINTS,
        per_joint: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.procrustes, self.joints, self.per_joint = procrustes, joints, per_joint
        self.add_state("total", torch.zeros(n_joints, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(n_joints, dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, preds: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
        """Add poses: preds and target [..., J, D], mask [..., J] (True = count)."""
        _check_joints(preds, self.total.shape[0])
        if self.procrustes:
            preds = align(preds, target, self.joints, mask=mask).points
        errors = joint_errors(preds, target, mask).reshape(-1, self.total.shape[0])
        self.total = self.total + errors.double().nansum(0)
        self.count = self.count + (~errors.isnan()).sum(0)

    def compute(self) -> Tensor:
        """Return the mean error, [] or [J], in the unit of the joints; NaN where there was nothing."""
        if self.per_joint:
            return self.total / self.count
        return self.total.sum() / self.count.sum()


class PercentageOfCorrectParts(Metric):
    """Computes the share of limbs with both ends within threshold x true length, see `torchpose.metrics.pcp`.

    Args:
        thresholds: [P], fractions of the limb's true length.
        limbs: L pairs of joint indices.
        per_limb: `compute` returns [L, P] instead of [P].
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    correct: Tensor
    count: Tensor

    def __init__(
        self,
        thresholds: Sequence[float] = PCP_THRESHOLDS,
        limbs: Sequence[tuple[int, int]] = ARM_LIMBS,
        per_limb: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.thresholds, self.limbs, self.per_limb = tuple(thresholds), tuple(limbs), per_limb
        size = (len(self.limbs), len(self.thresholds))
        self.add_state("correct", torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(size[0], dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, preds: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
        """Add poses: preds and target [..., J, D], mask [..., J] (True = the truth counts)."""
        batch = pcp(preds, target, self.thresholds, self.limbs, mask)
        correct = batch.per_limb.double().nan_to_num(0.0) * batch.counts[:, None]
        self.correct = self.correct + correct.round()
        self.count = self.count + batch.counts

    def compute(self) -> Tensor:
        """Return the share of correct limbs at each threshold, [P] or [L, P]."""
        if self.per_limb:
            return self.correct / self.count[:, None]
        return self.correct.sum(0) / self.count.sum()


class EllipsoidCoverage(Metric):
    """Computes the share of true joints inside their ellipsoids, see `torchpose.metrics.coverage`.

    Args:
        n_joints: J.
        levels: [L], nominal probabilities.
        procrustes: align each frame, and turn its covariances, first (3D only).
        joints: indices of the joints to align on; None = all joints.
        per_joint: `compute` returns [L, J] instead of [L].
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False
    inside: Tensor
    count: Tensor

    def __init__(
        self,
        n_joints: int = 8,
        levels: Sequence[float] = (0.5, 0.9),
        procrustes: bool = False,
        joints: Sequence[int] | None = ALIGN_JOINTS,
        per_joint: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.levels, self.procrustes = tuple(levels), procrustes
        self.joints, self.per_joint = joints, per_joint
        size = (len(self.levels), n_joints)
        self.add_state("inside", torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(n_joints, dtype=torch.int64), dist_reduce_fx="sum")

    def update(
        self, preds: Tensor, covariance: Tensor, target: Tensor, mask: Tensor | None = None
    ) -> None:
        """Add poses: preds and target [..., J, D], covariance [..., J, D, D], mask [..., J]."""
        _check_joints(preds, self.count.shape[0])
        if self.procrustes:
            moved = align(preds, target, self.joints, covariance, mask)
            preds = moved.points
            covariance = covariance if moved.covariance is None else moved.covariance
        batch = coverage(preds, covariance, target, self.levels, mask)
        self.inside = self.inside + (batch.per_joint.nan_to_num(0.0) * batch.counts).round()
        self.count = self.count + batch.counts

    def compute(self) -> Tensor:
        """Return the share inside at each level, [L] or [L, J]."""
        if self.per_joint:
            return self.inside / self.count
        return self.inside.sum(-1) / self.count.sum()


def _check_joints(preds: Tensor, n_joints: int) -> None:
    if preds.ndim < 2 or preds.shape[-2] != n_joints:
        raise ShapeError(
            f"preds must have shape [..., {n_joints}, D], got {list(preds.shape)}; "
            "set n_joints to the number of joints"
        )
