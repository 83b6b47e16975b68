"""Write H.264 files that a browser plays, whole or not at all."""

import contextlib
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from torchpose._core.checks import check_choice
from torchpose._core.files import atomic_path
from torchpose._core.images import Image
from torchpose.errors import InputError, MissingDependencyError, OutputError, ShapeError

_ENCODERS = ("libx264", "libopenh264")
_PRESETS = [
    "ultrafast",
    "superfast",
    "veryfast",
    "faster",
    "fast",
    "medium",
    "slow",
    "slower",
    "veryslow",
    "placebo",
]
_BT709, _LIMITED = 1, 1  # as numbered by H.273 and by FFmpeg


class VideoWriter:
    """Writes RGB frames to an MP4 file: H.264, 4:2:0, BT.709, its index in front (for browsers).

    The file is written under a temporary name in the same folder and appears with `close()`. Leaving
    the `with` block by an exception removes it; leaving by KeyboardInterrupt (Ctrl-C) keeps what was
    written so far, as a valid file, and the interrupt goes on. Without frames no file appears.
    H.264 has even sizes: an odd width or height is padded by repeating the last column or row, which is
    noted.

    Args:
        path: where the file is to appear, ending in .mp4; its folder must exist.
        fps: frames per second. size: (width, height) of the frames, pixels.
        crf: quality, from 0 (lossless) to 51; lower is better and larger.
        preset: of the encoder x264, from "ultrafast" (large files) to "veryslow".

    Raises:
        InputError: a rate, size, quality or name that is not possible.
        OutputError: the file cannot be written there. MissingDependencyError: no H.264 encoder.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchpose.video import VideoWriter, open_video
        >>> path = tempfile.mkdtemp() + "/grey.mp4"
        >>> with VideoWriter(path, fps=25, size=(64, 48)) as writer:
        ...     for _ in range(10):
        ...         writer.write(np.full((48, 64, 3), 128, np.uint8))
        >>> with open_video(path) as source:
        ...     print(source.fps, source.size, source.n_frames)
        25.0 (64, 48) 10
    """

    def __init__(
        self,
        path: str | Path,
        fps: float,
        size: tuple[int, int],
        crf: int = 20,
        preset: str = "veryfast",
    ) -> None:
        self.path, self.size = Path(path), (int(size[0]), int(size[1]))
        self.frames, self.notes = 0, list[str]()
        self._check(fps, crf, preset)
        self._padding = (self.size[1] % 2, self.size[0] % 2)
        if any(self._padding):
            stored = f"{self.size[0] + self._padding[1]}x{self.size[1] + self._padding[0]}"
            self.notes.append(
                f"H.264 needs even sizes: {self.size[0]}x{self.size[1]} is padded to {stored}"
            )
        encoder = _encoder()
        self._rate = Fraction(fps).limit_denominator(1001)
        self._waiting: list[Any] = []  # packets of the encoder, kept if Ctrl-C comes in between
        self._container: Any = None
        self._file = contextlib.ExitStack()
        temporary = self._file.enter_context(atomic_path(self.path))
        try:
            with _as_output_error(self.path):
                self._start(temporary, encoder, crf, preset)
        except BaseException:
            self._discard()
            raise

    def _check(self, fps: float, crf: int, preset: str) -> None:
        if self.path.suffix.lower() != ".mp4":
            raise InputError(f"{self.path}: the name of a video to write must end in .mp4")
        if not 0.01 <= fps <= 1000:
            raise InputError(f"fps must be from 0.01 to 1000, got {fps:g}")
        if not (0 < self.size[0] <= 16384 and 0 < self.size[1] <= 16384):
            raise InputError(
                f"size must be (width, height) from 1 to 16384 pixels, got {self.size}"
            )
        if not 0 <= crf <= 51:
            raise InputError(f"crf must be from 0 to 51, got {crf}")
        check_choice("preset", preset, _PRESETS)

    def _start(self, temporary: Path, encoder: str, crf: int, preset: str) -> None:
        import av
        from av.video.reformatter import VideoReformatter

        self._container = av.open(
            str(temporary.absolute()), "w", format="mp4", options={"movflags": "+faststart"}
        )
        options = {"crf": str(crf), "preset": preset} if encoder == "libx264" else {}
        stream: Any = self._container.add_stream(encoder, rate=self._rate, options=options)
        stream.width = self.size[0] + self._padding[1]
        stream.height = self.size[1] + self._padding[0]
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = 1 / self._rate
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _LIMITED
        if encoder != "libx264":  # no constant quality there: bits by area and rate
            stream.bit_rate = int(0.15 * stream.width * stream.height * float(self._rate))
        self._stream, self._reformatter = stream, VideoReformatter()

    def write(self, image: Image) -> None:
        """Write a frame.

        Args:
            image: RGB, uint8, [H, W, 3] of the size given.

        Raises:
            ShapeError: another shape. InputError: not uint8, or the file is closed.
            OutputError: the disk is full, or writing fails for another reason; nothing is left there.
        """
        import av
        from av.video.reformatter import ColorRange, Colorspace

        if self._container is None:
            raise InputError(f"{self.path}: is closed; frames are written before close()")
        self._check_frame(image)
        below, right = self._padding
        if below or right:
            image = np.pad(image, ((0, below), (0, right), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = self._reformatter.reformat(
            frame,
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
            threads=1,
        )
        frame.pts, frame.time_base = self.frames, 1 / self._rate
        try:
            with _as_output_error(self.path):
                self._encode(frame)
        except Exception:
            self._discard()
            raise

    def _check_frame(self, image: Image) -> None:
        expected = (self.size[1], self.size[0], 3)
        shape = getattr(image, "shape", None)
        if shape is None or tuple(shape) != expected:
            got = "no array" if shape is None else list(shape)
            raise ShapeError(f"a frame must have shape {list(expected)} (H, W, RGB), got {got}")
        if image.dtype != np.uint8:
            raise InputError(f"a frame must be uint8 from 0 to 255, got {image.dtype}")

    def _encode(self, frame: Any) -> None:
        self._waiting += self._stream.encode(frame)
        self.frames += frame is not None
        while self._waiting:
            self._container.mux(self._waiting.pop(0))

    def close(self) -> None:
        """Finish the file, which appears now; may be called repeatedly.

        Raises:
            OutputError: the disk is full, or writing fails for another reason; nothing is left there.
        """
        if self._container is None:
            return
        if not self.frames:
            self._discard()
            return
        try:
            with _as_output_error(self.path):
                self._encode(None)
                container, self._container = self._container, None
                container.close()
        except BaseException:
            self._discard()
            raise
        self._file.close()

    def _discard(self) -> None:
        """Remove what was written."""
        container, self._container = self._container, None
        self._waiting.clear()
        if container is not None:
            with contextlib.suppress(Exception):  # the cause is reported already
                container.close()
        self._file.__exit__(_Discarded, _Discarded(), None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.close()
        elif self._container is not None:
            self._discard()


class _Discarded(Exception):  # noqa: N818
    """Tells `atomic_path` not to keep the file."""


@contextlib.contextmanager
def _as_output_error(path: Path) -> Any:
    """Convert errors of FFmpeg and of the disk to typed ones."""
    import av

    try:
        yield
    except OutputError:
        raise
    except (av.FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OutputError(
            f"{path}: cannot be written ({reason}); nothing was left there"
        ) from error


def _encoder() -> str:
    """Return the name of the H.264 encoder of the installed PyAV."""
    import av

    for name in _ENCODERS:
        try:
            av.codec.Codec(name, "w")
        except av.codec.codec.UnknownCodecError:
            continue
        return name
    raise MissingDependencyError(
        f"writing H.264 needs {' or '.join(_ENCODERS)} in PyAV, whose build here has neither; "
        "install PyAV's own wheels (pip install --only-binary :all: av)"
    )
