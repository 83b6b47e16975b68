"""Recursive Bayesian filters over learned motion priors."""

from torchpose._core.facade import set_up_facade
from torchpose.filters.base import RecursiveFilter
from torchpose.filters.constant_velocity import ConstantVelocityFilter, ConstantVelocityState
from torchpose.filters.fixed_tracks import FixedTrackFilter
from torchpose.filters.gamma import fit_gamma
from torchpose.filters.mkf import MixtureKalmanFilter, MKFState
from torchpose.filters.outputs import FilterOutput, StepOutput
from torchpose.filters.particle import BootstrapParticleFilter, ParticleState
from torchpose.filters.resampling import resample
from torchpose.filters.sampled_tracks import SampledTrackFilter
from torchpose.filters.split_tracks import SplitTrackFilter

__all__ = [
    "BootstrapParticleFilter",
    "ConstantVelocityFilter",
    "ConstantVelocityState",
    "FilterOutput",
    "FixedTrackFilter",
    "MKFState",
    "MixtureKalmanFilter",
    "ParticleState",
    "RecursiveFilter",
    "SampledTrackFilter",
    "SplitTrackFilter",
    "StepOutput",
    "fit_gamma",
    "resample",
]

set_up_facade(__name__)
