"""Propose poses that one camera hardly tells apart: limbs whose bones point away from it or towards it.

A bone v whose depth along the ray r of its joint is mirrored, v - 2 (v r) r, has nearly the same image, and a
Gaussian holds one of both poses. So the limbs of the likeliest hypothesis are mirrored in turn, and take the
place of the unlikeliest hypothesis where they are likelier than it by the density of poses.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body._articulation import Articulation
from torchpose.body._skeleton import BodySkeleton
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter

__all__ = ["Flipped", "flip"]

_LOG_ODDS = -1.6  # of a flip: one in five
_DENSITY_SHARE = 0.3  # of the log density of poses
_LEAST_DEPTH = 0.08  # metres of a bone along its ray, below which both poses are one
_TURN, _TURN_SPEED = 0.3, 3.0  # radians, and per second: how unsure a mirrored limb is
_MIRRORED = ((True, True), (False, True), (True, False))  # upper and lower bone
_CHAINS = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))


class Flipped(NamedTuple):
    """Holds mirrored Gaussians [B] and their log-weight [B] relative to the given ones, -inf where alike."""

    state: BodyGaussian
    log_ratio: Tensor


def flip(
    filter: BodyKalmanFilter,
    state: BodyGaussian,
    joints: Float[Tensor, "B J 3"],
    turn: Int[Tensor, " B"],
) -> Flipped:
    """Return Gaussians with a limb mirrored in depth, as the first camera sees it.

    The limb stands still, and is independent of the rest.

    Args:
        filter: whose states they are. state: [B]. joints: of their means.
        turn: number of the flip: all limbs have both bones mirrored, then the lower one, then the upper one.
    """
    body = filter.articulation
    chains = _chains(body.skeleton).to(turn.device)
    limb = chains[turn % len(chains)]
    both = torch.tensor(_MIRRORED).to(turn.device)[turn // len(chains) % len(_MIRRORED)]
    moved, depth = _mirrored(filter, joints, limb, both)
    known = torch.zeros_like(joints[..., 0], dtype=torch.bool).scatter(1, limb, True)
    point = body.swung(state.mean, moved, known)
    turning, speeding = _columns(body, limb)
    changed = turning | speeding
    cov = state.cov.masked_fill(changed[..., None, :] | changed[..., None], 0.0)
    cov = cov + torch.diag_embed(_TURN**2 * turning + _TURN_SPEED**2 * speeding)
    still = point.velocity.masked_fill(speeding[:, body.columns["velocity"]], 0.0)
    mirrored = state._replace(mean=point._replace(velocity=still), cov=cov)
    gain = _log_density(filter.motion, mirrored)
    gain = gain - _log_density(filter.motion, mirrored._replace(mean=state.mean))
    log_ratio = _LOG_ODDS + _DENSITY_SHARE * gain
    return Flipped(mirrored, torch.where(depth > _LEAST_DEPTH, log_ratio, -torch.inf))


def _chains(skeleton: BodySkeleton) -> Int[Tensor, "4 3"]:
    """Return the three joints of arms and legs."""
    return torch.tensor(
        [[skeleton.joint(f"{side}_{n}") for n in c] for side in ("left", "right") for c in _CHAINS]
    )


def _columns(body: Articulation, limb: Int[Tensor, "B 3"]) -> tuple[Tensor, Tensor]:
    """Return which columns [B, N] of the tangent turn a limb, and which are their velocities."""
    at = body.columns
    carried = body.carriers[limb[:, 1:]].sum(1) > 0
    turning, speeding = torch.zeros_like(carried), torch.zeros_like(carried)
    turning[:, at["rotations"]] = carried[:, at["rotations"]]
    speeding[:, at["velocity"]] = carried[:, at["velocity"]]
    return turning, speeding


def _mirrored(
    filter: BodyKalmanFilter,
    joints: Float[Tensor, "B J 3"],
    limb: Int[Tensor, "B 3"],
    both: Bool[Tensor, "B 2"],
) -> tuple[Float[Tensor, "B J 3"], Float[Tensor, " B"]]:
    """Return joints with the bones of a limb mirrored, and the largest depth of a mirrored bone."""
    camera = -torch.linalg.solve(filter.maps.matrix[0], filter.maps.shift[0])
    places = limb[..., None].expand(-1, -1, 3)
    chain = joints.gather(1, places)
    bones, starts = chain[:, 1:] - chain[:, :-1], chain[:, :-1]
    rays = torch.nn.functional.normalize(starts - camera, dim=-1)
    along = (bones * rays).sum(-1) * both
    bones = bones - 2 * along[..., None] * rays
    moved = torch.cat([chain[:, :1], chain[:, :1] + bones.cumsum(1)], 1)
    return joints.scatter(1, places, moved), along.abs().amax(-1)


def _log_density(motion: BodyMotion, state: BodyGaussian) -> Float[Tensor, " B"]:
    body = motion.articulation
    columns = body.relative_columns
    return motion.log_density(body.relative_angles(state.mean), state.cov[:, columns, columns])
