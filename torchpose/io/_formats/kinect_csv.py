"""Read tables of 3D joints: Kinect v1 and v2 rows without a header, and any joint set with one."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose._core.reading import read_text
from torchpose._core.wording import first_of
from torchpose.errors import FileFormatError, SkeletonError
from torchpose.io._formats.raw_recording import (
    LEVEL_WEIGHTS,
    SENSOR_WEIGHTS,
    BodyFrame,
    RawRecording,
    frame_ranges,
    join_bodies,
)
from torchpose.io._formats.table_rows import (
    FASTEST,
    KINECT_FPS,
    KINECT_TICK,
    frame_rate,
    is_time,
    split_row,
    split_rows,
    stamp_of,
)
from torchpose.skeleton._joint_sets import SKELETONS, canonical_name

_GAP = 1.5  # median steps
_SHOWN = 3  # cells that a message lists
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
        return _read_with_header(path, rows, facts)
    if rows and not is_row(rows[0][1]):
        raise FileFormatError(
            f"{path}, line {rows[0][0]}: expected numbers, or a header with NAME_x, NAME_y and NAME_z of "
            "each joint (SpineBase_x, left_hand_x) above them, and a row for each frame, got "
            f"{first_of(split_row(rows[0][1]), _SHOWN):.120}"
        )
    return [_read_rows(path, rows, facts)]


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


def dropped_frames(stamps: np.ndarray, by: str = "time stamps") -> list[str]:
    """Return a note on frames that the sensor left out, by steps of more than 1.5 times the median one."""
    steps = np.diff(stamps)
    if not len(steps):
        return []
    ratio = steps / np.median(steps)
    after = np.flatnonzero(ratio > _GAP)
    if not len(after):
        return []
    count = int(np.round(ratio[after] - 1).sum())
    return [
        f"frames that are not in the file, by its {by}: {count}, after "
        f"{frame_ranges(after.tolist())}"
    ]


# --- without a header -----------------------------------------------------------------------------


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
        path, joints, names, _stated_rate(path, facts, fps), facts.get("axes", "kinect"),
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


# --- with a header --------------------------------------------------------------------------------


def _number(cell: str) -> float:
    """Return the number of a cell, NaN if it is empty; words of tracking states have one."""
    try:
        return float(cell or math.nan)
    except ValueError:
        if cell.lower() not in _STATES:
            raise
        return _STATES[cell.lower()]


def _read_with_header(
    path: Path, rows: list[tuple[int, str]], facts: dict[str, str]
) -> list[RawRecording]:
    columns = header_joints(rows[0][1])
    # "Time (s)" is time_s
    header = [re.sub(r"\W+", "_", cell).strip("_").lower() for cell in split_row(rows[0][1])]
    for joint, places in columns.items():
        if not {"x", "y", "z"} <= set(places):
            raise FileFormatError(
                f"{path}: joint {joint} has the columns {', '.join(sorted(places))}; expected x, y, z"
            )
    cells = split_rows(path, rows[1:], len(header))
    names = tuple(columns)
    numbers = _to_numbers(path, cells, sorted({c for j in columns.values() for c in j.values()}))
    joints = np.stack([numbers[:, [columns[n][axis] for axis in "xyz"]] for n in names], 1)
    weights = _column_weights(path, numbers, columns)
    notes: list[str] = []
    time = next((column for column, name in enumerate(header) if is_time(name)), None)
    frame = header.index("frame") if "frame" in header else None
    fps = None
    if time is not None:
        stamps = np.unique(_to_numbers(path, cells, [time], stamp_of)[:, time])
        fps, note = frame_rate(np.diff(stamps))
        notes += [note, *dropped_frames(stamps)] if note else []
    elif frame is not None:
        notes += dropped_frames(np.unique(_to_numbers(path, cells, [frame])[:, frame]), "numbers")
    known = {c for j in columns.values() for c in j.values()} | {time, frame}
    known |= {header.index(name) for name in (*_BODIES, *_PERSONS) if name in header}
    unused = [header[c] for c in range(len(header)) if c not in known]
    if unused:
        notes.append(f"columns not used: {', '.join(unused[:6])}{' ...' * (len(unused) > 6)}")
    common: dict[str, Any] = {
        "axes": facts.get("axes"), "action": facts.get("action", path.stem),
        "source": facts.get("source", ""), "notes": tuple(notes),
        "person": facts.get("person", _only_person(path, header, cells)),
    }  # fmt: skip
    fps = _stated_rate(path, facts, fps)
    body = next((header.index(name) for name in _BODIES if name in header), None)
    clock = frame if frame is not None else time
    if body is None:
        if clock is not None:
            _check_increase(path, header[clock], cells, clock)
        return [RawRecording(path, joints, names, fps, weights=weights, **common)]
    if clock is None:
        raise FileFormatError(
            f"{path}: a table with a column {header[body]!r} needs a column 'frame' or 'time'"
        )
    _, index = np.unique(_to_numbers(path, cells, [clock], stamp_of)[:, clock], return_inverse=True)
    frames = [
        BodyFrame(int(t), cells[i][1][body], joints[i], None if weights is None else weights[i])
        for i, t in enumerate(index.tolist())
    ]
    return join_bodies(path, frames, int(index.max(initial=-1)) + 1, names, fps, **common)


def _to_numbers(
    path: Path,
    rows: list[tuple[int, list[str]]],
    columns: list[int],
    number_of: Callable[[str], float] = _number,
) -> np.ndarray:
    """Return the columns as numbers [T, width], NaN for empty cells and for columns not asked for."""
    table = np.full((len(rows), len(rows[0][1]) if rows else max(columns) + 1), np.nan)
    for (number, row), values in zip(rows, table, strict=True):
        try:
            values[columns] = [number_of(row[c]) for c in columns]
        except ValueError as error:
            raise FileFormatError(f"{path}, line {number}: expected numbers ({error})") from error
    return table


def _check_increase(path: Path, clock: str, rows: list[tuple[int, list[str]]], column: int) -> None:
    """Raise unless the frames or times of rows of one body increase."""
    stamps = _to_numbers(path, rows, [column], stamp_of)[:, column]
    for row in np.flatnonzero(np.diff(stamps) <= 0)[:1] + 1:
        number, cells = rows[row]
        raise FileFormatError(
            f"{path}, line {number}: the {clock} must increase, got {cells[column]} after "
            f"{rows[row - 1][1][column]}; of several bodies, call the column that tells them apart body_id "
            f"({', '.join(_BODIES)}), and of several takes, write a file for each"
        )


def _column_weights(
    path: Path, numbers: np.ndarray, columns: dict[str, dict[str, int]]
) -> np.ndarray | None:
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


def _only_person(path: Path, header: list[str], rows: list[tuple[int, list[str]]]) -> str:
    column = next((header.index(name) for name in _PERSONS if name in header), None)
    if column is None:
        return ""
    found = sorted({row[column] for _, row in rows})
    if len(found) > 1:
        raise FileFormatError(
            f"{path}: holds several persons ({', '.join(found[:4])}); write one file for each"
        )
    return found[0] if found else ""


def _fact(line: str) -> tuple[str, str]:
    key, _, value = line.lstrip().lstrip("#").partition("=")
    return key.strip().lower(), value.strip()


def _stated_rate(path: Path, facts: dict[str, str], otherwise: float | None) -> float | None:
    if "fps" not in facts:
        return otherwise
    try:
        fps = float(facts["fps"])
    except ValueError:
        fps = math.nan
    if not 0 < fps < math.inf:
        raise FileFormatError(f"{path}: fps must be one positive number, got {facts['fps']!r}")
    return fps


def _is_joint(name: str) -> bool:
    try:
        canonical_name(name)
    except SkeletonError:
        return False
    return True
