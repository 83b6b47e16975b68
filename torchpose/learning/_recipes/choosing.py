"""Choose recordings of whole bodies to fit to, and turn them into joints, bodies and states.

The fits of manifolds, limbs and actions do so alike, from `torchpose fit` and from the training loop.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpose._core.digests import digest_of
from torchpose._core.wording import counted
from torchpose.body._fitting import fit_body, fit_state
from torchpose.body._kinematics import Body, Frame
from torchpose.body._skeleton import BODY_15, body_joints
from torchpose.errors import InputError
from torchpose.io._formats.axes import Axes
from torchpose.io._mocap import resample_frames
from torchpose.io._recordings import (
    Recording,
    find_recordings,
    notes_on_unread_files,
    read_recordings,
)
from torchpose.learning._curation.splits import (
    persons_of,
    pick_sides,
    refuse_shared_recordings,
)
from torchpose.learning._recipes.gaps import LONGEST_GAP, fill_short_gaps, missing_joints


class ChosenRecordings(NamedTuple):
    """Holds the recordings to fit to, and those of held-out persons, each in the order of the files.

    Attributes:
        unread: notes on files that may be recordings and were passed over.
    """

    train: list[Recording]
    watched: list[Recording]
    unread: list[str]


def choose_recordings(
    paths: Sequence[str],
    *,
    persons: Sequence[str] | None = None,
    held_out: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    axes: Axes | None = None,
) -> ChosenRecordings:
    """Read recordings and split them by person; other people in a file are left out.

    Args:
        paths: folders (with their subfolders) or files, see `expand_path`.
        persons: whom to fit to, as `origin#person` or just the person; by default everybody who is not
            held out.
        held_out: persons who are not fitted to, named in the same way: they tell how good the model is on
            others.
        actions: names of actions, as the files give them; by default all.
        without: names of files, without their suffix, to leave out altogether.
        axes: the axes of all recordings: camera, kinect, y-up, z-up; by default what each file says.

    Raises:
        InputError: unknown persons, actions or files, or nobody left to learn from. OverlapError: a
            person on both sides, or a recording, under another person.
    """
    given = [expand_path(path) for path in paths]
    files = find_recordings(given)
    read = read_recordings(_without(files, without or ()), axes)
    recordings = [r for r in read if not r.companion]
    wanted, out = pick_sides(persons_of(recordings), persons, held_out or ())
    if actions is not None:
        done = sorted({r.action for r in recordings})
        missing = [action for action in actions if action not in done]
        if missing:
            untold = sum(not r.action for r in recordings)
            raise InputError(
                f"no recording of {', '.join(missing)}; there are {', '.join(filter(None, done)) or 'none'}"
                + f", and {counted(untold, 'recording')} without `action` in the .npz"
                * bool(untold)
            )
        recordings = [r for r in recordings if r.action in actions]
    found = ChosenRecordings(
        [r for r in recordings if r.person_id in wanted],
        [r for r in recordings if r.person_id in out],
        notes_on_unread_files(given, files),
    )
    if not found.train:
        raise InputError(
            "everybody is held out, or did none of the actions; nobody is left to learn from"
        )
    if out and not found.watched:
        raise InputError(
            f"none of the persons held out ({', '.join(sorted(out))}) did any of the actions; hold others out"
        )
    refuse_shared_recordings(found.train, found.watched)
    return found


def _without(files: Sequence[Path], names: Sequence[str]) -> list[Path]:
    """Return the files without those of some names.

    Raises:
        InputError: no file of a name, or all files named.
    """
    unknown = sorted(set(names) - {file.stem for file in files})
    if unknown:
        raise InputError(f"without: no file named {', '.join(unknown)} among the recordings")
    left = [file for file in files if file.stem not in names]
    if not left:
        raise InputError("without: names all of the recordings; name fewer")
    return left


def recording_name(recording: Recording) -> str:
    """Return the name of a recording in messages: its file without the suffix, or its person."""
    return recording.person_id if recording.path is None else recording.path.stem


def recorded_joints(recording: Recording, fps: float) -> Tensor:
    """Return joints [T, 15, 3] of the body at a frame rate; those that are never there are NaN.

    Gaps of up to 0.2 s are filled (`fill_short_gaps`).

    Raises:
        InputError: no frame rate in the file, or a joint that is missing for longer.
    """
    name = recording_name(recording)
    if recording.fps is None:
        raise InputError(f"{name}: the file does not say its frame rate, which is needed")
    joints = body_joints(recording.joints, recording.names)
    joints = fill_short_gaps(joints, recording.fps)
    gaps = missing_joints(joints).nonzero()
    if len(gaps):
        frame, joint = gaps[0].tolist()
        raise InputError(
            f"{recording.path or name}: {BODY_15.names[joint]} is missing in frame {frame}, in a gap of more "
            f"than {LONGEST_GAP:g} s or at an end; cut the recording there, fill the gap, or leave the file "
            "out"
        )
    return resample_frames(joints, recording.fps, fps)


def body_of_each(
    recordings: Sequence[Recording], joints: Sequence[Tensor], frame: Frame = "parent"
) -> dict[str, Body]:
    """Return the body of each person, fitted to all of their recordings.

    Args:
        recordings: of everybody. joints: [T, 15, 3] of each recording, see `recorded_joints`.
        frame: of the bodies, see `fit_body`.

    Raises:
        InputError: joints that no body can be fitted to; the person is named.
    """
    found = {}
    for person in dict.fromkeys(r.person_id for r in recordings):
        own = [j for r, j in zip(recordings, joints, strict=True) if r.person_id == person]
        there = torch.stack([j.isfinite().all(-1).any(0) for j in own])
        for which, joint in (there.any(0) & ~there).nonzero()[:1].tolist():
            recording = [r for r in recordings if r.person_id == person][which]
            raise InputError(
                f"{recording.path or recording_name(recording)}: {BODY_15.names[joint]} is never there, and "
                f"other recordings of {person} have it; leave the file out, or those others"
            )
        try:
            found[person] = fit_body(torch.cat(own), frame=frame)
        except InputError as error:
            raise InputError(f"{person}: {error}") from error
    return found


def state_of(body: Body, recording: Recording, joints: Tensor) -> Tensor:
    """Return the states [T, D] of a recording on its person's body.

    Raises:
        InputError: joints that no state can be fitted to; the recording is named.
    """
    try:
        return fit_state(body, joints).detach()
    except InputError as error:
        raise InputError(f"{recording_name(recording)}: {error}") from error


def origin_of(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return persons, actions and sources of recordings, as models record what they were fitted to."""
    return {
        "persons": tuple(sorted({r.person_id for r in recordings})),
        "actions": tuple(sorted({r.action for r in recordings if r.action})),
        "sources": tuple(sorted({r.source or str(r.path) for r in recordings})),
    }


def expand_path(path: str) -> str:
    """Return a path with its `$NAME` and `~` filled in.

    Raises:
        InputError: a variable that is not set.
    """
    for braced, plain in re.findall(r"\$(?:\{(\w+)\}|(\w+))", path):
        name = braced or plain
        if not os.environ.get(name):
            raise InputError(
                f"{path}: the environment variable {name} is not set; set it to the folder of the "
                "recordings, or give the path itself"
            )
    return os.path.expanduser(os.path.expandvars(path))


def fingerprint(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the number of recordings, frames and persons, and a digest of all of it."""
    return {
        "count": len(recordings),
        "frames": sum(len(r) for r in recordings),
        "persons": sorted({r.person_id for r in recordings}),
        "sha256": digest_of(part for recording in recordings for part in _contents(recording)),
    }


def _contents(recording: Recording) -> list[str | Tensor]:
    """Return what a recording is told from others by."""
    facts = (recording.person_id, recording.fps, recording.names, recording.joints.shape)
    parts: list[str | Tensor] = [repr(facts), recording.joints]
    return parts if recording.weights is None else [*parts, recording.weights]
