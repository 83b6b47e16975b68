"""Track the feet of bodies that are tracked: frame by frame, or whole sequences, filtered or smoothed."""

import torch
from jaxtyping import Bool
from torch import Tensor

from torchpose.math._gaussian import safe_cholesky, symmetrise
from torchpose.whole_body._keypoints.foot_filter import (
    FootFilter,
    FootGaussian,
    FootPoses,
    exchanged_legs,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses
from torchpose.whole_body._keypoints.nested import PART, FrameCollector, by_parts, frame_at, mapped
from torchpose.whole_body._keypoints.turned_cameras import is_turned, turned


def step_feet(
    filter: FootFilter,
    before: FootGaussian | None,
    maps: RigMaps,
    poses: KeypointPoses,
    frame: KeypointFrame,
    fresh: Bool[Tensor, " B"] | None = None,
) -> tuple[FootGaussian, FootPoses]:
    """Track the feet of one more frame.

    Args:
        filter: of feet. before: of the frame before, None before the first. maps: of the cameras.
        poses: of the bodies [B]. frame: keypoints [B, C, 6].
        fresh: of whom nothing is known from the frame before; by default those whose tracking begins.
    """
    legs = filter.legs(poses)
    beliefs = exchanged_legs(poses.exchanged, poses.scale)
    fresh = poses.started if fresh is None else fresh
    seen = _as_bodies_saw(frame, poses, maps)
    return filter.advance(before, legs, seen, maps, beliefs, fresh)


def _as_bodies_saw(frame: KeypointFrame, poses: KeypointPoses, maps: RigMaps) -> KeypointFrame:
    """Return keypoints of feet in the cameras that see the body, turned back as those of the body were."""
    wrong = poses.off | ~(poses.inlier > 0.5).any(-1)
    frame = frame._replace(inlier=frame.inlier.masked_fill(wrong[..., None], 0.0))
    back = is_turned(poses.turn)
    if not bool(back.any()):
        return frame
    pixels = turned(frame, poses.turn, maps).pixels
    return frame._replace(pixels=torch.where(back[..., None, None], pixels, frame.pixels))


def track_feet(
    filter: FootFilter, maps: RigMaps, poses: KeypointPoses, frames: KeypointFrame, smoothing: bool
) -> FootPoses:
    """Return the feet of whole sequences.

    Args:
        filter: of feet. maps: of the cameras. poses: of the bodies [B, T], smoothed where feet are to be.
        frames: keypoints [B, T, C, 6]. smoothing: whether later frames count too.
    """
    every = by_parts(filter.legs, poses)
    beliefs = exchanged_legs(poses.exchanged, poses.scale)
    frames = _as_bodies_saw(frames, poses, maps)
    state: FootGaussian | None = None
    n_frames = poses.started.shape[1]
    found = FrameCollector(n_frames)
    for t in range(n_frames):
        legs, frame, believed = frame_at((every, frames, beliefs), t)
        state, feet = filter.advance(state, legs, frame, maps, believed, poses.started[:, t])
        found.add((state, feet) if smoothing else feet)
    if not smoothing:
        filtered: FootPoses = found.sequence
        return filtered
    states, filtered = found.sequence
    smoothed = smooth_feet(filter, states, poses.started)
    return by_parts(filter.poses, smoothed, every, filtered.inlier)


def smooth_feet(
    filter: FootFilter, states: FootGaussian, started: Bool[Tensor, "B T"]
) -> FootGaussian:
    """Smooth Gaussians [B, T] of whole sequences in their place, after Rauch, Tung and Striebel.

    m_t|T = m_t + C (m_t+1|T - m_t+1|t),   P_t|T = P_t + C (P_t+1|T - P_t+1|t) C^T,   C = P_t F^T P_t+1|t^-1.

    Args:
        filter: that filtered. states: posteriors of T frames, which are written over.
        started: frames in which tracking began anew, which say nothing of the frames before.
    """
    model = filter.motion
    mean, cov, centre = states
    for end in range(mean.shape[1] - 1, 0, -PART):
        begin = max(0, end - PART)
        rows, later = slice(begin, end), slice(begin + 1, end + 1)
        carried = model.matrix @ cov[:, rows]
        predicted = carried @ model.matrix.mT + model.noise
        gains = torch.cholesky_solve(carried, safe_cholesky(predicted)).mT
        gains = gains * ~started[:, later, None, None, None]
        ahead = filter.carried(mean[:, rows], centre[:, rows], centre[:, later])
        for t in range(end - 1, begin - 1, -1):
            C = gains[:, t - begin]
            off = mean[:, t + 1] - ahead[:, t - begin]
            mean[:, t] += (C @ off[..., None]).squeeze(-1)
            change = C @ (cov[:, t + 1] - predicted[:, t - begin]) @ C.mT
            cov[:, t] += symmetrise(change)
    return states


def continued(
    before: FootGaussian | None, numbers: Tensor | None, now: Tensor
) -> tuple[FootGaussian | None, Bool[Tensor, " P"]]:
    """Return the feet of persons of the frame before in the order of those of a frame, and who is new.

    Args:
        before: of the persons with these numbers. numbers: unlike all others. now: numbers of a frame.
    """
    if before is None or numbers is None or not len(numbers):
        return None, torch.ones_like(now, dtype=torch.bool)
    same = now[:, None] == numbers
    rows = same.int().argmax(1)
    return mapped(lambda value: value[rows], before), ~same.any(1)
