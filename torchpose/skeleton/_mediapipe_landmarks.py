"""Derive head, neck and hands, as priors have them, from MediaPipe's landmarks.

MediaPipe marks nose, eyes and ears but no head, shoulders but no neck, and wrists and fingers but no
hand; and its shoulders lie higher than Kinect's. A tracker takes position and scale of the body from head
and neck, so they have to be where the prior has them relative to the shoulders. With the ears or the
nose as head, the estimated person is a third too small.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import SkeletonError
from torchpose.skeleton._joint_sets import canonical_names

LANDMARKS = (
    "nose",
    "left_eye_inner", "left_eye", "left_eye_outer",
    "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear",
    "mouth_left", "mouth_right",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_pinky", "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb",
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
"""The 33 landmarks of MediaPipe's pose models, in their order."""

DERIVED_JOINTS = ("head", "neck", "hand_left", "hand_right")
"""What `derive_joints` adds."""

_HEAD_WIDTHS, _HEAD_EARS = 1.0, 1.45
_NECK = 0.27
_HAND = 0.7
_NEEDED = tuple(f"{part}_{side}" for part in ("ear", "shoulder", "wrist", "index")
                for side in ("left", "right"))  # fmt: skip


def lacks_joints(names: Sequence[str]) -> bool:
    """Return whether these are landmarks from which `derive_joints` can make head, neck and hands.

    >>> lacks_joints(LANDMARKS), lacks_joints(["head", "neck", "left_wrist", "right_wrist"])
    (True, False)
    """
    known = set(canonical_names(names))
    return known.issuperset(_NEEDED) and known.isdisjoint(DERIVED_JOINTS)


def count_given(names: Sequence[str]) -> int:
    """Return how many of these joints are measured, and not appended by `derive_joints`.

    >>> count_given((*LANDMARKS, *DERIVED_JOINTS)), count_given(["head", "neck"])
    (33, 2)
    """
    given = names[: -len(DERIVED_JOINTS)]
    appended = tuple(names[len(given) :]) == DERIVED_JOINTS and lacks_joints(given)
    return len(given) if appended else len(names)


def derive_joints(
    points: Float[Tensor, "*batch J C"],
    visibility: Float[Tensor, "*batch J"] | None,
    names: Sequence[str],
) -> tuple[Tensor, Tensor | None, tuple[str, ...]]:
    """Append head, neck and hands, as priors have them, to MediaPipe's landmarks.

        m = (shoulder_left + shoulder_right) / 2,   e = (ear_left + ear_right) / 2,
        w = |shoulder_left - shoulder_right|,       u = (e - m) / |e - m|,
        head = m + max(w, 1.45 |e - m|) u,          neck = m + 0.27 (head - m),
        hand = wrist + 0.7 (index - wrist)

    In Kinect's recordings (UTD-MHAD, eight persons standing) the head is 0.80 to 1.00 w above m and the
    neck 0.29 to 0.37 w. Here they are put where the elbows and shoulders that a tracker infers from
    them come close to MediaPipe's on seven webcam clips of three signers
    (benchmarks/mediapipe_front_end.py, which also chooses them on two signers and scores the third). The
    head is then about at the crown and the neck at the throat. The second term takes over when a person
    turns aside and the shoulders come close in the image; no clip tries it.

    Args:
        points: [*batch, J, C], pixels (C = 2) or metres (C = 3), NaN where missing.
        visibility: [*batch, J], 0 to 1, or None.
        names: the names of the J landmarks; those of `LANDMARKS` or a part of them.

    Returns:
        points [*batch, J + 4, C], visibility [*batch, J + 4] (the least of the landmarks that a joint
        comes from) and names. Where a landmark is missing, so is what comes from it.

    Raises:
        SkeletonError: ears, shoulders, wrists and index fingers are not all there, or a head, neck or
            hand already is. ShapeError: shapes that do not fit.

    >>> points, _, names = derive_joints(torch.rand(5, 33, 2), None, LANDMARKS)
    >>> points.shape, names[-4:]
    (torch.Size([5, 37, 2]), ('head', 'neck', 'hand_left', 'hand_right'))
    """
    check_shape("points", points, ["...", len(names), None])
    if not lacks_joints(names):
        raise SkeletonError(
            "expected landmarks with ears, shoulders, wrists and index fingers, and without head, "
            f"neck and hands, got {', '.join(map(str, names))}"
        )
    where = {name: i for i, name in enumerate(canonical_names(names))}

    def pair(part: str) -> Tensor:
        return points[..., [where[f"{part}_left"], where[f"{part}_right"]], :]

    shoulders, wrists = pair("shoulder"), pair("wrist")
    middle = shoulders.mean(-2)
    to_ears = pair("ear").mean(-2) - middle
    height = torch.linalg.vector_norm(to_ears, dim=-1, keepdim=True)
    width = torch.linalg.vector_norm(shoulders[..., 0, :] - shoulders[..., 1, :], dim=-1)[..., None]
    reach = torch.maximum(_HEAD_WIDTHS * width, _HEAD_EARS * height)
    to_head = reach * to_ears / height.clamp_min(1e-6)
    neck = middle + _NECK * to_head
    hands = wrists + _HAND * (pair("index") - wrists)
    made = torch.cat([torch.stack([middle + to_head, neck], -2), hands], -2)
    new_names = (*(str(name) for name in names), *DERIVED_JOINTS)
    if visibility is None:
        return torch.cat([points, made], -2), None, new_names
    check_shape("visibility", visibility, list(points.shape[:-1]))
    trunk = [where[f"{part}_{side}"] for part in ("ear", "shoulder") for side in ("left", "right")]
    parts = [trunk, trunk]
    parts += [[where[f"wrist_{side}"], where[f"index_{side}"]] for side in ("left", "right")]
    least = torch.stack([visibility[..., rows].amin(-1) for rows in parts], -1)
    return torch.cat([points, made], -2), torch.cat([visibility, least], -1), new_names
