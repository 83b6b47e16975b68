"""Notice cameras that are turned, see something else, or whose video stands still, and track without that.

A camera is watched by the share of its keypoints that are those of the body. Where it stays low, bodies begin
anew with the keypoints of that frame under several explanations: cameras are right; one, or all, are turned
(`turned_cameras`); one, or all but two, see nothing of the person. The likeliest one by the evidence of the
filter holds from then on. Two cameras do not tell which is wrong, so there are three at least.
"""

import math
from itertools import combinations
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.whole_body._keypoints.begin_anew import LEAST_JOINTS, sees_enough
from torchpose.whole_body._keypoints.body_kalman import FEW_INLIERS, BodyKalmanFilter, CorrectedBody
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    Beliefs,
    KeypointFrame,
    RigMaps,
    readings_of,
    see,
    squared_errors,
    weigh,
)
from torchpose.whole_body._keypoints.keypoint_start import FEW_HEADINGS, start
from torchpose.whole_body._keypoints.nested import replaced, taken
from torchpose.whole_body._keypoints.turn_looks import TurnLooks, free_turns, looked_again
from torchpose.whole_body._keypoints.turned_cameras import (
    angles_of,
    find_turns,
    is_turned,
    turned,
    unlikely,
)

LEAST_CAMERAS = 3
LEAST_GAIN = 10.0  # log-evidence by which an explanation must be better than right cameras
_PATIENCE = 0.5  # seconds of seeing something else before an explanation is looked for
_PAUSE = 5.0  # seconds until the next search, where none was found
_WIDE = 2.0  # factor of the noise's variance, above which a camera may be wrong
_FARTHEST_TURN = 0.5  # radians, of a camera that is used nevertheless
_RETURN = 0.25  # seconds for which a camera sees the body again before it counts again
_MOST_PAIRS = 6  # cameras, with which all but two may be wrong


class CameraFaults(NamedTuple):
    """Holds what is wrong with C cameras that see B persons.

    Attributes:
        turn: [B, C, 3, 3], rotation in world axes of what a camera sees. off: [B, C], whether it counts not.
        wrong: [B], whether any camera is turned or off.
        doubted: [B], frames in a row in which a camera has seen something else, below 0 after a search.
        back: [B, C], frames in a row in which one that counts not has seen the body.
        pixels, inlier: [B, C, J, 2], [B, C, J], keypoints of the frame before, as they were detected.
        still: [B, C], frames in a row in which keypoints of a camera were those of the frame before.
        looks: frames from which turns are estimated again.
    """

    turn: Tensor
    off: Tensor
    wrong: Tensor
    doubted: Tensor
    back: Tensor
    pixels: Tensor
    inlier: Tensor
    still: Tensor
    looks: TurnLooks

    @classmethod
    def none(cls, frame: KeypointFrame) -> Self:
        """Return right cameras, before a first frame."""
        shape = frame.inlier.shape[:2]
        new = frame.inlier.new_zeros
        no = torch.zeros(shape, dtype=torch.bool, device=frame.inlier.device)
        return cls(
            torch.eye(3).to(frame.pixels).expand(*shape, 3, 3), no, no[:, 0], new(shape[0]),
            new(shape), frame.pixels, torch.zeros_like(frame.inlier), new(shape),
            TurnLooks.none(frame),
        )  # fmt: skip


def corrected(frame: KeypointFrame, faults: CameraFaults, maps: RigMaps) -> KeypointFrame:
    """Return keypoints as cameras would see them that are right, without those of cameras that are off."""
    return _righted(frame, faults.turn, faults.off, maps) if bool(faults.wrong.any()) else frame


def _righted(
    frame: KeypointFrame, turn: Float[Tensor, "B C 3 3"], off: Bool[Tensor, "B C"], maps: RigMaps
) -> KeypointFrame:
    """Return keypoints turned back, without those of cameras that are off."""
    frame = turned(frame, turn, maps)
    return frame._replace(inlier=frame.inlier.masked_fill(off[..., None], 0.0))


def any_wrong(off: Bool[Tensor, "B C"], turn: Float[Tensor, "B C 3 3"]) -> Bool[Tensor, " B"]:
    """Return whose cameras include one that counts not, or is turned."""
    return (off | is_turned(turn)).any(-1)


def noted(faults: CameraFaults, frame: KeypointFrame, used: KeypointFrame) -> CameraFaults:
    """Return the faults with a frame kept for the next one, and of `without_still` what of it is used."""
    there, use = (one.there.any(-1) for one in (frame, used))
    still = torch.where(there & ~use, faults.still + 1.0, 0.0)
    return faults._replace(pixels=frame.pixels, inlier=frame.inlier, still=still)


