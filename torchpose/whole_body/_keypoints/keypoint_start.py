"""Find the state in which a body begins: from the keypoints of one frame, without a guess.

Joints are triangulated by the cameras that agree on them. They tell where the trunk is, its axis and the
limbs. The filter's own correction then begins at several headings, with noise that is wide at first. Evidence
tells which is right. Where there is one camera, a network lifts the joints, which tells the heading too.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._lifting_network import Lifted
from torchpose.whole_body._keypoints.adapted_noise import AdaptedNoise
from torchpose.whole_body._keypoints.body_kalman import (
    FEW_INLIERS,
    BodyGaussian,
    BodyKalmanFilter,
    CorrectedBody,
)
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    KeypointFrame,
    RigMaps,
    with_sides_exchanged,
)
from torchpose.whole_body._keypoints.known_person import with_usual_trunk
from torchpose.whole_body._keypoints.lifted_pose import corrected_by
from torchpose.whole_body._keypoints.nested import replaced, taken

FEW_HEADINGS = 2
"""Headings that are enough where bodies are only compared."""

_HEADINGS = 8
# Factors of the noise's variance.
_WIDTHS = (400.0, 200.0, 100.0, 50.0, 25.0, 12.0, 6.0, 3.0, 1.5, 1.0, 1.0)
_WIDER = 16.0  # factor of the variance of cameras whose calibration may be wrong
_WIDTHS_OF_ONE = _WIDTHS[-5:]
_POSITION, _ROOT_TURN, _TURN = 0.3, 0.5, 0.8  # metres and radians: how unsure a start is
_SPEED, _TURN_SPEED = 1.5, 5.0  # per second
_LOG_ODDS, _DOUBT = -6.0, -5.0
# Seconds of keypoints that the usual noise of a camera counts for, of several cameras and of one, in which
# the scale of the noise depends on what the network lifts.
_USUAL, _USUAL_ALONE = 0.1, 2.0
_TRUNK = (("left_shoulder", "right_shoulder", "neck", "head"), ("left_hip", "right_hip", "pelvis"))
_SIDED = ("shoulder", "hip")
_LEAST_WIDTH = 0.05  # metres between left and right that tell a direction


def likeliest_start(filter: BodyKalmanFilter, frame: KeypointFrame) -> CorrectedBody:
    """Return the likeliest starts of B persons, of two cameras also of those with exchanged sides.

    Of two cameras, one that exchanges left and right of arms or legs looks like a body that has them the
    wrong way round.

    Args:
        filter: that tracks on. frame: the first keypoints.
    """
    found = start(filter, frame)
    count, n_cameras, _ = frame.inlier.shape
    if n_cameras != 2:
        return found
    n = 2 * n_cameras
    one_limb = torch.eye(n, dtype=torch.bool, device=frame.inlier.device).view(n, n_cameras, 2)
    every = torch.arange(count, device=frame.inlier.device).repeat_interleave(n)
    others = start(filter, frame.take(every), FEW_HEADINGS, one_limb.repeat(count, 1, 1))
    other = taken(others, _likeliest(others, n))
    better = other.log_evidence + _LOG_ODDS > found.log_evidence
    rows = better.nonzero().squeeze(-1)
    return replaced(found, rows, taken(other, rows))


def start(
    filter: BodyKalmanFilter,
    frame: KeypointFrame,
    n_headings: int = _HEADINGS,
    exchanged: Bool[Tensor, "B C 2"] | None = None,
) -> CorrectedBody:
    """Return the likeliest starts of B persons whom several cameras see.

    Args:
        filter: that tracks on. frame: the first keypoints. n_headings: that are tried.
        exchanged: sides of arms and legs that are expected to be, in each camera; none if None.
    """
    sided = frame
    if exchanged is not None:
        sided = with_sides_exchanged(frame, exchanged, filter.exchange)
    joints = triangulate(filter.maps, sided)
    state = _begun(filter, joints, joints.isfinite().all(-1), n_headings)
    rows = torch.arange(len(joints), device=joints.device).repeat_interleave(n_headings)
    if exchanged is not None:
        state = state._replace(log_odds=state.log_odds.where(~exchanged[rows], -_LOG_ODDS))
    frames = frame.take(rows)
    state = _with_trunks(filter, state, filter.without_hips(frames))
    found = filter.correct(state, frames, _WIDTHS)
    best = _likeliest(found, n_headings)
    return _by_wider(filter, frame, taken(state, best), taken(found, best))


def _likeliest(found: CorrectedBody, n: int) -> Int[Tensor, " B"]:
    """Return which of each person's n bodies is the likeliest."""
    best = found.log_evidence.view(-1, n).argmax(-1)
    return best + n * torch.arange(len(best), device=best.device)


