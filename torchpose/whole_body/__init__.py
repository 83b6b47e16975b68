"""Track the whole body from silhouettes in calibrated cameras."""

from torchpose._core.facade import set_up_facade
from torchpose.whole_body.filters.annealed import AnnealedParticleFilter
from torchpose.whole_body.filters.body_particles import (
    BodyFilterState,
    BodyTrack,
    joint_covariance,
    reweight,
)
from torchpose.whole_body.filters.constrained import ConstrainedParticleFilter
from torchpose.whole_body.filters.manifold import ManifoldParticleFilter
from torchpose.whole_body.filters.motion import constant_velocity_std, default_step_std, motion_std
from torchpose.whole_body.filters.root_uncertainty import RootUncertaintyTracker
from torchpose.whole_body.filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body.filters.sir import SIRParticleFilter
from torchpose.whole_body.first_pose import FirstPose, find_first_pose
from torchpose.whole_body.methods import METHODS, register_body_filter
from torchpose.whole_body.pose_search import find_pose
from torchpose.whole_body.poses import BodyPoses, load_body
from torchpose.whole_body.sharpness import ValidationSequence, fit_sharpness
from torchpose.whole_body.silhouettes.likelihood import bidirectional, intersection_over_union
from torchpose.whole_body.silhouettes.rendering import (
    PreparedSilhouettes,
    SilhouetteCounts,
    count_pixels,
    prepare_silhouettes,
    render,
    render_limbs,
)
from torchpose.whole_body.silhouettes.shape import fit_radii
from torchpose.whole_body.tracker import BodyStream, BodyTracker, track_body

__all__ = [
    "METHODS",
    "AnnealedParticleFilter",
    "BodyFilterState",
    "BodyPoses",
    "BodyStream",
    "BodyTrack",
    "BodyTracker",
    "ConstrainedParticleFilter",
    "FirstPose",
    "ManifoldParticleFilter",
    "PreparedSilhouettes",
    "RootUncertaintyTracker",
    "SIRParticleFilter",
    "SilhouetteCounts",
    "SilhouetteParticleFilter",
    "ValidationSequence",
    "bidirectional",
    "constant_velocity_std",
    "count_pixels",
    "default_step_std",
    "find_first_pose",
    "find_pose",
    "fit_radii",
    "fit_sharpness",
    "intersection_over_union",
    "joint_covariance",
    "load_body",
    "motion_std",
    "prepare_silhouettes",
    "register_body_filter",
    "render",
    "render_limbs",
    "reweight",
    "track_body",
]

set_up_facade(__name__)
