"""Recordings made ready for a prior: what is wrong in them found, left out and said; persons kept apart."""

from torchpose.curation.bones import BONE_RATIOS, bone_lengths, find_wrong_joints, person_bones
from torchpose.curation.curate import Curated, CurationSettings, complete_runs, curate
from torchpose.curation.duplicates import Duplicate, find_duplicates
from torchpose.curation.harmonise import harmonise_bones
from torchpose.curation.jumps import JUMP_SPEEDS, find_jumps
from torchpose.curation.kinds import check_kinds
from torchpose.curation.mirror import mirrored
from torchpose.curation.normalise import face_camera, torso_rotation
from torchpose.curation.report import CurationReport, Drop
from torchpose.curation.splits import (
    PersonSplit,
    leave_one_person_out,
    persons_of,
    pick_persons,
    refuse_leaks,
    split_persons,
)
from torchpose.skeleton import scale_bones

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
    "complete_runs",
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
    "scale_bones",
    "split_persons",
    "torso_rotation",
]
