"""What a torso looks like to the tracker, by the way that its frames take."""

import torch

from torchpose.upper_body._articulated_frame import Optics, as_rays, facts_of, split, upright
from torchpose.upper_body._measured_joints import MeasuredJoints


def see_torso(rays, known, std):
    """Return the torso among the rays [B, 8, 3] of all joints, of a body that does not lean.

    Args:
        known: whether each is measured [B, 8]. std: of a pixel over the focal length.
    """
    eye = torch.eye(3, dtype=rays.dtype)
    cov = std**2 * eye[:2, :2].expand(8, 2, 2)
    measured = MeasuredJoints(rays[:, None, :, :2] / rays[:, None, :, 2:], known[:, None], cov)
    rays_of = as_rays(measured, Optics.of(eye))
    (frame,), (facts,) = split(rays_of), facts_of(rays_of, measured, eye)
    return upright(frame, facts, eye.expand(len(rays), 3, 3)).torso