def without_still(
    frame: KeypointFrame, pixels: Float[Tensor, "B C J 2"], inlier: Float[Tensor, "B C J"]
) -> KeypointFrame:
    """Return keypoints without those of cameras whose image is that of the frame before.

    All keypoints of such a camera are the same to the last digit, while most of another camera's are not.

    Args:
        frame: the keypoints. pixels, inlier: of the frame before.
    """
    moved = (frame.pixels != pixels).any(-1)
    if bool(moved.any(-1).all()):
        return frame
    both = frame.there & (inlier > 0)
    count, n_moved = both.sum(-1), (moved & both).sum(-1)
    most_moved = (2 * n_moved > count) & (count >= LEAST_JOINTS)
    still = ~moved.any(-1) & (count >= LEAST_JOINTS) & most_moved.any(-1, keepdim=True)
    return frame._replace(inlier=frame.inlier.masked_fill(still[..., None], 0.0))


def without_still_frames(frames: KeypointFrame) -> KeypointFrame:
    """Return keypoints [T, C, J] without those of cameras whose image is that of the frame before."""
    later, before = frames.map(lambda value: value[1:]), frames.map(lambda value: value[:-1])
    used = without_still(later, before.pixels, before.inlier)
    return frames._replace(inlier=torch.cat([frames.inlier[:1], used.inlier]))


class _Explanations(NamedTuple):
    """Holds N explanations of what C cameras see of B persons.

    Attributes:
        turn: [B, N, C, 3, 3], of cameras. off: [B, N, C], which count not. price: [B, N], of log-evidence.
        n_turns: how many of them, the first ones, are those of `free_turns`.
    """

    turn: Tensor
    off: Tensor
    price: Tensor
    n_turns: int


def find_faults(
    filter: BodyKalmanFilter,
    frame: KeypointFrame,
    faults: CameraFaults,
    begun: CorrectedBody | None = None,
) -> tuple[CameraFaults, CorrectedBody, Bool[Tensor, " B"]]:
    """Return the likeliest faults of cameras, who begins anew with them, and whether they are new.

    Args:
        filter: that tracks on. frame: keypoints as they were detected. faults: that were known so far.
        begun: who has just begun with these, if all have.
    """
    known = start(filter, corrected(frame, faults, filter.maps)) if begun is None else begun
    least = known.log_evidence - _of_nobody(frame, faults.off, filter.maps) - unlikely(faults.turn)
    tried = _explanations(frame, filter.maps)
    count, n = tried.price.shape
    every = torch.arange(count, device=tried.price.device)
    turn, off = tried.turn.flatten(0, 1), tried.off.flatten(0, 1)
    given = frame.take(every.repeat_interleave(n))
    right = _righted(given, turn, off, filter.maps)
    found = start(filter, right, FEW_HEADINGS)
    evidence = found.log_evidence - _of_nobody(given, off, filter.maps) - tried.price.flatten()
    wrong = any_wrong(off, turn)
    refused = sees_enough(right) & _few_or_wide(found, right) | (angles_of(turn) > _FARTHEST_TURN)
    evidence = torch.where(refused.any(-1) & wrong, -math.inf, evidence).view(-1, n)
    best = every * n + evidence.argmax(-1)
    better = evidence.amax(-1) > least + LEAST_GAIN
    looks = TurnLooks.begun(frame, tried.turn[:, : tried.n_turns])
    looks = looks._replace(n_frames=is_turned(turn[best]).any(-1).to(looks.n_frames))
    new = faults._replace(
        turn=turn[best],
        off=off[best],
        wrong=wrong[best],
        back=torch.zeros_like(faults.back),
        looks=looks,
    )
    rows = better.nonzero().squeeze(-1)
    after = replaced(faults, rows, taken(new, rows))
    after = after._replace(doubted=torch.where(better, 0.0, paused(filter, faults).doubted))
    return after, replaced(known, rows, taken(found, best[rows])), better


def paused(filter: BodyKalmanFilter, faults: CameraFaults, seconds: float = _PAUSE) -> CameraFaults:
    """Return the faults with no further search for some seconds."""
    return faults._replace(doubted=torch.full_like(faults.doubted, -seconds * filter.fps))


def _of_nobody(
    frame: KeypointFrame, off: Bool[Tensor, "B C"], maps: RigMaps
) -> Float[Tensor, " B"]:
    """Return minus the log density of keypoints of cameras that are off, which may be anywhere."""
    of_nobody = frame.there & off[..., None]
    return (of_nobody * maps.log_area[:, None]).sum((-2, -1))


