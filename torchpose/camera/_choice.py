"""Choose the camera of an input: the one given, the one that the input names, or a reported guess.

A calibrated camera is fitted to the size of the images that the input has. Cameras whose poses cannot be
those of one room are refused.
"""

import math
from itertools import combinations
from pathlib import Path

import torch
from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import intrinsics, scale_matrix
from torchpose.camera._rig import CameraRig
from torchpose.errors import CameraError, InputError

_MOST_TILT, _MOST_ROLL = 90, 180  # degrees
_MOST_STRETCHED = 1.5  # of focal lengths; pixels of HDV are 1.33 times as wide as high
_BLOCK = 16  # pixels: codecs store multiples of it, and some calibrations are of what is stored
_LEAST_FOCAL = 10.0  # pixels
_FARTHEST = 200.0  # metres from the origin; no room with cameras is larger
_SQUEEZED = 0.02  # difference of the ratio of the sides beyond which images are cut, and not scaled


def resolve_camera(
    given: str | None,
    name: str | None,
    size: tuple[int, int] | None,
    matrix: Tensor | None,
    source: object,
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of keypoints or of a video, and notes on assumptions.

    In this order: what was given, scaled to the input's images; K that came with the input; its image
    size with f = 525/640 of the longer side.

    Args:
        given: a TOML file, or ``fx,fy,cx,cy`` for images of the input's size.
        name: the name of the camera in a file with several.
        size: (width, height) of the images, if known. matrix: K of the input, if known.
        source: the input, for messages.

    Raises:
        CameraError: no camera is known, four numbers are not what was given, its images are of another
            shape than the input's, or its focal length is not one in pixels.
        InputError: a name without a file of cameras, or no such file. FileFormatError: the file.
    """
    if name is not None and (not given or _is_numbers(given)):
        raise InputError(
            f"--camera-name chooses one of several cameras of --camera FILE, got {name!r} "
            + (f"with --camera {given}" if given else "without --camera")
        )
    if given:
        camera = _of_pixels(_given_camera(given, name, size), given)
        camera, notes = fit_to_size(camera, size, source)
        if size is not None and camera.image_size is not None and camera.image_size != size:
            camera = _of_size(camera, camera.matrix, size)  # without the padding of a codec
        return camera, (*notes, *_doubts_about(camera))
    if matrix is not None:
        camera = _of_pixels(PinholeCamera.from_matrix(matrix, *(size or (None, None))), source)
        return camera, _doubts_about(camera)
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


def held_camera(
    camera: PinholeCamera,
    tilt: float | None,
    roll: float | None,
    up: str | None,
    given: str | None,
) -> PinholeCamera:
    """Return the camera with the orientation against gravity that options state; without any as it is.

    Args:
        camera: the camera of the input. tilt: degrees by which it looks up.
        roll: degrees by which it is rolled clockwise.
        up: the axis of the world that points up, by which its rotation tells both.
        given: the text that stated the camera, if one did.

    Raises:
        InputError: angles and an axis, or an axis without a file of cameras.
        CameraError: it looks up or down by more than 60 degrees, or angles of no camera.
    """
    if up is not None:
        if tilt is not None or roll is not None:
            raise InputError("--up tells tilt and roll by the camera's rotation; give one of them")
        if not given or _is_numbers(given):
            raise InputError(
                f"--up {up} needs --camera FILE with the rotation of the camera; give --tilt and --roll in "
                "degrees otherwise"
            )
        return camera.with_world_up(up)
    if tilt is None and roll is None:
        return camera
    if abs(roll or 0.0) > _MOST_ROLL or abs(tilt or 0.0) > _MOST_TILT:
        raise CameraError(
            f"--tilt must lie between -{_MOST_TILT} and {_MOST_TILT} degrees and --roll between "
            f"-{_MOST_ROLL} and {_MOST_ROLL}, got {tilt or 0:g} and {roll or 0:g}"
        )
    return camera.tilted(math.radians(tilt or 0.0), math.radians(roll or 0.0))


def _given_camera(given: str, name: str | None, size: tuple[int, int] | None) -> PinholeCamera:
    if not _is_numbers(given):
        return PinholeCamera.load(given, name)
    try:
        fx, fy, cx, cy = (float(part) for part in given.split(","))
    except ValueError as error:
        raise CameraError(
            f"a camera must be a TOML file or four numbers fx,fy,cx,cy in pixels, got {given!r}"
        ) from error
    return PinholeCamera(fx, fy, cx, cy, *(size or (None, None)))


def _is_numbers(given: str) -> bool:
    return "," in given and not Path(given).exists()


def _of_pixels(camera: PinholeCamera, source: object) -> PinholeCamera:
    """Return the camera if its focal lengths can be pixels."""
    focal = float(camera.matrix.diagonal()[:2].min())
    if focal < _LEAST_FOCAL:
        raise CameraError(
            f"{source}: a camera must be in pixels, got a focal length of {focal:g}; that of images of "
            "640 x 480 is about 525"
        )
    return camera


def _doubts_about(camera: PinholeCamera) -> tuple[str, ...]:
    """Return notes on numbers that hardly any camera has, as those in another order than fx, fy, cx, cy."""
    fx, fy, _, cx, cy = map(float, intrinsics(camera.matrix))
    notes = []
    if not 1 / _MOST_STRETCHED <= fx / fy <= _MOST_STRETCHED:
        notes.append(
            f"the camera's focal lengths {fx:g} and {fy:g} are far apart: check its numbers"
        )
    if camera.image_size is not None and not all(
        0 <= place <= side for place, side in zip((cx, cy), camera.image_size, strict=True)
    ):
        notes.append(
            f"the optical axis of the camera, ({cx:g}, {cy:g}), lies outside of its images of "
            f"{_text(camera.image_size)}: unless they are cut from larger ones, check its numbers"
        )
    return tuple(notes)


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels"


def is_padded(calibrated: tuple[int, int], size: tuple[int, int]) -> bool:
    """Return whether images are calibrated with up to 15 columns and rows more, as codecs store them.

    Args:
        calibrated, size: (width, height) of the calibration and of the images.
    """
    return all(0 <= c - s < _BLOCK for c, s in zip(calibrated, size, strict=True))


def fit_to_size(
    camera: PinholeCamera, size: tuple[int, int] | None, source: object
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera for images of a size, and a note if it is scaled.

    Args:
        camera: calibrated. size: (width, height) of the images, pixels, None if it is not known.
        source: what the images are of, for messages.

    Raises:
        CameraError: images of another shape.
    """
    calibrated = camera.image_size
    if size is None or calibrated is None or is_padded(calibrated, size):
        return camera, ()
    sx, sy = size[0] / calibrated[0], size[1] / calibrated[1]
    if abs(sx / sy - 1) > _SQUEEZED:
        turned = abs(size[0] * calibrated[0] / (size[1] * calibrated[1]) - 1) <= _SQUEEZED
        why = "they are turned by 90 degrees" if turned else "images of another shape are cut"
        raise CameraError(
            f"{source}: is of {_text(size)}, and camera {camera.name!r} is calibrated for "
            f"{_text(calibrated)}: {why}, so the calibration must be of them"
        )
    note = (
        f"camera {camera.name} is scaled from {_text(calibrated)} to the {_text(size)} of {source}"
    )
    return _of_size(camera, scale_matrix(camera.matrix, sx, sy), size), (note,)


def _of_size(camera: PinholeCamera, matrix: Tensor, size: tuple[int, int]) -> PinholeCamera:
    """Return the camera with another matrix and image size."""
    fx, fy, skew, cx, cy = map(float, intrinsics(matrix))
    return PinholeCamera(
        fx, fy, cx, cy, *size, camera.name, skew=skew, distortions=camera.distortions.tolist(),
        rotation=camera.rotation.tolist(), translation=camera.translation.tolist(),
        fisheye=camera.fisheye, up=None if camera.up is None else camera.up.tolist(),
    )  # fmt: skip


def check_room(rig: CameraRig) -> None:
    """Raise `CameraError` for cameras farther away than any room is large, and for two with one pose."""
    far = rig.translation.norm(dim=-1)
    if bool((far > _FARTHEST).any()):
        raise CameraError(
            f"cameras must be given in metres, got camera {rig.names[int(far.argmax())]!r} "
            f"{float(far.max()):g} m from the origin; divide translations in millimetres by 1000"
        )
    for a, b in combinations(range(len(rig)), 2):
        if torch.equal(rig.rotation[a], rig.rotation[b]) and torch.equal(
            rig.translation[a], rig.translation[b]
        ):
            raise CameraError(
                f"cameras {rig.names[a]!r} and {rig.names[b]!r} are in the same place with the same "
                "rotation; expected `rotation` and `translation` of each, of a calibration of all "
                "cameras together"
            )
