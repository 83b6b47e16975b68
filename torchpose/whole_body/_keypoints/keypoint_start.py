"""Find the state in which a body begins: from the keypoints of one frame, without a guess.

Joints are triangulated by the cameras that agree on them. Where there is one camera, they are put at the
depth at which a person has the image's size. They tell where the trunk is and its axis. The filter's own
correction then begins at several headings, with noise that is wide at first. Evidence tells which is right.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.body_kalman import (
    BodyGaussian,
    BodyKalmanFilter,
    CorrectedBody,
)
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps

__all__ = ["Start", "start"]

_HEADINGS, _HEADINGS_OF_ONE = 8, 12
_WIDTHS = (
    400.0,
    200.0,
    100.0,
    50.0,
    25.0,
    12.0,
    6.0,
    3.0,
    1.5,
    1.0,
    1.0,
)  # factors of the noise's variance
_COARSE, _HEADINGS_KEPT = 3, 2  # of these for all headings of one camera, which are then so many
_POSITION, _ROOT_TURN, _TURN = 0.3, 0.5, 0.8  # metres and radians: how unsure a start is
_SPEED, _TURN_SPEED = 1.5, 5.0  # per second
_LOG_ODDS, _DOUBT = -6.0, -5.0
_TRUNK = (("left_shoulder", "right_shoulder", "neck", "head"), ("left_hip", "right_hip", "pelvis"))
_SIDED = ("shoulder", "hip")
_LEAST_WIDTH = 0.05  # metres between left and right that tell a direction
_TRUNK_SHARE, _BODY_SHARE = 0.28, 0.9  # of the height: from hips to shoulders, from ankles to head
_DEFAULT_HEIGHT = 1.7


class Start(NamedTuple):
    """Holds hypotheses of a start, [B * M] corrected, and their log-evidence [B, M], the best first."""

    found: CorrectedBody
    log_weights: Tensor


def start(filter: BodyKalmanFilter, frame: KeypointFrame, count: int) -> Start:
    """Return the likeliest hypotheses of a start.

    Several cameras see the pose, so it is corrected from limbs along triangulated bones, at several headings.
    One camera does not: there every component of the pose prior is a hypothesis of its own, and the best
    heading of each is kept.

    Args:
        filter: that tracks on. frame: the first keypoints, of B persons.
        count: of hypotheses for each person, at most.
    """
    if len(filter.maps.shift) == 1:
        return _start_of_one(filter, frame, count)
    maps, body, motion = filter.maps, filter.articulation, filter.motion
    joints = triangulate(maps, frame)
    points = _points(body, motion, maps, joints, _HEADINGS)
    joints = joints.repeat_interleave(_HEADINGS, 0)
    points = body.swung(points, joints, joints.isfinite().all(-1))
    state = filter.pulled(_state(points, _initial_cov(motion)[None], maps), 1.0)
    found, evidence = _corrected(filter, state, frame, _WIDTHS)
    return _likeliest(found, evidence, count)


def _start_of_one(filter: BodyKalmanFilter, frame: KeypointFrame, count: int) -> Start:
    """Return the likeliest hypotheses in one camera: the best heading of every component of the pose prior.

    All headings are corrected with the widest noise, and of every component the best few with all of it.
    """
    maps, body, motion = filter.maps, filter.articulation, filter.motion
    points = _points(body, motion, maps, _at_one_depth(maps, frame, body), _HEADINGS_OF_ONE)
    log_prior = motion.poses.weights.log()
    state = _state(_posed(body, motion, points), _posed_covs(motion), maps)
    kinds = len(log_prior)
    _, evidence = _corrected(filter, state, frame, _WIDTHS[:_COARSE])
    best = evidence.unflatten(1, (-1, kinds)).topk(_HEADINGS_KEPT, 1).indices
    chosen = (best * kinds + _counted(kinds, best)).flatten(1)
    state = state.take(_rows_of(chosen, evidence.shape[1]))
    found, evidence = _corrected(filter, state, frame, _WIDTHS)
    evidence, heading = (evidence.unflatten(1, (-1, kinds)) + log_prior).max(1)
    found = found.take(_rows_of(heading * kinds + _counted(kinds, heading), _HEADINGS_KEPT * kinds))
    return _likeliest(found, evidence, count)


def _corrected(
    filter: BodyKalmanFilter, state: BodyGaussian, frame: KeypointFrame, widths: Sequence[float]
) -> tuple[CorrectedBody, Float[Tensor, "B M"]]:
    """Return the hypotheses of B persons, the same number of each, corrected, and their log-evidence."""
    count = len(frame.pixels)
    every = _counted(count, frame.pixels).repeat_interleave(len(state.scale) // count)
    found = filter.correct(state, frame.take(every), widths)
    return found, found.log_evidence.view(count, -1)


def _likeliest(found: CorrectedBody, evidence: Float[Tensor, "B M"], count: int) -> Start:
    """Return so many hypotheses at most, the best first."""
    weights, best = evidence.topk(min(count, evidence.shape[1]), -1)
    return Start(found.take(_rows_of(best, evidence.shape[1])), weights)


def _rows_of(chosen: Int[Tensor, "B K"], n_each: int) -> Int[Tensor, " N"]:
    """Return the rows of chosen hypotheses of each of B persons, who have so many each."""
    return (_counted(len(chosen), chosen)[:, None] * n_each + chosen).flatten()


def _counted(count: int, like: Tensor) -> Int[Tensor, " N"]:
    return torch.arange(count, device=like.device)


def _state(points: BodyPoint, covs: Float[Tensor, "#B N N"], maps: RigMaps) -> BodyGaussian:
    """Return Gaussians about points that take the covariances in turn; nothing is known of cameras."""
    count, n_cameras = len(points.position), len(maps.shift)
    new = points.position.new_full
    return BodyGaussian(
        points,
        covs.repeat(count // len(covs), 1, 1),
        new((count, n_cameras, 2), _LOG_ODDS),
        new((count, n_cameras), 1.0),
        new((count, len(BODY_15.names)), _DOUBT),
    )


def _posed(body: Articulation, motion: BodyMotion, points: BodyPoint) -> BodyPoint:
    """Return the points with every component's mean pose, those of a point one after the other."""
    means = motion.poses.means
    angles = means.new_zeros(len(means), body.n_rotations)
    angles[:, body.n_rotations - means.shape[1] :] = means
    step = means.new_zeros(len(means), body.dim)
    step[:, body.columns["rotations"]] = angles
    every = torch.arange(len(points.position), device=means.device)
    repeated = points.map(lambda value: value[every.repeat_interleave(len(means))])
    return body.moved(repeated, step.repeat(len(points.position), 1))


