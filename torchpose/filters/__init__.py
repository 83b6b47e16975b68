"""Recursive Bayesian filters over learned motion priors."""

from torchpose.filters.annealed import AnnealedParticleFilter
from torchpose.filters.base import FilterOutput, RecursiveFilter, StepOutput
from torchpose.filters.constant_velocity import ConstantVelocityFilter, ConstantVelocityState
from torchpose.filters.constrained import ConstrainedParticleFilter
from torchpose.filters.first_order import constant_velocity_std
from torchpose.filters.first_pose import FirstPose, find_first_pose
from torchpose.filters.gamma import fit_gamma
from torchpose.filters.manifold import ManifoldParticleFilter
from torchpose.filters.mkf import MixtureKalmanFilter, MKFState
from torchpose.filters.particle import BootstrapParticleFilter, ParticleState
from torchpose.filters.pose_search import find_pose
from torchpose.filters.resampling import resample
from torchpose.filters.root_uncertainty import RootUncertaintyTracker
from torchpose.filters.sharpness import ValidationSequence, fit_sharpness
from torchpose.filters.silhouette_filter import (
    BodyFilterState,
    BodyTrack,
    SilhouetteParticleFilter,
    default_step_std,
    motion_std,
)
from torchpose.filters.sir import SIRParticleFilter

__all__ = [
    "AnnealedParticleFilter",
    "BodyFilterState",
    "BodyTrack",
    "BootstrapParticleFilter",
    "ConstantVelocityFilter",
    "ConstantVelocityState",
    "ConstrainedParticleFilter",
    "FilterOutput",
    "FirstPose",
    "MKFState",
    "ManifoldParticleFilter",
    "MixtureKalmanFilter",
    "ParticleState",
    "RecursiveFilter",
    "RootUncertaintyTracker",
    "SIRParticleFilter",
    "SilhouetteParticleFilter",
    "StepOutput",
    "ValidationSequence",
    "constant_velocity_std",
    "default_step_std",
    "find_first_pose",
    "find_pose",
    "fit_gamma",
    "fit_sharpness",
    "motion_std",
    "resample",
]
