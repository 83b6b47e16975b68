"""Recursive Bayesian filters over learned motion priors."""

from torchpose.filters.base import FilterOutput, RecursiveFilter, StepOutput
from torchpose.filters.constant_velocity import ConstantVelocityFilter, ConstantVelocityState
from torchpose.filters.mkf import MixtureKalmanFilter, MKFState
from torchpose.filters.particle import BootstrapParticleFilter, ParticleState
from torchpose.filters.resampling import resample

__all__ = [
    "BootstrapParticleFilter",
    "ConstantVelocityFilter",
    "ConstantVelocityState",
    "FilterOutput",
    "MKFState",
    "MixtureKalmanFilter",
    "ParticleState",
    "RecursiveFilter",
    "StepOutput",
    "resample",
]