def _posed_covs(motion: BodyMotion) -> Float[Tensor, "K N N"]:
    """Return the covariances of a start in every component of the pose prior."""
    covs = _initial_cov(motion).repeat(len(motion.poses.weights), 1, 1)
    columns = motion.articulation.relative_columns
    covs[:, columns, columns] = motion.poses.covariances
    return covs


def _at_one_depth(
    maps: RigMaps, frame: KeypointFrame, articulation: Articulation
) -> Float[Tensor, "B J 3"]:
    """Return the keypoints of the first camera at the depth at which a person has their size."""
    there = (frame.inlier[:, 0] > 0)[..., None]
    pixels = torch.where(there, frame.pixels[:, 0], torch.nan)
    top, low = (_middle(articulation, pixels, names) for names in _TRUNK)
    trunk = (top - low).norm(dim=-1) / _TRUNK_SHARE
    high = torch.where(there, frame.pixels[:, 0], -math.inf).amax(1)
    deep = torch.where(there, frame.pixels[:, 0], math.inf).amin(1)
    box = (high - deep).amax(-1) / _BODY_SHARE
    size = torch.where(trunk.isfinite(), torch.maximum(trunk, box), box).clamp_min(1.0)
    focal = torch.linalg.det(maps.matrix[0]).abs().sqrt()
    depth = focal * _DEFAULT_HEIGHT / size
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) * depth[:, None, None]
    return torch.linalg.solve(maps.matrix[0], (homogeneous - maps.shift[0]).mT).mT


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
