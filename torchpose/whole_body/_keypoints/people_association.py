"""Decide whose detections are whose: by the predictions of tracked persons, and across cameras.

A detection d of camera c is that of person p rather than that of somebody new by the log odds

    g_pcd = sum_j log p(z_cdj | x_p) - log N(z_cdj; somewhere within a body's size),

with the filter's own predictive density of keypoints. Where p's joint is behind the camera, that of somebody
new may be anywhere in its image. In each camera the assignment of detections to persons that has the largest
sum of log odds is taken; a person without any above 0 has none. Persons who were not seen for a while get
what others leave, and begin anew with a group of detections that is where they are expected (`returned`).
"""

import math
from itertools import combinations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.assignment import best_columns
from torchpose.body._articulation import covariances_of
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.whole_body._keypoints.begin_anew import LEAST_JOINTS, sees_enough
from torchpose.whole_body._keypoints.body_kalman import BodyGaussian, BodyKalmanFilter
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    Beliefs,
    KeypointFrame,
    RigMaps,
    Seen,
    readings_of,
    see,
    weigh,
)

_TRUNK = [BODY_15.joint(name) for name in ("pelvis", "neck", "left_hip", "right_hip")]
_REACH = 11.3  # squared standard deviations within which 99 % of places in the room are
_BODY_SIZE = 0.25  # metres, standard deviation of keypoints of somebody else about a joint
_FARTHER = 2.0  # standard deviations of a prediction, within which somebody else is
_AGREE = 0.5  # share of the joints of two detections that must be triangulated
_WIDER = 2.0  # factor of the noise's variance, of a point that two cameras give
_BONE_STD = 0.25  # of a bone's length, relative
_FARTHEST_BONE = 4.0  # standard deviations, at which the penalty of a bone ends
_HEIGHT = 1.7  # metres, of the bones expected


def detection_gains(
    filter: BodyKalmanFilter, predicted: BodyGaussian, frame: KeypointFrame, width: float = 1.0
) -> Float[Tensor, "P C D"]:
    """Return the log odds of detections as those of persons against somebody new, -inf without keypoints.

    Args:
        filter: that predicted. predicted: one state for each of P persons.
        frame: [D, C, J], of the D detections of each camera. width: factor of the noise's variance.
    """
    joints, jacobian = filter.articulation.linearise(predicted.mean)
    joint_cov = covariances_of(jacobian, predicted.cov)
    seen = see(filter.maps, joints)
    n_persons, n_detections = len(joints), len(frame.pixels)
    persons = torch.arange(n_persons, device=joints.device).repeat_interleave(n_detections)
    pairs = frame.take(torch.arange(n_detections, device=joints.device).repeat(n_persons))
    seen = Seen(*(value[persons] for value in seen))
    beliefs = Beliefs(*(value[persons] for value in predicted.beliefs))
    weighed = weigh(
        readings_of(pairs, filter.exchange), seen, filter.maps, beliefs, filter.exchange,
        joint_cov[persons], marginal=True, width=width,
    )  # fmt: skip
    there = pairs.there
    about = _of_another(seen, joint_cov[persons])
    of_another = torch.where(seen.in_front, about, -filter.maps.log_area[:, None])
    gain = (weighed.log_joint - torch.where(there, of_another, 0.0)).sum(-1)
    gain = torch.where(there.any(-1), gain, -math.inf)
    return gain.unflatten(0, (n_persons, n_detections)).mT


def _of_another(
    seen: Seen, joint_cov: Float[Tensor, "B J 3 3"] | None = None
) -> Float[Tensor, "B C J"]:
    """Return the log density of a keypoint of somebody else who is about here.

    Args:
        seen: joints. joint_cov: of their prediction. Where that hardly tells the place, as at few frames a
            second, somebody else is no nearer than the person may be.
    """
    variance = 0.5 * _BODY_SIZE**2 * seen.by_joint.square().sum((-2, -1))
    if joint_cov is not None:
        spread = seen.by_joint @ joint_cov.unsqueeze(-4) * seen.by_joint
        variance = variance + 0.5 * _FARTHER**2 * spread.sum((-2, -1))
    return -(2 * math.pi * variance).log()


