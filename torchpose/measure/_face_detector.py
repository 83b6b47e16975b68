"""Detect faces in grey images by OpenCV's cascade of Viola & Jones (Burke & Lasenby, section 5.1)."""

from threading import Lock
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_grey, check_shape
from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.measure._brightness import brightened, gain_to, quantile_of_bytes

_CLEAR = 26.0  # size to which the smallest face of a search is enlarged, pixels
_STRICTER = 1  # boxes more that must agree in an enlarged image
_BRIGHT = 160.0  # grey of the brightest parts of an image that needs no gain


def check_faces(faces: Float[Tensor, "N 3"], count: int | None = None) -> None:
    """Raise unless these are faces (x, y, size), `count` of them, that have a size.

    Raises:
        ShapeError: another shape. InputError: a size that is not positive.
    """
    check_shape("faces", faces, ["N" if count is None else count, 3])
    if not bool((faces[:, 2] > 0).all()):
        raise InputError(f"faces must have a positive size, got {faces[:, 2].tolist()}")


class Region(NamedTuple):
    """Holds a part of an image and the sizes of the faces to search for, pixels."""

    left: int
    top: int
    right: int
    bottom: int
    smallest: float
    largest: float


@runtime_checkable
class FaceDetector(Protocol):
    """Finds faces in a grey image."""

    def __call__(self, image: Image, region: Region | None = None) -> Float[Tensor, "N 3"]:
        """Return centre (x, y) and size (side of the square bounding box) of every face, pixels.

        Args:
            image: [H, W], uint8. region: the searched part of the image, which may be 0 elsewhere; None is
                the whole image.
        """
        ...


def _frontal_faces() -> Any:
    """Return OpenCV's cascade for frontal faces."""
    import cv2

    path = f"{cv2.data.haarcascades}haarcascade_frontalface_default.xml"  # type: ignore[attr-defined]
    cascade = cv2.CascadeClassifier(path)
    if cascade.empty():
        raise InputError(
            f"{path}: expected OpenCV's face cascade; install opencv-python-headless>=4.10,<5"
        )
    return cascade


class HaarFaceDetector:
    """Detects frontal faces by the cascade of Viola & Jones that comes with OpenCV.

    In a region with faces below 26 pixels it enlarges the image, and asks for more boxes that agree.
    Dark images are made brighter: the cascade takes windows of little contrast for plain walls.

    Args:
        scale_factor: between the sizes that are tried. min_neighbours: boxes that must agree.
        min_size: of a face, pixels; a region names its own.

    Raises:
        InputError: settings out of range, or an OpenCV without its cascades.

    Reference:
        P. Viola, M. Jones (2001), as cited by Burke & Lasenby, section 5.1.
    """

    def __init__(
        self, scale_factor: float = 1.1, min_neighbours: int = 3, min_size: int = 40
    ) -> None:
        if not scale_factor > 1 or min_neighbours < 0 or min_size < 1:
            raise InputError(
                "scale_factor must be above 1, min_neighbours at least 0 and min_size at least 1, "
                f"got {scale_factor}, {min_neighbours} and {min_size}"
            )
        self.scale_factor, self.min_size = scale_factor, min_size
        self.min_neighbours = min_neighbours
        self._cascade, self._searching = _frontal_faces(), Lock()

    def __getstate__(self) -> dict[str, Any]:
        # OpenCV's classifier can be neither copied nor pickled
        return self.__dict__ | {"_cascade": None, "_searching": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state | {"_cascade": _frontal_faces(), "_searching": Lock()}

    def __call__(self, image: Image, region: Region | None = None) -> Float[Tensor, "N 3"]:
        """Return the faces of a grey image; see `FaceDetector`."""
        check_grey("image", image)
        if region is None:
            return self._detect(image, self.min_size, max(image.shape), self.min_neighbours)
        part = image[region.top : region.bottom, region.left : region.right]
        smallest, largest = int(region.smallest), int(region.largest)
        if part.size == 0 or largest < 1:
            return torch.zeros(0, 3, dtype=torch.float64)
        scale = max(1.0, _CLEAR / max(region.smallest, 1.0))
        if scale == 1:
            found = self._detect(part, smallest, largest, self.min_neighbours)
        else:
            sizes = (round(smallest * scale), round(largest * scale))
            strict = self.min_neighbours + _STRICTER
            found = scaled_back(self._detect(resized(part, scale), *sizes, strict), scale)
        return found + found.new_tensor([region.left, region.top, 0])

    def _detect(
        self, image: Image, smallest: int, largest: int, neighbours: int
    ) -> Float[Tensor, "N 3"]:
        """Return the faces between two sizes."""
        with self._searching:  # the cascade keeps the image that it searches
            boxes = self._cascade.detectMultiScale(
                np.ascontiguousarray(_brightened(image)), self.scale_factor, neighbours,
                minSize=(smallest,) * 2, maxSize=(max(smallest, largest),) * 2,
            )  # fmt: skip
        found = np.asarray(boxes, dtype=np.float64).reshape(-1, 4)
        found = found[np.lexsort(found.T[:3])]  # threads of OpenCV end in any order
        corners, size = torch.from_numpy(found).split([2, 2], 1)
        return torch.cat([corners + size / 2, size[:, :1]], 1)


def _brightened(image: Image) -> Image:
    """Return the image, multiplied if its brightest parts are dark."""
    return brightened(image, gain_to(_BRIGHT, quantile_of_bytes(image[::4, ::4], 0.98)))


def resized(image: Image, scale: float) -> Image:
    """Return the image enlarged or made smaller by this factor."""
    import cv2

    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=way), np.uint8)


def scaled_back(faces: Float[Tensor, "N 3"], scale: float) -> Float[Tensor, "N 3"]:
    """Return the faces of an image that was resized by this factor, in pixels of the original."""
    return torch.cat([(faces[:, :2] + 0.5) / scale - 0.5, faces[:, 2:] / scale], 1)
