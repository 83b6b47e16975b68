"""Define the known joint sets with their trees, and resolve the spellings of joint names.

Left and right are the person's own.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from torchpose.errors import SkeletonError

UPPER_BODY = (
    "hand_left",
    "elbow_left",
    "shoulder_left",
    "head",
    "neck",
    "shoulder_right",
    "elbow_right",
    "hand_right",
)
"""The eight joints in the order that every result of the library has."""

COCO = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip",
    "left_knee", "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
"""The 17 keypoints of COCO, with which Halpe's 26 and the 133 of COCO-WholeBody begin."""

WHOLE_BODY = (
    *COCO, "left_big_toe", "left_small_toe", "left_heel",
    "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
"""The keypoints of body and feet, with which the 133 of COCO-WholeBody begin."""

_HALPE_FEET = (
    "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel", "right_heel",
)  # fmt: skip
HALPE = dict(zip((*COCO, *_HALPE_FEET), (*range(17), *range(20, 26)), strict=True))
"""The keypoints of body and feet among Halpe's 26, with their places.

The three between are left out: the head is the crown, and neck and pelvis are middles.
"""

# --- names ----------------------------------------------------------------------------------------

# canonical part: other words for it. Words are compared without case, blanks and punctuation.
_SIDED = {
    "hand": "",
    "wrist": "radius",  # a CMU bone stands for its far end
    "elbow": "humerus",
    "shoulder": "",
    "hip": "hipjoint",
    "knee": "femur",
    "ankle": "tibia",
    "foot": "",
    "toe": "toes toebase",
    "big_toe": "",
    "small_toe": "",
    "foot_index": "",
    "heel": "",
    "eye": "",
    "eye_inner": "",
    "eye_outer": "",
    "ear": "",
    "mouth": "",
    "clavicle": "",
    "thumb": "",
    "index": "",
    "pinky": "",
    "fingers": "",
    "hand_tip": "",
}
_CENTRAL = {
    "head": "",
    "neck": "",
    "nose": "",
    "upper_neck": "",
    "lower_neck": "",
    "shoulder_center": "shouldercentre",
    "spine_shoulder": "",
    "thorax": "",
    "upper_back": "",
    "lower_back": "",
    "spine_chest": "",
    "spine": "spinemid torso",
    "spine_navel": "spinenaval",
    "hip_center": "hipcentre midhip chip pelvis root spinebase",  # chip: of Pose2Sim
}


_ASF_BONES = {
    "lclavicle": "shoulder_left",
    "rclavicle": "shoulder_right",
    "lwrist": "wrist_end_left",
    "rwrist": "wrist_end_right",
}


@lru_cache(maxsize=4096)
def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _known_names() -> dict[str, str]:
    known = {}
    for part, words in _CENTRAL.items():
        known.update({_key(word): part for word in (part, *words.split())})
    for part, words in _SIDED.items():
        for side in ("left", "right"):
            for word in (_key(w) for w in (part, *words.split())):
                spellings = (side + word, word + side, side[0] + word, word + side[0])
                known.update(dict.fromkeys(spellings, f"{part}_{side}"))
    return known


_KNOWN = _known_names()


def canonical_name(name: str) -> str:
    """Return the one name of a joint: ``part_side`` or ``part``, in lower case.

    Accepted are left_X, X_left, lX, LX, XLeft, LeftX, X_l and X.L, in any case.

    Args:
        name: a joint's name as files spell it.

    Returns:
        The canonical name.

    Raises:
        SkeletonError: not a known name; the known ones are listed.

    >>> [canonical_name(n) for n in ("LWrist", "left_hand", "ElbowRight", "lhumerus", "Neck")]
    ['wrist_left', 'hand_left', 'elbow_right', 'elbow_left', 'neck']
    """
    try:
        return _KNOWN[_key(name)]
    except KeyError:
        raise SkeletonError(
            f"unknown joint name {name!r}; known are, for each side, {', '.join(_SIDED)} "
            f"(as left_X, X_left, lX, LX or XLeft) and {', '.join(_CENTRAL)}; "
            "a wrist counts as the hand where there is no hand"
        ) from None


def canonical_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the canonical names of a joint set.

    In CMU's ASF files a name is a bone that stands for its far end: the clavicle ends at the
    shoulder and the radius at the wrist; the bone called wrist that follows is ``wrist_end`` here.

    Raises:
        SkeletonError: an unknown name, or two names of one joint.
    """
    canonical = [canonical_name(str(name)) for name in names]
    keys = [_key(str(name)) for name in names]
    if {"lhumerus", "rhumerus", "lradius", "rradius"} & set(keys):
        canonical = [_ASF_BONES.get(k, c) for k, c in zip(keys, canonical, strict=True)]
    twice = sorted({c for c in canonical if canonical.count(c) > 1})
    if twice:
        same = [str(n) for n, c in zip(names, canonical, strict=True) if c == twice[0]]
        raise SkeletonError(f"{' and '.join(same)} are both {twice[0]}; a joint may be there once")
    return tuple(canonical)


# --- joint sets -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Skeleton:
    """Describes a joint set and its kinematic tree.

    Args:
        name: the name of the set.
        joints: names in the order of the files.
        parents: index of each joint's parent, -1 for the root.
        axes: the axes of files that do not state them: ``camera``, ``kinect``, ``y-up`` or ``z-up``.
        neck: kind of neck, or None if it must be measured or there is none.
        hand: ``"hand"``, ``"wrist"`` or None.
        turned: whether people face anywhere, so that files are turned towards the camera.
    """

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    axes: str
    neck: str | None = None
    hand: str | None = None
    turned: bool = False

    def reordered(self, joints: Sequence[str]) -> "Skeleton":
        """Return the same set with its joints in another order and spelling.

        Args:
            joints: all names of the set, in the new order, in any known spelling.

        Returns:
            `Skeleton` with these names, and the parents' indices in the new order.

        Raises:
            SkeletonError: an unknown name, or one name twice.
        """
        own, other = canonical_names(self.joints), canonical_names(joints)
        parent = {c: (own[p] if p >= 0 else None) for c, p in zip(own, self.parents, strict=True)}
        parents = tuple(-1 if parent[c] is None else other.index(str(parent[c])) for c in other)
        return replace(self, joints=tuple(joints), parents=parents)


def _of_both_sides(template: str) -> str:
    return f"{template.format('left')} {template.format('right')}"


_KINECT_V1 = "hip_center spine shoulder_center head " + " ".join(
    _of_both_sides(t)
    for t in (
        "{0}_shoulder {0}_elbow {0}_wrist {0}_hand",
        "{0}_hip {0}_knee {0}_ankle {0}_foot",
    )
)
_KINECT_V2 = (
    "SpineBase SpineMid Neck Head ShoulderLeft ElbowLeft WristLeft HandLeft ShoulderRight "
    "ElbowRight WristRight HandRight HipLeft KneeLeft AnkleLeft FootLeft HipRight KneeRight "
    "AnkleRight FootRight SpineShoulder HandTipLeft ThumbLeft HandTipRight ThumbRight"
)
_AZURE = (
    "PELVIS SPINE_NAVEL SPINE_CHEST NECK CLAVICLE_LEFT SHOULDER_LEFT ELBOW_LEFT WRIST_LEFT "
    "HAND_LEFT HANDTIP_LEFT THUMB_LEFT CLAVICLE_RIGHT SHOULDER_RIGHT ELBOW_RIGHT WRIST_RIGHT "
    "HAND_RIGHT HANDTIP_RIGHT THUMB_RIGHT HIP_LEFT KNEE_LEFT ANKLE_LEFT FOOT_LEFT HIP_RIGHT "
    "KNEE_RIGHT ANKLE_RIGHT FOOT_RIGHT HEAD NOSE EYE_LEFT EAR_LEFT EYE_RIGHT EAR_RIGHT"
)
_MHAD = (
    "hip_center "
    + _of_both_sides("{0}_hip {0}_knee {0}_ankle {0}_toe")
    + " neck "
    + _of_both_sides("{0}_shoulder {0}_elbow {0}_wrist")
)
_CMU_ASF = (
    "root lhipjoint rhipjoint lowerback upperback thorax lowerneck lclavicle rclavicle rhumerus "
    "rradius rwrist rhand rthumb rfingers lhumerus lradius lwrist lhand lthumb lfingers upperneck "
    "head rfemur rtibia rfoot rtoes lfemur ltibia lfoot ltoes"
)
_CMU_ACTIONS = (
    "root "
    + _of_both_sides("{0}_hip {0}_knee {0}_ankle {0}_foot {0}_toe")
    + " lowerback upperback thorax lowerneck upperneck head "
    + _of_both_sides("{0}_shoulder {0}_elbow {0}_wrist")
)
_HUMANEVA = (
    "pelvis thorax "
    + _of_both_sides("{0}_shoulder {0}_elbow {0}_wrist")
    + " "
    + _of_both_sides("{0}_hip {0}_knee {0}_ankle")
    + " head"
)
_POSE2SIM = (
    "RHip RKnee RAnkle RBigToe RSmallToe RHeel LHip LKnee LAnkle LBigToe LSmallToe LHeel Neck Head "
    "Nose RShoulder RElbow RWrist LShoulder LElbow LWrist"
)
_COCO_18 = (
    "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist RHip RKnee RAnkle LHip LKnee LAnkle "
    "REye LEye REar LEar"
)
_BODY_25 = (
    "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle LHip LKnee "
    "LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
)


def _skeleton(
    name: str,
    joints: str,
    parents: str,
    axes: str,
    neck: str | None = None,
    hand: str | None = None,
    turned: bool = False,
) -> Skeleton:
    tree = tuple(int(p) for p in parents.split())
    return Skeleton(name, tuple(joints.split()), tree, axes, neck, hand, turned)


SKELETONS = {
    s.name: s
    for s in (
        _skeleton("upper-body-8", " ".join(UPPER_BODY), "1 2 4 4 -1 4 5 6", "camera"),
        _skeleton(
            "kinect-v1-20",
            _KINECT_V1,
            "-1 0 1 2 2 4 5 6 2 8 9 10 0 12 13 14 0 16 17 18",
            "kinect", "neck", "hand",
        ),
        _skeleton(
            "kinect-v2-25",
            _KINECT_V2,
            "-1 0 20 2 20 4 5 6 20 8 9 10 0 12 13 14 0 16 17 18 1 7 6 11 10",
            "kinect", "neck", "hand",
        ),
        _skeleton(
            "azure-32",
            _AZURE,
            "-1 0 1 2 2 4 5 6 7 8 7 2 11 12 13 14 15 14 0 18 19 20 0 22 23 24 3 26 26 26 26 26",
            "kinect", "neck", "hand",
        ),
        _skeleton(
            "mhad-16", _MHAD, "-1 0 1 2 3 0 5 6 7 0 9 10 11 9 13 14", "y-up", "low-neck", "wrist"
        ),
        _skeleton(
            "cmu-31",
            _CMU_ASF,
            "-1 0 0 0 3 4 5 5 5 8 9 10 11 11 12 7 15 16 17 17 18 6 21 2 23 24 25 1 27 28 29",
            "y-up", "neck", "hand", True,
        ),
        _skeleton(
            "cmu-23",
            _CMU_ACTIONS,
            "-1 0 1 2 3 4 0 6 7 8 9 0 11 12 13 14 15 12 17 18 12 20 21",
            "y-up", "neck", "wrist", True,
        ),
        _skeleton(
            "humaneva-15",
            _HUMANEVA,
            "-1 0 1 2 3 1 5 6 0 8 9 0 11 12 1",
            "z-up", None, "wrist", True,
        ),
        _skeleton(
            "pose2sim-21",
            _POSE2SIM,
            "12 0 1 2 2 2 12 6 7 8 8 8 -1 12 13 12 15 16 12 18 19",
            "z-up", None, "wrist", True,
        ),
        _skeleton(
            "openpose-18",
            _COCO_18,
            "1 -1 1 2 3 1 5 6 1 8 9 1 11 12 0 0 14 15",
            "camera", "mid-shoulder", "wrist",
        ),
        _skeleton(
            "openpose-25",
            _BODY_25,
            "1 -1 1 2 3 1 5 6 1 8 9 10 8 12 13 0 0 15 16 14 19 14 11 22 11",
            "camera", "mid-shoulder", "wrist",
        ),
    )
}  # fmt: skip
"""Every joint set that is known, by name."""

_BY_JOINTS = {frozenset(canonical_names(s.joints)): s for s in SKELETONS.values()}


def identify_skeleton(names: Sequence[str]) -> Skeleton | None:
    """Return the known joint set with these joints, in any order and spelling, or None.

    Args:
        names: joint names.

    Returns:
        The `Skeleton`, with its joints in the order of `names`.

    Raises:
        SkeletonError: an unknown name, or two names of one joint.

    >>> identify_skeleton(["LeftHand", "LeftElbow"]) is None
    True
    >>> identify_skeleton(UPPER_BODY).name
    'upper-body-8'
    """
    canonical = canonical_names(names)
    found = _BY_JOINTS.get(frozenset(canonical))
    if found is None and len(canonical) == len(UPPER_BODY):  # eight joints with wrists
        as_hands = [c.replace("wrist", "hand") for c in canonical]
        if set(as_hands) == set(UPPER_BODY) and not any("hand" in c for c in canonical):
            found = replace(SKELETONS["upper-body-8"].reordered(as_hands), hand="wrist")
            return replace(found, joints=tuple(str(n) for n in names))
    return None if found is None else found.reordered([str(n) for n in names])
