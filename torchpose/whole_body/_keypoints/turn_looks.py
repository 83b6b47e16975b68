"""Estimate turns of cameras again from several frames, since one frame does not tell them well.

A turn that one frame tells takes up the noise of its keypoints, and a detector's offsets in its pose. So from
the first frame on that says cameras are turned, frames are kept, at growing distances in time. With each new
one all explanations by turns are estimated again from all frames that are kept: one camera is turned, all
are, or none is. The likeliest one holds from then on.
"""

from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.nested import mapped, taken
from torchpose.whole_body._keypoints.turned_cameras import angles_of, find_turns

_FRAMES = 16  # that are kept
# Log-odds of all cameras turned, which one that is turned by more explains nearly as well.
_RATHER_ALL = 4.0
# What a camera that is turned by much has besides, such as a cropped image, is not to turn the others.
_FAR = 0.1  # radians from which that is so
_MORE = 0.02  # share of what it explains that all have to explain on top
_GAP = 0.05  # seconds from the first frame to the second; each next gap is longer by as much


class TurnLooks(NamedTuple):
    """Holds frames that tell by how much C cameras are turned, as each of B persons has them.

    Attributes:
        frames: keypoints [B, K, C, J], those that are not there yet without trust.
        n_frames: [B], how many there are, 0 where no camera is turned. age: [B], frames since the first.
        turn: [B, H, C, 3, 3], by each of the explanations of `free_turns`.
    """

    frames: KeypointFrame
    n_frames: Tensor
    age: Tensor
    turn: Tensor

    @classmethod
    def none(cls, frame: KeypointFrame) -> Self:
        """Return that no camera is turned."""
        count, n_cameras = frame.inlier.shape[:2]
        frames = frame.map(
            lambda value: torch.zeros_like(value[:, None]).repeat_interleave(_FRAMES, 1)
        )
        eye = torch.eye(3).to(frame.pixels)
        turn = eye.expand(count, n_cameras + 2, n_cameras, 3, 3)
        return cls(frames, frame.inlier.new_zeros(count), frame.inlier.new_zeros(count), turn)

    @classmethod
    def begun(cls, frame: KeypointFrame, turn: Float[Tensor, "B H C 3 3"]) -> Self:
        """Return looks with a first frame, and the turns that it tells."""
        first = cls.none(frame)
        place = first.n_frames.long()
        frames = mapped(lambda kept, new: _with_frame(kept, new, place), first.frames, frame)
        return cls(frames, torch.ones_like(first.n_frames), first.age, turn)


def free_turns(n_cameras: int, device: torch.device) -> Bool[Tensor, "H C"]:
    """Return which cameras are turned by each explanation: one after the other, all, none."""
    one = torch.eye(n_cameras, dtype=torch.bool, device=device)
    return torch.cat([one, torch.ones_like(one[:1]), torch.zeros_like(one[:1])])


def looked_again(
    looks: TurnLooks, frame: KeypointFrame, enough: Bool[Tensor, " B"], maps: RigMaps, fps: float
) -> tuple[TurnLooks, Int[Tensor, " N"], Float[Tensor, "N C 3 3"]]:
    """Return looks one frame later, for whom turns were estimated again, and the likeliest turns of these.

    Args:
        looks: of the frame before. frame: the keypoints. enough: whose keypoints tell turns.
        maps: the cameras. fps: frames per second.
    """
    age = looks.age + (looks.n_frames > 0)
    due = age >= _GAP * fps * looks.n_frames * (looks.n_frames + 1) / 2
    due = due & enough & (looks.n_frames > 0) & (looks.n_frames < _FRAMES)
    looks, rows = looks._replace(age=age), due.nonzero().squeeze(-1)
    if not len(rows):
        return looks, rows, looks.turn[rows, 0]
    some, best = _estimated(taken(looks, rows), frame.take(rows), maps)
    return mapped(lambda old, new: old.index_copy(0, rows, new), looks, some), rows, best


def _estimated(
    looks: TurnLooks, frame: KeypointFrame, maps: RigMaps
) -> tuple[TurnLooks, Float[Tensor, "B C 3 3"]]:
    """Return looks with one more frame, and the turns by the likeliest explanation of all its frames."""
    place = looks.n_frames.long()
    frames = mapped(lambda kept, new: _with_frame(kept, new, place), looks.frames, frame)
    used = int(place.amax()) + 1
    n, n_cameras = frame.inlier.shape[:2]
    free = free_turns(n_cameras, frame.inlier.device)
    rows = torch.arange(n, device=place.device)
    side_by_side = frames.map(lambda value: value[:, :used].transpose(1, 2).flatten(2, 3))
    found = find_turns(
        side_by_side.take(rows.repeat_interleave(len(free))), free.repeat(n, 1), maps,
        looks.turn.flatten(0, 1),
    )  # fmt: skip
    turn = found.matrix.view_as(looks.turn)
    best = _likeliest((found.misfit + found.price).view(n, -1), angles_of(turn))
    return TurnLooks(frames, looks.n_frames + 1, looks.age, turn), turn[rows, best]


def _likeliest(cost: Float[Tensor, "B H"], angles: Float[Tensor, "B H C"]) -> Int[Tensor, " B"]:
    """Return the likeliest explanations.

    Args:
        cost: minus the log-evidence of each. angles: of its turns, radians.
    """
    alone, whose = cost[:, :-2].min(-1)
    far = angles.amax(-1).gather(1, whose[:, None]).squeeze(-1) > _FAR
    handicap = torch.where(far, _MORE * (cost[:, -1] - alone), -_RATHER_ALL)
    all_cameras = cost[:, -2] + handicap
    return torch.cat([cost[:, :-2], all_cameras[:, None], cost[:, -1:]], -1).argmin(-1)


def _with_frame(kept: Tensor, new: Tensor, place: Tensor) -> Tensor:
    """Return tensors [B, K, ...] with those of a frame [B, ...] at a place of each element."""
    rows = torch.arange(len(kept), device=kept.device)
    return kept.index_put((rows, place), new)
