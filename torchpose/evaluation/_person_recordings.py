"""Recordings of persons: who is who, which frames are whole, and what arms do in them."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.wording import counted
from torchpose.io._recordings import (
    DOUBTS,
    Recording,
    find_recordings,
    notes_on_unread_files,
    read_recordings,
)
from torchpose.learning._curation.curate import CurationSettings, curate
from torchpose.learning._curation.joints import measured, runs
from torchpose.learning._curation.splits import same_names, unstated_rates

LEAST_FRAMES = 10
"""Of a sequence that is scored."""

POSE_CLASSES = ("raised", "crossed", "near the body", "reaching out")
"""What an arm does in a frame (`pose_classes`)."""

_CURATION = CurationSettings(person_frames=0)  # a short recording may still be scored
_HANDS, _SHOULDERS = (0, 7), (2, 5)
_NEAR = 0.2  # metres


def complete_pieces(joints: Float[Tensor, "T 8 3"]) -> list[Float[Tensor, "S 8 3"]]:
    """Return runs of at least ten frames in which no joint is missing."""
    return [joints[frames] for frames in runs(measured(joints).all(1), LEAST_FRAMES)]


def pose_classes(poses: Float[Tensor, "N 8 3"]) -> Int[Tensor, "N 2"]:
    """Return the pose class of the left and the right arm: index into `POSE_CLASSES`, the first that applies.

    Raised: the hand is above its shoulder. Crossed: it is on the other side of the middle of the
    shoulders, along their line. Near the body: within 20 cm of its shoulder, horizontally. Else it
    reaches out.

    Args:
        poses: camera axes, y down, metres.
    """
    hands, shoulders = poses[:, list(_HANDS)], poses[:, list(_SHOULDERS)]
    across = shoulders[:, 0] - shoulders[:, 1]
    across = torch.stack([across, -across], 1)
    middle = shoulders.mean(1, keepdim=True)
    raised = hands[..., 1] < shoulders[..., 1]
    crossed = ((hands - middle) * across).sum(-1) < 0
    near = (hands - shoulders)[..., [0, 2]].norm(dim=-1) < _NEAR
    return torch.where(raised, 0, torch.where(crossed, 1, torch.where(near, 2, 3)))


class KnownPersons(NamedTuple):
    """Holds recordings of persons whom their files name, and sentences on what is doubtful about them."""

    recordings: list[Recording]
    notes: list[str]


def read_known_persons(
    paths: Sequence[str | Path] | str | Path, curated: bool = True
) -> KnownPersons:
    """Read recordings, without other people in a person's file: nobody says who they are.

    Args:
        paths: folders or files. curated: leave out what is no body, as `torchpose fit` does.

    Raises:
        InputError, FileFormatError, SkeletonError, MissingDependencyError: as `read_recordings`.
        InputError, OverlapError: as `curate`.
    """
    found = find_recordings(paths)
    recordings = read_recordings(found)
    known = [r for r in recordings if not r.companion]
    others = [r for r in recordings if r.companion]
    files = sorted({r.path.name for r in others if r.path is not None})
    notes = [
        f"Other people in {', '.join(files)} are left out ({counted(len(others), 'recording')}): nobody "
        "says who they are."
    ] * bool(others)
    doubts = [*same_names(known), *unstated_rates(known), *notes_on_unread_files(paths, found)]
    notes += [f"{note}." for note in doubts]
    for doubt in DOUBTS:
        found_in = [note for r in known for note in r.notes if note.startswith(doubt)]
        notes += [f"In {len(found_in)} of {len(known)} recordings: {n}." for n in found_in[:1]]
    return _curated(known, notes) if curated and known else KnownPersons(known, notes)


def _curated(recordings: Sequence[Recording], notes: Sequence[str]) -> KnownPersons:
    """Return curated recordings in their order; a note says how much was left out.

    Kinds of hands and heads are curated apart: curation refuses them mixed, for a fit.
    """
    kinds: dict[Any, list[Recording]] = {}
    for recording in recordings:
        body = recording.upper_body()
        kinds.setdefault((body.hand, body.head), []).append(recording)
    found = [curate(group, _CURATION) for group in kinds.values()]
    left_out: Counter[tuple[str, str]] = Counter()
    for one in found:
        for reason, (count, what) in one.report.totals().items():
            left_out[reason, what.removesuffix("s")] += count
    listed = ", ".join(f"{counted(n, what)} ({why})" for (why, what), n in sorted(left_out.items()))
    said = [
        f"Curation left out {listed}; `torchpose fit` says where, and --curate false leaves all of it in."
    ] * bool(left_out)
    return KnownPersons([r for one in found for r in one.recordings], [*notes, *said])


def by_person(recordings: Sequence[Recording]) -> dict[str, list[Recording]]:
    """Return recordings of each person, under a name that no other one has, in order.

    The name is the short one of the person, or the whole `Recording.person_id` where several have it.
    """
    groups: dict[str, list[Recording]] = {}
    for recording in recordings:
        groups.setdefault(recording.person_id, []).append(recording)
    short = {key: one.person or _folder(one) or "one" for key, (one, *_) in groups.items()}
    names = [*short.values(), *groups]
    unique = {key: name if names.count(name) == 1 else key for key, name in short.items()}
    return {unique[key]: groups[key] for key in sorted(groups, key=lambda k: _natural(unique[k]))}


def _folder(recording: Recording) -> str:
    return recording.path.resolve().parent.name if recording.path is not None else ""


def _natural(name: str) -> tuple[Any, ...]:
    """Return a key by which s2 comes before s10."""
    digits = "".join(c if c.isdecimal() else " " for c in name).split()
    return ("".join(c for c in name if not c.isdecimal()), *map(int, digits))


def renamed(recordings: Sequence[Recording], suffix: str) -> list[Recording]:
    """Return the recordings as those of another person, where a test on the same person is the point."""
    return [replace(r, person=f"{r.person}, {suffix}") for r in recordings]


def spread(values: Sequence[float] | Tensor) -> tuple[float, float]:
    """Return the mean and standard deviation, NaN left out; NaN for the latter of fewer than two."""
    known = torch.as_tensor(values, dtype=torch.float64)
    known = known[torch.isfinite(known)]
    if not len(known):
        return math.nan, math.nan
    return float(known.mean()), float(known.std()) if len(known) > 1 else math.nan
