"""Bodies by grouping detections frame by frame, and tracking what they triangulate: a simple peer.

The way of several persons in Pose2Sim, read and not run: detections of two cameras belong together by the
mean distance of the rays of their joints, groups of them are triangulated without cameras that disagree, and
the bodies of successive frames are joined by their distance. Its circular constraints between three cameras
are replaced by groups that grow pair by pair.
"""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from benchmarks.keypoint_bodies.triangulation import (
    interpolated,
    low_pass,
    sure_keypoints,
    triangulate_subsets,
)
from benchmarks.keypoint_people.clips import People
from benchmarks.keypoint_people.scoring import Found
from torchpose.camera import CameraRig

RAYS = 0.1
"""Metres between the rays of joints, on average, from which two detections are of different persons."""

REACH = 0.5
"""Metres between the joints of two frames, on average, from which they are of different persons."""

_LEAST_JOINTS = 6
_GONE = 1.0  # seconds after which a person has left
_SHORTEST = 10  # frames of a track
_FAR = 1e6


def grouped(clip: People) -> list[Found]:
    """Return the bodies of each frame, joined over time; gaps stay."""
    bodies = []
    for keypoints, confidence in zip(clip.keypoints, clip.confidence, strict=True):
        groups = _groups(ray_distances(clip.rig, keypoints, confidence))
        bodies.append(_triangulated(clip.rig, keypoints, confidence, groups))
    return join_frames(bodies, clip.fps)


def filled(found: list[Found], fps: float) -> list[Found]:
    """Return bodies whose gaps are filled linearly, after a low-pass of 6 Hz forwards and backwards."""
    whole = [one for one in found if bool(one.joints.isfinite().flatten(1).any(0).all())]
    return [Found(one.first, low_pass(interpolated(one.joints), fps)) for one in whole]


def ray_distances(
    rig: CameraRig, keypoints: Float[Tensor, "C D J 2"], confidence: Float[Tensor, "C D J"]
) -> Float[Tensor, "C D C D"]:
    """Return the mean distance between the rays of joints, inf where fewer than six are in common."""
    sure = sure_keypoints(keypoints, confidence)
    ones = torch.ones_like(keypoints[..., :1])
    pixels = torch.cat([keypoints.nan_to_num(), ones], -1)
    inverse = torch.linalg.inv(rig.matrix)
    ray = torch.einsum("cji,cjk,cdnk->cdni", rig.rotation, inverse, pixels)
    ray = torch.nn.functional.normalize(ray, dim=-1)
    centre = -(rig.rotation.mT @ rig.translation[..., None]).squeeze(-1)
    normal = torch.linalg.cross(ray[:, :, None, None], ray[None, None])  # [C, D, C, D, J, 3]
    normal = torch.nn.functional.normalize(normal, dim=-1)
    apart = (centre[:, None] - centre)[:, None, :, None, None]
    distance = (normal * apart).sum(-1).abs()
    both = sure[:, :, None, None] & sure
    mean = (distance * both).sum(-1) / both.sum(-1).clamp_min(1)
    return torch.where(both.sum(-1) >= _LEAST_JOINTS, mean, torch.inf)


def _groups(distance: Float[Tensor, "C D C D"]) -> list[dict[int, int]]:
    """Return the detection of each camera of every group, which grow by the nearest pairs."""
    n_cameras, n_detections = distance.shape[:2]
    groups = {(c, d): {c: d} for c in range(n_cameras) for d in range(n_detections)}
    pairs = [
        (float(distance[a, i, b, j]), (a, i), (b, j))
        for a, b in itertools.combinations(range(n_cameras), 2)
        for i, j in itertools.product(range(n_detections), repeat=2)
    ]
    for near, one, other in sorted(pair for pair in pairs if pair[0] < RAYS):
        first, second = groups[one], groups[other]
        if first is second or first.keys() & second.keys():
            continue
        between = [float(distance[a, i, b, j]) for a, i in first.items() for b, j in second.items()]
        if max(near, sum(between) / len(between)) < RAYS:
            joined = first | second
            groups |= dict.fromkeys(joined.items(), joined)
    unlike = {id(group): group for group in groups.values() if len(group) > 1}
    return list(unlike.values())


def _triangulated(
    rig: CameraRig,
    keypoints: Float[Tensor, "C D J 2"],
    confidence: Float[Tensor, "C D J"],
    groups: list[dict[int, int]],
) -> Float[Tensor, "G J 3"]:
    """Return the joints of groups, of those that have enough."""
    points = torch.full((len(groups), len(rig), *keypoints.shape[2:]), torch.nan).to(keypoints)
    trust = torch.zeros(points.shape[:-1]).to(confidence)
    for g, group in enumerate(groups):
        for c, d in group.items():
            points[g, c], trust[g, c] = keypoints[c, d], confidence[c, d]
    joints = (
        triangulate_subsets(rig, points, trust).points if groups else points.new_zeros(0, 15, 3)
    )
    return joints[joints.isfinite().all(-1).sum(-1) >= _LEAST_JOINTS]


def join_frames(bodies: list[Float[Tensor, "G J 3"]], fps: float) -> list[Found]:
    """Return tracks of ten frames or more, each body joined to the person who was nearest when last seen.

    Args:
        bodies: of each frame, in any order. fps: frames per second.
    """
    tracks: list[dict[int, Tensor]] = []
    for t, found in enumerate(bodies):
        alive = [track for track in tracks if t - max(track) <= _GONE * fps]
        last = [_last_known(track) for track in alive]
        owner = _nearest(found, torch.stack(last) if last else found[:0])
        for body, k in zip(found, owner.tolist(), strict=True):
            if k < 0:
                tracks.append({t: body})
            else:
                alive[k][t] = body
    return [_as_found(track) for track in tracks if len(track) >= _SHORTEST]


def _last_known(track: dict[int, Tensor]) -> Float[Tensor, "J 3"]:
    """Return the joints of the last frame."""
    return track[max(track)]


def _nearest(found: Float[Tensor, "G J 3"], last: Float[Tensor, "K J 3"]) -> Int[Tensor, " G"]:
    """Return the track of each body, -1 if none is near, of the smallest sum of distances."""
    away = (found[:, None] - last).norm(dim=-1).nanmean(-1).nan_to_num(_FAR)
    near = torch.where(away < REACH, away, _FAR)
    owner = torch.full((len(found),), -1)
    for g, k in zip(*linear_sum_assignment(near.numpy()), strict=True):
        if float(near[g, k]) < REACH:
            owner[g] = int(k)
    return owner


def _as_found(track: dict[int, Tensor]) -> Found:
    first, last = min(track), max(track)
    nothing = torch.full_like(track[first], torch.nan)
    return Found(first, torch.stack([track.get(t, nothing) for t in range(first, last + 1)]))
