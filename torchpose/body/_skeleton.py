"""Describe the articulated body: joints, rigid parts, tips and limbs, and the map of joint sets to it.

Axes of a part: x to the person's left, y towards the part's parent end (up, in the rest pose:
standing, arms hanging), z forward; x cross y = z. Left and right are the person's own. Lengths in a
`BodySkeleton` are fractions of the body height, so that one skeleton serves every person.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import InputError, SkeletonError
from torchpose.math._tree_messages import tree_levels
from torchpose.skeleton._joint_sets import canonical_names

Offset = tuple[float, float, float]


@dataclass(frozen=True)
class Tip:
    """Describes a point of the body beyond its joints, fixed in a part's axes.

    Args:
        name: the name of the tip.
        joint: name of the joint it is measured from.
        part: name of the part that carries it.
        offset: the offset from the joint, in the part's axes, as fractions of the body height.
    """

    name: str
    joint: str
    part: str
    offset: Offset


@dataclass(frozen=True)
class TaperedCylinder:
    """Describes a limb as the convex hull of two spheres.

    Args:
        name: the name of the limb; ``left_`` and ``right_`` in front tell limbs of the two sides.
        start, end: names of joints or tips, the centres of the two spheres.
        radii: the radii of a clothed adult at start and end, as fractions of the body height.
    """

    name: str
    start: str
    end: str
    radii: tuple[float, float]


@dataclass(frozen=True)
class BodySkeleton:
    """Describes a tree of joints, the tree of rigid parts that carries it, and the limbs around both.

    The offset of a joint from its parent joint is fixed in the axes of the part that carries it; a
    part turns about the joint where it meets its parent part.

    Args:
        name: the name of the skeleton.
        names: the names of the J joints.
        parents: index of each joint's parent, -1 for the root.
        parts: names of the P rigid parts; the first one is the root part.
        part_of: index of the part that carries each joint's offset.
        part_parents: index of each part's parent part, -1 for the root part.
        directions: [J, 3], unit direction from the parent joint in the rest pose, in the axes of
            the carrying part; zero for the root.
        proportions: [J], distance from the parent joint as a fraction of the body height.
        tips: points beyond the joints.
        limbs: tapered cylinders between joints and tips.

    Raises:
        SkeletonError: lists of different lengths, a name twice or unknown, parents that form a
            cycle, more than one root, a joint carried by a part that does not meet its parent's.

    >>> BODY_15.dim, len(BODY_15.names), len(BODY_15.limbs)
    (36, 15, 17)
    """

    name: str
    names: tuple[str, ...]
    parents: tuple[int, ...]
    parts: tuple[str, ...]
    part_of: tuple[int, ...]
    part_parents: tuple[int, ...]
    directions: tuple[Offset, ...]
    proportions: tuple[float, ...]
    tips: tuple[Tip, ...] = ()
    limbs: tuple[TaperedCylinder, ...] = ()

    def __post_init__(self) -> None:
        _check_lengths(self)
        _check_names(self)
        if self.joint_levels[0] != (0,) or self.part_levels[0] != (0,):
            raise SkeletonError(
                f"the first joint and the first part of {self.name!r} must be the only roots "
                f"(parent -1), got parents {list(self.parents)} and {list(self.part_parents)}"
            )
        for joint, parent in enumerate(self.parents):
            part = self.part_of[joint]
            if joint and self.part_of[parent] not in (part, self.part_parents[part]):
                raise SkeletonError(
                    f"joint {self.names[joint]!r} is carried by {self.parts[part]!r}, which does "
                    f"not meet {self.parts[self.part_of[parent]]!r}, where its parent joint is"
                )

    @property
    def dim(self) -> int:
        """Return the dimension D of a state: 3 for the root position, 3 for the orientation of every part."""
        return 3 + 3 * len(self.parts)

    @cached_property
    def joint_levels(self) -> tuple[tuple[int, ...], ...]:
        """Return the joints by their depth in the tree, the root first."""
        return tree_levels(self.parents, self.names)

    @cached_property
    def part_levels(self) -> tuple[tuple[int, ...], ...]:
        """Return the parts by their depth in the tree, the root first."""
        return tree_levels(self.part_parents, self.parts)

    @cached_property
    def points(self) -> tuple[str, ...]:
        """Return the names of all points: the joints, then the tips."""
        return self.names + tuple(tip.name for tip in self.tips)

    @cached_property
    def mirrored_limbs(self) -> tuple[int, ...]:
        """Return the index of each limb's counterpart on the other side; its own in the middle."""
        where = {limb.name: i for i, limb in enumerate(self.limbs)}
        return tuple(where.get(other_side(limb.name), i) for i, limb in enumerate(self.limbs))

    def joint(self, name: str) -> int:
        """Return the index of a joint.

        Args:
            name: the name of the joint, as in `names`.

        Returns:
            Index from 0 to J - 1.

        Raises:
            SkeletonError: there is no such joint.
        """
        if name not in self.names:
            raise SkeletonError(f"no joint {name!r} in {self.name!r}: {', '.join(self.names)}")
        return self.names.index(name)

    def part(self, name: str) -> int:
        """Return the index of a part.

        Args:
            name: the name of the part, as in `parts`.

        Returns:
            Index from 0 to P - 1.

        Raises:
            SkeletonError: there is no such part.
        """
        if name not in self.parts:
            raise SkeletonError(f"no part {name!r} in {self.name!r}: {', '.join(self.parts)}")
        return self.parts.index(name)

    def single_joint(self, part: int) -> int | None:
        """Return the only joint that a part carries; the twist of that part about its bone is unobservable.

        Args:
            part: index of the part.

        Returns:
            Index of the joint; None where the part carries no joint or several.
        """
        carried = [j for j, p in enumerate(self.part_of) if p == part and self.parents[j] >= 0]
        return carried[0] if len(carried) == 1 else None

    def standard_lengths(self, height: float) -> Float[Tensor, " J"]:
        """Return the bone lengths of a person of average proportions.

        Args:
            height: body height, metres.

        Returns:
            [J], metres, distance from each joint's parent; 0 for the root.

        Raises:
            InputError: the height is not positive and finite.
        """
        return _positive("height", height) * torch.tensor(self.proportions, dtype=torch.float64)

    def standard_radii(self, height: float) -> Float[Tensor, "L 2"]:
        """Return the radii of the limbs of a clothed adult.

        Args:
            height: body height, metres.

        Returns:
            [L, 2], metres, at start and end of every limb.

        Raises:
            InputError: the height is not positive and finite.
        """
        radii = torch.tensor([limb.radii for limb in self.limbs], dtype=torch.float64)
        return _positive("height", height) * radii.reshape(-1, 2)

    def height(self, bone_lengths: Float[Tensor, " J"]) -> float:
        """Return the body height that follows from the lengths of the legs.

        H = sum of their lengths / sum of their proportions. Joint sets agree about the joints of the legs
        (CMU's wrist is 6 cm nearer to the elbow than that of others); the other bones count where the lengths
        of all leg bones are unknown.

        Args:
            bone_lengths: [J], metres, NaN where unknown.

        Returns:
            Height in metres.

        Raises:
            InputError: no bone length is finite.
        """
        lengths = bone_lengths.detach().tolist()
        bones = [*zip(self.proportions, lengths, strict=True)]
        legs = [
            bone for joint, bone in enumerate(bones)
            if bone[0] > _LEG_BONE and self.single_joint(self.part_of[joint]) == joint
        ]  # fmt: skip
        for wanted in (legs, bones):
            known = [bone for bone in wanted if bone[0] > 0 and math.isfinite(bone[1])]
            if known:
                shares, metres = zip(*known, strict=True)
                return float(sum(metres) / sum(shares))
        raise InputError("the body height needs at least one bone length, got none that is finite")