def _with_trunks(
    filter: BodyKalmanFilter, state: BodyGaussian, rows: Int[Tensor, " N"]
) -> BodyGaussian:
    """Return starts, some of which have trunks of a length that is usual for their arms."""
    if not len(rows):
        return state
    motion, scales = with_usual_trunk(filter.motion), filter.articulation.columns["scales"]
    wanted = taken(state, rows)
    mean = wanted.mean._replace(scales=motion.scale_mean.expand_as(wanted.mean.scales))
    cov = wanted.cov.clone()
    cov[:, scales, scales] = motion.scale_cov
    return replaced(state, rows, wanted._replace(mean=mean, cov=cov))


def _by_wider(
    filter: BodyKalmanFilter, frame: KeypointFrame, state: BodyGaussian, found: CorrectedBody
) -> CorrectedBody:
    """Return starts, with a wider noise of all cameras where that is likelier.

    Where calibrations are wrong, no three cameras agree on a joint by the usual noise. Two that do not
    agree may as well see two persons.
    """
    share = found.weighed.inlier.sum((-2, -1)) / frame.inlier.sum((-2, -1))
    several = frame.there.any(-1).sum(-1) > 2
    rows = ((share < FEW_INLIERS) & several).nonzero().squeeze(-1)
    if not len(rows):
        return found
    state = taken(state, rows)
    wide = state._replace(scale=_WIDER * state.scale)
    again = filter.correct(wide, frame.take(rows), _WIDTHS)
    better = again.log_evidence > found.log_evidence[rows]
    return replaced(found, rows[better], taken(again, better.nonzero().squeeze(-1)))


def start_of_one(
    filter: BodyKalmanFilter, frame: KeypointFrame, lifted: Lifted, joints: Float[Tensor, "B J 3"]
) -> CorrectedBody:
    """Return the starts of B persons whom one camera sees.

    Args:
        filter: that tracks on. frame: the first keypoints. lifted: what a network makes of them.
        joints: the same, where they fit the keypoints in the world.
    """
    state = _begun(filter, joints, torch.ones_like(joints[..., 0], dtype=torch.bool), 1)
    return filter.correct(corrected_by(lifted, filter, state), frame, _WIDTHS_OF_ONE)


def _begun(
    filter: BodyKalmanFilter,
    joints: Float[Tensor, "B J 3"],
    known: Bool[Tensor, "B J"],
    n_headings: int,
) -> BodyGaussian:
    """Return wide Gaussians about bodies whose limbs point along joints, at every heading."""
    maps, body, motion = filter.maps, filter.articulation, filter.motion
    points = _points(body, motion, maps, joints, n_headings)
    joints, known = (value.repeat_interleave(n_headings, 0) for value in (joints, known))
    points = body.swung(points, joints, known)
    return filter.pulled(_state(points, _initial_cov(motion), maps, filter.fps), 1.0)


