"""Define the interface of video sources: files, folders of images, cameras."""

import abc
from collections.abc import Iterator
from typing import NamedTuple, Self

from torchpose._core.images import Image
from torchpose.errors import InputError


class VideoFrame(NamedTuple):
    """Holds one frame of a video.

    Attributes:
        image: RGB, uint8, [H, W, 3], C-contiguous; the receiver may draw on it.
        time: seconds since the first frame. Files and folders: index / fps, exactly. Cameras: clock.
        index: 0, 1, 2, ...; of a camera, missed frames are counted.
    """

    image: Image
    time: float
    index: int  # type: ignore[assignment]  # a tuple has a method of that name

    @property
    def missed(self) -> int:
        """Return the number of frames that a camera gave right before, and that nobody read."""
        return 0


class VideoSource(abc.ABC):
    """Yields frames of one size at a constant rate, once, from the first to the last.

    A source is an iterator over `VideoFrame` and a context manager. Who begins to read it a second time gets
    an `InputError`. Findings about the input (a rotated or truncated file, repeated frames) are sentences in
    `notes`; some are known only after the last frame.

    Args:
        name: as given by the user.

    Attributes:
        name: as given by the user. fps: frames per second. size: (width, height) of every frame, pixels.
        n_frames: estimated number of frames; None if unknown (a camera).
        notes: findings so far. reopenable: whether `reopen` works.
        knows_rate: whether `fps` was stated, and not assumed.
    """

    reopenable = False
    knows_rate = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.fps = 0.0
        self.size = (0, 0)
        self.n_frames: int | None = None
        self.notes: list[str] = []
        self._frames: Iterator[VideoFrame] | None = None
        self._closed = self._exhausted = False

    @abc.abstractmethod
    def _read(self) -> Iterator[VideoFrame]:
        """Return a generator over the frames, which is started once."""

    @abc.abstractmethod
    def _release(self) -> None:
        """Release the resources of the source."""

    def reopen(self) -> "VideoSource":
        """Return a new source that starts at the first frame of the same input.

        Raises:
            InputError: a camera, which cannot be read twice.
        """
        raise InputError(
            f"{self.name}: a camera cannot be read a second time; record it to a file first"
        )

    def close(self) -> None:
        """Release the resources; may be called repeatedly. `notes` remain."""
        if not self._closed:
            self._closed = True
            self._frames = None
            self._release()

    def __iter__(self) -> Iterator[VideoFrame]:
        if self._exhausted:
            again = ", or reopen() it" if self.reopenable else ""
            raise InputError(
                f"{self.name}: all frames of this source have been read; open it again{again} to read it "
                "once more"
            )
        return self

    def __next__(self) -> VideoFrame:
        if self._closed:
            raise InputError(f"{self.name}: this source is closed; open it again to read it")
        if self._frames is None:
            self._frames = self._read()
        try:
            return next(self._frames)
        except StopIteration:
            self._exhausted = True
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