_LEG_BONE = 0.2  # share of the body height above which a bone is one of the legs


def _check_lengths(skeleton: BodySkeleton) -> None:
    n_joints, n_parts = len(skeleton.names), len(skeleton.parts)
    for field in ("parents", "part_of", "directions", "proportions"):
        if len(getattr(skeleton, field)) != n_joints:
            given = len(getattr(skeleton, field))
            raise SkeletonError(f"{field} must have one entry per joint, {n_joints}, got {given}")
    if len(skeleton.part_parents) != n_parts or not n_parts or not n_joints:
        raise SkeletonError(
            f"part_parents must have one entry per part, got {len(skeleton.part_parents)} for "
            f"{n_parts} parts; at least one part and one joint are needed"
        )
    if not all(0 <= part < n_parts for part in skeleton.part_of):
        raise SkeletonError(f"part_of must be indices of {n_parts} parts, got {skeleton.part_of}")


def _check_names(skeleton: BodySkeleton) -> None:
    for kind, names in (("joints and tips", skeleton.points), ("parts", skeleton.parts)):
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise SkeletonError(f"{kind} must have different names, twice: {', '.join(twice)}")
    for tip in skeleton.tips:
        skeleton.joint(tip.joint)
        skeleton.part(tip.part)
    for limb in skeleton.limbs:
        unknown = [end for end in (limb.start, limb.end) if end not in skeleton.points]
        if unknown:
            raise SkeletonError(
                f"limb {limb.name!r} must run between joints or tips, unknown: {', '.join(unknown)}"
            )


