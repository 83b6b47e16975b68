"""Read 2D keypoints from .npz and .csv files as they are there, before any check of their values."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchpose._core.reading import (
    check_span,
    npz_keys,
    one_number,
    one_text,
    read_npz,
    read_text,
    texts,
)
from torchpose._core.wording import first_of
from torchpose.errors import FileFormatError
from torchpose.io._formats.raw_recording import numbers
from torchpose.io._formats.table_rows import (
    first_second,
    frame_rate,
    is_time,
    notes_on_uneven_times,
    split_row,
    split_rows,
    stamp_of,
    usual_step,
)
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS

_SHOWN = 3  # columns that a message lists
_TRUST = ("confidence", "visibility")  # names of it; MediaPipe's is the second
_SCORES = (*_TRUST, "score", "likelihood")  # names of it in tables
_FRAMES = ("frame", "frame_number", "frame_index", "frame_idx", "frame_id", "sync_index")
_NAMES = ("name", "keypoint", "landmark", "joint", "bodypart")
_PASSED_OVER = ("z", "presence")  # beside x and y; MediaPipe's depth is no measurement
_KINDS = ("x", "y", *_PASSED_OVER, *_SCORES)
_SPELLINGS = (  # of columns, in place of NAME_x
    re.compile(rf"(?P<name>.+?)[_.:\s-]+(?P<kind>{'|'.join(_KINDS)})", re.IGNORECASE),  # Head.X
    re.compile(rf"(?P<kind>{'|'.join(_KINDS)})[_.:\s-]+(?P<name>.+)", re.IGNORECASE),  # x_Head
    re.compile(rf"(?P<name>.*[a-z0-9])(?P<kind>{'|'.join(map(str.title, _KINDS))})"),  # HeadX
)
_DEEPLABCUT = {"scorer", "individuals", "bodyparts", "coords"}  # first cells of its header
_OF_SEVERAL_CAMERAS = {"point_id", "img_loc_x", "img_loc_y"}
_TRACKED = (
    "the keypoints are poses that were tracked before: joints that were not measured there are missing, and "
    "noise is filtered out twice; give the keypoints of the detector instead"
)
_NEGATIVE = 0.2  # share of coordinates; pixels are hardly negative
_MAX_GAP = 100_000  # frames; a larger jump of the frame number is taken for a damaged file


def is_keypoint_header(cells: Sequence[str]) -> bool:
    """Return whether the cells of a first line name frames or x and y alone, or begin DeepLabCut's header.

    Times beside names of keypoints stand for frames.
    """
    lower = {cell.lower() for cell in cells}
    if not lower.isdisjoint((*_FRAMES, "scorer")):
        return True
    if lower >= {"x", "y"} and not lower.isdisjoint(_NAMES) and any(map(is_time, cells)):
        return True
    ends = _ends(cells)
    return ends >= {"_x", "_y"} and "_z" not in ends


def _ends(cells: Sequence[str]) -> set[str]:
    """Return the last two characters of the names of columns: "_x" of NAME_x."""
    return {cell[-2:] for cell in _usual_header(cells)}


def _usual_header(cells: Sequence[str]) -> list[str]:
    """Return names of columns as NAME_x, of those that are spelt in another way and have an x and a y.

    >>> _usual_header(["frame", "HeadX", "HeadY", "HeadScore", "MaxX"])
    ['frame', 'Head_x', 'Head_y', 'Head_score', 'MaxX']
    """
    wide = not {cell.lower() for cell in cells} & {*_NAMES}
    for spelling in _SPELLINGS if wide else ():
        found = {cell: match for cell in cells if (match := spelling.fullmatch(cell))}
        parts = {cell: (match["name"], match["kind"].lower()) for cell, match in found.items()}
        points = {
            name for name, _ in parts.values() if {(name, "x"), (name, "y")} <= {*parts.values()}
        }
        if points:
            return [
                "_".join(parts[c]) if c in parts and parts[c][0] in points else c for c in cells
            ]
    return list(cells)


@dataclass
class RawKeypoints:
    """Contents of a file, before the checks."""

    keypoints: np.ndarray
    names: tuple[str, ...]
    confidence: np.ndarray | None = None
    fps: float | None = None
    K: np.ndarray | None = None
    image_size: np.ndarray | Sequence[float] | None = None
    neck: str | None = None
    n_people: np.ndarray | None = None
    first_frame: int | None = None
    notes: tuple[str, ...] = ()
    first_time: float | None = None


def read_npz_keypoints(path: Path) -> RawKeypoints:
    """Read `keypoints` [T, J, 2] and `names` [J], or MediaPipe's, and the other keys of `read_keypoints`."""
    there = npz_keys(path)
    landmarks = "keypoints" not in there and "joints2d" in there
    points, trust = ("joints2d", _TRUST[::-1]) if landmarks else ("keypoints", _TRUST)
    seen = trust[0] if trust[0] in there else trust[1]
    tracked = landmarks and {"observed", "joints3d"} <= {*there}
    further = (seen, "fps", "K", "image_size", "neck", *["observed"] * tracked)
    arrays = read_npz(path, (points, "names"), further)
    given = {key: numbers(f"{path}: {key}", arrays[key])
             for key in (points, seen, "K", "image_size") if key in arrays}  # fmt: skip
    notes: tuple[str, ...] = ()
    observed = arrays.get("observed")
    if (
        observed is not None
        and observed.dtype == bool
        and observed.shape == given[points].shape[:-1]
    ):
        given[points] = np.where(observed[..., None], given[points], np.nan)
        notes = (_TRACKED,)
    neck = one_text(path, "neck", arrays["neck"]) if "neck" in arrays else ""
    return RawKeypoints(
        given[points], texts(path, "names", arrays["names"]), given.get(seen),
        one_number(path, "fps", arrays["fps"]) if "fps" in arrays else None,
        given.get("K"), given.get("image_size"), neck or None, notes=notes,
    )  # fmt: skip


