"""Render silhouettes of recorded joints with another body than the tracker's, and with faults."""

import torch
from jaxtyping import Bool
from torch import Tensor

from benchmarks.bodies.faults import add_faults
from torchpose.camera import CameraRig
from torchpose.demo._rendering.clothed_body import TrueShape, true_limbs
from torchpose.io._mocap import MocapClip
from torchpose.whole_body._silhouettes.rendering import render_limbs


def true_silhouettes(
    clip: MocapClip,
    shape: TrueShape,
    cameras: CameraRig,
    faults: float = 0.0,
    generator: torch.Generator | None = None,
) -> Bool[Tensor, "T C H W"]:
    """Return the silhouettes of a clip, with the faults of background subtraction.

    Args:
        clip: recorded joints. shape: of the person. cameras: with their image sizes.
        faults: severity for `benchmarks.bodies.faults.add_faults`; 0 renders without any.
        generator: of the faults.

    Returns:
        [T, C, H, W], True where the person is seen.
    """
    height, width = cameras.size or (480, 640)
    clean = render_limbs(true_limbs(clip, shape), cameras, height, width)
    return add_faults(clean, faults, generator) if faults > 0 else clean
