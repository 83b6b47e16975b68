"""A C3D parser for tests, written from the description of the format, in NumPy and struct."""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class C3D(NamedTuple):
    parameters: dict[str, Any]
    points: np.ndarray
    """[T, N, 4]: x, y, z and residual as stored."""
    first: int
    last: int
    rate: float


def parse_c3d(path: Path) -> C3D:
    data = path.read_bytes()
    assert len(data) % 512 == 0
    parameter_block, magic = data[0], data[1]
    assert magic == 0x50
    n_points, n_analog, first, last, gap = struct.unpack_from("<5H", data, 2)
    scale, start, per_frame, rate = struct.unpack_from("<fHHf", data, 12)
    assert (n_analog, gap, per_frame) == (0, 0, 0)
    assert scale < 0  # floating point
    parameters = _parameters(data, (parameter_block - 1) * 512)
    n_frames = int(parameters.get("POINT:LONG_FRAMES", last - first + 1))
    values = np.frombuffer(data, "<f4", n_frames * n_points * 4, (start - 1) * 512)
    return C3D(parameters, values.reshape(n_frames, n_points, 4), first, last, rate)


def _parameters(data: bytes, at: int) -> dict[str, Any]:
    n_blocks, processor = data[at + 2], data[at + 3]
    assert processor == 84
    end = at + 512 * n_blocks
    groups: dict[int, str] = {}
    found: dict[str, Any] = {}
    at += 4
    while at < end:
        length, group = struct.unpack_from("<bb", data, at)
        if length == 0:
            return found
        name = data[at + 2 : at + 2 + abs(length)].decode("ascii")
        place = at + 2 + abs(length)
        (step,) = struct.unpack_from("<h", data, place)
        if group < 0:
            groups[-group] = name
        else:
            found[f"{groups[group]}:{name}"] = _value(data, place + 2)
        if step == 0:
            return found
        at = place + step
    raise AssertionError("the parameters have no end")


def _value(data: bytes, at: int) -> Any:
    kind, n_sizes = struct.unpack_from("<bB", data, at)
    sizes = list(data[at + 2 : at + 2 + n_sizes])
    at += 2 + n_sizes
    count = int(np.prod(sizes)) if sizes else 1
    if kind == -1:
        text = data[at : at + count].decode("ascii")
        width = sizes[0]
        return [text[i : i + width].strip() for i in range(0, count, width)]
    codes = {1: "b", 2: "H", 4: "f"}
    values = struct.unpack_from(f"<{count}{codes[kind]}", data, at)
    return list(values) if sizes else values[0]
