"""Clips of a body in cameras that are late, turned and shifted against what is said of them."""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import Clip
from torchpose.camera import CameraRig
from torchpose.math._rotations import rotvec_to_matrix

FRAMES, EDGE = 80, 4
DELAYS = (0, 4, -2, 2)
"""Frames by which cameras begin too early."""

DEGREES, METRES = 1.0, 0.02


class Disturbed(NamedTuple):
    """A clip whose cameras are not as they are said to be.

    Attributes:
        joints: [T, 15, 3], when the first camera sees them. fps: frames per second. rig: the cameras.
        said: the cameras as they are said to be. keypoints, confidence: [T, C, 15, ...].
        delays: [C], frames by which cameras began too early.
    """

    joints: Tensor
    fps: float
    rig: CameraRig
    said: CameraRig
    keypoints: Tensor
    confidence: Tensor
    delays: Tensor


def disturb(clip: Clip, late: bool, turned: bool) -> Disturbed:
    """Return a clip with delays, and with cameras that are turned by 1 degree and shifted by 2 cm, but one.

    Args:
        clip: of the cameras. late: whether there are delays. turned: whether poses are wrong.
    """
    count = len(clip.rig)
    delays = torch.tensor(DELAYS[:count] if late else [0] * count)
    n = min(FRAMES, len(clip.joints) - 2 * EDGE)
    rows = torch.arange(EDGE, EDGE + n)[:, None] - delays
    cameras = torch.arange(count)
    generator = generator_of(clip.name, "cameras")
    drawn = torch.randn(count, 2, 3, generator=generator, dtype=torch.float64)
    drawn = drawn / drawn.norm(dim=-1, keepdim=True)
    drawn[int(torch.randint(count, (), generator=generator))] = 0
    drawn = drawn * torch.tensor([[math.radians(DEGREES)], [METRES]]) * turned
    turn = rotvec_to_matrix(drawn[:, 0])
    translation = (turn @ clip.rig.translation[..., None]).squeeze(-1) + drawn[:, 1]
    return Disturbed(
        clip.joints[EDGE : EDGE + n], clip.fps, clip.rig,
        with_poses(clip.rig, turn @ clip.rig.rotation, translation),
        clip.seen.keypoints[rows, cameras], clip.seen.confidence[rows, cameras], delays,
    )  # fmt: skip


def with_poses(rig: CameraRig, rotation: Tensor, translation: Tensor) -> CameraRig:
    """Return a rig with other poses."""
    other = copy.deepcopy(rig)
    other.rotation.copy_(rotation)
    other.translation.copy_(translation)
    return other


def in_step(values: Tensor, delays: Tensor) -> Tensor:
    """Return values [T, C, ...] of frame t + delay, and the first or last ones beyond."""
    rows = torch.arange(len(values))[:, None] + delays.round().long()
    return values[rows.clamp(0, len(values) - 1), torch.arange(len(delays))]
