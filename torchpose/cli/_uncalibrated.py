"""The camera of `torchpose track-body` without a camera file: of four numbers, or guessed."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchpose.cli._track import is_video
from torchpose.errors import CameraError, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera

_UNCALIBRATED = "uncalibrated"
_NAME = "camera"
_AXES = (
    "the camera has no pose: the axes of the world are its own, x right, y up, z towards the viewer, "
    "with the origin in the lens; it is taken to be about level"
)


def needs_no_file(cameras: str) -> bool:
    """Return whether text in place of a camera file stands for one camera, by its numbers or unknown."""
    return not Path(cameras).exists() and (cameras == _UNCALIBRATED or "," in cameras)


def camera_without_file(
    text: str, inputs: Sequence[str], videos: Sequence[str] | None
) -> "tuple[PinholeCamera, tuple[str, ...]]":
    """Return the camera of one input, about level, and notes on what is assumed.

    Args:
        text: ``fx,fy,cx,cy`` in pixels, or "uncalibrated" for K of the input, else the usual focal length for
            the size of its images.
        inputs: keypoints or videos. videos: into which the body is drawn, if some were given.

    Raises:
        InputError: several inputs, which need a camera file.
        CameraError: the size of the images is not known, or numbers that no camera has.
    """
    from torchpose.camera._choice import resolve_camera

    if len(inputs) != 1:
        raise InputError(
            f"{text} stands for one camera, got {len(inputs)} inputs; several cameras need a TOML file with "
            "their poses in the room"
        )
    size, matrix = _images_of(inputs[0], videos)
    given = None if text == _UNCALIBRATED else text
    if given is None and size is None and matrix is None:
        raise CameraError(
            f"{inputs[0]} does not tell the size of its images, so no focal length can be guessed: give the "
            "video by --videos, fx,fy,cx,cy in place of 'uncalibrated', or a TOML file with the camera"
        )
    camera, notes = resolve_camera(given, None, size, matrix, inputs[0])
    camera.name = _NAME
    camera.rotation[0] = math.pi  # y of a level camera points down, that of the world up
    return camera, (*notes, _AXES)


def _images_of(
    path: str, videos: Sequence[str] | None
) -> "tuple[tuple[int, int] | None, Tensor | None]":
    """Return (width, height) of the images and K, as far as the input or its video tells."""
    if is_video(path):
        return _size_of_video(path), None
    shown = None if not videos else _size_of_video(videos[0])
    if Path(path).is_dir():
        return shown, None
    from torchpose.io._keypoints import read_keypoints

    found = read_keypoints(path, shown)
    return found.image_size or shown, found.K


def _size_of_video(path: str) -> tuple[int, int]:
    from torchpose.video._source import open_video

    with open_video(path) as source:
        return source.size
