"""Read tables of 3D joints with a header, of any joint set."""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose.errors import FileFormatError, SkeletonError
from torchpose.io._formats.raw_recording import (
    LEVEL_WEIGHTS,
    SENSOR_WEIGHTS,
    BodyFrame,
    RawRecording,
    join_bodies,
)
from torchpose.io._formats.table_rows import (
    dropped_frames,
    frame_rate,
    is_time,
    split_row,
    split_rows,
    stamp_of,
    stated_rate,
)
from torchpose.skeleton._joint_sets import canonical_name

_WHAT = r"(?P<what>x|y|z|state|tracking_?state|confidence)"
_UNIT = r"( *[\[(](m|cm|mm)[\])])?"  # the size of the body tells the unit
_COLUMNS = (
    re.compile(rf"(?P<joint>.*?[a-z0-9])[ _.:/-]*{_WHAT}{_UNIT}", re.IGNORECASE),
    re.compile(rf"{_WHAT}[ _.:/-]+(?P<joint>.*?){_UNIT}", re.IGNORECASE),
)
_STATES = {
    "nottracked": 0.0, "inferred": 1.0, "tracked": 2.0,  # Kinect v2
    **{f"k4abt_joint_confidence_{word}": float(level)
       for level, word in enumerate(("none", "low", "medium", "high"))},
}  # fmt: skip
_BODIES = ("body", "body_id", "bodyid", "skeleton_id", "tracking_id", "trackingid", "user",
           "user_id", "userid", "player", "player_id", "playerid")  # fmt: skip
_PERSONS = ("person", "subject")


def header_joints(line: str) -> dict[str, dict[str, int]]:
    """Return the columns by joint and by what they hold; empty unless a joint has x, y and z."""
    found: dict[str, dict[str, int]] = {}
    for column, cell in enumerate(split_row(line)):
        name = cell.strip().strip('"')
        for match in filter(None, (spelling.fullmatch(name) for spelling in _COLUMNS)):
            if _is_joint(match["joint"]):
                what = match["what"].lower().replace("tracking_", "").replace("tracking", "")
                found.setdefault(match["joint"], {})[what] = column
    return found if any({"x", "y", "z"} <= set(joint) for joint in found.values()) else {}


def _number(cell: str) -> float:
    """Return the number of a cell, NaN if it is empty; words of tracking states have one."""
    try:
        return float(cell or math.nan)
    except ValueError:
        if cell.lower() not in _STATES:
            raise
        return _STATES[cell.lower()]


class _Table(NamedTuple):
    """Holds a table with a header.

    Attributes:
        path: of the file. header: names of the columns, "Time (s)" as time_s. joints: columns by joint and
            by what they hold. rows: the number of the line and the cells of each.
    """

    path: Path
    header: list[str]
    joints: dict[str, dict[str, int]]
    rows: list[tuple[int, list[str]]]

    @property
    def joint_columns(self) -> set[int]:
        """Return the columns that belong to joints."""
        return {column for places in self.joints.values() for column in places.values()}

    def column(self, names: Sequence[str]) -> int | None:
        """Return the column that has the first of these names, None without one."""
        return next((self.header.index(name) for name in names if name in self.header), None)

    def numbers(
        self, columns: Sequence[int], number_of: Callable[[str], float] = _number
    ) -> np.ndarray:
        """Return columns as numbers [T, width], NaN for empty cells and for columns not asked for."""
        table = np.full((len(self.rows), len(self.header)), np.nan)
        for (number, row), values in zip(self.rows, table, strict=True):
            try:
                values[columns] = [number_of(row[c]) for c in columns]
            except ValueError as error:
                where = f"{self.path}, line {number}"
                raise FileFormatError(f"{where}: expected numbers ({error})") from error
        return table

    def stamps(self, column: int) -> np.ndarray:
        """Return a column of frames or times, as numbers."""
        return self.numbers([column], stamp_of)[:, column]


def read_joint_table(
    path: Path, rows: list[tuple[int, str]], facts: dict[str, str]
) -> list[RawRecording]:
    """Return the recordings in a table, one for each body.

    Args:
        path: for messages. rows: lines with their numbers, the header first. facts: that the file states.

    Raises:
        FileFormatError: as `read_kinect_csv`.
    """
    table = _table_of(path, rows)
    numbers = table.numbers(sorted(table.joint_columns))
    joints = np.stack(
        [numbers[:, [places[axis] for axis in "xyz"]] for places in table.joints.values()], 1
    )
    weights = _column_weights(path, numbers, table.joints)
    time = next((column for column, name in enumerate(table.header) if is_time(name)), None)
    frame, body = table.column(["frame"]), table.column(_BODIES)
    fps, notes = _rate_of(table, time, frame)
    notes += _unused_columns(table, time, frame)
    common: dict[str, Any] = {
        "axes": facts.get("axes"), "action": facts.get("action", path.stem),
        "source": facts.get("source", ""), "notes": tuple(notes),
        "person": facts.get("person", _only_person(table)),
    }  # fmt: skip
    names, fps = tuple(table.joints), stated_rate(path, facts, fps)
    clock = frame if frame is not None else time
    if body is None:
        if clock is not None:
            _check_increase(table, clock)
        return [RawRecording(path, joints, names, fps, weights=weights, **common)]
    if clock is None:
        raise FileFormatError(
            f"{path}: a table with a column {table.header[body]!r} needs a column 'frame' or 'time'"
        )
    _, index = np.unique(table.stamps(clock), return_inverse=True)
    frames = [
        BodyFrame(int(t), cells[body], joints[i], None if weights is None else weights[i])
        for i, (t, (_, cells)) in enumerate(zip(index.tolist(), table.rows, strict=True))
    ]
    return join_bodies(path, frames, int(index.max(initial=-1)) + 1, names, fps, **common)


