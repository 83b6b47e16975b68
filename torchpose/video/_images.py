"""Read a folder of images as a video."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchpose._core.checks import check_rate
from torchpose._core.images import Image
from torchpose._core.wording import counted
from torchpose.errors import FileFormatError, InputError
from torchpose.video._source_interface import VideoFrame, VideoSource

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
_DEFAULT_FPS = 30.0


def natural_key(name: str) -> list[str | int]:
    """Return a key that sorts names in natural order: by the values of the numbers in them.

    >>> sorted(["f10.png", "f9.png", "F1.png"], key=natural_key)
    ['F1.png', 'f9.png', 'f10.png']
    """
    parts = re.split(r"([0-9]+)", name.lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)]


def is_image(path: Path) -> bool:
    """Return whether a file has the name of an image."""
    return path.suffix.lower() in _SUFFIXES


def find_images(folder: str | Path) -> list[Path]:
    """Return images directly in a folder (png, jpg, bmp, tif, webp), in natural order of their names.

    Raises:
        InputError: no such folder, or no images in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is no folder' if folder.exists() else 'no such folder'}")
    try:
        files = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error})") from error
    images = [path for path in files if is_image(path)]
    if not images:
        raise InputError(
            f"{folder}: expected a folder of images (png, jpg, bmp, tif, webp), found none among "
            f"its {len(files)} files; for a video in it, give the video's own name, and for keypoints a "
            "folder of OpenPose's *_keypoints.json"
        )
    return sorted(images, key=lambda path: (natural_key(path.name), path.name))


class FolderSource(VideoSource):
    """Yields the images of a folder, in natural order of their names, at a constant rate.

    Grey and 16-bit images become 8-bit RGB (of 16 bits the upper 8), transparency is ignored, and
    the orientation that a camera wrote into a JPEG is undone. An image that cannot be read is
    replaced by the one before, which is noted.

    Args:
        folder: the folder. fps: frames per second; 30 without it, which is noted.

    Raises:
        InputError: no folder, no images, or a rate that is not positive. FileFormatError: the first
            image cannot be read, or images have several sizes.
    """

    reopenable = True

    def __init__(self, folder: str | Path, fps: float | None = None) -> None:
        super().__init__(str(folder))
        fps = None if fps is None else check_rate("fps", fps)
        self.folder, self._wanted = Path(folder), fps
        self._paths = find_images(folder)
        self.n_frames, self.fps = len(self._paths), fps or _DEFAULT_FPS
        self.knows_rate = fps is not None
        if fps is None:
            self.notes.append(
                f"images have no rate; {_DEFAULT_FPS:g} frames per second are assumed"
            )
        first = _read_image(self._paths[0])
        if isinstance(first, str):
            raise FileFormatError(f"{self._paths[0]}: the first image cannot be read ({first})")
        self.size = (first.shape[1], first.shape[0])
        self._describe()
        self._check_headers()

    def reopen(self) -> "FolderSource":
        """Return a new source that starts at the first image of the same folder."""
        return FolderSource(self.folder, self._wanted)

    def _release(self) -> None:
        self._paths = []

    def _describe(self) -> None:
        import cv2

        data = np.fromfile(self._paths[0], np.uint8)
        stored: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if stored.dtype == np.uint16:
            dark = "; they use the lower 12 only and look black" if stored.max() < 4096 else ""
            self.notes.append(f"16-bit images: the upper 8 bits are used{dark}")
        if stored.ndim == 3 and stored.shape[2] == 4:
            self.notes.append("transparency of the images is ignored")
        numbers = [re.findall(r"[0-9]+", path.stem) for path in self._paths]
        last = [int(found[-1]) for found in numbers if found]
        steps = set(np.diff(last).tolist()) if len(last) == len(self._paths) else set()
        if len(steps) > 1:
            self.notes.append(
                "the numbers in the names have gaps; the images are used one after the other"
            )

    def _check_headers(self) -> None:
        """Raise now if an image has another size, as far as its header can be read."""
        first = _stored_size(self._paths[0])
        for path in self._paths:
            if first is not None and _stored_size(path) not in (None, first):
                image = _read_image(path)  # the orientation may make the sizes equal
                if not isinstance(image, str):
                    self._check_size(path, image)

    def _check_size(self, path: Path, image: Image) -> None:
        if (image.shape[1], image.shape[0]) != self.size:
            raise FileFormatError(
                f"{path}: expected {self.size[0]}x{self.size[1]} pixels like the first image "
                f"({self._paths[0].name}), got {image.shape[1]}x{image.shape[0]}; remove or scale it"
            )

    def _read(self) -> Iterator[VideoFrame]:
        before: Image | None = None
        damaged: list[str] = []
        for index, path in enumerate(self._paths):
            image = _read_image(path)
            if isinstance(image, str):
                if before is None:
                    raise FileFormatError(f"{path}: the first image cannot be read ({image})")
                damaged.append(path.name)
                image = before.copy()
            self._check_size(path, image)
            before = image.copy() if index + 1 < len(self._paths) else None
            yield VideoFrame(image, index / self.fps, index)
        if damaged:
            names = ", ".join(damaged[:5]) + (", ..." if len(damaged) > 5 else "")
            self.notes.append(
                f"{len(damaged)} of {counted(len(self._paths), 'image')} cannot be read ({names}); the image "
                "before each was shown again"
            )


def _read_image(path: Path) -> Image | str:
    """Return the image, RGB, or the reason why it cannot be read."""
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        return error.strerror or str(error)
    if not len(data):
        return "empty file"
    if _is_cut(data.tobytes()):
        return "truncated"
    try:
        image: Any = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        return "not an image of 8 or 16 bits per channel, or a damaged one"
    rgb: Any = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb


def _is_cut(data: bytes) -> bool:
    """Return whether the end of a JPEG or PNG is missing, which decoders fill with grey."""
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]


def _stored_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in the header of a PNG, BMP or JPEG; None if not found."""
    try:
        with path.open("rb") as stream:
            head = stream.read(32)
            if head.startswith(b"\x89PNG") and len(head) >= 24:
                return struct.unpack(">II", head[16:24])
            if head.startswith(b"BM") and len(head) >= 26:
                width, height = struct.unpack("<ii", head[18:26])
                return width, abs(height)
            if head.startswith(b"\xff\xd8"):
                return _jpeg_size(head + stream.read(65536 - 32))
    except OSError:
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], struct.unpack(">H", data[place + 2 : place + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return width, height
        place += 2 + length
    return None
