"""Curate recordings: apply all checks and changes in order, and report them."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpose._core.wording import counted
from torchpose.errors import InputError
from torchpose.io._recordings import Recording
from torchpose.learning._curation.bones import (
    BONE_RATIOS,
    face_camera,
    find_wrong_joints,
    harmonise_bones,
    human_size,
    mirrored,
    person_bones,
)
from torchpose.learning._curation.joints import (
    JUMP_SPEEDS,
    find_jumps,
    label,
    measured,
    with_missing,
)
from torchpose.learning._curation.report import CurationReport, Drop, Size, drop_frames
from torchpose.learning._curation.splits import (
    check_kinds,
    describe_duplicate,
    notes_of_reading,
    refuse_shared_between_persons,
    same_names,
    skeleton_counts,
    unstated_rates,
)
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM

_RATE = 30.0  # of recordings that do not say: a Kinect's
_LEFT, _RIGHT = UPPER_BODY.index("shoulder_left"), UPPER_BODY.index("shoulder_right")


class CurationSettings(NamedTuple):
    """Holds the settings of `curate`.

    Attributes:
        jump_speeds: bounds in m/s of the eight joints (`find_jumps`); None leaves jumps in.
        bone_ratios: bounds of the bones (`find_wrong_joints`); None leaves them in.
        person_frames: frames with a whole arm that a person needs; persons with fewer are dropped.
        companions: whether to keep other people in a person's file. Nobody says who they are, so one
            of them may be in training and test.
        duplicates: ``drop`` the second of two recordings of one person, or ``refuse``. Under two
            persons they are always refused.
        face_camera: None, ``recording`` or ``pose`` (`torchpose.learning._curation.face_camera`).
        harmonise: give everybody the bones of the mean person among the recordings; do so after a
            split, so that test persons have no part in that mean.
        mirror: add a mirrored copy of every recording.
    """

    jump_speeds: tuple[float, ...] | None = JUMP_SPEEDS
    bone_ratios: tuple[float, ...] | None = BONE_RATIOS
    person_frames: int = 100
    companions: bool = False
    duplicates: str = "drop"
    face_camera: str | None = None
    harmonise: bool = False
    mirror: bool = False


DEFAULTS = CurationSettings()


class Curated(NamedTuple):
    """Holds the recordings that are left, and a report on the others."""

    recordings: list[Recording]
    report: CurationReport


def curate(recordings: Sequence[Recording], settings: CurationSettings = DEFAULTS) -> Curated:
    """Leave out of recordings what would spoil a prior, and report it.

    In this order: kinds that cannot be mixed and infinite values are refused; other people in a file
    and recordings that are there twice are dropped; joints that jump, joints at the end of bones of a
    wrong length, and poses that are no body become missing (NaN, weight 0); persons of whom too
    little is left, or who have no person's size, are dropped. On request bodies are turned towards
    the camera, bones made alike, and mirrored copies added. Nothing is interpolated.

    Args:
        recordings: the recordings, in camera axes (`torchpose.io.read_recordings`); they are not changed.
        settings: bounds and what to do.

    Returns:
        `Curated`: new recordings, and a `CurationReport` on what was left out.

    Raises:
        InputError: no recordings, none left, infinite values, unknown settings. PriorError: kinds of
            hand or head mixed. OverlapError: one recording under two persons.
    """
    _check_settings(settings)
    check_kinds(recordings)
    _check_finite(recordings)
    drops: list[Drop] = []
    kept = _without_companions(list(recordings), settings, drops)
    kept = _without_duplicates(kept, settings, drops)
    if settings.jump_speeds is not None:
        kept = [_without_jumps(r, settings.jump_speeds, drops) for r in kept]
    if settings.bone_ratios is not None:
        kept = _without_wrong_bones(kept, settings.bone_ratios, drops)
    kept = _without_short_persons(kept, settings.person_frames, drops)
    if not kept:
        raise InputError(
            "nothing is left of the recordings: "
            + "; ".join(drop.text() for drop in sorted(drops, key=lambda d: -d.n_frames)[:3])
        )
    after = _size(kept)
    if settings.face_camera is not None:
        kept = [face_camera(r, settings.face_camera) for r in kept]  # type: ignore[arg-type]
    if settings.harmonise:
        kept = harmonise_bones(kept)
    if settings.mirror:
        kept += [mirrored(r) for r in kept]
    report = CurationReport(
        _size(recordings), after, tuple(drops), notes_on_recordings(recordings), settings._asdict()
    )
    return Curated(kept, report)


# --- the steps ------------------------------------------------------------------------------------


def _check_settings(settings: CurationSettings) -> None:
    if settings.duplicates not in ("drop", "refuse"):
        raise InputError(f"duplicates must be drop or refuse, got {settings.duplicates!r}")
    if settings.face_camera not in (None, "recording", "pose"):
        raise InputError(
            f"face_camera must be None, recording or pose, got {settings.face_camera!r}"
        )
    if settings.bone_ratios is not None and min(settings.bone_ratios) <= 1:
        raise InputError(f"bone_ratios must be above 1, got {min(settings.bone_ratios)}")


def _check_finite(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        infinite = torch.isinf(recording.joints)
        if bool(infinite.any()):
            frame, joint = torch.nonzero(infinite)[0, :2].tolist()
            raise InputError(
                f"{label(recording)}, person {recording.person_id}: {recording.names[joint]} is "
                f"infinite in frame {recording.first_frame + frame}; use NaN for what is missing"
            )


def _without_companions(
    recordings: list[Recording], settings: CurationSettings, drops: list[Drop]
) -> list[Recording]:
    if settings.companions:
        return recordings
    why = "nobody says who this is"
    drops += [_drop_whole("companion", r, why) for r in recordings if r.companion]
    return [r for r in recordings if not r.companion]


def _without_duplicates(
    recordings: list[Recording], settings: CurationSettings, drops: list[Drop]
) -> list[Recording]:
    copies: set[int] = set()
    for found in refuse_shared_between_persons(recordings):
        if settings.duplicates == "refuse":
            both = describe_duplicate(found, recordings)
            raise InputError(f"{both}; remove one, or set duplicates to drop")
        first, second = recordings[found.first], recordings[found.second]
        if not {found.first, found.second} & copies:
            shorter = found.second if len(second) <= len(first) else found.first
            kept = found.first + found.second - shorter
            copies.add(shorter)
            why = f"also in {label(recordings[kept])}"
            drops.append(_drop_whole("duplicate", recordings[shorter], why))
    return [r for i, r in enumerate(recordings) if i not in copies]


def _without_jumps(recording: Recording, speeds: tuple[float, ...], drops: list[Drop]) -> Recording:
    jumps = find_jumps(recording.upper_body().joints, recording.fps or _RATE, speeds)
    return _mark_missing(recording, jumps, "jump", drops)


def _without_wrong_bones(
    recordings: list[Recording], ratios: tuple[float, ...], drops: list[Drop]
) -> list[Recording]:
    usual = person_bones(recordings)
    shoulders = _shoulder_widths(recordings)
    kept = []
    for recording in recordings:
        body = recording.upper_body()
        bones = usual[recording.person_id, body.neck]
        size = human_size(bones, shoulders.get(recording.person_id))
        if size:
            drops.append(_drop_whole("no person's size", recording, size))
            continue
        found = find_wrong_joints(body.joints, bones, ratios)
        there = measured(body.joints)
        nobody = (found.frames[:, None] & there).any(1)
        if bool(nobody.any()):
            drops.append(_drop_some("no body", recording, "", nobody))
        recording = with_missing(recording, nobody[:, None] & there)
        wrong = found.joints & ~nobody[:, None]
        kept.append(_mark_missing(recording, wrong, "bone length", drops))
    return kept


def _without_short_persons(
    recordings: list[Recording], least: int, drops: list[Drop]
) -> list[Recording]:
    frames: Counter[str] = Counter()
    for recording in recordings:
        frames[recording.person_id] += _usable_frames(recording)
    short = {person for person, count in frames.items() if count < least}
    for recording in recordings:
        person = recording.person_id
        if person in short:
            why = f"{counted(frames[person], 'frame')} of this person with a whole arm, {least} are needed"
            drops.append(_drop_whole("too few frames", recording, why))
    return [r for r in recordings if r.person_id not in short]


def _mark_missing(recording: Recording, wrong: Tensor, reason: str, drops: list[Drop]) -> Recording:
    wrong = wrong & measured(recording.upper_body().joints)
    for joint in torch.nonzero(wrong.any(0)).flatten().tolist():
        drops.append(_drop_some(reason, recording, UPPER_BODY[joint], wrong[:, joint]))
    return with_missing(recording, wrong)


# --- counting -------------------------------------------------------------------------------------


def _usable_frames(recording: Recording) -> int:
    """Count the frames in which an arm is complete; joints that the joint set lacks do not count."""
    there = measured(recording.upper_body().joints)
    there = there | ~there.any(0)
    whole = there[:, LEFT_ARM].all(1) | there[:, RIGHT_ARM].all(1)
    return int((whole & measured(recording.upper_body().joints).any(1)).sum())


def _shoulder_widths(recordings: Sequence[Recording]) -> dict[str, float]:
    widths: dict[str, list[Tensor]] = {}
    for recording in recordings:
        joints = recording.upper_body().joints
        width = (joints[:, _LEFT] - joints[:, _RIGHT]).norm(dim=-1)
        widths.setdefault(recording.person_id, []).append(width)
    return {person: float(torch.cat(w).nanmedian()) for person, w in widths.items()}


def _drop_whole(reason: str, recording: Recording, why: str) -> Drop:
    return drop_frames(
        reason, label(recording), recording.person_id, "", range(len(recording)),
        recording.first_frame, why,
    )  # fmt: skip


def _drop_some(reason: str, recording: Recording, joint: str, frames: Tensor) -> Drop:
    listed = torch.nonzero(frames).flatten().tolist()
    return drop_frames(
        reason, label(recording), recording.person_id, joint, listed, recording.first_frame
    )


def _size(recordings: Sequence[Recording]) -> Size:
    joints = sum(int(measured(r.upper_body().joints).sum()) for r in recordings)
    persons = len({r.person_id for r in recordings})
    return Size(persons, len(recordings), sum(map(len, recordings)), joints)


def notes_on_recordings(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return notes on all recordings together, then those of single ones, alike ones once."""
    notes = [*_same_folders(recordings), *same_names(recordings), *unstated_rates(recordings)]
    sets = skeleton_counts(recordings)
    if len(sets) > 1:
        mixed = ", ".join(f"{name} {n}" for name, n in sets.items())
        notes.append(f"joint sets are mixed: {mixed} recordings; necks are converted to one kind")
    return (*notes, *notes_of_reading(recordings))


def _same_folders(recordings: Sequence[Recording]) -> list[str]:
    """Return notes on folders of one name, which count as one person though they are several."""
    folders: dict[str, set[Any]] = {}
    for r in recordings:
        if r.path is not None and not r.person and not r.source:
            folders.setdefault(r.person_id, set()).add(r.path.parent.resolve())
    return [
        f"{len(found)} folders count as the one person {person}: {', '.join(sorted(map(str, found)))}"
        for person, found in folders.items()
        if len(found) > 1
    ]
