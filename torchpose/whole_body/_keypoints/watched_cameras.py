"""Leave out, or turn back, cameras that are found to be wrong while persons are tracked by all of them."""

import torch
from jaxtyping import Int
from torch import Tensor

from torchpose.whole_body._keypoints.faulty_cameras import (
    LEAST_CAMERAS,
    find_faults,
    noted,
    watched,
    with_returned,
)
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_poses import KeypointStep
from torchpose.whole_body._keypoints.nested import replaced, taken
from torchpose.whole_body._keypoints.pose_maker import PoseMaker


def by_right_cameras(
    poses: PoseMaker,
    step: KeypointStep,
    frame: KeypointFrame,
    given: KeypointFrame,
    right: KeypointFrame,
) -> KeypointStep:
    """Return the frame with cameras that are found to be wrong left out, or turned back.

    Args:
        poses: makes those of persons who begin anew. step: the frame by cameras as they were known.
        frame: the keypoints. given: those that are new. right: as cameras would see them that are right.
    """
    stream, pose, found = step
    filter, faults = poses.filter, noted(stream.faults, frame, given)
    rows = None
    if right.inlier.shape[1] >= LEAST_CAMERAS:
        several = stream.begun & (stream.alone < 0)
        fresh = pose.started & (faults.looks.n_frames == 0.0)
        faults, due = watched(filter, faults, found, right, several, fresh)
        if bool(faults.off.any()):
            faults = with_returned(filter, faults, found, given)
        rows = due.nonzero().squeeze(-1)
    step = stream._replace(faults=faults), pose, found
    return step if rows is None or not len(rows) else _explained(poses, step, given, rows)


def _explained(
    poses: PoseMaker, step: KeypointStep, frame: KeypointFrame, rows: Int[Tensor, " N"]
) -> KeypointStep:
    """Return the frame with some persons begun anew, if that explains what cameras see."""
    stream, pose, before = taken(step, rows)
    begun = before if bool(pose.started.all()) else None
    faults, found, better = find_faults(poses.filter, frame.take(rows), stream.faults, begun)
    stream = stream._replace(faults=faults)
    anew = stream._replace(state=found.state, lost=torch.zeros_like(stream.lost))
    explained = anew, poses.posed(anew, found, torch.ones_like(better)), found
    kept = stream, pose, before
    chosen = better.nonzero().squeeze(-1)
    after = replaced(kept, chosen, taken(explained, chosen))
    return replaced(step, rows, after)
