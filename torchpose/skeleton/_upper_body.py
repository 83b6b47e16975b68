"""Map joint sets to the eight joints of the upper body.

Left and right are the person's own. Three joints differ between joint sets under one name, and are
distinguished here:

- the neck, by its height above the middle of the shoulders: ``"neck"`` (9 to 13 cm: Kinect v1
  shoulder_center, Kinect v2 and Azure Neck, CMU upperneck), ``"low-neck"`` (2 to 5 cm: Berkeley
  MHAD, CMU lowerneck, Kinect v2 SpineShoulder), ``"mid-shoulder"`` (0 cm: the authors' recording,
  OpenPose);
- the hand: ``"hand"`` or ``"wrist"``, 6 to 7 cm apart;
- the head: ``"head"``, or ``"nose"`` where the caller asked for it.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import SkeletonError
from torchpose.skeleton._joint_sets import (
    UPPER_BODY,
    canonical_names,
    identify_skeleton,
)

ARM_JOINTS = ("hand", "elbow", "shoulder", "head", "neck")
"""The five joints of one arm's state, in its order."""

LEFT_ARM = (0, 1, 2, 3, 4)
"""Indices into `UPPER_BODY` of the left arm, in the order of `ARM_JOINTS`."""

RIGHT_ARM = (7, 6, 5, 3, 4)
"""Indices into `UPPER_BODY` of the right arm, in the order of `ARM_JOINTS`."""

LIMBS = ((0, 1), (1, 2), (2, 4), (3, 4), (4, 5), (5, 6), (6, 7))
"""Pairs of `UPPER_BODY` indices to join by a line."""

BONES = ((4, 3), (4, 2), (2, 1), (1, 0), (4, 5), (5, 6), (6, 7))
"""Bones between joints of `UPPER_BODY`, from the neck outwards: the nearer joint, the farther one."""

_BONE_LEVELS = ((0, 1, 4), (2, 5), (3, 6))  # of BONES, from the neck outwards
OTHER_SIDE = (7, 6, 5, 3, 4, 2, 1, 0)
"""Indices into `UPPER_BODY` of the joints of the other side; head and neck stay."""

NECK_KINDS = ("neck", "low-neck", "mid-shoulder")
"""Kinds of neck, from the highest to the lowest."""

_NECKS = (("neck", None), ("upper_neck", "neck"), ("shoulder_center", "neck"),
          ("lower_neck", "low-neck"), ("spine_shoulder", "low-neck"))  # fmt: skip


class UpperBodyMap(NamedTuple):
    """Holds the places of the eight joints of `UPPER_BODY` in a joint set.

    indices: eight indices into the set, -1 where it has no such joint. missing: names of those.
    neck: kind of neck, None if the names do not tell (or there is none). hand: ``"hand"``,
    ``"wrist"`` or None. head: ``"head"``, ``"nose"`` or None.
    """

    indices: tuple[int, ...]
    missing: tuple[str, ...]
    neck: str | None
    hand: str | None
    head: str | None


class UpperBody(NamedTuple):
    """Holds eight joints [..., 8, C], NaN where absent, and the kinds of their neck, hand and head."""

    joints: Tensor
    neck: str | None
    hand: str | None
    head: str | None


def upper_body_indices(names: Sequence[str], nose_as_head: bool = False) -> UpperBodyMap:
    """Find the eight upper-body joints among `names`.

    The hand is the hand, else the wrist; the neck is the neck, else CMU's upperneck, else Kinect
    v1's shoulder_center, else a lower one.

    Args:
        names: joint names of the set.
        nose_as_head: take the nose where there is no head.

    Returns:
        `UpperBodyMap` with eight indices into `names`, -1 where a joint is missing.

    Raises:
        SkeletonError: an unknown name, two names of one joint, a hand on one side and a wrist on
            the other, or none of the eight joints.

    >>> upper_body_indices(["head", "lwrist", "rwrist"])[:2]
    ((1, -1, -1, 0, -1, -1, -1, 2), ('elbow_left', 'shoulder_left', 'neck', 'shoulder_right', 'elbow_right'))
    """
    return _find_upper_body(tuple(str(name) for name in names), nose_as_head)


@lru_cache(maxsize=1024)
def _find_upper_body(names: tuple[str, ...], nose_as_head: bool) -> UpperBodyMap:
    canonical = canonical_names(names)
    where = {name: i for i, name in enumerate(canonical)}
    hand = _hand_kind(canonical)
    head = next((h for h in ("head", "nose")[: 1 + nose_as_head] if h in where), None)
    neck_name, neck = next(((n, kind) for n, kind in _NECKS if n in where), (None, None))
    skeleton = identify_skeleton(names)
    if neck_name == "neck" and skeleton is not None:
        neck = skeleton.neck
    found = {side: f"{hand}_{side}" for side in ("left", "right")}
    wanted = {"head": head, "neck": neck_name,
              "hand_left": found["left"], "hand_right": found["right"]}  # fmt: skip
    indices = tuple(where.get(str(wanted.get(joint, joint)), -1) for joint in UPPER_BODY)
    missing = tuple(j for j, i in zip(UPPER_BODY, indices, strict=True) if i < 0)
    if len(missing) == len(UPPER_BODY):
        raise SkeletonError(
            f"expected some of {', '.join(UPPER_BODY)}, found only {', '.join(map(str, names))}"
        )
    return UpperBodyMap(indices, missing, neck, hand, head)


