"""Track the whole body from silhouettes in calibrated cameras."""

from torchpose._core.facade import set_up_facade
from torchpose.whole_body._body_track import BodyTrack, load_body
from torchpose.whole_body._body_tracker import BodyStream, BodyTracker
from torchpose.whole_body._filter_table import METHODS, register_body_filter
from torchpose.whole_body._filters.annealed import AnnealedParticleFilter
from torchpose.whole_body._filters.body_particles import BodyFilterOutput, reweight
from torchpose.whole_body._filters.constrained import ConstrainedParticleFilter
from torchpose.whole_body._filters.manifold_regularised import ManifoldParticleFilter
from torchpose.whole_body._filters.motion import constant_velocity_std, default_step_std, motion_std
from torchpose.whole_body._filters.root_uncertainty import RootUncertaintyTracker
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body._filters.sir import SIRParticleFilter
from torchpose.whole_body._first_pose import find_first_pose
from torchpose.whole_body._following import track_body
from torchpose.whole_body._pose_search import find_pose
from torchpose.whole_body._sharpness import fit_sharpness
from torchpose.whole_body._silhouettes.likelihood import bidirectional
from torchpose.whole_body._silhouettes.rendering import count_pixels, render

__all__ = [
    "METHODS",
    "AnnealedParticleFilter",
    "BodyFilterOutput",
    "BodyStream",
    "BodyTrack",
    "BodyTracker",
    "ConstrainedParticleFilter",
    "ManifoldParticleFilter",
    "RootUncertaintyTracker",
    "SIRParticleFilter",
    "SilhouetteParticleFilter",
    "bidirectional",
    "constant_velocity_std",
    "count_pixels",
    "default_step_std",
    "find_first_pose",
    "find_pose",
    "fit_sharpness",
    "load_body",
    "motion_std",
    "register_body_filter",
    "render",
    "reweight",
    "track_body",
]

set_up_facade(__name__)
