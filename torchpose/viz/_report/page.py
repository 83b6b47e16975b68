"""Write `report.html`: overlay, skeleton, curves and measured joints in one file."""

import base64
import html
import json
import os
import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import quote

import torch
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.files import atomic_path
from torchpose._core.reading import require_file
from torchpose.body._feet import FEET, FOOT_BONES
from torchpose.body._skeleton import BODY_15
from torchpose.errors import InputError
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import LIMBS
from torchpose.viz._report.packing import (
    CURVE_POINTS,
    MAX_POSES,
    ReportedTrack,
    Thinned,
    pack_person,
)
from torchpose.viz._style import readable, side_of

MAX_EMBEDDED = 64 * 2**20
"""Largest overlay that is embedded in the page, bytes; a larger one is linked."""

_SCRIPTS = ("numbers.js", "skeleton.js", "plots.js", "player.js")
_FPS = 30.0
_CHUNK = 3 * 2**18  # of three bytes, so that the pieces of base64 join without padding


def write_report(
    path: str | Path,
    people: Sequence[ReportedTrack],
    *,
    overlay: str | Path | None = None,
    title: str = "Tracked poses",
    facts: dict[str, str] | None = None,
    notes: Sequence[str] = (),
    first_frames: Sequence[int] | None = None,
    n_frames: int | None = None,
    labels: Sequence[str] | None = None,
    truth: Tensor | None = None,
    limbs: Sequence[tuple[int, int]] | None = None,
) -> Path:
    """Write tracked poses as one HTML page that any browser shows, without a network.

    The page holds the overlay video, a 3D skeleton that can be rotated while it plays, the curves of each
    joint with 90 % bands, and for each joint and frame whether it was measured or inferred. Numbers are
    base64 of 32-bit floats. Long tracks are thinned, which the page states.

    Args:
        path: the page; it appears whole or not at all.
        people: one `PoseTrack` of one sequence for each person, ``track.seen_by(camera)`` of a `BodyTrack`,
            or the like with other joints; an empty list gives a page without persons. NaN poses are not
            drawn.
        overlay: video for the page, H.264; up to 64 MB it is embedded, a larger one is linked.
            Without it the page plays the skeleton alone.
        title: the title of the page. facts: rows of a table, such as video, camera, method.
        notes: assumptions and failures, one sentence each.
        first_frames: frame of the video with which each track begins; by default 0.
        n_frames: frames of the video; by default up to the end of the last track.
        labels: name of each person; by default "person 1" and so on.
        truth: true joints of the first person [T, J, 3], metres, in the axes of its track.
        limbs: pairs of joints that a line joins; by default those of the upper body, or of a `BodyTrack`.

    Returns:
        `path`.

    Raises:
        InputError: a track in place of a list, one of several sequences or none, counts that do not match,
            other joints without limbs, limbs of joints that there are not, no such overlay.
        ShapeError: truth of another shape. OutputError: the page cannot be written.
    """
    path = Path(path)
    if hasattr(people, "joints3d"):
        raise InputError(
            f"people must be a list of tracks, got {type(people).__name__}; give [track]"
        )
    starts = [0] * len(people) if first_frames is None else list(first_frames)
    names = [f"person {i + 1}" for i in range(len(people))] if labels is None else list(labels)
    _check(people, starts, names, truth)
    limbs = _limbs(people[0].names if people else UPPER_BODY, limbs)
    fps, more = _frame_rate(people)
    end = max((start + track.joints3d.shape[1] for start, track in zip(starts, people, strict=True)),
              default=0)  # fmt: skip
    n_frames = max(end, n_frames or 0)
    budget = MAX_POSES // max(1, len(people))
    packed = [
        pack_person(track, name, start, truth if i == 0 else None, budget)
        for i, (track, name, start) in enumerate(zip(people, names, starts, strict=True))
    ]
    video = None if overlay is None else _Overlay(require_file(overlay), path)
    more += _thinning_notes([thinned for _, thinned in packed], fps)
    more += _failures(people, names) + ([] if video is None else video.notes)
    parts = {
        "title": html.escape(title),
        "summary": html.escape(_summary(people, packed, n_frames, fps)),
        "style": _template("report.css"),
        "script": "\n".join(_template(name) for name in _SCRIPTS),
        "facts": _facts(facts or {}),
        "notes": _list([*notes, *more]),
        "data": _data(people, packed, limbs, n_frames, fps, video),
    }
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="replace", newline="\n") as stream,
    ):
        _fill(stream, _template("template.html"), parts, video)
    return path


