"""Estimate turns of cameras again from several frames, since one frame does not tell them well.

A turn that one frame tells takes up the noise of its keypoints, and a detector's offsets in its pose. So from
the first frame on that says cameras are turned, frames are kept, at growing distances in time. With each new
one all explanations by turns are estimated again from all frames that are kept: one camera is turned, all
are, or none is. The likeliest one holds from then on.

What a detector has wrong of a joint in a camera lasts from frame to frame. Of errors of which a share rho
lasts, n frames tell as much as n / (1 + rho (n - 1)) whose errors are independent, so each counts that much
less. The share is told by the errors themselves: that of the mean over frames in their squares is
rho + (1 - rho) / n. Errors that last may also look like another turn. So as far as they do, turns are the
mean over the explanations, by their probabilities. Where the likeliest one does not explain a camera's
keypoints, its errors say nothing of the detector, and frames count as independent.
"""

from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.math._rotations import matrix_to_rotvec, rotvec_to_matrix
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.nested import mapped, replaced, taken
from torchpose.whole_body._keypoints.turned_cameras import Turns, angles_of, find_turns

_FRAMES = 16  # that are kept
# Log-odds of all cameras turned, which one that is turned by more explains nearly as well.
_RATHER_ALL = 4.0
# What a camera that is turned by much has besides, such as a cropped image, is not to turn the others.
_FAR = 0.1  # radians from which that is so
_MORE = 0.02  # share of what it explains that all have to explain on top
_POOR = 2.0  # misfit of a camera's keypoint on average, from which on its errors are no detector's
_LEAST = 1e-9  # of a sum by which another is divided
_GAP = 0.05  # seconds from the first frame to the second; each next gap is longer by as much


class TurnLooks(NamedTuple):
    """Holds frames that tell by how much C cameras are turned, as each of B persons has them.

    Attributes:
        frames: keypoints [B, K, C, J], those that are not there yet without trust.
        n_frames: [B], how many there are, 0 where no camera is turned. age: [B], frames since the first.
        turn: [B, H, C, 3, 3], by each of the explanations of `free_turns`.
        lasting: [B], share of the errors of keypoints that lasts, 0 where there is one frame.
    """

    frames: KeypointFrame
    n_frames: Tensor
    age: Tensor
    turn: Tensor
    lasting: Tensor

    @classmethod
    def none(cls, frame: KeypointFrame) -> Self:
        """Return that no camera is turned."""
        count, n_cameras = frame.inlier.shape[:2]
        frames = frame.map(
            lambda value: torch.zeros_like(value[:, None]).repeat_interleave(_FRAMES, 1)
        )
        frames = frames._replace(variance=torch.ones_like(frames.variance))
        eye = torch.eye(3).to(frame.pixels)
        turn = eye.expand(count, n_cameras + 2, n_cameras, 3, 3)
        zero = frame.inlier.new_zeros(count)
        return cls(frames, zero, zero, turn, zero)

    @classmethod
    def begun(cls, frame: KeypointFrame, turn: Float[Tensor, "B H C 3 3"]) -> Self:
        """Return looks with a first frame, and the turns that it tells."""
        first = cls.none(frame)
        place = first.n_frames.long()
        frames = mapped(lambda kept, new: _with_frame(kept, new, place), first.frames, frame)
        return first._replace(frames=frames, n_frames=torch.ones_like(first.n_frames), turn=turn)


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
    return replaced(looks, rows, some), rows, best


def _estimated(
    looks: TurnLooks, frame: KeypointFrame, maps: RigMaps
) -> tuple[TurnLooks, Float[Tensor, "B C 3 3"]]:
    """Return looks with one more frame, and the turns by the likeliest explanation of all its frames."""
    place = looks.n_frames.long()
    frames = mapped(lambda kept, new: _with_frame(kept, new, place), looks.frames, frame)
    used = int(place.amax()) + 1
    share = 1 / (1 + looks.lasting * looks.n_frames)
    counted = frames._replace(inlier=frames.inlier * share[:, None, None, None])
    beside = side_by_side(counted.map(lambda value: value[:, :used]))
    found, cost = likely_turns(beside, maps, looks.turn.flatten(0, 1))
    turn = found.matrix.view_as(looks.turn)
    chosen = torch.arange(len(cost), device=place.device) * cost.shape[1] + cost.argmin(-1)
    lasting = _lasting(found.errors[chosen], found.weights[chosen], used)
    poor = (found.misfit[chosen] > _POOR * beside.inlier.sum(-1)).any(-1)
    lasting = lasting.masked_fill(poor, 0.0)
    after = TurnLooks(frames, looks.n_frames + 1, looks.age, turn, lasting)
    return after, _mean_turn(turn, cost, lasting)


