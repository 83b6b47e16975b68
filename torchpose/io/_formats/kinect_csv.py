"""Read tables of 3D joints, and Kinect v1 and v2 rows, which have no header."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchpose._core.reading import read_text
from torchpose._core.wording import first_of
from torchpose.errors import FileFormatError
from torchpose.io._formats.joint_tables import header_joints, read_joint_table
from torchpose.io._formats.raw_recording import SENSOR_WEIGHTS, RawRecording
from torchpose.io._formats.table_rows import (
    FASTEST,
    KINECT_FPS,
    KINECT_TICK,
    dropped_frames,
    frame_rate,
    split_row,
    stamp_of,
    stated_rate,
)
from torchpose.skeleton._joint_sets import SKELETONS

_SHOWN = 3  # cells that a message lists


class _Layout(NamedTuple):
    """Describes the layout of a row without a header."""

    skeleton: str
    numbers: int  # of each joint: x, y, z, and a state with four
    stamped: bool


ROW_LENGTHS = {
    stamped + numbers * len(SKELETONS[name].joints): _Layout(name, numbers, bool(stamped))
    for name in ("kinect-v1-20", "kinect-v2-25")
    for numbers in (3, 4)
    for stamped in (0, 1)
}
"""Layouts of rows by their length: the joints of Kinect v1 or v2 in the order of the SDK."""


def read_kinect_csv(path: Path) -> list[RawRecording]:
    """Read a table with one row per frame, or one per frame and body.

    Without a header, the length of the rows says what they hold (`ROW_LENGTHS`). With one, the
    columns are `NAME_x`, `NAME_y`, `NAME_z` and optionally `NAME_state` (0, 1, 2, or Kinect's words) or
    `NAME_confidence` (0 to 1, or Azure's levels) of each joint, and optionally time, frame, body, and
    person. Lines with
    ``#`` above may say `fps`, `axes`, `person`, `action` and `source`, as ``# fps = 30``.

    Raises:
        FileFormatError: another layout, a row of another length, time that does not increase.
    """
    lines = read_text(path, "rows of numbers").splitlines()
    rows = [(i, line) for i, line in enumerate(lines, start=1) if line.strip()]
    facts = dict(_fact(line) for _, line in rows if line.lstrip().startswith("#"))
    rows = [(i, line) for i, line in rows if not line.lstrip().startswith("#")]
    if rows and header_joints(rows[0][1]):
        return read_joint_table(path, rows, facts)
    if rows and not is_row(rows[0][1]):
        raise FileFormatError(
            f"{path}, line {rows[0][0]}: expected numbers, or a header with NAME_x, NAME_y and NAME_z of "
            "each joint (SpineBase_x, left_hand_x) above them, and a row for each frame, got "
            f"{first_of(split_row(rows[0][1]), _SHOWN):.120}"
        )
    return [_read_rows(path, rows, facts)]


def is_row(line: str) -> bool:
    """Return whether a line holds numbers, the first of which may be a time stamp."""
    try:
        _numbers_of(line)
    except ValueError:
        return False
    return True


def _numbers_of(line: str) -> list[float]:
    """Return the numbers of a row, NaN where a cell is empty; `ValueError` if it holds something else."""
    first, *others = split_row(line)
    return [stamp_of(first), *(float(cell or math.nan) for cell in others)]


def _read_rows(path: Path, rows: list[tuple[int, str]], facts: dict[str, str]) -> RawRecording:
    layout = _layout(path, rows)
    names = SKELETONS[layout.skeleton].joints
    table = _table(path, rows, layout)
    stamps, values = (table[:, 0], table[:, 1:]) if layout.stamped else (None, table)
    values = values.reshape(-1, len(names), layout.numbers)
    notes: list[str] = []
    weights = None
    if layout.numbers == 4:
        weights = _state_weights(values[..., 3], layout, notes)
    fps: float | None = KINECT_FPS
    if stamps is not None and layout == ROW_LENGTHS[101] and _are_ticks(stamps):
        steps = np.diff(stamps) * KINECT_TICK
        fps = float(1 / np.median(steps)) if len(steps) else None
        notes += dropped_frames(stamps)
    elif stamps is not None:
        found, note = frame_rate(np.diff(stamps))
        fps = found or KINECT_FPS
        notes.append(note or "30 frames per second assumed: the first column holds no times")
    joints = values[..., :3]
    if weights is not None:
        joints = np.where(weights[..., None] > 0, joints, np.nan)
    return RawRecording(
        path, joints, names, stated_rate(path, facts, fps), facts.get("axes", "kinect"),
        person=facts.get("person", ""), action=facts.get("action", path.stem),
        source=facts.get("source", ""), weights=weights, notes=tuple(notes),
    )  # fmt: skip


def _are_ticks(stamps: np.ndarray) -> bool:
    """Return whether time stamps may count 100 ns, as Kinect's own do."""
    return len(stamps) < 2 or KINECT_TICK * float(np.median(np.diff(stamps))) >= 1 / FASTEST


def _layout(path: Path, rows: list[tuple[int, str]]) -> _Layout:
    if not rows:
        return ROW_LENGTHS[101]
    number, line = rows[0]
    cells = split_row(line)
    layout = ROW_LENGTHS.get(len(cells))
    if layout is None:
        raise FileFormatError(
            f"{path}, line {number}: expected a header with NAME_x, NAME_y, NAME_z of each joint, or "
            "rows of 60, 61, 80 or 81 numbers (Kinect v1: 20 joints, x, y, z, with or without a "
            f"state, and a time) or 75, 76, 100 or 101 (Kinect v2: 25 joints); got {len(cells)} cells"
        )
    return layout


def _table(path: Path, rows: list[tuple[int, str]], layout: _Layout) -> np.ndarray:
    names = SKELETONS[layout.skeleton].joints
    width = layout.stamped + layout.numbers * len(names)
    table: list[list[float]] = []
    for number, line in rows:
        try:
            row = _numbers_of(line)
        except ValueError as error:
            raise FileFormatError(
                f"{path}, line {number}: expected numbers, or a header with NAME_x, NAME_y and NAME_z of "
                f"each joint above them ({error})"
            ) from error
        if len(row) != width:
            raise FileFormatError(
                f"{path}, line {number}: expected {width} numbers "
                f"({'time stamp, then ' if layout.stamped else ''}{layout.numbers} of each of "
                f"{len(names)} joints), got {len(row)}"
            )
        if layout == ROW_LENGTHS[101] and not set(row[4::4]) <= {0.0, 1.0, 2.0}:
            raise FileFormatError(f"{path}, line {number}: tracking states must be 0, 1 or 2")
        if layout.stamped and table and row[0] <= table[-1][0]:
            raise FileFormatError(
                f"{path}, line {number}: time stamps must increase, got {row[0]:.15g} after "
                f"{table[-1][0]:.15g}"
            )
        table.append(row)
    return np.array(table).reshape(-1, width)


def _state_weights(states: np.ndarray, layout: _Layout, notes: list[str]) -> np.ndarray | None:
    """Return the weights of the fourth number of each joint, or None where it is no state."""
    found = set(np.unique(states).tolist())
    if found <= {0.0, 1.0, 2.0} and (2.0 in found or layout.skeleton == "kinect-v2-25"):
        return np.array(SENSOR_WEIGHTS)[states.astype(int)]
    if found <= {0.0, 1.0} and 1.0 in found:
        return states
    notes.append("the fourth number of each joint is no tracking state and is not used")
    return None


def _fact(line: str) -> tuple[str, str]:
    key, _, value = line.lstrip().lstrip("#").partition("=")
    return key.strip().lower(), value.strip()
