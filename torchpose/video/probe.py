"""What a video file is, found out without decoding it."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torchpose.errors import FileFormatError
from torchpose.video.timing import Rate, frame_rate, shown_for

if TYPE_CHECKING:
    import av

__all__ = ["Scan", "is_cover", "open_container", "scan_packets"]

_SCAN_PACKETS, _SCAN_BYTES = 20_000, 500_000_000  # what is read ahead to learn rate and length
_NO_VIDEO = {"tty", "image2", "hls", "concat", "dash", "sdp", "rtsp", "lavfi"}


class Scan(NamedTuple):
    """What reading the packets, without decoding them, tells.

    Attributes:
        frames: packets of video. rate: by their times, None without. declared: rate that the file
        says, None if it makes no sense. span: seconds from first to last frame. last: end of the last
        packet of any stream, seconds on the file's clock. complete: whether the end was reached.
        fault: the error that ended the file early, or nothing.
    """

    frames: int
    rate: Rate | None
    declared: float | None
    span: float
    last: float
    complete: bool
    fault: str


def is_cover(stream: "av.VideoStream") -> bool:
    """Whether the stream is the picture of a piece of music."""
    from av.stream import Disposition

    return bool(stream.disposition & Disposition.attached_pic)


def open_container(path: Path) -> tuple["av.container.InputContainer", "av.VideoStream"]:
    """The container and its first video stream, or a typed error that says what the file is."""
    import av

    try:
        # titles are in any encoding, and nobody needs them here
        container = av.open(str(path.absolute()), metadata_errors="replace")
    except av.FFmpegError as error:
        raise FileFormatError(f"{path}: {_why_not(path, error)}") from error
    try:
        name = container.format.name
        if name.endswith("_pipe"):
            kind = name.removesuffix("_pipe")
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
    """Why a file cannot be opened."""
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
    """Names of the outermost boxes of an MP4 file; empty for other files."""
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
