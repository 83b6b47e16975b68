import math

import torch
from torch import Tensor

from torchpose import BodyTracker
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera

ANGLES = {  # between the bones from the joint in the middle to the other two
    "elbow": ("left_shoulder", "left_elbow", "left_wrist"),
    "arm from trunk": ("left_hip", "left_shoulder", "left_elbow"),
}


def angle(joints: Tensor) -> Tensor:
    """Return the angle at the second of three joints [..., 3, 3], degrees."""
    one, other = joints[..., 0, :] - joints[..., 1, :], joints[..., 2, :] - joints[..., 1, :]
    across = torch.linalg.cross(one, other).norm(dim=-1)
    return torch.atan2(across, (one * other).sum(-1)).rad2deg()


def angle_with_std(joints: Tensor, covs: Tensor, shared: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return the angle, and its standard deviation to first order from covariances [..., 3, 3, 3].

    shared: correlation of the errors of the three joints, each along the axes of its covariance.
    """
    joints = joints.detach().requires_grad_()
    found = angle(joints)
    (slope,) = torch.autograd.grad(found.sum(), joints)
    variances, axes = torch.linalg.eigh(covs.nan_to_num())  # no pose stays NaN
    roots = axes * variances.clamp_min(0).sqrt()[..., None, :] @ axes.mT
    moved = (roots @ slope[..., None]).squeeze(-1)
    together, apart = moved.sum(-2).square().sum(-1), moved.square().sum((-2, -1))
    return found.detach(), (shared * together + (1 - shared) * apart).sqrt()


camera = PinholeCamera(900, 900, 639.5, 359.5, 1280, 720, "cam", translation=(0, 0, 3))
states = torch.zeros(20, 36, dtype=torch.float64)
states[:, 3] = math.pi  # upright where y points down
truth = Body.of_height(BODY_15, 1.75).joints(states)
rig = CameraRig([camera])
track = BodyTracker(rig, "kalman", fps=30, height=1.75)(
    keypoints=rig(truth).pixels, names=BODY_15.names, smoothing="full"
)
for name, joints in ANGLES.items():
    rows = [BODY_15.names.index(joint) for joint in joints]
    covs = track.details["covariance_from_pelvis"][:, rows]  # of cameras apart: covariance3d
    mean, std = angle_with_std(track.joints3d[:, rows], covs, shared=0.5)  # apart: 0
    error = (mean - angle(truth[:, rows]))[-1].abs()
    print(name, bool(error < 2 * std[-1]), bool(std[-1] < 40))
# > elbow True True
# > arm from trunk True True
