"""Prepare recordings for a fit: find errors, leave them out, report them, and split recordings by person."""

from torchpose.learning._curation.bones import (
    BONE_RATIOS,
    bone_lengths,
    face_camera,
    find_wrong_joints,
    harmonise_bones,
    mirrored,
    person_bones,
    torso_rotation,
)
from torchpose.learning._curation.curate import Curated, CurationSettings, curate
from torchpose.learning._curation.joints import JUMP_SPEEDS, find_jumps
from torchpose.learning._curation.report import CurationReport, Drop
from torchpose.learning._curation.splits import (
    Duplicate,
    PersonSplit,
    check_kinds,
    find_duplicates,
    leave_one_person_out,
    persons_of,
    pick_persons,
    refuse_leaks,
    split_persons,
)

__all__ = [
    "BONE_RATIOS",
    "JUMP_SPEEDS",
    "Curated",
    "CurationReport",
    "CurationSettings",
    "Drop",
    "Duplicate",
    "PersonSplit",
    "bone_lengths",
    "check_kinds",
    "curate",
    "face_camera",
    "find_duplicates",
    "find_jumps",
    "find_wrong_joints",
    "harmonise_bones",
    "leave_one_person_out",
    "mirrored",
    "person_bones",
    "persons_of",
    "pick_persons",
    "refuse_leaks",
    "split_persons",
    "torso_rotation",
]
