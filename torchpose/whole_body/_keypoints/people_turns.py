"""Find by how much cameras are turned where several persons are there, and nobody knows yet who is who.

Detections of turned cameras do not agree by the usual noise. By a noise that is wider, those of one person
still belong together rather than those of two. Turns that explain all such groups at once, with the joints of
all persons side by side, make cameras agree better, so detections are grouped anew by less noise, and turns
are found anew, down to the usual noise. The turns hold if all keypoints of the frame, those of nobody
included, are likelier by them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.faulty_cameras import LEAST_CAMERAS
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_start import FEW_HEADINGS, start
from torchpose.whole_body._keypoints.people_association import (
    group_detections,
    owned_detections,
    taken_detections,
)
from torchpose.whole_body._keypoints.turn_looks import likely_turns, side_by_side
from torchpose.whole_body._keypoints.turned_cameras import turned, unlikely

_WIDTHS = (25.0, 25.0, 25.0, 9.0, 9.0, 1.0)  # factors of the noise's variance, to group by


class CrowdTurns(NamedTuple):
    """Holds turns that explain the detections of a frame, [H, C, 3, 3], the likeliest explanation `best`.

    Attributes:
        turn: by each of the explanations of `free_turns`. best: the likeliest of them.
        gain: of the log-evidence, against cameras as they were believed to be.
        persons: keypoints [G, C, J] of the persons who tell the turns, as they were detected.
    """

    turn: Tensor
    best: int
    gain: float
    persons: KeypointFrame


def turns_of_all(
    filter: BodyKalmanFilter, frame: KeypointFrame, turn: Float[Tensor, "C 3 3"]
) -> CrowdTurns | None:
    """Return by how much cameras are turned, by all detections of a frame; None where they do not tell.

    Two cameras do not tell which is wrong, and turns of both make one person of any two. So somebody has to
    be seen by three.

    Args:
        filter: that tracks. frame: [D, C, J], as they were detected. turn: of cameras, as believed so far.
    """
    maps, known = filter.maps, turn
    before: Tensor | None = None
    for width in _WIDTHS:
        groups = _groups(filter, turned(frame, turn, maps), width)
        if not len(groups):
            return None
        if before is not None and torch.equal(groups, before):
            continue
        before = groups
        persons = taken_detections(frame, groups)
        found, cost = likely_turns(side_by_side(persons.map(lambda value: value[None])), maps)
        best = int(cost.argmin())
        turn = found.matrix[best]
    if not bool(((groups >= 0).sum(-1) >= LEAST_CAMERAS).any()):
        return None
    gain = _evidence(filter, frame, turn) - float(found.price[best])
    gain -= _evidence(filter, frame, known) - float(unlikely(known))
    return CrowdTurns(found.matrix, best, gain, persons)


def _groups(filter: BodyKalmanFilter, frame: KeypointFrame, width: float) -> Int[Tensor, "G C"]:
    """Return the detections of persons by a noise whose variance is larger by a factor."""
    wide = frame._replace(variance=width * frame.variance, relative=width * frame.relative)
    return group_detections(filter.maps, wide, frame.there.any(-1).mT)


def _evidence(
    filter: BodyKalmanFilter, frame: KeypointFrame, turn: Float[Tensor, "C 3 3"]
) -> float:
    """Return the log density of all keypoints of a frame in cameras that are turned."""
    right = turned(frame, turn, filter.maps)
    groups = _groups(filter, right, 1.0)
    nobodys = ~owned_detections(groups, len(frame.inlier)).mT[..., None] & frame.there
    evidence = -float((nobodys * filter.maps.log_area[:, None]).sum())
    if len(groups):
        found = start(filter, taken_detections(right, groups), FEW_HEADINGS)
        evidence += float(found.log_evidence.sum())
    return evidence
