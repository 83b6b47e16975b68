"""Propose poses that one camera hardly tells apart: limbs whose bones point away from it or towards it.

A bone v whose depth along the ray r of its joint is mirrored, v - 2 (v r) r, has nearly the same image, and a
Gaussian holds one of both poses. So the limbs of the likeliest hypothesis are mirrored in turn, and take the
place of the unlikeliest hypothesis where they are likelier than it by the density of poses.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._skeleton import BodySkeleton
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter

__all__ = ["Flipped", "LimbFlip", "flip", "limb_flips"]

_LOG_ODDS = -1.6  # of a flip: one in five
_DENSITY_SHARE = 0.3  # of the log density of poses
_LEAST_DEPTH = 0.08  # metres of a bone along its ray, below which both poses are one
_TURN, _TURN_SPEED = 0.3, 3.0  # radians, and per second: how unsure a mirrored limb is
_CHAINS = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))


class LimbFlip(NamedTuple):
    """Describes which bones of a limb are mirrored.

    Attributes:
        joints: indices of its three joints. upper, lower: whether that bone is mirrored.
    """

    joints: tuple[int, int, int]
    upper: bool
    lower: bool


class Flipped(NamedTuple):
    """Holds mirrored Gaussians [B] and their log-weight [B] relative to the given ones, -inf where alike."""

    state: BodyGaussian
    log_ratio: Tensor


def limb_flips(skeleton: BodySkeleton) -> tuple[LimbFlip, ...]:
    """Return all flips of arms and legs: of both bones, the lower one, the upper one."""
    flips = []
    for upper, lower in ((True, True), (False, True), (True, False)):
        for side in ("left", "right"):
            for chain in _CHAINS:
                first, middle, last = (skeleton.joint(f"{side}_{name}") for name in chain)
                flips.append(LimbFlip((first, middle, last), upper, lower))
    return tuple(flips)


def flip(
    filter: BodyKalmanFilter, state: BodyGaussian, joints: Float[Tensor, "B J 3"], limb: LimbFlip
) -> Flipped:
    """Return Gaussians with a limb mirrored in depth, as the first camera sees it.

    The limb stands still, and is independent of the rest.

    Args:
        filter: whose states they are. state: [B]. joints: of their means. limb: to mirror.
    """
    body, motion = filter.articulation, filter.motion
    moved, depth = _mirrored(filter, joints, limb)
    known = torch.zeros_like(joints[..., 0], dtype=torch.bool)
    known[:, list(limb.joints)] = True
    point = body.swung(state.mean, moved, known)
    ends = list(limb.joints[1:])
    turning = (body.carriers[ends].sum(0) > 0) & _turns(filter)
    speeding = torch.roll(turning, body.columns["velocity"].start)
    changed = turning | speeding
    cov = state.cov.masked_fill(changed[:, None] | changed, 0.0)
    cov = cov + torch.diag(_TURN**2 * turning + _TURN_SPEED**2 * speeding)
    still = point.velocity.masked_fill(speeding[body.columns["velocity"]], 0.0)
    mirrored = state._replace(mean=point._replace(velocity=still), cov=cov)
    gain = _log_density(motion, mirrored) - _log_density(motion, mirrored._replace(mean=state.mean))
    log_ratio = _LOG_ODDS + _DENSITY_SHARE * gain
    return Flipped(mirrored, torch.where(depth > _LEAST_DEPTH, log_ratio, -torch.inf))


def _mirrored(
    filter: BodyKalmanFilter, joints: Float[Tensor, "B J 3"], limb: LimbFlip
) -> tuple[Float[Tensor, "B J 3"], Float[Tensor, " B"]]:
    """Return joints with a limb mirrored, and the largest depth of a mirrored bone."""
    camera = -torch.linalg.solve(filter.maps.matrix[0], filter.maps.shift[0])
    result, depth = joints.clone(), torch.zeros_like(joints[:, 0, 0])
    bones = zip(limb.joints, limb.joints[1:], (limb.upper, limb.lower), strict=False)
    for start, end, turned in bones:
        bone = joints[:, end] - joints[:, start]
        ray = torch.nn.functional.normalize(joints[:, start] - camera, dim=-1)
        along = (bone * ray).sum(-1, keepdim=True)
        if turned:
            bone = bone - 2 * along * ray
            depth = torch.maximum(depth, along.squeeze(-1).abs())
        result[:, end] = result[:, start] + bone
    return result, depth


def _turns(filter: BodyKalmanFilter) -> Tensor:
    """Return which columns of the tangent are rotations."""
    columns = torch.zeros(filter.articulation.dim, dtype=torch.bool)
    columns[filter.articulation.columns["rotations"]] = True
    return columns.to(filter.maps.shift.device)


def _log_density(motion: BodyMotion, state: BodyGaussian) -> Float[Tensor, " B"]:
    body = motion.articulation
    columns = body.relative_columns
    return motion.log_density(body.relative_angles(state.mean), state.cov[:, columns, columns])
