"""Recordings made ready for a prior: what is wrong in them found, left out and said; persons kept apart."""

from torchpose._core.facade import set_up_facade
from torchpose.learning.curation.bones import (
    BONE_RATIOS,
    bone_lengths,
    find_wrong_joints,
    person_bones,
)
from torchpose.learning.curation.curate import Curated, CurationSettings, complete_runs, curate
from torchpose.learning.curation.duplicates import Duplicate, find_duplicates
from torchpose.learning.curation.harmonise import harmonise_bones
from torchpose.learning.curation.jumps import JUMP_SPEEDS, find_jumps
from torchpose.learning.curation.kinds import check_kinds
from torchpose.learning.curation.mirror import mirrored
from torchpose.learning.curation.normalise import face_camera, torso_rotation
from torchpose.learning.curation.report import CurationReport, Drop
from torchpose.learning.curation.splits import (
    PersonSplit,
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
    "split_persons",
    "torso_rotation",
]

set_up_facade(__name__)
