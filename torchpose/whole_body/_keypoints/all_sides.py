"""Say if left and right are exchanged in all cameras: no person then stands so, and knees bend forwards."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.wording import counted
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_start import start

_FRAMES = 8  # at most, in which a body begins by each reading
_AT_A_TIME = 4  # frames: this bounds the memory, and half of all may be enough
_LEAST_JOINTS = 10  # that two cameras see, of a frame that tells
_LEAST_GAIN = 20.0  # log-evidence of exchanged sides, of all frames together


def notes_on_all_sides(filter: BodyKalmanFilter, frames: KeypointFrame) -> tuple[str, ...]:
    """Return a note if bodies of exchanged sides are far likelier in frames that are far apart.

    Args:
        filter: of two cameras or more. frames: keypoints [T, C, J].
    """
    told = frames.some((frames.there.sum(1) >= 2).sum(-1) >= _LEAST_JOINTS, _FRAMES)
    gains = torch.zeros(0)
    for part in zip(*(value.split(_AT_A_TIME) for value in told), strict=True):
        gains = torch.cat([gains, _gains(filter, KeypointFrame(*part)).cpu()])
        if 2 * int((gains <= 0).sum()) >= len(told.inlier):  # the median is not above 0
            return ()
    if float(gains.sum()) < _LEAST_GAIN:
        return ()
    return (
        "left and right seem to be exchanged in all cameras: with the other sides bodies are likelier "
        f"(log-evidence {float(gains.sum()):.0f} more, in {counted(len(gains), 'frame')}), so people may "
        "look backwards; check the names of the keypoints, and whether all videos are mirrored",
    )


def _gains(filter: BodyKalmanFilter, frames: KeypointFrame) -> Float[Tensor, " N"]:
    """Return by how much log-evidence grows if sides are exchanged, of bodies that begin in each frame."""
    other = frames.map(lambda value: value.index_select(2, filter.exchange.mirror))
    return start(filter, other).log_evidence - start(filter, frames).log_evidence