def neck_of_detectors(names: Sequence[str]) -> str | None:
    """Return the kind of a neck that stands beside a face and without a head, or None.

    Detectors such as OpenPose, whose neck is the middle of the shoulders, mark faces in place of heads.

    Raises:
        SkeletonError: an unknown name, or two names of one joint.

    >>> neck_of_detectors(["Nose", "Neck", "LWrist"]), neck_of_detectors(["Head", "Neck", "LWrist"])
    ('mid-shoulder', None)
    """
    known = set(canonical_names(names))
    face = {"nose", "eye_left", "eye_right", "ear_left", "ear_right"} & known
    return "mid-shoulder" if face and "neck" in known and "head" not in known else None


def _hand_kind(canonical: Sequence[str]) -> str | None:
    sides = {kind: {s for s in ("left", "right") if f"{kind}_{s}" in canonical}
             for kind in ("hand", "wrist")}  # fmt: skip
    hands, wrists = sides["hand"], sides["wrist"]
    if not hands:
        return "wrist" if wrists else None
    if wrists - hands:  # one side has only a wrist
        if hands <= wrists:
            return "wrist"
        raise SkeletonError(
            f"got a hand on the {hands.pop()} and a wrist on the {wrists.pop()}; they are 6 to 7 "
            "cm apart: give the same on both sides"
        )
    return "hand"


def measure_neck_kind(joints: Float[Tensor, "... 8 3"]) -> str | None:
    """Return the kind of neck by its median distance from the middle of the shoulders, or None without them.

    Args:
        joints: the eight joints [..., 8, 3], metres.

    Returns:
        ``"mid-shoulder"`` below 1.5 cm, ``"low-neck"`` below 7.5 cm, else ``"neck"``.
    """
    check_shape("joints", joints, ["...", 8, 3])
    gap = (joints[..., 4, :] - (joints[..., 2, :] + joints[..., 5, :]) / 2).norm(dim=-1)
    gap = gap[torch.isfinite(gap)]
    if gap.numel() == 0:
        return None
    middle = float(gap.median())
    return "mid-shoulder" if middle < 0.015 else "low-neck" if middle < 0.075 else "neck"


def to_upper_body(
    joints: Float[Tensor, "... J C"], names: Sequence[str], nose_as_head: bool = False
) -> UpperBody:
    """Pick the eight upper-body joints out of a joint set.

    Args:
        joints: [..., J, C]: C = 3 (metres) or 2 (pixels).
        names: the J names.
        nose_as_head: take the nose where there is no head.

    Returns:
        `UpperBody`: joints [..., 8, C] in the order of `UPPER_BODY`, NaN where absent. Where the
        names do not tell the kind of neck and the joints are 3D, it is measured.

    Raises:
        ShapeError: J names and another number of joints. SkeletonError: as `upper_body_indices`.
    """
    check_shape("joints", joints, ["...", len(names), None])
    found = upper_body_indices(names, nose_as_head)
    index = torch.tensor(found.indices, device=joints.device)
    picked = joints.index_select(-2, index.clamp_min(0))
    upper = torch.where((index < 0)[:, None], torch.nan, picked)
    neck = found.neck
    if neck is None and "neck" not in found.missing and upper.shape[-1] == 3:
        neck = measure_neck_kind(upper)
    return UpperBody(upper, neck, found.hand, found.head)


def mirror_pose(joints: Float[Tensor, "... 8 3"]) -> Float[Tensor, "... 8 3"]:
    """Return the mirrored person: x changes sign and left becomes right.

    Args:
        joints: the eight joints, camera axes.
    """
    return joints[..., list(OTHER_SIDE), :] * joints.new_tensor([-1.0, 1.0, 1.0])


def scale_bones(
    joints: Float[Tensor, "... 8 3"], factors: Float[Tensor, "... 7"]
) -> Float[Tensor, "... 8 3"]:
    """Return the bones of other lengths in the same directions, rebuilt from the neck outwards.

        x'_neck = x_neck,   x'_b = x'_a + f_ab (x_b - x_a)

    Args:
        joints: of `UPPER_BODY`. factors: f of each of `BONES`; leading dimensions broadcast.

    Returns:
        Joints; those beyond a missing one are missing, because nothing tells where they would be.
    """
    check_shape("joints", joints, ["...", len(UPPER_BODY), 3])
    check_shape("factors", factors, ["...", len(BONES)])
    built = joints.clone()
    for level in _BONE_LEVELS:
        near, far = ([BONES[bone][end] for bone in level] for end in (0, 1))
        bones = joints[..., far, :] - joints[..., near, :]
        built[..., far, :] = built[..., near, :] + factors[..., list(level), None] * bones
    return built
