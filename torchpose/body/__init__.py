"""Model the articulated body: skeleton, kinematics, fits to recorded joints, limits."""

from torchpose._core.facade import set_up_facade
from torchpose.body._fitting import fit_body, fit_state
from torchpose.body._kinematics import Body, Frame, centres_of
from torchpose.body._limbs import Limbs
from torchpose.body._limits import JointLimits
from torchpose.body._skeleton import BODY_15, BodySkeleton, TaperedCylinder, Tip, body_joints

__all__ = [
    "BODY_15",
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
]

set_up_facade(__name__)
