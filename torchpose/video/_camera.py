"""Read cameras by OpenCV."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

from torchpose._core.checks import check_rate
from torchpose._core.wording import counted
from torchpose.errors import FileFormatError, InputError
from torchpose.video._source_interface import VideoFrame, VideoSource

_WARM_UP = 10  # frames that are discarded: exposure settles, and the rate is measured
_PATIENCE = 5  # reads without a frame, one after another, before a camera counts as unplugged
_PAUSE = 0.02  # seconds between them
_WRONG = 0.05  # share by which two rates may differ
_EARLY = 0.75  # of the time between frames by which one may come before its time, so that delays do not count
_PAUSE_FROM = 1.0  # seconds without a frame, which are then a pause: no frames were missed in it
_TELLING = 2.0  # seconds of frames that tell at what rate they are read


@runtime_checkable
class Capture(Protocol):
    """Declares the part of `cv2.VideoCapture` that is used."""

    def isOpened(self) -> bool: ...

    def read(self) -> tuple[bool, Any]: ...

    def get(self, prop: int) -> float: ...

    def set(self, prop: int, value: float) -> bool: ...

    def release(self) -> None: ...


class CameraFrame(VideoFrame):
    """Holds one frame of a camera."""

    missed = 0


class CameraSource(VideoSource):
    """Yields frames of a camera until it is closed or unplugged.

    The rate is measured over the first frames, which are discarded while the exposure settles. The times
    of the frames are those of the clock. Only the newest frame waits, so that a slow reader misses some.
    They are counted by the clock (`VideoFrame.missed`), and a note tells of them once the source is closed.
    Frames of another size than the first are scaled to it.

    Args:
        index: number of the camera, from 0.
        fps: the rate to ask the camera for; where it gives more, frames are left out.
        capture: returns the reader of an index; `cv2.VideoCapture` by default.

    Raises:
        InputError: no such camera, one that gives no frames, or a rate that is not positive.
    """

    def __init__(
        self,
        index: int,
        fps: float | None = None,
        capture: Callable[[int], Capture] | None = None,
    ) -> None:
        super().__init__(f"camera {index}")
        self._early = _EARLY  # of the time between frames by which one may come before its time
        self._resized = 0
        if index < 0:
            raise InputError(f"the number of a camera is 0 or more, got {index}")
        if fps is not None:
            check_rate("fps", fps)
        self._capture = (capture or _open)(index)
        try:
            self._prepare(index, fps)
        except BaseException:
            self.close()
            raise

    def _prepare(self, index: int, fps: float | None) -> None:
        import cv2

        if not self._capture.isOpened():
            raise InputError(
                f"camera {index} cannot be opened: there is none, another program uses it, or "
                "reading it is not permitted; cameras are numbered from 0"
            )
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # no queue of old frames
        if fps is not None:
            self._capture.set(cv2.CAP_PROP_FPS, fps)
        reported = float(self._capture.get(cv2.CAP_PROP_FPS))
        moments: list[float] = []
        for _ in range(_WARM_UP):
            image = self._grab()
            if image is None:
                raise InputError(f"camera {index} opens but gives no frames; is it in use?")
            moments.append(time.perf_counter())
            self.size = (image.shape[1], image.shape[0])
        span = moments[-1] - moments[2]  # the first frames are late
        measured = (len(moments) - 3) / span if span > 0 else 0.0
        self.fps = reported if 1 <= reported <= 1000 else fps or 30.0
        if 1 <= measured <= 1000 and abs(measured / self.fps - 1) > 0.2:
            self.notes.append(
                f"the camera says {self.fps:.4g} frames per second and gave {measured:.4g}, "
                "which are used; little light makes cameras slow"
            )
            self.fps = measured
        if fps is not None and self.fps > (1 + _WRONG) * fps:
            self.notes.append(
                f"the camera gives {self.fps:.4g} frames per second; {fps:.4g} of them are used, as asked for"
            )
            self.fps, self._early = fps, 0.5 * fps / self.fps

    def _grab(self) -> Any:
        import cv2

        for attempt in range(_PATIENCE):
            with contextlib.suppress(cv2.error):  # some drivers raise it where others give no frame
                found, image = self._capture.read()
                if found and image is not None:
                    return image
            if attempt + 1 < _PATIENCE:
                time.sleep(_PAUSE)
        return None

    def _read(self) -> Iterator[VideoFrame]:
        import cv2

        index, n_read, n_pauses = -1, 0, 0
        due = 0.0  # seconds after which the next frame is expected
        try:
            for image, seconds in self._images():
                late = (seconds - due) * self.fps  # in frames
                if late < -self._early:
                    continue
                missed = round(late) if late > _EARLY else 0
                if missed > _PAUSE_FROM * self.fps:
                    missed, due, n_pauses = 0, seconds, n_pauses + 1
                due += (1 + missed) / self.fps
                index, n_read = index + 1 + missed, n_read + 1
                frame = CameraFrame(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), seconds, index)
                frame.missed = missed
                yield frame
        finally:  # also if it is closed
            self._note_rate(n_read, index + 1)
            if n_pauses:
                self.notes.append(
                    f"pauses of more than {_PAUSE_FROM:g} s between frames of {self.name}, which take no "
                    f"time in the results: {n_pauses}"
                )
            if self._resized:
                self.notes.append(
                    f"{counted(self._resized, 'frame')} of {self.name} of another size, scaled to "
                    f"{self.size[0]}x{self.size[1]}"
                )
        self.notes.append(
            f"{self.name} gave no more frames after {n_read}: unplugged, or used by another program"
        )

    def _images(self) -> Iterator[tuple[Any, float]]:
        """Yield what the camera gives, and the seconds since the first image.

        The usual clock, `time.monotonic`, ticks 64 times a second on Windows before Python 3.13.
        """
        import cv2

        start = None
        while (image := self._grab()) is not None:
            now = time.perf_counter()
            start = now if start is None else start
            if image.ndim != 3:
                raise FileFormatError(
                    f"{self.name}: expected frames in colour, got an array of shape {list(image.shape)}"
                )
            if (image.shape[1], image.shape[0]) != self.size:
                self._resized += 1
                image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
            yield image, now - start

    def _note_rate(self, n_read: int, n_frames: int) -> None:
        """Add a note if frames were missed."""
        if n_frames < _TELLING * self.fps or n_read > (1 - _WRONG) * n_frames:
            return
        rate = self.fps * (n_read - 1) / (n_frames - 1)
        reached = f"{(1 - _WRONG) * rate:.3g}"
        self.notes.append(
            f"{self.name} was read at {rate:.3g} of {self.fps:.4g} frames per second: nothing was measured "
            "in the others, whose poses are predicted; ask for a rate that is reached "
            f"(fps={reached}, --fps {reached})"
        )

    def _release(self) -> None:
        self._capture.release()


def _open(index: int) -> Capture:
    import cv2

    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the typed error reports it
    try:
        return cv2.VideoCapture(index)
    finally:
        cv2.utils.logging.setLogLevel(level)