def other_side(name: str) -> str:
    """Return the name of a joint, part or limb on the other side; the same for one in the middle.

    >>> other_side("left_knee"), other_side("neck")
    ('right_knee', 'neck')
    """
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise InputError(f"{name} must be positive and finite, metres, got {value}")
    return value


# --- the body of 15 joints ------------------------------------------------------------------------


def _body_15() -> BodySkeleton:
    """Return `BODY_15`, its sides described once; proportions after Drillis and Contini."""
    joints: list[tuple[str, str, str, Offset, float]] = [  # name, parent, part, direction, length
        ("pelvis", "", "pelvis", (0.0, 0.0, 0.0), 0.0),
        ("neck", "pelvis", "torso", (0.0, 1.0, 0.0), 0.29),
        ("head", "neck", "head", (0.0, 1.0, 0.0), 0.10),
    ]
    parts = [("pelvis", ""), ("torso", "pelvis"), ("head", "torso")]
    tips = [
        Tip("chest", "neck", "torso", (0.0, -0.075, 0.01)),
        Tip("throat", "neck", "torso", (0.0, -0.005, 0.005)),
        Tip("chin", "neck", "head", (0.0, 0.095, 0.012)),
        Tip("crown", "neck", "head", (0.0, 0.125, 0.012)),
    ]
    limbs = [
        TaperedCylinder("head", "chin", "crown", (0.049, 0.054)),
        TaperedCylinder("neck", "throat", "chin", (0.038, 0.034)),
        TaperedCylinder("spine", "pelvis", "chest", (0.064, 0.066)),
        TaperedCylinder("shoulders", "left_shoulder", "right_shoulder", (0.036, 0.036)),
        TaperedCylinder("hips", "left_hip", "right_hip", (0.057, 0.057)),
    ]
    for side, x in (("left", 1.0), ("right", -1.0)):
        arm, forearm = f"{side}_upper_arm", f"{side}_forearm"
        thigh, shank = f"{side}_thigh", f"{side}_shank"
        shoulder, elbow, wrist = (f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist"))
        hip, knee, ankle = (f"{side}_{joint}" for joint in ("hip", "knee", "ankle"))
        joints += [
            (shoulder, "neck", "torso", (0.98 * x, -0.2, 0.0), 0.105),
            (elbow, shoulder, arm, (0.0, -1.0, 0.0), 0.172),
            (wrist, elbow, forearm, (0.0, -1.0, 0.0), 0.146),
            (hip, "pelvis", "pelvis", (1.0 * x, 0.0, 0.0), 0.052),
            (knee, hip, thigh, (0.0, -1.0, 0.0), 0.245),
            (ankle, knee, shank, (0.0, -1.0, 0.0), 0.246),
        ]
        parts += [(arm, "torso"), (forearm, arm), (thigh, "pelvis"), (shank, thigh)]
        tips += [
            Tip(f"{side}_hand", wrist, forearm, (0.0, -0.065, 0.0)),
            Tip(f"{side}_heel", ankle, shank, (0.0, -0.02, -0.022)),
            Tip(f"{side}_toe", ankle, shank, (0.0, -0.022, 0.095)),
        ]
        limbs += [
            TaperedCylinder(f"{side}_torso", shoulder, hip, (0.046, 0.057)),
            TaperedCylinder(arm, shoulder, elbow, (0.036, 0.029)),
            TaperedCylinder(forearm, elbow, f"{side}_hand", (0.028, 0.022)),
            TaperedCylinder(thigh, hip, knee, (0.056, 0.039)),
            TaperedCylinder(shank, knee, ankle, (0.038, 0.027)),
            TaperedCylinder(f"{side}_foot", f"{side}_heel", f"{side}_toe", (0.026, 0.018)),
        ]
    names = tuple(joint[0] for joint in joints)
    part_names = tuple(part for part, _ in parts)
    directions = torch.tensor([joint[3] for joint in joints], dtype=torch.float64)
    unit = torch.nn.functional.normalize(directions, dim=-1).tolist()
    return BodySkeleton(
        name="body-15",
        names=names,
        parents=tuple(names.index(joint[1]) if joint[1] else -1 for joint in joints),
        parts=part_names,
        part_of=tuple(part_names.index(joint[2]) for joint in joints),
        part_parents=tuple(part_names.index(above) if above else -1 for _, above in parts),
        directions=tuple((x, y, z) for x, y, z in unit),
        proportions=tuple(joint[4] for joint in joints),
        tips=tuple(tips),
        limbs=tuple(limbs),
    )


BODY_15 = _body_15()
"""The body of 15 joints in 11 parts with 17 limbs; its states have 36 numbers."""


# --- other joint sets -----------------------------------------------------------------------------

_SPELLINGS = {  # canonical names that may stand for a joint, the best one first
    "pelvis": ("hip_center",),
    "neck": ("lower_neck", "spine_shoulder", "neck", "shoulder_center", "upper_neck", "thorax"),
    "head": ("head",),
    "wrist": ("wrist", "hand"),
    "ankle": ("ankle", "foot"),
}
_MIDDLES = {"pelvis": ("left_hip", "right_hip"), "neck": ("left_shoulder", "right_shoulder")}
_FACE = (("ear_left", "ear_right"), ("eye_left", "eye_right"), ("nose",))  # the best one first
_NEEDED = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


def body_joints(
    joints: Float[Tensor, "*batch K C"], names: Sequence[str]
) -> Float[Tensor, "*batch 15 C"]:
    """Pick the joints of `BODY_15` out of a joint set.

    Known are HumanEva's 15 joints, Berkeley MHAD's 16, CMU's 31 (bones that stand for their far
    ends) and 23, pose2sim's 21, Kinect v1 20 and v2 25, and any other set with the same names. The
    neck is the low one (CMU lowerneck, v2 SpineShoulder, MHAD neck, HumanEva thorax) where there
    is a choice, since it moves least against the shoulders. Without a pelvis or a neck, the middle
    of hips or shoulders stands for it, and without a head that of the ears (of the one that is known: then
    a camera sees the head from the side), of the eyes, or the nose. The head of detectors
    that find ears as well, of Halpe and BODY_25B, is the crown and is not used; that of an Azure Kinect is.

    Args:
        joints: [..., K, C], metres (C = 3) or pixels (C = 2), in any axes.
        names: the K names.

    Returns:
        [..., 15, C] in the order of `BODY_15`, NaN where the set lacks a joint.

    Raises:
        ShapeError: K names and another number of joints. SkeletonError: an unknown name, a name
            twice, or no shoulders or hips.
    """
    check_shape("joints", joints, ["...", len(names), None])
    canonical = canonical_names(names)
    found = [_find(joint, canonical) for joint in BODY_15.names]
    missing = [j for j in _NEEDED if found[BODY_15.joint(j)] is None]
    if missing:
        raise SkeletonError(
            f"a whole body needs shoulders and hips; {', '.join(missing)} are not among "
            f"{', '.join(map(str, names))}; an upper body alone is for UpperBodyTracker (torchpose track), "
            "and joints that nothing measures, such as shoulders beside legs, may be NaN (empty cells)"
        )
    unknown = torch.full_like(joints[..., 0, :], torch.nan)
    picked = [unknown if i is None else joints[..., i, :] for i in found]
    for joint, (left, right) in _MIDDLES.items():
        if found[BODY_15.joint(joint)] is None:
            both = picked[BODY_15.joint(left)], picked[BODY_15.joint(right)]
            picked[BODY_15.joint(joint)] = (both[0] + both[1]) / 2
    if found[BODY_15.joint("head")] is None or _head_is_crown(canonical):
        picked[BODY_15.joint("head")] = _face(joints, canonical)
    return torch.stack(picked, -2)


def _head_is_crown(canonical: Sequence[str]) -> bool:
    """Return whether a set's head is the crown, as in sets of detectors; a Kinect's set has a chest."""
    return {"ear_left", "ear_right"} <= {*canonical} and "spine_chest" not in canonical


def _face(
    joints: Float[Tensor, "*batch K C"], canonical: Sequence[str]
) -> Float[Tensor, "*batch C"]:
    """Return the middle of the best known pair of points of the face, NaN where there is none."""
    middle = torch.full_like(joints[..., 0, :], torch.nan)
    for pair in _FACE:
        points = [canonical.index(name) for name in pair if name in canonical]
        if points:
            unknown = middle[..., :2].isnan().any(-1, keepdim=True)
            middle = torch.where(unknown, joints[..., points, :].nanmean(-2), middle)
    return middle


def _find(joint: str, canonical: Sequence[str]) -> int | None:
    side, _, kind = joint.rpartition("_")
    suffix = f"_{side}" if side else ""
    wanted = [f"{name}{suffix}" for name in _SPELLINGS.get(kind, (kind,))]
    return next((canonical.index(name) for name in wanted if name in canonical), None)
