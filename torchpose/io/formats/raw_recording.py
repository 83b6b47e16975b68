"""What a file of 3D joints holds, before conversion; and whose bodies they are in a file of several."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpose._core.reading import check_span
from torchpose.errors import FileFormatError

__all__ = ["SENSOR_WEIGHTS", "BodyFrame", "RawRecording", "frame_ranges", "join_bodies", "numbers"]

SENSOR_WEIGHTS = (0.0, 0.5, 1.0)
"""Kinect's tracking states as weights: not tracked, inferred, tracked."""

_SHOWN_RANGES = 4


@dataclass
class RawRecording:
    """A sequence of joints as a file has them.

    Args:
        path: the file.
        joints: [T, J, 3] in the axes and the unit of the file; NaN where missing.
        names: J names.
        fps: frames per second, None if unknown.
        axes: of the file, None if it does not say.
        unit: metres per unit of the file, None if it does not say.
        person, action, source: as in `Recording`.
        weights: [T, J] in [0, 1], None if the file does not say.
        companion: 0 for the person whose file it is, else which of the others.
        first_frame: number of the first frame in the file.
        notes: what was assumed or left out, for people.
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
    """One body in one frame: its number in the file, joints [J, 3] and weights [J]."""

    frame: int
    body: str
    joints: np.ndarray
    weights: np.ndarray | None = None


def numbers(name: str, array: np.ndarray) -> np.ndarray:
    """Return the array in float64, or raise an error that names it if it does not hold numbers."""
    if array.dtype.kind not in "fiub":
        raise FileFormatError(f"{name} must be numbers, got {array.dtype}")
    return array.astype(np.float64)


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
    """One recording for each person in a file of several bodies that come and go.

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
    """In how many frames a body is there, those of inferred joints counting less."""
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
        notes.append("another person than the one whose file it is; the file does not say who")
    away = sorted(set(range(n_frames)) - seen.keys())
    if away:
        notes.append(f"not there in frames {frame_ranges(away)}")
    return RawRecording(
        path, joints, names, fps, weights=weights, companion=companion, first_frame=first,
        notes=tuple(notes), **facts,
    )  # fmt: skip