class _Overlay:
    """Embeds the video of the page if it is small enough, else links it."""

    def __init__(self, file: Path, page: Path) -> None:
        self.file = file
        size = file.stat().st_size
        self.embedded = size <= MAX_EMBEDDED
        self.notes: list[str] = []
        self.source = "embedded"
        if not self.embedded:
            beside = os.path.relpath(file.resolve(), page.resolve().parent)
            self.source = quote(Path(beside).as_posix())
            self.notes = [
                f"The overlay has {size / 2**20:.0f} MB, too much for one page: it is linked, so keep "
                f"{beside} where it is beside this page."
            ]

    def base64(self) -> Iterator[str]:
        if self.embedded:
            with self.file.open("rb") as stream:
                while chunk := stream.read(_CHUNK):
                    yield base64.b64encode(chunk).decode("ascii")


def _fill(stream: TextIO, template: str, parts: dict[str, str], video: _Overlay | None) -> None:
    """Write the template with its parts, in which no placeholders are searched for."""
    for i, piece in enumerate(re.split(r"\{\{(\w+)\}\}", template)):
        if i % 2 == 0:
            stream.write(piece)
        elif piece == "video":
            stream.writelines([] if video is None else video.base64())
        else:
            stream.write(parts[piece])


def _data(
    people: Sequence[ReportedTrack],
    packed: Sequence[tuple[dict[str, Any], Thinned]],
    limbs: Sequence[tuple[int, int]],
    n_frames: int,
    fps: float,
    video: _Overlay | None,
) -> str:
    """Return the JSON of what the page's scripts show."""
    joints = people[0].names if people else UPPER_BODY
    data = {
        "fps": fps,
        "frames": n_frames,
        "names": [readable(name) for name in joints],
        "sides": [side_of(name) for name in joints],
        "limbs": [list(pair) for pair in limbs],
        "frame": people[0].frame if people else "camera",
        "video": None if video is None else video.source,
        "people": [person for person, _ in packed],
    }
    # no tag can begin inside of the data, whatever a name contains
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _template(name: str) -> str:
    return files("torchpose.viz._report").joinpath(name).read_text(encoding="utf-8")


def _limbs(
    names: Sequence[str], given: Sequence[tuple[int, int]] | None
) -> Sequence[tuple[int, int]]:
    """Return the pairs of joints that a line joins, those of the joints by default."""
    if given is not None:
        if not all(0 <= joint < len(names) for pair in given for joint in pair):
            raise InputError(
                f"limbs must be of joints 0 to {len(names) - 1}, got {list(given)!s:.80}"
            )
        return given
    if len(names) == len(UPPER_BODY):
        return LIMBS
    bones = [(parent, joint) for joint, parent in enumerate(BODY_15.parents) if parent >= 0]
    known = {BODY_15.names: bones, (*BODY_15.names, *FEET): [*bones, *FOOT_BONES]}
    if tuple(names) not in known:
        raise InputError(
            f"limbs must be given for the joints {', '.join(names)!s:.80}, pairs of their places"
        )
    return known[tuple(names)]


# --- words ----------------------------------------------------------------------------------------


