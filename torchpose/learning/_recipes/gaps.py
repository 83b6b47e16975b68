"""Fill short gaps of recordings, and cut recordings at long ones: motion is fitted to whole bodies."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.wording import counted, first_of
from torchpose.body._skeleton import BODY_15, body_joints
from torchpose.errors import InputError
from torchpose.io._recordings import Recording, cut_recording
from torchpose.learning._curation.splits import notes_of_reading, same_names
from torchpose.math._hermite import hermite

LONGEST_GAP = 0.2
"""Seconds from one whole frame to the next, up to which joints that are missing between are interpolated."""
_SHORTEST_PIECE = 0.5  # seconds of a recording between long gaps; shorter ones tell no motion
_ROUNDING = 1e-6  # relative error of the longest gap by rounding


def missing_joints(joints: Float[Tensor, "T J 3"]) -> Bool[Tensor, "T J"]:
    """Return which joints are missing, other than those that the recording never has."""
    missing = joints.isnan().any(-1)
    return missing & ~missing.all(0)


def fill_short_gaps(joints: Float[Tensor, "T J 3"], fps: float) -> Float[Tensor, "T J 3"]:
    """Return joints without gaps of up to 0.2 s, which are filled by cubic Hermite pieces.

    Whole frames are the knots, with slopes by differences of second order.

    Args:
        joints: metres, NaN where missing. fps: frames per second.
    """
    missing = missing_joints(joints)
    whole = ~missing.any(-1)
    if bool(whole.all()) or int(whole.sum()) < 2:
        return joints
    knots = whole.nonzero().squeeze(-1)
    time = torch.arange(len(joints), device=joints.device)
    after = torch.searchsorted(knots, time).clamp(1, len(knots) - 1)
    first, last = knots[after - 1], knots[after]
    d = last - first
    short = (first < time) & (time < last) & (d <= LONGEST_GAP * fps * (1 + _ROUNDING))
    points = joints[knots]
    slopes = torch.gradient(points, spacing=(knots.to(points),), dim=0)[0]
    s, d = (((time - first) / d).to(points)[:, None, None], d.to(points)[:, None, None])
    ends, sides = ((values[after - 1], values[after]) for values in (points, slopes))
    filled = hermite(s, ends, sides, d)
    return torch.where((missing & short[:, None])[..., None], filled, joints)


def whole_pieces(recordings: Sequence[Recording]) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings cut where joints are missing for longer, and notes on what was left out.

    Pieces of less than half a second are left out, too.

    Raises:
        InputError: nothing is left of a recording.
    """
    pieces, notes = [], []
    for recording in recordings:
        runs = _whole_runs(recording)
        length = sum(stop - start for start, stop in runs)
        if not runs:
            raise InputError(
                f"{_file_of(recording)}: no half a second in which all joints are there that the recording "
                "has; leave the file out"
            )
        if length == len(recording):
            pieces.append(recording)
            continue
        pieces += [cut_recording(recording, *run) for run in runs]
        notes.append(
            f"{_file_of(recording)}: {len(recording) - length} of {len(recording)} frames are left out, in "
            f"or beside gaps of more than {LONGEST_GAP:g} s"
        )
    return pieces, tuple(notes)


def notes_on_motion(recordings: Sequence[Recording], still: bool = True) -> tuple[str, ...]:
    """Return notes on persons of like names, on what reading assumed, and on joints that are not recorded.

    Args:
        recordings: of whole bodies. still: whether joints that a recording never has count as still.
    """
    notes = [*same_names(recordings), *notes_of_reading(recordings), *notes_on_gaps(recordings)]
    return (*notes, *(_notes_on_absent_joints(recordings) if still else ()))


def _notes_on_absent_joints(recordings: Sequence[Recording]) -> list[str]:
    absent = [
        tuple(_body(r).isnan().any(-1).all(0).nonzero().flatten().tolist()) for r in recordings
    ]
    frames = sum(len(r) for r, joints in zip(recordings, absent, strict=True) if joints)
    names = ", ".join(BODY_15.names[j] for j in sorted({j for joints in absent for j in joints}))
    return [
        f"{names}: never there in recordings of {frames} of {sum(map(len, recordings))} frames, and taken "
        "for still, so the model holds it too still; leave these recordings out where others have it"
    ] * bool(names)


def notes_on_gaps(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return a note if joints of recordings are interpolated, with the number of their frames."""
    counts = [int(missing_joints(_body(r)).any(-1).sum()) for r in recordings]
    if not any(counts):
        return ()
    files = [_file_of(r) for r, count in zip(recordings, counts, strict=True) if count]
    return (
        f"{counted(sum(counts), 'frame with missing joints is', 'frames with missing joints are')} "
        f"interpolated, in gaps of up to {LONGEST_GAP:g} s: "
        f"{first_of(files, 1)}",
    )


def _whole_runs(recording: Recording) -> list[tuple[int, int]]:
    """Return first frames and ends of the stretches without a long gap."""
    if recording.fps is None:
        return [(0, len(recording))]
    filled = fill_short_gaps(_body(recording), recording.fps)
    whole = ~missing_joints(filled).any(-1)
    if bool(whole.all()):
        return [(0, len(recording))]
    edges = torch.nn.functional.pad(whole.int(), (1, 1)).diff()
    starts, stops = ((edges == sign).nonzero().squeeze(-1) for sign in (1, -1))
    long = stops - starts >= _SHORTEST_PIECE * recording.fps
    return list(zip(starts[long].tolist(), stops[long].tolist(), strict=True))


def _body(recording: Recording) -> Float[Tensor, "T 15 3"]:
    return body_joints(recording.joints, recording.names)


def _file_of(recording: Recording) -> str:
    return str(recording.path or recording.person_id)