def assign(gains: Float[Tensor, "P C D"]) -> Int[Tensor, "P C"]:
    """Return the detection of every person in every camera, -1 if none, of the largest sum of gains.

    Where no two persons want the same detection, each has the best; else the Hungarian method decides.
    """
    best, wanted = gains.max(-1)
    wanted = torch.where(best > 0.0, wanted, -1)
    clash = (wanted[:, None] == wanted) & (wanted[:, None] >= 0)
    clash = clash.sum(0) > 1
    for camera in clash.any(0).nonzero().flatten().tolist():
        values = gains[:, camera].clamp_min(0).nan_to_num(0.0).cpu().numpy()
        chosen = torch.from_numpy(best_columns(values)).to(wanted)
        gained = gains[:, camera].gather(-1, chosen.clamp_min(0)[:, None]).squeeze(-1)
        wanted[:, camera] = torch.where((chosen >= 0) & (gained > 0), chosen, -1)
    return wanted


def left_over(gains: Float[Tensor, "P C D"], chosen: Int[Tensor, "P C"]) -> Int[Tensor, "P C"]:
    """Return the detections of persons, where they have none those by other gains that nobody has.

    Args:
        gains: by which they may get one. chosen: what they have already, -1 if none.
    """
    owned = owned_detections(chosen, gains.shape[-1])
    rest = gains.masked_fill(owned | (chosen >= 0)[..., None], -math.inf)
    return torch.where(chosen >= 0, chosen, assign(rest))


def owned_detections(chosen: Int[Tensor, "P C"], count: int) -> Bool[Tensor, "C D"]:
    """Return which of so many detections of each camera are somebody's."""
    return (chosen[..., None] == torch.arange(count, device=chosen.device)).any(0)


def taken_detections(frame: KeypointFrame, chosen: Int[Tensor, "P C"]) -> KeypointFrame:
    """Return the keypoints [P, C, J] of the detections of persons, none where it is -1."""
    cameras = torch.arange(chosen.shape[1], device=chosen.device)
    values = frame.map(lambda value: value[chosen.clamp_min(0), cameras])
    return values._replace(inlier=torch.where((chosen >= 0)[..., None], values.inlier, 0.0))


# --- persons who come back ------------------------------------------------------------------------


def returned(
    filter: BodyKalmanFilter,
    predicted: BodyGaussian,
    away: Bool[Tensor, " P"],
    owner: Bool[Tensor, "P G"],
    groups: KeypointFrame,
) -> Bool[Tensor, "P G"]:
    """Return which groups of detections are where persons are expected who were not seen for a while.

    Errors of the joints of such a prediction are nearly the same for all, so the trunk's mean error d counts
    once: d^T C^-1 d, with the mean C of the joints' covariances. Everybody gets one group at most, and of
    all ways to give them away the one with the least sum is taken.

    Args:
        filter: that predicted. predicted: one state for each of P persons. away: who is expected.
        owner: whose groups are known already. groups: keypoints [G, C, J].
    """
    joints = triangulate(filter.maps, groups)[:, _TRUNK]
    expected, jacobian = filter.articulation.linearise(predicted.mean)
    cov = covariances_of(jacobian, predicted.cov)[:, _TRUNK].mean(1)
    off = (joints - expected[:, None, _TRUNK]).nanmean(-2)
    square = (off * torch.linalg.solve(cov, off.mT).mT).sum(-1)
    closed = ~away[:, None] | owner.any(0) | owner.any(1, keepdim=True) | square.isnan()
    gains = (_REACH - square).masked_fill(closed, -math.inf)
    chosen = assign(gains[:, None])
    return chosen == torch.arange(len(joints), device=chosen.device)


# --- new persons ----------------------------------------------------------------------------------