def _summary(
    people: Sequence[ReportedTrack],
    packed: Sequence[tuple[dict[str, Any], Thinned]],
    n: int,
    fps: float,
) -> str:
    length = f"{_count(n, 'frame')}, {_duration(n / fps)}"
    if not people:
        return f"{length}. Nobody was tracked." if n else "Nobody was tracked."
    if len(people) > 1:
        return f"{length}, {len(people)} persons."
    shares = packed[0][0]["measured"]
    hidden = [readable(name) for name, s in zip(people[0].names, shares, strict=True) if s == 0]
    if not hidden:
        return f"{length}."
    return f"{length}. Never measured, so inferred throughout: {', '.join(hidden)}."


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def _thinning_notes(thinned: Sequence[Thinned], fps: float) -> list[str]:
    notes = []
    stride = max((t.stride for t in thinned), default=1)
    if stride > 1:
        notes.append(
            f"Thinned for this page: the skeleton shows every {_ordinal(stride)} pose "
            f"({fps / stride:.3g} per second) and moves evenly in between."
        )
    bucket = max((t.bucket for t in thinned), default=1)
    if bucket > 1:
        notes.append(
            f"Thinned for this page: curves of more than {CURVE_POINTS:,} frames show the lowest and "
            f"the highest value of every {bucket} frames, and the widest band. All values are in "
            "the .npz file of the poses."
        )
    return notes


def _ordinal(n: int) -> str:
    ending = "th" if n % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"


def _failures(people: Sequence[ReportedTrack], names: Sequence[str]) -> list[str]:
    return [
        f"The filter of {name} degenerated at its frame {int(track.failed_at[0])}: there is no pose "
        "from there on."
        for name, track in zip(names, people, strict=True)
        if int(track.failed_at[0]) >= 0
    ]


def _frame_rate(people: Sequence[ReportedTrack]) -> tuple[float, list[str]]:
    rates = {track.fps for track in people}
    if len(rates) > 1:
        raise InputError(
            "persons of one video must have one frame rate, got "
            + ", ".join("none" if rate is None else f"{rate:g}" for rate in rates)
        )
    rate = rates.pop() if rates else None
    if people and rate is None:
        return _FPS, [f"The frame rate is unknown; {_FPS:g} frames per second are assumed."]
    return rate or _FPS, []


def _facts(facts: dict[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{html.escape(str(key))}</th><td>{html.escape(str(value))}</td></tr>\n'
        for key, value in facts.items()
    )
    return f"<table>\n{rows}</table>" if rows else "<p>No facts were given.</p>"


def _list(notes: Sequence[str]) -> str:
    items = "".join(f"<li>{html.escape(str(note))}</li>\n" for note in notes)
    return f"<ul>\n{items}</ul>" if items else "<p>None.</p>"


def _check(
    people: Sequence[ReportedTrack],
    starts: Sequence[int],
    names: Sequence[str],
    truth: Tensor | None,
) -> None:
    for i, track in enumerate(people):
        if not hasattr(track, "joints3d"):
            raise InputError(f"people[{i}] must be a PoseTrack, got {type(track).__name__}")
        if hasattr(track, "seen_by"):
            raise InputError(
                f"people[{i}] must be poses in the axes of a camera, got {type(track).__name__}; give "
                "track.seen_by(camera)"
            )
        if len(track) != 1 or track.joints3d.shape[1] == 0:
            raise InputError(
                f"people[{i}] must be one sequence of at least one frame, got joints3d of shape "
                f"{list(track.joints3d.shape)}; see PoseTrack.sequence"
            )
    for name, given in (("first_frames", starts), ("labels", names)):
        if len(given) != len(people):
            raise InputError(f"expected {name} for {len(people)} persons, got {len(given)}")
    if any(start < 0 for start in starts):
        raise InputError(f"first_frames must not be negative, got {list(starts)}")
    if len({tuple(track.names) for track in people}) > 1:
        raise InputError("poses of all persons must be of the same joints, got some of others")
    if len({track.frame for track in people}) > 1:
        raise InputError("poses of all persons must be in one frame, got camera and body")
    if truth is not None:
        if not people:
            raise InputError("expected a tracked person to go with truth, got none")
        check_shape("truth", truth, [*people[0].joints3d.shape[1:3], 3])
        if not torch.is_floating_point(truth):
            raise InputError(f"truth must be floating point, got {truth.dtype}")
