"""Videos for the tests, made with PyAV: every frame tells its own number."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

CELL = 8  # pixels
BITS = 8


def numbered(number: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """A grey image whose top row of cells is `number` in black and white, lowest bit first."""
    width, height = size
    image = np.full((height, width, 3), 128, np.uint8)
    for bit in range(BITS):
        image[:CELL, bit * CELL : (bit + 1) * CELL] = 235 if number >> bit & 1 else 16
    return image


def number_of(image: np.ndarray) -> int:
    """The number that an image tells."""
    middle = CELL // 2
    cells = [int(image[middle, bit * CELL + middle].mean()) for bit in range(BITS)]
    return sum((value > 128) << bit for bit, value in enumerate(cells))


def make_video(
    path: Path,
    n: int = 30,
    size: tuple[int, int] = (64, 48),
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    fps: Fraction | int = 30,
    pts: list[int] | None = None,
    time_base: Fraction | None = None,
    rotation: int | None = None,
    images: Any = None,
    sound: bool = False,
    gop: int = 10,
    faststart: bool = False,
    tags: dict[str, int] | None = None,
    options: dict[str, str] | None = None,
    **container: Any,
) -> Path:
    """A video of `n` numbered frames, or of `images`.

    pts: of each frame in units of time_base (by default 1 / fps).
    """
    tick = time_base or 1 / Fraction(fps)
    movflags = {"movflags": "+faststart"} if faststart else {}
    with av.open(str(path), "w", options=movflags, **container) as out:
        quiet = {"x265-params": "log-level=none"} if codec == "libx265" else {}
        stream = out.add_stream(codec, rate=Fraction(fps), options={**quiet, **(options or {})})
        stream.width, stream.height, stream.pix_fmt = *size, pix_fmt
        stream.codec_context.time_base = tick
        stream.codec_context.gop_size = gop
        for name, value in (tags or {}).items():
            setattr(stream.codec_context, name, value)
        if rotation is not None:
            stream.set_display_rotation(rotation)
        audio = out.add_stream("aac", rate=44100, layout="mono") if sound else None
        if audio is not None:
            add_sound(out, audio, float(n * tick))
        out.start_encoding()
        for i in range(n):
            image = numbered(i, size) if images is None else images[i]
            frame = (
                image
                if isinstance(image, av.VideoFrame)
                else av.VideoFrame.from_ndarray(image, "rgb24").reformat(format=pix_fmt)
            )
            frame.pts, frame.time_base = (i if pts is None else pts[i]), tick
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def add_sound(out: Any, stream: Any, seconds: float) -> None:
    """Silence."""
    for k in range(int(seconds * 44100) // 1024):
        silence = np.zeros((1, 1024), np.float32)
        frame = av.AudioFrame.from_ndarray(silence, format="fltp", layout="mono")
        frame.sample_rate, frame.pts = 44100, k * 1024
        out.mux(stream.encode(frame))
    out.mux(stream.encode(None))
