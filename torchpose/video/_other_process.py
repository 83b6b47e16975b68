"""See in another process what the images of a recording show, while this one measures the persons.

Two threads of Python wait for each other with every small operation, and use one core and a half of two.
"""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from typing import Any, BinaryIO

import torch

from torchpose._core.images import Image
from torchpose._core.pipe import WAITING, PipeReader, PipeWriter, shared_memory
from torchpose.errors import TorchposeError
from torchpose.measure._upper_body_measurer import PersonsView, SeenPersons
from torchpose.video._measurers import Measurer, SeenFrame, look_ahead
from torchpose.video._prefetch import prefetch

LONG = 450  # frames from which on a recording is worth the start of a process
_UNKNOWN = 300  # frames after which one of unknown length is taken to be long
# Frames that wait to be measured: they last while the poses of a block are made.
AHEAD = WAITING - 2
_MEMORY = 1 << 26  # bytes that frames, and what they show, share with the process
_PROGRAM = "import sys; sys.path[:] = {!r}; from {} import serve; serve({}, {})"


def look_ahead_elsewhere(
    measurer: Measurer,
    state: Any,
    images: Iterable[tuple[Image, int]],
    n_frames: int | None,
    ahead: int,
) -> Generator[SeenFrame, None, None]:
    """Yield the frames of `look_ahead`, from a thread at first, and from another process once it has started.

    A short recording, and one before a measurer that cannot be pickled, stay with the thread.

    Args:
        measurer, state, images: see `look_ahead`. n_frames: of the recording, if known.
        ahead: frames that wait to be measured, no more than `AHEAD`.
    """
    images = iter(images)
    start = _UNKNOWN if n_frames is None else 0 if n_frames >= LONG else None
    beginning = _Beginning(measurer, start)
    with closing(beginning):
        with closing(prefetch(beginning.look(state, images), ahead)) as seen:
            yield from seen
        if beginning.other is not None and beginning.seen is not None:
            yield from beginning.other.look(beginning.seen, images, ahead)


class _Beginning:
    """Looks at the first frames, and starts the process that looks at the others.

    Args:
        measurer: looks at the frames. start: the frame at which the process is started; None for never.

    Attributes:
        other: the process, if it was started. seen: before the next frame, once the process is to go on.
    """

    def __init__(self, measurer: Measurer, start: int | None) -> None:
        self._measurer, self._start = measurer, start
        self.other: OtherProcess | None = None
        self.seen: SeenPersons | None = None

    def look(self, state: Any, images: Iterable[tuple[Image, int]]) -> Iterator[SeenFrame]:
        """Yield frames with what they show, until the process is ready."""
        for place, frame in enumerate(look_ahead(self._measurer, state, images)):
            yield frame
            if place == self._start:
                self.other = OtherProcess(self._measurer)
            if self.other is not None and self.other.ready:
                self.seen = None if frame.view is None else frame.view.after
                return

    def close(self) -> None:
        """End the process."""
        if self.other is not None:
            self.other.close()


class OtherProcess:
    """Looks at frames in a process of its own, which starts in the background.

    It runs the interpreter of this one, with the same paths. If it cannot be started, or the measurer cannot
    be sent to it, it never gets `ready`.

    Args:
        measurer: looks at the frames.
    """

    def __init__(self, measurer: Measurer) -> None:
        self.ready = False
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):
            self._process, self._frames, self._views = _started()
        if self._process is not None:
            self._starting = threading.Thread(target=self._hand_over, args=(measurer,), daemon=True)
            self._starting.start()

    def _hand_over(self, measurer: Measurer) -> None:
        """Send the measurer, and wait until it is there."""
        import cv2

        # whatever it is that cannot be pickled, or whyever the process ends, this one does the work
        with contextlib.suppress(Exception):
            self._frames.write((measurer, torch.get_num_threads(), cv2.getNumThreads()))
            self.ready = self._views.read() is None

    def look(
        self, seen: SeenPersons, images: Iterable[tuple[Image, int]], ahead: int = AHEAD
    ) -> Generator[SeenFrame, None, None]:
        """Yield frames with what they show; see `look_ahead`. What to look with next stays in the process.

        Args:
            seen: before the frames. images: each with the number of frames missed before it.
            ahead: see `look_ahead_elsewhere`.

        Raises:
            TorchposeError: the process has ended. Whatever looking at a frame raises.
        """
        self._send(seen)
        sent = prefetch(self._sent(images), ahead)
        try:
            for image, missed in sent:
                yield SeenFrame(image, self._view(), missed)
        finally:
            self._end()  # so that no frame waits for being read
            sent.close()

    def _sent(self, images: Iterable[tuple[Image, int]]) -> Iterator[tuple[Image, int]]:
        """Yield the images once they are sent."""
        for image, missed in images:
            self._send(image)
            yield image, missed

    def _send(self, value: Any) -> None:
        with contextlib.suppress(OSError):  # the process has ended, which `_view` tells
            self._frames.write(value)

    def _view(self) -> PersonsView:
        """Return what the next frame shows."""
        try:
            view = self._views.read()
        except EOFError as error:
            raise TorchposeError(
                "the process that looks at the frames has ended, perhaps for lack of memory; track with "
                "workers=0, which starts none"
            ) from error
        if isinstance(view, Exception):
            raise view
        return view  # type: ignore[no-any-return]

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        """End the process, and free what belongs to it."""
        self._end()
        if self._process is not None:
            self._starting.join()
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):  # what was not read is written once more
                    pipe.close()  # type: ignore[union-attr]


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _started() -> tuple["subprocess.Popen[bytes]", PipeWriter, PipeReader]:
    """Return a process that runs `serve`, without this one's Ctrl-C, and this one's ends of the pipes.

    Raises:
        OSError: it cannot be started.
    """
    if sys.platform == "win32":
        raise OSError("processes there cannot inherit descriptors of memory")
    memories = [shared_memory(_MEMORY) for _ in range(2)]
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(sys.path, __name__, *memories)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            pass_fds=memories,
        )
        assert process.stdin is not None and process.stdout is not None
        return (
            process,
            PipeWriter(process.stdin, memories[0]),
            PipeReader(process.stdout, memories[1]),
        )
    finally:
        for memory in memories:
            os.close(memory)


def serve(of_frames: int, of_views: int) -> None:
    """Look at the frames that come through standard input, until it ends; the program of the process.

    Args:
        of_frames, of_views: shared memory of what comes, and of what goes.
    """
    import cv2

    with contextlib.suppress(EOFError, BrokenPipeError):
        frames = PipeReader(sys.stdin.buffer, of_frames)
        views = PipeWriter(_own_output(), of_views)
        measurer, *threads = frames.read()
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])
        views.write(None)
        _look_at_all(measurer, frames, views)


def _own_output() -> BinaryIO:
    """Return standard output, which is standard error from now on for what libraries print."""
    own = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return own


def _look_at_all(measurer: Measurer, frames: PipeReader, views: PipeWriter) -> None:
    """Write what each frame shows, or the exception at one."""
    seen = frames.read()
    while True:
        image = frames.read()
        try:
            view = measurer.look(seen, image).view
        except Exception as error:
            views.write(error)
            return
        assert view is not None
        seen = view.after
        views.write(view._replace(after=None))
