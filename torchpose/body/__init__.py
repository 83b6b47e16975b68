"""The articulated body: skeleton, kinematics, fits to recorded joints, limits, silhouettes."""

from torchpose.body.fitting import fit_body, fit_state, joint_errors
from torchpose.body.kinematics import FRAMES, Body, Frame, centres_of
from torchpose.body.limbs import Limbs
from torchpose.body.limits import JointLimits
from torchpose.body.shape import fit_radii
from torchpose.body.silhouette import (
    PreparedSilhouettes,
    SilhouetteCounts,
    count_pixels,
    prepare_silhouettes,
    render,
    render_limbs,
)
from torchpose.body.silhouette_likelihood import bidirectional, intersection_over_union
from torchpose.body.skeleton import BODY_15, BodySkeleton, TaperedCylinder, Tip, body_joints

__all__ = [
    "BODY_15",
    "FRAMES",
    "Body",
    "BodySkeleton",
    "Frame",
    "JointLimits",
    "Limbs",
    "PreparedSilhouettes",
    "SilhouetteCounts",
    "TaperedCylinder",
    "Tip",
    "bidirectional",
    "body_joints",
    "centres_of",
    "count_pixels",
    "fit_body",
    "fit_radii",
    "fit_state",
    "intersection_over_union",
    "joint_errors",
    "prepare_silhouettes",
    "render",
    "render_limbs",
]
