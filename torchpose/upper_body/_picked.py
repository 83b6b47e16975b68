"""Find the eight joints of the upper body among the keypoints of a caller."""

from collections.abc import Sequence
from typing import NamedTuple

from torchpose.errors import InputError
from torchpose.skeleton._joint_sets import UPPER_BODY, canonical_names
from torchpose.skeleton._torso import KINECT_NECK
from torchpose.skeleton._upper_body import neck_of_detectors, upper_body_indices
from torchpose.upper_body._face_points import FACE

_NECK = UPPER_BODY.index("neck")
_WRISTS = "wrists are measured in place of hands: hand_left and hand_right are the wrists"
_LEFT, _RIGHT = UPPER_BODY.index("shoulder_left"), UPPER_BODY.index("shoulder_right")


class Picked(NamedTuple):
    """Places of the eight joints among the keypoints.

    Attributes:
        indices: the place of each joint, -1 if absent; with `middle`, that of the neck is the keypoint that
            lies in the middle of the shoulders.
        middle: whether the neck is to be put between that, or else the middle of the measured
            shoulders, and the head (`place_measured_neck`).
        notes: the assumptions about the neck. of_hands: those about hands of another kind than the prior's,
            by estimators that take one kind for the other.
        hand: the kind of the hands, "hand" or "wrist"; None where the names do not tell.
        face: the places of nose, eyes and ears (`FACE`) among the keypoints, -1 if absent.
        names: of all keypoints.
    """

    indices: tuple[int, ...]
    middle: bool
    notes: tuple[str, ...]
    hand: str | None = None
    face: tuple[int, ...] = (-1,) * len(FACE)
    of_hands: tuple[str, ...] = ()
    names: tuple[str, ...] = ()

    @property
    def wrists_for_hands(self) -> bool:
        """Return whether wrists are measured in place of the prior's hands."""
        return self.hand == "wrist" and bool(self.of_hands)

    def hand_notes(self, knows_wrists: bool) -> tuple[str, ...]:
        """Return the notes about hands of another kind than the prior's.

        Args:
            knows_wrists: whether the estimator tells wrists from hands.
        """
        if not knows_wrists:
            return self.of_hands
        return (_WRISTS,) if self.wrists_for_hands else ()

    @property
    def middle_alone(self) -> bool:
        """Return whether of the shoulders their middle alone is measured."""
        return self.middle and min(self.indices[_LEFT], self.indices[_RIGHT]) < 0

    @property
    def there(self) -> list[bool]:
        """Return for each of the eight joints whether it is among the keypoints."""
        return [i >= 0 for i in self.indices]


def pick_joints(
    n_joints: int,
    names: Sequence[str] | None,
    neck: str | None,
    wanted_neck: str | None,
    wanted_hand: str | None,
) -> Picked:
    """Find the eight joints among the keypoints.

    Args:
        n_joints: the number of keypoints. names: their names; None if they are the eight in order.
        neck: the kind of neck of the keypoints where the names do not tell; one of another kind than
            `wanted_neck` is not measured as it is. wanted_neck, wanted_hand: the prior's kinds.

    Raises:
        InputError: names missing, or not as many as keypoints. SkeletonError: unknown names.
    """
    if names is None:
        if n_joints != len(UPPER_BODY):
            raise InputError(
                f"names may be left out only for the {len(UPPER_BODY)} joints "
                f"{', '.join(UPPER_BODY)}; got {n_joints} keypoints without names"
            )
        names = UPPER_BODY
    if len(names) != n_joints:
        raise InputError(
            f"names must name each of the {n_joints} keypoints, got {len(names)} names"
        )
    found = upper_body_indices(names)
    indices = list(found.indices)
    kind = neck or found.neck or neck_of_detectors(names)
    middle, notes = False, []
    other = indices[_NECK] >= 0 and None not in (kind, wanted_neck) and kind != wanted_neck
    if other or indices[_NECK] < 0:
        indices[_NECK] = indices[_NECK] if kind == "mid-shoulder" else -1
        shoulders = min(indices[_LEFT], indices[_RIGHT]) >= 0
        middle = wanted_neck == "neck" and (shoulders or indices[_NECK] >= 0)
        if not middle:
            indices[_NECK] = -1
        notes += _neck_notes(kind if other else None, wanted_neck, middle)
    of_hands: tuple[str, ...] = ()
    if found.hand is not None and wanted_hand is not None and found.hand != wanted_hand:
        of_hands = (f"the keypoints' {found.hand}s stand for the prior's {wanted_hand}s",)
    known = canonical_names(names)
    face = tuple(known.index(name) if name in known else -1 for name in FACE)
    return Picked(tuple(indices), middle, tuple(notes), found.hand, face, of_hands, tuple(names))


def _neck_notes(kind: str | None, wanted: str | None, middle: bool) -> list[str]:
    """Return the notes about a neck of another kind, or about one that is missing (None)."""
    if middle:
        own = (
            "there is no neck among the keypoints"
            if kind is None
            else (f"the keypoints' neck ({kind}) is not the prior's ({wanted})")
        )
        share = f"{100 * KINECT_NECK.fraction:.0f} %"
        return [
            f"{own}: put {share} of the way from the middle of the shoulders to the head, and upright "
            "above them where there is no head"
        ]
    if kind is None:
        return []
    return [f"the keypoints' neck ({kind}) is not the prior's ({wanted}): not measured"]