def group_detections(
    maps: RigMaps, frame: KeypointFrame, free: Bool[Tensor, "C D"]
) -> Int[Tensor, "G C"]:
    """Return the detections of new persons, -1 in cameras without, the surest person first.

    Every two detections of two cameras triangulate joints, in every other camera the detection that agrees
    best joins them, and lengths of bones count. The likeliest group is taken, then the likeliest of what
    is left. Of one camera every detection is a person.

    Args:
        maps: the cameras. frame: [D, C, J]. free: which detections are to be grouped.
    """
    free = free & sees_enough(frame).mT
    if len(maps.shift) == 1:
        return free[0].nonzero()
    pairs = _pairs(free)
    if not len(pairs):
        return pairs
    joints = triangulate(maps, taken_detections(frame, pairs))
    known = joints.isfinite().all(-1)
    gains = _agreement(maps, frame, joints).masked_fill(~free, -math.inf)
    of_pair = gains.gather(-1, pairs.clamp_min(0)[..., None]).squeeze(-1)
    best, joined = gains.max(-1)
    groups = torch.where(pairs >= 0, pairs, torch.where(best > 0, joined, -1))
    score = torch.where(pairs >= 0, of_pair, best.clamp_min(0)).sum(-1) - _bone_penalty(joints)
    there = taken_detections(frame, pairs).there.sum(1) == 2
    enough = known.sum(-1) >= (_AGREE * there.sum(-1)).clamp_min(LEAST_JOINTS)
    enough &= ((of_pair > 0) | (pairs < 0)).all(-1)
    return _disjoint(groups, torch.where(enough, score, -math.inf))


def pairs_of_detections(frame: KeypointFrame) -> KeypointFrame:
    """Return the keypoints [N, C, J] of all pairs of detections of two cameras.

    Args:
        frame: [D, C, J].
    """
    return taken_detections(frame, _pairs(sees_enough(frame).mT))


def _pairs(free: Bool[Tensor, "C D"]) -> Int[Tensor, "H C"]:
    """Return all pairs of detections of two cameras, -1 in the other cameras."""
    found = []
    for a, b in combinations(range(len(free)), 2):
        both = (free[a][:, None] & free[b]).nonzero()
        pair = both.new_full((len(both), len(free)), -1)
        pair[:, [a, b]] = both
        found.append(pair)
    return torch.cat(found)


def _agreement(
    maps: RigMaps, frame: KeypointFrame, joints: Float[Tensor, "H J 3"]
) -> Float[Tensor, "H C D"]:
    """Return the log odds of detections as those of triangulated joints against somebody else."""
    known = joints.isfinite().all(-1)
    seen = see(maps, joints.nan_to_num())
    variance = _WIDER * frame.noise(seen.by_joint[:, None])
    square = (frame.pixels - seen.pixels[:, None]).square().sum(-1)
    log_in = -0.5 * square / variance - (2 * math.pi * variance).log()
    outside = torch.log1p(-frame.inlier) - maps.log_area[:, None]
    both = torch.logaddexp(frame.inlier.clamp_min(1e-30).log() + log_in, outside)
    there = frame.there & (known[:, None] & seen.in_front)[:, None]
    gains = torch.where(there, both - _of_another(seen)[:, None], 0.0)
    return gains.sum(-1).mT


def _bone_penalty(joints: Float[Tensor, "H J 3"]) -> Float[Tensor, " H"]:
    """Return half the squared deviations of bones from usual lengths, up to a farthest one."""
    parents = torch.tensor([max(parent, 0) for parent in BODY_15.parents])
    usual = Body.of_height(BODY_15, _HEIGHT).bone_lengths.to(joints).clamp_min(1e-3)
    off = ((joints - joints[:, parents]).norm(dim=-1) / usual - 1) / _BONE_STD
    off = off[:, 1:].nan_to_num(0.0).abs().clamp_max(_FARTHEST_BONE)
    return 0.5 * off.square().sum(-1)


def _disjoint(groups: Int[Tensor, "H C"], score: Float[Tensor, " H"]) -> Int[Tensor, "G C"]:
    """Return groups that share no detection, the one of the largest score first."""
    found = []
    while bool((score > 0.0).any()):
        group = groups[score.argmax()]
        found.append(group)
        shared = ((groups == group) & (group >= 0)).any(-1)
        score = score.masked_fill(shared, -math.inf)
    return torch.stack(found) if found else groups[:0]
