"""Choose the camera of an input: the one given, the one that the input names, or a reported guess."""

from pathlib import Path

from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import CameraError

__all__ = ["resolve_camera"]


def resolve_camera(
    given: str | None,
    name: str | None,
    size: tuple[int, int] | None,
    matrix: Tensor | None,
    source: object,
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of keypoints or of a video, and notes on assumptions.

    In this order: what was given; K that came with the input; its image size with f = 525/640 of the
    longer side.

    Args:
        given: a TOML file or ``fx,fy,cx,cy``. name: the name of the camera in a file with several.
        size: (width, height) of the images, if known. matrix: K of the input, if known.
        source: the input, for messages.

    Raises:
        CameraError: no camera is known, four numbers are not what was given, or its image size is
            not that of the input. InputError, FileFormatError: the file.
    """
    if given:
        camera = _given_camera(given, name)
        if size is not None and camera.image_size is not None and camera.image_size != size:
            raise CameraError(
                f"{given}: the camera is for images of {_text(camera.image_size)}, the input is "
                f"of {_text(size)}; give the camera of the input's images"
            )
        notes: tuple[str, ...] = ()
        if bool((camera.distortions != 0).any()):
            notes = ("the camera's distortions are not applied: undistort keypoints beforehand",)
        return camera, notes
    if matrix is not None:
        return PinholeCamera.from_matrix(matrix, *(size or (None, None))), ()
    if size is not None:
        camera = PinholeCamera.from_image_size(*size)
        focal = float(camera.matrix[0, 0])
        return camera, (
            f"no camera was given: a focal length of {focal:.0f} pixels (525/640 of the longer side of "
            "the image) was assumed; distances depend on it",
        )
    raise CameraError(
        f"no camera can be told for {source}: expected --camera FILE or "
        "--camera fx,fy,cx,cy, or K or image_size in the keypoint file; got none of them"
    )


def _given_camera(given: str, name: str | None) -> PinholeCamera:
    if Path(given).exists() or "," not in given:
        return PinholeCamera.load(given, name)
    try:
        fx, fy, cx, cy = (float(part) for part in given.split(","))
    except ValueError as error:
        raise CameraError(
            f"--camera must be a TOML file or four numbers fx,fy,cx,cy in pixels, got {given!r}"
        ) from error
    return PinholeCamera(fx, fy, cx, cy)


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels"
