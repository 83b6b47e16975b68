"""Open a video, whatever it is: a file, a folder of images, or a camera."""

import os
from pathlib import Path

from torchpose.errors import InputError
from torchpose.video._camera import CameraSource
from torchpose.video._file import FileSource
from torchpose.video._images import FolderSource
from torchpose.video._source_interface import VideoSource

_KINDS = ("file", "folder", "camera")
_ADDRESS = "://"


def open_video(
    where: str | Path | int, *, kind: str | None = None, fps: float | None = None
) -> VideoSource:
    """Open a video file, a folder of images, or a camera.

    Args:
        where: path of a file or folder, or the number of a camera, as text too. Digits of a text are a
            camera only if no such path exists.
        kind: "file", "folder" or "camera", to say which; None finds out.
        fps: frames per second. A file is resampled to it, a folder is taken to have it (30 without),
            a camera is asked for it, and frames of a faster one are left out.

    Returns:
        Frames and what is known about them; close it, or use it in a `with` statement.

    Raises:
        InputError: nothing there, an address, an unknown kind, or a rate that is not positive.
        FileFormatError: not a video, or one without a single frame that can be decoded.

    Example:
        >>> import tempfile
        >>> import cv2, numpy as np
        >>> from torchpose.video import open_video
        >>> folder = tempfile.mkdtemp()
        >>> _ = cv2.imwrite(f"{folder}/1.png", np.zeros((48, 64, 3), np.uint8))
        >>> with open_video(folder, fps=25) as source:
        ...     print(source.size, source.fps, [frame.image.shape for frame in source])
        (64, 48) 25.0 [(48, 64, 3)]
    """
    if kind not in (None, *_KINDS):
        raise InputError(f"kind must be one of {', '.join(_KINDS)} or None, got {kind!r}")
    if isinstance(where, bool) or not isinstance(where, str | os.PathLike | int):
        raise InputError(f"expected a path or the number of a camera, got {where!r:.60}")
    text, path = str(where), Path(str(where))
    if isinstance(where, int) and kind is None:
        kind = "camera"
    if kind == "camera" or (kind is None and is_camera(text)):
        if not _is_number(text):
            raise InputError(f"a camera is given by its number, 0 or more; got {text!r}")
        return CameraSource(int(text), fps)
    if kind == "folder" or (kind is None and os.path.isdir(path)):
        return FolderSource(path, fps)
    if not os.path.exists(path):
        what = "addresses are not read: copy the video, and give the path of the copy"
        if _ADDRESS not in text:
            what = "no such file or folder; a camera is given by its number"
        raise InputError(f"{text}: {what}")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{text}: is a device or a pipe; a camera is given by its number")
    return FileSource(path, fps)


def is_camera(where: str) -> bool:
    """Return whether a text is the number of a camera, which the name of a file or folder is not."""
    return _is_number(where) and not os.path.exists(where)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()
