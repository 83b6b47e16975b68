"""Find turned cameras where there are several persons: one belief about the cameras, shared by all.

The person of whom cameras have most keypoints is the witness. What is believed of the cameras is told by the
witness as by a single person (`faulty_cameras`), and holds for all detections before anybody gets them.
Turns that are found with the witness hold if they also explain the others, who all begin anew with them. A
camera that sees nothing of the witness is not left out: nobody gets its detections anyway.
"""

from typing import NamedTuple

from torch import Tensor

from torchpose.whole_body._keypoints.body_kalman import CorrectedBody
from torchpose.whole_body._keypoints.faulty_cameras import (
    LEAST_CAMERAS,
    CameraFaults,
    corrected,
    find_faults,
    looked_at_again,
    paused,
    watched,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses, KeypointStream
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.nested import mapped, taken


class Tracked(NamedTuple):
    """Holds P persons of a frame: their streams, their poses, and what their correction gave."""

    bodies: KeypointStream
    poses: KeypointPoses
    corrected: CorrectedBody


def righted(
    tracker: KeypointTracker, frame: KeypointFrame, faults: CameraFaults | None
) -> KeypointFrame:
    """Return keypoints [N, C, J] as right cameras would see them, by what is believed for all."""
    if faults is None:
        return frame
    every = mapped(lambda value: value.expand(len(frame.inlier), *value.shape[1:]), faults)
    return corrected(frame, every, tracker.filter.maps)


def with_watched_cameras(
    tracker: KeypointTracker,
    faults: CameraFaults | None,
    tracked: Tracked,
    frame: KeypointFrame,
) -> tuple[CameraFaults | None, Tracked]:
    """Return what is believed of cameras after a frame, and the persons, begun anew where that changed.

    Args:
        tracker: of single persons. faults: what was believed, of one element; None where nothing was yet.
        tracked: the persons. frame: their keypoints [P, C, J], as they were detected.
    """
    if frame.inlier.shape[1] < LEAST_CAMERAS:
        return faults, tracked
    witness = (frame.inlier > 0).sum((-2, -1)).argmax()[None]
    given = frame.take(witness)
    faults = CameraFaults.none(given) if faults is None else faults
    faults = looked_at_again(tracker.filter, faults, given)
    bodies, poses, found = taken(tracked, witness)
    fresh = poses.started & (faults.looks.n_frames == 0)
    right = righted(tracker, given, faults)
    several = bodies.begun & (bodies.alone < 0)
    faults, due = watched(tracker.filter, faults, found, right, several, fresh)
    if bool(due):
        faults, tracked = _explained(tracker, faults, tracked, frame, witness)
    turn = faults.turn.expand_as(tracked.poses.turn)
    return faults, tracked._replace(poses=tracked.poses._replace(turn=turn))


def _explained(
    tracker: KeypointTracker,
    faults: CameraFaults,
    tracked: Tracked,
    frame: KeypointFrame,
    witness: Tensor,
) -> tuple[CameraFaults, Tracked]:
    """Return other faults, and all persons begun anew, if that explains what cameras see."""
    new, _, better = find_faults(tracker.filter, frame.take(witness), faults, turns_alone=True)
    if not bool(better):
        return new, tracked
    before, after = (
        Tracked(*tracker.advance(None, righted(tracker, frame, one), watch=False))
        for one in (faults, new)
    )
    sure = before.bodies.begun & after.bodies.begun
    gain = (after.corrected.log_evidence - before.corrected.log_evidence).masked_fill(~sure, 0.0)
    if float(gain.sum() - gain[witness]) < 0:
        return paused(tracker.filter, faults), tracked
    rows = sure.nonzero().squeeze(-1)
    tracked = mapped(lambda old, begun: old.index_copy(0, rows, begun[rows]), tracked, after)
    return new, tracked
