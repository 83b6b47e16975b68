"""Decode video files by FFmpeg's libraries (PyAV) to upright RGB frames at a constant rate."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpose._core.checks import check_rate
from torchpose._core.images import Image
from torchpose._core.reading import require_file
from torchpose._core.wording import counted
from torchpose.errors import FileFormatError
from torchpose.video._source_interface import VideoFrame, VideoSource
from torchpose.video._timing import (
    Rate,
    Scan,
    Tally,
    is_cover,
    open_container,
    scan_packets,
    to_constant_rate,
)

if TYPE_CHECKING:
    import av

_FALLBACK_FPS = 30.0
_FASTEST = 1000.0  # frames per second; higher rates are no valid times
_MOST_HELD = 64  # frames in a decoder's pipeline that fail one after another
_LATE_SOUND = 1.0  # seconds by which sound may outlast the picture
_UNKNOWN_MATRIX = 2  # as numbered by H.273
_BT601 = (1279, 576)  # larger videos that declare no matrix are taken as BT.709, as players do
_USUAL_START = 2.0  # seconds; broadcast formats start their clocks a little late
_HDR = {16: "PQ", 18: "HLG"}


class FileSource(VideoSource):
    """Yields the frames of a video file.

    Times come from the file's own time stamps. Where frames come at a variable rate, or another rate
    is asked for, the frame nearest to each k / fps is taken; lost frames are replaced by repeated ones.
    Rotation and mirroring of phone videos are undone, colours converted by the file's own matrix and
    range (10-bit and grey to 8-bit RGB). Frames that cannot be decoded are left out and counted in
    `notes`. A truncated file ends at its last frame.

    Args:
        path: the file. fps: the rate wanted; None is the file's own.

    Raises:
        InputError: no such file, or a rate that is not positive. FileFormatError: not a video, or one
            without a single frame that can be decoded.
    """

    reopenable = True

    def __init__(self, path: str | Path, fps: float | None = None) -> None:
        super().__init__(str(path))
        self.path = require_file(path)
        self._wanted = None if fps is None else check_rate("fps", fps)
        self._closed = True  # until there is something to close
        scan = self._scan()
        self._container, self._stream = open_container(self.path)
        self._closed = False
        try:
            self._prepare(scan)
        except BaseException:
            self.close()
            raise

    def reopen(self) -> "FileSource":
        """Return a new source that starts at the first frame of the same file."""
        return FileSource(self.path, self._wanted)

    def _release(self) -> None:
        self._container.close()

    def _prepare(self, scan: Scan) -> None:
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()
        self._tally = Tally()
        self._count = self._broken = self._corrupt = self._resized = 0
        self._kept = 0  # frames of a truncated file that are there
        self._ended = ""  # why reading ended before the end of the file
        self._scanned = scan.complete
        self._decoded = self._decode()
        self._first = next(self._decoded, None)
        if self._first is None:
            raise FileFormatError(f"{self.path}: {_why_no_frame(scan)}")
        frame = self._first
        self._turn, odd = _orientation(frame)
        self._raw_size = (frame.width, frame.height)
        self.size = self._raw_size[::-1] if self._turn[0] else self._raw_size
        self._set_rate(scan)
        self._describe(frame, odd)
        self._declared_end(scan)

    def _set_rate(self, scan: Scan) -> None:
        rate, span = scan.rate, scan.span
        self._timeless = rate is None or rate.fps > _FASTEST
        if rate is None or self._timeless:
            rate = Rate(self._wanted or scan.declared or _FALLBACK_FPS, True)
            span = (scan.frames - 1) / rate.fps
            if scan.frames > 1:
                self.notes.append(
                    f"the file has no times; {rate.fps:.6g} frames per second are assumed"
                )
        self.fps = self._wanted or rate.fps
        same = abs(self.fps / rate.fps - 1) < 0.01
        self._snap = rate.constant and same
        if not rate.constant:
            self.notes.append(
                f"variable frame rate ({rate.fps:.4g} per second on average): resampled to "
                f"{self.fps:.6g} frames per second by repeating and leaving out frames"
            )
        elif not same:
            self.notes.append(
                f"resampled from {rate.fps:.6g} to {self.fps:.6g} frames per second, as asked"
            )
        if scan.complete:
            self.n_frames = max(1, math.ceil(span * self.fps + 0.5 - 1e-6))
        elif self._duration():
            self.n_frames = round(self._duration() * self.fps)
        elif self._stream.frames:
            self.n_frames = self._stream.frames

    def _describe(self, frame: "av.VideoFrame", odd_turn: bool) -> None:
        """Add notes on the first frame."""
        swapped, flip_x, flip_y = self._turn
        if swapped or flip_x or flip_y:
            width, height = self.size
            self.notes.append(f"stored rotated or mirrored; shown upright, {width}x{height}")
        if odd_turn:
            self.notes.append("to be shown at an angle that is no multiple of 90 degrees: ignored")
        if frame.interlaced_frame:
            self.notes.append(
                "interlaced: fast movements have striped edges; deinterlace the file first"
            )
        if frame.color_trc in _HDR:
            self.notes.append(
                f"high dynamic range ({_HDR[frame.color_trc]}) is not tone-mapped: colours look flat"
            )
        aspect = self._stream.sample_aspect_ratio
        if aspect and aspect != 1:
            self.notes.append(f"pixels are not square ({aspect}); treated as square")
        videos = [s for s in self._container.streams.video if not is_cover(s)]
        if len(videos) > 1:
            self.notes.append(f"{len(videos)} video streams; the first is read")
        start = self._time(frame)
        if start is not None and abs(start) > _USUAL_START:
            self.notes.append(f"the file's clock starts at {start:.2f} s; times count from there")

    def _declared_end(self, scan: Scan) -> None:
        """Add a note if the file declares more frames than it holds."""
        if not scan.complete:
            return
        duration = self._duration() if scan.rate else 0.0
        cut = self._stream.frames > scan.frames + 1
        if cut or duration - scan.last > max(0.1, 2 / self.fps) or scan.fault:
            self._kept = scan.frames
            self._say_truncated(scan.frames, scan.span)

    def _say_truncated(self, frames: int, seconds: float) -> None:
        of = f" of {self._stream.frames}" if self._stream.frames > frames else ""
        self.notes.append(
            f"the file is truncated or damaged: it holds {frames}{of} frames ({seconds:.2f} s), "
            "which are used"
        )

    def _duration(self) -> float:
        """Return the declared duration, seconds; 0 if unknown."""
        return (self._container.duration or 0) / 1e6

    def _scan(self) -> Scan:
        container, stream = open_container(self.path)
        with container:
            return scan_packets(container, stream)

    def _packets(self) -> Iterator["av.Packet"]:
        """Yield packets of the video, without the broken one at the end of a truncated file.

        A decoder with several threads would lose intact frames because of it.
        """
        from av.error import FFmpegError

        packets = self._container.demux(self._stream)
        held: av.Packet | None = None
        while True:
            try:
                packet = next(packets, None)
            except FFmpegError as error:  # the file ends in the middle of something
                self._ended = str(error.strerror or error)
                packet = None
            ends = packet is None or packet.size == 0
            if held is not None:
                if ends and held.is_corrupt:
                    self._broken += 1
                else:
                    yield held
            if ends:
                return
            held = packet

    def _decode(self) -> Iterator["av.VideoFrame"]:
        """Yield frames as they are stored, without those that cannot be decoded."""
        from av.error import EOFError as AvEOFError
        from av.error import FFmpegError

        flush = (None for _ in range(_MOST_HELD))  # frames that the decoder still holds
        for packet in itertools.chain(self._packets(), flush):
            try:
                frames = self._stream.decode(packet)
            except AvEOFError:
                return
            except FFmpegError:
                self._broken += 1
                continue
            for frame in frames:
                self._corrupt += bool(frame.is_corrupt)
                self._count += 1
                yield frame

    def _timed(self) -> Iterator[tuple[float | None, "av.VideoFrame"]]:
        frame, self._first = self._first, None
        if frame is not None:
            yield self._time(frame), frame
        del frame
        for frame in self._decoded:
            yield self._time(frame), frame

    def _time(self, frame: "av.VideoFrame") -> float | None:
        """Return seconds on the file's clock, None if unknown; the last frames have no `frame.time`."""
        if frame.pts is None or self._timeless:
            return None
        return float(frame.pts * (self._stream.time_base or 0))

    def _read(self) -> Iterator[VideoFrame]:
        last: av.VideoFrame | None = None
        steady = to_constant_rate(self._timed(), self.fps, self._tally, self._snap)
        index = -1
        for index, frame in enumerate(steady):
            if frame is not last:
                self._resized += (frame.width, frame.height) != self._raw_size
            last = frame
            yield VideoFrame(self._to_rgb(frame), index / self.fps, index)
        if not self._scanned:  # too long to be looked through beforehand
            seconds = (index + 1) / self.fps
            known = self._stream.frames > self._count + self._broken + 1
            if known or self._duration() - seconds > _LATE_SOUND:
                self._say_truncated(self._count, seconds)
        self._tell()

    def _to_rgb(self, frame: "av.VideoFrame") -> Image:
        from av.video.reformatter import Colorspace

        width, height = self._raw_size
        large = frame.height > _BT601[1] or frame.width > _BT601[0]
        unknown = frame.colorspace == _UNKNOWN_MATRIX
        rgb = self._reformatter.reformat(
            frame,
            width,
            height,
            "rgb24",
            src_colorspace=Colorspace.ITU709 if unknown and large else None,
            threads=1,
        )
        image: Any = rgb.to_ndarray()
        if rgb is frame:  # RGB already: the decoder and repeated frames need it as it is
            image = image.copy()
        return _upright(image, self._turn)

    def _tell(self) -> None:
        """Add notes on what was found while reading."""
        tally, count = self._tally, counted
        missing = self._kept - self._count
        if missing > 0:
            self.notes.append(f"{count(missing, 'frame')} of these could not be decoded")
        elif self._broken:
            self.notes.append(f"{count(self._broken, 'frame')} could not be decoded: left out")
        if self._ended:
            self.notes.append(f"reading ended early ({self._ended})")
        if self._corrupt:
            self.notes.append(f"{count(self._corrupt, 'frame')} decoded with damage")
        if self._resized:
            width, height = self.size
            self.notes.append(
                f"{count(self._resized, 'frame')} of another size, scaled to {width}x{height}"
            )
        if tally.restarts:
            self.notes.append(f"the clock jumped {count(tally.restarts, 'time')}; treated as cuts")
        if tally.late:
            self.notes.append(f"{count(tally.late, 'frame')} with a time not after the one before")
        repeated, dropped = count(tally.repeated, "frame"), count(tally.dropped, "frame")
        done = [f"{repeated} repeated"] * bool(tally.repeated)
        done += [f"{dropped} left out"] * bool(tally.dropped)
        if done:
            self.notes.append(f"{' and '.join(done)} to keep {self.fps:.6g} frames per second")


