"""Clips of the protocol Bend: single performances cut out of recordings, and their splits.

A recording holds several bends; a performance is one of them, from upright to upright.
"""

from collections.abc import Sequence

from benchmarks.bodies.clips import Split, select_persons
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip
from torchpose.learning import split_repetitions
from torchpose.priors import posture_angles

_LEAST_FRAMES = 12  # of a performance


def leave_one_out(
    clips: Sequence[MocapClip],
    persons: Sequence[str] = (),
    *,
    n_clips: int = 1,
    n_frames: int = 86,
) -> list[Split]:
    """Leave one person out after the other: tracked in their first recordings; the others train.

    The other recordings of the person tell bone lengths and radii.

    Args:
        clips: of one action. persons: who is tracked; everybody if empty.
        n_clips: recordings that are tracked of each. n_frames: of each, from its first repetition.

    Raises:
        InputError: nobody of that name, one person only, or no recording beside the tracked ones.
    """
    everybody = select_persons(clips, ())
    chosen = select_persons(clips, persons)
    if len(everybody) < 2:
        raise InputError(
            f"one person is left out and the others train: expected two persons or more, got "
            f"{', '.join(everybody)}"
        )
    folds = []
    for person, own in chosen.items():
        if len(own) <= n_clips:
            raise InputError(
                f"person {person}: expected more than {n_clips} recordings, of which one tells the "
                f"bone lengths, got {len(own)}"
            )
        others = [clip for name, group in everybody.items() if name != person for clip in group]
        folds.append(Split(
            person,
            tuple(first_bend(clip, n_frames) for clip in own[:n_clips]),
            tuple(part for clip in others for part in performances(clip)),
            (), (first_bend(own[n_clips], n_frames), *own[n_clips + 1 :]), seen=False,
        ))  # fmt: skip
    return folds


def action_clips(
    clips: Sequence[MocapClip], actions: Sequence[str]
) -> dict[str, dict[str, list[MocapClip]]]:
    """Return recordings by action and person, in the order asked for.

    Raises:
        InputError: an action that nobody performed.
    """
    known = dict.fromkeys(clip.action for clip in clips)
    missing = [name for name in actions if name not in known]
    if missing:
        raise InputError(
            f"expected recordings of {', '.join(missing)}; there are {', '.join(known)}"
        )
    return {
        name: select_persons([clip for clip in clips if clip.action == name], ())
        for name in actions
    }


def performances(clip: MocapClip) -> list[MocapClip]:
    """Return the single repetitions of a recording; the whole of it where nothing is repeated."""
    parts = [clip.cut(p.start, p.stop) for p in _repetitions(clip)]
    return [part for part in parts if len(part) >= _LEAST_FRAMES] or [clip]


def first_bend(clip: MocapClip, n_frames: int) -> MocapClip:
    """Return so many frames from the start of the first repetition, or the last ones of the recording."""
    start = min(_repetitions(clip)[0].start, max(len(clip) - n_frames, 0))
    return clip.cut(start, start + n_frames)


def _repetitions(clip: MocapClip) -> list[slice]:
    return split_repetitions(posture_angles(clip.joints), clip.fps)
