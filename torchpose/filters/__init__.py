"""Recursive Bayesian filters over learned motion priors."""

from importlib import import_module as _import_module

from torchpose.filters.base import RecursiveFilter
from torchpose.filters.constant_velocity import ConstantVelocityFilter, ConstantVelocityState
from torchpose.filters.gamma import fit_gamma
from torchpose.filters.mkf import MixtureKalmanFilter
from torchpose.filters.outputs import FilterOutput, StepOutput
from torchpose.filters.particle import BootstrapParticleFilter, ParticleState
from torchpose.filters.resampling import resample
from torchpose.filters.tracks import MKFState

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
    "fit_gamma",
    "resample",
]

_OF_WHOLE_BODIES = frozenset(
    [
        "AnnealedParticleFilter",
        "BodyFilterState",
        "BodyTrack",
        "ConstrainedParticleFilter",
        "FirstPose",
        "ManifoldParticleFilter",
        "RootUncertaintyTracker",
        "SIRParticleFilter",
        "SilhouetteParticleFilter",
        "ValidationSequence",
        "constant_velocity_std",
        "default_step_std",
        "find_first_pose",
        "find_pose",
        "fit_sharpness",
        "motion_std",
    ]
)


def __getattr__(name: str) -> object:
    """Return a filter over whole bodies, which is at home in `torchpose.whole_body`."""
    if name not in _OF_WHOLE_BODIES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module("torchpose.whole_body"), name)