def read_csv_keypoints(path: Path) -> RawKeypoints:
    """Read a table with a row per frame or per keypoint; `read_keypoints` describes both."""
    lines = read_text(path, "comma-separated text").splitlines()
    notes = [line for line in lines if line.startswith("#")]
    filled = [(number, line) for number, line in enumerate(lines, start=1)
              if line.strip() and not line.startswith("#")]  # fmt: skip
    if not filled:
        raise FileFormatError(f"{path}: expected a header frame,NAME_x,NAME_y,...; it is empty")
    rows = split_rows(path, filled, len(split_row(filled[0][1])))
    rows = _from_deeplabcut(path, rows)
    rows[0] = rows[0][0], _usual_header(rows[0][1])
    header = [cell.lower() for cell in rows[0][1]]
    if set(header) >= _OF_SEVERAL_CAMERAS:
        raise FileFormatError(
            f"{path}: expected a table of one camera, got one of several, as Caliscope writes it; write a "
            "table frame,landmark,x,y of each from sync_index, names of point_id, img_loc_x and img_loc_y"
        )
    counted = any(name in header for name in _FRAMES)
    if not counted:
        _check_uncounted_header(path, rows)
    times = _times(path, rows, needed=not counted)
    rows, left_out = _without_other_columns(rows if counted else _with_frames(path, rows, times))
    header = rows[0][1]
    long = len(header) > 1 and header[1].lower() in _NAMES
    raw = _long_rows(path, header, rows[1:]) if long else _wide_rows(path, header, rows[1:])
    if any(column.lower().endswith("z") for column in left_out):
        _check_flat(path, raw.keypoints)
    raw.fps, raw.image_size = _csv_notes(path, notes)
    if raw.fps is None and times is not None:
        raw.fps, raw.notes = _rate_by_times(rows[1:], times.stamps)
        if raw.fps is not None:
            left_out = [name for name in left_out if name != times.name]
    if not counted and times is not None and raw.fps is not None:
        raw.first_time = first_second(times.stamps, raw.fps)
    if left_out:
        shown = first_of(left_out, _SHOWN)
        raw.notes += (f"columns {shown} are passed over: x, y and a score of keypoints count",)
    if not counted and times is None:
        raw.notes += (
            "no column of frames or times: each row is taken for the frame after the last",
        )
    return raw


