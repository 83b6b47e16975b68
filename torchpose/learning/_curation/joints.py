"""Read and change the eight joints of a recording, and find the frames in which they jump."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.io._recordings import Recording
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import upper_body_indices


def label(recording: Recording) -> str:
    """Return the file of a recording, for messages."""
    return str(recording.path) if recording.path is not None else "a recording without a file"


def measured(joints: Float[Tensor, "... J 3"]) -> Bool[Tensor, "... J"]:
    """Return which joints were measured."""
    return torch.isfinite(joints).all(-1)


def runs(there: Bool[Tensor, " T"], least: int) -> list[slice]:
    """Return the runs of at least `least` consecutive true frames."""
    edge = there.new_zeros(1)
    steps = torch.cat([edge, there, edge]).long().diff()
    starts, ends = (torch.nonzero(steps == sign).flatten().tolist() for sign in (1, -1))
    return [slice(a, b) for a, b in zip(starts, ends, strict=True) if b - a >= least]


def with_upper_joints(recording: Recording, joints: Float[Tensor, "T 8 3"]) -> Recording:
    """Return the recording with its eight joints replaced; joints that it lacks are ignored.

    Raises:
        ShapeError: another number of frames or joints.
    """
    check_shape("joints", joints, [len(recording), len(UPPER_BODY), 3])
    rows, columns = _columns(recording)
    changed = recording.joints.clone()
    changed[:, columns] = joints[:, rows].to(changed.dtype)
    return replace(recording, joints=changed, weights=_weights(recording, changed))


def with_missing(recording: Recording, missing: Bool[Tensor, "T 8"]) -> Recording:
    """Return the recording with some of its eight joints set to NaN and weight zero."""
    check_shape("missing", missing, [len(recording), len(UPPER_BODY)])
    if not bool(missing.any()):
        return recording
    joints = recording.upper_body().joints
    return with_upper_joints(recording, torch.where(missing[..., None], torch.nan, joints))


def _columns(recording: Recording) -> tuple[list[int], list[int]]:
    indices = upper_body_indices(recording.names).indices
    rows = [row for row, column in enumerate(indices) if column >= 0]
    return rows, [indices[row] for row in rows]


def _weights(recording: Recording, joints: Tensor) -> Tensor | None:
    if recording.weights is None:
        return None
    return torch.where(measured(joints), recording.weights, 0.0)


JUMP_SPEEDS = (15.0, 10.0, 6.0, 6.0, 6.0, 6.0, 10.0, 15.0)
"""Bounds in m/s for the joints of `UPPER_BODY`. The fastest hand of optical mocap (Berkeley MHAD:
punching, throwing, clapping) moves at 6.5 m/s, its elbows at 5.1, its shoulders at 3.4."""

SPIKE_SPEED = 4.0
"""Bound in m/s for going and coming back at once, of any joint."""

_SHORTEST_SPIKE = 0.1  # metres: less is noise, at whatever frame rate
_SPIKE_TIME, _AWAY_TIME = 0.1, 1 / 6  # seconds that a joint may be away
_AWAY = 0.5  # of the distance of a jump: how far from its surroundings a joint is that has jumped


def find_jumps(
    joints: Float[Tensor, "T J 3"], fps: float, speeds: tuple[float, ...] = JUMP_SPEEDS
) -> Bool[Tensor, "T J"]:
    """Find frames in which a joint is elsewhere than in the frames just before and after.

    1. Spikes: up to 0.1 s between two steps that are both faster than `SPIKE_SPEED` (and longer than
       10 cm) and that lead back to within half of the shorter one. No arm turns round so quickly.
    2. Jumps: a step between measured frames s < t with |x_t - x_s| > v (t - s) / fps. Between two
       of them, up to 1/6 s that lies farther than v / (2 fps) from the median of its surroundings
       is wrong.
    3. Where such a step remains, the joint is not back and nobody can tell which side is right: the
       frames before and after it are wrong.

    Args:
        joints: metres; NaN where missing.
        fps: frames per second.
        speeds: v of each joint, m/s.

    Returns:
        True for joints to leave out.

    Raises:
        InputError: a speed or rate that is not positive. ShapeError: another number of speeds.
    """
    check_shape("joints", joints, [None, len(speeds), 3])
    if not (fps > 0 and min(speeds) > 0):
        raise InputError(f"fps and speeds must be positive, got {fps} and {min(speeds)}")
    wrong = _spikes(
        joints, max(SPIKE_SPEED / fps, _SHORTEST_SPIKE), max(1, round(_SPIKE_TIME * fps))
    )
    joints = torch.where(wrong[..., None], torch.nan, joints)
    reach = joints.new_tensor(speeds) / fps
    fast, _ = _fast_steps(joints, reach)
    if not bool(fast.any()):
        return wrong
    jumps = _between_jumps(joints, fast, reach, max(1, round(_AWAY_TIME * fps)))
    left, previous = _fast_steps(torch.where(jumps[..., None], torch.nan, joints), reach)
    time, joint = torch.nonzero(left, as_tuple=True)
    jumps[time, joint] = True
    jumps[previous[time, joint], joint] = True
    return wrong | jumps


def _spikes(joints: Tensor, reach: float, longest: int) -> Tensor:
    """Find frames [T, J] between two long steps that lead back to where the first began."""
    wrong = torch.zeros(joints.shape[:2], dtype=torch.bool)
    step = (joints[1:] - joints[:-1]).norm(dim=-1)
    for length in range(1, min(longest, len(joints) - 2) + 1):
        out, home = step[: len(step) - length], step[length:]
        shorter = torch.minimum(out, home)
        back = (joints[length + 1 :] - joints[: -length - 1]).norm(dim=-1)
        found = (shorter > reach) & (back < _AWAY * shorter)
        for later in range(length):
            wrong[1 + later : 1 + later + len(found)] |= found
    return wrong


def _between_jumps(joints: Tensor, fast: Tensor, reach: Tensor, longest: int) -> Tensor:
    """Find frames [T, J] of short pieces between jumps that are far from their surroundings."""
    n_joints = joints.shape[1]
    # number the pieces of all joints together, to count their frames
    piece = fast.long().cumsum(0) + len(joints) * torch.arange(n_joints)
    frames = torch.bincount(piece.flatten(), minlength=len(joints) * (n_joints + 1))[piece]
    away = (joints - _running_median(joints, longest)).norm(dim=-1) > _AWAY * reach
    return (frames <= longest) & fast.any(0) & away & measured(joints)


def _fast_steps(joints: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Find measured joints [T, J] that were reached too fast, and the frames they came from."""
    there = measured(joints)
    frame = torch.arange(len(joints))[:, None]
    last = torch.where(there, frame, -1).cummax(0).values
    previous = torch.cat([last.new_full((1, last.shape[1]), -1), last[:-1]])
    start = joints.gather(0, previous.clamp_min(0)[..., None].expand_as(joints))
    too_far = (joints - start).norm(dim=-1) > reach * (frame - previous)
    return too_far & there & (previous >= 0), previous


def _running_median(joints: Tensor, reach: int) -> Tensor:
    """Return the median of each coordinate over `reach` frames to both sides, without missing ones."""
    border = joints.new_full((reach, *joints.shape[1:]), torch.nan)
    windows = torch.cat([border, joints, border]).unfold(0, 2 * reach + 1, 1)
    return windows.nanmedian(-1).values
