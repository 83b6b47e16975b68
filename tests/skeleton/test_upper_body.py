"""Joint names, joint sets, and the eight joints, against the data sets' own files and by hand."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.data import data_dir_or_skip
from torchpose.errors import ShapeError, SkeletonError
from torchpose.skeleton import (
    LEFT_ARM,
    RIGHT_ARM,
    SKELETONS,
    UPPER_BODY,
    canonical_name,
    to_upper_body,
    upper_body_indices,
)
from torchpose.skeleton._joint_sets import canonical_names, identify_skeleton
from torchpose.skeleton._upper_body import ARM_JOINTS, LIMBS, measure_neck_kind

SPELLINGS = [
    lambda p, s: f"{s}_{p}",
    lambda p, s: f"{p}_{s}",
    lambda p, s: f"{s[0]}{p.capitalize()}",
    lambda p, s: f"{s[0]}{p}",
    lambda p, s: f"{s[0].upper()}{p.capitalize()}",
    lambda p, s: f"{p.capitalize()}{s.capitalize()}",
    lambda p, s: f"{s.capitalize()} {p}",
    lambda p, s: f"{p.upper()}_{s.upper()}",
    lambda p, s: f"{p}.{s[0].upper()}",
]


def test_the_two_arms():
    assert [UPPER_BODY[i].split("_")[0] for i in LEFT_ARM] == list(ARM_JOINTS)
    assert [UPPER_BODY[i].split("_")[0] for i in RIGHT_ARM] == list(ARM_JOINTS)
    assert all("right" not in UPPER_BODY[i] for i in LEFT_ARM)
    assert all("left" not in UPPER_BODY[i] for i in RIGHT_ARM)
    ends = [UPPER_BODY[i] + "-" + UPPER_BODY[j] for i, j in LIMBS]
    assert len(set(ends)) == 7  # a tree over eight joints


@pytest.mark.parametrize("spell", SPELLINGS)
def test_spellings(spell):
    for part, side in itertools.product(
        ("hand", "wrist", "elbow", "shoulder", "knee"), ("left", "right")
    ):
        assert canonical_name(spell(part, side)) == f"{part}_{side}"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Neck", "neck"),
        ("SHOULDER_CENTER", "shoulder_center"),
        ("SpineBase", "hip_center"),
        ("MidHip", "hip_center"),
        ("CHip", "hip_center"),
        ("pelvis", "hip_center"),
        ("lhumerus", "elbow_left"),
        ("rradius", "wrist_right"),
        ("ltibia", "ankle_left"),
        ("LBigToe", "big_toe_left"),
        ("REar", "ear_right"),
        ("left_eye_inner", "eye_inner_left"),
    ],
)
def test_other_words(name, expected):
    assert canonical_name(name) == expected


@pytest.mark.parametrize("name", ["", "left", "tail", "hand", "left_left_hand", "head_left", "7"])
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(SkeletonError, match=r"known are.*hand.*left_X.*neck.*wrist counts as"):
        canonical_name(name)


def test_a_canonical_name_is_its_own():
    for skeleton in SKELETONS.values():
        for name in canonical_names(skeleton.joints):
            if "wrist_end" not in name:
                assert canonical_name(name) == name


@pytest.mark.parametrize("name", SKELETONS)
def test_joint_sets_are_trees(name):
    skeleton = SKELETONS[name]
    n = len(skeleton.joints)
    assert len(skeleton.parents) == n == int(name.rsplit("-", 1)[1])
    assert skeleton.parents.count(-1) == 1
    for joint in range(n):
        steps = 0
        while joint >= 0:
            joint, steps = skeleton.parents[joint], steps + 1
            assert steps <= n
    names = canonical_names(skeleton.joints)
    for child, parent in enumerate(skeleton.parents):  # no bone crosses from left to right
        sides = {names[i].rsplit("_", 1)[-1] for i in (child, parent) if i >= 0}
        assert not {"left", "right"} <= sides


@pytest.mark.parametrize("name", SKELETONS)
@settings(deadline=None, max_examples=30)
@given(data=st.data())
def test_a_joint_set_is_found_in_any_order(name, data):
    skeleton = SKELETONS[name]
    order = data.draw(st.permutations(range(len(skeleton.joints))))
    found = identify_skeleton([skeleton.joints[i] for i in order])
    assert found is not None
    assert found.name == name
    for new, old in enumerate(order):
        parent, expected = found.parents[new], skeleton.parents[old]
        assert (parent, expected) == (-1, -1) or order[parent] == expected


def test_other_sets_are_none():
    assert identify_skeleton(["head", "neck"]) is None
    assert identify_skeleton([*UPPER_BODY, "nose"]) is None
    with_wrists = identify_skeleton([n.replace("hand", "wrist") for n in UPPER_BODY])
    assert with_wrists is not None
    assert (with_wrists.name, with_wrists.hand) == ("upper-body-8", "wrist")


EXPECTED_KINDS = {
    "upper-body-8": ((), None, "hand"),
    "kinect-v1-20": ((), "neck", "hand"),
    "kinect-v2-25": ((), "neck", "hand"),
    "azure-32": ((), "neck", "hand"),
    "mhad-16": (("head",), "low-neck", "wrist"),
    "cmu-31": ((), "neck", "hand"),
    "cmu-23": ((), "neck", "wrist"),
    "humaneva-15": (("neck",), None, "wrist"),
    "pose2sim-21": ((), None, "wrist"),
    "openpose-18": (("head",), "mid-shoulder", "wrist"),
    "openpose-25": (("head",), "mid-shoulder", "wrist"),
}


@pytest.mark.parametrize("name", SKELETONS)
def test_the_eight_joints_of_every_set(name):
    found = upper_body_indices(SKELETONS[name].joints)
    assert (found.missing, found.neck, found.hand) == EXPECTED_KINDS[name]
    sides = [SKELETONS[name].joints[i] for i in found.indices[:3] if i >= 0]
    assert all(canonical_name(joint).endswith("_left") for joint in sides)


def test_cmu_bones_stand_for_their_far_ends():
    joints = SKELETONS["cmu-31"].joints
    found = upper_body_indices(joints)
    expected = "lhand lhumerus lclavicle head upperneck rclavicle rhumerus rhand"
    assert [joints[i] for i in found.indices] == expected.split()


def test_hand_before_wrist_and_nose_on_request():
    assert upper_body_indices(["lwrist", "rwrist", "lhand", "rhand"]).indices[0] == 2
    assert upper_body_indices(["lwrist", "rwrist", "head"]).hand == "wrist"
    assert upper_body_indices(["lwrist", "lhand", "rwrist"]).hand == "wrist"
    assert upper_body_indices(["rhand", "head"]).hand == "hand"
    with pytest.raises(SkeletonError, match="hand on the left and a wrist on the right"):
        upper_body_indices(["lhand", "rwrist"])
    assert upper_body_indices(["nose", "neck"]).head is None
    assert upper_body_indices(["nose", "neck"], nose_as_head=True)[::4] == (
        (-1, -1, -1, 0, 1, -1, -1, -1),
        "nose",
    )
    assert upper_body_indices(["nose", "head"], nose_as_head=True).head == "head"


def test_names_that_do_not_tell_the_neck():
    assert upper_body_indices(["head", "neck", "lhand", "rhand"]).neck is None
    assert upper_body_indices(["shoulder_center"]).neck == "neck"
    assert upper_body_indices(["SpineShoulder"]).neck == "low-neck"


def test_bad_names():
    with pytest.raises(SkeletonError, match="both hand_left"):
        upper_body_indices(["left_hand", "HandLeft"])
    with pytest.raises(SkeletonError, match="found only lknee"):
        upper_body_indices(["lknee"])
    with pytest.raises(SkeletonError, match="found only"):
        upper_body_indices([])


def test_to_upper_body():
    joints = torch.arange(2 * 4 * 3, dtype=torch.float64).reshape(2, 4, 3)
    upper = to_upper_body(joints, ["rwrist", "head", "knee_left", "LShoulder"])
    assert upper.joints.shape == (2, 8, 3)
    torch.testing.assert_close(upper.joints[:, [7, 3, 2]], joints[:, [0, 1, 3]])
    assert upper.joints[:, [0, 1, 4, 5, 6]].isnan().all()
    assert (upper.neck, upper.hand, upper.head) == (None, "wrist", "head")
    pixels = to_upper_body(joints[..., :2].float(), ["rwrist", "head", "knee_left", "LShoulder"])
    assert pixels.joints.dtype == torch.float32
    with pytest.raises(ShapeError, match="joints"):
        to_upper_body(joints, ["head"])


@pytest.mark.parametrize(
    ("height", "kind"),
    [(0.0, "mid-shoulder"), (0.01, "mid-shoulder"), (0.04, "low-neck"), (0.107, "neck")],
)
def test_the_neck_is_measured(height, kind):
    joints = torch.zeros(5, 8, 3, dtype=torch.float64)
    joints[:, 2, 0], joints[:, 5, 0] = 0.17, -0.17
    joints[:, 4, 1] = -height
    assert measure_neck_kind(joints) == kind
    assert to_upper_body(joints, UPPER_BODY).neck == kind
    joints[0] = torch.nan
    assert measure_neck_kind(joints) == kind
    joints[:, 2] = torch.nan
    assert measure_neck_kind(joints) is None


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("burke_kinect", "upper-body-8"),
        ("kinect_utd_mhad", "kinect-v1-20"),
        ("mocap_berkeley_mhad", "mhad-16"),
        ("mocap_cmu_actions", "cmu-23"),
        ("mocap_cmu_walk", "cmu-31"),
        ("multicam_pose2sim", "pose2sim-21"),
        ("utd_mhad_silhouettes", "kinect-v1-20"),
    ],
)
def test_joint_sets_are_those_of_the_files(folder, name):
    path = sorted(data_dir_or_skip(folder).glob("*.npz"))[0]
    with np.load(path) as file:
        assert tuple(file["names"]) == SKELETONS[name].joints
        if "parents" in file:
            assert tuple(file["parents"]) == SKELETONS[name].parents


@pytest.mark.data
def test_measured_heights_of_necks():
    """The heights that tell the kinds apart, on real persons."""
    heights = {"kinect_utd_mhad": ("neck", 0.09, 0.13), "mocap_berkeley_mhad": ("low-neck", 0, 0.075),
               "burke_kinect": ("mid-shoulder", 0, 0.001)}  # fmt: skip
    for folder, (kind, low, high) in heights.items():
        path = sorted(data_dir_or_skip(folder).glob("*.npz"))[0]
        with np.load(path) as file:
            upper = to_upper_body(torch.from_numpy(file["joints"]).double(), list(file["names"]))
        gap = upper.joints[:, 4] - (upper.joints[:, 2] + upper.joints[:, 5]) / 2
        assert low <= float(gap.norm(dim=-1).median()) <= high
        assert upper.neck == kind
