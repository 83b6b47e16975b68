"""Write joints as points of a C3D file, with their uncertainty as residuals.

A file is a sequence of blocks of 512 bytes: a header, parameters in named groups, and the points of each
frame as four 32-bit floats x, y, z, and residual. Numbers are little-endian ("Intel").
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.checks import check_rate, check_shape
from torchpose._core.files import atomic_path
from torchpose.errors import InputError

_BLOCK = 512
_MILLIMETRES = 1000.0
_LARGEST_RESIDUAL = 255  # millimetres: a byte
_LARGEST_COUNT = 65535  # of frames, in the fields of 16 bits
_MOST_POINTS = 255  # a dimension of a parameter is a byte
_INTEL = 84
_MISSING = -1.0


def write_c3d(
    path: str | Path,
    joints: Float[Tensor, "T J 3"],
    names: Sequence[str],
    fps: float,
    *,
    std: Float[Tensor, "T J"] | None = None,
    y_up: bool = False,
    first_frame: int = 0,
) -> None:
    """Write points in millimetres as ``.c3d``; the file appears whole or not at all.

    The residual of a point is its standard deviation in whole millimetres, from 1 to 255. Points that are
    NaN have the residual -1, which marks missing ones. Frames are counted from 1.

    Args:
        path: the file, which is replaced. joints: metres, in the axes of the file.
        names: of the J points. fps: frames per second. std: metres; without it residuals are 0.
        y_up: whether y points up; then POINT:X_SCREEN and Y_SCREEN say so.
        first_frame: number of the first frame in the recording, counted from 0.

    Raises:
        ShapeError: other joints or std. InputError: no frame, more than 255 points, a rate that is not
            positive. OutputError: it cannot be written.
    """
    check_shape("joints", joints, [None, len(names), 3])
    check_rate("fps", fps)
    if not len(joints) or not 0 < len(names) <= _MOST_POINTS:
        raise InputError(
            f"a C3D file holds frames of 1 to {_MOST_POINTS} points, got {list(joints.shape)}"
        )
    points = _points(joints, std)
    first, last = first_frame + 1, first_frame + len(joints)
    start = 2 + _n_blocks(_parameters(names, fps, first, last, y_up, 0))
    parameters = _parameters(names, fps, first, last, y_up, start)
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header(len(names), first, last, start, fps))
        stream.write(_filled(parameters))
        stream.write(_filled(points.tobytes()))


def _points(joints: Tensor, std: Tensor | None) -> NDArray[np.float32]:
    """Return x, y, z and residual [T, J, 4]."""
    points = np.zeros((*joints.shape[:2], 4), dtype="<f4")
    places = joints.detach().cpu().double().numpy() * _MILLIMETRES
    missing = np.asarray(~np.isfinite(places).all(-1))
    points[..., :3] = np.where(missing[..., None], 0.0, places)
    if std is not None:
        check_shape("std", std, list(joints.shape[:2]))
        spread = np.rint(std.detach().cpu().double().numpy() * _MILLIMETRES)
        points[..., 3] = np.nan_to_num(spread, nan=_LARGEST_RESIDUAL).clip(1, _LARGEST_RESIDUAL)
    points[missing, 3] = _MISSING
    return points


def _header(n_points: int, first: int, last: int, start: int, fps: float) -> bytes:
    """Return the first block."""
    counts = (n_points, 0, min(first, _LARGEST_COUNT), min(last, _LARGEST_COUNT), 0)
    return struct.pack("<BB5HfHHf", 2, 0x50, *counts, -1.0, start, 0, fps).ljust(_BLOCK, b"\0")


def _parameters(
    names: Sequence[str], fps: float, first: int, last: int, y_up: bool, start: int
) -> bytes:
    """Return the section of the parameters; `start` is the block with which the points begin."""
    n_frames = last - first + 1
    point = [
        _integers("USED", [len(names)]),
        _integers("FRAMES", [min(n_frames, _LARGEST_COUNT)]),
        _integers("DATA_START", [start]),
        _number("SCALE", -1.0),
        _number("RATE", fps),
        _texts("UNITS", ["mm"]),
        _texts("LABELS", names),
        _texts("DESCRIPTIONS", names),
        _number("LONG_FRAMES", float(n_frames)),
    ]
    if y_up:
        point += [_texts("X_SCREEN", ["+X"]), _texts("Y_SCREEN", ["+Y"])]
    trial = [
        _integers("ACTUAL_START_FIELD", _two_words(first)),
        _integers("ACTUAL_END_FIELD", _two_words(last)),
        _number("CAMERA_RATE", fps),
    ]
    analog = [_integers("USED", [0]), _number("GEN_SCALE", 1.0)]
    groups = {"POINT": point, "ANALOG": analog, "TRIAL": trial}
    records = b"".join(
        _record(name, -number, b"\0") + b"".join(_record(key, number, body) for key, body in group)
        for number, (name, group) in enumerate(groups.items(), start=1)
    )
    body = records + b"\0\0"
    return struct.pack("<BBBB", 1, 0x50, _n_blocks(b"\0" * 4 + body), _INTEL) + body


def _record(name: str, group: int, body: bytes) -> bytes:
    """Return a group or parameter: its name, the distance to the next one, and what it holds."""
    text = name.encode("ascii")
    return struct.pack("<bb", len(text), group) + text + struct.pack("<h", 2 + len(body)) + body


def _integers(name: str, values: Sequence[int]) -> tuple[str, bytes]:
    sizes = struct.pack("<bB", 2, 0) if len(values) == 1 else struct.pack("<bBB", 2, 1, len(values))
    return name, sizes + struct.pack(f"<{len(values)}H", *values) + b"\0"


def _number(name: str, value: float) -> tuple[str, bytes]:
    return name, struct.pack("<bBf", 4, 0, value) + b"\0"


def _texts(name: str, values: Sequence[str]) -> tuple[str, bytes]:
    """Return words, padded to the length of the longest."""
    words = [value.encode("ascii", "replace") for value in values]
    width = max(map(len, words))
    sizes = [width] if len(words) == 1 else [width, len(words)]
    text = b"".join(word.ljust(width) for word in words)
    return name, struct.pack(f"<bB{len(sizes)}B", -1, len(sizes), *sizes) + text + b"\0"


def _two_words(count: int) -> list[int]:
    return [count & 0xFFFF, count >> 16]


def _n_blocks(data: bytes) -> int:
    return -(-len(data) // _BLOCK)


def _filled(data: bytes) -> bytes:
    return data.ljust(_n_blocks(data) * _BLOCK, b"\0")
