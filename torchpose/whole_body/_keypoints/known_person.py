"""Put what is known of a person into the prior over bodies: bone lengths, or the height."""

import copy

import torch
from torch import Tensor

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import SkeletonError
from torchpose.priors._body_motion import BodyMotion

__all__ = ["of_one_camera", "with_body", "with_height"]

_LENGTH_STD = 0.01  # of the log of a given bone length
_PULL_TIME_OF_ONE = 0.1  # seconds
_HEIGHT_STD = 0.03  # of the log of the legs' length of a person of given height


def with_body(motion: BodyMotion, body: Body) -> BodyMotion:
    """Return the prior of a person whose bone lengths are known.

    Raises:
        SkeletonError: a body of another skeleton.
    """
    if body.skeleton != BODY_15:
        raise SkeletonError(f"expected a body of 'body-15', got {body.skeleton.name!r}")
    scales = motion.articulation.scales_of(body.bone_lengths.to(motion.scale_mean))
    cov = _LENGTH_STD**2 * torch.eye(len(scales)).to(scales)
    return _with_scales(motion, scales, cov)


def with_height(motion: BodyMotion, height: float) -> BodyMotion:
    """Return the prior of a person whose height is known, which tells the scale of the legs."""
    body = motion.articulation
    told = torch.tensor([name in ("knee", "ankle") for name in body.groups]).to(motion.scale_mean)
    told = told / told.sum()
    wanted = body.scales_of(BODY_15.standard_lengths(height).to(motion.scale_mean)) @ told
    cross = motion.scale_cov @ told
    gain = cross / (told @ cross + _HEIGHT_STD**2)
    mean = motion.scale_mean + gain * (wanted - told @ motion.scale_mean)
    cov = motion.scale_cov - gain[:, None] * cross
    return _with_scales(motion, mean, (cov + cov.mT) / 2)


def of_one_camera(motion: BodyMotion, lengths_fixed: bool) -> BodyMotion:
    """Return the prior for one camera, in which neither sizes nor the depths of limbs are seen.

    Bone lengths stay those that are expected: corrections that are linear in them would shrink the body
    frame by frame, since a bone that is seen shorter is mostly turned and not short. Poses are pulled to
    the mixture more strongly.

    Args:
        lengths_fixed: whether lengths are to be fixed; a given body's are already.
    """
    other = copy.copy(motion)
    cov = _LENGTH_STD**2 * torch.eye(len(motion.scale_mean)).to(motion.scale_cov)
    pull_time = torch.full_like(motion.pull_time, _PULL_TIME_OF_ONE)
    other._buffers = {**motion._buffers, "pull_time": pull_time}
    return _with_scales(other, other.scale_mean, cov) if lengths_fixed else other


def _with_scales(motion: BodyMotion, mean: Tensor, cov: Tensor) -> BodyMotion:
    other = copy.copy(motion)
    other._buffers = {**motion._buffers, "scale_mean": mean, "scale_cov": cov}
    return other
