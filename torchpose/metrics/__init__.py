"""Measure poses: Procrustes and joint errors, PCP, jitter, calibration of covariances."""

from torchpose._core.facade import set_up_facade
from torchpose.metrics._calibration import (
    calibration_error,
    coverage,
    predictive_log_likelihood,
    reliability,
)
from torchpose.metrics._pose_errors import (
    align,
    jitter,
    joint_errors,
    joint_errors_2d,
    joint_errors_3d,
    pcp,
    procrustes,
    summarise_errors,
)

__all__ = [
    "align",
    "calibration_error",
    "coverage",
    "jitter",
    "joint_errors",
    "joint_errors_2d",
    "joint_errors_3d",
    "pcp",
    "predictive_log_likelihood",
    "procrustes",
    "reliability",
    "summarise_errors",
]

set_up_facade(__name__)