_Rows = list[tuple[int, list[str]]]


def _from_deeplabcut(path: Path, rows: _Rows) -> _Rows:
    """Return rows with one header in place of DeepLabCut's three lines scorer, bodyparts and coords."""
    lines = {cells[0].lower(): cells for _, cells in rows[:4]}
    if not {"scorer", "bodyparts", "coords"} <= set(lines):
        return rows
    if len(set(lines.get("individuals", [])[1:])) > 1:
        raise FileFormatError(f"{path}: expected the keypoints of one person, got those of several")
    pairs = zip(lines["bodyparts"][1:], lines["coords"][1:], strict=False)
    header = ["frame", *(f"{part}_{kind}" for part, kind in pairs)]
    return [(rows[0][0], header), *rows[len(lines.keys() & _DEEPLABCUT) :]]


class _Times(NamedTuple):
    """Holds a column of times: its name, its cells with the number of their lines, and their numbers."""

    name: str
    cells: list[tuple[int, str]]
    stamps: np.ndarray


def _check_uncounted_header(path: Path, rows: _Rows) -> None:
    """Raise unless a table without a column of frames names keypoints, or points in time, all the same."""
    number, header = rows[0]
    long = {"x", "y"} <= {cell.lower() for cell in header} and any(map(is_time, header))
    if not (long or _ends(header) >= {"_x", "_y"}):
        raise FileFormatError(
            f"{path}, line {number}: expected a header frame,NAME_x,NAME_y[,NAME_confidence],... "
            f"or frame,name,x,y[,confidence], got {','.join(header)[:60]!r}"
        )


def _times(path: Path, rows: _Rows, needed: bool) -> _Times | None:
    """Return the first column of times, None without one; cells that are no times raise where needed."""
    name = next(filter(is_time, rows[0][1]), None)
    if name is None:
        return None
    column = rows[0][1].index(name)
    cells = [(number, cells[column]) for number, cells in rows[1:]]
    stamps = []
    for number, cell in cells:
        try:
            stamps.append(stamp_of(cell))
        except ValueError as error:
            if not needed:
                return None
            raise FileFormatError(f"{path}, line {number}: {error}") from error
    return _Times(name, cells, np.array(stamps))


def _with_frames(path: Path, rows: _Rows, times: _Times | None) -> _Rows:
    """Return rows with a column of frames in front, by their times, or counted in a table without times.

    Times that are several usual steps apart have missing frames between them; equal ones are one frame.
    """
    (number, header), *filled = rows
    frames = range(len(filled)) if times is None else _frames_by_times(path, header, times)
    numbered = zip(filled, frames, strict=True)
    return [
        (number, ["frame", *header]),
        *((number, [str(frame), *cells]) for (number, cells), frame in numbered),
    ]


def _frames_by_times(path: Path, header: Sequence[str], times: _Times) -> Sequence[int]:
    """Return the number of each row's frame; rows of one time are one where each names its keypoint."""
    steps = np.diff(times.stamps)
    bad = ~(steps >= 0)  # NaN included
    if bad.any():
        number, cell = times.cells[1 + int(np.flatnonzero(bad)[0])]
        raise FileFormatError(
            f"{path}, line {number}: expected times that increase, as there is no column of frames, "
            f"got {cell or 'none'}"
        )
    if {cell.lower() for cell in header}.isdisjoint(_NAMES) and (steps == 0).any():
        number, cell = times.cells[1 + int(steps.argmin())]
        raise FileFormatError(
            f"{path}, line {number}: expected a later time than {cell}, which the row before has too, as "
            "each row is a frame and there is no column of frames; number the frames in a column 'frame', "
            "give finer times, or delete what is there twice"
        )
    usual = usual_step(steps[steps > 0]) if (steps > 0).any() else 1.0
    if (steps > _MAX_GAP * usual).any():
        number, cell = times.cells[1 + int(steps.argmax())]
        raise FileFormatError(
            f"{path}, line {number}: expected the next time, got {cell}, far later"
        )
    frames = np.where(steps > 0, np.rint(steps / usual).clip(min=1), 0).astype(int)
    return [0, *frames.cumsum().tolist()][: len(times.cells)]