def _explanations(frame: KeypointFrame, maps: RigMaps) -> _Explanations:
    """Return explanations of frames."""
    count, n_cameras = frame.inlier.shape[:2]
    free = free_turns(n_cameras, frame.inlier.device)
    rows = torch.arange(count, device=free.device).repeat_interleave(len(free))
    turns = find_turns(frame.take(rows), free.repeat(count, 1), maps)
    some_off = [one := free[:n_cameras]]
    if 3 < n_cameras <= _MOST_PAIRS:
        pairs = [list(pair) for pair in combinations(range(n_cameras), 2)]
        some_off.append(torch.stack([~one[pair].any(0) for pair in pairs]))
    off = torch.cat([torch.zeros_like(free), *some_off]).expand(count, -1, -1)
    n_off = off.shape[1] - len(free)
    turn, price = (value.unflatten(0, (count, -1)) for value in (turns.matrix, turns.price))
    eye = torch.eye(3).to(turn).expand(count, n_off, n_cameras, 3, 3)
    nothing = price.new_zeros(count, n_off)
    return _Explanations(torch.cat([turn, eye], 1), off, torch.cat([price, nothing], 1), len(free))


def looked_at_again(
    filter: BodyKalmanFilter, faults: CameraFaults, frame: KeypointFrame
) -> CameraFaults:
    """Return the faults with turns estimated again from several frames.

    Args:
        filter: that tracks. faults: that are known. frame: the keypoints.
    """
    if not bool((faults.looks.n_frames > 0.0).any()):
        return faults
    enough = sees_enough(frame).sum(-1) >= LEAST_CAMERAS
    looks, rows, best = looked_again(faults.looks, frame, enough, filter.maps, filter.fps)
    turn = faults.turn.index_copy(0, rows, best)
    wrong = any_wrong(faults.off, turn)
    looks = looks._replace(n_frames=torch.where(wrong, looks.n_frames, 0.0))
    return faults._replace(turn=turn, wrong=wrong, looks=looks)


def watched(
    filter: BodyKalmanFilter,
    faults: CameraFaults,
    found: CorrectedBody,
    frame: KeypointFrame,
    begun: Bool[Tensor, " B"],
    started: Bool[Tensor, " B"],
    astray: Bool[Tensor, " B"] | None = None,
) -> tuple[CameraFaults, Bool[Tensor, " B"]]:
    """Return the faults with a frame counted, and for whom an explanation is to be looked for.

    Args:
        filter: that found. faults: that are known. found: the bodies. frame: their keypoints.
        begun: who is tracked by all cameras. started: with this frame. astray: for whom cameras see somebody
            where nobody is.
    """
    doubtful = _few_or_wide(found, frame)
    also = started if astray is None else started | astray
    if not bool((doubtful | also[:, None] | (faults.doubted != 0.0)[:, None]).any()):
        return faults, also
    enough = sees_enough(frame)
    doubtful = doubtful | (started[:, None] & (_noise(filter, found, frame) > _WIDE))
    doubtful = (doubtful & enough).any(-1) & begun & (enough.sum(-1) >= LEAST_CAMERAS)
    doubtful = doubtful if astray is None else doubtful | astray
    pausing = faults.doubted < 0
    doubted = torch.where(doubtful | pausing, faults.doubted + 1, 0.0)
    due = doubtful & ~pausing & (started | (doubted > _PATIENCE * filter.fps))
    return faults._replace(doubted=doubted), due


def with_returned(
    filter: BodyKalmanFilter, faults: CameraFaults, found: CorrectedBody, frame: KeypointFrame
) -> CameraFaults:
    """Return the faults without cameras that count not and have seen the body again for some time.

    Args:
        filter: that found. faults: that are known. found: the bodies, without these cameras.
        frame: the keypoints of all cameras.
    """
    frame = turned(frame, faults.turn, filter.maps)
    beliefs = Beliefs(found.state.log_odds, torch.ones_like(found.state.scale))
    weighed = weigh(
        readings_of(frame, filter.exchange), see(filter.maps, found.joints), filter.maps, beliefs,
        filter.exchange, found.joint_cov,
    )  # fmt: skip
    sees = sees_enough(frame) & (weighed.inlier.sum(-1) >= FEW_INLIERS * frame.inlier.sum(-1))
    back = torch.where(faults.off & sees, faults.back + 1, 0.0)
    off = faults.off & (back <= _RETURN * filter.fps)
    wrong = any_wrong(off, faults.turn)
    return faults._replace(off=off, back=back, wrong=wrong)


def _few_or_wide(found: CorrectedBody, frame: KeypointFrame) -> Bool[Tensor, "B C"]:
    """Return of which cameras few keypoints are of the body, or by a noise that is wide."""
    few = found.weighed.inlier.sum(-1) < FEW_INLIERS * frame.inlier.sum(-1)
    return few | (found.state.scale > _WIDE)


def _noise(
    filter: BodyKalmanFilter, found: CorrectedBody, frame: KeypointFrame
) -> Float[Tensor, "B C"]:
    """Return the squared errors of the keypoints of bodies over the variance of their noise."""
    readings = readings_of(frame, filter.exchange)
    seen = see(filter.maps, found.joints)
    sums, count = squared_errors(readings, seen, found.weighed, found.joint_cov)
    return sums / count.clamp_min(1.0)
