"""Say if left and right are exchanged in all cameras: no person then stands so, and knees bend forwards."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_start import start

_FRAMES = 8  # at most, in which a body begins by each reading
_AT_A_TIME = 3  # of these, which bounds the memory
_LEAST_JOINTS = 10  # that two cameras see, of a frame that tells
_LEAST_GAIN = 20.0  # log-evidence of exchanged sides, of all frames together


def notes_on_all_sides(filter: BodyKalmanFilter, frames: KeypointFrame) -> tuple[str, ...]:
    """Return a note if bodies of exchanged sides are far likelier in frames that are far apart.

    Args:
        filter: of two cameras or more. frames: keypoints [T, C, J].
    """
    gains = evidence_of_exchanged(filter, frames)
    if float(gains.sum()) < _LEAST_GAIN or float(gains.median()) <= 0:
        return ()
    return (
        "left and right seem to be exchanged in all cameras: with the other sides bodies are likelier "
        f"(log-evidence {float(gains.sum()):.0f} more, in {len(gains)} frames), so people may look "
        "backwards; check the names of the keypoints, and whether all videos are mirrored",
    )


def evidence_of_exchanged(filter: BodyKalmanFilter, frames: KeypointFrame) -> Float[Tensor, " N"]:
    """Return by how much log-evidence grows if sides are exchanged, of bodies that begin in some frames."""
    told = ((frames.inlier > 0).sum(1) >= 2).sum(-1) >= _LEAST_JOINTS
    rows = told.nonzero().squeeze(-1)
    rows = rows[:: max(1, -(-len(rows) // _FRAMES))]
    some = frames.take(rows)
    other = some.map(lambda value: value.index_select(2, filter.exchange.mirror))
    return _evidence(filter, other) - _evidence(filter, some)


def _evidence(filter: BodyKalmanFilter, frames: KeypointFrame) -> Float[Tensor, " N"]:
    """Return the log-evidence of bodies that begin in each of the frames."""
    parts = zip(*(value.split(_AT_A_TIME) for value in frames), strict=True)
    return torch.cat([start(filter, KeypointFrame(*part)).log_evidence for part in parts])
