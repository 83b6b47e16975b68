"""Hold the 3D joints of a file before conversion, and read the package's .npz and the authors' .yaml."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose._core.checks import check_rate
from torchpose._core.reading import (
    check_span,
    one_number,
    one_text,
    read_npz,
    read_text,
    reading,
    texts,
)
from torchpose.errors import FileFormatError, InputError, SkeletonError
from torchpose.skeleton._joint_sets import UPPER_BODY, canonical_names

SENSOR_WEIGHTS = (0.0, 0.5, 1.0)
"""Kinect's tracking states as weights: not tracked, inferred, tracked."""
LEVEL_WEIGHTS = (0.0, 0.5, 1.0, 1.0)
"""Azure Kinect's levels of confidence as weights: out of range, occluded (predicted), medium, high."""

_SHOWN_RANGES = 4


@dataclass
class RawRecording:
    """Holds a sequence of joints as a file has them.

    Args:
        path: the file.
        joints: [T, J, 3] in the axes and the unit of the file; NaN where missing.
        names: J names.
        fps: frames per second, None if unknown.
        axes: the axes of the file, None if it does not say.
        unit: metres per unit of the file, None if it does not say.
        person, action, source: as in `Recording`.
        weights: [T, J] in [0, 1], None if the file does not say.
        companion: 0 for the person whose file it is, else which of the others.
        first_frame: number of the first frame in the file.
        notes: sentences on assumptions and omissions of the reader.
    """

    path: Path
    joints: np.ndarray
    names: tuple[str, ...]
    fps: float | None
    axes: str | None = None
    unit: float | None = None
    person: str = ""
    action: str = ""
    source: str = ""
    weights: np.ndarray | None = None
    companion: int = 0
    first_frame: int = 0
    notes: tuple[str, ...] = ()

    def where(self) -> str:
        """Return the file and person, for messages."""
        other = f", other body {self.companion}" if self.companion else ""
        return f"{self.path}{f', person {self.person}' if self.person else ''}{other}"


class BodyFrame(NamedTuple):
    """Holds one body in one frame: its number in the file, joints [J, 3] and weights [J]."""

    frame: int
    body: str
    joints: np.ndarray
    weights: np.ndarray | None = None


def numbers(name: str, array: np.ndarray) -> np.ndarray:
    """Return the array in float64, or raise an error that names it if it does not hold numbers."""
    if array.dtype.kind not in "fiub":
        raise FileFormatError(f"{name} must be numbers, got {array.dtype}")
    return array.astype(np.float64)


def checked_rate(where: str | Path, fps: float | None) -> float | None:
    """Return the frame rate of a file, None if it states none.

    Raises:
        FileFormatError: it is no rate.
    """
    try:
        return None if fps is None else check_rate("fps", fps)
    except InputError as error:
        raise FileFormatError(f"{where}: {error}") from error


def check_names(where: str | Path, names: Sequence[str]) -> None:
    """Raise a `SkeletonError` that names the file, where names are of no joints, or one is there twice."""
    try:
        canonical_names(names)
    except SkeletonError as error:
        raise SkeletonError(f"{where}: {error}") from error


def frame_ranges(frames: Iterable[int], first: int = 0) -> str:
    """Return the frame numbers for people, runs joined; `first` is added to each.

    >>> frame_ranges([3, 4, 5, 9])
    '3-5, 9'
    """
    ordered = np.unique(np.fromiter(frames, dtype=int)) + first
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1) if len(ordered) else []
    shown = [f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
    more = len(shown) - _SHOWN_RANGES
    return ", ".join(shown[:_SHOWN_RANGES]) + (f" and {more} more places" if more > 0 else "")


def join_bodies(
    path: Path,
    frames: list[BodyFrame],
    n_frames: int,
    names: tuple[str, ...],
    fps: float | None,
    **facts: Any,
) -> list[RawRecording]:
    """Return one recording for each person in a file of several bodies that come and go.

    A sensor gives a body that it lost and found a new number. So bodies that are never there at once
    are taken for one person: first those of the body tracked longest, whose file it is, then those
    of its companions. Whoever the companions are, a file does not say.

    Args:
        path: the file.
        frames: every body in every frame.
        n_frames: of the file, with those in which there is nobody.
        names, fps, facts: as in `RawRecording`.

    Returns:
        Recordings from the first to the last frame of each person, NaN where that person is away;
        the file's own person first. None if there is no body at all.

    Raises:
        FileFormatError: a body twice in one frame.
    """
    bodies: dict[str, dict[int, BodyFrame]] = {}
    for one in frames:
        seen = bodies.setdefault(one.body, {})
        if one.frame in seen:
            raise FileFormatError(f"{path}, frame {one.frame}: body {one.body} is there twice")
        seen[one.frame] = one
    tracked = {body: _tracked(seen.values()) for body, seen in bodies.items()}
    longest_first = sorted(bodies, key=lambda body: (-tracked[body], min(bodies[body])))
    people: list[dict[int, BodyFrame]] = []
    numbers_of: list[list[str]] = []
    for body in longest_first:
        apart = [i for i, other in enumerate(people) if not other.keys() & bodies[body].keys()]
        if apart:
            people[apart[0]] |= bodies[body]
            numbers_of[apart[0]].append(body)
        else:
            people.append(dict(bodies[body]))
            numbers_of.append([body])
    spans = sum(max(seen) - min(seen) + 1 for seen in people)
    check_span(path, spans, len(frames))
    return [
        _one_person(path, seen, names, fps, which, numbers_of[which], n_frames, facts)
        for which, seen in enumerate(people)
    ]


def _tracked(frames: Iterable[BodyFrame]) -> float:
    """Return the number of frames with a body; frames of inferred joints count less."""
    return sum(1.0 if one.weights is None else float(one.weights.mean()) for one in frames)


def _one_person(
    path: Path,
    seen: dict[int, BodyFrame],
    names: tuple[str, ...],
    fps: float | None,
    companion: int,
    numbers_of: list[str],
    n_frames: int,
    facts: dict[str, Any],
) -> RawRecording:
    first, last = min(seen), max(seen)
    joints = np.full((last - first + 1, len(names), 3), np.nan)
    weights = np.zeros(joints.shape[:2])
    for frame, body in seen.items():
        joints[frame - first] = body.joints
        weights[frame - first] = 1.0 if body.weights is None else body.weights
    joints[weights == 0] = np.nan
    notes = list(facts.get("notes", ()))
    facts = {key: value for key, value in facts.items() if key != "notes"}
    if len(numbers_of) > 1:
        notes.append(
            f"bodies {', '.join(numbers_of)} are taken for one person: never two of them at once"
        )
    if companion:
        notes.append("a further person in the file; the file does not say who")
    away = sorted(set(range(n_frames)) - seen.keys())
    if away:
        notes.append(f"not there in frames {frame_ranges(away)}")
    return RawRecording(
        path, joints, names, fps, weights=weights, companion=companion, first_frame=first,
        notes=tuple(notes), **facts,
    )  # fmt: skip


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
