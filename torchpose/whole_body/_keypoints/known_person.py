"""Put what is known of a person into the prior over bodies: bone lengths, or the height."""

import copy
from collections.abc import Mapping

import torch
from torch import Tensor

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import SkeletonError
from torchpose.math._gaussian import symmetrise
from torchpose.priors._body_motion import BodyMotion

_LEGS = ("knee", "ankle")  # joints at the lower ends of their bones
_LENGTH_STD = 0.01  # of the log of a given bone length
_TOLD_STD = 0.002  # of the log of the legs' length, in one camera, of a known person
# Of the logarithm of a bone's scale against another's: mean and standard deviation over the walkers and the
# persons of MHAD for choosing.
_TRUNK = {("neck", "elbow"): (0.05, 0.06), ("hip", "shoulder"): (0.02, 0.08)}
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
    told = weights_of_legs(motion)
    wanted = body.scales_of(BODY_15.standard_lengths(height).to(motion.scale_mean)) @ told
    cross = motion.scale_cov @ told
    gain = cross / (told @ cross + _HEIGHT_STD**2)
    mean = motion.scale_mean + gain * (wanted - told @ motion.scale_mean)
    cov = motion.scale_cov - gain[:, None] * cross
    return _with(motion, {"scale_mean": mean, "scale_cov": symmetrise(cov)})


def of_one_camera(motion: BodyMotion, told: bool = False) -> BodyMotion:
    """Return the prior for one camera, in which nothing tells a small person from a far one.

    The legs together keep the length that is expected. Proportions have the covariance over persons whose
    legs are equally long.

    Args:
        motion: of the person. told: whether the length of the legs is known. Limbs of whose depth the network
            that lifts is unsure come out short, and would make the legs short within seconds.
    """
    legs = weights_of_legs(motion)
    cross = motion.scale_cov @ legs
    cov = motion.scale_cov - cross[:, None] * cross / (legs @ cross)
    along = legs[:, None] * legs / (legs @ legs)
    std = _TOLD_STD if told else _LENGTH_STD
    cov = cov + _LENGTH_STD**2 * (torch.eye(len(cov)).to(cov) - along) + std**2 * along
    return _with(motion, {"scale_cov": symmetrise(cov)})


def with_usual_trunk(motion: BodyMotion) -> BodyMotion:
    """Return the prior of a person of whom no hip is seen; trunks end in the middle of shoulders and hips.

    Sets of recordings have the pelvis in different places, so lengths of trunks are spread widely. Where no
    hip is seen, nothing tells which place is meant, and the trunk goes with upper arms and shoulders.
    """
    groups, mean, cov = motion.articulation.groups, motion.scale_mean, motion.scale_cov
    of = torch.eye(len(groups)).to(mean)
    H = torch.stack([of[groups.index(bone)] - of[groups.index(other)] for bone, other in _TRUNK])
    expected, std = torch.tensor(list(_TRUNK.values())).to(mean).unbind(-1)
    gain = torch.linalg.solve(H @ cov @ H.mT + torch.diag(std.square()), H @ cov).mT
    cov = cov - gain @ H @ cov
    given = {"scale_mean": mean + gain @ (expected - H @ mean), "scale_cov": symmetrise(cov)}
    return _with(motion, given)


def length_of_legs(motion: BodyMotion) -> float:
    """Return the expected length of thigh and shank, metres."""
    body = motion.articulation
    lengths = body.offsets.norm(dim=-1) * motion.scale_mean[body.group].exp().to(body.offsets)
    legs = [j for j, name in enumerate(BODY_15.names) if name.endswith(_LEGS)]
    return float(lengths[legs].sum()) / 2


def std_of_legs(motion: BodyMotion) -> float:
    """Return the standard deviation of the log of the legs' length."""
    told = weights_of_legs(motion)
    return float((told @ motion.scale_cov @ told).clamp_min(0).sqrt())


def weights_of_legs(motion: BodyMotion) -> Tensor:
    """Return the weights of the logarithms of lengths whose sum is that of the legs."""
    legs = [name in _LEGS for name in motion.articulation.groups]
    told = torch.tensor(legs).to(motion.scale_mean)
    return told / told.sum()


def _with(motion: BodyMotion, given: Mapping[str, Tensor]) -> BodyMotion:
    """Return the prior with some of its tensors replaced."""
    other = copy.copy(motion)
    other._buffers = {**motion._buffers, **given}
    return other
