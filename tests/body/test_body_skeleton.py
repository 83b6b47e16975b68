"""The skeleton of 15 joints, what is refused, and the map of joint sets to it."""

from dataclasses import replace

import pytest
import torch

from torchpose.body import BODY_15, TaperedCylinder, Tip, body_joints
from torchpose.body._skeleton import tree_levels
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.skeleton import SKELETONS

WHOLE = [
    "humaneva-15",
    "mhad-16",
    "cmu-31",
    "cmu-23",
    "pose2sim-21",
    "kinect-v1-20",
    "kinect-v2-25",
]


def numbered(name):
    """Every joint of a set at its own index along x."""
    names = SKELETONS[name].joints
    x = torch.arange(len(names), dtype=torch.float64)
    return torch.stack([x, 0 * x, 0 * x], -1), list(names)


def test_the_body_has_both_sides():
    assert (len(BODY_15.names), len(BODY_15.parts), BODY_15.dim) == (15, 11, 36)
    assert BODY_15.names[:4] == ("pelvis", "neck", "head", "left_shoulder")
    mirrored = [BODY_15.limbs[i].name for i in BODY_15.mirrored_limbs]
    assert mirrored[5:11] == [limb.name for limb in BODY_15.limbs[11:]]
    assert mirrored[:5] == ["head", "neck", "spine", "shoulders", "hips"]
    directions = torch.tensor(BODY_15.directions)
    torch.testing.assert_close(directions.norm(dim=-1)[1:], torch.ones(14))


@pytest.mark.parametrize("name", WHOLE)
def test_every_joint_of_known_sets_is_found(name):
    joints, names = numbered(name)
    body = body_joints(joints.expand(4, -1, -1), names)
    assert body.shape == (4, 15, 3)
    without = {"mhad-16": ["head"]}.get(name, [])
    unknown = torch.isnan(body[0, :, 0])
    assert [BODY_15.names[i] for i in torch.nonzero(unknown).flatten()] == without
    sides = {names[int(x)]: n for n, x in zip(BODY_15.names, body[0, :, 0], strict=True)
             if float(x).is_integer()}  # fmt: skip
    for theirs, ours in sides.items():
        if ours.startswith(("left", "right")):
            assert theirs.lower()[0] == ours[0] or ours.split("_")[0] in theirs.lower()


def test_bones_of_cmu_stand_for_their_far_ends():
    joints, names = numbered("cmu-31")
    found = dict(zip(BODY_15.names, body_joints(joints, names)[:, 0].tolist(), strict=True))
    theirs = {ours: names[int(i)] for ours, i in found.items()}
    assert [theirs[f"left_{j}"] for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")] == [
        "lclavicle", "lhumerus", "lradius", "lhipjoint", "lfemur", "ltibia",
    ]  # fmt: skip
    assert (theirs["neck"], theirs["pelvis"]) == ("lowerneck", "root")


def test_the_low_neck_is_taken_and_middles_stand_in():
    joints, names = numbered("kinect-v2-25")
    assert names[int(body_joints(joints, names)[1, 0])] == "SpineShoulder"
    joints, names = numbered("pose2sim-21")
    hips = (names.index("LHip") + names.index("RHip")) / 2
    assert float(body_joints(joints, names)[0, 0]) == hips


def test_a_head_beside_ears_is_the_crown_unless_a_kinect_has_it():
    head = BODY_15.joint("head")
    joints, names = numbered("openpose-25")
    with_crown = torch.cat([joints, torch.full_like(joints[:1], 99.0)])
    ears = (names.index("LEar") + names.index("REar")) / 2
    assert float(body_joints(with_crown, [*names, "Head"])[head, 0]) == ears
    joints, names = numbered("azure-32")
    assert names[int(body_joints(joints, names)[head, 0])] == "HEAD"


def test_joints_of_other_sets_are_refused():
    joints, names = numbered("upper-body-8")
    with pytest.raises(SkeletonError, match="left_hip, right_hip are not among"):
        body_joints(joints, names)
    with pytest.raises(ShapeError):
        body_joints(joints[:5], names)
    with pytest.raises(SkeletonError, match="unknown joint name"):
        body_joints(joints, [*names[:-1], "tail"])


def test_levels_and_cycles():
    assert tree_levels((-1, 0, 1, 0), "abcd") == ((0,), (1, 3), (2,))
    with pytest.raises(SkeletonError, match="cycle or hang on: c, d"):
        tree_levels((-1, 0, 3, 2), "abcd")
    parents = list(BODY_15.parents)
    parents[BODY_15.joint("left_shoulder")] = BODY_15.joint("left_wrist")
    with pytest.raises(SkeletonError, match="cycle"):
        replace(BODY_15, parents=tuple(parents))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parents": BODY_15.parents[:-1]}, "one entry per joint"),
        ({"part_parents": (-1, 0)}, "one entry per part"),
        ({"part_of": (*BODY_15.part_of[:-1], 99)}, "indices of 11 parts"),
        ({"parents": (*BODY_15.parents[:-1], -1)}, "only roots"),
        ({"names": ("neck", *BODY_15.names[1:])}, "twice: neck"),
        ({"tips": (Tip("crown", "nose", "head", (0, 0, 0)),)}, "no joint 'nose'"),
        ({"limbs": (TaperedCylinder("tail", "pelvis", "end", (0, 0)),)}, "unknown: end"),
        ({"part_of": (*BODY_15.part_of[:-1], 1)}, "does not meet"),
    ],
)
def test_skeletons_that_do_not_hold_together(change, message):
    with pytest.raises(SkeletonError, match=message):
        replace(BODY_15, **change)


def test_height_by_the_legs():
    lengths = BODY_15.standard_lengths(1.8)
    assert BODY_15.height(lengths) == pytest.approx(1.8)
    lengths[BODY_15.joint("left_wrist")] = 9.0  # arms do not count
    lengths[BODY_15.joint("right_knee")] = torch.nan
    assert BODY_15.height(lengths) == pytest.approx(1.8)
    with pytest.raises(InputError, match="at least one bone length"):
        BODY_15.height(torch.full_like(lengths, torch.nan))
    with pytest.raises(InputError, match="height must be positive"):
        BODY_15.standard_radii(0.0)
