"""The articulated body: skeleton, kinematics, fits to recorded joints, limits, silhouettes."""

from torchpose._core.facade import set_up_facade
from torchpose.body.fitting import fit_body, fit_state, joint_errors
from torchpose.body.kinematics import FRAMES, Body, Frame, centres_of
from torchpose.body.limbs import Limbs
from torchpose.body.limits import JointLimits
from torchpose.body.skeleton import BODY_15, BodySkeleton, TaperedCylinder, Tip, body_joints

__all__ = [
    "BODY_15",
    "FRAMES",
    "Body",
    "BodySkeleton",
    "Frame",
    "JointLimits",
    "Limbs",
    "TaperedCylinder",
    "Tip",
    "body_joints",
    "centres_of",
    "fit_body",
    "fit_state",
    "joint_errors",
]

set_up_facade(__name__)
