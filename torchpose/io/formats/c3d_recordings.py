"""Points of C3D files that are named as joints, read by the library c3d."""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose.errors import FileFormatError, MissingDependencyError, SkeletonError
from torchpose.io.formats.raw_recording import RawRecording
from torchpose.io.formats.units import unit_from_text
from torchpose.skeleton.joint_sets import canonical_name

__all__ = ["C3DPoints", "read_c3d", "read_c3d_points"]


class C3DPoints(NamedTuple):
    """Points of a file: their labels, [T, N, 3] as written, frames per second, unit, axis up."""

    labels: list[str]
    points: np.ndarray
    rate: float
    unit: str
    up: str


_UP = {"+Z": "z-up", "+Y": "y-up"}


def read_c3d(path: Path) -> list[RawRecording]:
    """Read the points whose labels are names of joints; others are left out, and named.

    A prefix up to a colon is dropped (``subject:LElbow``). Points with a residual of -1 are missing.
    The unit is POINT:UNITS; axes follow from POINT:Y_SCREEN, the axis that points up on a screen.

    Raises:
        MissingDependencyError: c3d is not installed. SkeletonError: no point is named as a joint.
        FileFormatError: damaged or truncated.
    """
    found = read_c3d_points(path)
    columns = _joint_columns(path, found.labels)
    joints = found.points[:, list(columns.values())]
    unused = [label.strip() for i, label in enumerate(found.labels) if i not in columns.values()]
    notes = [f"points not used: {', '.join(unused[:8])}{' ...' * (len(unused) > 8)}"] * bool(unused)
    return [
        RawRecording(
            path, joints, tuple(columns), found.rate if found.rate > 0 else None,
            _UP.get(found.up.upper()), unit_from_text(found.unit), action=path.stem, notes=tuple(notes),
        )
    ]  # fmt: skip


def read_c3d_points(path: Path) -> C3DPoints:
    """Read every point of a file, whatever it is called; NaN where the residual is -1.

    Raises:
        MissingDependencyError: c3d is not installed. FileFormatError: damaged or truncated.
    """
    try:
        import c3d
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading C3D files needs c3d; run `python -m pip install c3d`"
        ) from error
    try:
        with path.open("rb") as stream, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            reader = c3d.Reader(stream)
            labels = [str(label) for label in reader.point_labels][: reader.point_used]
            frames = [points for _, points, _ in reader.read_frames()]
            expected, rate = reader.frame_count, float(reader.point_rate)
            unit = _text(reader, "POINT:UNITS")
            up = _text(reader, "POINT:Y_SCREEN")
    except Exception as error:  # a damaged file makes the library raise anything, even NameError
        raise FileFormatError(
            f"{path}: expected a C3D file; it is damaged or of another kind ({error})"
        ) from error
    if len(frames) < expected or any("end of file" in str(note.message) for note in said):
        raise FileFormatError(f"{path}: expected {expected} frames, ends in frame {len(frames)}")
    points = np.array(frames).reshape(-1, len(labels), 5)
    placed = np.where(points[..., 3:4] < 0, np.nan, points[..., :3]).astype(np.float64)
    return C3DPoints(labels, placed, rate, unit, up)


def _text(reader: Any, key: str) -> str:
    parameter = reader.get(key)
    return "" if parameter is None else str(parameter.string_value).strip("\0 ")


def _joint_columns(path: Path, labels: list[str]) -> dict[str, int]:
    """Return the columns by the name of their joint, without those that are none."""
    columns: dict[str, int] = {}
    for column, label in enumerate(labels):
        name = re.sub(r"^.*:", "", label).strip()
        try:
            canonical_name(name)
        except SkeletonError:
            continue
        columns.setdefault(name, column)
    if not columns:
        shown = ", ".join(label.strip() for label in labels[:20]) or "none"
        raise SkeletonError(
            f"{path}: expected points that are named as joints (LElbow, head, ...), got {shown}; "
            "markers on the skin are no joints: export the joint centres of your software"
        )
    return columns
