"""Recorded bodies with toes as cameras see them: keypoints of fifteen joints and of both big toes.

Bodies, cameras and the keypoints of the fifteen joints are those of `benchmarks.keypoint_bodies`, number for
number. Those of the toes have the same faults, drawn beside them; where legs are exchanged, toes are as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies import clips as bodies
from benchmarks.keypoint_bodies.clips import FAULTS, Clip, Faults, bursts, displaced, recorded
from benchmarks.keypoint_feet.fit import toes_of
from torchpose.body import BODY_15
from torchpose.io._mocap import MocapClip

__all__ = ["TOES", "ToedClip", "begun", "read_toed"]

TOES = ("left_big_toe", "right_big_toe")
_LEGS = [j for j, name in enumerate(BODY_15.names) if name.endswith(("hip", "knee", "ankle"))]


class ToedClip(NamedTuple):
    """A recorded body with toes as cameras see it.

    Attributes:
        body: the fifteen joints. toes: [T, 2, 3], of the left and the right foot, metres.
        keypoints: [T, C, 2, 2], of the toes. confidence: [T, C, 2], 0 where missing.
        clean: [T, C, 2], which are neither missing nor outliers.
    """

    body: Clip
    toes: Tensor
    keypoints: Tensor
    confidence: Tensor
    clean: Tensor

    def of_cameras(self, count: int) -> ToedClip:
        """Return the clip in the first cameras of its ring."""
        seen = (value[:, :count] for value in (self.keypoints, self.confidence, self.clean))
        return ToedClip(self.body.of_cameras(count), self.toes, *seen)


def read_toed(
    data: Path, names: Mapping[str, Sequence[str]], seed: int = 0, faults: Faults = FAULTS
) -> dict[str, list[ToedClip]]:
    """Return clips by set.

    Args:
        data: folder with the sets. names: recordings by set. seed: of cameras and faults.
        faults: of the detector.
    """
    return {
        folder: [_seen(clip, seed, faults) for clip in recorded(data / folder, chosen)]
        for folder, chosen in names.items()
    }


def begun(clip: ToedClip, frames: int) -> ToedClip:
    """Return the first frames of a clip."""
    return ToedClip(bodies.begun(clip.body, frames), *(value[:frames] for value in clip[1:]))


def _seen(clip: MocapClip, seed: int, faults: Faults) -> ToedClip:
    """Return a recording in the ring of cameras that its name and the seed draw."""
    body, toes = bodies.see(clip, seed, faults), toes_of(clip)
    pixels = body.rig(toes).pixels
    generator = generator_of(clip.trial, seed, "toes")
    exchanged = body.seen.exchanged[:, :, _LEGS].any(-1)
    noise = torch.randn(pixels.shape, generator=generator, dtype=pixels.dtype)
    found = pixels + faults.noise * noise
    found = torch.where(exchanged[..., None, None], found.flip(-2), found)
    shape = found.shape[:-1]
    outlier = torch.rand(shape, generator=generator) < faults.outliers
    found = torch.where(outlier[..., None], _wild(pixels, generator, faults), found)
    missing = bursts(shape, faults.missing, faults.missing_frames, generator)
    sure, unsure = (
        mean + std * torch.randn(shape, generator=generator)
        for mean, std in (faults.sure, faults.unsure)
    )
    confidence = torch.where(outlier, unsure, sure).clamp(0.05, 1.0).masked_fill(missing, 0.0)
    found = found.masked_fill(missing[..., None], math.nan)
    return ToedClip(body, toes, found, confidence.to(found), ~(missing | outlier))


def _wild(
    pixels: Float[Tensor, "T C 2 2"], generator: torch.Generator, faults: Faults
) -> Float[Tensor, "T C 2 2"]:
    """Return outliers: half of them anywhere within a foot's way about both, half off by a distance."""
    drawn = torch.rand(*pixels.shape[:-1], 5, generator=generator, dtype=pixels.dtype)
    low, high = pixels.amin(2, keepdim=True) - 300, pixels.amax(2, keepdim=True) + 300
    anywhere = low + (high - low) * drawn[..., :2]
    return displaced(pixels, anywhere, drawn[..., 2:], faults)
