"""Cameras that are much wrong, beside triangulation: frozen, turned, mirrored, late, with another's video."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import OTHER, WIDTH, Clip, begun
from benchmarks.keypoint_bodies.methods import track
from benchmarks.keypoint_bodies.peers import standing_still
from benchmarks.keypoint_bodies.triangulation import held, triangulate_subsets
from benchmarks.keypoint_cameras.disturbed import with_poses
from torchpose.camera import CameraRig
from torchpose.evaluation import Report
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.metrics import joint_errors

FRAMES = 80
WRONG = 1
"""The camera that is wrong, where one is."""

Seen = tuple[CameraRig, Tensor, Tensor]
"""Cameras as they are said to be, keypoints [T, C, 15, 2] and confidence [T, C, 15]."""

_NOTE = (
    "Mean and worst error over {} clips of {} frames, mm, axes of the room. 'subsets': triangulation of the "
    "cameras that agree to 15 pixels; where there is no point, the last one stays."
)


def right(clip: Clip) -> Seen:
    """Return a clip as it is."""
    return clip.rig, clip.seen.keypoints.clone(), clip.seen.confidence.clone()


def frozen(clip: Clip) -> Seen:
    """Return a clip in which a camera shows the same image from a quarter of the clip on."""
    rig, keypoints, confidence = right(clip)
    first = len(keypoints) // 4
    for values in (keypoints, confidence):
        values[first:, WRONG] = values[first, WRONG]
    return rig, keypoints, confidence


def turned(clip: Clip, degrees: float, cameras: Sequence[int] | None = None) -> Seen:
    """Return a clip whose cameras, all or some, are turned about any axis against what is said of them.

    Args:
        clip: of right cameras. degrees: of the turns. cameras: that are turned.
    """
    rig, keypoints, confidence = right(clip)
    generator = generator_of(clip.name, "turned")
    axis = torch.randn(len(rig), 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(axis, dim=-1)
    if cameras is not None:
        still = torch.ones(len(rig), dtype=torch.bool)
        still[list(cameras)] = False
        axis[still] = 0
    turn = rotvec_to_matrix(math.radians(degrees) * axis)
    translation = (turn @ rig.translation[..., None]).squeeze(-1)
    return with_poses(rig, turn @ rig.rotation, translation), keypoints, confidence


def mirrored(clip: Clip) -> Seen:
    """Return a clip in which a camera's video is mirrored, and a detector takes left for right."""
    rig, keypoints, confidence = right(clip)
    keypoints[:, WRONG, :, 0] = WIDTH - 1 - keypoints[:, WRONG, :, 0]
    for values in (keypoints, confidence):
        values[:, WRONG] = values[:, WRONG, list(OTHER)]
    return rig, keypoints, confidence


def slower(clip: Clip) -> Seen:
    """Return a clip in which a camera has 30 frames for 25 of the others."""
    rig, keypoints, confidence = right(clip)
    rows = torch.arange(len(keypoints)) * 25 // 30
    for values in (keypoints, confidence):
        values[:, WRONG] = values[rows, WRONG]
    return rig, keypoints, confidence


def exchanged(clip: Clip) -> Seen:
    """Return a clip in which the inputs of the second and third camera are exchanged."""
    rig, keypoints, confidence = right(clip)
    order = [0, 2, 1, *range(3, len(rig))]
    return rig, keypoints[:, order], confidence[:, order]


CASES: Mapping[str, Callable[[Clip], Seen]] = {
    "right cameras": right,
    "one stands still": frozen,
    "one turned by 1 degree": lambda clip: turned(clip, 1.0, [WRONG]),
    "one turned by 3 degrees": lambda clip: turned(clip, 3.0, [WRONG]),
    "one turned by 10 degrees": lambda clip: turned(clip, 10.0, [WRONG]),
    "one turned by 20 degrees": lambda clip: turned(clip, 20.0, [WRONG]),
    "all turned by 1 degree": lambda clip: turned(clip, 1.0),
    "all turned by 3 degrees": lambda clip: turned(clip, 3.0),
    "one mirrored": mirrored,
    "one of another rate": slower,
    "two inputs exchanged": exchanged,
}

Way = Callable[[CameraRig, Tensor, Tensor, float], Tensor]
"""From cameras, keypoints, confidence and frames per second to joints."""

WAYS: Mapping[str, Way] = {
    "kalman": lambda *seen: track(*seen).joints,
    "triangulation": lambda *seen: standing_still(*seen).joints,
    "subsets": lambda *seen: held(triangulate_subsets(*seen[:3]).points),
}


def add_faulty_cameras(report: Report, clips: Sequence[Clip], rigs: Sequence[int]) -> None:
    """Add a table of each number of cameras.

    Args:
        report: to which they are added. clips: of recorded bodies. rigs: numbers of cameras, 3 or more.
    """
    columns = [f"{way}{what}" for way in WAYS for what in ("", ", worst")]
    for count in rigs:
        title = f"One camera is much wrong, {count} cameras"
        note = _NOTE.format(len(clips), FRAMES)
        table = report.table(title, title, columns, digits=(1,) * len(columns), note=note)
        chosen = [begun(clip.of_cameras(count), FRAMES) for clip in clips]
        for name in tqdm(CASES, desc=title):
            seen = [CASES[name](clip) for clip in chosen]
            cells: list[float] = []
            for way in WAYS.values():
                errors = [
                    1000 * float(joint_errors(way(*one, clip.fps), clip.joints).nanmean())
                    for one, clip in zip(seen, chosen, strict=True)
                ]
                cells += [sum(errors) / len(errors), max(errors)]
            table.add(name, cells)
