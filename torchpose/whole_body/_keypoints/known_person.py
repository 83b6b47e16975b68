"""Put what is known of a person into the prior over bodies: bone lengths, or the height."""

import copy
from collections.abc import Mapping

import torch
from torch import Tensor

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import SkeletonError
from torchpose.priors._body_motion import BodyMotion

__all__ = ["of_one_camera", "with_body", "with_height"]

_LENGTH_STD = 0.01  # of the log of a given bone length
_TRUNK = ("neck", "shoulder", "hip")  # where joint sets differ in what they call a joint
_TRUNK_STD_OF_ONE = 0.1  # of the log of their lengths
_SHIFT_STD_OF_ONE, _SHIFT_TIME_OF_ONE = 0.015, 0.5  # metres, seconds
_PULL_TIME_OF_ONE = 0.05  # seconds
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
    return _with(motion, {"scale_mean": scales, "scale_cov": cov})


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
    return _with(motion, {"scale_mean": mean, "scale_cov": (cov + cov.mT) / 2})


def of_one_camera(motion: BodyMotion, lengths_fixed: bool) -> BodyMotion:
    """Return the prior for one camera, in which neither sizes nor the depths of limbs are seen.

    Limbs keep the lengths that are expected, and the trunk nearly. Corrections that are linear in lengths
    would shrink the body frame by frame, since a bone that is seen shorter is mostly turned and not short.
    For the same reason joints of the trunk shift little. Poses are pulled to the mixture more strongly.

    Args:
        motion: the prior. lengths_fixed: whether lengths are to be fixed; a given body's are already.
    """
    std = torch.full_like(motion.scale_mean, _LENGTH_STD)
    std[[motion.articulation.groups.index(name) for name in _TRUNK]] = _TRUNK_STD_OF_ONE
    given = {
        "pull_time": torch.full_like(motion.pull_time, _PULL_TIME_OF_ONE),
        "shift_std": torch.full_like(motion.shift_std, _SHIFT_STD_OF_ONE),
        "shift_time": torch.full_like(motion.shift_time, _SHIFT_TIME_OF_ONE),
    }
    if lengths_fixed:
        given["scale_cov"] = torch.diag(std.square())
    return _with(motion, given)


def _with(motion: BodyMotion, given: Mapping[str, Tensor]) -> BodyMotion:
    """Return the prior with some of its tensors replaced."""
    other = copy.copy(motion)
    other._buffers = {**motion._buffers, **given}
    return other