def _without_other_columns(rows: _Rows) -> tuple[_Rows, list[str]]:
    """Return rows with the frame in front and without depths and times, and the names of these."""
    header = rows[0][1]
    lower = [cell.lower() for cell in header]
    frame = next(lower.index(name) for name in _FRAMES if name in lower)
    known = set(lower)

    def is_left_out(cell: str) -> bool:
        if is_time(cell) or (cell in _PASSED_OVER and {"x", "y"} <= known):
            return True
        name, _, kind = cell.rpartition("_")
        return kind in _PASSED_OVER and {f"{name}_x", f"{name}_y"} <= known

    left_out = [i for i, cell in enumerate(lower) if is_left_out(cell)]
    kept = [frame, *(i for i in range(len(header)) if i != frame and i not in left_out)]
    return [(number, [cells[i] for i in kept]) for number, cells in rows], [
        header[i] for i in left_out
    ]


def _rate_by_times(rows: _Rows, stamps: np.ndarray) -> tuple[float | None, tuple[str, ...]]:
    """Return the frames per second by the time stamps of rows of checked frames, and notes on them."""
    frames, first = np.unique([float(cells[0]) for _, cells in rows], return_index=True)
    told = np.isfinite(stamps[first])
    frames, stamps = frames[told], stamps[first][told]
    before = np.maximum.accumulate(np.concatenate([[-np.inf], stamps[:-1]]))
    later = stamps > before  # of coarse stamps the first of those that are alike
    frames, stamps = frames[later], stamps[later]
    fps, note = frame_rate(np.diff(stamps), np.diff(frames))
    return (None, ()) if fps is None else (fps, (note, *notes_on_uneven_times(fps, frames, stamps)))


def _check_flat(path: Path, points: np.ndarray) -> None:
    """Refuse x and y beside z that are places in a room, as their signs tell, and no pixels."""
    known = points[np.isfinite(points).all(-1)]
    negative = (known < 0).mean(0).max() if len(known) else 0.0
    if negative > _NEGATIVE:
        raise FileFormatError(
            f"{path}: expected x and y of keypoints in pixels, and {100 * negative:.0f} % of x or y are "
            "negative, beside a z: these are points in space; give the 2D keypoints of each camera"
        )


def _wide_rows(path: Path, header: list[str], rows: _Rows) -> RawKeypoints:
    column = {name: i for i, name in enumerate(header)}
    names = [h[:-2] for h in header[1:] if h.endswith("_x")]
    trust = next((t for t in _SCORES if any(f"{n}_{t}" in column for n in names)), _SCORES[0])
    wanted = {header[0]} | {f"{n}_{axis}" for n in names for axis in ("x", "y", trust)}
    strange = [h for h in header if h not in wanted]
    absent = [f"{n}_y" for n in names if f"{n}_y" not in column]
    if names and strange:
        raise FileFormatError(
            f"{path}: expected columns frame,NAME_x,NAME_y[,NAME_confidence],...; delete or rename "
            f"{first_of(strange, _SHOWN)} (a score is NAME_confidence; write # fps = 30 "
            "above the header, or call a column of time stamps time)"
        )
    if not names or absent or len(column) != len(header):
        raise FileFormatError(
            f"{path}: expected columns frame,NAME_x,NAME_y[,NAME_confidence],... each once, got "
            f"{first_of(absent or header, _SHOWN)}"
            + (" (absent)" if absent else "; rename them so")
        )
    table = np.array([[_cell(path, number, c) for c in cells] for number, cells in rows])
    table = table.reshape(-1, len(header))
    index, count, first = _frames(path, table[:, 0], rows, repeated=False)
    joints = np.stack([table[:, [column[f"{n}_{a}"] for n in names]] for a in "xy"], -1)
    points = np.full((count, len(names), 2), np.nan)
    points[index] = joints
    confidence = None
    if any(f"{n}_{trust}" in column for n in names):
        confidence = np.zeros((count, len(names)))
        for j, name in enumerate(names):
            given = column.get(f"{name}_{trust}")
            confidence[index, j] = 1.0 if given is None else table[:, given]
    return RawKeypoints(points, tuple(names), confidence, first_frame=first)


