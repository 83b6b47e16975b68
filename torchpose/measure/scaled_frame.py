"""A frame made so small that certain faces have a common size in it."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.measure.face import Image
from torchpose.measure.skin import SkinModel

__all__ = ["ScaledFrame", "scale_frame", "scales_of_faces"]

_FACE_PIXELS = 19.0  # size of a face: a window on a hand is then some 15 pixels wide
_LARGEST_SIDE = 640
# Lengths in sizes of the face.
_FACE = (0.65, -0.1, 0.9)  # half the width, centre and half the height of the ellipse taken out
_NECK = (0.4, 1.1)  # half the width, bottom


class ScaledFrame(NamedTuple):
    """What is looked at to find hands.

    Attributes:
        bins: number of each pixel's colour (`SkinModel.byte_bins`).
        usable: which pixels may be a hand: neither face, neck nor background.
        faces: (x, y) and size of all N faces, pixels of this image.
        scale: pixels of this image for one of the frame, across and down.
    """

    bins: Int[Tensor, "H W"]
    usable: Bool[Tensor, "H W"]
    faces: Float[Tensor, "N 3"]
    scale: Float[Tensor, " 2"]

    def from_frame(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return the points (x, y) of the frame in pixels of this image."""
        # a pixel's centre has whole coordinates, its corner half of one less
        return (points + 0.5) * self.scale - 0.5

    def to_frame(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return the points (x, y) of this image in pixels of the frame."""
        return (points + 0.5) / self.scale - 0.5


def scales_of_faces(faces: Float[Tensor, "N 3"], frame: Image) -> Int[Tensor, " N"]:
    """Return the pixels of the frame for one of the image in which each face has a size of some 19 pixels."""
    least = max(frame.shape[:2]) / _LARGEST_SIDE
    return (faces[:, 2] / _FACE_PIXELS).clamp_min(least).round().clamp_min(1).long()


def scale_frame(
    frame: Image,
    foreground: Image | None,
    faces: Float[Tensor, "N 3"],
    divisor: int,
    skin: SkinModel,
) -> ScaledFrame:
    """Make the frame smaller by a divisor, and see which of its pixels may be hands.

    Args:
        frame: RGB [H, W, 3]. foreground: [H, W], 0 where there is background; None is foreground
            everywhere. faces: (x, y) and size of all faces, pixels of the frame.
        divisor: one of `scales_of_faces`. skin: the model whose bins are taken.
    """
    height, width = (max(round(n * (1 / divisor)), 1) for n in frame.shape[:2])
    scale = faces.new_tensor([width / frame.shape[1], height / frame.shape[0]])
    places = torch.cat([(faces[:, :2] + 0.5) * scale - 0.5, faces[:, 2:] * scale.mean()], 1)
    usable = _not_head(places, (height, width))
    if foreground is not None:
        usable = usable & torch.from_numpy(_resized(foreground, height, width) > 0)
    return ScaledFrame(_bins(skin, _resized(frame, height, width)), usable, places, scale)


def _bins(skin: SkinModel, image: Image) -> Tensor:
    import cv2

    lab = torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2Lab)).permute(2, 0, 1)[None]
    return skin.byte_bins(lab)[0]


def _resized(image: Image, height: int, width: int) -> Image:
    import cv2

    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _not_head(faces: Tensor, shape: tuple[int, int]) -> Tensor:
    """False on the faces and necks of all persons, [H, W]."""
    x, y, size = faces[:, :, None, None].unbind(1)
    across = ((torch.arange(shape[1]).to(faces) - x) / size).abs()
    down = (torch.arange(shape[0]).to(faces)[:, None] - y) / size
    head = ((across / _FACE[0]).square() + ((down - _FACE[1]) / _FACE[2]).square() < 1).any(0)
    neck = ((across < _NECK[0]) & (down > 0) & (down < _NECK[1])).any(0)
    return ~(head | neck)
