"""Axes: where right, up and forward of each kind of file end up, and who is upside down."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.errors import FileFormatError, InputError
from torchpose.io._formats.axes import (
    AXES,
    axes_rotation,
    check_upright,
    default_axes,
    heading,
    note_on_lying,
    note_on_mirroring,
)
from torchpose.skeleton import SKELETONS, UPPER_BODY

NAMES = ("head", "shoulder_left", "shoulder_right", "hip_left", "hip_right")
# A person who faces the camera, in camera axes: left at larger x, head up (smaller y).
FACING = torch.tensor(
    [[0, -0.3, 0], [0.2, 0, 0], [-0.2, 0, 0], [0.1, 0.5, 0], [-0.1, 0.5, 0]], dtype=torch.float64
)
# The same person in the axes of each kind of file.
WRITTEN = {
    "camera": FACING,
    "kinect": FACING * torch.tensor([-1.0, -1, 1]),
    "y-up": FACING * torch.tensor([1.0, -1, -1]),
    "z-up": torch.stack([FACING[:, 0], FACING[:, 2], -FACING[:, 1]], -1),
}


def about_vertical(angle: float, axis: int) -> torch.Tensor:
    i, j = [k for k in range(3) if k != axis]
    R = torch.eye(3, dtype=torch.float64)
    R[i, i] = R[j, j] = math.cos(angle)
    R[i, j], R[j, i] = -math.sin(angle), math.sin(angle)
    return R


@pytest.mark.parametrize("axes", AXES)
def test_everybody_ends_up_facing_the_camera(axes):
    joints = WRITTEN[axes].expand(4, 5, 3)
    M = axes_rotation(joints, NAMES, axes)
    torch.testing.assert_close(joints @ M.mT, FACING.expand(4, 5, 3))
    assert float(torch.linalg.det(M)) == pytest.approx(1)


@settings(deadline=None, max_examples=40)
@given(st.floats(-3.1, 3.1), st.sampled_from(["y-up", "z-up"]))
def test_rooms_are_turned_towards_the_camera(angle, axes):
    turned = WRITTEN[axes] @ about_vertical(angle, 1 if axes == "y-up" else 2).mT
    joints = turned.expand(3, 5, 3)
    M = axes_rotation(joints, NAMES, axes)
    torch.testing.assert_close(joints @ M.mT, FACING.expand(3, 5, 3))


@pytest.mark.parametrize(
    ("written", "said"), [("y-up", "z-up"), ("z-up", "y-up"), ("kinect", "z-up")]
)
def test_axes_that_exchange_up_and_forwards_are_doubted(written, said):
    joints = WRITTEN[written].expand(4, 5, 3)
    right, wrong = (joints @ axes_rotation(joints, NAMES, axes).mT for axes in (written, said))
    [note] = note_on_lying(wrong, NAMES)
    assert "90 degrees" in note and "axes.txt" in note
    assert note_on_lying(right, NAMES) == [] == note_on_lying(wrong[:, 1:3], NAMES[1:3])


def test_without_hips_the_head_is_compared_with_the_shoulders():
    lying = eight(0.0, 0.4)
    lying[:, 3, 2] = -0.3
    [note] = note_on_lying(lying, UPPER_BODY)
    assert "from the shoulders to the head it is 90 degrees" in note
    assert note_on_lying(eight(-0.25, 0.4), UPPER_BODY) == []


@pytest.mark.parametrize("ends", [("hand",), ("big_toe",), ("foot", "wrist")])
def test_mirrored_joints_are_told_from_turned_ones(ends):
    parts, sides = ("ankle", *ends), {"left": 0.2, "right": -0.2}
    names = (*NAMES, *(f"{part}_{side}" for part in parts for side in sides))
    more = [[x, 1.0, -0.1 * (part in ends)] for part in parts for x in sides.values()]
    facing = torch.cat([FACING, torch.tensor(more, dtype=torch.float64)]).expand(3, -1, 3)
    turned = facing @ about_vertical(2.5, 1).mT
    for mirror in ([-1.0, 1, 1], [1.0, 1, -1]):
        [note] = note_on_mirroring(turned * torch.tensor(mirror), names)
        assert "mirrored" in note and "no --axes corrects" in note
    assert note_on_mirroring(turned, names) == [] == note_on_mirroring(facing[:, :5], NAMES)
    assert note_on_mirroring(facing[:, :1], NAMES[:1]) == []


def test_a_camera_is_never_turned():
    turned = FACING @ about_vertical(1.0, 1).mT
    M = axes_rotation(turned[None], NAMES, "camera")
    torch.testing.assert_close(M, torch.eye(3, dtype=torch.float64))
    assert heading(FACING[None], NAMES) == pytest.approx(0)


def test_the_mhad_set_is_not_turned():
    skeleton = SKELETONS["mhad-16"]
    joints = torch.randn(3, 16, 3, dtype=torch.float64)
    M = axes_rotation(joints, skeleton.joints, "y-up")
    torch.testing.assert_close(M, torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)))


def test_heading_is_a_mean_over_frames_and_leaves_out_missing_ones():
    frames = [FACING @ about_vertical(a, 1).mT for a in (-0.2, 0.0, 0.5)]
    joints = torch.stack([*frames, torch.full_like(FACING, math.nan)])
    expected = -math.atan2(
        sum(math.sin(a) for a in (-0.2, 0, 0.5)), sum(math.cos(a) for a in (-0.2, 0, 0.5))
    )
    assert abs(heading(joints, NAMES)) == pytest.approx(abs(expected))
    # facing the person's own left is facing to the right of the picture
    to_the_left = torch.stack(
        [torch.zeros(3), torch.tensor([0, 0, 0.2]), torch.tensor([0, 0, -0.2])]
    )
    assert heading(to_the_left[None], NAMES[:3]) == pytest.approx(math.pi / 2)
    assert heading(joints[:, :1], NAMES[:1]) is None
    assert heading(joints[-1:], NAMES) is None


@pytest.mark.parametrize(
    ("wrong", "right"), [("camera", "kinect"), ("kinect", "camera"), ("camera", "y-up")]
)
def test_upside_down(wrong, right):
    joints = WRITTEN[right].expand(5, 5, 3)
    upside_down = joints @ axes_rotation(joints, NAMES, wrong).mT
    with pytest.raises(FileFormatError, match=r"walk.npz.*head lies 80 cm below the hips"):
        check_upright("walk.npz", upside_down, NAMES)
    check_upright("walk.npz", joints @ axes_rotation(joints, NAMES, right).mT, NAMES)


def eight(head: float, hands: float) -> torch.Tensor:
    joints = torch.zeros(7, 8, 3, dtype=torch.float64)
    joints[:, 3, 1], joints[:, [0, 7], 1] = head, hands
    return joints


def test_eight_joints_have_no_hips():
    check_upright("a.npz", eight(-0.25, 0.4), UPPER_BODY)
    check_upright("a.npz", eight(-0.25, -0.6), UPPER_BODY)  # both hands held up all the time
    with pytest.raises(FileFormatError, match=r"a.npz.*below the shoulders"):
        check_upright("a.npz", eight(0.25, -0.4), UPPER_BODY)


def test_only_head_and_hands():
    names, rows = ("hand_left", "head", "hand_right"), [0, 3, 7]
    check_upright("a.npz", eight(-0.25, 0.4)[:, rows], names)
    with pytest.raises(FileFormatError, match=r"a.npz.*below the hands"):
        check_upright("a.npz", eight(0.25, -0.4)[:, rows], names)


def test_single_frames_may_be_upside_down():
    joints = FACING.repeat(5, 1, 1)
    joints[0] = joints[0] * torch.tensor([1.0, -1, 1])
    joints[1] = math.nan
    check_upright("a.npz", joints, NAMES)


def test_millimetres_are_no_metres():
    with pytest.raises(FileFormatError, match=r"a.npz.*800 m.*millimetres"):
        check_upright("a.npz", 1000 * FACING[None], NAMES)


def test_axes_of_joint_sets():
    expected = {
        "upper-body-8": "camera", "kinect-v1-20": "kinect", "kinect-v2-25": "kinect",
        "azure-32": "kinect", "mhad-16": "y-up", "cmu-31": "y-up", "cmu-23": "y-up",
        "humaneva-15": "z-up", "pose2sim-21": "z-up",
    }  # fmt: skip
    for name, axes in expected.items():
        assert default_axes("a.npz", SKELETONS[name].joints) == axes
    with pytest.raises(FileFormatError, match=r"a.npz.*no known set.*camera, kinect, y-up, z-up"):
        default_axes("a.npz", NAMES)


def test_other_axes():
    with pytest.raises(InputError, match=r"camera, kinect, y-up, z-up.*x-up"):
        axes_rotation(FACING[None], NAMES, "x-up")
