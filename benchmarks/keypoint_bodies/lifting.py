"""Fit the network that lifts keypoints of one camera, which comes with torchpose.

It sees every recording of the persons of `clips.TRAINING` in each camera of several rings that are turned
against each other, so from all sides, with a detector's faults. Of every piece that is drawn, the camera is
turned by a random rotation. In some, legs or arms are not seen at all: people stand behind tables and at the
border of the image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks._lifters import draw_pieces, train_lifter
from benchmarks.keypoint_bodies.clips import TRAINING, WALKS, Clip, recorded, see
from torchpose.body import BODY_15
from torchpose.math import euler_to_matrix
from torchpose.whole_body._keypoints.keypoint_body_tracker import INLIER
from torchpose.whole_body._keypoints.lifting_network import (
    LiftingNetwork,
    LiftingNetworkInfo,
    lifting_features,
)

__all__ = ["fit_shipped"]

_STEPS, _QUICK_STEPS = 8_000, 2
_SEQUENCES, _FRAMES = 32, 48
_RINGS, _LONGEST = 4, 600  # of every recording; frames
_QUARTER = 90.0  # degrees from a camera of a ring to the next
_UNIT = 0.3  # metres in which errors count
_TURNS = (4.0, 8.0, 6.0)  # degrees: standard deviations of roll, pitch and yaw of the camera
_HIDDEN = (("knee", "ankle"), ("hip", "knee", "ankle"), ("elbow", "wrist"), ("wrist",))
_SHARE_HIDDEN = 0.25
_PELVIS = BODY_15.joint("pelvis")


class _Recording(NamedTuple):
    """A recording in one camera: rays [T, 15, 2], confidence [T, 15], joints [T, 15, 3], frame rate."""

    rays: Tensor
    confidence: Tensor
    joints: Tensor
    fps: float


def fit_shipped(data: Path, quick: bool = False) -> LiftingNetwork:
    """Return the network that comes with torchpose.

    Args:
        data: folder with the sets. quick: few recordings and steps, to see that it works.
    """
    patterns = {WALKS: TRAINING[WALKS][:1]} if quick else TRAINING
    info = LiftingNetworkInfo(
        name="whole-body",
        recordings=tuple(f"{folder}/{p}" for folder, chosen in patterns.items() for p in chosen),
        licence="MIT; see the card for the recordings",
        command="python -m benchmarks.keypoint_bodies --data DIR --fit FILE.safetensors",
    )
    return _fitted(data, patterns, info, _QUICK_STEPS if quick else _STEPS)


def _fitted(
    data: Path,
    patterns: Mapping[str, Sequence[str]],
    info: LiftingNetworkInfo,
    steps: int,
    seed: int = 0,
) -> LiftingNetwork:
    """Return a network that was fitted to recordings.

    Args:
        data: folder with the sets. patterns: of the recordings, by set. info: facts about the fit.
        steps: of AdamW, 32 pieces of 48 frames each. seed: of weights and pieces.
    """
    torch.manual_seed(seed)
    pool = _pool(data, patterns)
    network = LiftingNetwork(replace(info, legs=_legs(pool)))
    generator = torch.Generator().manual_seed(seed)

    def loss() -> Tensor:
        seen, joints = _drawn(pool, generator)
        lifted, _ = network(seen)
        off = (lifted.joints - joints.nan_to_num()).square().sum(-1) / _UNIT**2
        std = lifted.std / _UNIT
        spread = 3 * std.log() + 0.5 * off.detach() / std.square()
        known = joints.isfinite().all(-1)
        return (off + 1e-6).sqrt()[known].mean() + spread[known].mean()

    train_lifter(network, loss, steps, "lifting network")
    return network.requires_grad_(False)


def _pool(data: Path, patterns: Mapping[str, Sequence[str]]) -> list[_Recording]:
    """Return the recordings in every camera of several rings."""
    pool = []
    for folder, chosen in patterns.items():
        for clip in recorded(data / folder, chosen, _LONGEST):
            for ring in range(_RINGS):
                pool += _views(see(clip, 1 + ring, turn=_QUARTER * ring / _RINGS))
    return pool


def _views(clip: Clip) -> list[_Recording]:
    """Return a recording in each of its cameras."""
    rig, seen = clip.rig, clip.seen
    apart = clip.joints - clip.joints[:, [_PELVIS]]
    views = []
    for matrix, rotation, pixels, sure in zip(
        rig.matrix, rig.rotation, seen.keypoints.unbind(1), seen.confidence.unbind(1), strict=True
    ):
        there = pixels.isfinite().all(-1) & (sure > 0)
        rays = ((pixels - matrix[:2, 2]) / matrix.diagonal()[:2]).nan_to_num()
        trust = torch.where(there, sure.clamp(*INLIER), 0.0)
        joints = apart @ rotation.mT
        views.append(_Recording(rays.float(), trust.float(), joints.float(), clip.fps))
    return views


def _legs(pool: Sequence[_Recording]) -> float:
    """Return the mean length of thigh and shank over recordings, metres."""
    hip, knee, ankle = (
        [BODY_15.joint(f"{side}_{name}") for side in ("left", "right")]
        for name in ("hip", "knee", "ankle")
    )
    lengths = [
        (x.joints[:, knee] - x.joints[:, hip]).norm(dim=-1)
        + (x.joints[:, ankle] - x.joints[:, knee]).norm(dim=-1)
        for x in pool
    ]
    return float(torch.stack([length.nanmean() for length in lengths]).nanmean())


def _drawn(
    pool: Sequence[_Recording], generator: torch.Generator
) -> tuple[Float[Tensor, "N T F"], Float[Tensor, "N T 15 3"]]:
    """Return features and joints, metres from the pelvis, of random pieces in turned cameras."""
    lengths = [len(one.rays) for one in pool]
    weights = torch.tensor(lengths, dtype=torch.float32)
    seen, joints = [], []
    for i, rows in draw_pieces(weights, lengths, _FRAMES, _SEQUENCES, generator):
        one = pool[i]
        turn = _camera_turn(generator)
        ahead = torch.cat([one.rays[rows], torch.ones_like(one.rays[rows][..., :1])], -1) @ turn.mT
        sure = one.confidence[rows] * _shown(generator) * (ahead[..., 2] > 0.1)
        rays = ahead[..., :2] / ahead[..., 2:].clamp_min(0.1)
        seen.append(lifting_features(rays, sure, one.fps))
        joints.append(one.joints[rows] @ turn.mT)
    return torch.stack(seen), torch.stack(joints)


def _camera_turn(generator: torch.Generator) -> Float[Tensor, "3 3"]:
    """Return a random rotation of the camera."""
    angles = torch.randn(3, generator=generator) * torch.tensor(_TURNS) * (math.pi / 180)
    return euler_to_matrix(angles)


def _shown(generator: torch.Generator) -> Float[Tensor, " 15"]:
    """Return 0 for joints that are not seen at all in a piece, and 1 for the others."""
    shown = torch.ones(len(BODY_15.names))
    if float(torch.rand(1, generator=generator)) < _SHARE_HIDDEN:
        kinds = _HIDDEN[int(torch.randint(len(_HIDDEN), (1,), generator=generator))]
        shown[[i for i, name in enumerate(BODY_15.names) if name.endswith(kinds)]] = 0.0
    return shown