def _state(points: BodyPoint, cov: Float[Tensor, "N N"], maps: RigMaps, fps: float) -> BodyGaussian:
    """Return Gaussians about points; nothing is known of cameras."""
    count, n_cameras = len(points.position), len(maps.shift)
    told = (_USUAL_ALONE if n_cameras == 1 else _USUAL) * fps
    new = points.position.new_full
    return BodyGaussian(
        points,
        cov.expand(count, *cov.shape),
        new((count, n_cameras, 2), _LOG_ODDS),
        new((count, n_cameras), 1.0),
        new((count, len(BODY_15.names)), _DOUBT),
        new((count, n_cameras), told),
        new((count, len(BODY_15.names), 3), torch.nan),
        AdaptedNoise.usual(new((count, 3 * len(BODY_15.names)), 0.0)),
    )


def _middle(
    articulation: Articulation, points: Float[Tensor, "B J d"], names: Sequence[str]
) -> Float[Tensor, "B d"]:
    """Return the mean of the known ones of some joints, NaN if there is none."""
    return points[:, [articulation.skeleton.joint(name) for name in names]].nanmean(1)


def _points(
    articulation: Articulation,
    motion: BodyMotion,
    maps: RigMaps,
    joints: Float[Tensor, "B J 3"],
    n_headings: int,
) -> BodyPoint:
    """Return upright bodies at the joints, with the limbs at their centres, at every heading."""
    top, low = (_middle(articulation, joints, names) for names in _TRUNK)
    image_up = -torch.linalg.solve(maps.matrix[0], torch.eye(3).to(joints))[:, 1]
    up = torch.where((top - low).isfinite(), top - low, image_up)
    up = torch.nn.functional.normalize(up, dim=-1)
    position = torch.where(low.isfinite(), low, joints.nanmean(1)).nan_to_num()
    side = _leftwards(articulation, joints, up)
    trunk = torch.stack([side, up, torch.linalg.cross(side, up)], -1)
    angles = torch.arange(n_headings).to(up) * (2 * math.pi / n_headings)
    headings = rotvec_to_matrix(angles[:, None] * torch.tensor([0.0, 1.0, 0.0]).to(up))
    count = len(joints) * n_headings
    rotations = torch.eye(3).to(up).repeat(count, len(articulation.skeleton.parts), 1, 1)
    rotations[:, 0] = (trunk[:, None] @ headings).flatten(0, 1)
    return BodyPoint(
        position.repeat_interleave(n_headings, 0),
        rotations,
        up.new_zeros(count, articulation.n_pose),
        motion.scale_mean.to(up).expand(count, -1),
        up.new_zeros(count, len(articulation.shifted), 3),
    )


def _leftwards(
    articulation: Articulation, joints: Float[Tensor, "B J 3"], up: Float[Tensor, "B 3"]
) -> Float[Tensor, "B 3"]:
    """Return the direction from right to left across an axis, any where shoulders and hips are not known."""
    left, right = (
        torch.stack([joints[:, articulation.skeleton.joint(f"{side}_{name}")] for name in _SIDED])
        for side in ("left", "right")
    )
    apart = (left - right).nanmean(0).nan_to_num()
    apart = apart - (apart * up).sum(-1, keepdim=True) * up
    least = torch.nn.functional.one_hot(up.abs().argmin(-1), 3).to(up)
    known = apart.norm(dim=-1, keepdim=True) > _LEAST_WIDTH
    side = torch.where(known, apart, torch.linalg.cross(least, up))
    return torch.nn.functional.normalize(side, dim=-1)


def _initial_cov(motion: BodyMotion) -> Float[Tensor, "N N"]:
    """Return the covariance of a start before any keypoint."""
    a, at = motion.articulation, motion.articulation.columns
    std = torch.zeros(a.dim).to(motion.acceleration)
    std[at["position"]] = _POSITION
    std[at["rotations"]] = _TURN
    std[at["rotations"]][:3] = _ROOT_TURN
    std[at["velocity"]] = _TURN_SPEED
    std[at["velocity"]][:3] = _SPEED
    std[at["shifts"]] = motion.shift_std.repeat_interleave(3)
    cov = torch.diag(std.square())
    cov[at["scales"], at["scales"]] = motion.scale_cov
    return cov
