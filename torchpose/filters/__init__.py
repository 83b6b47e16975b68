"""Recursive Bayesian filters over learned motion priors."""

from torchpose.filters.base import FilterOutput, RecursiveFilter, StepOutput
from torchpose.filters.mkf import MixtureKalmanFilter, MKFState

__all__ = [
    "FilterOutput",
    "MKFState",
    "MixtureKalmanFilter",
    "RecursiveFilter",
    "StepOutput",
]
