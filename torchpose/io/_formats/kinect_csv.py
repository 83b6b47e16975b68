"""Read tables of 3D joints: Kinect v1 and v2 rows without a header, and any joint set with one."""

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose._core.reading import read_text
from torchpose.errors import FileFormatError, SkeletonError
from torchpose.io._formats.raw_recording import (
    SENSOR_WEIGHTS,
    BodyFrame,
    RawRecording,
    frame_ranges,
    join_bodies,
)
from torchpose.skeleton._joint_sets import SKELETONS, canonical_name

KINECT_FPS = 30.0
_KINECT_TICK = 1e-7  # Kinect v2's time stamps count 100 ns
_TICKS = {
    1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", _KINECT_TICK: "100 ns",
    1e-9: "nanoseconds",
}  # fmt: skip
_GAP = 1.5  # median steps
_RATES = (4.0, 250.0)  # frames per second that a recording may have
_COLUMN = re.compile(
    r"(?P<joint>.*?[a-z0-9])[ _.:/-]*(?P<what>x|y|z|state|tracking_?state|confidence)",
    re.IGNORECASE,
)
_TIMES = ("time", "time_s", "time_ms", "time_us", "timestamp", "timestamp_usec", "timestamp_ms")
_BODIES = ("body", "body_id", "bodyid", "skeleton_id", "tracking_id", "trackingid", "user")
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
    columns are `NAME_x`, `NAME_y`, `NAME_z` and optionally `NAME_state` (0, 1, 2) or
    `NAME_confidence` (0 to 1) of each joint, and optionally time, frame, body, and person. Lines with
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
    return [_read_rows(path, rows, facts)]


def split_row(line: str) -> list[str]:
    """Return the cells of a row, at semicolons, tabs or commas, else at blanks.

    Between semicolons or tabs a comma is the decimal mark.
    """
    line = line.strip()
    for mark in (";", "\t", ","):
        if mark in line:
            line = line.removesuffix(mark)
            line = line if mark == "," else re.sub(r"(?<=\d),(?=\d)", ".", line)
            return [cell.strip() for cell in line.split(mark)]
    return line.split()


def header_joints(line: str) -> dict[str, dict[str, int]]:
    """Return the columns by joint and by what they hold; empty unless a joint has x, y and z."""
    found: dict[str, dict[str, int]] = {}
    for column, cell in enumerate(split_row(line)):
        match = _COLUMN.fullmatch(cell.strip().strip('"'))
        if match is None or not _is_joint(match["joint"]):
            continue
        what = match["what"].lower().replace("tracking_", "").replace("tracking", "")
        found.setdefault(match["joint"], {})[what] = column
    return found if any({"x", "y", "z"} <= set(joint) for joint in found.values()) else {}


def frame_rate(stamps: np.ndarray) -> tuple[float | None, str]:
    """Return the frames per second by the median step of the stamps, and what they were taken for.

    Of seconds, milliseconds, microseconds, 100 ns and nanoseconds, the one that comes nearest to 30
    frames per second; None for steps that are none of them, such as numbers of frames.
    """
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not len(steps):
        return None, ""
    rates = {name: 1 / (tick * float(np.median(steps))) for tick, name in _TICKS.items()}
    name = min(rates, key=lambda name: abs(math.log(rates[name] / KINECT_FPS)))
    if not _RATES[0] <= rates[name] <= _RATES[1]:
        return None, ""
    return rates[name], f"time stamps taken for {name}: {rates[name]:.3g} frames per second"


def dropped_frames(stamps: np.ndarray) -> list[str]:
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
        f"{count} frames are not in the file, by its time stamps: after {frame_ranges(after.tolist())}"
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
    if stamps is not None and layout == ROW_LENGTHS[101]:
        steps = np.diff(stamps) * _KINECT_TICK
        fps = float(1 / np.median(steps)) if len(steps) else None
        notes += dropped_frames(stamps)
    elif stamps is not None:
        found, note = frame_rate(stamps)
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
            row = [float(value) if value else math.nan for value in split_row(line)]
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
                f"{path}, line {number}: time stamps must increase, got {row[0]:.0f} after "
                f"{table[-1][0]:.0f}"
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
    cells = _cells(path, rows[1:], len(header))
    names = tuple(columns)
    numbers = _to_numbers(
        path, rows[1:], cells, sorted({c for j in columns.values() for c in j.values()})
    )
    joints = np.stack([numbers[:, [columns[n][axis] for axis in "xyz"]] for n in names], 1)
    weights = _column_weights(path, numbers, columns)
    notes: list[str] = []
    time = next((header.index(name) for name in _TIMES if name in header), None)
    frame = header.index("frame") if "frame" in header else None
    fps = None
    if time is not None:
        stamps = np.unique(_to_numbers(path, rows[1:], cells, [time])[:, time])
        fps, note = frame_rate(stamps)
        notes += [note, *dropped_frames(stamps)] if note else []
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
    if body is None:
        return [RawRecording(path, joints, names, fps, weights=weights, **common)]
    clock = frame if frame is not None else time
    if clock is None:
        raise FileFormatError(
            f"{path}: a table with a column {header[body]!r} needs a column 'frame' or 'time'"
        )
    _, index = np.unique(_to_numbers(path, rows[1:], cells, [clock])[:, clock], return_inverse=True)
    frames = [
        BodyFrame(int(t), cells[i][body], joints[i], None if weights is None else weights[i])
        for i, t in enumerate(index.tolist())
    ]
    return join_bodies(path, frames, int(index.max(initial=-1)) + 1, names, fps, **common)


def _cells(path: Path, rows: list[tuple[int, str]], width: int) -> list[list[str]]:
    cells = []
    for number, line in rows:
        row = split_row(line)
        row += [""] * (width - len(row) if line.strip().endswith((",", ";", "\t")) else 0)
        if len(row) != width:
            raise FileFormatError(
                f"{path}, line {number}: expected {width} cells as in the header, got {len(row)}"
            )
        cells.append(row)
    return cells


def _to_numbers(
    path: Path, rows: list[tuple[int, str]], cells: list[list[str]], columns: list[int]
) -> np.ndarray:
    """Return the columns as numbers [T, width], NaN for empty cells and for columns not asked for."""
    table = np.full((len(cells), len(cells[0]) if cells else max(columns) + 1), np.nan)
    for (number, _), row, values in zip(rows, cells, table, strict=True):
        try:
            values[columns] = [float(row[c]) if row[c] else math.nan for c in columns]
        except ValueError as error:
            raise FileFormatError(f"{path}, line {number}: expected numbers ({error})") from error
    return table


def _column_weights(
    path: Path, numbers: np.ndarray, columns: dict[str, dict[str, int]]
) -> np.ndarray | None:
    if not any({"state", "confidence"} & set(places) for places in columns.values()):
        return None
    weights = np.ones((len(numbers), len(columns)))
    for j, (joint, places) in enumerate(columns.items()):
        if "confidence" in places:
            weights[:, j] = np.nan_to_num(numbers[:, places["confidence"]])
        elif "state" in places:
            states = np.nan_to_num(numbers[:, places["state"]])
            if not set(np.unique(states)) <= {0.0, 1.0, 2.0}:
                raise FileFormatError(f"{path}: tracking states of {joint} must be 0, 1 or 2")
            weights[:, j] = np.array(SENSOR_WEIGHTS)[states.astype(int)]
    return weights


def _only_person(path: Path, header: list[str], cells: list[list[str]]) -> str:
    column = next((header.index(name) for name in _PERSONS if name in header), None)
    if column is None:
        return ""
    found = sorted({row[column] for row in cells})
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
