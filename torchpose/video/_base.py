"""What every source of frames has in common: files, folders of images, cameras."""

import abc
from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple, Self

from torchpose._core.images import Image
from torchpose.errors import InputError

__all__ = ["Image", "VideoFrame", "VideoSource"]


class VideoFrame(NamedTuple):
    """One frame of a video.

    Attributes:
        image: RGB, uint8, [H, W, 3], C-contiguous; its receiver may draw on it.
        time: seconds since the first frame. Files and folders: index / fps, exactly. Cameras: clock.
        index: 0, 1, 2, ...
    """

    image: Image
    time: float
    index: int  # type: ignore[assignment]  # a tuple has a method of that name


class VideoSource(abc.ABC):
    """Frames of one size at a constant rate, read once from front to back.

    A source is an iterator over `VideoFrame` and a context manager. What was noticed about the input
    (a rotated or truncated file, frames that were repeated) stands in `notes`, in plain words; some of
    it is known only after the last frame.

    Attributes:
        name: what the user gave. fps: frames per second. size: (width, height) of every frame, pixels.
        n_frames: how many frames to expect, an estimate; None if it cannot be told (a camera).
        notes: what was noticed so far. reopenable: whether `reopen` works.
    """

    reopenable = False

    def __init__(self, name: str) -> None:
        self.name = name
        self.fps = 0.0
        self.size = (0, 0)
        self.n_frames: int | None = None
        self.notes: list[str] = []
        self._frames: Iterator[VideoFrame] | None = None
        self._closed = False

    @abc.abstractmethod
    def _read(self) -> Iterator[VideoFrame]:
        """The frames, as a generator that is started once."""

    @abc.abstractmethod
    def _release(self) -> None:
        """Give back what the source holds open."""

    def reopen(self) -> "VideoSource":
        """A new source that starts at the first frame of the same input.

        Raises:
            InputError: a camera, which cannot be read twice.
        """
        raise InputError(
            f"{self.name}: a camera cannot be read a second time; record it to a file first"
        )

    def close(self) -> None:
        """Give back what is held open; may be called any number of times. `notes` stay."""
        if not self._closed:
            self._closed = True
            self._frames = None
            self._release()

    def __iter__(self) -> Iterator[VideoFrame]:
        return self

    def __next__(self) -> VideoFrame:
        if self._closed:
            raise InputError(f"{self.name}: this source is closed; open it again to read it")
        if self._frames is None:
            self._frames = self._read()
        return next(self._frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
