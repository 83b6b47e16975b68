"""The common form of a recording, .npz, and the authors' OpenCV matrix, .yaml."""

import re
from pathlib import Path

import numpy as np

from torchpose._core.fields import one_number, one_text, texts
from torchpose._core.npz import read_npz
from torchpose._core.reading import read_text, reading
from torchpose.errors import FileFormatError
from torchpose.io.formats.raw_recording import RawRecording, numbers
from torchpose.skeleton.joint_sets import UPPER_BODY

__all__ = ["read_npz_recording", "read_opencv_recording"]

_COLUMNS = 3 * len(UPPER_BODY)
_KINDS = {
    "u": "u1",
    "c": "i1",
    "w": "u2",
    "s": "i2",
    "i": "i4",
    "f": "f4",
    "d": "f8",
}  # of one channel
_DIGITS = 9  # of the number of rows
# A matrix as OpenCV writes it. Its own parser is not used: it overflows its stack on nested brackets.
_MATRIX = re.compile(
    r"!!opencv-matrix\s+rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\"?(\w+)\"?\s+data:\s*\[([^\[\]]*)\]"
)


def read_npz_recording(path: Path) -> list[RawRecording]:
    """Read `joints` [T, J, 3], `names` [J] and what else a common ``.npz`` may hold."""
    arrays = read_npz(
        path,
        required=("joints", "names"),
        optional=("fps", "subject", "action", "source", "axes", "weights"),
    )
    joints = numbers(f"{path}: joints", arrays["joints"])
    names = texts(path, "names", arrays["names"])
    weights = arrays.get("weights")
    text = {key: one_text(path, key, arrays[key]) if key in arrays else ""
            for key in ("subject", "action", "source", "axes")}  # fmt: skip
    fps = one_number(path, "fps", arrays["fps"]) if "fps" in arrays else None
    return [
        RawRecording(
            path, joints, names, fps, text["axes"] or None, person=text["subject"],
            action=text["action"], source=text["source"],
            weights=None if weights is None else numbers(f"{path}: weights", weights),
        )
    ]  # fmt: skip


def read_opencv_recording(path: Path) -> list[RawRecording]:
    """Read the authors' matrix of T x 24: the eight joints of the upper body in their order.

    Raises:
        FileFormatError: not one such matrix in OpenCV's YAML.
    """
    expected = f"an OpenCV FileStorage with one matrix of T x {_COLUMNS}"
    text = read_text(path, expected)
    found = [match.groups() for match in _MATRIX.finditer(text)]
    shapes = [(rows, columns) for rows, columns, _, _ in found]
    if len(found) != 1 or shapes[0][1] != str(_COLUMNS):
        raise FileFormatError(f"{path}: expected {expected}, got matrices of {shapes}")
    rows, _, kind, data = found[0]
    with reading(path, expected):
        cells = [cell.strip().lower().replace(".nan", "nan").replace(".inf", "inf")
                 for cell in data.split(",")]  # fmt: skip
        values = np.array([float(cell) for cell in cells if cell])
    if kind not in _KINDS or str(len(values)) != str(_COLUMNS * int(rows[:_DIGITS])):
        raise FileFormatError(
            f"{path}: expected {expected} of numbers, got {len(values)} of the kind {kind!r} for "
            f"{rows} rows"
        )
    with np.errstate(over="ignore"):  # what does not fit is infinite, and refused as that
        kept = values.astype(_KINDS[kind]).astype(np.float64)
    joints = kept.reshape(-1, len(UPPER_BODY), 3)
    # the source states no rate; Kinect v1 records 30 frames per second
    return [RawRecording(path, joints, UPPER_BODY, 30.0, "camera")]
