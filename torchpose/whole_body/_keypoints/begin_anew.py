"""Tell when tracking of a person may begin, and who is lost, so that it begins anew."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, Weighed

LEAST_JOINTS = 6  # that are measured where tracking begins
_PATIENCE = 0.5  # seconds that a start waits for a second camera, which tells the distance
_LOST = 0.3  # share of keypoints below which the person is somewhere else
_LOST_TIME = 0.5  # seconds of that after which tracking begins anew
_AWAY = 0.5  # share of a lost frame that one without anybody counts: a second until a new start


def sees_enough(frame: KeypointFrame) -> Bool[Tensor, "B C"]:
    """Return which cameras see enough joints of a person to tell by themselves where it is."""
    return frame.there.sum(-1) >= LEAST_JOINTS


def sees_most(frame: KeypointFrame) -> Int[Tensor, " B"]:
    """Return the camera that sees the most joints, the first of several."""
    return frame.there.sum(-1).argmax(-1)


def may_begin(frame: KeypointFrame, waited: Float[Tensor, " B"], fps: float) -> Bool[Tensor, " B"]:
    """Return whether tracking may begin: two cameras see the same joints, or one for long.

    Args:
        frame: the keypoints. waited: frames for which a second camera has been waited for.
        fps: frames per second.
    """
    there = frame.there
    n_needed = min(2, there.shape[-2])
    enough = (there.sum(-2) >= n_needed).sum(-1) >= LEAST_JOINTS
    return enough | ((waited > _PATIENCE * fps) & sees_enough(frame).any(-1))


def first_frames(frames: KeypointFrame, fps: float) -> Int[Tensor, " B"]:
    """Return the frames in which tracking begins, T where it never does.

    Args:
        frames: [B, T, C, J, ...]. fps: frames per second.
    """
    count = len(frames.pixels)
    there = frames.there.flatten(2).any(-1)
    waited = there.cumsum(-1) - there.long()
    every = frames.map(lambda value: value.flatten(0, 1))
    enough = may_begin(every, waited.flatten().to(every.inlier), fps).view(count, -1)
    never = torch.ones_like(enough[:, :1])
    return torch.cat([enough, never], -1).int().argmax(-1)


def are_lost(lost: Float[Tensor, " B"], fps: float) -> Bool[Tensor, " B"]:
    """Return whether so many frames in a row (`frames_lost`) are too many."""
    return lost > _LOST_TIME * fps


def frames_lost(
    lost: Float[Tensor, " B"], begun: Bool[Tensor, " B"], frame: KeypointFrame, weighed: Weighed
) -> Float[Tensor, " B"]:
    """Return for how many frames in a row keypoints have been of something else, or of the other side.

    A camera that seems to exchange sides counts half: detectors do so for moments, and where it goes on,
    it is the body that has them the wrong way round. Frames without any keypoint count half, too: a
    prediction over more than a second is too wide to be corrected.

    Args:
        lost: up to the frame before. begun: who is tracked; others wait. frame: the keypoints.
        weighed: what the filter took of them.
    """
    expected = frame.inlier.sum((-2, -1))
    found = weighed.inlier.sum((-2, -1))
    turned = (weighed.exchanged > 0.5).any(-1).any(-1)
    grown = lost + torch.where(found < _LOST * expected, 1.0, 0.5)
    astray = (found < _LOST * expected) | turned
    after = torch.where(astray, grown, 0.0)
    after = torch.where(begun, after, lost + 1.0)
    return torch.where(expected > 0.0, after, lost + _AWAY * begun.to(after))