def _why_no_frame(scan: Scan) -> str:
    if scan.frames == 0:
        return "expected a video, got one with zero frames"
    return f"none of its {counted(scan.frames, 'frame')} can be decoded; the file is damaged"


def _orientation(frame: "av.VideoFrame") -> tuple[tuple[bool, bool, bool], bool]:
    """Return (transpose, then mirror x, then mirror y) to turn a frame upright; whether it is skewed.

    The matrix of the file maps (x, y) to (a x + c y, b x + d y); a, b, c, d are in 16.16 fixed point.
    """
    data: Any = frame.side_data
    matrix = next((s for s in data if s.type.name == "DISPLAYMATRIX"), None)
    if matrix is None:
        return (False, False, False), False
    a, b, _, c, d = np.frombuffer(bytes(matrix), dtype=np.int32)[:5] / 65536.0
    straight, swapped = min(abs(a), abs(d)), min(abs(b), abs(c))
    if max(straight, swapped) == 0 or min(straight, swapped) > 0.01 * max(straight, swapped):
        return (False, False, False), True
    if swapped > straight:
        return (True, bool(c < 0), bool(b < 0)), False
    return (False, bool(a < 0), bool(d < 0)), False


def _upright(image: Image, turn: tuple[bool, bool, bool]) -> Image:
    swapped, flip_x, flip_y = turn
    if swapped:
        image = image.swapaxes(0, 1)
    if flip_x:
        image = image[:, ::-1]
    if flip_y:
        image = image[::-1]
    return np.ascontiguousarray(image)