def _table_of(path: Path, rows: list[tuple[int, str]]) -> _Table:
    joints = header_joints(rows[0][1])
    for joint, places in joints.items():
        if not {"x", "y", "z"} <= set(places):
            raise FileFormatError(
                f"{path}: joint {joint} has the columns {', '.join(sorted(places))}; expected x, y, z"
            )
    header = [re.sub(r"\W+", "_", cell).strip("_").lower() for cell in split_row(rows[0][1])]
    used = {header[column] for places in joints.values() for column in places.values()}
    twice = sorted(name for name in used if header.count(name) > 1)
    if twice:
        raise FileFormatError(
            f"{path}: column {twice[0]} is there twice; expected each joint once, so rename one or drop it"
        )
    return _Table(path, header, joints, split_rows(path, rows[1:], len(header)))


def _rate_of(table: _Table, time: int | None, frame: int | None) -> tuple[float | None, list[str]]:
    """Return the frame rate by the times, if there are any, and notes on it and on dropped frames."""
    if time is not None:
        stamps = np.unique(table.stamps(time))
        fps, note = frame_rate(np.diff(stamps))
        return fps, [note, *dropped_frames(stamps)] if note else []
    if frame is not None:
        return None, dropped_frames(np.unique(table.numbers([frame])[:, frame]), "numbers")
    return None, []


def _unused_columns(table: _Table, *used: int | None) -> list[str]:
    """Return a note on the columns that are neither used nor of joints, bodies and persons, if any."""
    known = {table.header.index(name) for name in (*_BODIES, *_PERSONS) if name in table.header}
    known |= table.joint_columns.union(column for column in used if column is not None)
    unused = [name for column, name in enumerate(table.header) if column not in known]
    if not unused:
        return []
    return [f"columns not used: {', '.join(unused[:6])}{' ...' * (len(unused) > 6)}"]


def _check_increase(table: _Table, clock: int) -> None:
    """Raise unless the frames or times of rows of one body increase."""
    for row in np.flatnonzero(np.diff(table.stamps(clock)) <= 0)[:1] + 1:
        number, cells = table.rows[row]
        raise FileFormatError(
            f"{table.path}, line {number}: the {table.header[clock]} must increase, got {cells[clock]} after "
            f"{table.rows[row - 1][1][clock]}; of several bodies, call the column that tells them apart "
            f"body_id ({', '.join(_BODIES)}), and of several takes, write a file for each"
        )


def _column_weights(
    path: Path, numbers: np.ndarray, columns: dict[str, dict[str, int]]
) -> np.ndarray | None:
    """Return the weights [T, J] of joints by their confidences or states, None without any."""
    if not any({"state", "confidence"} & set(places) for places in columns.values()):
        return None
    weights = np.ones((len(numbers), len(columns)))
    scores = [places["confidence"] for places in columns.values() if "confidence" in places]
    found = set(np.unique(np.nan_to_num(numbers[:, scores])))
    are_levels = found <= {0.0, 1.0, 2.0, 3.0} and max(found, default=0.0) > 1
    for j, (joint, places) in enumerate(columns.items()):
        if "confidence" in places:
            confidence = np.nan_to_num(numbers[:, places["confidence"]])
            weights[:, j] = (
                np.array(LEVEL_WEIGHTS)[confidence.astype(int)] if are_levels else confidence
            )
        elif "state" in places:
            states = np.nan_to_num(numbers[:, places["state"]])
            if not set(np.unique(states)) <= {0.0, 1.0, 2.0}:
                raise FileFormatError(f"{path}: tracking states of {joint} must be 0, 1 or 2")
            weights[:, j] = np.array(SENSOR_WEIGHTS)[states.astype(int)]
    return weights


def _only_person(table: _Table) -> str:
    column = table.column(_PERSONS)
    if column is None:
        return ""
    found = sorted({cells[column] for _, cells in table.rows})
    if len(found) > 1:
        raise FileFormatError(
            f"{table.path}: holds several persons ({', '.join(found[:4])}); write one file for each"
        )
    return found[0] if found else ""


def _is_joint(name: str) -> bool:
    try:
        canonical_name(name)
    except SkeletonError:
        return False
    return True
