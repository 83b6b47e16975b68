"""Scan a video file without decoding it, and resample its frames to a constant rate.

Filters step at a fixed rate. Phones and screen recorders write frames at a variable rate, webcams lose
frames, and clocks restart. A file of constant rate is not changed.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from torchpose.errors import FileFormatError, InputError

if TYPE_CHECKING:
    import av

T = TypeVar("T")
_JITTER = 0.2  # of the usual interval: what a constant rate may deviate by
_REGULAR = 0.9  # of all intervals have to be that regular
_LONGEST_GAP = 10.0  # seconds; a longer gap is a cut or a fault of the clock
_LAST = 0.5 - 1e-6  # intervals for which the last frame is shown after its time
_LATE = 0.5  # seconds; a clock that goes back by more has been restarted


@dataclass(frozen=True)
class Rate:
    """Holds the frames per second, and whether the rate is constant."""

    fps: float
    constant: bool


@dataclass
class Tally:
    """Counts the changes made to reach a constant rate, in frames.

    Attributes:
        repeated, dropped: frames shown again, frames left out.
        late: frames not after the one before. restarts: times at which the clock jumped back, or
        forward by more than ten seconds (two intervals of slower videos); the jump was taken out.
    """

    repeated: int = 0
    dropped: int = 0
    late: int = 0
    restarts: int = 0


def frame_rate(times: Sequence[float], declared: float | None = None) -> Rate | None:
    """Return the rate of frames at these times.

    If nine in ten intervals are within a fifth of the median, the rate is constant (jitter, lost
    frames) and is one over the mean of those intervals; otherwise it is the average over all.

    Args:
        times: the times of the frames, seconds, in any order.
        declared: rate by the file, taken if within half a percent of the one found.

    Returns:
        The rate, None for fewer than two different times.

    >>> frame_rate([0.0, 0.033, 0.067, 0.100, 0.133], declared=30.0)
    Rate(fps=30.0, constant=True)
    >>> frame_rate([0.0, 0.1, 0.5, 0.6, 1.6])
    Rate(fps=2.5, constant=False)
    """
    ordered = np.unique(np.asarray(times, dtype=np.float64))
    intervals = np.diff(ordered)
    if not len(intervals):
        return None
    usual = float(np.median(intervals))
    regular = np.abs(intervals - usual) <= _JITTER * usual
    constant = float(regular.mean()) >= _REGULAR
    counted = intervals[regular if constant else intervals <= _longest(usual)]
    mean = float(counted.mean())
    fps = 1 / mean
    if constant and declared is not None and abs(declared * mean - 1) <= 0.005:
        fps = declared
    return Rate(fps, constant)


def shown_for(times: Sequence[float]) -> float:
    """Return seconds from the first to the last frame, without gaps of more than ten seconds."""
    intervals = np.diff(np.unique(np.asarray(times, dtype=np.float64)))
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    return float(intervals[intervals <= _longest(usual)].sum())


def _longest(interval: float) -> float:
    """Return the longest gap between two frames that counts, seconds."""
    return max(_LONGEST_GAP, 2 * interval)


def to_constant_rate(
    timed: Iterable[tuple[float | None, T]], fps: float, tally: Tally, snap: bool = True
) -> Iterator[T]:
    """Yield for each time k / fps after the first frame the frame that is nearest to it.

    Args:
        timed: time in seconds (None: unknown) and frame, in order of display.
        fps: the constant rate.
        tally: counts what was done; complete after the last frame.
        snap: the frames have that rate already, up to jitter: each is shown once if it is within one
            interval of its turn.

    Yields:
        Frames; a repeated one is the same object again.

    Raises:
        InputError: the rate is not positive.

    >>> tally = Tally()
    >>> "".join(to_constant_rate([(0.0, "a"), (0.9, "b"), (4.1, "c")], 1.0, tally))
    'abbcc'
    >>> tally.repeated
    2
    """
    if not fps > 0:
        raise InputError(f"the frame rate must be positive, got {fps:g} frames per second")
    turns = _turns(timed, fps, tally)
    return _nearest(_snapped(turns) if snap else turns, tally)


def _turns(
    timed: Iterable[tuple[float | None, T]], fps: float, tally: Tally
) -> Iterator[tuple[float, T]]:
    """Yield the times in intervals since the first frame, in ascending order."""
    origin, last, step = 0.0, 0.0, 1 / fps
    for count, (time, frame) in enumerate(timed):
        if time is None:
            now = last + step if count else 0.0
        elif count == 0:
            origin, now = time, 0.0
        else:
            now = time - origin
            if now < last - _LATE or now > last + _longest(step):
                tally.restarts += 1
                origin, now = time - last - step, last + step
            elif now <= last:
                tally.late += 1
                now = last
        last = now
        yield now * fps, frame


def _snapped(turns: Iterable[tuple[float, T]]) -> Iterator[tuple[float, T]]:
    """Yield whole turns: the next one, unless the frame is an interval or more away from it."""
    place = -1
    for turn, frame in turns:
        place = place + 1 if abs(turn - place - 1) < 1 else round(turn)
        yield float(place), frame


def _nearest(turns: Iterable[tuple[float, T]], tally: Tally) -> Iterator[T]:
    held: tuple[float, T] | None = None
    place = 0  # the turn that is filled next
    for turn, frame in turns:
        if held is not None:
            end = (held[0] + turn) / 2
            shown = 0
            while place < end or (place == end and shown == 0 and held[0] == place):
                yield held[1]
                place, shown = place + 1, shown + 1
            _count(tally, shown)
        held = (turn, frame)
    if held is not None:
        shown = 0
        while place < held[0] + _LAST:
            yield held[1]
            place, shown = place + 1, shown + 1
        _count(tally, shown)


def _count(tally: Tally, shown: int) -> None:
    if shown:
        tally.repeated += shown - 1
    else:
        tally.dropped += 1


_SCAN_PACKETS, _SCAN_BYTES = 20_000, 500_000_000  # what is read ahead to learn rate and length
_PICTURE = "image2"  # for which FFmpeg takes some JPEGs, by their names
_NO_VIDEO = {"tty", "hls", "concat", "dash", "sdp", "rtsp", "lavfi"}


class Scan(NamedTuple):
    """Holds the result of reading the packets without decoding them.

    Attributes:
        frames: the number of packets of video. rate: the rate by their times, None without times.
        declared: the rate by the file, None if it is not plausible. span: the seconds from first to last
            frame. last: the end of the last packet of any stream, seconds on the file's clock.
        complete: whether the end was reached. fault: the error that ended the file early, or nothing.
    """

    frames: int
    rate: Rate | None
    declared: float | None
    span: float
    last: float
    complete: bool
    fault: str


def is_cover(stream: "av.VideoStream") -> bool:
    """Return whether the stream is the cover picture of a sound file."""
    from av.stream import Disposition

    return bool(stream.disposition & Disposition.attached_pic)


def open_container(path: Path) -> tuple["av.container.InputContainer", "av.VideoStream"]:
    """Return the container and its first video stream; raise a typed error for another kind of file."""
    import av

    try:
        # titles may have any encoding, and are not used
        container = av.open(str(path.absolute()), metadata_errors="replace")
    except av.FFmpegError as error:
        raise FileFormatError(f"{path}: {_why_not(path, error)}") from error
    try:
        name = container.format.name
        if name.endswith("_pipe") or name == _PICTURE:
            kind = path.suffix[1:].lower() if name == _PICTURE else name.removesuffix("_pipe")
            raise FileFormatError(
                f"{path}: expected a video, got a single picture ({kind}); "
                "pictures are read from a folder: give the folder"
            )
        if name in _NO_VIDEO:
            raise FileFormatError(f"{path}: expected a video, got text or a list ({name})")
        videos = [stream for stream in container.streams.video if not is_cover(stream)]
        if not videos:
            kinds = sorted({stream.type or "unknown" for stream in container.streams})
            what = "sound only" if "audio" in kinds else ", ".join(kinds) or "one with zero frames"
            raise FileFormatError(f"{path}: expected a video, got {what} ({name})")
        videos[0].thread_type = "AUTO"
    except BaseException:
        container.close()
        raise
    return container, videos[0]


def _why_not(path: Path, error: Exception) -> str:
    """Return the reason why a file cannot be opened."""
    if isinstance(error, PermissionError):
        return "cannot be read (permission denied)"
    if path.stat().st_size == 0:
        return "expected a video, got an empty file"
    if isinstance(error, EOFError):
        return "expected a video, got one with zero frames, or cut off before the first"
    boxes = _mp4_boxes(path)
    if "mdat" in boxes and "moov" not in boxes:
        return (
            "this MP4 has no index (moov), so none of it can be decoded: the recording was cut off "
            "or the copy is incomplete; copy it again, or record to MKV, which survives that"
        )
    reason = getattr(error, "strerror", None) or str(error)
    return f"expected a video file, got something else or a damaged one ({reason})"


def _mp4_boxes(path: Path) -> list[str]:
    """Return the names of the outermost boxes of an MP4 file; empty for other files."""
    names: list[str] = []
    with path.open("rb") as stream:
        end, start = path.stat().st_size, 0
        while start + 8 <= end and len(names) < 10_000:
            stream.seek(start)
            head = stream.read(16)
            size, name = int.from_bytes(head[:4], "big"), head[4:8]
            if not names and name not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
                return []
            names.append(name.decode("latin-1"))
            if size == 1:
                size = int.from_bytes(head[8:16], "big")
            if size < 8:  # 0: up to the end of the file
                break
            start += size
    return names


def scan_packets(container: "av.container.InputContainer", stream: "av.VideoStream") -> Scan:
    """Read packets without decoding them, up to a bound."""
    from av.error import FFmpegError

    guessed = float(stream.guessed_rate or stream.average_rate or 0)
    declared = guessed if 1 <= guessed <= 1000 else None
    tick = float(stream.time_base or 0)
    times: list[float] = []
    frames = size = 0
    offset, before, last = 0.0, None, 0.0
    complete, fault = True, ""
    packets = container.demux()
    while True:
        try:
            packet = next(packets, None)
        except FFmpegError as error:
            fault = str(error)
            break
        if packet is None:
            break
        stamp = packet.dts if packet.pts is None else packet.pts
        if stamp is not None and packet.time_base:
            last = max(last, float((stamp + (packet.duration or 0)) * packet.time_base))
        if packet.stream.index != stream.index or packet.size == 0 or packet.is_discard:
            continue
        frames, size = frames + 1, size + packet.size
        if stamp is not None:
            decoded = (stamp if packet.dts is None else packet.dts) * tick
            if before is not None and decoded < before - 0.5:
                offset += before - decoded  # a clock that was restarted
            before = decoded
            times.append(stamp * tick + offset)
        if frames >= _SCAN_PACKETS or size >= _SCAN_BYTES:
            complete = False
            break
    rate, span = frame_rate(times, declared), shown_for(times)
    return Scan(frames, rate, declared, span, last, complete, fault)
