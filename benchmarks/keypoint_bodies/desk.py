"""People behind a desk or a counter: two cameras see COCO's joints above the hips.

The recordings of the tables and persons 9 to 12 of Berkeley MHAD who sit, 60 frames of each, with a
detector's faults. Beside the filter stand the mean pose of the recordings for choosing, laid at the tracked
shoulders along the true upward direction, and the first tracked pose, held.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import (
    CHOOSING,
    SCORED,
    Clip,
    begun,
    detect,
    draw_ring,
    pair_of,
    read_clips,
)
from benchmarks.keypoint_bodies.methods import OURS, Method
from benchmarks.keypoint_bodies.scoring import Estimate
from benchmarks.keypoint_bodies.sitting import CHOOSING_SITTERS, SCORED_SITTERS, read_sitters
from torchpose.body import BODY_15
from torchpose.evaluation import Report
from torchpose.metrics import coverage
from torchpose.whole_body._keypoints.upright import axes_of

__all__ = ["add_desk_table", "desk_clips"]

_CAMERAS, _FRAMES, _QUICK_FRAMES = 2, 60, 16
_SITTING = "people who sit"
_NECK = BODY_15.joint("neck")
_SHOULDERS, _HIPS, _KNEES, _ANKLES = map(pair_of, ("shoulder", "hip", "knee", "ankle"))
_LEGS = [*_KNEES, *_ANKLES]
_HIDDEN = [BODY_15.joint("pelvis"), *_HIPS, *_LEGS]
_COLUMNS = ("hips", "legs", "hips 90 %", "legs 90 %")
_NOTE = (
    "Errors of hips, and of knees and ankles, in the room, mm; then shares of true joints in the ellipsoids, "
    "%. 'mean pose' is that of recorded persons, laid at the shoulders that 'kalman' tracks; 'still' is its "
    "first pose, held."
)


def add_desk_table(report: Report, methods: Mapping[str, Method], data: Path, quick: bool) -> None:
    """Add the table of people of whom nobody sees the hips.

    Args:
        report: gets the table. methods: by name, those of `OURS`. data: folder with the sets.
        quick: one clip of each set and few frames, to see that it works.
    """
    choosing = desk_clips(data, quick, choosing=True)
    mean = torch.cat([_laid_out(clip) for clips in choosing.values() for clip in clips]).nanmean(0)
    table = report.table("desk", "Two cameras, hips and legs hidden (mm)", [*_COLUMNS],
                         digits=(1, 1, 0, 0), note=_NOTE)  # fmt: skip
    scores: dict[str, dict[str, list[list[float]]]] = {}
    for folder, clips in tqdm(desk_clips(data, quick).items(), desc="people behind a desk"):
        for clip in clips:
            for name, found in _found(methods, clip, mean).items():
                scores.setdefault(name, {}).setdefault(folder, []).append(_measures(found, clip))
    for name, by_set in scores.items():
        for folder, rows in by_set.items():
            table.add(f"{name}, {folder}", torch.tensor(rows).nanmean(0).tolist())
        every = [row for rows in by_set.values() for row in rows]
        table.add(f"{name}, all", torch.tensor(every).nanmean(0).tolist())


def desk_clips(data: Path, quick: bool = False, choosing: bool = False) -> dict[str, list[Clip]]:
    """Return clips of people of whom the joints above the hips are seen, by set.

    Args:
        data: folder with the sets. quick: one of each set, with few frames.
        choosing: whether they are those on which constants are chosen.
    """
    frames = _QUICK_FRAMES if quick else _FRAMES
    names: Mapping[str, Sequence[str]] = CHOOSING if choosing else SCORED
    if quick:
        names = {folder: chosen[:1] for folder, chosen in names.items()}
    clips = {
        folder: [begun(clip, frames) for clip in group]
        for folder, group in read_clips(data, names).items()
    }
    sitters = read_sitters(data, CHOOSING_SITTERS if choosing else SCORED_SITTERS, frames, quick)
    clips[_SITTING] = []
    for one in sitters:
        generator = generator_of(one.name, 0)
        rig = draw_ring(one.joints, one.up, generator)
        seen = detect(rig(one.joints).pixels, generator)
        clips[_SITTING].append(Clip(one.name, one.fps, one.joints, one.up, rig, seen))
    return {
        folder: [_hidden(clip.of_cameras(_CAMERAS)) for clip in group]
        for folder, group in clips.items()
    }


def _hidden(clip: Clip) -> Clip:
    """Return a clip without hips and legs, whose neck is the middle of the shoulders."""
    keypoints, confidence = clip.seen.keypoints.clone(), clip.seen.confidence.clone()
    keypoints[..., _NECK, :] = keypoints[..., _SHOULDERS, :].mean(-2)
    there = keypoints[..., _NECK, :].isfinite().all(-1)
    confidence[..., _NECK] = torch.where(there, confidence[..., _SHOULDERS].mean(-1), 0.0)
    seen = clip.seen._replace(keypoints=keypoints, confidence=confidence)
    return clip._replace(seen=seen).without(_HIDDEN)


def _found(
    methods: Mapping[str, Method], clip: Clip, mean: Float[Tensor, "15 3"]
) -> dict[str, Estimate]:
    """Return what methods find, and what the mean pose and the first pose of the filter give."""
    found = {name: method(*clip.given) for name, method in methods.items()}
    if OURS[0] in found:
        joints = found[OURS[0]].joints
        middle, axes = _axes(joints, clip.up)
        found["mean pose"] = Estimate(middle + mean @ axes)
        found["still"] = Estimate(joints[:1].expand_as(joints))
    return found


def _laid_out(clip: Clip) -> Float[Tensor, "T 15 3"]:
    """Return true joints from the middle of the shoulders, to the left, up and ahead."""
    middle, axes = _axes(clip.joints, clip.up)
    return (clip.joints - middle) @ axes.mT


def _axes(
    joints: Float[Tensor, "T 15 3"], up: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "T 1 3"], Float[Tensor, "T 3 3"]]:
    """Return the middle of the shoulders, and the directions to their left, up and ahead."""
    return joints[:, _SHOULDERS].mean(1, keepdim=True), axes_of(joints, up)


def _measures(estimate: Estimate, clip: Clip) -> list[float]:
    """Return errors of hips and of legs, and the shares of each in their ellipsoids."""
    errors = 1000 * (estimate.joints - clip.joints).norm(dim=-1)
    means = [float(errors[:, chosen].nanmean()) for chosen in (_HIPS, _LEGS)]
    if estimate.covariance is None:
        return [*means, math.nan, math.nan]
    given = estimate.joints, estimate.covariance, clip.joints
    shares = [
        100 * float(coverage(*(value[:, chosen] for value in given)).overall[1])
        for chosen in (_HIPS, _LEGS)
    ]
    return [*means, *shares]
