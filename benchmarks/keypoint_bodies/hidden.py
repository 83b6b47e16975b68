"""Joints that all cameras miss for some frames, beside the simplest guesses about them.

Three recordings of each set, 130 frames of each with 4 px of noise and nothing else wrong. A hand, an arm, a
foot, a leg or the whole body is hidden in all cameras at once for 6, 15 or 30 frames, several times, left and
right in turn. Errors within the gaps stand beside those of the joint's last tracked place, which stays in the
room, or relative to the pelvis, or to the nearest joint that is seen; those of smoothed poses beside straight
lines between the smoothed places at both ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

import torchpose
from benchmarks.keypoint_bodies.clips import NOISE_ALONE, SCORED, Clip, cut, read_clips
from benchmarks.keypoint_bodies.scoring import Estimate, from_the_start
from torchpose.body import BODY_15
from torchpose.evaluation import Report
from torchpose.metrics import coverage

__all__ = ["Gap", "add_hidden_table", "gaps_of", "guesses", "hidden_joints", "lines"]

_KINDS: Mapping[str, Sequence[str]] = {
    "hand": ("wrist",),
    "arm": ("elbow", "wrist"),
    "foot": ("ankle",),
    "leg": ("knee", "ankle"),
    "everything": (),
}
_LENGTHS, _CAMERAS = (6, 15, 30), (4, 2, 1)
_SEEN = {6: 14, 15: 18, 30: 20}  # frames from a gap to the next
_FIRST, _LEFT = 20, 4  # frames before the first gap, and at least after the last one
_FRAMES, _QUICK_FRAMES, _EVERY = 130, 32, 4
_PELVIS = BODY_15.joint("pelvis")
_MIDDLE = (_PELVIS, BODY_15.joint("neck"))
_COLUMNS = ("filtered", "last place", "from the pelvis", "from the joint before", "50 %", "90 %",
            "smoothed", "line", "line from the joint before", "smoothed 50 %", "smoothed 90 %")  # fmt: skip
_DIGITS = (1, 1, 1, 1, 0, 0, 1, 1, 1, 0, 0)
_NOTE = (
    "Errors of hidden joints within gaps, mm, of one camera relative to the pelvis; mean over clips. 'last "
    "place': where the joint was tracked last, held in the room, relative to the pelvis, or to the nearest "
    "joint that is seen. 'line': straight between the smoothed places at both ends, in the room or relative "
    "to that joint. Shares of true joints in the ellipsoids, %. 'seen': all frames and joints, none hidden."
)


class Gap(NamedTuple):
    """Frames [start, stop) in which joints are hidden."""

    start: int
    stop: int
    joints: tuple[int, ...]

    @property
    def frames(self) -> slice:
        """Return the frames as a slice."""
        return slice(self.start, self.stop)


Guesser = Callable[[Tensor, Gap], list[Tensor]]
"""From tracked joints [T, 15, 3] and a gap to places of its joints [N, K, 3], of several guesses."""


def add_hidden_table(report: Report, data: Path, quick: bool) -> None:
    """Add the table of joints that are hidden for some frames.

    Args:
        report: gets the table. data: folder with the sets.
        quick: one clip of each set, and the shortest gaps in two cameras, to see that it works.
    """
    every = 10 if quick else _EVERY
    names = {folder: chosen[::every] for folder, chosen in SCORED.items()}
    clips = [clip for group in read_clips(data, names, faults=NOISE_ALONE).values()
             for clip in group]  # fmt: skip
    table = report.table("hidden", "Joints hidden for some frames (mm)", [*_COLUMNS],
                         digits=_DIGITS, note=_NOTE)  # fmt: skip
    lengths = _LENGTHS[:1] if quick else _LENGTHS
    for cameras in _CAMERAS[1:2] if quick else _CAMERAS:
        rows: dict[str, list[list[float]]] = {}
        for clip in tqdm(clips, desc=f"hidden joints, {cameras} cameras"):
            short = _middle(clip.of_cameras(cameras), _QUICK_FRAMES if quick else _FRAMES)
            for name, values in _scored(short, lengths).items():
                rows.setdefault(name, []).append(values)
        for name, found in rows.items():
            table.add(f"{cameras} cameras, {name}", torch.tensor(found).nanmean(0).tolist())


def hidden_joints(kind: str, side: str) -> tuple[int, ...]:
    """Return the joints of a kind of gap.

    Args:
        kind: a name of the table. side: "left" or "right".
    """
    parts = _KINDS[kind]
    if not parts:
        return tuple(range(len(BODY_15.names)))
    return tuple(BODY_15.joint(f"{side}_{part}") for part in parts)


def gaps_of(kind: str, length: int, n_frames: int) -> list[Gap]:
    """Return the gaps of one length in a clip, left and right in turn.

    Args:
        kind: what is hidden. length: frames. n_frames: of the clip.
    """
    starts = range(_FIRST, n_frames - length - _LEFT + 1, length + _SEEN[length])
    return [
        Gap(start, start + length, hidden_joints(kind, ("left", "right")[i % 2]))
        for i, start in enumerate(starts)
    ]


def guesses(joints: Float[Tensor, "T 15 3"], gap: Gap) -> list[Float[Tensor, "N K 3"]]:
    """Return hidden joints at their last place: in the room, from the pelvis, and from the joint before.

    Args:
        joints: as they were tracked. gap: with the K joints.
    """
    hidden, last = list(gap.joints), gap.start - 1
    found = []
    for base in _bases(joints, gap):
        found.append(base[gap.frames] + joints[last, hidden] - base[last])
    return found


def lines(joints: Float[Tensor, "T 15 3"], gap: Gap) -> list[Float[Tensor, "N K 3"]]:
    """Return hidden joints on straight lines between both ends: in the room, and from the joint before.

    Args:
        joints: as they were smoothed. gap: with the K joints.
    """
    hidden, last = list(gap.joints), gap.start - 1
    share = torch.arange(1, gap.stop - last, dtype=joints.dtype) / (gap.stop - last)
    room, _, before = _bases(joints, gap)
    found = []
    for base in (room, before):
        ends = (joints[t, hidden] - base[t] for t in (last, gap.stop))
        first, second = ends
        found.append(base[gap.frames] + first.lerp(second, share[:, None, None]))
    return found


def _bases(joints: Float[Tensor, "T 15 3"], gap: Gap) -> list[Float[Tensor, "T K 3"]]:
    """Return for each hidden joint the origin, the pelvis, and the nearest joint before it that is seen."""
    room = torch.zeros_like(joints[:, list(gap.joints)])
    if set(_MIDDLE) & set(gap.joints):  # everything is hidden
        return [room, room, room]
    return [
        room,
        joints[:, [_PELVIS]].expand_as(room),
        joints[:, [_seen_before(joint, gap.joints) for joint in gap.joints]],
    ]


def _seen_before(joint: int, hidden: Sequence[int]) -> int:
    """Return the nearest joint towards the pelvis that is not hidden."""
    while joint in hidden:
        joint = BODY_15.parents[joint]
    return joint


def _middle(clip: Clip, frames: int) -> Clip:
    """Return the frames in the middle of a clip."""
    start = max(0, (len(clip.joints) - frames) // 2)
    return cut(clip, slice(start, start + frames))


def _scored(clip: Clip, lengths: Sequence[int]) -> dict[str, list[float]]:
    """Return the columns of the table by what is hidden, of one clip."""
    n_frames = len(clip.joints)
    gaps = {
        f"{kind}, {length} frames": gaps_of(kind, length, n_frames)
        for kind in _KINDS
        for length in lengths
    }
    gaps = {"seen": [], **gaps}
    filtered, smoothed = (_tracked(clip, list(gaps.values()), how) for how in ("none", "full"))
    found = {}
    for i, (name, own) in enumerate(gaps.items()):
        if not own:
            own = [Gap(0, n_frames, tuple(range(len(BODY_15.names))))]
            nothing = [math.nan] * 3
            first, second = (_measured(track[i], clip, own, None) for track in (filtered, smoothed))
            found[name] = [first[0], *nothing, *first[1:], second[0], *nothing[1:], *second[1:]]
            continue
        found[name] = [*_measured(filtered[i], clip, own, guesses),
                       *_measured(smoothed[i], clip, own, lines)]  # fmt: skip
    return found


def _tracked(clip: Clip, gaps: Sequence[Sequence[Gap]], smoothing: str) -> list[Estimate]:
    """Return the poses of a clip with each of several lists of gaps; of one camera from the pelvis."""
    count = len(gaps)
    keypoints = clip.seen.keypoints.expand(count, -1, -1, -1, -1).clone()
    confidence = clip.seen.confidence.expand(count, -1, -1, -1).clone()
    for row, own in enumerate(gaps):
        for gap in own:
            keypoints[row, gap.frames, :, list(gap.joints)] = math.nan
            confidence[row, gap.frames, :, list(gap.joints)] = 0.0
    tracker = torchpose.BodyTracker(clip.rig, method="kalman", fps=clip.fps)
    tracks = tracker(
        keypoints=keypoints, confidence=confidence, names=BODY_15.names, smoothing=smoothing
    )
    found = []
    for track in tracks:
        joints, covariance = track.joints3d, track.covariance3d
        if len(clip.rig) == 1:
            joints = joints - joints[:, [_PELVIS]]
            covariance = track.details["covariance_from_pelvis"]
        found.append(
            Estimate(*(from_the_start(x, track.first_frame) for x in (joints, covariance)))
        )
    return found


def _measured(
    estimate: Estimate, clip: Clip, gaps: Sequence[Gap], others: Guesser | None
) -> list[float]:
    """Return errors within gaps, of an estimate and of other guesses, and shares in ellipsoids."""
    truth = clip.joints
    if len(clip.rig) == 1:
        truth = truth - truth[:, [_PELVIS]]
    errors: list[list[Tensor]] = []
    parts = []
    for gap in gaps:
        wanted = [joint for joint in gap.joints if len(clip.rig) > 1 or joint != _PELVIS]
        own = gap._replace(joints=tuple(wanted))
        true = truth[gap.frames][:, wanted]
        joints, covariance = (value[gap.frames][:, wanted] for value in estimate)
        guessed = [] if others is None else others(estimate.joints, own)
        errors.append([1000 * (x - true).norm(dim=-1).flatten() for x in (joints, *guessed)])
        parts.append([x.flatten(0, 1)[:, None] for x in (joints, covariance, true)])
    means = [float(torch.cat(values).nanmean()) for values in zip(*errors, strict=True)]
    given = [torch.cat(values) for values in zip(*parts, strict=True)]
    return [*means, *(100 * coverage(*given).overall).tolist()]
