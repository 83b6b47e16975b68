"""Find turned cameras where there are several persons: one belief about the cameras, shared by all.

A camera may be turned if the person of whom cameras have most keypoints says so as a single person would
(`faulty_cameras`), if detections belong to nobody while persons have none in that camera, and where somebody
begins. Then turns are looked for that explain all detections of the
frame (`people_turns`). They hold for all detections before anybody gets them, and are estimated again from
later frames by the keypoints of several persons. No camera is left out: nobody gets its detections anyway.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchpose._core.rows import joined
from torchpose.whole_body._keypoints.begin_anew import sees_enough
from torchpose.whole_body._keypoints.body_kalman import CorrectedBody
from torchpose.whole_body._keypoints.faulty_cameras import (
    LEAST_CAMERAS,
    LEAST_GAIN,
    CameraFaults,
    any_wrong,
    corrected,
    looked_at_again,
    paused,
    watched,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.nested import mapped, taken
from torchpose.whole_body._keypoints.people_association import owned_detections
from torchpose.whole_body._keypoints.people_turns import turns_of_all
from torchpose.whole_body._keypoints.turn_looks import TurnLooks, side_by_side
from torchpose.whole_body._keypoints.turned_cameras import is_turned

_UNTOLD = 0.5  # seconds until the next search, where a frame does not tell turns
_WITNESSES = 3  # persons whose keypoints tell turns after the first frame


def righted(
    tracker: KeypointTracker, frame: KeypointFrame, faults: CameraFaults | None
) -> KeypointFrame:
    """Return keypoints [N, C, J] as right cameras would see them, by what is believed for all."""
    if faults is None:
        return frame
    every = mapped(lambda value: value.expand(len(frame.inlier), *value.shape[1:]), faults)
    return corrected(frame, every, tracker.filter.maps)


def watched_cameras(
    tracker: KeypointTracker,
    faults: CameraFaults | None,
    tracked: tuple[KeypointStream, KeypointPoses, CorrectedBody],
    frame: KeypointFrame,
    strays: Bool[Tensor, " C"],
) -> tuple[CameraFaults, bool]:
    """Return what is believed of cameras after a frame, and whether turns are to be looked for.

    Args:
        tracker: of single persons. faults: what was believed, of one element; None where nothing was yet.
        tracked: P persons. frame: their keypoints [P, C, J], as they were detected.
        strays: of `strays_of`.
    """
    beside = _of_witnesses(frame)
    faults = CameraFaults.none(beside) if faults is None else faults
    if frame.inlier.shape[1] < LEAST_CAMERAS:
        return faults, False
    faults = looked_at_again(tracker.filter, faults, beside)
    started = tracked[1].started.any() & (faults.looks.n_frames == 0)
    astray = started | strays.any()
    witness = frame.there.sum((-2, -1)).argmax()[None]
    bodies, _, found = taken(tracked, witness)
    several = bodies.begun & (bodies.alone < 0)
    right = righted(tracker, frame.take(witness), faults)
    faults, due = watched(tracker.filter, faults, found, right, several, started, astray)
    return faults, bool(due)


def explained(
    tracker: KeypointTracker, faults: CameraFaults, frame: KeypointFrame
) -> tuple[CameraFaults, bool]:
    """Return turns of cameras that explain detections [D, C, J] of a frame, and whether they are new."""
    found = turns_of_all(tracker.filter, frame, faults.turn[0])
    if found is None:
        return paused(tracker.filter, faults, _UNTOLD), False
    if found.gain <= 0:
        return paused(tracker.filter, faults), False
    turn = found.turn[found.best][None]
    looks = TurnLooks.begun(_of_witnesses(found.persons), found.turn[None])
    looks = looks._replace(n_frames=is_turned(turn).any(-1).to(looks.n_frames))
    faults = faults._replace(looks=looks, doubted=torch.zeros_like(faults.doubted))
    if found.gain <= LEAST_GAIN:
        return faults, False
    return faults._replace(turn=turn, wrong=any_wrong(faults.off, turn)), True


def strays_of(frame: KeypointFrame, chosen: Int[Tensor, "P C"]) -> Bool[Tensor, " C"]:
    """Return which cameras have a detection that is nobody's, and none of somebody who is there.

    Args:
        frame: [D, C, J]; of a detection so many joints count with which a person could begin.
        chosen: the persons' detections, -1 if none.
    """
    left = sees_enough(frame).mT & ~owned_detections(chosen, len(frame.inlier))
    return left.any(-1) & (chosen < 0).any(0)


def _of_witnesses(frame: KeypointFrame) -> KeypointFrame:
    """Return the keypoints [1, C, W J] of the W persons who have most, side by side."""
    count = frame.there.sum((-2, -1))
    rows = count.topk(min(_WITNESSES, len(count))).indices.sort().values
    some = frame.take(rows)
    none = frame.map(lambda value: value.new_ones(_WITNESSES - len(rows), *value.shape[1:]))
    none = none._replace(inlier=torch.zeros_like(none.inlier))
    return side_by_side(joined([some, none]).map(lambda value: value[None]))