def _lasting(
    errors: Float[Tensor, "B C N 2"], weights: Float[Tensor, "B C N"], n_frames: int
) -> Float[Tensor, " B"]:
    """Return the share rho of squared errors that is that of an error which lasts.

    Args:
        errors: over the standard deviations of their noise, those of one frame after the other. weights:
            of these. n_frames: how many there are.
    """
    errors, weights = (value.unflatten(2, (n_frames, -1)) for value in (errors, weights))
    total = (weights * errors.square().sum(-1)).sum((-3, -2, -1))
    summed, weight = (weights[..., None] * errors).sum(2), weights.sum(2).clamp_min(_LEAST)
    of_means = (summed.square().sum(-1) / weight).sum((-2, -1))
    there = weights > 0
    n_each = there.sum((-3, -2, -1)) / there.any(2).sum((-2, -1)).clamp_min(1)
    ratio = of_means / total.clamp_min(_LEAST)
    return ((n_each * ratio - 1) / (n_each - 1).clamp_min(_LEAST)).clamp(0, 1)


def _mean_turn(
    turn: Float[Tensor, "B H C 3 3"], cost: Float[Tensor, "B H"], lasting: Float[Tensor, " B"]
) -> Float[Tensor, "B C 3 3"]:
    """Return the likeliest turns, or as far as errors last the mean of all; none, if none is likeliest."""
    best = cost.argmin(-1)
    sure = torch.nn.functional.one_hot(best, cost.shape[-1]).to(cost)
    share = torch.lerp(sure, (-cost).softmax(-1), lasting[:, None])
    mean = rotvec_to_matrix((share[..., None, None] * matrix_to_rotvec(turn)).sum(1))
    none = best == cost.shape[-1] - 1
    return torch.where(none[:, None, None, None], turn[:, -1], mean)


def side_by_side(frames: KeypointFrame) -> KeypointFrame:
    """Return keypoints [B, K, C, J] of K frames, or persons, as those of one with all joints, [B, C, K J]."""
    return frames.map(lambda value: value.transpose(1, 2).flatten(2, 3))


def likely_turns(
    frame: KeypointFrame, maps: RigMaps, known: Float[Tensor, "N C 3 3"] | None = None
) -> tuple[Turns, Float[Tensor, "B H"]]:
    """Return turns by each of the explanations of `free_turns`, and what these cost with their prior odds.

    Args:
        frame: the keypoints [B, C, J]. maps: the cameras. known: turns that are near; N = B H.
    """
    n, n_cameras = frame.inlier.shape[:2]
    free = free_turns(n_cameras, frame.inlier.device)
    rows = torch.arange(n, device=free.device).repeat_interleave(len(free))
    found = find_turns(frame.take(rows), free.repeat(n, 1), maps, known)
    cost, angles = found.misfit.sum(-1) + found.price, angles_of(found.matrix)
    return found, _with_odds(cost.view(n, -1), angles.view(n, -1, n_cameras))


def _with_odds(cost: Float[Tensor, "B H"], angles: Float[Tensor, "B H C"]) -> Float[Tensor, "B H"]:
    """Return what explanations cost with the prior odds of one camera and of all.

    Args:
        cost: minus the log-evidence of each. angles: of its turns, radians.
    """
    alone, whose = cost[:, :-2].min(-1)
    far = angles.amax(-1).gather(1, whose[:, None]).squeeze(-1) > _FAR
    handicap = torch.where(far, _MORE * (cost[:, -1] - alone), -_RATHER_ALL)
    all_cameras = cost[:, -2] + handicap
    return torch.cat([cost[:, :-2], all_cameras[:, None], cost[:, -1:]], -1)


def _with_frame(kept: Tensor, new: Tensor, place: Tensor) -> Tensor:
    """Return tensors [B, K, ...] with those of a frame [B, ...] at a place of each element."""
    rows = torch.arange(len(kept), device=kept.device)
    return kept.index_put((rows, place), new)
