"""The camera of `torchpose track-body` without a camera file: of four numbers, or guessed.

Its world has y up. Which way that is is stated, or found by how people stand.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli._track import is_video
from torchpose.errors import CameraError, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.whole_body._body_track import BodyTrack

_UNCALIBRATED = "uncalibrated"
_NAME = "camera"
_AXES = "the axes of the world are x right, y up, z towards the viewer, with the origin in the lens"
_LEVEL = f"the camera has no pose: {_AXES}; it is taken to be about level (--tilt and --roll say otherwise)"


def needs_no_file(cameras: str) -> bool:
    """Return whether text in place of a camera file stands for one camera, by its numbers or unknown."""
    return not Path(cameras).exists() and (cameras == _UNCALIBRATED or "," in cameras)


def camera_without_file(
    text: str,
    inputs: Sequence[str],
    videos: Sequence[str] | None,
    tilt: float | None,
    roll: float | None,
) -> "tuple[PinholeCamera, tuple[str, ...]]":
    """Return the camera of one input, in a world whose y axis points up, and notes on what is assumed.

    Args:
        text: ``fx,fy,cx,cy`` in pixels, or "uncalibrated" for K of the input, else the usual focal length for
            the size of its images.
        inputs: keypoints or videos. videos: into which the body is drawn, if some were given.
        tilt: degrees by which the camera looks up. roll: degrees by which it is rolled clockwise.

    Raises:
        InputError: several inputs, which need a camera file.
        CameraError: the size of the images is not known, or numbers that no camera has.
    """
    from torchpose.camera._choice import held_camera, resolve_camera

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
    return held_camera(camera, tilt, roll, None, given).in_level_world(), notes


def is_tilt_told(values: Mapping[str, Any]) -> bool:
    """Return whether options tell how the camera is held."""
    return values["tilt"] is not None or values["roll"] is not None


def told_tilt(values: Mapping[str, Any]) -> str:
    """Return the note on the world of a camera whose tilt is not looked for, given the options."""
    if is_tilt_told(values):
        return f"the camera {_angles(values['tilt'] or 0.0, values['roll'] or 0.0)}: {_AXES}"
    level = "it is level, as --up says" if values["up"] else "it is taken to be about level"
    return f"the camera has no pose: {_AXES}; {level}"


def tilt_of(
    people: "Sequence[BodyTrack]", camera: "PinholeCamera"
) -> "tuple[PinholeCamera | None, str]":
    """Return the camera with the tilt that people show, None if they show none, and a note on it.

    Args:
        people: tracked in the camera, taken to be level. camera: in which they were.
    """
    from torchpose.camera._rig import CameraRig
    from torchpose.whole_body._keypoints.camera_tilt import find_camera_tilt

    found = find_camera_tilt(people, CameraRig([camera]))
    if found is None:
        return None, f"{_LEVEL}: nobody was seen to stand for half a second"
    pitch, roll, *stds = map(math.degrees, found)
    note = f"{_angles(pitch, roll, stds)}, by how people stand (--tilt and --roll say otherwise)"
    return camera.tilted(found.pitch, found.roll).in_level_world(), f"the camera {note}: {_AXES}"


def _angles(tilt: float, roll: float, stds: Sequence[float] = ()) -> str:
    """Return how a camera is held, by degrees and their standard deviations, if there are some."""
    off = [f" ± {std:.0f}" for std in stds] or ["", ""]
    up, clockwise = (f"{abs(angle):.0f}" if stds else f"{abs(angle):g}" for angle in (tilt, roll))
    return (
        f"looks {'down' if tilt < 0 else 'up'} by {up}{off[0]} degrees and is rolled by {clockwise}{off[1]} "
        f"{'counterclockwise' if roll < 0 else 'clockwise'}"
    )


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
