"""Recorded walkers who pass each other, as a detector of several persons sees them in a ring of cameras.

Each walker is turned and moved so that all are within half a metre of each other in the middle of the clip.
Faults of keypoints are those of `benchmarks.keypoint_bodies.clips`. On top of them, a person of whose box in
an image half is covered by that of a nearer one is not detected, and there are detections of nobody. The
order of the detections of a camera is drawn anew in every frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import (
    FAULTS,
    HEIGHT,
    WALKS,
    WIDTH,
    Faults,
    detect,
    draw_ring,
    recorded,
)
from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.io._mocap import MocapClip
from torchpose.math._rotations import rotvec_to_matrix

CHOOSING = (
    ("s02_02_01_walk", "s07_07_01_walk"), ("s05_05_01_walk", "s08_08_01_walk"),
    ("s06_06_01_walk", "s39_39_01_walk", "s02_02_01_walk"),
)  # fmt: skip
"""Walkers who pass each other, on whom constants are chosen."""

SCORED = (
    ("s10_10_04_walk", "s16_16_15_walk"), ("s32_32_01_walk", "s35_35_02_walk"),
    ("s38_38_01_walk", "s43_43_01_walk"), ("s55_55_04_walk", "s16_16_31_walk"),
    ("s10_10_04_walk", "s32_32_02_walk", "s38_38_01_walk"),
    ("s16_16_15_walk", "s35_35_28_walk", "s43_43_01_walk"),
)  # fmt: skip
"""Walkers who are scored."""

QUARTET = ("s10_10_04_walk", "s32_32_01_walk", "s38_38_01_walk", "s43_43_01_walk")
"""Walkers with whom the time is measured."""

FRAMES = 120
HIDDEN = 0.5  # share of a person's box that a nearer one's covers, from which on it is not detected
NOBODY = 0.03  # share of the frames of a camera with a detection of nobody
_APART = 0.45  # metres between neighbours where they pass
_PELVIS = BODY_15.joint("pelvis")


class People(NamedTuple):
    """Walkers as cameras see them.

    Attributes:
        name: of the recordings. fps: frames per second. joints: [T, P, 15, 3], metres. rig: cameras.
        keypoints: [T, C, D, 15, 2], pixels, NaN where there is none. confidence: [T, C, D, 15].
        place: [T, C, P], which detection is a person's, -1 where it is not detected.
    """

    name: str
    fps: float
    joints: Tensor
    rig: CameraRig
    keypoints: Tensor
    confidence: Tensor
    place: Tensor

    def of_cameras(self, count: int) -> People:
        """Return the same in the first cameras of the ring."""
        return self._replace(
            rig=self.rig.select(range(count)), keypoints=self.keypoints[:, :count],
            confidence=self.confidence[:, :count], place=self.place[:, :count],
        )  # fmt: skip

    def of_person(self, person: int) -> tuple[Tensor, Tensor]:
        """Return the keypoints [T, C, 15, 2] and confidences [T, C, 15] of one person."""
        there = self.place[..., person] >= 0
        index = self.place[..., person].clamp_min(0)[..., None, None]
        confidence = self.confidence.gather(2, index.expand(*index.shape[:3], 15))[:, :, 0]
        index = index[..., None].expand(*index.shape[:3], 15, 2)
        keypoints = self.keypoints.gather(2, index)[:, :, 0]
        return (
            keypoints.masked_fill(~there[..., None, None], math.nan),
            confidence.masked_fill(~there[..., None], 0.0),
        )


def meet(data: Path, names: Sequence[str], seed: int, frames: int = FRAMES) -> People:
    """Return walkers who pass each other, as cameras see them.

    Args:
        data: folder with the sets. names: the recordings. seed: of cameras and faults. frames: at most.
    """
    clips = [next(recorded(data / WALKS, [name], frames)) for name in names]
    return let_pass(clips, seed)


def let_pass(clips: Sequence[MocapClip], seed: int = 0, faults: Faults = FAULTS) -> People:
    """Return recorded walkers, moved so that they pass each other, as cameras see them."""
    names = [clip.trial for clip in clips]
    count = min(len(clip) for clip in clips)
    up = clips[0].up.double()
    generator = generator_of(*names, seed)
    joints = torch.stack(
        [
            _placed(clip.joints.double()[:count], up, i, len(clips), _APART)
            for i, clip in enumerate(clips)
        ],
        1,
    )
    rig = draw_ring(joints.flatten(0, 1), up, generator)
    return see_people("+".join(names), clips[0].fps, joints, rig, generator, faults)


def see_people(
    name: str, fps: float, joints: Float[Tensor, "T P 15 3"], rig: CameraRig,
    generator: torch.Generator, faults: Faults = FAULTS,
) -> People:  # fmt: skip
    """Return what a detector makes of persons."""
    n_persons = joints.shape[1]
    pixels = torch.stack(
        [rig(joints[:, p]).pixels for p in range(n_persons)], 2
    )  # [T, C, P, 15, 2]
    seen = [detect(pixels[:, :, p], generator, faults) for p in range(n_persons)]
    keypoints = torch.stack([one.keypoints for one in seen], 2)
    confidence = torch.stack([one.confidence for one in seen], 2)
    hidden = (
        _hidden(joints, pixels, rig) if faults.missing else torch.zeros_like(pixels[..., 0, 0]) > 0
    )
    keypoints = keypoints.masked_fill(hidden[..., None, None], math.nan)
    confidence = confidence.masked_fill(hidden[..., None], 0.0)
    nobody, trust = _nobody(pixels[:, :, 0], generator, NOBODY if faults.outliers else 0.0)
    keypoints = torch.cat([keypoints, nobody[:, :, None]], 2)
    confidence = torch.cat([confidence, trust[:, :, None]], 2)
    order = torch.rand(confidence.shape[:3], generator=generator).argsort(-1)
    index = order[..., None].expand_as(confidence)
    place = order.argsort(-1)[..., :n_persons]
    gone = ~(confidence[:, :, :n_persons] > 0).any(-1)
    return People(
        name, fps, joints, rig,
        keypoints.gather(2, index[..., None].expand_as(keypoints)), confidence.gather(2, index),
        place.masked_fill(gone, -1),
    )  # fmt: skip


def _placed(
    joints: Float[Tensor, "T 15 3"], up: Float[Tensor, "3"], i: int, count: int, apart: float
) -> Float[Tensor, "T 15 3"]:
    """Return walker i of some, turned by its share of a circle, near the origin in the middle of the clip."""
    path = joints[:, _PELVIS]
    middle = path[len(path) // 2]
    ahead = path[-1] - path[0]
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=-1)
    first = torch.nn.functional.normalize(torch.roll(up, 1) - (torch.roll(up, 1) @ up) * up, dim=-1)
    second = torch.linalg.cross(up, first)
    now = torch.atan2(ahead @ second, ahead @ first)
    turn = rotvec_to_matrix(up * (2 * math.pi * i / count - now))
    aside = 2 * math.pi * i / count + math.pi / 2
    radius = apart / (2 * math.sin(math.pi / count))
    shift = radius * (math.cos(aside) * first + math.sin(aside) * second)
    foot = middle - (middle @ up) * up
    return (joints - foot) @ turn.T + shift


def _hidden(
    joints: Float[Tensor, "T P 15 3"], pixels: Float[Tensor, "T C P 15 2"], rig: CameraRig
) -> Bool[Tensor, "T C P"]:
    """Return who is not detected, since the box of somebody nearer covers the own one by half."""
    low, high = pixels.amin(3), pixels.amax(3)
    inner = torch.minimum(high[:, :, :, None], high[:, :, None]) - torch.maximum(
        low[:, :, :, None], low[:, :, None]
    )
    covered = inner.clamp_min(0).prod(-1) / (high - low).prod(-1)[..., None]
    centre = joints[:, :, _PELVIS]
    depth = (centre @ rig.rotation[:, 2].T + rig.translation[:, 2]).mT  # [T, C, P]
    nearer = depth[:, :, None] < depth[..., None]
    return ((covered > HIDDEN) & nearer).any(-1)


def _nobody(
    pixels: Float[Tensor, "T C 15 2"], generator: torch.Generator, share: float
) -> tuple[Tensor, Tensor]:
    """Return detections of nobody: a person's keypoints anywhere in the image, in some frames."""
    drawn = torch.rand(*pixels.shape[:2], 3, generator=generator, dtype=pixels.dtype)
    place = drawn[..., :2] * torch.tensor([WIDTH, HEIGHT]).to(pixels)
    there = drawn[..., 2] < share
    moved = pixels - pixels.mean(2, keepdim=True) + place[:, :, None]
    confidence = torch.full_like(pixels[..., 0], 0.5) * there[..., None]
    return moved.masked_fill(~there[..., None, None], math.nan), confidence