def _long_rows(path: Path, header: list[str], rows: _Rows) -> RawKeypoints:
    scored = len(header) == 5 and header[4].lower() in _SCORES
    if len(header) != 4 + scored or [cell.lower() for cell in header[2:4]] != ["x", "y"]:
        raise FileFormatError(
            f"{path}: expected columns frame,name,x,y[,confidence], got {','.join(header)}; rename or "
            "delete columns"
        )
    names = list(dict.fromkeys(cells[1] for _, cells in rows))
    table = np.array([[_cell(path, number, c) for c in (cells[0], *cells[2:])]
                      for number, cells in rows]).reshape(-1, 3 + scored)  # fmt: skip
    index, count, first = _frames(path, table[:, 0], rows, repeated=True)
    place = {name: j for j, name in enumerate(names)}
    joint = np.array([place[cells[1]] for _, cells in rows], dtype=int)
    if len(set(zip(index.tolist(), joint.tolist(), strict=True))) < len(rows):
        raise FileFormatError(
            f"{path}: a keypoint is given twice in one frame; expected one person"
        )
    points = np.full((count, len(names), 2), np.nan)
    points[index, joint] = table[:, 1:3]
    confidence = None
    if scored:
        confidence = np.zeros((count, len(names)))
        confidence[index, joint] = table[:, 3]
    return RawKeypoints(points, _of_numbers(names), confidence, first_frame=first)


def _of_numbers(names: Sequence[str]) -> tuple[str, ...]:
    """Return names, those of MediaPipe's landmarks in place of their numbers."""
    if sorted(names) == sorted(map(str, range(len(LANDMARKS)))):
        return tuple(LANDMARKS[int(name)] for name in names)
    return tuple(names)


def _cell(path: Path, number: int, cell: str) -> float:
    if not cell:
        return math.nan
    try:
        return float(cell)
    except ValueError as error:
        raise FileFormatError(f"{path}, line {number}: expected a number, got {cell!r}") from error


def _frames(
    path: Path, frames: np.ndarray, rows: list[tuple[int, list[str]]], repeated: bool
) -> tuple[np.ndarray, int, int]:
    """Return the index of each row's frame, counted from the first, the number of frames, and the first."""
    with np.errstate(invalid="ignore"):  # of infinite ones
        whole = np.isfinite(frames) & (frames % 1 == 0)
        steps = np.diff(frames, prepend=frames[:1] - (not repeated))
    bad = ~whole | (steps < (not repeated)) | (steps > _MAX_GAP)
    if bad.any():
        at = int(np.flatnonzero(bad)[0])
        raise FileFormatError(
            f"{path}, line {rows[at][0]}: frame numbers must be whole and increase, "
            f"got {rows[at][1][0] or 'none'}"
        )
    index = (frames - frames[:1]).astype(int)
    count = int(index[-1]) + 1 if len(index) else 0
    check_span(path, count, len(np.unique(index)))
    return index, count, int(frames[0]) if count else 0


def _csv_notes(path: Path, notes: list[str]) -> tuple[float | None, list[float] | None]:
    fps, size = None, None
    for note in notes:
        key, _, value = note.lstrip("# ").partition("=")
        try:
            if key.strip() == "fps":
                fps = float(value)
            elif key.strip() == "image_size":
                size = [float(v) for v in value.split(",")]
        except ValueError as error:
            raise FileFormatError(f"{path}: cannot read {note!r}") from error
    return fps, size
