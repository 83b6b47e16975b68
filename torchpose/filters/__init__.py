"""Filter recursively over learnt motion priors: Kalman filters of mixtures, particle filters."""

from torchpose._core.facade import set_up_facade
from torchpose.filters._fixed_tracks import FixedTrackFilter
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import FilterOutput, StepOutput
from torchpose.filters._particle import BootstrapParticleFilter
from torchpose.filters._recursive_filter import RecursiveFilter, standard_normal, uniform
from torchpose.filters._resampling import resample
from torchpose.filters._sampled_tracks import SampledTrackFilter
from torchpose.filters._split_tracks import SplitTrackFilter
from torchpose.filters._transition import fit_gamma, make_transition

__all__ = [
    "BootstrapParticleFilter",
    "FilterOutput",
    "FixedTrackFilter",
    "MixtureKalmanFilter",
    "RecursiveFilter",
    "SampledTrackFilter",
    "SplitTrackFilter",
    "StepOutput",
    "fit_gamma",
    "make_transition",
    "resample",
    "standard_normal",
    "uniform",
]

set_up_facade(__name__)
