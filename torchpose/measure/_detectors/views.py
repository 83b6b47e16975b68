"""Put parts of an image into the input of a model, and points back from there."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.images import Image


class View(NamedTuple):
    """Holds the pixels that a model sees, and where they are from.

        (image's pixel) = (model's pixel - offset) / scale

    Attributes:
        pixels: RGB, uint8 [h, w, 3]. scale: model's pixels per pixel of the image.
        offset: of the image's corner, model's pixels, (u, v).
    """

    pixels: Image
    scale: float
    offset: tuple[float, float]

    def to_image(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return points of the image for points of the model's input."""
        return (points - points.new_tensor(self.offset)) / self.scale


def whole(image: Image) -> Float[Tensor, " 4"]:
    """Return the box of an image: left, top, right, bottom."""
    height, width = image.shape[:2]
    return torch.tensor([0.0, 0.0, width, height], dtype=torch.float64)


def view(
    image: Image,
    box: Float[Tensor, " 4"],
    size: tuple[int, int],
    fill: int = 0,
    centred: bool = True,
) -> View:
    """Return a box of an image, as large as it fits into the model's input without being distorted.

    Args:
        image: RGB. box: left, top, right, bottom, pixels; it may reach out of the image.
        size: width and height of the input. fill: value of pixels outside of the image.
        centred: put the box into the middle of the input, else into its upper left corner.
    """
    import cv2

    left, top, right, bottom = box.tolist()
    wide, high = max(right - left, 1.0), max(bottom - top, 1.0)
    scale = min(size[0] / wide, size[1] / high)
    free = ((size[0] - scale * wide) / 2, (size[1] - scale * high) / 2) if centred else (0.0, 0.0)
    offset = (free[0] - scale * left, free[1] - scale * top)
    matrix = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    pixels = cv2.warpAffine(image, matrix, size, borderValue=(fill, fill, fill))
    return View(np.asarray(pixels, np.uint8), scale, offset)
